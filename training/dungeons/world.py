"""The world of the dungeons protocol: a map with perfect poses, a noise-free sensor, and a lattice of way-points.

What is modelled is what the published benchmark does (DARE, ICRA 2025, and the ARiADNE family before it): maps of
0.2 m pixels pooled twofold, a ray every half degree that marks what it passes and the first wall, way-points
every 4 m through the start, hops of up to two way-points along each axis over cells known to be free, and an end
when no way-point sees two pieces of frontier any more.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from agents.stations.lattice import count_in_sight, in_sight, join, ways
from agents.stations.sensor import SENSORS, look, rays
from agents.stations.survey import HOP, STRIDE, VOXEL
from mecanum_env.rooms.files.image_files import read_grey
from slam.grids.occupancy import FREE, UNKNOWN
from training.runs.errors import BadInput, bad_input

__all__ = [
    "CELL_M", "HOP", "RANGE_M", "SENSORS", "STRIDE", "Dungeon", "Lattice", "dungeon_of", "frontier_points",
    "layout", "load", "scan",
]  # fmt: skip

CELL_M = 0.4
"""Side of a cell [m], two pixels of a map."""
RANGE_M = 20.0
"""Range of the sensor [m]."""

_SEEN_FROM = 40.0  # cells: frontiers count as in sight of a way-point up to 16 m away
_WORTH = 2  # of these make a way-point worth a visit
_TILE_M = 5.0  # the benchmark's maps are made of such tiles
_WALL_BELOW, _START = 150, 208  # pixel values
_MOST_PIXELS = 4000  # a side


@dataclass(frozen=True, eq=False)
class Dungeon:
    """A map; row 0 is the picture's first row, and y grows with the row."""

    name: str
    free: NDArray[np.bool_]  # (rows, cols) cells of 0.4 m
    start: tuple[int, int]  # row, column


def load(path: Path) -> Dungeon:
    """Return the map of a picture: free above 150, its start the patch of value 208, walls elsewhere.

    Raises
    ------
    BadInput
        In one line: what is wrong with the file.
    """
    with bad_input():
        pixels = np.nan_to_num(read_grey(path)).astype(np.uint8)
    if max(pixels.shape) > _MOST_PIXELS or min(pixels.shape) < 2:
        raise BadInput(f"map {path} has {pixels.shape[1]} × {pixels.shape[0]} pixels; 2 to {_MOST_PIXELS} a side")
    return dungeon_of(pixels, path.stem)


def dungeon_of(pixels: NDArray[np.uint8], name: str) -> Dungeon:
    """Return the map of pixel values ``(2 rows, 2 cols)``, pooled twofold by their minimum.

    As in the benchmark, the robot starts in the eleventh pooled cell of the patch's first row, or in its last one
    where the patch is smaller.
    """
    rows, cols = pixels.shape[0] // 2, pixels.shape[1] // 2
    pooled = pixels[: 2 * rows, : 2 * cols].reshape(rows, 2, cols, 2).min(axis=(1, 3))
    patch = np.argwhere(pooled == _START)
    if not len(patch):
        raise BadInput(f"map {name} has no start: a patch of pixels of value {_START}, at least 2 × 2")
    row, col = patch[min(10, len(patch) - 1)]
    return Dungeon(name, pooled > _WALL_BELOW, (int(row), int(col)))


def scan(
    free: NDArray[np.bool_], row: int, col: int, known: NDArray[np.int8], sensor: str = SENSORS[0]
) -> NDArray[np.int64]:
    """Write into ``known`` ``(rows, cols)`` what the sensor sees of ``free`` from a cell (:func:`look`)."""
    return np.asarray(look(free, row, col, rays(sensor), known))


class Lattice:
    """The way-points on the map as it is known: where they are, how they join, what they see of frontiers.

    Attributes
    ----------
    cells : NDArray[np.int64]
        ``(n, 2)`` row, column of the way-points that are known to be free.
    points : NDArray[np.int64]
        ``(m, 2)`` row, column of the frontier's pieces.
    joined : NDArray[np.int64]
        ``(n, 25)`` the way-points that a hop may go to from each, −1 where there is none.
    sees : NDArray[np.int64]
        ``(n,)`` how many pieces are in sight of each way-point.
    """

    def __init__(self, known: NDArray[np.int8], start: tuple[int, int]) -> None:
        self._known = known
        self._first = start[0] % STRIDE, start[1] % STRIDE
        picked = known[self._first[0] :: STRIDE, self._first[1] :: STRIDE] == FREE
        own = np.argwhere(picked)
        self.cells: NDArray[np.int64] = own * STRIDE + np.array(self._first)
        self._index = np.full(picked.shape, -1, dtype=np.int64)
        self._index[tuple(own.T)] = np.arange(len(own))
        self.joined = join(known, self.cells, own, self._index, HOP)
        self.points = frontier_points(known)
        self.sees = count_in_sight(known, self.cells, self.points, _SEEN_FROM)

    def index(self, row: int, col: int) -> int:
        """Return the number of the way-point in a cell, or −1."""
        r, c = row - self._first[0], col - self._first[1]
        if r % STRIDE or c % STRIDE or not (0 <= row < self._known.shape[0] and 0 <= col < self._known.shape[1]):
            return -1
        return int(self._index[r // STRIDE, c // STRIDE])

    def ways(self, start: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the length [m] ``(n,)`` of the way from one way-point to each, and the way-point before it.

        Of ways of one length, the one with more way-points: it looks more often.
        """
        length, before = ways(self.cells, self.joined, start)
        return length * CELL_M, before

    def sight(self, points: NDArray[np.int64], cells: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which points ``(m, 2)`` are in sight of each cell ``(n, 2)``, as frontier is: ``(n, m)``."""
        return np.asarray(in_sight(self._known, cells, points, _SEEN_FROM))

    def worth_a_visit(self, reachable: NDArray[np.bool_], visited: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return which way-points ``(n,)`` see enough of frontiers, can be reached, and were not looked from."""
        been = visited[tuple(self.cells.T)]
        return np.asarray((self.sees >= _WORTH) & reachable & ~been)


def layout(dungeon: Dungeon) -> bytes:
    """Return what maps of one plan share, turned or mirrored: the least of its ways round, in tiles of 5 m."""
    rows, cols = (max(round(cells * CELL_M / _TILE_M), 1) for cells in dungeon.free.shape)
    share = cv2.resize(dungeon.free.astype(np.float32), (cols, rows), interpolation=cv2.INTER_AREA)
    turned = [np.rot90(share > 0.5, quarters) for quarters in range(4)]
    return min(bytes(tiles.shape) + tiles.tobytes() for own in turned for tiles in (own, own[:, ::-1]))


def frontier_points(known: NDArray[np.int8]) -> NDArray[np.int64]:
    """Return one cell ``(m, 2)`` for each 1.6 m square with frontier in it, the one nearest to its middle.

    A frontier cell is free and has two to seven unknown ones among its eight neighbours.
    """
    unknown = (known == UNKNOWN).astype(np.float32)
    kernel = np.ones((3, 3), dtype=np.float32)
    around = cv2.filter2D(unknown, -1, kernel, borderType=cv2.BORDER_CONSTANT)
    cells = np.argwhere((known == FREE) & (around > 1.5) & (around < 7.5))
    if not len(cells):
        return np.zeros((0, 2), dtype=np.int64)
    square = cells // VOXEL
    away = np.sum((cells - square * VOXEL - 0.5 * (VOXEL - 1)) ** 2, axis=1)
    key = square[:, 0] * (known.shape[1] // VOXEL + 1) + square[:, 1]
    order = np.lexsort((away, key))
    _, first = np.unique(key[order], return_index=True)
    return np.asarray(cells[order[first]])
