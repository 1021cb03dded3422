"""The walls and doors of a flat: rooms on both sides of a corridor, some of them linked to each other.

All in cells of 0.05 m. The corridor runs along x, with a row of rooms below and one above it; at one end it may
meet a room as deep as the whole flat, and an entrance hall may run from it to the outer wall. At last the plan
is turned and mirrored at random.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from functools import cache
from typing import Annotated

import numpy as np

from mecanum_env.rooms.layout.furniture import Box, cells
from slam.settings import Config, Share, Span

__all__ = ["ApartmentConfig", "Door", "Layout", "draw_layout"]

_MARGIN = 4  # solid cells around the flat
_MIN_ROOM = 44  # 2.2 m: a room's least width
_FLATS = 10  # in 500 attempts: fewer, and one seed in ten thousand finds none
_DOOR_EDGE = 4  # 0.2 m: least wall between a door and the room's corner


@dataclass(frozen=True, kw_only=True)
class ApartmentConfig(Config):
    """Limits between which a flat is drawn, by seed."""

    # Floor between the walls, furniture included.
    area_m2: Annotated[tuple[float, float], Span("[60, 200]")] = (70.0, 130.0)
    rooms: Annotated[tuple[int, int], Span("[4, 12]")] = (5, 8)
    corridor_m: Annotated[tuple[float, float], Span("[1.1, 3]")] = (1.2, 1.8)
    door_m: Annotated[tuple[float, float], Span("[0.9, 1.6]")] = (0.9, 1.2)
    wall_m: Annotated[tuple[float, float], Span("[0.1, 0.5]")] = (0.1, 0.2)
    links: Share = 0.35  # probability of a door between two neighbouring rooms; there is always one
    furniture: Share = 0.75  # 0 empty rooms, 1 as full as can be driven through

    def __post_init__(self) -> None:
        super().__post_init__()
        if any(getattr(self, f.name) != f.default for f in fields(self)):
            _check_found(self)


@dataclass(frozen=True, slots=True)
class Door:
    """A doorway: the opening in the wall, and the indices of the rooms it joins (-1: the corridor)."""

    box: Box
    rooms: tuple[int, int]


@dataclass(slots=True)
class Layout:
    """Free rectangles of a flat [cells]."""

    rooms: list[Box] = field(default_factory=list)
    corridors: list[Box] = field(default_factory=list)  # they may overlap
    doors: list[Door] = field(default_factory=list)

    @property
    def floors(self) -> list[Box]:
        """All free rectangles."""
        return [*self.rooms, *self.corridors, *(door.box for door in self.doors)]

    @property
    def area(self) -> int:
        """Floor of rooms and corridors [cells²]."""
        boxes = [*self.rooms, *self.corridors]
        total = sum(_area(box) for box in boxes)
        for a, b in itertools.combinations(self.corridors, 2):
            width, depth = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
            total -= max(width, 0) * max(depth, 0)
        return total


def draw_layout(config: ApartmentConfig, rng: np.random.Generator) -> tuple[Layout, tuple[int, int]]:
    """Return a random layout and the columns and rows of the raster that holds it.

    Raises
    ------
    ValueError
        If 500 attempts give no flat within the limits of the config.
    """
    layout = next(_layouts(config, rng), None)
    if layout is None:
        raise _none_found(config)
    return _turn(layout, rng)


def _layouts(config: ApartmentConfig, rng: np.random.Generator) -> Iterator[Layout]:
    """Yield those of 500 attempts that are within the limits of the config."""
    low, high = (v / 0.05**2 for v in config.area_m2)
    for _ in range(500):
        layout = _attempt(config, rng)
        if layout is not None and low <= layout.area <= high:
            yield layout


@cache
def _check_found(config: ApartmentConfig) -> None:
    """Raise ``ValueError`` where so few attempts give a flat that some seed would give none."""
    if len(list(itertools.islice(_layouts(config, np.random.default_rng(0)), _FLATS))) < _FLATS:
        raise _none_found(config)


def _none_found(config: ApartmentConfig) -> ValueError:
    return ValueError(
        f"no flat of {config.area_m2} m² with {config.rooms} rooms found; widen area_m2 or change rooms"
    )


def _attempt(config: ApartmentConfig, rng: np.random.Generator) -> Layout | None:
    """Return one flat, or None where the drawn sizes do not go together."""

    def draw(limits: tuple[float, float]) -> int:
        return cells(float(rng.uniform(*limits)))

    corridor, thin, thick = draw(config.corridor_m), *sorted((draw(config.wall_m), draw(config.wall_m)))
    count = int(rng.integers(config.rooms[0], config.rooms[1] + 1))
    depths = (draw((2.8, 4.6)), draw((2.8, 4.6)))
    area = float(rng.uniform(*config.area_m2)) / 0.05**2
    # Walls between rooms take some 3 % of the length.
    length = round(area / (sum(depths) + corridor) * 1.03)
    end = draw((3.0, 4.4)) if rng.random() < 0.45 else 0
    hall = draw(config.corridor_m) if rng.random() < 0.4 else 0
    row_length = length - (end + thick if end else 0)
    row_count = count - (1 if end else 0)
    below = row_count // 2 if hall or rng.random() < 0.5 else row_count - row_count // 2
    if below < 1 or row_count - below < 1 or not 110 <= row_length <= 480 or length > 500:
        return None
    layout = Layout()
    y0, y1 = depths[0] + thick, depths[0] + thick + corridor
    layout.corridors.append((0, y0, row_length, y1))
    rows: list[list[int]] = []
    for row, number in enumerate((below, row_count - below)):
        spans = _split(row_length, number, hall if row == 0 else 0, thin, rng)
        if spans is None:
            return None
        rows.append(_add_row(layout, spans, row, (y0, y1), depths[row], thick, rng))
    if end:
        layout.rooms.append((row_length + thick, 0, length, depths[0] + depths[1] + corridor + 2 * thick))
        last = len(layout.rooms) - 1
        box = _doorway(layout.corridors[0], layout.rooms[last], config, rng)
        if box is None:
            return None
        layout.doors.append(Door(box, (-1, last)))
        rows = [[*row, last] for row in rows]
    return layout if _add_doors(layout, rows, config, rng) else None


def _split(
    length: int, number: int, hall: int, wall: int, rng: np.random.Generator
) -> list[tuple[int, int, bool]] | None:
    """Divide a row into rooms of random widths, with a hall between two of them: (from, to, is hall)."""
    at_hall = int(rng.integers(number + 1)) if hall else -1
    open_length = length - (number - 1) * wall - (hall + wall if hall else 0)
    weights = rng.uniform(0.7, 1.6, number)
    widths = np.floor(open_length * weights / weights.sum()).astype(int)
    widths[-1] += open_length - int(widths.sum())
    if widths.min() < _MIN_ROOM or widths.max() > 120:
        return None
    spans: list[tuple[int, int, bool]] = []
    x = 0
    for i in range(number + 1):
        if i == at_hall:
            spans.append((x, x + hall, True))
            x += hall + wall
        if i < number:
            spans.append((x, x + int(widths[i]), False))
            x += int(widths[i]) + wall
    return spans


def _add_row(
    layout: Layout,
    spans: list[tuple[int, int, bool]],
    row: int,
    corridor: tuple[int, int],
    depth: int,
    wall: int,
    rng: np.random.Generator,
) -> list[int]:
    """Add the rooms of a row to the layout; return their indices, with -2 where the hall parts them."""
    indices: list[int] = []
    for i, (x0, x1, is_hall) in enumerate(spans):
        recess = 0
        if i in (0, len(spans) - 1) and not is_hall and rng.random() < 0.3:
            # An end room less deep than its row gives the flat a less boxy outline.
            recess = min(int(rng.integers(10, 25)), depth - 52)
            recess = recess if recess >= 8 else 0
        if row == 0:
            box = (x0, recess, x1, corridor[0] - wall)
        else:
            box = (x0, corridor[1] + wall, x1, corridor[1] + wall + depth - recess)
        if is_hall:
            layout.corridors.append((x0, 0, x1, corridor[1]))
            indices.append(-2)
        else:
            layout.rooms.append(box)
            indices.append(len(layout.rooms) - 1)
    return indices


def _add_doors(layout: Layout, rows: list[list[int]], config: ApartmentConfig, rng: np.random.Generator) -> bool:
    """Give every room of the rows a door to the corridor, and some neighbours one to each other."""
    joined = {room for door in layout.doors for room in door.rooms}
    pairs: list[tuple[int, int]] = []
    for row in rows:
        pairs += [(a, b) for a, b in itertools.pairwise(row) if a >= 0 and b >= 0]
        for room in row:
            if room < 0 or room in joined:
                continue
            box = _doorway(layout.corridors[0], layout.rooms[room], config, rng)
            if box is None:
                return False
            layout.doors.append(Door(box, (-1, room)))
            joined.add(room)
    if not pairs:
        return False
    sure = int(rng.integers(len(pairs)))
    links = 0
    for i, (a, b) in enumerate(pairs):
        if i == sure or rng.random() < config.links:
            box = _doorway(layout.rooms[a], layout.rooms[b], config, rng)
            if box is not None:
                layout.doors.append(Door(box, (a, b)))
                links += 1
    return links > 0


def _doorway(a: Box, b: Box, config: ApartmentConfig, rng: np.random.Generator) -> Box | None:
    """Cut a doorway through the wall between two boxes, often near a corner, as doors are."""
    width = cells(float(rng.uniform(*config.door_m)))
    upright = a[2] <= b[0] or b[2] <= a[0]
    lo, hi = (max(a[1], b[1]), min(a[3], b[3])) if upright else (max(a[0], b[0]), min(a[2], b[2]))
    lo, hi = lo + _DOOR_EDGE, hi - _DOOR_EDGE - width
    if hi < lo:
        return None
    if rng.random() < 0.7:
        inset = min(int(rng.integers(5)), (hi - lo) // 2)
        at = lo + inset if rng.random() < 0.5 else hi - inset
    else:
        at = int(rng.integers(lo, hi + 1))
    if upright:
        return min(a[2], b[2]), at, max(a[0], b[0]), at + width
    return at, min(a[3], b[3]), at + width, max(a[1], b[1])


def _turn(layout: Layout, rng: np.random.Generator) -> tuple[Layout, tuple[int, int]]:
    """Mirror and turn a layout at random and move it clear of the raster's border."""
    width = max(box[2] for box in layout.floors)
    depth = max(box[3] for box in layout.floors)
    flip_x, flip_y, swap = (bool(v) for v in rng.random(3) < 0.5)

    def place(box: Box) -> Box:
        x0, y0, x1, y1 = box
        if flip_x:
            x0, x1 = width - x1, width - x0
        if flip_y:
            y0, y1 = depth - y1, depth - y0
        if swap:
            x0, y0, x1, y1 = y0, x0, y1, x1
        return x0 + _MARGIN, y0 + _MARGIN, x1 + _MARGIN, y1 + _MARGIN

    turned = Layout(
        [place(box) for box in layout.rooms],
        [place(box) for box in layout.corridors],
        [Door(place(door.box), door.rooms) for door in layout.doors],
    )
    size = (depth, width) if swap else (width, depth)
    return turned, (size[0] + 2 * _MARGIN, size[1] + 2 * _MARGIN)


def _area(box: Box) -> int:
    return (box[2] - box[0]) * (box[3] - box[1])
