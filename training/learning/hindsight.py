"""What exploring would still cost, by the truth: rewards are shaped by it.

A tour of the true map from where the robot is until 95 % is seen (hindsight optimisation, as in Yoon et al.,
"Probabilistic planning via determinization in hindsight", AAAI 2008). A choice that makes it longer is felt soon.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.ways.routing import improve
from slam.belief import Belief
from slam.types import Array, Cells
from training.truth.places import TruePlaces, greedy_tour, see_from

__all__ = ["Hindsight"]

_OFFSETS_M = np.array([0.5, 2.0, 6.0])  # greedy tours tried: what a new cell is worth against its way
_ENOUGH = 0.04  # share of the cells that may stay unseen: small remains are left out of the count anyway
_HERE_M = 0.43  # the robot is at a place: no cell of the lattice is farther from all of them


class Hindsight:
    """Prices what is left to explore in one episode; its room's places are not changed, and may be used again."""

    def __init__(self, true: TruePlaces) -> None:
        self._true = true
        self._sight = true.sight.copy()
        self._places = true.map.to_points(true.cells)

    def price_from_here(self, belief: Belief) -> float:
        """Return what all that is left costs from where the robot is [weighted m]."""
        true = self._true
        missing = true.missing(belief)
        away = np.hypot(*(self._places - belief.pose[:2]).T)
        # What has been looked at from a place and is not seen by now is not to be seen from it.
        self._sight[np.ix_(away < _HERE_M, np.flatnonzero(missing))] = False
        tiles = np.flatnonzero((missing > 0) & self._sight.any(axis=0))
        cells = missing[tiles].astype(np.float64)
        spare = _ENOUGH * true.ground.mappable_cells
        if cells.sum() <= spare:
            spare = 0.0
        seen = np.ascontiguousarray(self._sight[:, tiles].T)
        return float(_price(seen, true.distance, cells, cells @ seen, int(np.argmin(away)), spare))


@njit(cache=True, nogil=True)
def _price(seen: NDArray[np.bool_], distance: Array, left: Array, gains: Array, place: int, spare: float) -> float:
    """Return the cost of the best of some greedy tours from a place, improved; ``left``, ``gains`` are used up.

    Parameters
    ----------
    seen
        ``(tiles, places)``.
    distance
        ``(places, places)`` [weighted m].
    left, gains
        ``(tiles,)`` missing in each, and ``(places,)`` those in sight of each place.
    spare
        That many cells need not be seen.
    """
    total = left.sum()
    total -= see_from(seen, place, left, gains)
    if total <= spare + 0.5:
        return 0.0
    lowest, best = np.inf, np.array([place])
    for offset in _OFFSETS_M:
        order, way = greedy_tour(seen, distance, left.copy(), gains.copy(), total, place, spare, offset)
        if way < lowest:
            lowest, best = way, order
    return min(lowest, _improved(seen, distance, left, total, best, spare))


@njit(cache=True, nogil=True)
def _improved(
    seen: NDArray[np.bool_], distance: Array, left: Array, total: float, order: Cells, spare: float
) -> float:
    """Return the way along a tour's places in a better order, until enough is seen; ``left`` is used up."""
    own = np.empty((len(order), len(order)))
    for a in range(len(order)):
        for b in range(len(order)):
            own[a, b] = distance[order[a], order[b]]
    turn = np.arange(len(order))
    improve(own, np.zeros(len(order)), turn)
    way = 0.0
    for k in range(1, len(turn)):
        if total <= spare + 0.5:
            break
        way += own[turn[k - 1], turn[k]]
        for j in range(len(left)):
            if seen[j, order[turn[k]]]:
                total -= left[j]
                left[j] = 0.0
    return way
