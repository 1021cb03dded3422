"""Options that several commands and studies share."""

from __future__ import annotations

import math
import os
import sys
from contextlib import AbstractContextManager, nullcontext, redirect_stdout
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from training.runs.compiling import compiling_shown
from training.runs.typed import LAST_SEED

if TYPE_CHECKING:
    from training.runs.campaign import Workers as Whose

__all__ = [
    "Backends", "Command", "Communication", "ConfigFile", "FloorPlanFile", "JointBelief", "Json", "MaxSteps",
    "Noise", "Out", "Range", "Ray", "Robot", "RoomSeed", "RoomSeedOrNone", "Rooms", "Seed", "Seeds", "Slam",
    "Starts", "UnknownStarts", "Workers", "json_alone", "workers_of",
]  # fmt: skip

Backends = Annotated[str, typer.Option(help="SLAM backends, separated by commas.")]
Communication = Annotated[
    str | None,
    typer.Option(help="Who hears whom: unlimited, range, line-of-sight, walls or none.  [default: unlimited]"),
]
ConfigFile = Annotated[
    Path | None, typer.Option(metavar="FILE.toml", help="Configuration; options that are given override it.")
]
FloorPlanFile = Annotated[
    Path | None, typer.Option(metavar="FILE", help="A real plan instead of --rooms: ROS map or image.")
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output, nothing else.")]
MaxSteps = Annotated[
    int | None,
    typer.Option(min=1, max=1_000_000, help="Step limit.  [default: 1.2 s per m² of free space, at least 300 s]"),
]
Noise = Annotated[str | None, typer.Option(help="Noise preset.  [default: nominal]")]
Out = Annotated[Path, typer.Option(help="Folder for the results.")]
Ray = Annotated[
    str | None,
    typer.Option(
        metavar="[ADDRESS]",
        help="Work on Ray: HOST:PORT of a cluster's head, auto (what runs here) or local (started for this "
        "command; also without an address, unless RAY_ADDRESS has one). See docs/how-to/cluster.md.",
    ),
]
Range = Annotated[
    float | None,
    typer.Option(
        "--range", min=0.001, max=1000, help="How far robots hear each other in the open, m.  [default: 10]"
    ),
]
Robot = Annotated[str | None, typer.Option(help="Robot preset, with its lidar and noise.  [default: youbot]")]
Rooms = Annotated[str | None, typer.Option(help="Generator of the rooms.  [default: apartment]")]
RoomSeed = Annotated[int, typer.Option(min=0, max=LAST_SEED, help="Of the room and the noise.")]
RoomSeedOrNone = Annotated[
    int | None, typer.Option(min=0, max=LAST_SEED, help="Of the room and the noise.  [default: 0]")
]
Seed = Annotated[int, typer.Option(min=0, max=LAST_SEED)]
Seeds = Annotated[str, typer.Option(help="3, 0:9 (both included) or 1,4,7.")]
Slam = Annotated[str | None, typer.Option(help="SLAM backend.  [default: invariant-ekf]")]
Starts = Annotated[
    str | None, typer.Option(help="Where several robots start: together or scattered.  [default: together]")
]
UnknownStarts = Annotated[bool, typer.Option("--unknown-starts", help="No robot knows where the others start.")]
JointBelief = Annotated[
    bool, typer.Option("--joint-belief", help="One filter over all robots, which hear all and know all starts.")
]
Workers = Annotated[int | None, typer.Option(min=1, max=1024, help="Processes.  [default: one a core]")]


class Command(TyperCommand):
    """A command that says when kernels compile, takes ``--ray`` without an address, and repeats what was wrong.

    Typer offers none of it; to the bounds of some of its versions NaN is neither too small nor too large, and no
    name at all is the current folder.
    """

    def invoke(self, ctx: Any) -> Any:
        """Run the command; where an agent or a backend calls ``sys.exit()``, that is no success of it."""
        try:
            with compiling_shown():
                return super().invoke(ctx)
        except SystemExit as error:
            raise RuntimeError("sys.exit() was called amid the work, by an agent or a backend") from error

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put in the address that is meant, then parse."""
        meant = os.environ.get("RAY_ADDRESS") or "local"
        words = []
        for k, word in enumerate(args):
            bare = word == "--ray" and (k + 1 == len(args) or args[k + 1].startswith("-"))
            words += [word, meant] if bare else [word]
        try:
            rest = super().parse_args(ctx, list(words))
        except typer.BadParameter as error:
            error.message = f"{error.message.rstrip('.')}, got {_given(words, error.param)}"
            raise
        option: Any
        for option in self.params:
            if isinstance(ctx.params.get(option.name or ""), Path) and _given(words, option) == repr(""):
                raise typer.BadParameter("it is empty; give a name.", ctx=ctx, param=option)
            given = ctx.params.get(option.name or "")
            if isinstance(given, float) and not math.isfinite(given):
                raise typer.BadParameter(f"{given} is no number.", ctx=ctx, param=option)
        return rest


def _given(words: list[str], option: Any) -> str:
    """Return the last word that was given for an option."""
    names = getattr(option, "opts", [])
    after = [next_ for word, next_ in pairwise(words) if word in names]
    joined = [word.partition("=")[2] for word in words if word.partition("=")[0] in names and "=" in word]
    return repr([*after, *joined][-1][:60]) if after or joined else "nothing"


def json_alone(as_json: bool) -> AbstractContextManager[Any]:
    """Send what agents and backends print to standard error, where standard output is for JSON alone."""
    return redirect_stdout(sys.stderr) if as_json else nullcontext()


def workers_of(workers: int | None, ray: str | None) -> Whose:
    """Return who does the work, as ``--workers`` and ``--ray`` say; :class:`BadInput` where Ray is not there."""
    if ray is None:
        return workers
    from training.runs.cluster import find_cluster

    return find_cluster(ray, workers)
