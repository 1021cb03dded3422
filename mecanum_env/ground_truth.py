"""The truth of an episode, for metrics and drawing only: nothing of it reaches an observation or an agent."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from mecanum_env.config import LidarConfig, NoiseConfig, RobotConfig
from mecanum_env.rooms.floor_plan import FloorPlan, FloorPlanError
from mecanum_env.sensing.sensors import Lidar
from slam.geometry import compose, inverse, transform_points, wrap_scalar
from slam.grids.occupancy import FREE, OccupancyGrid
from slam.types import Array, Flags, Indices, Scan

__all__ = ["Coverage", "GroundTruth"]

_VIEW_SPACING_M = 0.8  # side of squares, or less: from one cell in each all is seen. A quarter finds 0.3 % more
_VIEW_BEAMS = 360
_MOST_CELLS = 30_000_000  # of the rasters: some 70 bytes each while they are made


class GroundTruth:
    """A floor plan as the start frame has it: what can be mapped, and what a perfect map would be.

    Parameters
    ----------
    plan : FloorPlan
        In the world frame.
    start : Array
        Start pose ``(3,)`` in the world frame; the belief's frame is this pose's.
    resolution : float
        Of the rasters [m]; they lie on the same lattice as the belief's grid.

    Attributes
    ----------
    mappable : NDArray[np.bool_]
        Free cells that the lidar can see from the places the robot can reach, on the lattice.
    walls : NDArray[np.bool_]
        Cells with a surface in them, next to a mappable cell.
    lattice_origin : tuple[int, int]
        Lattice row and column of either raster's cell (0, 0).
    """

    def __init__(
        self, plan: FloorPlan, start: Array, *, robot: RobotConfig, lidar: LidarConfig, resolution: float
    ) -> None:
        _check_size(plan, resolution)
        self.plan = plan
        self.start = np.asarray(start, dtype=np.float64)
        heading = float(self.start[2])
        self._frame = np.array([*self.start, math.cos(heading), math.sin(heading)])
        self.resolution = resolution
        seen = self._view_from_everywhere(robot, lidar)
        self.lattice_origin = seen.lattice_origin
        free = plan.is_free(transform_points(self.start, seen.centres())).reshape(seen.shape)
        self.mappable = np.asarray((seen.classes() == FREE) & free)
        self.mappable_cells = max(int(np.count_nonzero(self.mappable)), 1)
        near = cv2.dilate(self.mappable.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        self.walls = self._surfaces(seen) & near

    @property
    def corners(self) -> Array:
        """True corners ``(n, 2)`` [m] in the start frame."""
        return transform_points(inverse(self.start), self.plan.corners)

    def in_start_frame(self, pose_world: Array) -> Array:
        """Return a world pose ``(3,)`` in the start frame."""
        out = np.empty(3)
        _in_frame(pose_world, self._frame, out)
        return out

    def _view_from_everywhere(self, robot: RobotConfig, lidar: LidarConfig) -> OccupancyGrid:
        """Map the plan without noise from all over the places that the robot's body can reach."""
        plan = self.plan
        here = plan.reachable(robot.inscribed_radius_m, self.start)
        spacing = min(_VIEW_SPACING_M, lidar.range_max_m)
        cells = _one_a_block(here, max(round(spacing / plan.resolution), 1))
        views = (cells[:, ::-1] + 0.5) * plan.resolution + np.array(plan.origin)
        views = np.vstack([views, self.start[:2]])
        grid = OccupancyGrid(self.resolution)
        to_start = inverse(self.start)
        all_round = LidarConfig(beams=_VIEW_BEAMS, range_min_m=0.0, range_max_m=lidar.range_max_m, offset_m=0.0)
        eye = Lidar(all_round, NoiseConfig())
        for x, y in views:
            pose = np.array([x, y, self.start[2]])
            ranges = eye.true_ranges(plan.segments, plan.circles, pose)
            scan = Scan(ranges, all_round.angle_min, all_round.angle_increment, all_round.range_max_m)
            grid.integrate(compose(to_start, pose), scan)
            grid.take_changes()
        return grid

    def _surfaces(self, grid: OccupancyGrid) -> Flags:
        """Rasterise every surface on the lattice of ``grid``."""
        raster = np.zeros(grid.shape, np.uint8)
        to_start = inverse(self.start)
        ends = transform_points(to_start, self.plan.segments.reshape(-1, 2))
        scale, corner = 16.0, np.array(self.lattice_origin[::-1])
        pixels = (ends / self.resolution - corner - 0.5) * scale
        for a, b in np.round(pixels).astype(np.int32).reshape(-1, 2, 2):
            cv2.line(raster, a.tolist(), b.tolist(), 1, 1, cv2.LINE_8, 4)
        centres = transform_points(to_start, self.plan.circles[:, :2]) / self.resolution
        centres = (centres - corner - 0.5) * scale
        for (x, y), radius in zip(np.round(centres).astype(int).tolist(), self.plan.circles[:, 2], strict=True):
            cv2.circle(raster, (x, y), round(radius / self.resolution * scale), 1, 1, cv2.LINE_8, 4)
        return raster > 0


class Coverage:
    """Share of the mappable cells that a belief's grid rightly has as free, kept up from its changes.

    Attributes
    ----------
    changes : NDArray[np.int32] or None
        What the last update was told of, as :meth:`OccupancyGrid.take_changes` has it; None after a redraw.
    """

    changes: NDArray[np.int32] | None

    def __init__(self, truth: GroundTruth) -> None:
        self._truth = truth
        self._revision = -1
        self._right = 0

    def update(self, grid: OccupancyGrid) -> float:
        """Return the coverage in [0, 1] after the grid's latest changes."""
        row0, col0 = self._truth.lattice_origin
        changes = grid.take_changes()
        self.changes = changes
        if grid.revision != self._revision:
            self._revision, self.changes = grid.revision, None
            free = on_lattice(grid.classes() == FREE, grid.lattice_origin, self._truth)
            self._right = int(np.count_nonzero(free & self._truth.mappable))
        else:
            self._right += _count_right(changes, self._truth.mappable, row0, col0)
        return self._right / self._truth.mappable_cells


def on_lattice(raster: Flags, origin: tuple[int, int], truth: GroundTruth, margin: int = 0) -> Flags:
    """Return a raster of the belief's lattice cut or padded to the truth's, with a margin of cells around it."""
    rows, cols = truth.mappable.shape
    out = np.zeros((rows + 2 * margin, cols + 2 * margin), bool)
    r = origin[0] - truth.lattice_origin[0] + margin
    c = origin[1] - truth.lattice_origin[1] + margin
    r0, c0 = max(r, 0), max(c, 0)
    r1, c1 = min(r + raster.shape[0], out.shape[0]), min(c + raster.shape[1], out.shape[1])
    if r0 < r1 and c0 < c1:
        out[r0:r1, c0:c1] = raster[r0 - r : r1 - r, c0 - c : c1 - c]
    return out


def _one_a_block(mask: Flags, side: int) -> Indices:
    """Return for each block of ``side`` × ``side`` cells that has any the one nearest its middle: rows, columns.

    Of cells at the same distance it is the first by row, then by column.
    """
    rows, cols = (math.ceil(size / side) for size in mask.shape)
    padded = np.zeros((rows * side, cols * side), np.bool_)
    padded[: mask.shape[0], : mask.shape[1]] = mask
    r, c = np.divmod(np.arange(side * side), side)
    order = np.argsort((r - side // 2) ** 2 + (c - side // 2) ** 2, kind="stable")
    inside = padded.reshape(rows, side, cols, side).swapaxes(1, 2).reshape(rows, cols, -1)[..., order]
    blocks = np.argwhere(inside.any(axis=2))
    nearest = order[inside.argmax(axis=2)[tuple(blocks.T)]]
    return np.asarray(blocks * side + np.stack([r[nearest], c[nearest]], axis=1), np.int64)


def _check_size(plan: FloorPlan, resolution: float) -> None:
    rows, cols = (side * plan.resolution for side in plan.free.shape)
    if not rows * cols <= _MOST_CELLS * resolution**2:
        raise FloorPlanError(
            f"plan {plan.name!r} is {cols:.0f} m by {rows:.0f} m, more than {_MOST_CELLS // 10**6} million cells "
            f"of {resolution:g} m; give a coarser grid_resolution_m, or correct the plan's resolution"
        )


@njit(cache=True, nogil=True, error_model="numpy")
def _in_frame(pose: Array, frame: Array, out: Array) -> None:
    """Write a pose ``(3,)`` in a frame: x, y, θ of its origin, and θ's cosine and sine ``(5,)``."""
    dx, dy, c, s = pose[0] - frame[0], pose[1] - frame[1], frame[3], frame[4]
    out[0], out[1], out[2] = c * dx + s * dy, -s * dx + c * dy, wrap_scalar(pose[2] - frame[2])


@njit(cache=True, nogil=True, error_model="numpy")
def _count_right(changes: NDArray[np.int32], mappable: Flags, row0: int, col0: int) -> int:
    total = 0
    for k in range(changes.shape[0]):
        r, c = changes[k, 0] - row0, changes[k, 1] - col0
        if 0 <= r < mappable.shape[0] and 0 <= c < mappable.shape[1] and mappable[r, c]:
            if changes[k, 3] == FREE:
                total += 1
            if changes[k, 2] == FREE:
                total -= 1
    return total
