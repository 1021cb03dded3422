"""The last check before a twist goes out: the body, braking from it, must come onto nothing.

Two witnesses are heard: the belief's map, and the newest scan, which the map may lag behind. And each of two
robots keeps to its own side of what parts them (:mod:`agents.driving.sides`): both can brake, whatever they do.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.ways.cost_map import clearance
from mecanum_env.config import LidarConfig, RobotConfig
from slam.belief import Belief
from slam.types import Array, Floats

__all__ = [
    "Guard", "LocalMap", "body_gaps", "clearance_at", "escape_twist", "footprint", "local_map", "safe_twist",
    "scan_points", "scan_shares",
]  # fmt: skip

_SCAN_WITHIN_M = 2.0
_POSES = 8  # of a predicted motion at least, the present one included
_APART_M = 0.1  # between two of them at most: farther, the rim steps over a post of one cell and the gaps to it
_MOST_POSES = 1000  # a body that takes minutes to stop turning is not worth more
_SPEEDS = (1.0, 0.7, 0.45, 0.25, 0.1)  # shares of the wanted twist that are tried
_SIDESTEPS = (0.6, -0.6, 1.2, -1.2)  # [rad] off the wanted direction, tried after that
_SIDESTEP_M_S = 0.12
_ESCAPE_M_S = 0.1  # along any of 16 directions, where nothing else goes, …
_ESCAPE_RAD_S = (-0.4, -0.1, 0.0, 0.1, 0.4)  # … turning so
_SLACK_M = 0.002  # by which what is drawn and measured of a wall differs from step to step


# Named tuples, for these go into kernels as they are.
class LocalMap(NamedTuple):
    """Clearance around the robot: the distance [m] from each fine cell's centre to the nearest occupied edge."""

    clearance: Floats  # (rows, cols) [m]
    origin: Array  # (2,) lower-left corner of cell (0, 0) in the belief's frame [m]
    resolution: float  # [m]

    def at(self, points: Array) -> Array:
        """Return the clearance [m] at points ``(n, 2)``; beyond the window that of its rim."""
        return np.array([clearance_at(self, x, y) for x, y in np.atleast_2d(points).tolist()])


class Guard(NamedTuple):
    """What the check knows of the body: its outline and how it brakes."""

    rim: Array  # (n, 2) points of the outline [m], in the body frame
    half: Array  # (2,) half the length and width [m]
    lag_s: float  # how long a twist is held before braking shows
    braking_m_s2: float
    turn_braking_rad_s2: float
    scan_gap_m: float  # between the body and what the scan hit


def local_map(belief: Belief, radius_m: float) -> LocalMap:
    """Return the clearance within a square of this half side [m] around the robot."""
    grid = belief.grid
    resolution, (rows, cols) = grid.resolution, grid.shape
    row0, col0 = grid.lattice_origin
    x, y = float(belief.pose[0]), float(belief.pose[1])
    row, col = math.floor(y / resolution) - row0, math.floor(x / resolution) - col0
    span = math.ceil(radius_m / resolution)
    low_r, high_r = max(row - span, 0), min(row + span + 1, rows)
    low_c, high_c = max(col - span, 0), min(col + span + 1, cols)
    if high_r <= low_r or high_c <= low_c:  # off the map: nothing is known to be near
        low_r, high_r, low_c, high_c = 0, 1, 0, 1
    origin = np.array([grid.origin[0] + low_c * resolution, grid.origin[1] + low_r * resolution])
    return LocalMap(clearance(grid.log_odds[low_r:high_r, low_c:high_c], resolution), origin, resolution)


def footprint(robot: RobotConfig, spacing_m: float = 0.05) -> Array:
    """Return points ``(n, 2)`` [m] along the body's rim, in the body frame."""
    half_l, half_w = 0.5 * robot.length_m, 0.5 * robot.width_m
    along = np.linspace(-half_l, half_l, math.ceil(robot.length_m / spacing_m) + 1)
    across = np.linspace(-half_w, half_w, math.ceil(robot.width_m / spacing_m) + 1)[1:-1]
    sides = [np.stack([along, np.full_like(along, y)], axis=1) for y in (-half_w, half_w)]
    ends = [np.stack([np.full_like(across, x), across], axis=1) for x in (-half_l, half_l)]
    return np.ascontiguousarray(np.vstack(sides + ends))


def scan_shares(observation: Mapping[str, Any] | None, lidar: LidarConfig) -> NDArray[Any] | None:
    """Return the scan in an observation ``(beams,)``, ranges as shares of the greatest; None without one.

    Raises
    ------
    ValueError
        If the scan has another number of beams than the lidar.
    """
    if not isinstance(observation, Mapping) or "scan" not in observation:
        return None
    share = np.asarray(observation["scan"])
    if share.shape != (lidar.beams,):
        raise ValueError(
            f"the scan has shape {share.shape}, the agent's lidar {lidar.beams} beams: "
            "give agents.make the environment's lidar"
        )
    return share


def scan_points(observation: Mapping[str, Any] | None, lidar: LidarConfig) -> Array:
    """Return what the scan in an observation hit within 2 m ``(n, 2)`` [m], in the body frame, if there is one."""
    share = scan_shares(observation, lidar)
    if share is None:
        return np.zeros((0, 2))
    share = share.astype(np.float64)
    return _hits(share, _directions(lidar), lidar.offset_m, lidar.range_min_m, lidar.range_max_m)


@lru_cache(maxsize=16)
def _directions(lidar: LidarConfig) -> Array:
    """Return the unit vectors ``(beams, 2)`` along the beams, in the body frame."""
    angles = lidar.angle_min + lidar.angle_increment * np.arange(lidar.beams)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


@njit(cache=True, nogil=True)
def _hits(share: Array, directions: Array, offset_m: float, range_min_m: float, range_max_m: float) -> Array:
    points = np.empty((len(share), 2))
    count = 0
    for i in range(len(share)):
        reach = share[i] * range_max_m
        # Nothing returned at 1; a return below the least range is no return (NaN compares false).
        if share[i] < 1.0 and reach > range_min_m and reach < _SCAN_WITHIN_M:
            points[count, 0] = offset_m + reach * directions[i, 0]
            points[count, 1] = reach * directions[i, 1]
            count += 1
    return points[:count]


@njit(cache=True, nogil=True)
def safe_twist(
    twist: Array, pose: Array, near: LocalMap, map_gap: float, hits: Array, sides: Array, guard: Guard,
    floors: Array,
) -> Array:  # fmt: skip
    """Return the first of a twist ``(3,)`` and its tamer kin whose braking distance is clear; zero if none.

    ``map_gap`` [m] is what the body keeps from the map, ``hits`` ``(n, 2)`` [m] scan points in the body frame,
    ``sides`` ``(k, 3)`` the lines not to be crossed, one for each robot nearby: n·p ≤ d as rows nx, ny, d [m],
    also in the body frame. ``floors`` ``(2,)`` [m] are the gaps to map and scan below which a body that is too
    near already must not come: -inf at first, and kept up here from step to step.
    """
    kin = _tamer_kin(twist)
    map_now, scan_now = _gaps_at(0.0, 0.0, 0.0, pose, near, hits, guard)
    map_slack, scan_slack = _slack(map_now, map_gap, floors, 0), _slack(scan_now, guard.scan_gap_m, floors, 1)
    for k in range(len(kin)):
        candidate: Array = kin[k]
        if not candidate.any():
            continue
        _, map_ahead, _, scan_ahead = body_gaps(candidate, pose, near, hits, guard)
        # Already too near: any motion that brings it no nearer is allowed, or it would never get away.
        clear = map_ahead >= min(map_gap, map_now - map_slack)
        clear &= scan_ahead >= min(guard.scan_gap_m, scan_now - scan_slack)
        if clear and (len(sides) == 0 or _keeps_side(candidate, sides, guard)):
            return candidate
    return np.zeros(3)


@njit(cache=True, nogil=True)
def escape_twist(
    pose: Array, near: LocalMap, map_gap: float, hits: Array, sides: Array, guard: Guard, floors: Array
) -> Array:
    """Return the slow twist ``(3,)`` that ends with the widest gaps; zero where none ends with wider ones.

    For a body that is askew in a door, too near on both sides: what it is sent to, :func:`safe_twist` refuses,
    and most else. Arguments as there; what it refuses is not sent from here, either.
    """
    best, here = np.zeros(3), np.zeros(2)
    here[0], here[1] = _gaps_at(0.0, 0.0, 0.0, pose, near, hits, guard)
    least_map = min(map_gap, here[0] - _slack(here[0], map_gap, floors, 0))
    least_scan = min(guard.scan_gap_m, here[1] - _slack(here[1], guard.scan_gap_m, floors, 1))
    widest = min(here[0] - map_gap, here[1] - guard.scan_gap_m)
    for turn in _ESCAPE_RAD_S:
        for k in range(17):  # the last stays where it is
            speed, angle = (_ESCAPE_M_S if k < 16 else 0.0), k * math.pi / 8.0
            candidate = np.array([speed * math.cos(angle), speed * math.sin(angle), turn])
            _, map_ahead, _, scan_ahead = body_gaps(candidate, pose, near, hits, guard)
            if map_ahead < least_map or scan_ahead < least_scan:
                continue
            x, y, turned = _braking_way(candidate, guard)[-1]
            map_end, scan_end = _gaps_at(x, y, turned, pose, near, hits, guard)
            room = min(map_end - map_gap, scan_end - guard.scan_gap_m)
            if room > widest and (len(sides) == 0 or _keeps_side(candidate, sides, guard)):
                best, widest = candidate, room
    return best


@njit(cache=True, nogil=True)
def _slack(now: float, gap: float, floors: Array, which: int) -> float:
    """Return by how much a body may come nearer yet [m]: 2 mm in all, from the farthest since it is too near."""
    floors[which] = max(floors[which], now - _SLACK_M) if now < gap else -np.inf
    return float(min(max(now - floors[which], 1e-6), _SLACK_M))


@njit(cache=True, nogil=True)
def _tamer_kin(twist: Array) -> Array:
    """Return what is tried for a twist ``(14, 3)``, in turn: slower, without its turn, turning only, sideways."""
    kin = np.zeros((14, 3))
    for k in range(5):
        for i in range(3):
            kin[k, i] = _SPEEDS[k] * twist[i]
    for k in range(4):
        kin[5 + k, 0], kin[5 + k, 1] = kin[k, 0], kin[k, 1]
    kin[9, 2] = twist[2]
    slow = _SIDESTEP_M_S * twist[:2] / max(math.hypot(twist[0], twist[1]), _SIDESTEP_M_S)
    for k in range(4):
        c, s = math.cos(_SIDESTEPS[k]), math.sin(_SIDESTEPS[k])
        kin[10 + k, 0], kin[10 + k, 1] = c * slow[0] - s * slow[1], s * slow[0] + c * slow[1]
    return kin


@njit(cache=True, nogil=True)
def body_gaps(
    twist: Array, pose: Array, near: LocalMap, hits: Array, guard: Guard
) -> tuple[float, float, float, float]:
    """Return gaps [m] between the body and what the map and the scan show: now and, at the least, braking.

    The twist ``(3,)`` is held for the guard's lag, then shed as fast as it brakes speed and turn, whichever takes
    longer. ``hits`` are scan points in the body frame.

    Returns
    -------
    tuple
        Gap to the map now, gap to the map ahead, gap to the scan now, gap to the scan ahead.
    """
    way = _braking_way(twist, guard)
    map_now = map_ahead = scan_now = scan_ahead = np.inf
    for k in range(len(way)):
        map_gap, scan_gap = _gaps_at(way[k, 0], way[k, 1], way[k, 2], pose, near, hits, guard)
        if k == 0:
            map_now, scan_now = map_gap, scan_gap
        else:
            map_ahead, scan_ahead = min(map_ahead, map_gap), min(scan_ahead, scan_gap)
    return map_now, map_ahead, scan_now, scan_ahead


@njit(cache=True, nogil=True)
def _gaps_at(
    x: float, y: float, turned: float, pose: Array, near: LocalMap, hits: Array, guard: Guard
) -> tuple[float, float]:
    """Return gaps [m] to what the map and the scan show with the body at a pose in the body frame now."""
    rim, half = guard.rim, guard.half
    cos_b, sin_b = math.cos(pose[2]), math.sin(pose[2])
    c, s = math.cos(turned), math.sin(turned)
    map_gap = scan_gap = np.inf
    for i in range(rim.shape[0]):
        bx, by = x + c * rim[i, 0] - s * rim[i, 1], y + s * rim[i, 0] + c * rim[i, 1]
        wx, wy = pose[0] + cos_b * bx - sin_b * by, pose[1] + sin_b * bx + cos_b * by
        map_gap = min(map_gap, clearance_at(near, wx, wy))
    for i in range(hits.shape[0]):
        dx, dy = hits[i, 0] - x, hits[i, 1] - y
        out_x = abs(c * dx + s * dy) - half[0]
        out_y = abs(-s * dx + c * dy) - half[1]
        out = max(out_x, out_y)
        if out < scan_gap:  # few are: the root is taken for them alone
            scan_gap = min(scan_gap, math.hypot(out_x, out_y) if out_x > 0.0 and out_y > 0.0 else out)
    return map_gap, scan_gap


@njit(cache=True, nogil=True)
def _braking_s(twist: Array, guard: Guard) -> float:
    """Return how long it takes to brake from a twist [s], speed or turn, whichever takes longer."""
    speed = math.hypot(twist[0], twist[1])
    return float(max(speed / guard.braking_m_s2, abs(twist[2]) / guard.turn_braking_rad_s2))


@njit(cache=True, nogil=True)
def _held_s(t: float, twist: Array, guard: Guard) -> float:
    """Return the way covered after a time [s], as seconds at the full twist: uniform braking after the hold."""
    lag, braking = guard.lag_s, _braking_s(twist, guard)
    late = max(t - lag, 0.0)
    return float(min(t, lag) + (late - 0.5 * late * late / braking if braking > 0.0 else 0.0))


@njit(cache=True, nogil=True)
def _braking_way(twist: Array, guard: Guard) -> Array:
    """Return poses on the way to a stand ``(poses, 3)``, even in time, in the body frame now: the first is 0.

    There are so many that what the body passes over lies in it, or within the gaps of it, at one of them.
    """
    total = guard.lag_s + _braking_s(twist, guard)
    half_l, half_w = guard.half
    corner_m_s = math.hypot(twist[0], twist[1]) + abs(twist[2]) * math.hypot(half_l, half_w)
    pieces = math.ceil(corner_m_s * total / min(half_l, half_w, _APART_M))
    poses = min(max(_POSES, pieces + 1), _MOST_POSES)
    way = np.zeros((poses, 3))
    last = 0.0
    for k in range(1, poses):
        held = _held_s(total * k / (poses - 1), twist, guard)
        dt, last = held - last, held
        middle = way[k - 1, 2] + 0.5 * dt * twist[2]
        way[k, 0] = way[k - 1, 0] + dt * (math.cos(middle) * twist[0] - math.sin(middle) * twist[1])
        way[k, 1] = way[k - 1, 1] + dt * (math.sin(middle) * twist[0] + math.cos(middle) * twist[1])
        way[k, 2] = way[k - 1, 2] + dt * twist[2]
    return way


@njit(cache=True, nogil=True)
def _keeps_side(twist: Array, sides: Array, guard: Guard) -> bool:
    """Tell whether the body, braking from a twist, crosses no line; or, where it has, goes no farther."""
    way = _braking_way(twist, guard)
    now = np.empty(len(sides))
    for k in range(len(way)):
        x, y = way[k, 0], way[k, 1]
        c, s = math.cos(way[k, 2]), math.sin(way[k, 2])
        for i in range(len(sides)):
            nx, ny, d = sides[i]
            # The body's corner that is farthest along the line's normal.
            body = guard.half[0] * abs(c * nx + s * ny) + guard.half[1] * abs(c * ny - s * nx)
            room = d - nx * x - ny * y - body
            if k == 0:
                now[i] = room
            elif room < min(0.0, now[i]) - 1e-6:
                return False
    return True


@njit(cache=True, nogil=True)
def clearance_at(near: LocalMap, x: float, y: float) -> float:
    """Return the clearance [m] at a point, bilinear between cell centres; beyond the window that of its rim."""
    field = near.clearance
    rows, cols = field.shape
    u = min(max((x - near.origin[0]) / near.resolution - 0.5, 0.0), cols - 1.0)
    v = min(max((y - near.origin[1]) / near.resolution - 0.5, 0.0), rows - 1.0)
    col, row = min(int(u), max(cols - 2, 0)), min(int(v), max(rows - 2, 0))
    fu, fv = u - col, v - row
    next_c, next_r = min(col + 1, cols - 1), min(row + 1, rows - 1)
    low = field[row, col] * (1.0 - fu) + field[row, next_c] * fu
    high = field[next_r, col] * (1.0 - fu) + field[next_r, next_c] * fu
    return float(low * (1.0 - fv) + high * fv)
