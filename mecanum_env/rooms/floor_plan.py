"""A floor plan: the geometry that the lidar sees and that the robot collides with, one and the same."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from mecanum_env.rooms.outlines.corners import find_corners
from mecanum_env.rooms.outlines.distance import distance_to_zero
from slam.types import Array, Flags, Floats

__all__ = ["FloorPlan", "FloorPlanError", "clearance_of"]


_APART_M = 1e-6  # between a polygon's vertices at least
_DENT_M = 2e-6  # of a polygon at most: coordinates are rounded to a micrometre


class FloorPlanError(ValueError):
    """A plan that cannot be used: no free space, a start inside a wall, a damaged file."""


def clearance_of(free: Flags, resolution: float) -> Floats:
    """Return the distance [m] from each free cell's centre to the nearest edge of a non-free cell.

    What lies outside the raster counts as not free. The value is exact in front of walls along the cells and at
    most 0.21 cells too large diagonally before a corner; it is 0 in cells that are not free.
    """
    padded = np.zeros((free.shape[0] + 2, free.shape[1] + 2), np.uint8)
    padded[1:-1, 1:-1] = free
    cells = distance_to_zero(padded)[1:-1, 1:-1]
    # The transform measures from centre to centre; the surface is the edge, half a cell nearer.
    return np.asarray(np.maximum(cells - 0.5, 0.0) * resolution, np.float32)


@dataclass(frozen=True, eq=False, kw_only=True)
class FloorPlan:
    """Walls, obstacles, free space and a start, in the world frame [m].

    The walls are the *surfaces* of whatever is solid: a wall of a building is two of them, some 10 to 20 cm
    apart. What lies behind a surface is never seen and never reached. The generators and importers direct every
    wall so that free space lies on its left.

    Raises
    ------
    FloorPlanError
        If an array is misshapen or not finite, a polygon is not convex, nothing is free, or the start is not in
        free space, at least ``start_clearance_m`` from every surface.
    """

    name: str
    walls: Array  # (w, 4) segments x1, y1, x2, y2
    polygons: tuple[Array, ...] = ()  # obstacles: (k, 2) vertices each, convex; kept counter-clockwise
    circles: Array = field(default_factory=lambda: np.zeros((0, 3)))  # (c, 3) obstacles: x, y, radius
    free: Flags  # (rows, cols) True where a point is in free space; row 0 at the lowest y
    resolution: float  # [m] of a cell of ``free``
    origin: tuple[float, float] = (0.0, 0.0)  # world position of the lower-left corner of cell (0, 0)
    start: tuple[float, float, float]  # x, y, θ: a pose in which the robot touches nothing
    start_clearance_m: float = 0.0  # [m] that the start keeps from every surface

    def __post_init__(self) -> None:
        object.__setattr__(self, "walls", _array(self, "walls", self.walls, 4))
        polygons = tuple(_convex(self, _array(self, "polygons", polygon, 2)) for polygon in self.polygons)
        object.__setattr__(self, "polygons", polygons)
        object.__setattr__(self, "circles", _array(self, "circles", self.circles, 3))
        object.__setattr__(self, "free", np.ascontiguousarray(self.free, dtype=np.bool_))
        self._check_shapes()
        self._check_start()

    def _check_shapes(self) -> None:
        if self.circles.size and not np.all(self.circles[:, 2] > 0):
            raise FloorPlanError(f"plan {self.name}: every circle needs a radius > 0")
        if not (np.isfinite(self.resolution) and self.resolution > 0):
            raise FloorPlanError(f"plan {self.name}: resolution must be > 0 m, got {self.resolution}")
        if len(self.origin) != 2 or not np.all(np.isfinite(self.origin)):
            raise FloorPlanError(f"plan {self.name}: origin must be two finite coordinates [m]")
        if self.free.ndim != 2 or not self.free.any():
            raise FloorPlanError(
                f"plan {self.name} has no free space: check the thresholds, or whether it needs inverting"
            )

    def _check_start(self) -> None:
        if len(self.start) != 3 or not np.all(np.isfinite(self.start)):
            raise FloorPlanError(f"plan {self.name}: start must be three finite numbers x, y, θ")
        x, y = self.start[:2]
        point = np.array([[x, y]])
        if not self.is_free(point)[0]:
            x0, y0, x1, y1 = self.bounds
            raise FloorPlanError(
                f"plan {self.name}: start ({x:.2f}, {y:.2f}) is not in free space; choose a free point within "
                f"x {x0:.2f} to {x1:.2f}, y {y0:.2f} to {y1:.2f}"
            )
        if self.start_clearance_m > 0:
            distance = float(self.distance_to_surfaces(point)[0])
            if distance < self.start_clearance_m:
                raise FloorPlanError(
                    f"plan {self.name}: start ({x:.2f}, {y:.2f}) is only {distance:.2f} m from a surface; choose "
                    f"one at least {self.start_clearance_m:.2f} m away"
                )

    @cached_property
    def segments(self) -> Array:
        """Every straight surface ``(n, 4)``: the walls, then the edges of the polygons."""
        edges = [np.hstack([p, np.roll(p, -1, axis=0)]) for p in self.polygons]
        return np.ascontiguousarray(np.vstack([self.walls, *edges]) if edges else self.walls)

    @cached_property
    def corners(self) -> Array:
        """True corner points ``(n, 2)`` [m]: where free space bends by more than 5°.

        They are end points of surfaces. One that is hidden (a cupboard's back corner in a room's corner) or
        where the surface goes on straight (two cupboards side by side) is no corner. Obstacles that reach into a
        wall or one another have corners where they end, not where they are seen to: let them touch.
        """
        return self._corners_and_kinds[0]

    @cached_property
    def corner_kinds(self) -> NDArray[np.int8]:
        """``(n,)`` CONVEX, CONCAVE, or 0 for a corner of thin walls, which is both; see :mod:`slam.types`."""
        return self._corners_and_kinds[1]

    @cached_property
    def _corners_and_kinds(self) -> tuple[Array, NDArray[np.int8]]:
        return find_corners(self.walls, self.polygons, self.is_free, self.resolution)

    @cached_property
    def bounds(self) -> tuple[float, float, float, float]:
        """Least box around all surfaces: x_min, y_min, x_max, y_max [m] (the raster's where there is none)."""
        ends = [self.segments[:, :2], self.segments[:, 2:]]
        if self.circles.size:
            centre, radius = self.circles[:, :2], self.circles[:, 2:]
            ends += [centre - radius, centre + radius]
        points = np.vstack(ends)
        if not points.size:
            rows, cols = self.free.shape
            points = np.array([(0.0, 0.0), (cols, rows)]) * self.resolution + np.asarray(self.origin)
        (x0, y0), (x1, y1) = points.min(axis=0), points.max(axis=0)
        return float(x0), float(y0), float(x1), float(y1)

    @cached_property
    def area_m2(self) -> float:
        """Area of free space [m²]."""
        return float(np.count_nonzero(self.free)) * self.resolution**2

    def is_free(self, points: Array) -> Flags:
        """Return for points ``(n, 2)`` [m] whether each lies in a free cell ``(n,)``; outside the raster: no."""
        x, y = ((np.asarray(points, np.float64).reshape(-1, 2) - self.origin) / self.resolution).T
        rows, cols = self.free.shape
        # Compared as floats: a far-away or NaN point must not wrap round in the conversion to integers.
        found: Flags = (x >= 0) & (x < cols) & (y >= 0) & (y < rows)
        found[found] = self.free[y[found].astype(np.int64), x[found].astype(np.int64)]
        return found

    def clearance(self) -> Floats:
        """Return for each cell ``(rows, cols)`` the distance [m] to the nearest non-free cell (a fresh array).

        See :func:`clearance_of`.
        """
        return clearance_of(self.free, self.resolution)

    def reachable(self, clearance_m: float, start: Array) -> Flags:
        """Return which cells ``(rows, cols)`` have a clearance [m] and hang together with a start ``(≥ 2,)`` [m].

        The start may stand nearer to a surface than that: what counts is the cell with that clearance that is
        nearest to it, of those that no wall parts from it. Where no cell has it, none is reachable.
        """
        rows, cols = self.free.shape
        dx = (np.arange(cols) + 0.5) * self.resolution + self.origin[0] - start[0]
        dy = (np.arange(rows) + 0.5) * self.resolution + self.origin[1] - start[1]
        squared = dx**2 + dy[:, None] ** 2
        room = _part_nearest(self.free, squared)
        return _part_nearest(room & (self.clearance() >= clearance_m), squared)

    def distance_to_surfaces(self, points: Array) -> Array:
        """Return the exact distance [m] ``(n,)`` from points ``(n, 2)`` to the nearest wall or obstacle."""
        points = np.asarray(points, np.float64).reshape(-1, 2)
        best = np.full(len(points), np.inf)
        start, along = self.segments[:, :2], self.segments[:, 2:] - self.segments[:, :2]
        squared = np.maximum(np.einsum("ij,ij->i", along, along), 1e-18)
        for i, point in enumerate(points):
            offset = point - start
            share = np.clip(np.einsum("ij,ij->i", offset, along) / squared, 0.0, 1.0)
            gap = offset - share[:, None] * along
            best[i] = min(best[i], np.sqrt(np.einsum("ij,ij->i", gap, gap).min(initial=np.inf)))
            rims = np.hypot(*(point - self.circles[:, :2]).T) - self.circles[:, 2]
            best[i] = min(best[i], np.maximum(rims, 0.0).min(initial=np.inf))
        return best

    def with_start(self, start: Sequence[float], *, clearance_m: float = 0.0) -> FloorPlan:
        """Return the same plan with another start pose (x, y, θ), checked like the first.

        Raises
        ------
        FloorPlanError
            If the pose is not finite, not free, or nearer than ``clearance_m`` [m] to a surface.
        """
        try:
            pose = tuple(float(v) for v in start)
        except (TypeError, ValueError) as error:
            raise FloorPlanError(f"plan {self.name}: start must be three numbers x, y, θ") from error
        return dataclasses.replace(self, start=pose, start_clearance_m=clearance_m)  # type: ignore[arg-type]


def _part_nearest(cells: Flags, squared: Array) -> Flags:
    """Return the cells that hang together with the one of them whose squared distance is least."""
    _, labels = cv2.connectedComponents(cells.astype(np.uint8), connectivity=4)
    nearest = int(np.argmin(np.where(cells, squared, np.inf)))
    return np.asarray(cells & (labels == labels.flat[nearest]), np.bool_)


def _array(plan: FloorPlan, what: str, values: Array, columns: int) -> Array:
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.size == 0:
        array = array.reshape(0, columns)
    if array.ndim != 2 or array.shape[1] != columns:
        raise FloorPlanError(f"plan {plan.name}: {what} must have shape (n, {columns}), got {array.shape}")
    if not np.all(np.isfinite(array)):
        raise FloorPlanError(f"plan {plan.name}: {what} must be finite; remove the NaN or infinite coordinates")
    return array


def _convex(plan: FloorPlan, polygon: Array) -> Array:
    """Return a polygon ``(k, 2)`` counter-clockwise.

    Of one with a dent the robot would touch the hull, and the lidar see the dent.
    """
    if len(polygon) < 3:
        raise FloorPlanError(f"plan {plan.name}: a polygon needs at least 3 vertices")
    points = polygon.tolist()
    edges = [(bx - ax, by - ay) for (ax, ay), (bx, by) in zip(points, points[1:] + points[:1], strict=True)]
    lengths = [math.hypot(*edge) for edge in edges]
    if min(lengths) < _APART_M:
        raise FloorPlanError(f"plan {plan.name}: a polygon has two vertices in one place; leave one out")
    turns, bends = [], []  # at each vertex; how far off the line that passes it by
    for k, (ux, uy) in enumerate(edges):
        vx, vy = edges[k - 1]
        turns.append(math.atan2(vx * uy - vy * ux, vx * ux + vy * uy))
        bends.append(turns[-1] * min(lengths[k - 1], lengths[k]))
    turned = sum(turns)
    clockwise = turned < 0.0
    # A vertex may lie that far within the line of its neighbours, as rounding has it.
    dent = max(bends) if clockwise else -min(bends)
    once = abs(abs(turned) - 2.0 * math.pi) < 1e-6
    if not once or dent > _DENT_M or max(map(abs, turns)) > math.pi - 1e-6:
        raise FloorPlanError(f"plan {plan.name}: a polygon must be convex, of some area; give it in convex parts")
    return polygon[::-1].copy() if clockwise else polygon
