"""Places shared out: one for each robot at the least total cost, or tours that end at about one time."""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.optimize import linear_sum_assignment

from slam.types import Array, Indices

__all__ = ["FAR_M", "assign", "share_tours", "tour_length"]

_MOST_ROUNDS = 50
_LEAST = 1e-7
FAR_M = 1e6
"""Farther [m] than anything is."""
_POWER = 3.0  # of the tours' lengths, summed up: the higher, the more the longest one counts


def assign(costs: Array) -> Indices:
    """Return the column of each robot's place ``(k,)``, −1 for none: the least total of ``costs`` ``(k, n)``.

    As many robots as can get one do. The Hungarian method's problem (Kuhn, 1955).
    """
    owned = np.full(len(costs), -1, dtype=np.int64)
    if costs.size:
        rows, columns = linear_sum_assignment(np.where(np.isfinite(costs), costs, FAR_M))
        reached = np.isfinite(costs[rows, columns])
        owned[rows[reached]] = columns[reached]
    return owned


@njit(cache=True, nogil=True)
def tour_length(start: Array, distance: Array, tour: Indices) -> float:
    """Return the length of an open tour from a robot with ways ``(n,)`` to its first place."""
    total = 0.0
    for k in range(len(tour)):
        total += start[tour[k]] if k == 0 else distance[tour[k - 1], tour[k]]
    return total


@njit(cache=True, nogil=True)
def share_tours(starts: Array, distance: Array) -> Indices:
    """Return the robot ``(n,)`` that each place goes to, so that all tours end at about one time.

    Several travelling salesmen without a way back, who want the last of them to be done early: the sum of the
    third powers of their tours' lengths is made small, by cheapest insertion, the place first that any robot ends
    soonest with, and then by moving single places between tours and within.

    Parameters
    ----------
    starts
        ``(k, n)`` from each robot to each place [m]; ``1e6`` or more where it cannot get.
    distance
        ``(n, n)`` between places [m].
    """
    robots, n = starts.shape
    tours = np.empty((robots, n), dtype=np.int64)
    sizes = np.zeros(robots, dtype=np.int64)
    lengths = np.zeros(robots)
    owner = np.full(n, -1, dtype=np.int64)
    for _ in range(n):
        best_i, best_k, best_at, best = -1, -1, 0, np.inf
        for i in range(n):
            if owner[i] >= 0:
                continue
            for k in range(robots):
                at, longer = _cheapest(starts[k], distance, tours[k, : sizes[k]], i)
                if lengths[k] + longer < best - _LEAST:
                    best_i, best_k, best_at, best = i, k, at, lengths[k] + longer
        if best_i < 0:
            break
        _put(tours[best_k], sizes[best_k], best_at, best_i)
        sizes[best_k] += 1
        lengths[best_k] = best
        owner[best_i] = best_k
    for _ in range(_MOST_ROUNDS):
        if not _move_one(starts, distance, tours, sizes, lengths, owner):
            break
    return owner


@njit(cache=True, nogil=True)
def _cheapest(start: Array, distance: Array, tour: Indices, place: int) -> tuple[int, float]:
    """Return where in a tour a place is put at the least cost, and by how much that makes the way longer."""
    best, least = 0, np.inf
    for at in range(len(tour) + 1):
        leg = start[place] if at == 0 else distance[tour[at - 1], place]
        if at < len(tour):
            leg += distance[place, tour[at]] - (start[tour[0]] if at == 0 else distance[tour[at - 1], tour[at]])
        if leg < least:
            best, least = at, leg
    return best, least


@njit(cache=True, nogil=True)
def _put(tour: Indices, size: int, at: int, place: int) -> None:
    for k in range(size, at, -1):
        tour[k] = tour[k - 1]
    tour[at] = place


@njit(cache=True, nogil=True)
def _move_one(
    starts: Array, distance: Array, tours: Indices, sizes: Indices, lengths: Array, owner: Indices
) -> bool:
    """Move each place to where it costs least; return whether any was moved."""
    moved = False
    rest = np.empty(tours.shape[1], dtype=np.int64)
    for i in range(len(owner)):
        a = owner[i]
        if a < 0:
            continue
        count = 0
        for k in range(sizes[a]):
            if tours[a, k] != i:
                rest[count] = tours[a, k]
                count += 1
        without = tour_length(starts[a], distance, rest[:count])
        best_k, best_at, best, best_length = -1, 0, -_LEAST, 0.0
        for k in range(len(starts)):
            tour = rest[:count] if k == a else tours[k, : sizes[k]]
            at, longer = _cheapest(starts[k], distance, tour, i)
            length = (without if k == a else lengths[k]) + longer
            # By how much the sum of powers changes.
            if k == a:
                change = length**_POWER - lengths[a] ** _POWER
            else:
                change = without**_POWER - lengths[a] ** _POWER + length**_POWER - lengths[k] ** _POWER
            if change < best:
                best_k, best_at, best, best_length = k, at, change, length
        if best_k >= 0:
            tours[a, :count] = rest[:count]
            sizes[a] = count
            lengths[a] = without
            _put(tours[best_k], sizes[best_k], best_at, i)
            sizes[best_k] += 1
            lengths[best_k] = best_length
            owner[i] = best_k
            moved = True
    return moved
