"""Which corners and walls a lidar is expected to see from a place, and how well: by rays over the planning grid.

The accuracy is that of the straight lines that the estimators fit (:mod:`slam.features.extraction`): N beams of
noise σ on a piece of wall of length L give its offset to σ²/N and its slope to 12 σ² / (N L²); a corner is as good
as the beams are dense there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.ways.cost_map import CostMap, kind_at
from mecanum_env.config import LidarConfig
from slam.grids.occupancy import FREE
from slam.settings import Config, Length, Positive, Sigma
from slam.types import LINE, Array, Flags

__all__ = ["SensorModel", "expected_sightings"]

_NEAR = 0.05  # m: nearer than this nothing is seen
_STEP = 0.7  # cells: less than one, so that no wall is stepped over, diagonal ones included
_BLIND = 2.5  # cells before a surface, within which the grid's own drawing of it is met
_PIECE_M = 0.3  # between the points of a wall that are looked for
_MOST_PIECES = 40
_OUT_OF_REACH = 1.001  # of the range, the nearest point of a wall: nothing of it is in sight, roundings aside


@dataclass(frozen=True, kw_only=True)
class SensorModel(Config):
    """What is needed of the lidar beside its geometry."""

    range_sigma_m: Sigma = 0.01  # of one beam
    corner_share: Sigma = 0.5  # 1σ of a corner, as a share of the beams' spacing there
    corner_sigma_m: Sigma = 0.004  # … and what remains however near it is
    wall_length_m: Length = 0.6  # least of a wall to be taken for one
    wall_beams: Positive = 10.0
    wall_sigma_m: Sigma = 0.0002  # that straight walls are not
    wall_sigma_rad: Sigma = 0.00005


def expected_sightings(
    cost_map: CostMap, poses: Array, marks: Array, kinds: Array, ends: Array, *, lidar: LidarConfig,
    model: SensorModel, most: int,
) -> tuple[Flags, Array]:  # fmt: skip
    """Return what is seen from each pose, and how well.

    Parameters
    ----------
    cost_map : CostMap
        The planning grid: sight goes through what is free.
    poses : Array
        Of the robot ``(k, 3)``.
    marks, kinds, ends : Array
        Corners x, y [m] and walls α [rad], r [m] ``(m, 2)``, ``LINE`` for walls ``(m,)``, and the walls' ends
        ``(m, 4)`` [m].
    most : int
        Landmarks that are seen from one pose at most: the first.

    Returns
    -------
    tuple
        ``(k, m)``, and per sighting σ²ρ, σρφ, σ²φ ``(k, m, 3)`` [m², m·rad, rad²] of range and bearing, for walls
        of the distance and bearing of their foot.
    """
    seen = np.zeros((len(poses), len(marks)), dtype=np.bool_)
    cov = np.zeros((len(poses), len(marks), 3))
    half_view = math.pi if lidar.field_of_view_deg >= 360.0 else math.radians(0.5 * lidar.field_of_view_deg)
    limits = np.array([
        lidar.offset_m, lidar.range_max_m, half_view, lidar.angle_increment, model.range_sigma_m,
        model.corner_share, model.corner_sigma_m, model.wall_length_m, model.wall_beams, model.wall_sigma_m,
        model.wall_sigma_rad,
    ])  # fmt: skip
    frame = np.array([*cost_map.origin, cost_map.resolution])
    _look_round(cost_map.classes, frame, np.asarray(poses), marks, kinds, ends, limits, most, seen, cov)
    return seen, cov


@njit(cache=True, nogil=True, error_model="numpy")
def _look_round(
    classes: NDArray[np.int8], frame: Array, poses: Array, marks: Array, kinds: Array, ends: Array, limits: Array,
    most: int, seen: Flags, cov: Array,
) -> None:  # fmt: skip
    sensor = np.empty(3)
    for k in range(poses.shape[0]):
        sensor[0] = poses[k, 0] + limits[0] * math.cos(poses[k, 2])
        sensor[1] = poses[k, 1] + limits[0] * math.sin(poses[k, 2])
        sensor[2] = poses[k, 2]
        count = 0
        for i in range(marks.shape[0]):
            if count == most:
                break
            if kinds[i] == LINE:
                seen[k, i] = _sees_wall(classes, frame, sensor, marks[i], ends[i], limits, cov[k, i])
            else:
                seen[k, i] = _sees_corner(classes, frame, sensor, marks[i], limits, cov[k, i])
            count += seen[k, i]


@njit(cache=True, nogil=True, error_model="numpy")
def _sees_corner(
    classes: NDArray[np.int8], frame: Array, sensor: Array, mark: Array, limits: Array, out: Array
) -> bool:
    if not _sees(classes, frame, sensor, mark[0], mark[1], limits):
        return False
    rho = math.hypot(mark[0] - sensor[0], mark[1] - sensor[1])
    variance = (limits[5] * rho * limits[3]) ** 2 + limits[6] ** 2
    out[0], out[1], out[2] = variance, 0.0, variance / (rho * rho)
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _sees_wall(
    classes: NDArray[np.int8], frame: Array, sensor: Array, mark: Array, ends: Array, limits: Array, out: Array
) -> bool:
    """Tell whether a piece of a wall, long enough, is in sight, and write how well that tells the wall."""
    nx, ny = math.cos(mark[0]), math.sin(mark[0])
    away = mark[1] - nx * sensor[0] - ny * sensor[1]
    if away < _NEAR or away > limits[1]:  # behind it, or on it
        return False
    length = math.hypot(ends[2] - ends[0], ends[3] - ends[1])
    count = min(max(int(length / _PIECE_M), 2), _MOST_PIECES)
    # Along the wall from the foot of the sensor's perpendicular.
    start = -ny * (ends[0] - sensor[0]) + nx * (ends[1] - sensor[1])
    step = (-ny * (ends[2] - ends[0]) + nx * (ends[3] - ends[1])) / count
    end = start + count * step
    beside = min(abs(start), abs(end)) if start * end > 0.0 else 0.0
    if math.hypot(away, beside) > _OUT_OF_REACH * limits[1]:
        return False
    best_from, best_to, run = 0, -1, 0
    for j in range(count + 1):
        share = j / count
        px, py = ends[0] + share * (ends[2] - ends[0]), ends[1] + share * (ends[3] - ends[1])
        run = run + 1 if _sees(classes, frame, sensor, px, py, limits) else 0
        if run > best_to - best_from + 1:
            best_from, best_to = j - run + 1, j
    seen_m = (best_to - best_from) * length / count
    if seen_m < limits[7]:
        return False
    low, high = start + best_from * step, start + best_to * step
    beams = abs(math.atan2(high, away) - math.atan2(low, away)) / limits[3]
    if beams < limits[8]:
        return False
    middle = 0.5 * (low + high)
    sigma = limits[4] * away / math.hypot(away, middle)  # noise acts along the beam
    slope = 12.0 * sigma * sigma / (beams * seen_m * seen_m)
    out[0] = sigma * sigma / beams + middle * middle * slope + limits[9] ** 2
    out[1] = middle * slope
    out[2] = slope + limits[10] ** 2
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _sees(classes: NDArray[np.int8], frame: Array, sensor: Array, x: float, y: float, limits: Array) -> bool:
    """Tell whether the way from the sensor to a point of a surface is free, up to the surface's own drawing."""
    dx, dy = x - sensor[0], y - sensor[1]
    rho = math.hypot(dx, dy)
    if not _NEAR < rho < limits[1]:
        return False
    if limits[2] < math.pi:
        off = math.atan2(dy, dx) - sensor[2]
        if abs(math.atan2(math.sin(off), math.cos(off))) > limits[2]:
            return False
    column, row = (sensor[0] - frame[0]) / frame[2], (sensor[1] - frame[1]) / frame[2]
    reach = rho / frame[2]
    dx, dy = dx / rho, dy / rho
    at = 0.0
    while at < reach:
        kind = kind_at(classes, math.floor(row + at * dy), math.floor(column + at * dx))
        if kind != FREE and at < reach - _BLIND:
            return False
        at += _STEP
    return True
