"""``mecanum rooms`` on the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from training.runs.options import Json

__all__ = ["rooms"]


def rooms(
    kind: Annotated[str, typer.Option(help="Generator of the rooms.")] = "apartment",
    seeds: Annotated[str, typer.Option(help="3, 0:9 (both included) or 1,4,7; at most 100.")] = "0:9",
    out: Annotated[Path, typer.Option(help="Folder for the pictures.")] = Path("out/rooms"),
    robot: Annotated[str, typer.Option(help="Robot drawn at the start.")] = "youbot",
    as_json: Json = False,
) -> None:
    """Draw generated rooms: one PNG a seed, and a contact sheet of them all.

    \b
    Examples:
      mecanum rooms
      mecanum rooms --kind apartment --seeds 0:9 --out out/rooms
      mecanum rooms --kind rectangular --seeds 1,4,7 --json
    """  # noqa: D301
    from training.episodes.room_pictures import draw_rooms

    drawn = draw_rooms(kind=kind, seeds=seeds, out=out, robot=robot)
    if as_json:
        print(json.dumps(drawn))
    else:
        print(f"{len(drawn['files'])} plans in {out}, all together in {drawn['sheet']}")
