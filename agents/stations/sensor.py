"""What a robot on a station sees: rays that walk over the cells of a grid until a wall.

``public`` is the sensor of the published benchmark's code (DARE, ICRA 2025), ``wide`` one that shows the cells
beside the rays, too. Near the robot many rays pass the same cells: as one tree, a third of the steps is left.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN
from slam.types import Flags, Indices

__all__ = ["BLIND", "SENSORS", "Rays", "look", "rays"]

SENSORS = ("public", "wide")
"""Names for :func:`rays`, the benchmark's own first."""

_RAYS = 720
_REACH = 50.0  # cells: 20 m
_UNKNOWN = int(UNKNOWN)


class Rays(NamedTuple):
    """A sensor, for :func:`look`."""

    tree: NDArray[np.int32]  # (n, 3) depth first: row and column from the robot, and where to go on behind a wall
    around: int  # cells that are shown on each side of those passed; 0: and the wall that ends a ray is shown


BLIND = Rays(np.zeros((0, 3), dtype=np.int32), 0)
"""A sensor that sees nothing."""


@cache
def rays(sensor: str) -> Rays:
    """Return the rays of one of :data:`SENSORS`: 720, half a degree apart, up to 50 cells long.

    ``public``: a ray steps along one axis at a time, shows what it passes and the first wall, not its last cell.
    ``wide``: it may step along both axes at once, shows the eight cells around each that it passes, and ends
    before the first wall.
    """
    walk = {"public": _steps, "wide": _line}[sensor]
    root: dict[tuple[int, int], Any] = {}
    for k in range(_RAYS):
        angle = 2.0 * math.pi * k / _RAYS
        node = root
        for cell in walk(*(math.floor(_REACH * share + 0.5) for share in (math.sin(angle), math.cos(angle)))):
            node = node.setdefault(cell, {})
    rows: list[list[int]] = []

    def flatten(node: dict[tuple[int, int], Any]) -> None:
        for cell, behind in node.items():
            own = [*cell, 0]
            rows.append(own)
            flatten(behind)
            own[2] = len(rows)

    flatten(root)
    return Rays(np.array(rows, dtype=np.int32), int(sensor == "wide"))


def _steps(dr: int, dc: int) -> Iterator[tuple[int, int]]:
    """Yield the cells from (0, 0) to before an end, one axis a step: Bresenham's with an integer error."""
    row, col, error = 0, 0, abs(dc) - abs(dr)
    for _ in range(abs(dr) + abs(dc)):
        yield row, col
        if error > 0:
            col, error = col + (1 if dc > 0 else -1), error - 2 * abs(dr)
        else:
            row, error = row + (1 if dr > 0 else -1), error + 2 * abs(dc)


def _line(dr: int, dc: int) -> Iterator[tuple[int, int]]:
    """Yield the cells nearest to the line from (0, 0) to before an end."""
    count = max(abs(dr), abs(dc))
    for i in range(count):
        yield math.floor(i / count * dr + 0.5), math.floor(i / count * dc + 0.5)


@njit(cache=True, nogil=True)
def look(free: Flags, row: int, col: int, sensor: Rays, known: NDArray[np.int8]) -> Indices:
    """Write into ``known`` ``(rows, cols)`` what the sensor sees of ``free`` from a cell.

    Returns ``(4,)`` the first and last row and column in which a cell became known; the last ones −1 where none
    did.
    """
    rows, cols = free.shape
    box = np.array([rows, -1, cols, -1])
    tree, around = sensor.tree, sensor.around
    i = 0
    while i < len(tree):
        r, c = row + tree[i, 0], col + tree[i, 1]
        if r < 0 or c < 0 or r >= rows or c >= cols or (around and not free[r, c]):
            i = tree[i, 2]
            continue
        i = i + 1 if free[r, c] else tree[i, 2]
        for rr in range(max(r - around, 0), min(r + around + 1, rows)):
            for cc in range(max(c - around, 0), min(c + around + 1, cols)):
                if known[rr, cc] == _UNKNOWN:
                    known[rr, cc] = FREE if free[rr, cc] else OCCUPIED
                    box[0], box[1] = min(box[0], rr), max(box[1], rr)
                    box[2], box[3] = min(box[2], cc), max(box[3], cc)
    return box
