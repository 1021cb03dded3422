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

from agents import cost_map as cost_maps
from agents.base import Goal
from agents.cost_map import CostMap
from agents.explorer import Candidates, Explorer
from agents.planning import shortest_path, travel_costs
from agents.routing import best_tour, draw_luck
from mecanum_env.ground_truth import GroundTruth, on_lattice
from slam.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slam.types import Belief

__all__ = ["NAME", "KnownMap"]

Array = NDArray[np.float64]
Cells = NDArray[np.int64]

NAME = "known-map"
"""What reports call it."""

_PLACES_M = 0.6  # between the places to look from
_TILE = 6  # fine cells a side of the tiles that are to be seen
_NEARER = 0.9  # share of the lidar's range within which a tile counts as seen
_RAYS = 720
_HERE_M = 0.25  # the robot stands at a place
_SOON = (0.0, 1.0, 3.0, 10.0, 30.0)  # prices tried, of a metre of the way to what would show all that is unseen
_OFFSETS_M = (0.5, 2.0, 5.0)
_HOLD = 0.95  # another tour must be shorter by this much than what is left of the one it is on
_ENOUGH = 0.04  # share of the cells that may stay unseen: reports count to 95 %
_TRIES = 4  # set covers tried at each choice
_MOST = 0.7  # share of a tile in view from where it counts as seen
_LEAST_SHARE = 0.4  # of a tile's mappable cells unseen: less is not gone for


class KnownMap(Explorer):
    """Tours the true map's places to look from.

    Parameters
    ----------
    ground : GroundTruth
        The truth of the episode that it is to plan.
    """

    def __init__(self, ground: GroundTruth, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._ground = ground
        self._map = self._true_cost_map(np.zeros(3))
        reached = np.isfinite(travel_costs(self._map).cost)
        step = max(1, round(_PLACES_M / self._map.resolution))
        self._places = np.argwhere(reached[::step, ::step]) * step
        self._distance = np.array([self._costs_from(cell) for cell in self._places]).reshape(-1, len(self._places))
        self._sight = self._sights()
        self._plan: list[int] = []  # places still to go to

    def _true_cost_map(self, pose: Array) -> CostMap:
        ground = self._ground
        classes = np.full(ground.mappable.shape, UNKNOWN, dtype=np.int8)
        classes[ground.mappable] = FREE
        classes[ground.walls] = OCCUPIED
        row, col = ground.lattice_origin
        size = ground.resolution
        grid = OccupancyGrid.from_classes(classes, size, (col * size, row * size))
        nothing = np.zeros((0, 2))
        belief = Belief(
            pose=pose, pose_cov=np.zeros((3, 3)), landmarks=nothing, landmark_cov=np.zeros((0, 2, 2)),
            landmark_ids=np.zeros(0, np.int64), grid=grid,
        )  # fmt: skip
        return cost_maps.build(belief, self.config.planner, self._robot)

    def _costs_from(self, cell: Cells) -> Array:
        """Return the travel costs ``(places,)`` [weighted m] from a cell of the true map to every place."""
        cost = travel_costs(replace(self._map, start=(int(cell[0]), int(cell[1])))).cost
        return np.asarray(cost[self._places[:, 0], self._places[:, 1]], dtype=np.float64)

    def _sights(self) -> NDArray[np.bool_]:
        """Return which tiles of the truth's raster each place sees for the most part ``(places, tiles)``."""
        ground = self._ground
        whole = _per_tile(ground.mappable)
        corner = np.array(ground.lattice_origin[::-1]) * ground.resolution
        eyes = (self._map.to_points(self._places) - corner) / ground.resolution
        reach = _NEARER * self._lidar.range_max_m / ground.resolution
        sight = np.zeros((len(eyes), whole.size), dtype=np.bool_)
        for i, eye in enumerate(eyes):
            part = _per_tile(_in_view(ground.mappable, eye, reach))
            sight[i] = ((part > _MOST * whole) & (whole >= _TILE)).ravel()
        return sight

    def _missing(self, belief: Belief) -> Cells:
        """Return the mappable cells of each tile ``(tiles,)`` that the belief lacks; 0 where hardly any."""
        ground = self._ground
        free = on_lattice(belief.grid.classes() == FREE, belief.grid.lattice_origin, ground)
        missing, whole = _per_tile(ground.mappable & ~free), _per_tile(ground.mappable)
        return np.where((missing > _LEAST_SHARE * whole) & (missing >= _TILE), missing, 0).ravel()

    def choose(self, belief: Belief) -> Goal | None:
        """Return the first place of the tour that shows the unseen soonest; with all seen, a frontier's place."""
        missing = self._missing(belief)
        tiles = np.flatnonzero(missing)
        # What has been looked at from a place and is not seen by now is not to be seen from it.
        here = np.hypot(*(self._map.to_points(self._places) - belief.pose[:2]).T) < _HERE_M
        self._sight[np.ix_(here, tiles)] = False
        sight = self._sight[:, tiles]
        away = self._costs_from(self._map.to_cells(belief.pose[None, :2])[0])
        useful = np.flatnonzero(sight.any(axis=1) & np.isfinite(away))
        if not len(useful):
            return super().choose(belief)
        # Place 0 is where the robot is; it sees nothing that it has not seen.
        seen = np.vstack([np.zeros((1, len(tiles)), dtype=np.bool_), sight[useful]])
        distance = np.zeros((len(useful) + 1, len(useful) + 1))
        distance[0, 1:] = distance[1:, 0] = away[useful]
        distance[1:, 1:] = self._distance[np.ix_(useful, useful)]
        cells = missing[tiles].astype(np.float64)
        tours = self._tours(seen, distance, cells)
        ways = [self._way(order, seen, distance, cells) for order in tours]
        index = {int(place): k + 1 for k, place in enumerate(useful)}
        planned = np.array([0, *(index[p] for p in self._plan if p in index)])
        tours.append(planned)
        ways.append(_HOLD * self._way(planned, seen, distance, cells))
        tour = tours[int(np.argmin(ways))]
        self._plan = useful[tour[1:] - 1].tolist()
        return self._drive_to(self._places[self._plan[0]], belief)

    def _tours(self, seen: NDArray[np.bool_], distance: Array, cells: Array) -> list[Cells]:
        """Return tours to choose from: short ones, greedy ones."""
        share = seen @ cells / cells.sum()
        luck = draw_luck(_TRIES, len(seen))
        tours = [best_tour(seen, distance, soon * share, luck)[0] for soon in _SOON]
        return tours + [_greedy(seen, distance, cells, offset) for offset in _OFFSETS_M]

    def _way(self, order: Cells, seen: NDArray[np.bool_], distance: Array, cells: Array) -> float:
        """Return how far [weighted m] a tour goes until 95 % is seen; all of it, where that much is."""
        spare = _ENOUGH * self._ground.mappable_cells
        return _way_until(seen, distance, cells, order, spare if cells.sum() > spare else 0.0)

    def _drive_to(self, cell: Cells, belief: Belief) -> Goal:
        here = self._map.to_cells(belief.pose[None, :2])[0]
        cost_map = replace(self._map, start=(int(here[0]), int(here[1])))
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


@njit(cache=True, nogil=True)
def _greedy(seen: NDArray[np.bool_], distance: Array, cells: Array, offset: float) -> Cells:
    """Return the tour that goes on to where most new cells are in view for the way there and ``offset`` [m]."""
    left = cells.copy()
    order = [0]
    while True:
        best, most = -1, 0.0
        for i in range(1, len(seen)):
            new = 0.0
            for j in range(len(left)):
                if seen[i, j]:
                    new += left[j]
            value = new / (distance[order[-1], i] + offset)
            if value > most:
                best, most = i, value
        if best < 0:
            return np.array(order)
        order.append(best)
        for j in range(len(left)):
            if seen[best, j]:
                left[j] = 0.0


def _per_tile(cells: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the number of cells set in each tile."""
    rows, cols = (-(-side // _TILE) for side in cells.shape)
    padded = np.zeros((rows * _TILE, cols * _TILE), dtype=np.int64)
    padded[: cells.shape[0], : cells.shape[1]] = cells
    return np.asarray(padded.reshape(rows, _TILE, cols, _TILE).sum(axis=(1, 3)))


@njit(cache=True, nogil=True)
def _in_view(free: NDArray[np.bool_], eye: Array, reach: float) -> NDArray[np.bool_]:
    """Return the free cells that rays from an eye ``(2,)`` (x, y in cells) cross."""
    view = np.zeros(free.shape, dtype=np.bool_)
    for k in range(_RAYS):
        angle = 2.0 * math.pi * k / _RAYS
        dx, dy = math.cos(angle), math.sin(angle)
        away = 0.0
        while away < reach:
            row, col = math.floor(eye[1] + away * dy), math.floor(eye[0] + away * dx)
            if not (0 <= row < free.shape[0] and 0 <= col < free.shape[1]) or not free[row, col]:
                break
            view[row, col] = True
            away += 0.7
    return view
