"""A furnished flat: rooms on both sides of a corridor, in the sizes and with the furniture of a real one."""

from __future__ import annotations

import numpy as np

from mecanum_env.rooms.floor_plan import FloorPlan
from mecanum_env.rooms.layout.apartment_layout import ApartmentConfig, Layout, draw_layout
from mecanum_env.rooms.layout.assembly import assemble, generator
from mecanum_env.rooms.layout.furniture import Box, Furnisher, Piece

__all__ = ["ApartmentConfig", "apartment"]

_CLEAR_DEPTH = 21  # 1.05 m kept free before a door
_CLEAR_SIDE = 2  # 0.1 m beside it


def apartment(config: ApartmentConfig, *, seed: int) -> FloorPlan:
    """Return the flat of a seed: the same one every time.

    Raises
    ------
    ValueError
        If the limits of the config leave no room for a flat.
    """
    rng = generator(seed)
    layout, size = draw_layout(config, rng)
    pieces: list[Piece] = []
    for index, use in enumerate(_uses(layout, rng)):
        furnisher = Furnisher(layout.rooms[index], rng, _before_doors(layout, index))
        _furnish(furnisher, use, config.furniture, rng)
        pieces += furnisher.pieces
    return assemble(f"apartment-{seed}", layout.floors, pieces, size=size, rng=rng)


def _uses(layout: Layout, rng: np.random.Generator) -> list[str]:
    """Say what each room is for: the largest to live in, the smallest to wash in."""
    areas = [(box[2] - box[0]) * (box[3] - box[1]) for box in layout.rooms]
    order = list(np.argsort(areas, kind="stable"))
    uses = ["bedroom"] * len(order)
    uses[order[-1]] = "living"
    uses[order[0]] = "bath"
    uses[order[1]] = "study" if rng.random() < 0.4 else "kitchen"
    rest = [int(i) for i in order[2:-1]]
    rng.shuffle(rest)
    if "kitchen" not in uses and rest:
        uses[rest.pop()] = "kitchen"
    for use in ("bedroom", "study", "bedroom", "dining", "bedroom", "store"):
        if rest:
            uses[rest.pop()] = use
    return uses


def _before_doors(layout: Layout, room: int) -> list[Box]:
    """Return the floor before the doors of a room."""
    x0, y0, x1, y1 = layout.rooms[room]
    zones: list[Box] = []
    for door in layout.doors:
        if room not in door.rooms:
            continue
        dx0, dy0, dx1, dy1 = door.box
        if dx1 <= x0 or dx0 >= x1:
            near, far = (x0, x0 + _CLEAR_DEPTH) if dx1 <= x0 else (x1 - _CLEAR_DEPTH, x1)
            zones.append((near, dy0 - _CLEAR_SIDE, far, dy1 + _CLEAR_SIDE))
        else:
            near, far = (y0, y0 + _CLEAR_DEPTH) if dy1 <= y0 else (y1 - _CLEAR_DEPTH, y1)
            zones.append((dx0 - _CLEAR_SIDE, near, dx1 + _CLEAR_SIDE, far))
    return zones


def _furnish(room: Furnisher, use: str, density: float, rng: np.random.Generator) -> None:
    """Place the furniture of a room, the large pieces first; ``density`` thins it out."""

    def wanted(share: float = 1.0) -> bool:
        return bool(rng.random() < share * min(1.0, density / 0.75)) and density > 0

    def size(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    if use == "bedroom":
        if wanted():
            double = rng.random() < 0.65
            width, tables = (size(1.4, 1.8), int(rng.integers(1, 3))) if double else (0.9, 1)
            room.bed(width, 2.0, tables=tables) or room.bed(0.9, 2.0, tables=0)
        if wanted():
            room.against_wall(size(1.4, 2.4), 0.6, corner=0.7) or room.against_wall(1.0, 0.6, corner=0.7)
        if wanted(0.6):
            room.desk(size(1.2, 1.5), 0.65) or room.against_wall(1.0, 0.45)
        if wanted(0.5):
            room.against_wall(size(0.7, 1.1), 0.45)
    elif use == "living":
        if wanted():
            room.corner_sofa(size(2.0, 2.8), size(0.6, 1.1)) or room.against_wall(1.9, 0.9)
        if wanted():
            room.against_wall(size(1.4, 2.0), 0.45, corner=0.1)
        if wanted(0.8):
            room.island(size(1.4, 2.0), size(0.8, 1.0), chairs=4) or room.round_table(0.45)
        if wanted(0.5):
            room.round_table(size(0.35, 0.5))
        if wanted(0.5):
            room.turned_box(0.8, 0.8)
        if wanted(0.7):
            room.against_wall(size(0.8, 1.8), 0.4)
        if wanted(0.4):
            room.against_wall(size(0.8, 1.2), 0.35, corner=0.6)
    elif use == "kitchen":
        if wanted():
            room.kitchen(size(2.0, 3.0), size(0.6, 1.4)) or room.kitchen(size(1.6, 2.0), 0.0)
        if wanted(0.9):
            room.island(1.2, 0.8, chairs=2) or room.round_table(0.45) or room.round_table(0.35)
        if wanted(0.7):
            room.against_wall(0.6, 0.6, corner=0.8)
    elif use == "bath":
        if wanted():
            room.against_wall(1.7, 0.75, corner=1.0) or room.against_wall(0.9, 0.9, corner=1.0)
        if wanted():
            room.against_wall(0.4, 0.65, corner=0.1)
        if wanted():
            room.against_wall(size(0.6, 1.2), 0.5, corner=0.2)
        if wanted(0.5):
            room.against_wall(0.6, 0.6, corner=0.8)
    elif use == "dining":
        if wanted():
            room.island(size(1.4, 2.0), 0.9, chairs=4) or room.round_table(0.55) or room.round_table(0.4)
        if wanted():
            room.against_wall(size(1.2, 2.0), 0.45)
        if wanted(0.5):
            room.against_wall(size(0.8, 1.2), 0.4, corner=0.7)
    elif use == "study":
        if wanted():
            room.desk(size(1.3, 1.8), 0.7)
        if wanted():
            room.against_wall(size(1.2, 2.4), 0.35, corner=0.7)
        if wanted(0.6):
            room.turned_box(0.75, 0.75) or room.against_wall(0.8, 0.8, corner=1.0)
        if wanted(0.6):
            room.against_wall(size(0.8, 1.6), 0.35, corner=0.5)
    else:
        for _ in range(4):
            if wanted(0.8):
                room.against_wall(size(0.8, 2.0), float(rng.choice([0.4, 0.5, 0.6])), corner=0.6)
