"""How a scan is drawn into an occupancy grid: cell values, and the Numba kernels behind the grid.

OpenCV fills the polygon between :func:`outline` and :func:`fuse`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

UNKNOWN, FREE, OCCUPIED = -1, 0, 100
"""Cell classes, with the values of a ROS ``nav_msgs/OccupancyGrid``."""

UNIT_NAT = 0.05  # log-odds of one unit of a cell
HIT, MISS = 17, -13  # 0.85 and -0.65 nat: p = 0.70 and 0.34
MAX_LOG_ODDS, MIN_LOG_ODDS = 70, -39  # p = 0.97 and 0.12
OCCUPIED_FROM, FREE_UP_TO = 13, -8  # p ≥ 0.65 and p ≤ 0.40

WORD = 8  # cells that the kernel looks at together
FIXED_POINT = 4  # fractional bits of the polygon's vertices
IN_FREE, IN_SURFACE = 1, 2  # marks in the scan's own mask


def _tables() -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.int8]]:
    """Return, for each byte of a cell: probability × 255, entropy [bit], class."""
    units = np.arange(256, dtype=np.uint8).view(np.int8).astype(np.float64)
    p = 1.0 / (1.0 + np.exp(-UNIT_NAT * units))
    entropy = -(p * np.log2(p) + (1 - p) * np.log2(1 - p))
    classes = np.full(256, UNKNOWN, np.int8)
    classes[units >= OCCUPIED_FROM] = OCCUPIED
    classes[units <= FREE_UP_TO] = FREE
    return np.round(255 * p).astype(np.uint8), entropy.astype(np.float32), classes


PROBABILITY_BYTE, ENTROPY_BIT, CLASS_OF = _tables()
_NO_MARKS = np.uint64(0)
_ALL_FREE = np.full(WORD, IN_FREE, np.uint8).view(np.uint64)[0]
_EVERY_BYTE = np.full(WORD, 1, np.uint8).view(np.uint64)[0]
_FULL_BYTE, _ONE = np.uint64(255), np.uint64(1)
_ALL_SURELY_FREE = np.full(WORD, MIN_LOG_ODDS, np.int8).view(np.uint64)[0]
_ALL_SURELY_OCCUPIED = np.full(WORD, MAX_LOG_ODDS, np.int8).view(np.uint64)[0]


NO_SURFACE = np.zeros(0, np.int16)


@njit(cache=True, nogil=True, error_model="numpy")
def outline(
    polygon: NDArray[np.int32], ranges: Array, rays: Array, surface: NDArray[np.int16], x: float, y: float,
    theta: float, resolution: float, range_max: float, mask_row: int, mask_col: int, full_circle: bool,
) -> tuple[int, int, int, int, int]:  # fmt: skip
    """Write the scan's free polygon in fixed-point mask cells; return its length and the box it needs."""
    scale = float(1 << FIXED_POINT)
    c, s = math.cos(theta), math.sin(theta)
    x0 = x / resolution - mask_col - 0.5  # OpenCV's pixel (0, 0) is centred on (0, 0)
    y0 = y / resolution - mask_row - 0.5
    low_x = high_x = x0
    low_y = high_y = y0
    count = 0
    lost = 0
    n = ranges.shape[0]
    joined = surface.shape[0] == n
    for i in range(n):
        r = ranges[i]
        if joined and 0 < i < n - 1 and surface[i] >= 0 and surface[i - 1] == surface[i] == surface[i + 1]:
            continue  # within a straight surface: its two ends say it all
        if math.isnan(r):
            # One or two lost beams are bridged by their neighbours; a run of them is not known to be free.
            lost += 1
            if lost != 3:
                continue
            reach = 0.0
        else:
            lost = 0
            reach = (range_max if r > range_max else r) / resolution
        dx = (c * rays[i, 0] - s * rays[i, 1]) * reach
        dy = (s * rays[i, 0] + c * rays[i, 1]) * reach
        polygon[count, 0] = round((x0 + dx) * scale)
        polygon[count, 1] = round((y0 + dy) * scale)
        count += 1
        low_x, high_x = min(low_x, x0 + dx), max(high_x, x0 + dx)
        low_y, high_y = min(low_y, y0 + dy), max(high_y, y0 + dy)
    if not full_circle:
        polygon[count, 0] = round(x0 * scale)
        polygon[count, 1] = round(y0 * scale)
        count += 1
    # Two cells of margin: half for the rounding, one and a half for the surfaces beyond the rim.
    return (
        count, max(int(low_y) - 2, 0), max(int(low_x) - 2, 0), int(high_y) + 3, int(high_x) + 3
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def mark_surfaces(
    mask: NDArray[np.uint8], ranges: Array, rays: Array, surface: NDArray[np.int16], x: float, y: float,
    theta: float, resolution: float, mask_row: int, mask_col: int,
) -> None:  # fmt: skip
    """Mark the cells that beams ended in, and those between two hits on one straight surface."""
    c, s = math.cos(theta), math.sin(theta)
    x0, y0 = x / resolution - mask_col, y / resolution - mask_row
    n = ranges.shape[0]
    joined = surface.shape[0] == n
    last_x = last_y = 0.0
    last_surface = -1
    for i in range(n):
        r = ranges[i]
        if not math.isfinite(r):
            continue
        # What stopped the beam lies behind the point it returned from: a quarter of a cell deeper.
        reach = r / resolution + 0.25
        px = x0 + (c * rays[i, 0] - s * rays[i, 1]) * reach
        py = y0 + (s * rays[i, 0] + c * rays[i, 1]) * reach
        mask[int(py), int(px)] = IN_SURFACE
        here = int(surface[i]) if joined else -1
        if here >= 0 and here == last_surface:
            dx, dy = px - last_x, py - last_y
            steps = int(max(abs(dx), abs(dy)) * 1.5)
            for k in range(1, steps + 1):
                f = k / (steps + 1)
                mask[int(last_y + f * dy), int(last_x + f * dx)] = IN_SURFACE
        last_x, last_y, last_surface = px, py, here


@njit(cache=True, nogil=True, error_model="numpy")
def fuse(
    mask_words: NDArray[np.uint64], mask_row: int, mask_col: int, top: int, left: int, bottom: int, right: int,
    log_odds: NDArray[np.int8], log_odds_words: NDArray[np.uint64], lattice_row: int, lattice_col: int,
    overview_probability: NDArray[np.int32], overview_known: NDArray[np.int32], shift: int,
    changes: NDArray[np.int32], count: int,
) -> tuple[int, int, float]:  # fmt: skip
    """Add the box [top, bottom] × [left, right] of a scan's mask to the grid and wipe it.

    Return the number of changes, and by how much the known cells and the entropy went up. Eight cells at a time
    are passed over where the scan says nothing, or nothing new of cells at their limits: most of a known map.
    """
    known = 0
    entropy = 0.0
    first_word, end_word = left // WORD, (right + 1) // WORD
    words_ahead = (mask_col - lattice_col) // WORD  # from a word of the mask to its place in the grid
    width = min(1 << shift, WORD)  # cells of a word within one block of the overview
    for i in range(top, bottom + 1):
        line = mask_words[i]
        row = mask_row + i - lattice_row
        word = first_word - 1
        while True:
            word += 1
            while word + 4 <= end_word and (line[word] | line[word + 1]) | (line[word + 2] | line[word + 3]) == 0:
                word += 4
            if word >= end_word:
                break
            marks = line[word]
            if marks == _NO_MARKS:
                continue
            line[word] = _NO_MARKS
            at = words_ahead + word
            first = WORD * at
            cells = log_odds_words[row, at]
            free = (marks & _EVERY_BYTE) * _FULL_BYTE
            surface = ((marks >> _ONE) & _EVERY_BYTE) * _FULL_BYTE
            unsettled = (cells ^ _ALL_SURELY_FREE) & free | (cells ^ _ALL_SURELY_OCCUPIED) & surface
            if unsettled == _NO_MARKS:
                continue
            if marks == _ALL_FREE:
                value = cells & np.uint64(255)
                if cells == value * _EVERY_BYTE:
                    # Eight cells alike, as in a room just seen: reckon once.
                    old = int(log_odds[row, first])
                    new: int = max(old + MISS, MIN_LOG_ODDS)
                    if new == 0:
                        new = -1
                    log_odds_words[row, at] = np.uint64(new & 255) * _EVERY_BYTE
                    entropy += WORD * (ENTROPY_BIT[new & 255] - ENTROPY_BIT[old & 255])
                    delta = int(PROBABILITY_BYTE[new & 255]) - (
                        int(PROBABILITY_BYTE[old & 255]) if old != 0 else 0
                    )
                    for c in range(first >> shift, ((first + WORD - 1) >> shift) + 1):
                        overview_probability[row >> shift, c] += width * delta
                        if old == 0:
                            overview_known[row >> shift, c] += width
                    if old == 0:
                        known += WORD
                    if CLASS_OF[old & 255] != CLASS_OF[new & 255]:
                        for col in range(first, first + WORD):
                            changes[count, 0] = lattice_row + row
                            changes[count, 1] = lattice_col + col
                            changes[count, 2] = CLASS_OF[old & 255]
                            changes[count, 3] = CLASS_OF[new & 255]
                            count += 1
                    continue
            for k in range(WORD):
                mark = (marks >> np.uint64(8 * k)) & np.uint64(255)  # little-endian, as x86 and ARM are
                if mark == 0:
                    continue
                col = first + k
                old = int(log_odds[row, col])
                new = min(old + HIT, MAX_LOG_ODDS) if mark == IN_SURFACE else max(old + MISS, MIN_LOG_ODDS)
                if new == old:
                    continue
                if new == 0:
                    new = -1  # zero means never observed
                log_odds[row, col] = new
                r, c = row >> shift, col >> shift
                delta = int(PROBABILITY_BYTE[new & 255])
                entropy += ENTROPY_BIT[new & 255] - ENTROPY_BIT[old & 255]
                if old == 0:
                    known += 1
                    overview_known[r, c] += 1
                else:
                    delta -= int(PROBABILITY_BYTE[old & 255])
                overview_probability[r, c] += delta
                if CLASS_OF[old & 255] != CLASS_OF[new & 255]:
                    changes[count, 0] = lattice_row + row
                    changes[count, 1] = lattice_col + col
                    changes[count, 2] = CLASS_OF[old & 255]
                    changes[count, 3] = CLASS_OF[new & 255]
                    count += 1
    return count, known, entropy


@njit(cache=True, nogil=True, error_model="numpy")
def mark_and_fuse(
    ranges: Array, rays: Array, surface: NDArray[np.int16], x: float, y: float, theta: float, resolution: float,
    mask: NDArray[np.uint8], mask_words: NDArray[np.uint64], mask_row: int, mask_col: int, top: int, left: int,
    bottom: int, right: int, log_odds: NDArray[np.int8], log_odds_words: NDArray[np.uint64], lattice_row: int,
    lattice_col: int, overview_probability: NDArray[np.int32], overview_known: NDArray[np.int32], shift: int,
    changes: NDArray[np.int32], count: int,
) -> tuple[int, int, float]:  # fmt: skip
    """Mark a scan's surfaces in its mask, then add the mask to the grid: all that follows OpenCV, in one call."""
    mark_surfaces(mask, ranges, rays, surface, x, y, theta, resolution, mask_row, mask_col)
    return fuse(
        mask_words, mask_row, mask_col, top, left, bottom, right, log_odds, log_odds_words, lattice_row,
        lattice_col, overview_probability, overview_known, shift, changes, count,
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def sum_blocks(
    log_odds: NDArray[np.int8], visited: NDArray[np.uint8], shift: int, known: NDArray[np.int32],
    probability: NDArray[np.int32], trail: NDArray[np.int32],
) -> None:  # fmt: skip
    """Add up blocks of 2^shift cells a side: observed cells, their probability × 255, visited cells."""
    for i in range(log_odds.shape[0]):
        r = i >> shift
        for j in range(log_odds.shape[1]):
            v = log_odds[i, j]
            if v != 0:
                known[r, j >> shift] += 1
                probability[r, j >> shift] += PROBABILITY_BYTE[np.uint64(v & 255)]
            if visited[i, j] != 0:
                trail[r, j >> shift] += 1


@njit(cache=True, nogil=True, error_model="numpy")
def mark_disc(
    visited: NDArray[np.uint8], overview: NDArray[np.int32], shift: int, y: float, x: float, radius: float
) -> None:
    """Mark the cells whose centre lies within ``radius`` of (x, y), all in cells of the grid."""
    for i in range(int(y - radius), int(y + radius) + 1):
        for j in range(int(x - radius), int(x + radius) + 1):
            if (i + 0.5 - y) ** 2 + (j + 0.5 - x) ** 2 <= radius * radius and visited[i, j] == 0:
                visited[i, j] = 1
                overview[i >> shift, j >> shift] += 1


@njit(cache=True, nogil=True, error_model="numpy")
def ends_on(
    log_odds: NDArray[np.int8], ranges: Array, rays: Array, x: float, y: float, theta: float, resolution: float,
    range_max: float,
) -> int:  # fmt: skip
    """Return the sum of the cells in which beams end; ``x`` and ``y`` in cells of the array."""
    c, s = math.cos(theta), math.sin(theta)
    total = 0
    for i in range(ranges.shape[0]):
        r = ranges[i]
        if not r < range_max:  # lost (nan) and without return
            continue
        col = math.floor(x + (c * rays[i, 0] - s * rays[i, 1]) * r / resolution)
        row = math.floor(y + (s * rays[i, 0] + c * rays[i, 1]) * r / resolution)
        if 0 <= row < log_odds.shape[0] and 0 <= col < log_odds.shape[1]:
            total += log_odds[row, col]
    return total
