"""A planner that knows the true map: the bound that the reports set beside the agents, and no agent itself.

It tours the places from which all of the true map is seen, with much in view soon, and
goes on as the belief's map fills. It drives as every agent does, on the belief's pose and with the same follower;
that is why it belongs to the reports alone (``agents/`` may not reach the truth). A bound in practice, not a
proven one: tours are found by local search.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.base import Goal
from agents.explorer import Candidates, Explorer
from agents.ways.planning import shortest_path, travel_costs
from agents.ways.routing import best_tour, draw_luck
from mecanum_env.ground_truth import GroundTruth
from slam.belief import Belief
from slam.types import Array
from training.episodes.true_places import TruePlaces, greedy_tour

__all__ = ["NAME", "KnownMap"]

Cells = NDArray[np.int64]

NAME = "known-map"
"""What reports call it."""

_HERE_M = 0.25  # the robot stands at a place
_SOON = (0.0, 1.0, 3.0, 10.0, 30.0)  # prices tried, of a metre of the way to what would show all that is unseen
_OFFSETS_M = (0.5, 2.0, 5.0)
_HOLD = 0.95  # another tour must be shorter by this much than what is left of the one it is on
_ENOUGH = 0.04  # share of the cells that may stay unseen: reports count to 95 %
_TRIES = 4  # set covers tried at each choice


class KnownMap(Explorer):
    """Tours the true map's places to look from.

    Parameters
    ----------
    ground : GroundTruth
        The truth of the episode that it is to plan.
    """

    def __init__(self, ground: GroundTruth, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._true = TruePlaces(ground, self.config.planner, robot=self._robot, lidar=self._lidar)
        self._sight = self._true.sight.copy()
        self._plan: list[int] = []  # places still to go to

    def choose(self, belief: Belief) -> Goal | None:
        """Return the first place of the tour that shows the unseen soonest; with all seen, a frontier's place."""
        true = self._true
        missing = true.missing(belief)
        tiles = np.flatnonzero(missing)
        # What has been looked at from a place and is not seen by now is not to be seen from it.
        here = np.hypot(*(true.map.to_points(true.cells) - belief.pose[:2]).T) < _HERE_M
        self._sight[np.ix_(here, tiles)] = False
        sight = self._sight[:, tiles]
        away = true.costs_from(true.map.to_cells(belief.pose[None, :2])[0])
        useful = np.flatnonzero(sight.any(axis=1) & np.isfinite(away))
        if not len(useful):
            return super().choose(belief)
        # Place 0 is where the robot is; it sees nothing that it has not seen.
        seen = np.vstack([np.zeros((1, len(tiles)), dtype=np.bool_), sight[useful]])
        distance = np.zeros((len(useful) + 1, len(useful) + 1))
        distance[0, 1:] = distance[1:, 0] = away[useful]
        distance[1:, 1:] = true.distance[np.ix_(useful, useful)]
        cells = missing[tiles].astype(np.float64)
        tours = self._tours(seen, distance, cells)
        ways = [self._way(order, seen, distance, cells) for order in tours]
        index = {int(place): k + 1 for k, place in enumerate(useful)}
        planned = np.array([0, *(index[p] for p in self._plan if p in index)])
        tours.append(planned)
        ways.append(_HOLD * self._way(planned, seen, distance, cells))
        tour = tours[int(np.argmin(ways))]
        self._plan = useful[tour[1:] - 1].tolist()
        return self._drive_to(true.cells[self._plan[0]], belief)

    def _tours(self, seen: NDArray[np.bool_], distance: Array, cells: Array) -> list[Cells]:
        """Return tours to choose from: short ones, greedy ones."""
        share = seen @ cells / cells.sum()
        luck = draw_luck(_TRIES, len(seen))
        tours = [best_tour(seen, distance, soon * share, luck)[0] for soon in _SOON]
        tiles = np.ascontiguousarray(seen.T)
        for offset in _OFFSETS_M:
            order, _ = greedy_tour(tiles, distance, cells.copy(), cells @ tiles, cells.sum(), 0, -1.0, offset)
            tours.append(order)
        return tours

    def _way(self, order: Cells, seen: NDArray[np.bool_], distance: Array, cells: Array) -> float:
        """Return how far [weighted m] a tour goes until 95 % is seen; all of it, where that much is."""
        spare = _ENOUGH * self._true.ground.mappable_cells
        return _way_until(seen, distance, cells, order, spare if cells.sum() > spare else 0.0)

    def _drive_to(self, cell: Cells, belief: Belief) -> Goal:
        true_map = self._true.map
        here = true_map.to_cells(belief.pose[None, :2])[0]
        cost_map = replace(true_map, start=(int(here[0]), int(here[1])))
        path = shortest_path(
            cost_map, travel_costs(cost_map), (int(cell[0]), int(cell[1])), start=belief.pose,
            spacing_m=self.config.planner.path_spacing_m,
        )  # fmt: skip
        target = path[-1]
        if self._target is None or np.hypot(*(target - self._target)) > self.config.patience.same_m:
            self._deadline = math.inf
            self._arrived_for = 0.0
        self._target = target
        self._status = "driving"
        return Goal(pose=np.array([*target, float(belief.pose[2])]), path=path)

    def pick(self, candidates: Candidates, belief: Belief) -> int:
        """Return the nearest frontier: what is left when all tiles are seen."""
        return int(np.argmin(candidates.costs))

    def _is_frontier(self, belief: Belief, point: Array) -> bool:
        # Its goals are places, chosen anew each second.
        return True


@njit(cache=True, nogil=True)
def _way_until(seen: NDArray[np.bool_], distance: Array, cells: Array, order: Cells, spare: float) -> float:
    """Return how far [weighted m] a tour goes until ``spare`` cells are unseen; inf where that never is."""
    left = cells.copy()
    total, way = cells.sum(), 0.0
    for k in range(1, len(order)):
        way += distance[order[k - 1], order[k]]
        for j in range(len(left)):
            if seen[order[k], j]:
                total -= left[j]
                left[j] = 0.0
        if total <= spare + 0.5:
            return float(way)
    return np.inf
