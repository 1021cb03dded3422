"""Key scans: what the map is redrawn from when the filter corrects the past.

A grid is drawn from poses that the filter later corrects. Each key scan therefore hangs on the landmarks that
were seen with it, points and walls: where those have moved, the scan's pose moves along (least squares over
SE(2)), and once a key scan would be drawn more than half a cell from where it was, the map is redrawn from all of
them. So a closed loop mends the map instead of doubling its walls. What the landmarks of a scan leave open, as the
way along a single wall, follows the scan before it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.geometry import wrap, wrap_scalar
from slam.grids.occupancy import OccupancyGrid
from slam.settings import Config, Gap, Within
from slam.types import Array, Scan

__all__ = ["KeyScanConfig", "KeyScans", "largest_shift"]

_ANCHORS = 12  # landmarks that a key scan hangs on, at most

_RECENT = 100  # key scans, some 20 m of way

# How well a key scan hangs on what: weights are σ⁻², σ in m and rad.
_POINT = 0.02**-2  # a point, or how far off a wall is
_TURN = 0.005**-2  # the direction of a wall
_NEIGHBOUR_SHIFT, _NEIGHBOUR_TURN = 0.1**-2, 0.02**-2  # what moved the key scan before it


@dataclass(frozen=True, kw_only=True)
class KeyScanConfig(Config):
    """When a scan is kept, and when the map is redrawn."""

    spacing_m: Gap = 0.2
    spacing_rad: Gap = 0.25
    check_every: Annotated[int, Within("[1, 1000000000]")] = 20  # updates between two looks at the landmarks
    lever_m: Gap = 4.0  # distance at which a turn of a key scan counts as a shift [m]


class KeyScans:
    """The scans a map can be redrawn from, each with its pose and the landmarks it hangs on."""

    def __init__(self, config: KeyScanConfig | None = None) -> None:
        self.config = config or KeyScanConfig()
        self._scans: list[tuple[Scan, NDArray[np.int16]]] = []
        self._poses = np.zeros((64, 3))  # of the sensor, as last drawn
        self._variances = np.zeros(64)  # [m²] of where the beams ended, when the scan was taken
        self._anchor_ids = np.full((64, _ANCHORS), -1, np.int64)
        self._anchor_local = np.zeros((64, _ANCHORS, 3))  # in that pose's frame: x, y, 0, or α, r, 1
        self._since_check = 0
        self._last = (0.0, 0.0, 0.0)
        self._cos_spacing = math.cos(min(self.config.spacing_rad, math.pi))

    def __len__(self) -> int:
        return len(self._scans)

    @property
    def poses(self) -> Array:
        """Sensor poses ``(n, 3)`` of the key scans as they were last drawn."""
        return self._poses[: len(self._scans)].copy()

    def wants(self, x: float, y: float, theta: float) -> bool:
        """Tell whether a scan from this sensor pose should be kept: it has moved on since the last one."""
        n = len(self._scans)
        if n == 0:
            return True
        last_x, last_y, last_theta = self._last
        config = self.config
        return (
            math.hypot(x - last_x, y - last_y) >= config.spacing_m
            or math.cos(theta - last_theta) <= self._cos_spacing
        )

    def old_variance(self, x: float, y: float, radius_m: float) -> float:
        """Return the variance [m²] of the least sure old key scan within a radius of a place; 0 without one.

        Old are all but the last hundred: beside those the robot knows where it is, unsure as both may be.
        """
        n = max(len(self._scans) - _RECENT, 0)
        near = np.hypot(self._poses[:n, 0] - x, self._poses[:n, 1] - y) <= radius_m
        return float(self._variances[:n][near].max(initial=0.0))

    def keep(
        self, sensor_pose: Array, scan: Scan, surface: NDArray[np.int16], ids: NDArray[np.int64], marks: Array,
        variance: float = 0.0,
    ) -> None:  # fmt: skip
        """Keep a scan, and what was seen with it.

        ``ids`` are the landmarks; ``marks`` ``(k, 3)`` are x, y, 0 of a point as it is now, or α, r, 1 of a wall.
        ``variance`` [m²] is that of where its beams ended.
        """
        n = len(self._scans)
        if n == len(self._poses):
            self._poses = np.vstack([self._poses, np.zeros_like(self._poses)])
            self._variances = np.concatenate([self._variances, np.zeros_like(self._variances)])
            self._anchor_ids = np.vstack([self._anchor_ids, np.full_like(self._anchor_ids, -1)])
            self._anchor_local = np.vstack([self._anchor_local, np.zeros_like(self._anchor_local)])
        _hang(sensor_pose, ids, marks, n, self._poses, self._anchor_ids, self._anchor_local)
        self._variances[n] = variance
        self._last = (float(sensor_pose[0]), float(sensor_pose[1]), float(sensor_pose[2]))
        self._scans.append((scan.kept(), surface.copy()))

    def due(self) -> bool:
        """Count an update; tell whether it is time to look at the landmarks again."""
        self._since_check += 1
        if self._since_check < self.config.check_every:
            return False
        # A redraw costs as much as there are key scans: the longer the journey, the rarer the look.
        n = len(self._scans)
        return self._since_check >= n // 8 and n >= 2

    def redraw_if_moved(
        self, grid: OccupancyGrid, landmarks: Array, row_of_id: NDArray[np.int64], others: Sequence[KeyScans] = ()
    ) -> bool:
        """Redraw ``grid`` if a landmark's correction moved a key scan by more than half a cell; tell whether.

        ``landmarks`` ``(n, 2)`` are the current estimates, of points x, y and of walls α, r; ``row_of_id`` maps a
        landmark's id to its row, or -1. ``others`` are key scans of other robots, drawn into the same grid.
        """
        everyone = (self, *others)
        corrected = [k._corrected(landmarks, row_of_id) for k in everyone]
        if max(largest for _, largest in corrected) <= 0.5 * grid.resolution:
            return False
        for scans, (poses, _) in zip(everyone, corrected, strict=True):
            scans._poses[: len(poses)] = poses
            if len(poses):
                scans._last = tuple(poses[-1].tolist())
        grid.redraw(np.concatenate([poses for poses, _ in corrected]), [s for k in everyone for s in k._scans])
        return True

    def _corrected(self, landmarks: Array, row_of_id: NDArray[np.int64]) -> tuple[Array, float]:
        """Return where the key scans ``(n, 3)`` should be drawn, and by how much [m] one moved most."""
        n = len(self._scans)
        self._since_check = 0
        corrected = np.empty((n, 3))
        largest = _corrected_poses(
            self._poses[:n], self._anchor_ids, self._anchor_local, landmarks, row_of_id, self.config.lever_m,
            corrected,
        )  # fmt: skip
        return corrected, largest

    def put_back(self, grid: OccupancyGrid, poses: Array) -> None:
        """Keep only as many scans as there are sensor poses ``(n, 3)``, the first ones, and redraw ``grid``."""
        n = len(poses)
        del self._scans[n:]
        self._poses[:n] = poses
        self._anchor_ids[n:] = -1
        self._last = tuple(poses[-1].tolist()) if n else (0.0, 0.0, 0.0)
        grid.redraw(poses, self._scans)


def largest_shift(poses: Array, drawn: Array, lever_m: float) -> float:
    """Return how far [m] the farthest of poses ``(n, 3)`` is from where it was drawn; 0 where there are none."""
    off = np.hypot(*(poses - drawn)[:, :2].T) + np.abs(wrap(poses[:, 2] - drawn[:, 2])) * lever_m
    return float(off.max(initial=0.0))


@njit(cache=True, nogil=True, error_model="numpy")
def _hang(
    sensor_pose: Array, ids: NDArray[np.int64], marks: Array, n: int, poses: Array,
    anchor_ids: NDArray[np.int64], anchor_local: Array,
) -> None:  # fmt: skip
    """Write the n-th key scan's pose, and its landmarks in that pose's frame."""
    x, y, theta = sensor_pose
    poses[n, 0], poses[n, 1], poses[n, 2] = x, y, theta
    c, s = math.cos(theta), math.sin(theta)
    for k in range(min(ids.shape[0], anchor_ids.shape[1])):
        anchor_ids[n, k] = ids[k]
        u, v, wall = marks[k]
        anchor_local[n, k, 2] = wall
        if wall:
            anchor_local[n, k, 0], anchor_local[n, k, 1] = u - theta, v - x * math.cos(u) - y * math.sin(u)
        else:
            dx, dy = u - x, v - y
            anchor_local[n, k, 0], anchor_local[n, k, 1] = c * dx + s * dy, -s * dx + c * dy


@njit(cache=True, nogil=True, error_model="numpy")
def _corrected_poses(
    poses: Array, ids: NDArray[np.int64], local: Array, landmarks: Array, row_of_id: NDArray[np.int64],
    lever: float, out: Array,
) -> float:  # fmt: skip
    """Write each key scan's pose as its landmarks now have it; return the largest shift [m]."""
    normals = np.empty((landmarks.shape[0], 2))  # of those that are walls
    for i in range(landmarks.shape[0]):
        normals[i, 0], normals[i, 1] = math.cos(landmarks[i, 0]), math.sin(landmarks[i, 0])
    largest = 0.0
    shift_x = shift_y = turn = 0.0  # of the scan before
    for k in range(poses.shape[0]):
        expected = poses[k, 0] + shift_x, poses[k, 1] + shift_y, poses[k, 2] + turn
        x, y, theta = expected
        for _ in range(2):  # Gauss-Newton; turns are small
            dx, dy, dt = _step(x, y, theta, expected, k, ids, local, landmarks, normals, row_of_id)
            x, y, theta = x + dx, y + dy, theta + dt
        shift_x, shift_y, turn = x - poses[k, 0], y - poses[k, 1], theta - poses[k, 2]
        out[k, 0], out[k, 1], out[k, 2] = x, y, wrap_scalar(theta)
        largest = max(largest, math.hypot(shift_x, shift_y) + abs(turn) * lever)
    return largest


@njit(nogil=True, error_model="numpy", forceinline=True)
def _step(
    x: float, y: float, theta: float, expected: tuple[float, float, float], k: int, ids: NDArray[np.int64],
    local: Array, landmarks: Array, normals: Array, row_of_id: NDArray[np.int64],
) -> tuple[float, float, float]:  # fmt: skip
    """Return the step from the k-th key scan's pose to where its landmarks, and the scan before it, want it."""
    c, s = math.cos(theta), math.sin(theta)
    # The normal equations' upper triangle and right-hand side, at first of the scan before it alone.
    xx = yy = _NEIGHBOUR_SHIFT
    tt = _NEIGHBOUR_TURN
    xy = xt = yt = 0.0
    bx, by, bt = xx * (expected[0] - x), yy * (expected[1] - y), tt * (expected[2] - theta)
    for a in range(ids.shape[1]):
        row = row_of_id[ids[k, a]] if ids[k, a] >= 0 else -1
        if row < 0:
            continue
        u, v, local_u, local_v = landmarks[row, 0], landmarks[row, 1], local[k, a, 0], local[k, a, 1]
        if local[k, a, 2]:
            nx, ny = normals[row, 0], normals[row, 1]
            turn = wrap_scalar(u - theta - local_u)
            if abs(turn) > 0.5 * math.pi:  # the wall passed the map's origin: the other normal
                u, v, turn = u + math.pi, -v, wrap_scalar(turn + math.pi)
                nx, ny = math.cos(u), math.sin(u)
            off = v - nx * x - ny * y - local_v
            xx, xy, yy = xx + _POINT * nx * nx, xy + _POINT * nx * ny, yy + _POINT * ny * ny
            bx, by = bx + _POINT * nx * off, by + _POINT * ny * off
            tt, bt = tt + _TURN, bt + _TURN * turn
        else:
            px, py = c * local_u - s * local_v, s * local_u + c * local_v
            ex, ey = u - x - px, v - y - py
            xx, yy, tt = xx + _POINT, yy + _POINT, tt + _POINT * (px * px + py * py)
            xt, yt = xt - _POINT * py, yt + _POINT * px
            bx, by, bt = bx + _POINT * ex, by + _POINT * ey, bt + _POINT * (px * ey - py * ex)
    # Solved by elimination of x and then y; the matrix is positive definite.
    f, g = xy / xx, xt / xx
    yy, yt, by = yy - f * xy, yt - f * xt, by - f * bx
    tt, bt = tt - g * xt, bt - g * bx
    h = yt / yy
    turn = (bt - h * by) / (tt - h * yt)
    dy = (by - yt * turn) / yy
    return (bx - xy * dy - xt * turn) / xx, dy, turn
