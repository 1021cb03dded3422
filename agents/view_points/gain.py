"""How much new area a lidar may be expected to see from a place, by rays over the belief's planning grid.

A ray goes on through what is free and what is unknown until it meets a wall or its range ends; what it crosses
of the unknown counts, each stretch with the area of its sector, r · Δr · Δθ (González-Baños and Latombe, 2002).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.ways.cost_map import CostMap, kind_at
from slam.grids.occupancy import OCCUPIED, UNKNOWN
from slam.types import Array, Cells

__all__ = ["expected_area"]

_RAYS = 120
_STEP = 0.7  # cells: less than one, so that no wall is stepped over, diagonal ones included


def expected_area(
    cost_map: CostMap, cells: Cells, *, range_m: float, depth_m: float = math.inf, rays: int = _RAYS
) -> Array:
    """Return the unknown area ``(m,)`` [m²] in view of a sensor that sees all round.

    Parameters
    ----------
    cost_map : CostMap
        The planning grid.
    cells : NDArray[np.int64]
        Places to look from ``(m, 2)``: row, column. Rows of −1 (no such place) see nothing.
    range_m : float
        How far the sensor sees.
    depth_m : float
        How far into the unknown a ray is believed to get: behind every frontier there is a wall sooner or later.
    rays : int
        Directions, evenly spread.
    """
    area = np.zeros(len(cells))
    resolution = cost_map.resolution
    _cast(cost_map.classes, cells, range_m / resolution, depth_m / resolution, rays, area)
    return area * resolution**2


@njit(cache=True, nogil=True)
def _cast(classes: NDArray[np.int8], cells: Cells, reach: float, depth: float, rays: int, area: Array) -> None:
    sector = _STEP * 2.0 * math.pi / rays
    for i in range(cells.shape[0]):
        if cells[i, 0] < 0:
            continue
        x0, y0 = cells[i, 1] + 0.5, cells[i, 0] + 0.5
        total = 0.0
        for k in range(rays):
            angle = 2.0 * math.pi * (k + 0.5) / rays
            dx, dy = math.cos(angle), math.sin(angle)
            away, unknown = 0.5 * _STEP, 0.0
            while away < reach and unknown < depth:
                kind = kind_at(classes, math.floor(y0 + away * dy), math.floor(x0 + away * dx))
                if kind == OCCUPIED:
                    break
                if kind == UNKNOWN:
                    total += away
                    unknown += _STEP
                away += _STEP
        area[i] = total * sector
