"""Places all over the true map, the ways between them and what is to be seen from each: for bounds and teachers.

Nothing of it may reach an agent; ``agents/`` cannot import it.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.ways import cost_map as cost_maps
from agents.ways.cost_map import CostMap, PlannerConfig
from agents.ways.planning import travel_costs
from mecanum_env.config import LidarConfig, RobotConfig
from mecanum_env.ground_truth import GroundTruth, on_lattice
from slam.belief import Belief
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slam.types import Array, Cells

__all__ = ["TILE", "TruePlaces", "cells_per_tile", "greedy_tour", "see_from", "true_cost_map", "true_grid"]

TILE = 6
"""Fine cells a side of the tiles that are to be seen."""

_PLACES_M = 0.6  # between the places to look from
_NEARER = 0.9  # share of the lidar's range within which a tile counts as seen
_RAYS = 720
_MOST = 0.7  # share of a tile in view from where it counts as seen
_LEAST_SHARE = 0.4  # of a tile's mappable cells unseen: less is not gone for


class TruePlaces:
    """A lattice of places that the robot can reach, by the truth.

    Parameters
    ----------
    ground : GroundTruth
        The truth of an episode.
    planner, robot, lidar
        What ways cost, to which body, and how far is seen.

    Attributes
    ----------
    map : CostMap
        The true map for planning, in the start frame.
    cells : Cells
        Row and column of each place ``(places, 2)`` on it.
    distance : Array
        Travel costs ``(places, places)`` [weighted m].
    sight : NDArray[np.bool_]
        Which tiles of the truth's raster each place sees for the most part ``(places, tiles)``.
    """

    def __init__(
        self, ground: GroundTruth, planner: PlannerConfig, *, robot: RobotConfig, lidar: LidarConfig
    ) -> None:
        self.ground = ground
        self._whole = cells_per_tile(ground.mappable)
        self.map = true_cost_map(ground, planner, robot)
        reached = np.isfinite(travel_costs(self.map).cost)
        stride = max(1, round(_PLACES_M / self.map.resolution))
        self.cells = np.argwhere(reached[::stride, ::stride]) * stride
        self.distance = np.array([self.costs_from(cell) for cell in self.cells]).reshape(-1, len(self.cells))
        self.sight = self._sights(lidar)

    def costs_from(self, cell: Cells) -> Array:
        """Return the travel costs ``(places,)`` [weighted m] from a cell of the true map to every place."""
        cost = travel_costs(replace(self.map, start=(int(cell[0]), int(cell[1])))).cost
        return np.asarray(cost[self.cells[:, 0], self.cells[:, 1]], dtype=np.float64)

    def missing(self, belief: Belief) -> Cells:
        """Return the mappable cells of each tile ``(tiles,)`` that the belief lacks; 0 where hardly any."""
        ground = self.ground
        free = on_lattice(belief.grid.classes() == FREE, belief.grid.lattice_origin, ground)
        missing = cells_per_tile(ground.mappable & ~free)
        return np.where((missing > _LEAST_SHARE * self._whole) & (missing >= TILE), missing, 0).ravel()

    def _sights(self, lidar: LidarConfig) -> NDArray[np.bool_]:
        ground = self.ground
        whole = self._whole
        corner = np.array(ground.lattice_origin[::-1]) * ground.resolution
        eyes = (self.map.to_points(self.cells) - corner) / ground.resolution
        reach = _NEARER * lidar.range_max_m / ground.resolution
        part = _tiles_in_view(ground.mappable, eyes, reach)
        return (part > _MOST * whole.ravel()) & (whole.ravel() >= TILE)


def true_grid(ground: GroundTruth) -> OccupancyGrid:
    """Return the map that a belief would have that knew all, in the start frame."""
    classes = np.full(ground.mappable.shape, UNKNOWN, dtype=np.int8)
    classes[ground.mappable] = FREE
    classes[ground.walls] = OCCUPIED
    row, col = ground.lattice_origin
    size = ground.resolution
    return OccupancyGrid.from_classes(classes, size, (col * size, row * size))


def true_cost_map(ground: GroundTruth, planner: PlannerConfig, robot: RobotConfig) -> CostMap:
    """Return the planning grid of :func:`true_grid`, with the robot at its start."""
    belief = Belief.without_landmarks(np.zeros(3), np.zeros((3, 3)), true_grid(ground))
    return cost_maps.build(belief, planner, robot)


def cells_per_tile(cells: NDArray[np.bool_], side: int = TILE) -> NDArray[np.int64]:
    """Return the number of cells set in each tile ``(rows, columns)`` of so many cells a side."""
    rows, cols = (np.arange(0, length, side) for length in cells.shape)
    along = np.add.reduceat(cells, rows, axis=0, dtype=np.int64)
    return np.asarray(np.add.reduceat(along, cols, axis=1))


@njit(cache=True, nogil=True)
def _tiles_in_view(free: NDArray[np.bool_], eyes: Array, reach: float) -> NDArray[np.int64]:
    """Return how many free cells of each tile ``(eyes, tiles)`` rays from each eye (x, y in cells) cross."""
    rows, cols = free.shape
    across = -(-cols // TILE)
    seen = np.zeros((len(eyes), -(-rows // TILE) * across), dtype=np.int64)
    last = np.full(free.shape, -1, dtype=np.int32)  # the eye that saw each cell last
    for i in range(len(eyes)):
        for k in range(_RAYS):
            angle = 2.0 * math.pi * k / _RAYS
            dx, dy = math.cos(angle), math.sin(angle)
            away = 0.0
            while away < reach:
                row, col = math.floor(eyes[i, 1] + away * dy), math.floor(eyes[i, 0] + away * dx)
                if not (0 <= row < rows and 0 <= col < cols) or not free[row, col]:
                    break
                if last[row, col] != i:
                    last[row, col] = i
                    seen[i, (row // TILE) * across + col // TILE] += 1
                away += 0.7
    return seen


@njit(cache=True, nogil=True)
def greedy_tour(
    seen: NDArray[np.bool_], distance: Array, left: Array, gains: Array, total: float, place: int, spare: float,
    offset: float,
) -> tuple[Cells, float]:  # fmt: skip
    """Return the places in turn until enough is seen, each where most is new for the way there, and the way.

    Parameters
    ----------
    seen
        ``(tiles, places)``.
    distance
        ``(places, places)`` [weighted m].
    left, gains
        ``(tiles,)`` missing in each, and ``(places,)`` those in sight of each place; both are used up.
    total, place
        Cells missing in all, and the place to begin at.
    spare
        That many cells need not be seen; below 0 the tour goes on while anything is to be seen.
    offset
        Added to every way [weighted m].
    """
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
        total -= see_from(seen, place, left, gains)
    return order[:count], way


@njit(cache=True, nogil=True)
def see_from(seen: NDArray[np.bool_], place: int, left: Array, gains: Array) -> float:
    """Strike out what is seen from a place; return how many cells that is."""
    new = 0.0
    for j in range(len(left)):
        if left[j] > 0.0 and seen[j, place]:
            new += left[j]
            for i in range(len(gains)):
                gains[i] -= left[j] * seen[j, i]
            left[j] = 0.0
    return new
