"""Who reads what: for each reader sound files, how they are read, and by which command."""

from __future__ import annotations

import importlib.util
import tempfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import agents
from slam.landmarks.database import read_landmark_map
from training.episodes import explore
from training.replay import run as replay
from training.runs.errors import BadInput
from training.studies.reliability.files import (
    hostile,
    hostile_bags,
    hostile_logs,
    hostile_stores,
    results,
    samples,
)
from training.studies.reliability.files.forked import load_command, run_forked
from training.studies.reliability.files.mutations import mutated, mutated_cells
from training.studies.reliability.files.samples import Files, Hostile, Sound, packed, put

__all__ = ["READERS", "Case", "Reader"]

_LOG_PACKED = 0.25  # share of logs that are packed, before or after they were damaged
_HEADER = 0.5  # share of weights whose header alone is damaged
_CELLS = 0.6  # share of databases in which values are damaged, not bytes

Variant = tuple[str, tuple[str, ...]]
"""The name that a reader is given, ``.`` for the folder, and the files that have to be there."""


@dataclass(frozen=True)
class Case:
    """A file, with those beside it, to be read."""

    name: str
    files: Files
    entry: str

    def put(self, folder: Path) -> Path:
        """Write it all, and return the path to be read."""
        put(folder / "given", self.files)
        return folder / "given" / self.entry if self.entry != "." else folder / "given"


@dataclass(frozen=True, kw_only=True)
class Reader:
    """One that is handed files."""

    about: str
    sound: Callable[[], Sound]
    variants: tuple[Variant, ...]
    use: Callable[[Path], None]
    hostile: Hostile = field(default_factory=dict)
    command: Callable[[Path, Path], Sequence[str]] | None = None  # of the path, and a folder for results
    every: int = 100  # file is read by the command
    named: bool = True  # every error names the file; of a configuration it may name the setting instead

    def warm_up(self) -> None:
        """Load and compile what only a first call does: that is not the file's time."""
        load_command()
        entry, names = self.variants[0]
        with tempfile.TemporaryDirectory() as folder:
            self.use(Case("sound", {name: self.sound()[name] for name in names}, entry).put(Path(folder)))

    def by_command(self, index: int) -> bool:
        """Tell whether a file is read by the command."""
        return self.command is not None and index % self.every == self.every - 1

    def case(self, seed: int, index: int) -> Case:
        """Return a file by its number: the hostile ones first, then damaged ones."""
        if index < len(self.hostile):
            name = list(self.hostile)[index]
            entry, names = self.variants[0]
            given = self.hostile[name]()
            # One with a name of its own is the one to be read.
            entry = entry if entry == "." else next((n for n in given if not n.startswith(names)), entry)
            return Case(name, {n: self.sound()[n] for n in names} | dict(given), entry.rstrip("/"))
        rng = np.random.default_rng([seed, zlib.crc32(self.about.encode()), index])
        entry, names = self.variants[int(rng.integers(len(self.variants)))]
        files = {name: self.sound()[name] for name in names}
        name = str(rng.choice(names))
        name, damaged, what = _damaged(name, files.pop(name), rng)
        entry = f"{entry}.gz" if entry != "." and name == f"{entry}.gz" else entry
        return Case(f"{name}: {', '.join(what)}", files | {name: damaged}, entry)

    def read(self, path: Path, index: int) -> None:
        """Have a file read; each :attr:`every`-th by the command.

        Raises
        ------
        ValueError
            As the reader does, or as the command said in one line before it ended with 2.
        """
        if self.command is None or not self.by_command(index):
            self.use(path)
            return
        code, said = run_forked(self.command(path, path.parent / "out"))
        lines = [line for line in said.splitlines() if line.startswith("mecanum")]
        if code == 2 and len(lines) == 1:
            raise BadInput(lines[0])
        if code:
            raise RuntimeError(f"exit code {code}: {said[-300:]}")


def _damaged(name: str, data: bytes, rng: np.random.Generator) -> tuple[str, bytes, list[str]]:
    if name.endswith((".db", ".db3", ".sqlite")) and rng.random() < _CELLS:
        return name, *mutated_cells(data, rng)
    if name.endswith(".safetensors") and rng.random() < _HEADER:
        size = 8 + int.from_bytes(data[:8], "little")
        head, what = mutated(data[8:size], rng)
        told = len(head) if rng.random() < 0.8 else int(rng.integers(2**63))
        return name, told.to_bytes(8, "little") + head + data[size:], ["header", *what]
    if name.endswith((".clf", ".log", ".dat", ".txt")) and rng.random() < _LOG_PACKED:
        if rng.random() < 0.5:
            damaged, what = mutated(data, rng)
            return f"{name}.gz", packed(damaged, 1), ["packed", *what]
        damaged, what = mutated(packed(data, 1), rng)
        return f"{name}.gz", damaged, ["gzip", *what]
    return name, *mutated(data, rng)


# ---- how they are read -----------------------------------------------------------------------------------------

_NOWHERE = Path("out")


def _plan(path: Path) -> None:
    """Place a robot in a plan, and let it move: what the command does before it explores."""
    episode = explore.prepare(out=_NOWHERE, floor_plan=path, agent="random")
    episode.env.step(np.zeros(3, np.float32))


def _log(path: Path) -> None:
    """Replay a log by its odometry."""
    replayed = replay.prepare(path, out=_NOWHERE, slam="odometry")
    replay.run(replayed, lambda _: None)


def _config(path: Path) -> None:
    """Read a configuration, check it whole, and draw its rooms."""
    explore.asked_for(out=_NOWHERE, files=[], config=path)


@cache
def _seen() -> tuple[Any, Any]:
    """Return an observation and the belief that it belongs to."""
    episode = explore.prepare(out=_NOWHERE, rooms="rectangular", agent="random")
    return episode.observation, episode.env.belief


def _policy(path: Path) -> None:
    """Have a policy act once."""
    observation, belief = _seen()
    agent = agents.make(str(path))
    agent.reset(belief)
    agent.act(observation, belief)


def _landmarks(path: Path) -> None:
    found = read_landmark_map(path)
    for table in (found.landmarks, found.relations, found.sightings):
        len(table)


def _explore(*options: str) -> Callable[[Path, Path], Sequence[str]]:
    """Return the command line that explores with a file."""

    def argv(path: Path, out: Path) -> Sequence[str]:
        given = [option.replace("PATH", str(path)) for option in options]
        return ["explore", *given, "--max-steps", "1", "--out", str(out)]

    return argv


def _replay(path: Path, out: Path) -> Sequence[str]:
    return ["replay", str(path), "--slam", "odometry", "--out", str(out)]


_PLAN = _explore("--floor-plan", "PATH", "--agent", "random")

READERS: dict[str, Reader] = {
    "ros-maps": Reader(
        about="ROS maps, YAML and PGM", sound=samples.ros_map, use=_plan, command=_PLAN,
        variants=(("plan.yaml", ("plan.yaml", "plan.pgm")),), hostile=hostile.MAPS,
    ),
    "images": Reader(
        about="plans as PNG, PGM, JPEG, BMP", sound=samples.images, use=_plan, command=_PLAN,
        variants=tuple((name, (name,)) for name in samples.images()), hostile=hostile.IMAGES,
    ),
    "carmen": Reader(
        about="CARMEN logs, plain and gzip", sound=samples.carmen, use=_log, command=_replay,
        variants=(("log.clf", ("log.clf",)),), hostile=hostile_logs.CARMEN,
    ),
    "dp-slam": Reader(
        about="DP-SLAM logs, plain and gzip", sound=samples.dpslam, use=_log, command=_replay,
        variants=(("run.log", ("run.log",)),), hostile=hostile_logs.DPSLAM,
    ),
    "utias": Reader(
        about="UTIAS logs", sound=samples.utias, use=_log, command=_replay,
        variants=((".", tuple(samples.utias())),), hostile=hostile_logs.UTIAS,
    ),
    "victoria-park": Reader(
        about="Victoria Park's log", sound=samples.park, use=_log, command=_replay,
        variants=((".", tuple(samples.park())),), hostile=hostile_logs.PARK,
    ),
    "configs": Reader(
        about="TOML configurations", sound=samples.configs, use=_config,
        command=_explore("--config", "PATH"), variants=(("config.toml", ("config.toml",)),),
        hostile=hostile.CONFIGS, named=False,
    ),
    "policies": Reader(
        about="policies, safetensors and JSON", sound=samples.policies, use=_policy,
        command=_explore("--agent", "PATH", "--rooms", "rectangular"), hostile=hostile.POLICIES,
        variants=tuple((f"{name}.safetensors", (f"{name}.safetensors", f"{name}.json"))
                       for name in ("ppo", "ppo-frontier", "learned-tour")),
    ),
    "landmarks": Reader(
        about="landmark databases", sound=samples.landmarks, use=_landmarks,
        variants=(("landmarks.db", ("landmarks.db",)),), hostile=hostile_stores.LANDMARKS,
    ),
    "stores": Reader(
        about="stores of benchmarks, results.sqlite", sound=results.store, use=results.use_store,
        command=results.benchmark, every=250, variants=(("results.sqlite", ("results.sqlite", "settings.json")),),
        hostile=hostile_stores.STORES,
    ),
    "rows": Reader(
        about="rows of studies, JSON lines", sound=results.rows, use=results.use_rows,
        variants=(("rows.jsonl", ("rows.jsonl",)),), hostile=hostile_stores.ROWS,
    ),
    "run-files": Reader(
        about="settings.json and summary.json of runs", sound=results.run_files, use=results.use_run_files,
        command=results.leaderboard, variants=((".", ("settings.json", "summary.json", "page.md")),),
        hostile=hostile_stores.RUN_FILES,
    ),
}  # fmt: skip
"""Name → reader."""

if all(map(importlib.util.find_spec, ("mcap", "rosbags"))):  # of an extra
    READERS["ros-bags"] = Reader(
        about="ROS 2 bags, MCAP and SQLite", sound=hostile_bags.bags, use=_log, command=_replay,
        variants=(("drive.mcap", ("drive.mcap",)), ("drive.db3", ("drive.db3",))), hostile=hostile_bags.BAGS,
    )  # fmt: skip
