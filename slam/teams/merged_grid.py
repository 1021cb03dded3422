"""An occupancy grid of one's own map and of what other robots told of theirs."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.geometry import rotation, transform_points
from slam.grids.occupancy import CLASS_OF, OccupancyGrid
from slam.grids.scan_drawing import ENTROPY_BIT, MAX_LOG_ODDS, MIN_LOG_ODDS, PROBABILITY_BYTE, WORD
from slam.types import Array, Bytes

__all__ = ["Chart", "MergedGrid"]

_GIVEN_WORDS = 2  # of the sum of two bytes a cell, in the length of a word of cells
_Box = tuple[int, int, int, int]  # lattice rows and columns: first, first, beyond the last, beyond the last


class Chart(NamedTuple):
    """A robot's own grid as it was told to another; nothing in it that others had told."""

    cells: NDArray[np.int8]  # (rows, cols) log-odds as of :class:`OccupancyGrid`, 0 where never observed
    lattice_origin: tuple[int, int]  # row and column of cell (0, 0)

    @classmethod
    def of(cls, grid: OccupancyGrid) -> Chart:
        """Return a copy of a grid."""
        return cls(grid.log_odds.copy(), grid.lattice_origin)

    def grid(self, resolution: float) -> OccupancyGrid:
        """Return the classes of the cells as a grid of this resolution [m]."""
        row, col = self.lattice_origin
        classes = CLASS_OF[self.cells.view(np.uint8)]
        return OccupancyGrid.from_classes(classes, resolution, (col * resolution, row * resolution))


class MergedGrid(OccupancyGrid):
    """The sum of a robot's own log-odds and others', on the robot's own lattice.

    Each robot's evidence counts once: a chart replaces the one that its robot told before, and holds nothing but
    what that robot saw itself (:mod:`slam.teams`). ``take_changes`` tells of nothing; ``drawn_since`` of all.
    """

    def __init__(self, own: OccupancyGrid) -> None:
        super().__init__(own.resolution)
        self._own = own
        self._seen = -1  # drawings of the own grid that are in here
        self._charts: dict[int, tuple[Chart, Array | None]] = {}
        self._given = np.zeros(self.shape, np.int16)  # the others' sum, on this lattice
        self._taken = np.zeros(self.shape, np.int8)  # what of the own grid is in here

    def take(self, charts: dict[int, tuple[Chart, Array | None]]) -> None:
        """Replace what other robots told.

        Parameters
        ----------
        charts : dict
            For each robot its chart, and the pose ``(3,)`` of its frame in this one; None where they are the same.
        """
        if not charts and not self._charts:
            return
        self._charts = dict(charts)
        for chart, frame in charts.values():
            self._grow(*_extent(chart, frame, self.resolution))
        given = np.zeros(self.shape, np.int16)
        for chart, frame in charts.values():
            self._add(given, chart, frame)
        row0, col0 = self.lattice_origin
        first_row, first_col, last_row, last_col = _differing(given, self._given)
        self._given, before = given, self._given
        if first_row <= last_row:
            self._merge(row0 + first_row, col0 + first_col, row0 + last_row + 1, col0 + last_col + WORD, before)

    def follow(self) -> None:
        """Take over what was drawn into the own grid since the last time."""
        own = self._own
        if own.drawings == self._seen:
            return
        r0, c0, r1, c1 = own.drawn_since(self._seen)
        self._seen = own.drawings
        row, col = own.lattice_origin
        box = row + r0, col + c0, row + r1, col + c1
        self._grow(*box)
        self._merge(*box, self._given)

    def _moved(self, plane: NDArray[Any], lattice_origin: tuple[int, int]) -> NDArray[Any]:
        """Return a plane of this grid, as it was before it grew, in its present shape."""
        moved = np.zeros(self.shape, plane.dtype)
        r, c = (then - now for then, now in zip(lattice_origin, self.lattice_origin, strict=True))
        moved[r : r + plane.shape[0], c : c + plane.shape[1]] = plane
        return moved

    def _move_near(self, row0: int, col0: int, row1: int, col1: int) -> None:
        """Stay: what others tell may lie anywhere, and nothing of it is drawn yet."""

    def _grow(self, row0: int, col0: int, row1: int, col1: int) -> None:
        before = self.shape, self.lattice_origin
        super()._grow(row0, col0, row1, col1)
        if (self.shape, self.lattice_origin) != before:
            self._given = self._moved(self._given, before[1])
            self._taken = self._moved(self._taken, before[1])

    def _add(self, given: NDArray[np.int16], chart: Chart, frame: Array | None) -> None:
        """Add a chart to a plane of this grid; no sum of what was observed is zero."""
        row0, col0, row1, col1 = _extent(chart, frame, self.resolution)
        r, c = row0 - self.lattice_origin[0], col0 - self.lattice_origin[1]
        window = given[r : r + row1 - row0, c : c + col1 - col0]
        cells = chart.cells
        if frame is not None:
            cells = _turned(chart, frame, self.resolution, (row0, col0), window.shape)
        window += cells
        window[(window == 0) & (cells != 0)] = -1

    def _merge(self, row0: int, col0: int, row1: int, col1: int, before: NDArray[np.int16]) -> None:
        """Sum up own and given cells in a box of the lattice; ``before`` is what was given the last time."""
        own, r, c = self._own, *self.lattice_origin
        known, entropy = _sum(
            own.log_odds, own.visited, own.lattice_origin[0] - r, own.lattice_origin[1] - c, self._given, before,
            self._taken, self.log_odds, self.visited, row0 - r, col0 - c, row1 - r, col1 - c, self.overview_sums,
            self._overview_shift,
        )  # fmt: skip
        self.known_cells += known
        self.entropy_bit += entropy
        self._note_drawn(row0, col0, row1, col1)


def _extent(chart: Chart, frame: Array | None, resolution: float) -> _Box:
    """Return the box of the lattice that a chart covers, placed by its frame's pose."""
    (row, col), (rows, cols) = chart.lattice_origin, chart.cells.shape
    if frame is None:
        return row, col, row + rows, col + cols
    ends = np.array([(col, row), (col + cols, row), (col + cols, row + rows), (col, row + rows)]) * resolution
    placed = transform_points(frame, ends) / resolution
    (col0, row0), (col1, row1) = np.floor(placed.min(axis=0)) - 1, np.ceil(placed.max(axis=0)) + 1
    return int(row0), int(col0), int(row1), int(col1)


def _turned(
    chart: Chart, frame: Array, resolution: float, corner: tuple[int, int], shape: tuple[int, ...]
) -> NDArray[np.int8]:
    """Return a chart's cells on another lattice from its cell (row, column) ``corner`` on: the nearest."""
    turn = rotation(float(frame[2]))
    # From a cell (column, row) of the result to one of the chart: both by their centres.
    offset = (np.array(corner[::-1]) + 0.5) * resolution - frame[:2]
    origin = turn.T @ offset / resolution - np.array(chart.lattice_origin[::-1]) - 0.5
    back = np.hstack([turn.T, origin[:, None]])
    cells = cv2.warpAffine(
        chart.cells.view(np.uint8), back, (shape[1], shape[0]), flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    )  # fmt: skip
    return np.asarray(cells).view(np.int8)


@njit(cache=True, nogil=True, error_model="numpy")
def _differing(plane: NDArray[np.int16], other: NDArray[np.int16]) -> tuple[int, int, int, int]:
    """Return the first row, the first column of a word, and the last ones, of the box where two planes differ."""
    words, others = plane.view(np.uint64), other.view(np.uint64)
    first_row, last_row, first, last = plane.shape[0], -1, words.shape[1], -1
    for i in range(words.shape[0]):
        for j in range(words.shape[1]):
            if words[i, j] != others[i, j]:
                first_row, last_row = min(first_row, i), i
                first, last = min(first, j), max(last, j)
    return first_row, first // _GIVEN_WORDS * WORD, last_row, last // _GIVEN_WORDS * WORD


@njit(cache=True, nogil=True, error_model="numpy")
def _sum(
    own: NDArray[np.int8], own_visited: Bytes, down: int, ahead: int, given: NDArray[np.int16],
    before: NDArray[np.int16], taken: NDArray[np.int8], cells: NDArray[np.int8], visited: Bytes,
    row0: int, col0: int, row1: int, col1: int, overview: NDArray[np.int32], shift: int,
) -> tuple[int, float]:  # fmt: skip
    """Write own + given cells of a box; return by how much the known cells and the entropy went up.

    ``down`` and ``ahead``: rows and columns from the first cell here to that of the own grid. Where nothing is
    given but what was ``before``, and the own grid is as it was ``taken``, nothing is done: words of cells are
    compared at once. So columns of boxes and of grids begin and end at multiples of a word.
    """
    own_words, taken_words = own.view(np.uint64), taken.view(np.uint64)
    own_trail, trail = own_visited.view(np.uint64), visited.view(np.uint64)
    given_words, before_words = given.view(np.uint64), before.view(np.uint64)
    known, entropy = 0, 0.0
    for i in range(row0, row1):
        own_i = i - down
        inside = 0 <= own_i < own.shape[0]
        first, last = max(ahead, 0) // WORD, min(ahead + own.shape[1], cells.shape[1]) // WORD if inside else 0
        for word in range(col0 // WORD, col1 // WORD):
            mine_too = first <= word < last
            changed = False
            for k in range(_GIVEN_WORDS * word, _GIVEN_WORDS * (word + 1)):
                changed |= given_words[i, k] != before_words[i, k]
            if mine_too:
                own_word = word - ahead // WORD
                changed |= own_words[own_i, own_word] != taken_words[i, word]
                changed |= own_trail[own_i, own_word] != trail[i, word]
            if not changed:
                continue
            for j in range(word * WORD, (word + 1) * WORD):
                mine = np.int64(0)
                block_i, block_j = i >> shift, j >> shift
                if mine_too:
                    mine = np.int64(own[own_i, j - ahead])
                    taken[i, j] = mine
                    overview[2, block_i, block_j] += np.int64(own_visited[own_i, j - ahead]) - visited[i, j]
                    visited[i, j] = own_visited[own_i, j - ahead]
                total = mine + given[i, j]
                if total == 0 and mine != 0:
                    total = -1
                total = min(max(total, MIN_LOG_ODDS), MAX_LOG_ODDS)
                then = np.int64(cells[i, j])
                if total != then:
                    cells[i, j] = total
                    overview[1, block_i, block_j] += (PROBABILITY_BYTE[total & 255] if total != 0 else 0) - (
                        PROBABILITY_BYTE[then & 255] if then != 0 else 0
                    )
                    entropy += ENTROPY_BIT[total & 255] - ENTROPY_BIT[then & 255]
                    gained = (total != 0) - (then != 0)
                    overview[0, block_i, block_j] += gained
                    known += gained
    return known, entropy
