"""Stations: places on a lattice that a robot hops between, and what is in sight of each.

For a robot that looks only where it stops. Everything is in cells of a grid of classes, row and column.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.grids.occupancy import FREE
from slam.types import Array, Cells, Flags, Indices

__all__ = ["count_in_sight", "edges", "in_sight", "join", "lengths", "line_is_free", "ways"]


@njit(cache=True, nogil=True)
def line_is_free(classes: NDArray[np.int8], r0: int, c0: int, r1: int, c1: int) -> bool:
    """Whether every cell on the line between two cells is free, the last one left out of account."""
    count = max(abs(r1 - r0), abs(c1 - c0))
    for i in range(count):
        share = i / count
        row, col = math.floor(r0 + share * (r1 - r0) + 0.5), math.floor(c0 + share * (c1 - c0) + 0.5)
        if classes[row, col] != FREE:
            return False
    return True


@njit(cache=True, nogil=True)
def join(classes: NDArray[np.int8], cells: Cells, places: Cells, index: Cells, hop: int) -> Cells:
    """Return each station's neighbours ``(n, (2 hop + 1)²)`` up to ``hop`` away along each axis, −1 for none.

    Parameters
    ----------
    classes
        ``(rows, cols)`` of the grid.
    cells, places
        ``(n, 2)`` row, column of the stations on the grid, and on their lattice.
    index
        Number of the station at each place of the lattice, −1 where there is none.
    hop
        How many stations a hop may go along each axis.
    """
    side = 2 * hop + 1
    joined = np.full((len(cells), side * side), -1, dtype=np.int64)
    for i in range(len(cells)):
        for k in range(side * side):
            r, c = places[i, 0] + k // side - hop, places[i, 1] + k % side - hop
            if r < 0 or c < 0 or r >= index.shape[0] or c >= index.shape[1]:
                continue
            j = index[r, c]
            # Each pair once: what is free one way is free the other way.
            if j > i and line_is_free(classes, cells[i, 0], cells[i, 1], cells[j, 0], cells[j, 1]):
                joined[i, k] = j
                joined[j, side * side - 1 - k] = i
    return joined


@njit(cache=True, nogil=True)
def in_sight(classes: NDArray[np.int8], cells: Cells, points: Cells, reach: float) -> Flags:
    """Return ``(n, m)``: which points lie nearer than ``reach`` cells to a station, with a free line to it."""
    seen = np.zeros((len(cells), len(points)), dtype=np.bool_)
    for i in range(len(cells)):
        for j in range(len(points)):
            dr, dc = points[j, 0] - cells[i, 0], points[j, 1] - cells[i, 1]
            if dr * dr + dc * dc < reach * reach:
                seen[i, j] = line_is_free(classes, cells[i, 0], cells[i, 1], points[j, 0], points[j, 1])
    return seen


@njit(cache=True, nogil=True)
def count_in_sight(classes: NDArray[np.int8], cells: Cells, points: Cells, reach: float) -> Indices:
    """Return ``(n,)``: how many points are in sight of each station."""
    count = np.zeros(len(cells), dtype=np.int64)
    for i in range(len(cells)):
        count[i] = in_sight(classes, cells[i : i + 1], points, reach).sum()
    return count


@njit(cache=True, nogil=True)
def ways(cells: Cells, joined: Cells, start: int) -> tuple[Array, Cells]:
    """Return the length of the way from one station to each ``(n,)`` in cells, and the station before each.

    Of ways of one length, the one with more stations: it looks more often.
    """
    n = len(cells)
    length, before = np.full(n, np.inf), np.full(n, -1, dtype=np.int64)
    hops = np.zeros(n, dtype=np.int64)
    done = np.zeros(n, dtype=np.bool_)
    length[start] = 0.0
    for _ in range(n):
        i = -1
        for j in range(n):
            if not done[j] and length[j] < np.inf and (i < 0 or length[j] < length[i]):
                i = j
        if i < 0:
            break
        done[i] = True
        for k in range(joined.shape[1]):
            j = joined[i, k]
            if j < 0 or done[j]:
                continue
            total = length[i] + math.hypot(cells[j, 0] - cells[i, 0], cells[j, 1] - cells[i, 1])
            if total < length[j] - 1e-9 or (total < length[j] + 1e-9 and hops[i] + 1 > hops[j]):
                length[j], before[j], hops[j] = total, i, hops[i] + 1
    return length, before


@njit(cache=True, nogil=True)
def edges(cells: Cells, joined: Cells) -> tuple[NDArray[np.int32], Array, NDArray[np.int32]]:
    """Return the hops of :func:`join` without gaps: neighbours ``(n, k)``, distances in cells, their number."""
    n, most = joined.shape
    to, length, count = np.empty((n, most), np.int32), np.empty((n, most)), np.zeros(n, np.int32)
    for i in range(n):
        for k in range(most):
            j = joined[i, k]
            if j >= 0:
                to[i, count[i]] = j
                length[i, count[i]] = math.hypot(cells[j, 0] - cells[i, 0], cells[j, 1] - cells[i, 1])
                count[i] += 1
    return to, length, count


@njit(cache=True, nogil=True)
def lengths(to: NDArray[np.int32], length: Array, count: NDArray[np.int32], start: int) -> Array:
    """Return the length of the way from one station to each ``(n,)`` in cells, over :func:`edges`.

    What :func:`ways` returns without the ways themselves, several times as fast: stations are corrected in the
    order in which they were found (a queue), which on a lattice hardly ever corrects one twice.
    """
    n = len(to)
    found = np.full(n, np.inf)
    queue, waiting = np.empty(n + 1, np.int32), np.zeros(n, np.bool_)
    first, beyond = 0, 1
    queue[0], found[start], waiting[start] = start, 0.0, True
    while first != beyond:
        i = queue[first]
        first = (first + 1) % (n + 1)
        waiting[i] = False
        for k in range(count[i]):
            j, total = to[i, k], found[i] + length[i, k]
            if total < found[j] - 1e-9:
                found[j] = total
                if not waiting[j]:
                    waiting[j] = True
                    queue[beyond] = j
                    beyond = (beyond + 1) % (n + 1)
    return found
