"""Where a scan saw free space: the polygon between its beams' ends, and the cells inside it (kernels).

Inside is what OpenCV 5 has inside: what ``fillPoly`` fills, less the rim that ``polylines`` draws. These two took
nearly three times as long, and OpenCV 4 draws another rim.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.grids.scan_drawing import IN_BETWEEN, IN_FREE, WORD
from slam.types import Array, Bytes, Indices

__all__ = ["SUBCELL_BITS", "crossings_of", "fill_inside", "mark_free"]

SUBCELL_BITS = 4
"""Fractional bits of a polygon's vertices: they are whole sixteenths of a cell."""
_FINE_BITS = 16  # of where an edge crosses a row
_HALF_CELL = 1 << (SUBCELL_BITS - 1)


def crossings_of(rows: int, vertices: int) -> Indices:
    """Return work space for polygons of so many vertices in so many rows of a mask."""
    return np.empty((rows, vertices + 1), np.int64)


@njit(cache=True, nogil=True, error_model="numpy")
def mark_free(
    mask: Bytes, polygon: NDArray[np.int32], crossings: Indices, beams: Array, ranges: Array,
    rays: Array, surface: NDArray[np.int16], x: float, y: float, theta: float, resolution: float,
    range_max: float, mask_row: int, mask_col: int, full_circle: bool, dense: float,
) -> tuple[int, int, int, int, int]:  # fmt: skip
    """Mark the cells that a scan from (x, y, θ) saw free; return what :func:`_outline` does.

    Nothing is marked where the polygon has fewer than three vertices. ``crossings`` is from :func:`crossings_of`.
    What lies farther off than ``dense`` [cells], and under no beam, is marked as between two.
    """
    count, top, left, bottom, right = _outline(
        polygon, beams, ranges, rays, surface, x, y, theta, resolution, range_max, mask_row, mask_col, full_circle
    )
    if count >= 3:
        fill_inside(mask, polygon, count, crossings, top, bottom)
        if dense < range_max / resolution:
            x0, y0 = x / resolution - mask_col - 0.5, y / resolution - mask_row - 0.5
            _mark_between(mask, beams, x0, y0, dense, top, left, bottom, right)
    return count, top, left, bottom, right


@njit(cache=True, nogil=True, error_model="numpy")
def _mark_between(
    mask: Bytes, beams: Array, x0: float, y0: float, dense: float, top: int, left: int, bottom: int, right: int
) -> None:
    """Mark as between beams what is farther than ``dense`` [cells] from (x0, y0), but for the cells under one."""
    for row in range(top, bottom + 1):
        for col in range(left, right + 1):
            if mask[row, col] == IN_FREE and (col - x0) ** 2 + (row - y0) ** 2 > dense * dense:
                mask[row, col] = IN_BETWEEN
    for i in range(beams.shape[1]):
        length = math.hypot(beams[0, i], beams[1, i])
        if not length > dense:  # lost, or near by
            continue
        step_x, step_y = beams[0, i] / length, beams[1, i] / length
        for k in range(int(dense), int(length) + 1):
            row, col = int(y0 + k * step_y + 0.5), int(x0 + k * step_x + 0.5)
            if mask[row, col] == IN_BETWEEN:  # not the rim
                mask[row, col] = IN_FREE


@njit(cache=True, nogil=True, error_model="numpy")
def _outline(
    polygon: NDArray[np.int32], beams: Array, ranges: Array, rays: Array, surface: NDArray[np.int16], x: float,
    y: float, theta: float, resolution: float, range_max: float, mask_row: int, mask_col: int, full_circle: bool,
) -> tuple[int, int, int, int, int]:  # fmt: skip
    """Write the scan's free polygon in fixed-point mask cells; return its length and the box it needs.

    ``beams`` ``(4, n)`` is for :func:`slam.grids.scan_drawing.draw`: its last two rows become the cells that beams
    ended in, or ``nan``.
    """
    scale = float(1 << SUBCELL_BITS)
    c, s = math.cos(theta), math.sin(theta)
    x0, y0 = x / resolution - mask_col, y / resolution - mask_row
    n = ranges.shape[0]
    # What needs no branches first, in a loop that vectorises.
    for i in range(n):
        r = ranges[i]
        along_x, along_y = c * rays[0, i] - s * rays[1, i], s * rays[0, i] + c * rays[1, i]
        # Below zero would be outside of the mask, whatever sensor says so: the beam is lost.
        reach = (range_max if r > range_max else (r if r >= 0.0 else math.nan)) / resolution
        beams[0, i], beams[1, i] = along_x * reach, along_y * reach
        # What stopped the beam lies behind the point it returned from: a quarter of a cell deeper.
        deeper = reach + 0.25 if r <= range_max else math.nan
        beams[2, i], beams[3, i] = x0 + along_x * deeper, y0 + along_y * deeper
    x0, y0 = x0 - 0.5, y0 - 0.5  # the middle of cell (0, 0) is (0, 0) there
    low_x = high_x = x0
    low_y = high_y = y0
    count = 0
    lost = 0
    while full_circle and lost < min(n, 2) and math.isnan(beams[0, n - 1 - lost]):
        lost += 1  # a run of them may reach over the seam
    joined = surface.shape[0] == n
    for i in range(n):
        if joined and 0 < i < n - 1 and surface[i] >= 0 and surface[i - 1] == surface[i] == surface[i + 1]:
            continue  # within a straight surface: its two ends say it all
        dx, dy = beams[0, i], beams[1, i]
        if math.isnan(dx):
            # One or two lost beams are bridged by their neighbours; a run of them is not known to be free.
            lost += 1
            if lost != 3:
                continue
            dx = dy = 0.0
        else:
            lost = 0
        polygon[count, 0] = round((x0 + dx) * scale)
        polygon[count, 1] = round((y0 + dy) * scale)
        count += 1
        low_x, high_x = min(low_x, x0 + dx), max(high_x, x0 + dx)
        low_y, high_y = min(low_y, y0 + dy), max(high_y, y0 + dy)
    if not full_circle:
        polygon[count, 0] = round(x0 * scale)
        polygon[count, 1] = round(y0 * scale)
        count += 1
    # Two cells of margin: half for the rounding, one and a half for the surfaces beyond the rim. Whole words.
    return (
        count, max(int(low_y) - 2, 0), max(int(low_x) - 2, 0) & -WORD, int(high_y) + 3,
        (int(high_x) + 3) | (WORD - 1),
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def fill_inside(
    mask: Bytes, polygon: NDArray[np.int32], count: int, crossings: Indices, top: int, bottom: int
) -> None:
    """Mark the cells inside a polygon, by the even-odd rule, in a mask that is empty there.

    Parameters
    ----------
    mask
        Its cells' middles are at whole numbers.
    polygon
        ``(≥ count, 2)`` column and row of each vertex, times 2 to the power of :data:`SUBCELL_BITS`; all of it
        lies in the mask.
    crossings
        From :func:`crossings_of`.
    top, bottom
        Rows between which the polygon lies.
    """
    _cross_rows(polygon, count, crossings, top, bottom)
    _fill_rows(mask, crossings, top, bottom)
    # The rim runs along surfaces: the cells under it are not known to be free. Without this, walls seen at a flat
    # angle, where hits are sparse, would be erased between the hits.
    _erase_rim(mask, polygon, count)


@njit(cache=True, nogil=True, error_model="numpy")
def _cross_rows(polygon: NDArray[np.int32], count: int, crossings: Indices, top: int, bottom: int) -> None:
    """Write for each row from ``top`` to ``bottom`` where edges cross its middle, in order; their number first.

    A vertex counts as in the middle of its row. From row to row an edge goes on by a step that is rounded up: what
    is gained or lost by that lies under the rim.
    """
    u = np.uint64  # as indices, others are tested for being negative
    for row in range(u(top), u(bottom + 1)):
        crossings[row, 0] = 0
    x0, y0 = polygon[count - 1, 0], (polygon[count - 1, 1] + _HALF_CELL) >> SUBCELL_BITS
    for k in range(u(count)):
        x1, y1 = polygon[k, 0], (polygon[k, 1] + _HALF_CELL) >> SUBCELL_BITS
        if y0 != y1:
            x, y, to_x, to_y = (x0, y0, x1, y1) if y0 < y1 else (x1, y1, x0, y0)
            x, to_x = x << (_FINE_BITS - SUBCELL_BITS), to_x << (_FINE_BITS - SUBCELL_BITS)
            step = -((x - to_x) // (to_y - y))
            for row in range(u(y), u(to_y)):
                i = u(crossings[row, 0])
                crossings[row, 0] += 1
                while i > 0 and crossings[row, i] > x:
                    crossings[row, i + u(1)] = crossings[row, i]
                    i -= u(1)
                crossings[row, i + u(1)] = x
                x += step
        x0, y0 = x1, y1


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_rows(mask: Bytes, crossings: Indices, top: int, bottom: int) -> None:
    """Mark the cells between each row's first and second crossing, third and fourth, and so on."""
    u = np.uint64
    almost_one = (1 << _FINE_BITS) - 1
    for row in range(u(top), u(bottom + 1)):
        for i in range(u(1), u(crossings[row, 0]), u(2)):
            first = (crossings[row, i] + almost_one) >> _FINE_BITS
            last = crossings[row, i + u(1)] >> _FINE_BITS
            for col in range(u(first), u(last + 1)):
                mask[row, col] = IN_FREE


@njit(cache=True, nogil=True, error_model="numpy")
def _erase_rim(mask: Bytes, polygon: NDArray[np.int32], count: int) -> None:
    """Wipe the cells under the polygon's edges: Bresenham's lines between the cells of its vertices."""
    x0, y0 = _cell_of(polygon, count - 1)
    for k in range(np.uint64(count)):
        x1, y1 = _cell_of(polygon, k)
        # From left to right: the other way some lines would take other cells.
        if x0 <= x1:
            _erase_line(mask, x0, y0, x1 - x0, y1 - y0)
        else:
            _erase_line(mask, x1, y1, x0 - x1, y0 - y1)
        x0, y0 = x1, y1


@njit(nogil=True, error_model="numpy", forceinline=True)
def _cell_of(polygon: NDArray[np.int32], k: int) -> tuple[int, int]:
    """Return column and row of the cell that a vertex lies in."""
    return (polygon[k, 0] + _HALF_CELL) >> SUBCELL_BITS, (polygon[k, 1] + _HALF_CELL) >> SUBCELL_BITS


@njit(nogil=True, error_model="numpy", forceinline=True)
def _erase_line(mask: Bytes, x: int, y: int, dx: int, dy: int) -> None:
    """Wipe a line of cells from (x, y) on, ``dx`` ≥ 0 to the right and ``dy`` up or down (Bresenham 1965)."""
    down, dy = -1 if dy < 0 else 1, abs(dy)
    error = max(dx, dy) - 2 * min(dx, dy)
    if dy <= dx:
        for col in range(np.uint64(x), np.uint64(x + dx + 1)):
            mask[np.uint64(y), col] = 0
            if error < 0:
                error += 2 * dx
                y += down
            error -= 2 * dy
    else:
        for _ in range(dy + 1):
            mask[np.uint64(y), np.uint64(x)] = 0
            if error < 0:
                error += 2 * dy
                x += 1
            error -= 2 * dx
            y += down
