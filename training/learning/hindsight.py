"""What each choice would have cost, by the truth: a teacher that tells more than which choice is best.

For each candidate, the way there and, from there on, a tour of the true map until 95 % is seen (hindsight
optimisation, as in Yoon et al., "Probabilistic planning via determinization in hindsight", AAAI 2008). A policy
that learns what this is on average, given only what the robot sees, knows what lies behind frontiers of a kind.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.explorer import Candidates
from agents.learned.choice import Choice
from agents.ways.cost_map import CostMap
from agents.ways.planning import way_cells
from agents.ways.routing import improve
from slam.belief import Belief
from training.episodes.true_places import TruePlaces

__all__ = ["Hindsight"]

Array = NDArray[np.float64]
Cells = NDArray[np.int64]

_OFFSETS_M = np.array([0.5, 2.0, 6.0])  # greedy tours tried: what a new cell is worth against its way
_ENOUGH = 0.04  # share of the cells that may stay unseen: small remains are left out of the count anyway
_HERE_M = 0.43  # the robot is at a place: no cell of the lattice is farther from all of them


class Hindsight:
    """Prices choices in one episode.

    Parameters
    ----------
    true : TruePlaces
        Of the episode's room; it is not changed, and may be used again.
    """

    def __init__(self, true: TruePlaces) -> None:
        self._true = true
        self._sight = true.sight.copy()
        self._places = true.map.to_points(true.cells)
        self._lattice = _lattice(true)

    def prices(self, choice: Choice, found: Candidates, belief: Belief) -> NDArray[np.float32]:
        """Return what each candidate costs ``(m,)``, with all that would be left after it [weighted m]."""
        left = self._left(belief)
        return np.array(
            [left.price(*self._on_the_way(found.cost_map, found, index)) for index in choice.index], np.float32
        )

    def price_from_here(self, belief: Belief) -> float:
        """Return what all that is left costs from where the robot is [weighted m].

        Fewer tours are tried than for :meth:`prices`: it is a little more than the lowest of these.
        """
        away = np.hypot(*(self._places - belief.pose[:2]).T)
        return self._left(belief).price(np.array([np.argmin(away)]), np.zeros(1))

    def _left(self, belief: Belief) -> _Left:
        """Return what is left to see."""
        true = self._true
        missing = true.missing(belief)
        # What has been looked at from a place and is not seen by now is not to be seen from it.
        here = np.hypot(*(self._places - belief.pose[:2]).T) < _HERE_M
        self._sight[np.ix_(here, np.flatnonzero(missing))] = False
        tiles = np.flatnonzero((missing > 0) & self._sight.any(axis=0))
        cells = missing[tiles].astype(np.float64)
        spare = _ENOUGH * true.ground.mappable_cells
        if cells.sum() <= spare:
            spare = 0.0
        seen = np.ascontiguousarray(self._sight[:, tiles].T)
        return _Left(seen, true.distance, cells, cells @ seen, spare)

    def _on_the_way(self, cost_map: CostMap, found: Candidates, index: int) -> tuple[Cells, Array]:
        """Return the places that a candidate's way comes by, and what it has cost until there."""
        row, col = found.cells[index].tolist()
        way = way_cells(found.travel, (row, col))
        costs = found.travel.cost[tuple(way.T)].astype(np.float64)
        true = self._true
        at = np.rint(true.map.to_cells(cost_map.to_points(way)) / true.stride).astype(np.int64)
        at = np.minimum(at, np.array(self._lattice.shape) - 1)
        places = self._lattice[tuple(at.T)]
        first = np.flatnonzero(np.diff(places, prepend=-2) != 0)
        first = first[places[first] >= 0]
        if not len(first):
            nearest = int(np.argmin(np.hypot(*(self._places - cost_map.to_points(way[-1:])).T)))
            return np.array([nearest]), costs[-1:]
        # The last one is reached where the way ends.
        return places[first], np.append(costs[first[:-1]], costs[-1])


@dataclass(frozen=True, eq=False)
class _Left:
    """What is left to see, and from where; as :func:`_price` takes it."""

    seen: NDArray[np.bool_]
    distance: Array
    cells: Array
    gains: Array
    spare: float

    def price(self, places: Cells, costs: Array) -> float:
        """Return the cost of a way by ``places`` and of what is left after it."""
        return float(_price(self.seen, self.distance, self.cells, self.gains, places, costs, self.spare))


def _lattice(true: TruePlaces) -> Cells:
    """Return the number of the place at or beside each point of the lattice, −1 where there is none."""
    shape = -(-np.array(true.map.classes.shape) // true.stride) + 1
    lattice = np.full(shape, -1, dtype=np.int64)
    at = true.cells // true.stride
    for d_row, d_col in ((1, 1), (1, -1), (-1, 1), (-1, -1), (1, 0), (-1, 0), (0, 1), (0, -1), (0, 0)):
        beside = at + np.array([d_row, d_col])
        within = ((beside >= 0) & (beside < shape)).all(axis=1)
        lattice[tuple(beside[within].T)] = np.flatnonzero(within)
    return lattice


@njit(cache=True, nogil=True)
def _price(
    seen: NDArray[np.bool_], distance: Array, cells: Array, gains: Array, places: Cells, costs: Array, spare: float
) -> float:
    """Return the cost of a way by ``places`` and of the best of some greedy tours from its end, improved.

    Parameters
    ----------
    seen
        ``(tiles, places)``.
    distance
        ``(places, places)`` [weighted m].
    cells, gains
        ``(tiles,)`` missing in each, and ``(places,)`` those in sight of each place.
    places, costs
        On the way, and what it has cost until there.
    spare
        That many cells need not be seen.
    """
    gains = gains.copy()
    left, total = cells.copy(), cells.sum()
    for k in range(len(places)):
        total -= _look(seen, places[k], left, gains)
        if total <= spare + 0.5:
            return float(costs[k])
    lowest, best = np.inf, places[-1:]
    for offset in _OFFSETS_M:
        order, way = _greedy_tour(seen, distance, left.copy(), gains.copy(), total, places[-1], spare, offset)
        if way < lowest:
            lowest, best = way, order
    return float(costs[-1] + min(lowest, _improved(seen, distance, left, total, best, spare)))


@njit(cache=True, nogil=True)
def _greedy_tour(
    seen: NDArray[np.bool_], distance: Array, left: Array, gains: Array, total: float, place: int, spare: float,
    offset: float,
) -> tuple[Cells, float]:  # fmt: skip
    """Return the places in turn until enough is seen, each where most is new for the way there, and the way."""
    order, count, way = np.empty(len(gains) + 1, dtype=np.int64), 1, 0.0
    order[0] = place
    while total > spare + 0.5:
        best, most = -1, 0.0
        for i in range(len(gains)):
            value = gains[i] / (distance[place, i] + offset)
            if gains[i] > 0.5 and value > most:
                best, most = i, value
        if best < 0:
            break
        way += distance[place, best]
        place = best
        order[count] = place
        count += 1
        total -= _look(seen, place, left, gains)
    return order[:count], way


@njit(cache=True, nogil=True)
def _improved(
    seen: NDArray[np.bool_], distance: Array, left: Array, total: float, order: Cells, spare: float
) -> float:
    """Return the way along a tour's places in a better order, until enough is seen."""
    own = np.empty((len(order), len(order)))
    for a in range(len(order)):
        for b in range(len(order)):
            own[a, b] = distance[order[a], order[b]]
    turn = np.arange(len(order))
    improve(own, np.zeros(len(order)), turn)
    unseen, way = left.copy(), 0.0
    for k in range(1, len(turn)):
        if total <= spare + 0.5:
            break
        way += own[turn[k - 1], turn[k]]
        for j in range(len(unseen)):
            if seen[j, order[turn[k]]]:
                total -= unseen[j]
                unseen[j] = 0.0
    return way


@njit(cache=True, nogil=True)
def _look(seen: NDArray[np.bool_], place: int, left: Array, gains: Array) -> float:
    """Strike out what is seen from a place; return how many cells that is."""
    new = 0.0
    for j in range(len(left)):
        if left[j] > 0.0 and seen[j, place]:
            new += left[j]
            for i in range(len(gains)):
                gains[i] -= left[j] * seen[j, i]
            left[j] = 0.0
    return new
