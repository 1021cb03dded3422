"""The bound of the dungeons protocol: a planner that knows the true map, in reports only.

It stops on way-points that together see every free cell, and visits them in the best order found. Whoever does not
know the map cannot count on doing as well; a set cover and a local search do not find the very shortest tour, so
that the true bound lies a little lower still.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agents.routing import best_tour, draw_luck
from agents.stations import ways
from slam.occupancy import FREE, OCCUPIED, UNKNOWN
from training.dungeon_world import CELL_M, Dungeon, Lattice, scan

__all__ = ["known_map_path"]

_SQUARE = 4  # cells: all of a square is taken for seen where its middle is


def known_map_path(dungeon: Dungeon, *, tries: int = 5) -> float:
    """Return the length [m] of a tour that sees the whole map from its start, 0 where one look is enough.

    Parameters
    ----------
    dungeon
        The map.
    tries
        Choices of way-points that the shortest tour is taken from.
    """
    known = np.where(dungeon.free, FREE, OCCUPIED).astype(np.int8)
    lattice = Lattice(known, dungeon.start)
    here = lattice.index(*dungeon.start)
    length, _ = lattice.ways(here)
    reached = np.concatenate([[here], np.setdiff1d(np.flatnonzero(np.isfinite(length)), [here])])
    sight = _sight(dungeon, lattice.cells[reached])
    sight[:, sight[0]] = False  # what is seen from the start needs no visit
    useful = np.concatenate([[0], 1 + np.flatnonzero(sight[1:].any(axis=1))])
    if len(useful) == 1:
        return 0.0
    places = reached[useful]
    distance = np.array([ways(lattice.cells, lattice.joined, int(i))[0][places] for i in places]) * CELL_M
    _, cost = best_tour(sight[useful], distance, np.zeros(len(places)), draw_luck(tries, len(places)))
    assert math.isfinite(cost)
    return float(cost)


def _sight(dungeon: Dungeon, cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which free squares' middles each way-point's scan sees ``(n, m)``."""
    middle = np.zeros(dungeon.free.shape, dtype=np.bool_)
    middle[_SQUARE // 2 :: _SQUARE, _SQUARE // 2 :: _SQUARE] = True
    points = np.argwhere(middle & dungeon.free)
    sight = np.zeros((len(cells), len(points)), dtype=np.bool_)
    for i, (row, col) in enumerate(cells):
        seen = np.full(dungeon.free.shape, UNKNOWN, dtype=np.int8)
        scan(dungeon.free, int(row), int(col), seen)
        sight[i] = seen[tuple(points.T)] == FREE
    return sight
