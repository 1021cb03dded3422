"""``mecanum rooms``: generated rooms as pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2

from mecanum_env import rooms as room_registry
from mecanum_env.config import ROBOT_PRESETS, RobotConfig, resolve
from mecanum_env.rooms import FloorPlan
from mecanum_env.views.plans import contact_sheet, draw_plan
from slam.formats import atomic_write
from slam.settings import check_name
from training.runs.errors import BadInput, Interrupted, bad_input, check_writable
from training.runs.signals import interrupt_flag
from training.runs.typed import LAST_SEED

__all__ = ["draw_rooms", "parse_seeds"]

MOST_SEEDS = 100
_COLUMNS = 5  # of the contact sheet


def parse_seeds(text: str, *, most: int = MOST_SEEDS) -> list[int]:
    """Return the seeds of ``3``, ``0:9`` (both ends included), ``1,4,7`` or a mix, each once, in that order.

    Raises
    ------
    BadInput
        If it is none of these, or more than ``most`` seeds.
    """
    too_many = BadInput(f"--seeds {text!r} are more than {most}; give fewer, in several calls")
    seeds: dict[int, None] = {}
    for part in text.split(","):
        first, colon, last = (piece.strip() for piece in part.partition(":"))
        if not (first.isascii() and first.isdigit() and (not colon or (last.isascii() and last.isdigit()))):
            raise BadInput(f"--seeds {text!r} are no seeds; give 3, 0:9 (both included) or 1,4,7")
        low, high = int(first), int(last) if colon else int(first)
        if low > high or high > LAST_SEED:
            raise BadInput(f"--seeds {part.strip()!r} must run upwards from 0 to at most {LAST_SEED}")
        if high - low >= most or len(seeds) > most:
            raise too_many
        seeds |= dict.fromkeys(range(low, high + 1))
    if len(seeds) > most:
        raise too_many
    return list(seeds)


def draw_rooms(*, kind: str, seeds: str, out: Path, robot: str) -> dict[str, Any]:
    """Draw each seed's plan, and all of them on a contact sheet; return what was written.

    Raises
    ------
    BadInput
        For an unknown kind or robot, bad seeds, or a folder that cannot be written to.
    Interrupted
        On Ctrl-C; the plans drawn until then stay.
    """
    with bad_input():
        chosen = parse_seeds(seeds)
        check_name("rooms", kind, room_registry.names())
        body = resolve(RobotConfig, robot, ROBOT_PRESETS, "robot")
        sheet_name = f"{kind}-sheet.png"
        check_writable(out, [sheet_name, *(f"{kind}-{seed}.png" for seed in chosen)])
    out.mkdir(parents=True, exist_ok=True)
    plans: list[FloorPlan] = []
    files: list[str] = []
    with interrupt_flag() as interrupted:
        for seed in chosen:
            with bad_input():
                plans.append(room_registry.make(kind, seed=seed))
            path = out / f"{kind}-{seed}.png"
            picture = draw_plan(plans[-1], pixels_per_m=60.0, robot=body)
            atomic_write(path, cv2.imencode(".png", picture)[1].tobytes())
            files.append(str(path))
            if interrupted.is_set():
                raise Interrupted(f"interrupted after {len(files)} of {len(chosen)} plans, which are in {out}")
    sheet = out / sheet_name
    picture = contact_sheet(plans, _COLUMNS, pixels_per_m=24.0)
    atomic_write(sheet, cv2.imencode(".png", picture)[1].tobytes())
    areas = {str(seed): round(plan.area_m2, 3) for seed, plan in zip(chosen, plans, strict=True)}
    return {"rooms": kind, "seeds": chosen, "area_m2": areas, "files": files, "sheet": str(sheet)}
