"""From a raster of free cells to straight surfaces, none of them further than half a cell from a cell's edge.

First the exact outline is walked along the edges between free and other cells; then its stairs, and only they,
are replaced by straight pieces. A stair is a run of one-cell jogs, the way in which a raster shows a slanting or
a curved wall. A piece goes from one jog to another where every corner of the outline between them stays within
the bound; as it begins and ends on the outline, it does not leave it either. The middles of neighbouring jogs can
always be joined so, and dynamic programming finds the fewest pieces.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from slam.types import Array, Flags, Indices

__all__ = ["outline_segments", "trace"]

_TOLERANCE = 0.5 + 1e-9  # [cells]: the flat top of an arc is cut by exactly half a cell
_PLACES = 5  # where along a jog pieces may meet; odd, so that its middle is one
_WINDOW = 64  # jogs that one piece spans at most

# Headings along the lattice: 0 east, 1 north, 2 west, 3 south, as steps in column (x) and row (y).
_DX = np.array([1, 0, -1, 0], np.int64)
_DY = np.array([0, 1, 0, -1], np.int64)


def outline_segments(free: Flags, *, simplify: bool = True) -> Array:
    """Return the surfaces ``(n, 4)`` around free space, in cells, free space on the left of each.

    A point (x, y) is x cells right of and y cells above the lower-left corner of cell (0, 0). What lies outside
    the raster is solid. Every surface is within half a cell of the edges between free and solid cells, and every
    such edge within half a cell of a surface; with ``simplify=False`` they are those edges themselves.
    Free cells that touch at a corner alone are parted there, so a wall one cell thick stays closed on a slant.
    """
    corners, first = trace(np.ascontiguousarray(free, dtype=np.bool_))
    if simplify:
        corners, first = _straighten(corners, first)
    if not len(corners):
        return np.zeros((0, 4))
    following = np.arange(1, len(corners) + 1)
    following[first[1:] - 1] = first[:-1]
    return np.hstack([corners, corners[following]])


def trace(free: Flags) -> tuple[Array, Indices]:
    """Return the corners ``(n, 2)`` of the exact outline [cells], and where each closed loop of them begins.

    Loop i has the corners ``first[i]`` to ``first[i + 1]``; it has free space on its left.
    """
    padded = np.zeros((free.shape[0] + 2, free.shape[1] + 2), np.bool_)
    padded[1:-1, 1:-1] = free
    corners, first = _walk(padded)
    return corners - 1.0, first


@njit(cache=True, nogil=True)
def _walk(free: Flags) -> tuple[Array, Indices]:
    """Walk every loop of the outline of a raster whose border is solid, in lattice coordinates."""
    rows, cols = free.shape
    corners, first = np.empty((1024, 2), np.float64), np.empty(256, np.int64)
    seen = np.zeros((rows, cols), np.bool_)  # eastward edges below a free cell
    n, loops = 0, 0
    for row in range(1, rows):
        for col in range(1, cols):
            if seen[row, col] or not free[row, col] or free[row - 1, col]:
                continue
            # The first edge not yet walked, row by row, is the first of its run: a corner.
            if loops + 1 == len(first):
                first = np.concatenate((first, np.empty_like(first)))
            first[loops] = n
            loops += 1
            x, y, heading = col, row, 0
            turned = True
            while True:
                if turned:
                    if n == len(corners):
                        corners = np.concatenate((corners, np.empty_like(corners)))
                    corners[n, 0], corners[n, 1] = x, y
                    n += 1
                if heading == 0:
                    seen[y, x] = True
                x += _DX[heading]
                y += _DY[heading]
                heading_before = heading
                heading = _next_heading(free, x, y, heading)
                turned = heading != heading_before
                if x == col and y == row and heading == 0:
                    break
    first[loops] = n
    return corners[:n], first[: loops + 1]


@njit(cache=True, nogil=True, inline="always")
def _next_heading(free: Flags, x: int, y: int, heading: int) -> int:
    """Heading after lattice point (x, y), free space staying on the left and solid on the right."""
    # The cells before the point, left and right of the heading.
    if heading == 0:
        left, right = free[y, x], free[y - 1, x]
    elif heading == 1:
        left, right = free[y, x - 1], free[y, x]
    elif heading == 2:
        left, right = free[y - 1, x - 1], free[y, x - 1]
    else:
        left, right = free[y - 1, x], free[y - 1, x - 1]
    if not left:
        return (heading + 1) % 4  # also where two free cells touch at this corner alone
    return (heading + 3) % 4 if right else heading


@njit(cache=True, nogil=True)
def _straighten(corners: Array, first: Indices) -> tuple[Array, Indices]:
    """Replace the stairs of loops of corners by straight pieces."""
    out = np.empty_like(corners)
    out_first = np.empty_like(first)
    longest = 0
    for loop in range(first.shape[0] - 1):
        longest = max(longest, first[loop + 1] - first[loop])
    path = np.empty((2 * longest + 1, 2), np.float64)
    role = np.empty(2 * longest + 1, np.int64)
    stair = np.empty(longest, np.bool_)
    n = first[0]
    for loop in range(first.shape[0] - 1):
        out_first[loop] = n
        n = _straighten_loop(corners[first[loop] : first[loop + 1]], out, n, path, role, stair)
    out_first[-1] = n
    return out[:n], out_first


@njit(cache=True, nogil=True)
def _straighten_loop(loop: Array, out: Array, n: int, path: Array, role: Indices, stair: Flags) -> int:
    """Append the straightened loop to ``out`` from row ``n`` on; return the row after it."""
    size = loop.shape[0]
    for i in range(size):
        # Stairs have jogs to the same side one run apart.
        stair[i] = _is_jog(loop, i) and (_same_jog(loop, i, i + 2) or _same_jog(loop, i, i - 2))
    count = _stations(loop, stair, path, role)
    start = 0
    while start < count and role[start] != 2:
        start += 1
    if start == count:
        # A loop of stairs alone, such as a disc: begin at any station.
        start = 0
        while start < count and role[start] == 0:
            start += 1
    begin, at = n, start
    while at < start + count:
        stop = at + 1
        while stop < start + count and role[stop % count] != 2:
            stop += 1
        n = _straighten_stair(path, role, count, at, stop, out, n)
        at = stop
    if n - begin < 3:
        # Straightened to nothing; keep the exact outline of so small a thing.
        n = begin
        for i in range(size):
            out[n] = loop[i]
            n += 1
    return n


@njit(cache=True, nogil=True)
def _stations(loop: Array, stair: Flags, path: Array, role: Indices) -> int:
    """List the loop's corners and the middles of its stairs' jogs, in order, each with its role.

    Roles: 0 a stair's corner, which pieces must pass near; 1 the middle of a jog, where they may meet; 2 any
    other corner, where they must meet.
    """
    size, count = loop.shape[0], 0
    for i in range(size):
        path[count] = loop[i]
        role[count] = 0 if stair[i] or stair[(i - 1) % size] else 2
        count += 1
        if stair[i]:
            following = loop[(i + 1) % size]
            path[count, 0] = 0.5 * (loop[i, 0] + following[0])
            path[count, 1] = 0.5 * (loop[i, 1] + following[1])
            role[count] = 1
            count += 1
    return count


@njit(cache=True, nogil=True)
def _straighten_stair(path: Array, role: Indices, count: int, at: int, stop: int, out: Array, n: int) -> int:
    """Append the fewest straight pieces from station ``at`` to ``stop``, both met exactly; return the row after.

    Dynamic programming over the jogs and over places along each; of as few pieces, those with the least error.
    The row for ``stop`` is left to what follows.
    """
    size = 2
    for i in range(at + 1, stop):
        if role[i % count] == 1:
            size += 1
    out[n] = path[at % count]
    if size == 2:
        return n + 1
    station = np.empty(size, np.int64)
    station[0], station[size - 1] = at, stop
    k = 1
    for i in range(at + 1, stop):
        if role[i % count] == 1:
            station[k] = i
            k += 1
    cost = np.full(size * _PLACES, np.inf)
    previous = np.zeros(size * _PLACES, np.int64)
    cost[_PLACES // 2] = 0.0
    low = 0
    for j in range(1, size):
        low = max(low, j - _WINDOW)
        reached = False
        for i in range(low, j):
            spanned = _relax(path, role, count, station, i, j, cost, previous)
            if spanned and not reached:
                # What cannot reach this station cannot reach the next one either.
                low, reached = i, True
    last = (size - 1) * _PLACES + _PLACES // 2
    pieces, state = 0, last
    while state >= _PLACES:
        pieces += 1
        state = previous[state]
    state = previous[last]
    for row in range(n + pieces - 1, n, -1):
        out[row, 0], out[row, 1] = _place(path, count, station[state // _PLACES], state % _PLACES)
        state = previous[state]
    return n + pieces


@njit(cache=True, nogil=True)
def _relax(
    path: Array, role: Indices, count: int, station: Indices, i: int, j: int, cost: Array, previous: Indices
) -> bool:
    """Offer every piece from station i to station j; return whether one is within the bound."""
    spanned = False
    middle, last = _PLACES // 2, station.shape[0] - 1
    for q in range(_PLACES):
        if j == last and q != middle:
            continue
        bx, by = _place(path, count, station[j], middle if j == last else q)
        for p in range(_PLACES):
            start = i * _PLACES + p
            # Not worth the measuring unless it saves a piece.
            if cost[start] + 1.0 + 0.1 * _TOLERANCE >= cost[j * _PLACES + q]:
                continue
            ax, ay = _place(path, count, station[i], p)
            error = _deviation(path, role, count, station[i], station[j], ax, ay, bx, by)
            if error > _TOLERANCE:
                continue
            spanned = True
            offer = cost[start] + 1.0 + 0.1 * error
            if offer < cost[j * _PLACES + q]:
                cost[j * _PLACES + q] = offer
                previous[j * _PLACES + q] = start
    return spanned


@njit(cache=True, nogil=True, inline="always")
def _place(path: Array, count: int, station: int, place: int) -> tuple[float, float]:
    """Return one of the places along a jog; the middle one is the station itself."""
    x, y = path[station % count]
    if place == _PLACES // 2:
        return x, y
    before, after = path[(station - 1) % count], path[(station + 1) % count]
    share = (place + 0.5) / _PLACES
    return before[0] + share * (after[0] - before[0]), before[1] + share * (after[1] - before[1])


@njit(cache=True, nogil=True)
def _deviation(
    path: Array, role: Indices, count: int, at: int, end: int, ax: float, ay: float, bx: float, by: float
) -> float:
    """Return the largest distance of a corner between two stations from the straight piece, 2 if out of bounds."""
    ux, uy = bx - ax, by - ay
    squared = ux * ux + uy * uy
    worst = 0.0 if squared > 0.0 else 2.0
    for i in range(at + 1, end):
        if worst > _TOLERANCE:
            return 2.0
        if role[i % count] == 0:
            px, py = path[i % count, 0] - ax, path[i % count, 1] - ay
            share = min(1.0, max(0.0, (px * ux + py * uy) / squared))
            worst = max(worst, math.hypot(px - share * ux, py - share * uy))
    return worst


@njit(cache=True, nogil=True, inline="always")
def _run(loop: Array, i: int) -> tuple[float, float]:
    """Step from corner i to the next."""
    size = loop.shape[0]
    a, b = loop[i % size], loop[(i + 1) % size]
    return b[0] - a[0], b[1] - a[1]


@njit(cache=True, nogil=True, inline="always")
def _is_jog(loop: Array, i: int) -> bool:
    """Whether run i is one cell long and the outline goes on behind it in the direction it came in."""
    x, y = _run(loop, i)
    if abs(x) + abs(y) != 1.0:
        return False
    before, after = _run(loop, i - 1), _run(loop, i + 1)
    return before[0] * after[0] + before[1] * after[1] > 0.0


@njit(cache=True, nogil=True, inline="always")
def _same_jog(loop: Array, i: int, j: int) -> bool:
    """Whether run j is a jog in the direction of run i."""
    if not _is_jog(loop, j):
        return False
    a, b = _run(loop, i), _run(loop, j)
    return a[0] == b[0] and a[1] == b[1]
