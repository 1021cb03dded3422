"""The occupancy grid that every backend draws from its estimated poses.

Cells are log-odds in an ``int8`` (one unit is 0.05 nat). The grid lies on a lattice through the origin of the
belief's frame and grows as scans need it: neither its size nor its origin tells anything about the true plan.

A scan is drawn as what it is, a star-shaped polygon of free space with surfaces on its rim:
cells inside lose odds once per scan, however many beams pass through them, and cells that a beam ended in, or
that lie on a straight surface between two beams, gain.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from slam.grids.free_space import crossings_of, mark_free
from slam.grids.scan_drawing import (
    APART_M,
    CLASS_OF,
    ENTROPY_BIT,
    FREE,
    GAP_M,
    MAX_LOG_ODDS,
    MIN_LOG_ODDS,
    NO_SURFACE,
    OCCUPIED,
    PROBABILITY_BYTE,
    UNIT_NAT,
    UNKNOWN,
    WINDOW,
    WORD,
    draw,
    ends_on,
    mark_disc,
    sum_blocks,
)
from slam.types import Array, Cells, Floats, Indices, Scan

__all__ = ["CLASS_OF", "FREE", "OCCUPIED", "PROBABILITY_BYTE", "UNKNOWN", "OccupancyGrid"]

_CHUNK = 32  # the grid's edges lie on multiples of this, so that every overview block is whole
_SPARE = 2  # chunks more than is needed when it grows
_FAR = 32 * _CHUNK  # so many cells of nothing are not worth keeping
_MOST_CHANGES = 1 << 20  # that are kept for who follows; then followers start over
_OVERVIEW = 64  # the overview never has more than this many blocks a side


class OccupancyGrid:
    """Log-odds occupancy over a lattice of square cells, with a block overview kept up to date.

    Rows run along y and columns along x, row 0 at the lowest y. ``log_odds`` is 0 where a cell was never
    observed, and nowhere else.

    Attributes
    ----------
    resolution : float
        Side of a cell [m].
    log_odds : NDArray[np.int8]
        ``(rows, cols)``, in units of 0.05 nat.
    visited : NDArray[np.uint8]
        ``(rows, cols)``, 1 where the robot's body has been.
    cells, trail : NDArray[np.uint8]
        Either one's bytes ``(rows · cols + spare,)``, row by row: kernels may read some that are zero behind them.
    known_cells : int
        Number of cells ever observed.
    entropy_bit : float
        Entropy of the observed cells less one bit each: 0 at the start, falling as the map grows sure.
    overview_sums : NDArray[np.int32]
        ``(3, rows, cols)``, per block: observed cells, the sum of their probability × 255, visited cells.
    overview_block : int
        Cells a side of a block.
    revision : int
        Goes up when the whole map was redrawn, so that whoever follows ``take_changes`` starts over.
    drawings : int
        Goes up whenever anything is drawn, so that any number of readers can ask :meth:`drawn_since`.
    """

    def __init__(self, resolution: float = 0.05) -> None:
        if not (math.isfinite(resolution) and 0.0 < resolution <= 10.0):
            raise ValueError(f"grid resolution must be in (0, 10] m, got {resolution}")
        self.resolution = float(resolution)
        self._col0 = self._row0 = -_CHUNK  # lattice index of cell (0, 0) …
        self._col1 = self._row1 = _CHUNK  # … and of the one beyond the last
        self._lay_out(2 * _CHUNK, 2 * _CHUNK)
        self.known_cells = 0
        self.entropy_bit = 0.0
        self.revision = self.drawings = 0
        self._drawn = np.zeros((2, 2), np.int64)  # the last drawing that touched each chunk
        self._changes = np.zeros((1024, 4), np.int32)
        self._change_count = 0
        self._lidar: tuple[int, float, float, float] | None = None
        self._build_overview()

    def _lay_out(self, rows: int, cols: int) -> None:
        """Take new planes, all unknown."""
        self.cells, self.trail = (np.zeros(rows * cols + WINDOW, np.uint8) for _ in range(2))
        self.log_odds = self.cells[:-WINDOW].view(np.int8).reshape(rows, cols)
        self.visited = self.trail[:-WINDOW].reshape(rows, cols)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what holds the planes' bytes once more."""
        return {name: value for name, value in self.__dict__.items() if name not in ("cells", "trail")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make a copy or a pickle whole: its planes came each by itself."""
        self.__dict__.update(state)
        self._lay_out(*self.shape)
        self.log_odds[:], self.visited[:] = state["log_odds"], state["visited"]

    @classmethod
    def from_classes(cls, classes: NDArray[np.int8], resolution: float, origin: tuple[float, float]) -> Self:
        """Build a grid from ``(rows, cols)`` classes; ``origin`` is rounded to a multiple of the cell."""
        grid = cls(resolution)
        rows, cols = classes.shape
        col, row = round(origin[0] / resolution), round(origin[1] / resolution)
        grid._grow(row, col, row + rows, col + cols)
        r, c = row - grid._row0, col - grid._col0
        view = grid.log_odds[r : r + rows, c : c + cols]
        view[classes == OCCUPIED] = MAX_LOG_ODDS
        view[classes == FREE] = MIN_LOG_ODDS
        grid.known_cells = int(np.count_nonzero(grid.log_odds))
        grid.entropy_bit = float(np.sum(ENTROPY_BIT[grid.log_odds[grid.log_odds != 0].view(np.uint8)] - 1.0))
        grid._build_overview()
        grid._note_drawn(row, col, row + rows, col + cols)
        return grid

    # ---- geometry ------------------------------------------------------------------------------------------

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.log_odds.shape[0], self.log_odds.shape[1]

    @property
    def lattice_origin(self) -> tuple[int, int]:
        """Lattice index (row, column) of cell (0, 0); lattice cell (0, 0) touches the frame's origin."""
        return self._row0, self._col0

    @property
    def origin(self) -> tuple[float, float]:
        """Position (x, y) [m] of the lower-left corner of cell (0, 0)."""
        return self._col0 * self.resolution, self._row0 * self.resolution

    def to_cells(self, points: Array) -> Indices:
        """Return row and column ``(n, 2)`` of points ``(n, 2)`` [m]; they may lie outside the grid."""
        cells = np.floor(np.asarray(points, dtype=np.float64) / self.resolution).astype(np.int64)
        return np.asarray(cells[..., ::-1] - np.array([self._row0, self._col0]), dtype=np.int64)

    def to_points(self, cells: Cells) -> Array:
        """Return the centres ``(n, 2)`` [m] of cells ``(n, 2)`` given as row, column."""
        lattice = np.asarray(cells)[..., ::-1] + np.array([self._col0, self._row0])
        return np.asarray((lattice + 0.5) * self.resolution, dtype=np.float64)

    def centres(self) -> Array:
        """Return the centres ``(rows · cols, 2)`` [m] of all cells, row by row."""
        rows, cols = self.shape
        x = (np.arange(self._col0, self._col0 + cols) + 0.5) * self.resolution
        y = (np.arange(self._row0, self._row0 + rows) + 0.5) * self.resolution
        return np.column_stack([np.tile(x, rows), np.repeat(y, cols)])

    # ---- reading -------------------------------------------------------------------------------------------

    def classes(self) -> NDArray[np.int8]:
        """Return ``(rows, cols)`` of UNKNOWN, FREE and OCCUPIED."""
        return CLASS_OF[self.log_odds.view(np.uint8)]

    def points_of(self, kind: int, centre: tuple[float, float], radius_m: float) -> Array:
        """Return the centres ``(n, 2)`` [m] of the cells of a class within a radius of a point, row by row."""
        (x, y), rows, cols = centre, slice(None), slice(None)
        if math.isfinite(radius_m):
            rows, cols = (
                slice(max(math.floor((at - radius_m) / self.resolution) - first, 0),
                      max(math.ceil((at + radius_m) / self.resolution) - first + 1, 0))
                for at, first in ((y, self._row0), (x, self._col0))
            )  # fmt: skip
        found = np.argwhere(CLASS_OF[self.log_odds[rows, cols].view(np.uint8)] == kind)
        points = self.to_points(found + np.array([rows.start or 0, cols.start or 0]))
        return points[np.hypot(points[:, 0] - x, points[:, 1] - y) <= radius_m]

    def probability(self) -> Floats:
        """Return the occupancy probability ``(rows, cols)``, 0.5 where nothing was observed."""
        return np.asarray(1.0 / (1.0 + np.exp(-UNIT_NAT * self.log_odds.astype(np.float32))), np.float32)

    @property
    def known_area_m2(self) -> float:
        """Area of the cells ever observed [m²]."""
        return self.known_cells * self.resolution**2

    def take_changes(self) -> NDArray[np.int32]:
        """Return the cells whose class changed since the last call, oldest first, and forget them.

        Rows of ``(n, 4)``: lattice row, lattice column, class before, class now.
        """
        changes = self._changes[: self._change_count].copy()
        self._change_count = 0
        return changes

    def drawn_since(self, drawing: int) -> tuple[int, int, int, int]:
        """Return a box around all that was drawn after so many ``drawings``; it is empty where nothing was.

        First row and column, and those beyond the last. Nothing is forgotten: every reader counts for itself.
        """
        chunks = self._drawn > drawing
        rows, cols = np.flatnonzero(chunks.any(axis=1)), np.flatnonzero(chunks.any(axis=0))
        if not len(rows):
            return 0, 0, 0, 0
        return (
            _CHUNK * int(rows[0]), _CHUNK * int(cols[0]), _CHUNK * int(rows[-1] + 1), _CHUNK * int(cols[-1] + 1)
        )  # fmt: skip

    def agreement(self, sensor_pose: Array, scan: Scan) -> float:
        """Return the sum of the log-odds [nat] of the cells that a scan's beams end in, seen from a pose ``(3,)``.

        It compares poses of one scan by how well each fits the map; unknown cells count for nothing.
        """
        self._prepare_for(scan)
        x, y, theta = np.asarray(sensor_pose).tolist()
        units = ends_on(
            self.log_odds, scan.ranges, self._rays, x / self.resolution - self._col0,
            y / self.resolution - self._row0, theta, self.resolution, scan.range_max,
        )  # fmt: skip
        return UNIT_NAT * units

    # ---- drawing -------------------------------------------------------------------------------------------

    def clear(self) -> None:
        """Forget every observation (but not where the robot has been), for a redraw from corrected poses."""
        self.log_odds[:] = 0
        self.known_cells = 0
        self.entropy_bit = 0.0
        self.revision += 1
        self._change_count = 0
        self._build_overview()
        self._note_drawn(self._row0, self._col0, self._row1, self._col1)

    def redraw(self, sensor_poses: Array, scans: Iterable[tuple[Scan, NDArray[np.int16]]]) -> None:
        """Draw anew from poses ``(n, 3)`` of scans, each with its surfaces; followers start over."""
        self.clear()
        for pose, (scan, surface) in zip(sensor_poses, scans, strict=False):
            self.integrate(pose, scan, surface)
        self._change_count = 0

    def mark_visited(self, x: float, y: float, radius: float) -> None:
        """Mark the disc around (x, y) [m] as a place where the robot's body has been."""
        x, y, radius = self._make_room_for(x, y, radius)
        mark_disc(self.visited, self.overview_sums, self._overview_shift, y - self._row0, x - self._col0, radius)
        self._note_drawn(*_box_of(x, y, radius))

    def integrate(
        self, sensor_pose: Array | tuple[float, float, float], scan: Scan,
        surface: NDArray[np.int16] | None = None, *, body: tuple[float, float, float] | None = None,
    ) -> None:  # fmt: skip
        """Draw one scan taken from ``sensor_pose`` ``(3,)`` in the grid's frame.

        Parameters
        ----------
        sensor_pose : Array or tuple
            Where the sensor was: x [m], y [m], θ [rad].
        scan : Scan
            The ranges; lost beams (``nan``) say nothing, free space beyond a beam without return (``inf``)
            reaches to ``range_max``.
        surface : NDArray[np.int16], optional
            ``(beams,)``: the straight surface each beam ended on (see :mod:`slam.features.extraction`), negative
            for none. Hits on one surface are joined, which closes walls seen at a flat angle.
        body : tuple, optional
            Where the robot's body was, x and y [m], and its radius [m]: :meth:`mark_visited` in the same breath.
        """
        if surface is None:
            surface = NO_SURFACE
        self._prepare_for(scan)
        resolution, reach = self.resolution, self._reach
        mask, beams = self._mask, self._beams
        x, y, theta = sensor_pose if isinstance(sensor_pose, tuple) else sensor_pose.tolist()
        # The sensor is near the mask's middle; its columns lie eight cells to a word of the grid's.
        mask_row = math.floor(y / resolution) - reach
        mask_col = (math.floor(x / resolution) - reach) & -WORD
        count, r0, c0, r1, c1 = mark_free(
            mask, self._polygon, self._crossings, beams, scan.ranges, self._rays, surface, x, y, theta, resolution,
            scan.range_max, mask_row, mask_col, self._full_circle, self._dense,
        )  # fmt: skip
        if count < 3:
            if body is not None:
                self.mark_visited(*body)
            return
        self._grow(mask_row + r0, mask_col + c0, mask_row + r1 + 1, mask_col + c1 + 1)
        body_x, body_y, radius = (0.0, 0.0, -1.0) if body is None else self._make_room_for(*body)
        if self._change_count > _MOST_CHANGES:  # nobody follows
            self._change_count = 0
            self.revision += 1
        most = self._change_count + (r1 + 1 - r0) * (c1 + 1 - c0) + 1
        if len(self._changes) < most:
            grown = np.zeros((2 * most, 4), np.int32)
            grown[: self._change_count] = self._changes[: self._change_count]
            self._changes = grown
        self._change_count, known, entropy = draw(
            mask, beams, surface, mask_row, mask_col, r0, c0, r1, c1, self.cells, self.visited, self._row0,
            self._col0, self.overview_sums, self._overview_shift, self._changes, self._change_count,
            body_y - self._row0, body_x - self._col0, radius, self._dense, GAP_M / resolution,
        )  # fmt: skip
        self.known_cells += known
        self.entropy_bit += entropy
        # One box of both: the body is where the scan was taken from.
        row0, col0, row1, col1 = mask_row + r0, mask_col + c0, mask_row + r1 + 1, mask_col + c1 + 1
        if body is not None:
            low_row, low_col, high_row, high_col = _box_of(body_x, body_y, radius)
            row0, col0 = min(row0, low_row), min(col0, low_col)
            row1, col1 = max(row1, high_row), max(col1, high_col)
        self._note_drawn(row0, col0, row1, col1)

    def _prepare_for(self, scan: Scan) -> None:
        """Make the tables and buffers for scans of this one's lidar, where the last one was of another."""
        n, increment = len(scan.ranges), scan.angle_increment
        lidar = (n, scan.angle_min, increment, scan.range_max)
        if lidar == self._lidar:
            return
        self._lidar = lidar
        angles = scan.angle_min + increment * np.arange(n)
        self._rays = np.stack([np.cos(angles), np.sin(angles)])
        self._full_circle = n * increment > 2 * math.pi - 1.5 * increment
        # [cells] up to where beams lie close together; a scan of one beam may have no increment.
        self._dense = APART_M / max(abs(increment), 1e-9) / self.resolution
        self._polygon = np.empty((n + 1, 2), np.int32)
        self._beams = np.empty((4, n))
        self._reach = math.ceil(scan.range_max / self.resolution) + 3
        # As wide as that again and a window more, into which the kernel may look beyond the box of a scan.
        self._mask = np.zeros((2 * self._reach + 1, (2 * self._reach // WORD + 3) * WORD + WINDOW), np.uint8)
        self._crossings = crossings_of(len(self._mask), n + 1)

    def _make_room_for(self, x: float, y: float, radius: float) -> tuple[float, float, float]:
        """Make room for a disc [m]; return it in cells of the lattice."""
        cell = self.resolution
        x, y, radius = x / cell, y / cell, radius / cell
        row, col, reach = math.floor(y), math.floor(x), math.ceil(radius) + 1
        self._grow(row - reach, col - reach, row + reach + 1, col + reach + 1)
        return x, y, radius

    def _note_drawn(self, row0: int, col0: int, row1: int, col1: int) -> None:
        """Take note that lattice cells [row0, row1) × [col0, col1) were drawn in."""
        self.drawings += 1
        rows = slice(max(row0 - self._row0, 0) // _CHUNK, -((self._row0 - row1) // _CHUNK))
        cols = slice(max(col0 - self._col0, 0) // _CHUNK, -((self._col0 - col1) // _CHUNK))
        self._drawn[rows, cols] = self.drawings

    def _grow(self, row0: int, col0: int, row1: int, col1: int) -> None:
        """Make room for lattice cells [row0, row1) × [col0, col1), in chunks and with some to spare."""
        if row0 >= self._row0 and col0 >= self._col0 and row1 <= self._row1 and col1 <= self._col1:
            return
        if not self.drawings:
            self._move_near(row0, col0, row1, col1)
        rows, cols = self.shape
        new_row0, new_col0 = (
            old if wanted >= old else (wanted // _CHUNK - _SPARE) * _CHUNK
            for wanted, old in ((row0, self._row0), (col0, self._col0))
        )  # fmt: skip
        new_row1, new_col1 = (
            old if wanted <= old else (-(-wanted // _CHUNK) + _SPARE) * _CHUNK
            for wanted, old in ((row1, self._row1), (col1, self._col1))
        )  # fmt: skip
        r, c, log_odds, visited = self._row0 - new_row0, self._col0 - new_col0, self.log_odds, self.visited
        self._lay_out(new_row1 - new_row0, new_col1 - new_col0)
        self.log_odds[r : r + rows, c : c + cols] = log_odds
        self.visited[r : r + rows, c : c + cols] = visited
        drawn = np.zeros((self.shape[0] // _CHUNK, self.shape[1] // _CHUNK), np.int64)
        r, c, (rows, cols) = r // _CHUNK, c // _CHUNK, self._drawn.shape
        drawn[r : r + rows, c : c + cols] = self._drawn
        self._drawn = drawn
        self._row0, self._col0, self._row1, self._col1 = new_row0, new_col0, new_row1, new_col1
        self._build_overview()

    def _move_near(self, row0: int, col0: int, row1: int, col1: int) -> None:
        """Have the empty grid begin at a box that is far from it: there may be kilometres between."""
        rows, cols = self.shape
        if max(self._row0 - row1, row0 - self._row1, self._col0 - col1, col0 - self._col1) > _FAR:
            self._row0, self._col0 = row0 // _CHUNK * _CHUNK, col0 // _CHUNK * _CHUNK
            self._row1, self._col1 = self._row0 + rows, self._col0 + cols
            self.revision += 1

    # ---- overview ------------------------------------------------------------------------------------------

    def _build_overview(self) -> None:
        """Sum the cells up in blocks, the smallest power of two that leaves at most 64 a side."""
        rows, cols = self.shape
        block = 1
        while max(rows, cols) > _OVERVIEW * block:
            block *= 2
        if block > _CHUNK:
            # Beyond 2048 cells a side: the last block of a row may be short, which the padding stands for.
            rows, cols = -(-rows // block) * block, -(-cols // block) * block
        self.overview_block, self._overview_shift = block, block.bit_length() - 1
        self.overview_sums = np.zeros((3, rows // block, cols // block), np.int32)
        sum_blocks(self.log_odds, self.visited, self._overview_shift, self.overview_sums)


def _box_of(x: float, y: float, radius: float) -> tuple[int, int, int, int]:
    """Return the box of cells that a disc lies in, all in cells of the lattice: first and last + 1 of both."""
    return int(y - radius) - 1, int(x - radius) - 1, int(y + radius) + 2, int(x + radius) + 2
