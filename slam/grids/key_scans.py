"""Key scans: what the map is redrawn from when the filter corrects the past.

A grid is drawn from poses that the filter later corrects. Each key scan therefore hangs on the landmarks that
were seen with it: where those have moved, the scan's pose moves along (least squares over SE(2)), and once a
key scan would be drawn more than half a cell from where it was, the map is redrawn from all of them. So a
closed loop mends the map instead of doubling its walls.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.geometry import wrap_scalar
from slam.grids.occupancy import OccupancyGrid
from slam.types import Scan

__all__ = ["KeyScanConfig", "KeyScans"]

Array = NDArray[np.float64]

_ANCHORS = 8  # landmarks that a key scan hangs on, at most


@dataclass(frozen=True, kw_only=True)
class KeyScanConfig:
    """When a scan is kept, and when the map is redrawn."""

    spacing_m: float = 0.2
    spacing_rad: float = 0.25
    check_every: int = 20  # updates between two looks at the landmarks
    lever_m: float = 4.0  # distance at which a turn of a key scan counts as a shift [m]


class KeyScans:
    """The scans a map can be redrawn from, each with its pose and the landmarks it hangs on."""

    def __init__(self, config: KeyScanConfig | None = None) -> None:
        self.config = config or KeyScanConfig()
        self._scans: list[tuple[Scan, NDArray[np.int16]]] = []
        self._poses = np.zeros((64, 3))  # of the sensor, as last drawn
        self._anchor_ids = np.full((64, _ANCHORS), -1, np.int64)
        self._anchor_local = np.zeros((64, _ANCHORS, 2))  # in the frame of that pose
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

    def keep(
        self, sensor_pose: Array, scan: Scan, surface: NDArray[np.int16], ids: NDArray[np.int64], points: Array
    ) -> None:
        """Keep a scan; ``ids`` and ``points`` ``(k, 2)`` are the landmarks seen with it, as estimated then."""
        n = len(self._scans)
        if n == len(self._poses):
            self._poses = np.vstack([self._poses, np.zeros_like(self._poses)])
            self._anchor_ids = np.vstack([self._anchor_ids, np.full_like(self._anchor_ids, -1)])
            self._anchor_local = np.vstack([self._anchor_local, np.zeros_like(self._anchor_local)])
        _hang(sensor_pose, ids, points, n, self._poses, self._anchor_ids, self._anchor_local)
        self._last = (float(sensor_pose[0]), float(sensor_pose[1]), float(sensor_pose[2]))
        self._scans.append((scan, surface.copy()))

    def due(self) -> bool:
        """Count an update; tell whether it is time to look at the landmarks again."""
        self._since_check += 1
        if self._since_check < self.config.check_every:
            return False
        # A redraw costs as much as there are key scans: the longer the journey, the rarer the look.
        n = len(self._scans)
        return self._since_check >= n // 8 and n >= 2

    def redraw_if_moved(self, grid: OccupancyGrid, landmarks: Array, row_of_id: NDArray[np.int64]) -> bool:
        """Redraw ``grid`` if a landmark's correction moved a key scan by more than half a cell; tell whether.

        ``landmarks`` ``(n, 2)`` are the current estimates, ``row_of_id`` maps a landmark's id to its row, or -1.
        """
        n = len(self._scans)
        self._since_check = 0
        corrected = np.empty((n, 3))
        largest = _corrected_poses(
            self._poses[:n], self._anchor_ids, self._anchor_local, landmarks, row_of_id, self.config.lever_m,
            corrected,
        )  # fmt: skip
        if largest <= 0.5 * grid.resolution:
            return False
        self._poses[:n] = corrected
        self._last = tuple(corrected[-1].tolist())
        grid.redraw(corrected, self._scans)
        return True

    def put_back(self, grid: OccupancyGrid, poses: Array) -> None:
        """Keep only as many scans as there are sensor poses ``(n, 3)``, the first ones, and redraw ``grid``."""
        n = len(poses)
        del self._scans[n:]
        self._poses[:n] = poses
        self._anchor_ids[n:] = -1
        self._last = tuple(poses[-1].tolist()) if n else (0.0, 0.0, 0.0)
        grid.redraw(poses, self._scans)


@njit(cache=True, nogil=True, error_model="numpy")
def _hang(
    sensor_pose: Array, ids: NDArray[np.int64], points: Array, n: int, poses: Array,
    anchor_ids: NDArray[np.int64], anchor_local: Array,
) -> None:  # fmt: skip
    """Write the n-th key scan's pose, and its landmarks in that pose's frame."""
    poses[n] = sensor_pose
    c, s = math.cos(sensor_pose[2]), math.sin(sensor_pose[2])
    for k in range(min(ids.shape[0], anchor_ids.shape[1])):
        dx, dy = points[k, 0] - sensor_pose[0], points[k, 1] - sensor_pose[1]
        anchor_ids[n, k] = ids[k]
        anchor_local[n, k, 0], anchor_local[n, k, 1] = c * dx + s * dy, -s * dx + c * dy


@njit(cache=True, nogil=True, error_model="numpy")
def _corrected_poses(
    poses: Array, ids: NDArray[np.int64], local: Array, landmarks: Array, row_of_id: NDArray[np.int64],
    lever: float, out: Array,
) -> float:  # fmt: skip
    """Write each key scan's pose as its landmarks now have it; return the largest shift [m]."""
    largest = 0.0
    dx = dy = dtheta = 0.0  # the correction of the last scan with enough landmarks: its neighbours share it
    for k in range(poses.shape[0]):
        count = 0
        ax = ay = bx = by = 0.0
        for a in range(ids.shape[1]):
            if ids[k, a] < 0 or row_of_id[ids[k, a]] < 0:
                continue
            row = row_of_id[ids[k, a]]
            ax, ay = ax + local[k, a, 0], ay + local[k, a, 1]
            bx, by = bx + landmarks[row, 0], by + landmarks[row, 1]
            count += 1
        solved = False
        if count >= 2:
            ax, ay, bx, by = ax / count, ay / count, bx / count, by / count
            cos_sum = sin_sum = spread = 0.0
            for a in range(ids.shape[1]):
                if ids[k, a] < 0 or row_of_id[ids[k, a]] < 0:
                    continue
                row = row_of_id[ids[k, a]]
                px, py = local[k, a, 0] - ax, local[k, a, 1] - ay
                qx, qy = landmarks[row, 0] - bx, landmarks[row, 1] - by
                cos_sum += px * qx + py * qy
                sin_sum += px * qy - py * qx
                spread += px * px + py * py
            # Landmarks closer together than some two metres say too little about the heading.
            if spread > 2.0:
                theta = math.atan2(sin_sum, cos_sum)
                c, s = math.cos(theta), math.sin(theta)
                dx = bx - (c * ax - s * ay) - poses[k, 0]
                dy = by - (s * ax + c * ay) - poses[k, 1]
                dtheta = wrap_scalar(theta - poses[k, 2])
                solved = True
        out[k, 0], out[k, 1] = poses[k, 0] + dx, poses[k, 1] + dy
        out[k, 2] = wrap_scalar(poses[k, 2] + dtheta)
        if solved:
            largest = max(largest, math.sqrt(dx * dx + dy * dy) + abs(dtheta) * lever)
    return largest
