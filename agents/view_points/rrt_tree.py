"""A rapidly exploring random tree over the planning grid, and the edges of it that leave the known.

LaValle, "Rapidly-exploring random trees", 1998. Edges are walked cell by cell (Amanatides and Woo, 1987), through
every cell that they touch: none steps over a wall, however thin.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.ways.cost_map import CostMap, kind_at
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN
from slam.types import Array, Indices

__all__ = ["Tree", "mean_shift"]

_SHIFTS = 20  # at most, before a point counts as resting


class Tree:
    """Nodes in the belief's frame, each with an edge through free cells to its parent, an earlier node.

    Parameters
    ----------
    stride_m : float
        Longest edge.
    capacity : int
        Most nodes; a full tree grows no further, but its edges still find what borders on the unknown.
    """

    def __init__(self, stride_m: float, capacity: int) -> None:
        self._stride_m = stride_m
        self._nodes = np.zeros((capacity, 2))  # [m]
        self._parents = np.empty(capacity, dtype=np.int64)
        self._count = 0

    @property
    def nodes(self) -> Array:
        """Positions ``(n, 2)`` [m], the root first."""
        return self._nodes[: self._count].copy()

    @property
    def parents(self) -> Indices:
        """Each node's parent ``(n,)``; the root is its own."""
        return self._parents[: self._count].copy()

    def plant(self, point: Array) -> None:
        """Start anew from one node at ``point`` ``(2,)`` [m]."""
        self._nodes[0], self._parents[0], self._count = point, 0, 1

    def prune(self, cost_map: CostMap) -> None:
        """Drop the edges that the map no longer shows free, and all that hangs on them."""
        nodes = self._nodes[: self._count]
        kept = _prune(cost_map.classes, cost_map.in_cells(nodes), self._parents, nodes)
        self._count = int(kept)

    def grow(self, cost_map: CostMap, draws: Array, *, restart: bool = False) -> Array:
        """Steer towards each of ``draws`` ``(k, 2)`` [m]; return where edges met the unknown ``(h, 2)`` [m].

        What is returned is the last free point of each such edge. With ``restart`` (the local tree of Umari and
        Mukhopadhyay) the tree shrinks back to its root every time.
        """
        if self._count == 0 or len(draws) == 0:
            return np.zeros((0, 2))
        nodes = cost_map.in_cells(self._nodes)
        hits = np.empty((len(draws), 2))
        goals = cost_map.in_cells(draws)
        stride = self._stride_m / cost_map.resolution
        before = 1 if restart else self._count
        self._count, found = _grow(
            cost_map.classes, nodes, self._parents, self._count, goals, stride, restart, hits
        )
        resolution, origin = cost_map.resolution, np.asarray(cost_map.origin)
        self._nodes[before : self._count] = nodes[before : self._count] * resolution + origin
        return np.asarray(hits[:found] * resolution + origin)


def mean_shift(points: Array, bandwidth: float) -> Indices:
    """Return the indices ``(k,)`` of one of ``points`` ``(n, 2)`` per cluster: the one nearest to its mode.

    A flat kernel (Comaniciu and Meer, 2002): each point moves to the mean of the points within ``bandwidth`` until
    it rests; what comes to rest together is a cluster.
    """
    chosen = np.empty(len(points), dtype=np.int64)
    count = _shift(np.ascontiguousarray(points), bandwidth, np.empty((len(points), 2)), chosen)
    return np.unique(chosen[:count])


@njit(cache=True, nogil=True)
def _walk(classes: NDArray[np.int8], ax: float, ay: float, bx: float, by: float) -> tuple[int, float]:
    """Return the kind of the first cell from a to b that is not free, and the share of the way it is met at.

    A line through a corner needs both cells beside it free.
    """
    row, col = math.floor(ay), math.floor(ax)
    last_row, last_col = math.floor(by), math.floor(bx)
    kind = kind_at(classes, row, col)
    if kind != FREE:
        return kind, 0.0
    dx, dy = bx - ax, by - ay
    step_c, step_r = (1 if dx > 0.0 else -1), (1 if dy > 0.0 else -1)
    per_c = abs(1.0 / dx) if dx != 0.0 else np.inf
    per_r = abs(1.0 / dy) if dy != 0.0 else np.inf
    next_c = ((col + 1 - ax) if dx > 0.0 else (ax - col)) * per_c if dx != 0.0 else np.inf
    next_r = ((row + 1 - ay) if dy > 0.0 else (ay - row)) * per_r if dy != 0.0 else np.inf
    for _ in range(abs(last_row - row) + abs(last_col - col)):
        at = min(next_c, next_r)
        if abs(next_c - next_r) < 1e-9:
            beside = max(kind_at(classes, row, col + step_c), kind_at(classes, row + step_r, col))
            if beside == OCCUPIED:
                return OCCUPIED, at
        if next_c < next_r:
            col += step_c
            next_c += per_c
        else:
            row += step_r
            next_r += per_r
        kind = kind_at(classes, row, col)
        if kind != FREE:
            return kind, at
    return FREE, 1.0


@njit(cache=True, nogil=True)
def _grow(
    classes: NDArray[np.int8], nodes: Array, parents: Indices, count: int, goals: Array, stride: float,
    restart: bool, hits: Array,
) -> tuple[int, int]:  # fmt: skip
    """Fill ``nodes``, ``parents`` and ``hits``; return how many there are of the first and the last."""
    found = 0
    for k in range(goals.shape[0]):
        near, square = 0, np.inf
        for i in range(count):
            away = (goals[k, 0] - nodes[i, 0]) ** 2 + (goals[k, 1] - nodes[i, 1]) ** 2
            if away < square:
                near, square = i, away
        if square == 0.0:
            continue
        share = min(stride / math.sqrt(square), 1.0)
        ax, ay = nodes[near, 0], nodes[near, 1]
        bx, by = ax + share * (goals[k, 0] - ax), ay + share * (goals[k, 1] - ay)
        kind, at = _walk(classes, ax, ay, bx, by)
        if kind == UNKNOWN:
            # A hair before the unknown: in the last free cell.
            back = max(at - 1e-6, 0.0)
            hits[found, 0], hits[found, 1] = ax + back * (bx - ax), ay + back * (by - ay)
            found += 1
            if restart:
                count = 1
        elif kind == FREE and count < nodes.shape[0]:
            nodes[count, 0], nodes[count, 1] = bx, by
            parents[count] = near
            count += 1
    return count, found


@njit(cache=True, nogil=True)
def _prune(classes: NDArray[np.int8], cells: Array, parents: Indices, nodes: Array) -> int:
    """Close the gaps in ``nodes`` and ``parents`` that the lost ones leave; return how many are left."""
    place = np.full(cells.shape[0], -1, dtype=np.int64)  # of each old node among the kept ones
    kept = 0
    for i in range(cells.shape[0]):
        parent = parents[i]
        if i > 0 and place[parent] < 0:
            continue
        kind, _ = _walk(classes, cells[parent, 0], cells[parent, 1], cells[i, 0], cells[i, 1])
        if kind != FREE:
            continue
        place[i] = kept
        nodes[kept, 0], nodes[kept, 1] = nodes[i, 0], nodes[i, 1]
        parents[kept] = place[parent] if i > 0 else 0
        kept += 1
    return kept


@njit(cache=True, nogil=True)
def _shift(points: Array, bandwidth: float, modes: Array, chosen: Indices) -> int:
    """Fill ``modes`` with one mode per cluster and ``chosen`` with the point nearest to it; return how many."""
    count = 0
    for i in range(points.shape[0]):
        mx, my = points[i, 0], points[i, 1]
        nearest = i
        for _ in range(_SHIFTS):
            x = y = 0.0
            near, least = 0, np.inf
            for j in range(points.shape[0]):
                square = (points[j, 0] - mx) ** 2 + (points[j, 1] - my) ** 2
                if square <= bandwidth**2:
                    x += points[j, 0]
                    y += points[j, 1]
                    near += 1
                if square < least:
                    least, nearest = square, j
            if near == 0:  # a mean that has drifted off all points: only by rounding
                break
            moved = (x / near - mx) ** 2 + (y / near - my) ** 2
            mx, my = x / near, y / near
            if moved < 1e-8:
                break
        known = False
        for k in range(count):
            known = known or (modes[k, 0] - mx) ** 2 + (modes[k, 1] - my) ** 2 <= 0.25 * bandwidth**2
        if not known:
            modes[count, 0], modes[count, 1] = mx, my
            chosen[count] = nearest
            count += 1
    return count
