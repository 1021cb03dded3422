"""``mecanum train`` on the command line."""

from __future__ import annotations

import os
import sys
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from training.runs.errors import BadInput, Interrupted, bad_input, check_writable, needs_extra, suggestion
from training.runs.options import Ray, workers_of
from training.runs.typed import LAST_SEED

if TYPE_CHECKING:
    from collections.abc import Callable

    from training.learning.config import TrainConfig
    from training.learning.end_to_end.config import DriveConfig
    from training.learning.folder import FolderRun

__all__ = ["train"]

CONFIGS = Path(__file__).parents[1] / "learning" / "configs"


def train(
    config: Annotated[
        str, typer.Option(help="Name of a configuration that comes with the package, or a TOML file.")
    ] = "ppo-frontier",
    seed: Annotated[
        int | None, typer.Option(min=0, max=LAST_SEED, help="Another seed than the configuration's.")
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=1024,
            help="Processes of lessons and trials; members trained at once.  [default: one a core]",
        ),
    ] = None,
    ray: Ray = None,
    device: Annotated[
        str,
        typer.Option(help="Where PPO's networks learn: cpu, cuda (cuda:1, …), or auto: a GPU if there is one."),
    ] = "cpu",
    out: Annotated[Path, typer.Option(help="Folder of the run.")] = Path("out/train"),
    wandb: Annotated[
        str | None,
        typer.Option(metavar="PROJECT", help="Also follow it on Weights & Biases, in a project there."),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the run in --out.")] = False,
) -> None:
    """Train a policy with PPO, in rehearsals or after imitation, as the configuration says.

    Writes into --out: checkpoint and best (zips of stable-baselines3; of ppo, safetensors), progress.json,
    curve.jsonl (a line per evaluation on validation seeds) and TensorBoard's files. A run that was broken off goes
    on from its last checkpoint with --resume, and ends as it would have without. See docs/how-to/training.md.

    \b
    Examples:
      mecanum train --out out/frontier
      mecanum train --config ppo --out out/ppo
      mecanum train --config ppo-frontier --seed 2 --out out/frontier-2
      mecanum train --config my.toml --out out/mine --resume
      mecanum train --out out/frontier --wandb exploration
      mecanum train --out out/frontier --device cuda
    """  # noqa: D301
    check_writable(out)
    settings = _read(config, seed)
    begun = (out / "progress.json").exists()
    if begun and not resume:
        raise BadInput(f"{out} holds a run already; go on with it by --resume, or choose another --out")
    if wandb is not None:
        with needs_extra("wandb", "--wandb"):
            import_module("wandb")
    with needs_extra("train", "training"):
        make_run = _runner(settings)
        from training.learning.follow import Follow
    who = workers_of(workers, ray) or os.cpu_count() or 1
    if ray is not None and device != "cpu":
        raise BadInput("--device is of this machine; leave out --ray, or --device")
    with bad_input():
        where = _device(device)
        command = f"mecanum train --config {Path(config).name} --seed {settings.seed}"
        run = make_run(settings, out, workers=who, log=_say, command=command, follow=Follow(wandb), device=where)
    if resume and not begun:
        raise BadInput(f"{out} holds no run to go on with; leave out --resume")
    try:
        run.train()
    except KeyboardInterrupt as error:
        raise Interrupted("interrupted; --resume goes on from the last checkpoint, if there was one") from error
    print(f"trained; mecanum policy {out} FILE.safetensors makes a file of the best policy")


def _runner(settings: TrainConfig | DriveConfig) -> Callable[..., FolderRun]:
    from training.learning.end_to_end.config import DriveConfig

    if isinstance(settings, DriveConfig):
        from training.learning.end_to_end.run import DriveRun

        return DriveRun
    from training.learning.ensemble import EnsembleRun
    from training.learning.ppo import Run

    return Run if settings.members == 1 else EnsembleRun


def _device(name: str) -> str:
    """Return a device of torch that is there; ``ValueError`` says which are."""
    import torch

    there = [f"cuda:{k}" for k in range(torch.cuda.device_count())]
    if name == "auto":
        return "cuda" if there else "cpu"
    if name != "cpu" and name not in there and not (there and name == "cuda"):
        raise ValueError(f"--device {name}: torch finds {', '.join(['cpu', *there])} here; see `mecanum doctor`")
    return name


def _read(config: str, seed: int | None) -> TrainConfig | DriveConfig:
    """Read a configuration by its name in the package, or from a file."""
    from slam.files import read_toml
    from slam.settings import from_mapping
    from training.learning.config import TrainConfig
    from training.learning.end_to_end.config import DriveConfig

    shipped = sorted(path.stem for path in CONFIGS.glob("*.toml"))
    path = CONFIGS / f"{config}.toml" if config in shipped else Path(config)
    if not path.exists():
        hint = suggestion(config, shipped)
        raise BadInput(f"no configuration {config!r}{hint}; a file, or one of {', '.join(shipped)}")
    try:
        values = read_toml(path)
    except ValueError as error:
        raise BadInput(f"cannot read {path}: {error}") from error
    kind: type[TrainConfig | DriveConfig] = DriveConfig if values.get("policy") == "drive" else TrainConfig
    with bad_input():
        return from_mapping(kind, values if seed is None else values | {"seed": seed})


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
