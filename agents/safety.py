"""The last check before a twist goes out: the body, braking from it, must come onto nothing.

Two witnesses are heard: the belief's map, and the newest scan, which the map may lag behind.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.cost_map import belief_classes, clearance
from mecanum_env.config import LidarConfig, RobotConfig
from slam.types import Belief

__all__ = ["LocalMap", "body_gaps", "footprint", "local_map", "scan_points"]

Array = NDArray[np.float64]

POSES = 8  # of a predicted motion, the present one included


@dataclass(frozen=True, eq=False)
class LocalMap:
    """Clearance around the robot: the distance [m] from each fine cell's centre to the nearest occupied edge."""

    clearance: NDArray[np.float32]  # (rows, cols) [m]
    origin: Array  # (2,) lower-left corner of cell (0, 0) in the belief's frame [m]
    resolution: float  # [m]

    def at(self, points: Array) -> Array:
        """Return the clearance [m] at points ``(n, 2)``; beyond the window that of its rim."""
        return _clearances(
            self.clearance, self.origin, self.resolution, np.atleast_2d(np.asarray(points, dtype=np.float64))
        )


def local_map(belief: Belief, radius_m: float) -> LocalMap:
    """Return the clearance within a square of this half side [m] around the robot."""
    grid = belief.grid
    resolution = grid.resolution
    row, col = grid.to_cells(np.asarray(belief.pose)[None, :2])[0]
    span = math.ceil(radius_m / resolution)
    low_r, high_r = np.clip([row - span, row + span + 1], 0, grid.shape[0])
    low_c, high_c = np.clip([col - span, col + span + 1], 0, grid.shape[1])
    if high_r <= low_r or high_c <= low_c:  # off the map: nothing is known to be near
        low_r, high_r, low_c, high_c = 0, 1, 0, 1
    origin = np.array([grid.origin[0] + low_c * resolution, grid.origin[1] + low_r * resolution])
    window = belief_classes(belief, slice(low_r, high_r), slice(low_c, high_c))
    return LocalMap(clearance(window, resolution), origin, resolution)


def footprint(robot: RobotConfig, spacing_m: float = 0.05) -> Array:
    """Return points ``(n, 2)`` [m] along the body's rim, in the body frame."""
    half_l, half_w = 0.5 * robot.length_m, 0.5 * robot.width_m
    along = np.linspace(-half_l, half_l, math.ceil(robot.length_m / spacing_m) + 1)
    across = np.linspace(-half_w, half_w, math.ceil(robot.width_m / spacing_m) + 1)[1:-1]
    sides = [np.stack([along, np.full_like(along, y)], axis=1) for y in (-half_w, half_w)]
    ends = [np.stack([np.full_like(across, x), across], axis=1) for x in (-half_l, half_l)]
    return np.ascontiguousarray(np.vstack(sides + ends))


def scan_points(observation: Mapping[str, Any] | None, lidar: LidarConfig, *, within_m: float = 2.0) -> Array:
    """Return what the scan in an observation hit ``(n, 2)`` [m], in the body frame; empty where there is none.

    Raises
    ------
    ValueError
        If the scan has another number of beams than the lidar.
    """
    if not isinstance(observation, Mapping) or "scan" not in observation:
        return np.zeros((0, 2))
    share = np.asarray(observation["scan"], dtype=np.float64)
    if share.shape != (lidar.beams,):
        raise ValueError(
            f"the scan has shape {share.shape}, the agent's lidar {lidar.beams} beams: "
            "give agents.make the environment's lidar"
        )
    ranges = share * lidar.range_max_m
    # Nothing returned at 1; a return below the least range is no return (NaN compares false).
    hit = (share < 1.0) & (ranges > lidar.range_min_m) & (ranges < within_m)
    angles = lidar.angle_min + lidar.angle_increment * np.flatnonzero(hit)
    return np.stack([lidar.offset_m + ranges[hit] * np.cos(angles), ranges[hit] * np.sin(angles)], axis=1)


@njit(cache=True, nogil=True)
def body_gaps(
    twist: Array,
    pose: Array,
    timing: Array,
    half: Array,
    rim: Array,
    field: NDArray[np.float32],
    origin: Array,
    resolution: float,
    hits: Array,
) -> tuple[float, float, float, float]:
    """Return gaps [m] between the body and what the map and the scan show: now and, at the least, braking.

    The twist ``(3,)`` is held for ``timing[0]`` [s], then shed at ``timing[1]`` [m/s²] and ``timing[2]``
    [rad/s²], whichever takes longer. ``half`` is half the length and width, ``rim`` points of the outline,
    ``hits`` scan points, all in the body frame.

    Returns
    -------
    tuple
        Gap to the map now, gap to the map ahead, gap to the scan now, gap to the scan ahead.
    """
    speed = math.hypot(twist[0], twist[1])
    braking = max(speed / timing[1], abs(twist[2]) / timing[2])
    total = timing[0] + braking
    map_now = map_ahead = scan_now = scan_ahead = np.inf
    x, y, theta = 0.0, 0.0, 0.0  # of the predicted body in the present body frame
    last = 0.0
    heading = pose[2]
    cos_b, sin_b = math.cos(heading), math.sin(heading)
    for k in range(POSES):
        t = total * k / (POSES - 1)
        # Distance covered so far, as seconds at the full twist: uniform braking after the hold.
        late = max(t - timing[0], 0.0)
        held = min(t, timing[0]) + (late - 0.5 * late * late / braking if braking > 0.0 else 0.0)
        dt, last = held - last, held
        middle = theta + 0.5 * dt * twist[2]
        x += dt * (math.cos(middle) * twist[0] - math.sin(middle) * twist[1])
        y += dt * (math.sin(middle) * twist[0] + math.cos(middle) * twist[1])
        theta += dt * twist[2]
        c, s = math.cos(theta), math.sin(theta)
        gap = np.inf
        for i in range(rim.shape[0]):
            bx, by = x + c * rim[i, 0] - s * rim[i, 1], y + s * rim[i, 0] + c * rim[i, 1]
            wx, wy = pose[0] + cos_b * bx - sin_b * by, pose[1] + sin_b * bx + cos_b * by
            gap = min(gap, _sample(field, origin, resolution, wx, wy))
        near = np.inf
        for i in range(hits.shape[0]):
            dx, dy = hits[i, 0] - x, hits[i, 1] - y
            out_x = abs(c * dx + s * dy) - half[0]
            out_y = abs(-s * dx + c * dy) - half[1]
            if out_x > 0.0 and out_y > 0.0:
                near = min(near, math.hypot(out_x, out_y))
            else:
                near = min(near, max(out_x, out_y))
        if k == 0:
            map_now, scan_now = gap, near
        else:
            map_ahead, scan_ahead = min(map_ahead, gap), min(scan_ahead, near)
    return map_now, map_ahead, scan_now, scan_ahead


@njit(cache=True, nogil=True)
def _sample(field: NDArray[np.float32], origin: Array, resolution: float, x: float, y: float) -> float:
    """Bilinear between cell centres; beyond the window the value at its rim."""
    rows, cols = field.shape
    u = min(max((x - origin[0]) / resolution - 0.5, 0.0), cols - 1.0)
    v = min(max((y - origin[1]) / resolution - 0.5, 0.0), rows - 1.0)
    col, row = min(int(u), max(cols - 2, 0)), min(int(v), max(rows - 2, 0))
    fu, fv = u - col, v - row
    next_c, next_r = min(col + 1, cols - 1), min(row + 1, rows - 1)
    low = field[row, col] * (1.0 - fu) + field[row, next_c] * fu
    high = field[next_r, col] * (1.0 - fu) + field[next_r, next_c] * fu
    return float(low * (1.0 - fv) + high * fv)


@njit(cache=True, nogil=True)
def _clearances(field: NDArray[np.float32], origin: Array, resolution: float, points: Array) -> Array:
    out = np.empty(points.shape[0])
    for i in range(points.shape[0]):
        out[i] = _sample(field, origin, resolution, points[i, 0], points[i, 1])
    return out
