"""Travel costs between many places at once: exactly for some, by the tree of shortest ways for the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.ways.cost_map import CostMap
from agents.ways.planning import TravelCosts, cell_before, travel_costs
from slam.types import Array, Cells, Floats

__all__ = ["between"]

_CELLS = 100_000  # that may be searched for exact costs in one call: some 5 ms


def between(cost_map: CostMap, travel: TravelCosts, cells: Cells, *, searched: int = _CELLS) -> Array:
    """Return the travel costs ``(n, n)`` [weighted m] between reachable cells ``(n, 2)``, the robot's first.

    The way back along the tree of shortest ways from the robot is one that exists; it is the shortest wherever
    rooms hang on corridors like leaves on twigs. As many of the first cells are searched from exactly as there are
    ``searched`` cells of the map for; from the robot's own it is exact in any case.
    """
    costs = _along_tree(travel.cost, travel.step, cells)
    exact = min(len(cells), searched // cost_map.classes.size + 1)
    for i in range(1, exact):
        row, col = int(cells[i, 0]), int(cells[i, 1])
        own = travel_costs(replace(cost_map, start=(row, col))).cost[tuple(cells.T)]
        costs[i] = np.minimum(costs[i], own)
        costs[:, i] = np.minimum(costs[:, i], own)
    return costs


@njit(cache=True, nogil=True)
def _along_tree(cost: Floats, step: NDArray[np.int8], cells: Cells) -> Array:
    n = len(cells)
    out = np.zeros((n, n))
    passed = np.zeros(cost.shape, dtype=np.int32)  # by the way to which place, from 1; zeros take no time
    for i in range(n):
        row, col = cells[i, 0], cells[i, 1]
        passed[row, col] = i + 1
        while step[row, col] >= 0:
            row, col = cell_before(step, row, col)
            passed[row, col] = i + 1
        for j in range(i):
            row, col = cells[j, 0], cells[j, 1]
            while passed[row, col] != i + 1 and step[row, col] >= 0:
                row, col = cell_before(step, row, col)
            out[i, j] = cost[cells[i, 0], cells[i, 1]] + cost[cells[j, 0], cells[j, 1]] - 2.0 * cost[row, col]
            out[j, i] = out[i, j]
    return out
