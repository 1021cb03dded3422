"""What is killed: the command line's long runs, small enough to be run many times."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from training.studies.reliability.files.samples import carmen

__all__ = ["COMMANDS", "KilledCommand", "inputs", "installed"]

_TRAIN = """
[world]
rooms = ["rectangular"]
time_limit_s = 20.0
[ppo]
steps = 64
environments = 2
n_steps = 8
chunk = 1
batch_size = 16
[evaluation]
episodes = 1
every = 2
"""
_BENCHMARK = (
    "benchmark", "--suite", "rooms", "--agents", "nearest-frontier,random", "--seeds", "0:5", "--max-steps", "40",
)  # fmt: skip
_STUDY = (
    "study", "recovery", "--rooms", "rectangular", "--seeds", "0:3", "--max-steps", "150", "--faults",
    "none,teleport", "--workers", "2",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class KilledCommand:
    """A command line: ``{in}`` stands for :func:`inputs`, ``--out FOLDER`` comes behind it."""

    argv: Sequence[str]
    again: Sequence[str] = ()  # put behind it where it goes on: where the folder holds ``begun``
    begun: str = "settings.json"
    goes_on: bool = True  # what was kept before is kept; else it begins anew
    needs: str | None = None  # a module


COMMANDS: dict[str, KilledCommand] = {
    "benchmark": KilledCommand(argv=(*_BENCHMARK, "--workers", "2")),
    "explore": KilledCommand(
        argv=("explore", "--rooms", "rectangular", "--seed", "3", "--max-steps", "120", "--mcap"), goes_on=False
    ),
    "team": KilledCommand(
        argv=("explore", "--robots", "2", "--rooms", "apartment", "--seed", "5", "--max-steps", "120"),
        goes_on=False,
    ),
    "replay": KilledCommand(argv=("replay", "{in}/log.clf", "--slam", "graph-slam"), goes_on=False),
    "study": KilledCommand(argv=_STUDY),
    "train": KilledCommand(
        argv=("train", "--config", "{in}/train.toml", "--workers", "1"),
        again=("--resume",),
        begun="progress.json",
        needs="sb3_contrib",
    ),
    "ray": KilledCommand(argv=(*_BENCHMARK, "--ray", "local", "--workers", "2"), needs="ray"),
}
"""What is killed, by name."""


def installed() -> list[str]:
    """Return the names of those whose libraries are there."""
    return [name for name, one in COMMANDS.items() if one.needs is None or find_spec(one.needs) is not None]


@cache
def inputs() -> Path:
    """Return a folder of what the commands read, the same as long as this process lives."""
    folder = Path(tempfile.mkdtemp(prefix="kills-in-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    (folder / "train.toml").write_text(_TRAIN, "utf-8")
    (folder / "log.clf").write_bytes(carmen()["log.clf"])
    return folder
