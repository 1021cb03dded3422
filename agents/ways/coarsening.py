"""From the belief's fine grid to the planning grid: in few passes, for a large map has millions of cells."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.grids.occupancy import CLASS_OF, FREE, OCCUPIED, UNKNOWN
from slam.types import Bytes, Flags, Floats, Indices

__all__ = ["FAR_M", "OCCUPIED_LEAST", "Blocks", "fill_blocks", "known_extent", "to_walls"]

Corners = tuple[int, int, int, int]

FAR_M = 10.0
"""Clearances [m] beyond this say nothing more."""

_LOG_ODDS = np.arange(256, dtype=np.uint8).view(np.int8)
# Classes are ranges of log-odds: free up to here …
_FREE_MOST = int(_LOG_ODDS[CLASS_OF == FREE].max())
OCCUPIED_LEAST = int(_LOG_ODDS[CLASS_OF == OCCUPIED].min())
"""… and occupied from here."""
_NO_WALL = (CLASS_OF != OCCUPIED).astype(np.uint8)

# Three counts in one number: of free fine cells, of occupied ones, and of suspect ones.
_FIELD = 20  # bits
_COUNT = (1 << _FIELD) - 1


@dataclass(frozen=True, eq=False)
class Blocks:
    """Blocks of fine cells, and a ring of unknown ones around them."""

    classes: NDArray[np.int8]  # (rows, cols): occupied if any fine cell is, free if most are
    clearance: Floats  # (rows, cols) [m] from the block's centre to the nearest occupied edge
    suspect: Flags  # (rows, cols) where something was hit that is not settled to be a wall

    @classmethod
    def blank(cls, rows: int, cols: int) -> Self:
        """Return so many blocks, all unknown."""
        return cls(
            np.full((rows, cols), UNKNOWN, dtype=np.int8),
            np.full((rows, cols), FAR_M, dtype=np.float32),
            np.zeros((rows, cols), dtype=np.bool_),
        )


def to_walls(log_odds: NDArray[np.int8]) -> Floats:
    """Return each cell's distance to the nearest occupied cell's centre, in cells, infinite without any."""
    free_of_wall = cv2.LUT(log_odds.view(np.uint8), _NO_WALL)
    if cv2.countNonZero(free_of_wall) == free_of_wall.size:
        return np.full(log_odds.shape, np.inf, dtype=np.float32)
    return np.asarray(cv2.distanceTransform(free_of_wall, cv2.DIST_L2, cv2.DIST_MASK_5), dtype=np.float32)


@njit(cache=True, nogil=True)
def known_extent(log_odds: NDArray[np.int8], visited: Bytes) -> tuple[int, int, int, int]:
    """Return the box of what is known or was visited: first row and column, and those beyond the last.

    Of an empty grid the first are beyond all. Each row is looked at only outside the columns that are in the box
    already.
    """
    rows, cols = log_odds.shape
    row0, row1 = 0, rows
    while row0 < rows and _is_blank(log_odds[row0], visited[row0]):
        row0 += 1
    while row1 > 0 and _is_blank(log_odds[row1 - 1], visited[row1 - 1]):
        row1 -= 1
    col0, col1 = cols, 0
    for row in range(row0, row1):
        for col in range(col0):
            if log_odds[row, col] != 0 or visited[row, col] != 0:
                col0 = col
                break
        for col in range(cols - 1, col1 - 1, -1):
            if log_odds[row, col] != 0 or visited[row, col] != 0:
                col1 = col + 1
                break
    return row0, col0, row1, col1


@njit(cache=True, nogil=True)
def _is_blank(log_odds: NDArray[np.int8], visited: Bytes) -> bool:
    found = np.uint8(0)
    for col in range(log_odds.shape[0]):  # to the end: then it is many at a time
        found |= np.uint8(log_odds[col]) | visited[col]
    return bool(found == 0)


@njit(cache=True, nogil=True)
def fill_blocks(
    log_odds: NDArray[np.int8], visited: Bytes, distance: Floats, extent: Corners, box: Corners, resolution: float,
    factor: int, row_pad: int, col_pad: int, classes: NDArray[np.int8], clearance: Floats, suspect: Flags,
) -> None:  # fmt: skip
    """Fill a box of blocks, a row of them at a time.

    Parameters
    ----------
    log_odds, visited, distance
        Planes ``(rows, cols)`` of fine cells, the last from :func:`to_walls`.
    extent
        First row and column, and those beyond the last, of the fine cells that there are blocks of.
    box
        The same of the blocks to fill; block (1, 1) is the first that is none of the ring's.
    resolution
        Side of a fine cell [m].
    factor, row_pad, col_pad
        Fine cells to a side of a block, and how far into block (1, 1) the extent begins.
    classes, clearance, suspect
        As in :class:`Blocks`.
    """
    row0, col0, row1, col1 = extent
    near, far = np.float32(resolution), np.float32(FAR_M)
    blocks = box[3] - box[1]
    # Fine columns of these blocks, as counted from the first block's beginning.
    before = (box[1] - 1) * factor - col_pad
    first, beyond = col0 + max(before, 0), min(col0 + before + blocks * factor, col1)
    pad = max(-before, 0)
    metres, marks = np.empty(beyond - first, dtype=np.float32), np.empty(beyond - first, dtype=np.int64)
    totals, counts = np.empty(blocks), np.empty(blocks, dtype=np.int64)
    inside = np.zeros(blocks, dtype=np.int64)  # fine columns of each
    for col in range(beyond - first):
        inside[(col + pad) // factor] += 1
    for row in range(box[0], box[2]):
        totals[:] = 0.0
        counts[:] = 0
        low, high = max(row0 + (row - 1) * factor - row_pad, row0), min(row0 + row * factor - row_pad, row1)
        for r in range(low, high):
            _read(
                log_odds[r, first:beyond], visited[r, first:beyond], distance[r, first:beyond], near, far, metres,
                marks,
            )  # fmt: skip
            for i in range(factor):
                _add(metres, marks, i - pad, factor, totals, counts)
        for block in range(blocks):
            count, col = counts[block], box[1] + block
            if (count >> _FIELD) & _COUNT:
                classes[row, col] = OCCUPIED
            elif 2 * (count & _COUNT) > factor * factor:
                classes[row, col] = FREE
            else:
                classes[row, col] = UNKNOWN
            suspect[row, col] = count >> (2 * _FIELD) != 0
            # The mean over a block is the distance at its centre, to second order.
            clearance[row, col] = totals[block] / (inside[block] * (high - low))


@njit(cache=True, nogil=True)
def _read(
    log_odds: NDArray[np.int8], visited: Bytes, distance: Floats, resolution: np.float32,
    far: np.float32, metres: Floats, marks: Indices,
) -> None:  # fmt: skip
    """Write each fine cell's clearance [m] and what it is, in a row; without branches, for many at a time."""
    half = np.float32(0.5)  # a cell: from the occupied cell's centre to its edge
    for col in range(log_odds.shape[0]):
        metres[col] = min((distance[col] - half) * resolution, far)
    for col in range(log_odds.shape[0]):
        odds = log_odds[col]
        occupied = odds >= OCCUPIED_LEAST
        free = (odds <= _FREE_MOST) | ((visited[col] != 0) & ~occupied)
        unsettled = (odds > 0) & ~occupied & ~free
        marks[col] = np.int64(free) | np.int64(occupied) << _FIELD | np.int64(unsettled) << (2 * _FIELD)


@njit(cache=True, nogil=True)
def _add(
    metres: Floats, marks: Indices, shift: int, factor: int, totals: NDArray[np.float64], counts: Indices
) -> None:
    """Add to each block the cell of a row that lies ``shift`` cells from the block's beginning, if any."""
    first, beyond = 1 if shift < 0 else 0, (metres.shape[0] - 1 - shift) // factor + 1
    start = factor * first + shift
    # Views that begin where the work does: their indices are seen to be in order, and many are taken at a time.
    totals, counts, metres, marks = totals[first:beyond], counts[first:beyond], metres[start:], marks[start:]
    if factor == 2:  # the usual one: the compiler makes more of a number that it knows
        for j in range(totals.shape[0]):
            totals[j] += metres[2 * j]
            counts[j] += marks[2 * j]
    else:
        for j in range(totals.shape[0]):
            totals[j] += metres[factor * j]
            counts[j] += marks[factor * j]
