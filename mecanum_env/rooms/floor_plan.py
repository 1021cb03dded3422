"""A floor plan: the geometry that the lidar sees and that the robot collides with, one and the same."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

__all__ = ["FloorPlan", "FloorPlanError"]

Array = NDArray[np.float64]


class FloorPlanError(ValueError):
    """A plan that cannot be used: no free space, a start inside a wall, a damaged file."""


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """Walls, obstacles, free space and a start, in the world frame [m].

    The walls are the *surfaces* of whatever is solid: a wall of a building is two of them, some 10 to 20 cm
    apart. What lies behind a surface is never seen and never reached.
    """

    name: str
    walls: Array  # (w, 4) segments x1, y1, x2, y2
    polygons: tuple[Array, ...]  # obstacles: (k, 2) vertices each, convex, counter-clockwise
    circles: Array  # (c, 3) obstacles: x, y, radius
    free: NDArray[np.bool_]  # (rows, cols) True where a point is in free space; row 0 at the lowest y
    resolution: float  # [m] of a cell of ``free``
    origin: tuple[float, float]  # world position of the lower-left corner of cell (0, 0)
    start: tuple[float, float, float]  # x, y, θ: a pose in which the robot touches nothing

    @cached_property
    def segments(self) -> Array:
        """Every straight surface ``(n, 4)``: the walls, then the edges of the polygons."""
        edges = [np.hstack([p, np.roll(p, -1, axis=0)]) for p in self.polygons]
        return np.ascontiguousarray(np.vstack([self.walls, *edges]) if edges else self.walls)

    @cached_property
    def corners(self) -> Array:
        """True corner points ``(n, 2)``: where two surfaces that are not in line share an end point."""
        raise NotImplementedError
