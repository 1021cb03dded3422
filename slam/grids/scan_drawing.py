"""How a scan is drawn into an occupancy grid: cell values, and the Numba kernels behind the grid.

:mod:`slam.grids.free_space` has marked the free cells in the scan's mask before.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.types import Array, Bytes, Floats, Indices

UNKNOWN, FREE, OCCUPIED = -1, 0, 100
"""Cell classes, with the values of a ROS ``nav_msgs/OccupancyGrid``."""

UNIT_NAT = 0.05  # log-odds of one unit of a cell
HIT, MISS = 17, -13  # 0.85 and -0.65 nat: p = 0.70 and 0.34
MAX_LOG_ODDS, MIN_LOG_ODDS = 70, -39  # p = 0.97 and 0.12
OCCUPIED_FROM, FREE_UP_TO = 13, -8  # p ≥ 0.65 and p ≤ 0.40

WORD = 8  # cells that the kernel updates together
WINDOW = 64  # cells that it looks at together: vectors of bytes
IN_FREE, IN_SURFACE, IN_BETWEEN, IN_BRIDGE = 1, 2, 3, 4  # marks in the scan's own mask
APART_M = 0.14  # between two beams, beyond which a thin wall may stand between them unseen
GAP_M = 0.6  # between two hits so far apart, beyond which a passage may open between them unseen


def _tables() -> tuple[Bytes, Floats, NDArray[np.int8]]:
    """Return, for each byte of a cell: probability × 255, entropy [bit], class."""
    units = np.arange(256, dtype=np.uint8).view(np.int8).astype(np.float64)
    p = 1.0 / (1.0 + np.exp(-UNIT_NAT * units))
    entropy = -(p * np.log2(p) + (1 - p) * np.log2(1 - p))
    classes = np.full(256, UNKNOWN, np.int8)
    classes[units >= OCCUPIED_FROM] = OCCUPIED
    classes[units <= FREE_UP_TO] = FREE
    return np.round(255 * p).astype(np.uint8), entropy.astype(np.float32), classes


PROBABILITY_BYTE, ENTROPY_BIT, CLASS_OF = _tables()

# A cell's mark and byte make an index into what the cell becomes and what the grid's sums gain. The gains share
# one number, from the low bits up: probability × 255 (of an unknown cell all of it) plus a bias that keeps it
# positive, newly known, class changed, and the entropy in units of which every difference of two entropies is a
# multiple. So the gains of eight cells are one sum, and exact in any order.
_PROBABILITY, _BIAS = (1 << 16) - 1, 256
_KNOWN_AT, _CHANGED_AT, _ENTROPY_AT = 16, 20, 24
_COUNT = 15  # a field of counts: up to eight cells
_ENTROPY_UNITS = float(1 << 26)  # to a bit


def _steps() -> tuple[Bytes, Indices]:
    """Return, for each mark × 256 + byte of a cell: its byte afterwards, and what the sums gain."""
    old = np.arange(256, dtype=np.uint8).view(np.int8).astype(np.int64)
    # Between two beams that lie far apart nothing was seen: that much is likely where nothing is known, no more.
    between = np.where(old <= 0, np.minimum(old, FREE_UP_TO), old)
    bridge = np.where(old >= FREE_UP_TO, np.maximum(old, OCCUPIED_FROM), old)
    free, surface = np.maximum(old + MISS, MIN_LOG_ODDS), np.minimum(old + HIT, MAX_LOG_ODDS)
    new = np.stack([old, free, surface, between, bridge])
    new[1:][new[1:] == 0] = -1  # zero means never observed
    before, after = old & 255, new & 255
    probability = PROBABILITY_BYTE.astype(np.int64)
    gain = probability[after] - np.where(old == 0, 0, probability[before])
    gain += (old == 0).astype(np.int64) << _KNOWN_AT
    gain += (CLASS_OF[after] != CLASS_OF[before]).astype(np.int64) << _CHANGED_AT
    entropy = (ENTROPY_BIT[after] - ENTROPY_BIT[before]) * _ENTROPY_UNITS
    gain += np.round(entropy).astype(np.int64) << _ENTROPY_AT
    return after.astype(np.uint8).ravel(), (_BIAS + np.where(new == old, 0, gain)).ravel()


_NEXT, _GAIN = _steps()
_SURELY_FREE, _SURELY_OCCUPIED = np.uint8(MIN_LOG_ODDS & 255), np.uint8(MAX_LOG_ODDS)

NO_SURFACE = np.zeros(0, np.int16)


@njit(cache=True, nogil=True, error_model="numpy")
def mark_surfaces(mask: Bytes, beams: Array, surface: NDArray[np.int16], dense: float, gap: float) -> None:
    """Mark the cells that beams ended in, and those between two hits on one straight surface.

    Farther off than ``dense`` [cells] there may be none between them; and where there, or across beams that were
    lost, they are more than ``gap`` [cells] apart nothing is said of what is between.
    """
    n = beams.shape[1]
    joined = surface.shape[0] == n
    last_x = last_y = 0.0
    last_surface = last = -1
    for i in range(n):
        px, py = beams[2, i], beams[3, i]
        if math.isnan(px):
            continue
        mask[np.uint32(py), np.uint32(px)] = IN_SURFACE
        here = int(surface[i]) if joined else -1
        if here >= 0 and here == last_surface:
            dx, dy = px - last_x, py - last_y
            steps = int(max(abs(dx), abs(dy)) * 1.5)
            near = beams[0, i] ** 2 + beams[1, i] ** 2 <= dense * dense
            if (not near or i > last + 1) and dx * dx + dy * dy > gap * gap:
                steps = 0
            for k in range(1, steps + 1):
                f = k / (steps + 1)
                row, col = np.uint32(last_y + f * dy), np.uint32(last_x + f * dx)
                if near:
                    mask[row, col] = IN_SURFACE
                elif mask[row, col] != IN_SURFACE:
                    mask[row, col] = IN_BRIDGE
        last_x, last_y, last_surface, last = px, py, here, i


@njit(cache=True, nogil=True, inline="always")
def _step_of(marks: np.uint64, cells: np.uint64, k: int) -> np.uint64:
    """Return the index into the steps for the k-th cell of a word (little-endian, as x86 and ARM are)."""
    at = np.uint64(8 * k)
    return ((marks >> at) & np.uint64(255)) << np.uint64(8) | ((cells >> at) & np.uint64(255))


@njit(cache=True, nogil=True, error_model="numpy")
def _take_unsettled(
    mask: Bytes, cells: Bytes, width: int, down: int, ahead: int, top: int, left: int, bottom: int, right: int
) -> tuple[NDArray[np.uint64], NDArray[np.uint32]]:
    """Wipe a box of the mask; return its windows with marks that change a cell, and which words these are.

    A row of the windows is eight words of such marks, then the row and column that they begin at in the grid.

    Most of a known map is settled: its cells are at the limit that a scan pushes them to. Nothing here branches
    on what a cell holds, which the processor would guess wrongly along every rim.

    A window may reach beyond the box: the mask is wide enough for it and bears no marks there, and of the cells,
    ``width`` to a row of the grid, there are :data:`WINDOW` to spare at their end.
    """
    u = np.uint64  # as indices, others are tested for being negative
    words_each = u(WINDOW // WORD)
    most = (bottom - top + 1) * ((right - left) // WINDOW + 1)
    windows = np.empty((most, WINDOW // WORD + 2), np.uint64)
    mask_words, unsettled_marks = mask.view(np.uint64), windows.view(np.uint8)
    n = u(0)
    for i in range(u(top), u(bottom + 1)):
        for j in range(u(left), u(right + 1), u(WINDOW)):
            row, col = i + u(down), j + u(ahead)
            first = row * u(width) + col
            any_unsettled = False
            for k in range(u(WINDOW)):
                mark, cell = mask[i, j + k], cells[first + k]
                unsettled = (
                    ((mark == IN_FREE) & (cell != _SURELY_FREE))
                    | ((mark == IN_SURFACE) & (cell != _SURELY_OCCUPIED))
                    | (mark >= IN_BETWEEN)
                )
                unsettled_marks[n, k] = mark if unsettled else 0
                any_unsettled |= unsettled
            for k in range(words_each):
                mask_words[i, j // u(WORD) + k] = 0
            windows[n, words_each], windows[n, words_each + u(1)] = row, col
            n += u(any_unsettled)
    todo = np.empty(n * words_each, np.uint32)
    m = u(0)
    for i in range(n):
        for k in range(words_each):
            todo[m] = i * words_each + k
            m += u(windows[i, k] != 0)
    return windows, todo[:m]


@njit(cache=True, nogil=True, error_model="numpy")
def fuse(
    mask: Bytes, mask_row: int, mask_col: int, top: int, left: int, bottom: int, right: int,
    cells: Bytes, width: int, lattice_row: int, lattice_col: int, overview: NDArray[np.int32],
    shift: int, changes: NDArray[np.int32], count: int,
) -> tuple[int, int, float]:  # fmt: skip
    """Add the box [top, bottom] × [left, right] of a scan's mask to the grid and wipe it.

    Return the number of changes, and by how much the known cells and the entropy went up. ``changes`` needs room
    for one more than there are cells in the box.
    """
    u = np.uint64  # as indices, others are tested for being negative
    words_each = u(WINDOW // WORD)
    words, words_a_row = cells.view(np.uint64), u(width // WORD)
    windows, todo = _take_unsettled(
        mask, cells, width, mask_row - lattice_row, mask_col - lattice_col, top, left, bottom, right
    )
    together = (1 << shift) >= WORD  # the cells of a word are in one block of the overview
    known = entropy = 0
    for t in range(u(todo.shape[0])):
        window, word = u(todo[t]) // words_each, u(todo[t]) % words_each
        marks, row = windows[window, word], windows[window, words_each]
        col = windows[window, words_each + u(1)] + u(WORD) * word
        at = row * words_a_row + col // u(WORD)
        before, after = words[at], u(0)
        gain = 0
        for k in range(WORD):
            step = _step_of(marks, before, k)
            after |= u(_NEXT[step]) << u(8 * k)
            gain += _GAIN[step]
        words[at] = after
        known += (gain >> _KNOWN_AT) & _COUNT
        entropy += gain >> _ENTROPY_AT
        r = row >> u(shift)
        if together:
            overview[0, r, col >> u(shift)] += (gain >> _KNOWN_AT) & _COUNT
            overview[1, r, col >> u(shift)] += (gain & _PROBABILITY) - WORD * _BIAS
        else:
            for k in range(WORD):
                own = _GAIN[_step_of(marks, before, k)]
                overview[0, r, (col + u(k)) >> u(shift)] += (own >> _KNOWN_AT) & _COUNT
                overview[1, r, (col + u(k)) >> u(shift)] += (own & _PROBABILITY) - _BIAS
        if (gain >> _CHANGED_AT) & _COUNT:
            for k in range(WORD):
                class_before = CLASS_OF[(before >> u(8 * k)) & u(255)]
                class_after = CLASS_OF[(after >> u(8 * k)) & u(255)]
                # Written in any case, and kept if it is one.
                changes[u(count), 0] = lattice_row + np.int64(row)
                changes[u(count), 1] = lattice_col + np.int64(col) + k
                changes[u(count), 2] = class_before
                changes[u(count), 3] = class_after
                count += class_before != class_after
    return count, known, entropy / _ENTROPY_UNITS


@njit(cache=True, nogil=True, error_model="numpy")
def draw(
    mask: Bytes, beams: Array, surface: NDArray[np.int16], mask_row: int, mask_col: int, top: int,
    left: int, bottom: int, right: int, cells: Bytes, visited: Bytes, lattice_row: int,
    lattice_col: int, overview: NDArray[np.int32], shift: int, changes: NDArray[np.int32], count: int, y: float,
    x: float, radius: float, dense: float, gap: float,
) -> tuple[int, int, float]:  # fmt: skip
    """Do the rest in one call: surfaces into the mask, the mask into the grid, and the body.

    Arguments and return value are those of :func:`mark_surfaces`, :func:`fuse` and :func:`mark_disc`.
    """
    mark_surfaces(mask, beams, surface, dense, gap)
    mark_disc(visited, overview, shift, y, x, radius)
    return fuse(
        mask, mask_row, mask_col, top, left, bottom, right, cells, visited.shape[1], lattice_row, lattice_col,
        overview, shift, changes, count,
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def sum_blocks(log_odds: NDArray[np.int8], visited: Bytes, shift: int, overview: NDArray[np.int32]) -> None:
    """Add up blocks of 2^shift cells a side: observed cells, their probability × 255, visited cells."""
    for i in range(log_odds.shape[0]):
        r = i >> shift
        for j in range(log_odds.shape[1]):
            v = log_odds[i, j]
            if v != 0:
                overview[0, r, j >> shift] += 1
                overview[1, r, j >> shift] += PROBABILITY_BYTE[np.uint64(v & 255)]
            if visited[i, j] != 0:
                overview[2, r, j >> shift] += 1


@njit(cache=True, nogil=True, error_model="numpy")
def mark_disc(visited: Bytes, overview: NDArray[np.int32], shift: int, y: float, x: float, radius: float) -> None:
    """Mark the cells whose centre lies within ``radius`` of (x, y), all in cells of the grid; none if negative."""
    if radius < 0.0:
        return
    for i in range(int(y - radius), int(y + radius) + 1):
        for j in range(int(x - radius), int(x + radius) + 1):
            if visited[i, j] == 0 and (i + 0.5 - y) ** 2 + (j + 0.5 - x) ** 2 <= radius * radius:
                visited[i, j] = 1
                overview[2, i >> shift, j >> shift] += 1


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
        col = math.floor(x + (c * rays[0, i] - s * rays[1, i]) * r / resolution)
        row = math.floor(y + (s * rays[0, i] + c * rays[1, i]) * r / resolution)
        if 0 <= row < log_odds.shape[0] and 0 <= col < log_odds.shape[1]:
            total += log_odds[row, col]
    return total
