"""Open tours from the robot over view points: which places to stop at, and in what order.

The places are chosen as a set cover (one may see several pieces of frontier), the order by 2-opt and Or-opt, and
then each place is exchanged for any other that sees the same and lies better on the way. What an order costs is
its length and, where places have weights, how late each is reached: Σ legs + Σ weight · arrival.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from slam.types import Array, Flags, Indices

__all__ = ["best_tour", "cover", "draw_luck", "improve", "nearest_order", "order_cost", "tours_begun_with"]

_MOST_ROUNDS = 100  # of improvement: each makes the tour shorter, so that this is never reached in practice
_LEAST = 1e-7  # [m] an improvement


@njit(cache=True, nogil=True)
def order_cost(distance: Array, weight: Array, order: Indices) -> float:
    """Return what an order costs, ``order[0]`` being where the robot is.

    Parameters
    ----------
    distance
        ``(n, n)`` between places [m].
    weight
        ``(n,)`` price of reaching each place a metre later.
    order
        Places in the order of the tour.
    """
    arrival, total = 0.0, 0.0
    for k in range(1, len(order)):
        arrival += distance[order[k - 1], order[k]]
        total += weight[order[k]] * arrival
    return total + arrival


@njit(cache=True, nogil=True)
def nearest_order(distance: Array) -> Indices:
    """Return the order ``(n,)`` that starts at place 0 and always goes on to the nearest one left."""
    n = len(distance)
    order = np.zeros(n, dtype=np.int64)
    left = np.ones(n, dtype=np.bool_)
    left[0] = False
    for k in range(1, n):
        best = -1
        for j in range(n):
            if left[j] and (best < 0 or distance[order[k - 1], j] < distance[order[k - 1], best]):
                best = j
        order[k], left[best] = best, False
    return order


@njit(cache=True, nogil=True)
def improve(distance: Array, weight: Array, order: Indices) -> float:
    """Improve an order in place by reversing stretches (2-opt) and moving short ones (Or-opt); return its cost."""
    n = len(order)
    cost = order_cost(distance, weight, order)
    trial = np.empty(n, dtype=np.int64)
    for _ in range(_MOST_ROUNDS):
        before = cost
        for i in range(1, n):
            for j in range(i + 1, n):
                trial[:] = order
                for k in range(i, j + 1):
                    trial[k] = order[i + j - k]
                changed = order_cost(distance, weight, trial)
                if changed < cost - _LEAST:
                    order[:] = trial
                    cost = changed
        for length in range(1, 4):
            for i in range(1, n - length + 1):
                for at in range(1, n - length + 1):
                    for turned in range(2 if length > 1 else 1):
                        _move(order, i, length, at, turned == 1, trial)
                        changed = order_cost(distance, weight, trial)
                        if changed < cost - _LEAST:
                            order[:] = trial
                            cost = changed
        if cost >= before - _LEAST:
            break
    return cost


@njit(cache=True, nogil=True)
def _move(order: Indices, first: int, length: int, at: int, turned: bool, out: Indices) -> None:
    """Write the order with ``length`` places from ``first`` on taken out and put back at position ``at``."""
    k = 0
    for i in range(len(order)):
        if i < at or i >= at + length:
            if k == first:
                k += length
            out[i] = order[k]
            k += 1
        else:
            step = i - at
            out[i] = order[first + (length - 1 - step if turned else step)]


@njit(cache=True, nogil=True)
def cover(sight: Flags, rank: Array, luck: Array) -> Indices:
    """Return places that together see all that any place sees, place 0 (the robot's) left out.

    Greedily: most that none of the others sees, times the place's ``luck`` ``(n,)``; of equals, lowest ``rank``.
    """
    n, m = sight.shape
    left = np.zeros(m, dtype=np.bool_)
    for i in range(1, n):
        left |= sight[i]
    chosen = np.empty(n, dtype=np.int64)
    count = 0
    while left.any():
        best, most = -1, 0.0
        for i in range(1, n):
            new = 0
            for j in range(m):
                if left[j] and sight[i, j]:
                    new += 1
            if new > 0:
                value = new * luck[i] - 1e-4 * rank[i]
                if best < 0 or value > most:
                    best, most = i, value
        chosen[count] = best
        count += 1
        for j in range(m):
            if sight[best, j]:
                left[j] = False
    return chosen[:count].copy()


def draw_luck(tries: int, places: int) -> Array:
    """Return ``(tries, places)``: ones for the greedy cover, then some that put places at a disadvantage."""
    luck = np.random.default_rng(0).uniform(0.4, 1.0, (tries, places))
    luck[0] = 1.0
    return luck


@njit(cache=True, nogil=True)
def best_tour(sight: Flags, distance: Array, weight: Array, luck: Array) -> tuple[Indices, float]:
    """Return places in the order of the best tour found from place 0, and what it costs.

    Parameters
    ----------
    sight
        ``(n, m)`` what each place sees of the pieces; row 0 is the robot's place.
    distance, weight
        As in :func:`order_cost`.
    luck
        ``(tries, n)`` from :func:`draw_luck`: the covers that are tried.
    """
    best, lowest = np.zeros(1, dtype=np.int64), np.inf
    for t in range(len(luck)):
        places = np.zeros(1, dtype=np.int64)
        places = np.concatenate((places, cover(sight, distance[0], luck[t])))
        for rounds in range(4):
            own, own_weight = distance[places][:, places], weight[places]
            order = nearest_order(own) if rounds == 0 else np.arange(len(places))
            improve(own, own_weight, order)
            places = places[order]
            exchanged = _exchange(sight, distance, weight, places)
            places = _without_idle(sight, places)
            if not exchanged:
                break
        cost = order_cost(distance, weight, places)
        if cost < lowest - _LEAST:
            best, lowest = places, cost
    return best, lowest


@njit(cache=True, nogil=True)
def tours_begun_with(sight: Flags, distance: Array, weight: Array, tour: Indices) -> Array:
    """Return what a tour costs that begins with each place ``(n,)``, 0 for place 0.

    Each is ``tour`` with that place put first, those left out that then see nothing alone, and the rest in a
    better order: an upper bound, exact enough to tell how much is lost by going somewhere else first.
    """
    n = len(distance)
    costs = np.zeros(n)
    for first in range(1, n):
        rest = tour[tour != first]
        rest[0] = first  # in the robot's place: the rest of the tour begins here
        rest = _without_idle(sight, rest)
        own, own_weight = distance[rest][:, rest], weight[rest]
        leg = distance[0, first]
        after = improve(own, own_weight, np.arange(len(rest)))
        late = own_weight[1:].sum()
        costs[first] = leg * (1.0 + weight[first] + late) + after
    return costs


@njit(cache=True, nogil=True)
def _without_idle(sight: Flags, places: Indices) -> Indices:
    """Return the places without those, the first aside, that see nothing but what others of them see."""
    count = _seen_by(sight, places)
    kept = np.ones(len(places), dtype=np.bool_)
    for k in range(1, len(places)):
        kept[k] = False
        for j in range(sight.shape[1]):
            if sight[places[k], j] and count[j] == 1:
                kept[k] = True
                break
        if not kept[k]:
            for j in range(sight.shape[1]):
                count[j] -= sight[places[k], j]
    return places[kept]


@njit(cache=True, nogil=True)
def _seen_by(sight: Flags, places: Indices) -> Indices:
    """Return how many of the places on a tour see each piece ``(m,)``."""
    count = np.zeros(sight.shape[1], dtype=np.int64)
    for k in range(len(places)):
        for j in range(sight.shape[1]):
            count[j] += sight[places[k], j]
    return count


@njit(cache=True, nogil=True)
def _exchange(sight: Flags, distance: Array, weight: Array, places: Indices) -> bool:
    """Exchange each place of a tour, in place, for the best that sees what only it does; return if any was."""
    count = _seen_by(sight, places)
    exchanged = False
    lowest = order_cost(distance, weight, places)
    for k in range(1, len(places)):
        old = places[k]
        best = old
        for i in range(1, len(sight)):
            if i == old:
                continue
            serves = True
            for j in range(sight.shape[1]):
                if sight[old, j] and count[j] == 1 and not sight[i, j]:
                    serves = False
                    break
            if serves:
                places[k] = i
                cost = order_cost(distance, weight, places)
                if cost < lowest - _LEAST:
                    best, lowest = i, cost
        places[k] = best
        if best != old:
            exchanged = True
            for j in range(sight.shape[1]):
                count[j] += int(sight[best, j]) - int(sight[old, j])
    return exchanged
