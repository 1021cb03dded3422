"""The bounds of the dungeons protocol: planners that know the true map, in reports only.

They stop on way-points that together see all there is to see, and visit them in the best order found. Whoever does
not know the map cannot count on doing as well; a set cover and a local search do not find the very shortest tour,
so that the true bound lies a little lower still. ``known-map`` sees every free cell, as far as the sensor reaches.
``known-walls`` sees every piece of wall from within 16 m, as an agent sees a frontier: that is how the benchmark's
own planner with the map known is defined, and what the published bound is to be compared with.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from agents.stations.lattice import ways
from agents.ways.routing import best_tour, draw_luck
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN
from training.dungeons.world import CELL_M, SENSORS, Dungeon, Lattice, frontier_points, scan

__all__ = ["BOUNDS", "known_map_path", "known_walls_path"]

_SQUARE = 4  # cells: all of a square is taken for seen where its middle is


def known_map_path(dungeon: Dungeon, sensor: str = SENSORS[0], *, tries: int = 5) -> float:
    """Return the length [m] of a tour that sees the whole map from its start, 0 where one look is enough.

    It is the shortest over so many choices of way-points (``tries``).
    """
    return _shortest(dungeon, lambda lattice, reached: _sight(dungeon, lattice.cells[reached], sensor), tries)


def known_walls_path(dungeon: Dungeon, sensor: str = SENSORS[0], *, tries: int = 5) -> float:
    """Return the length [m] of a tour that sees all walls from within 16 m, 0 where one look is enough.

    Arguments are those of :func:`known_map_path`; with all sensors it is the same.
    """
    walls = np.where(dungeon.free, FREE, UNKNOWN).astype(np.int8)  # pieces of wall are found as frontier is
    points = frontier_points(walls)
    return _shortest(dungeon, lambda lattice, reached: lattice.sight(points, lattice.cells[reached]), tries)


BOUNDS: dict[str, Callable[[Dungeon, str], float]] = {"known-map": known_map_path, "known-walls": known_walls_path}
"""What stands among the agents' names for each."""


def _shortest(
    dungeon: Dungeon, see: Callable[[Lattice, NDArray[np.int64]], NDArray[np.bool_]], tries: int
) -> float:
    known = np.where(dungeon.free, FREE, OCCUPIED).astype(np.int8)
    lattice = Lattice(known, dungeon.start)
    here = lattice.index(*dungeon.start)
    length, _ = lattice.ways(here)
    reached = np.concatenate([[here], np.setdiff1d(np.flatnonzero(np.isfinite(length)), [here])])
    sight = see(lattice, reached)
    sight[:, sight[0]] = False  # what is seen from the start needs no visit
    useful = np.concatenate([[0], 1 + np.flatnonzero(sight[1:].any(axis=1))])
    if len(useful) == 1:
        return 0.0
    places = reached[useful]
    distance = np.array([ways(lattice.cells, lattice.joined, int(i))[0][places] for i in places]) * CELL_M
    sight = np.ascontiguousarray(sight[useful])
    _, cost = best_tour(sight, distance, np.zeros(len(places)), draw_luck(tries, len(places)))
    assert math.isfinite(cost)
    return float(cost)


def _sight(dungeon: Dungeon, cells: NDArray[np.int64], sensor: str) -> NDArray[np.bool_]:
    """Return which free squares' middles each way-point's scan sees ``(n, m)``."""
    middle = np.zeros(dungeon.free.shape, dtype=np.bool_)
    middle[_SQUARE // 2 :: _SQUARE, _SQUARE // 2 :: _SQUARE] = True
    points = np.argwhere(middle & dungeon.free)
    sight = np.zeros((len(cells), len(points)), dtype=np.bool_)
    for i, (row, col) in enumerate(cells):
        seen = np.full(dungeon.free.shape, UNKNOWN, dtype=np.int8)
        scan(dungeon.free, int(row), int(col), seen, sensor)
        sight[i] = seen[tuple(points.T)] == FREE
    return sight
