"""One step along a path, as kernels for :mod:`agents.driving.control`: where to, how fast, and turned which way.

Every array here is tiny and every step needs them all: NumPy would spend its time on calls, not on sums.
Positions, velocities and headings are in the belief's frame, twists in the body frame. A path is its points
``(n, 2)`` [m] with ``arc`` ``(n,)`` [m], the length of the path up to each of them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from agents.driving.safety import Guard, LocalMap, clearance_at, safe_twist
from slam.geometry import wrap_scalar
from slam.types import Array

__all__ = ["WINDOW_M", "Motors", "Pace", "aim", "send"]

WINDOW_M = 2.0  # half side of the map that the follower looks at
_SPACING_M = 0.1  # between the points of a path, about
_PIECE_M = 0.2  # of the path ahead that the heading is chosen for …
_PIECES = 15  # … so many at most
_TIGHT_POINTS = 13  # of the path ahead that are searched for a tight passage, where it is turned to the path


class Pace(NamedTuple):
    """How a path is followed."""

    max_speed_m_s: float
    near_wall_m_s: float
    open_m: float
    deceleration_m_s2: float
    lag_s: float
    look_ahead_s: float
    min_look_ahead_m: float
    max_look_ahead_m: float
    lateral_m_s2: float
    turn_gain: float  # [1/s]
    max_turn_rad_s: float
    align_rad: float
    arrival_m_s: float
    arrived_m: float
    arrived_rad: float
    half_length_m: float  # of the body
    reversible: bool  # whether it may be driven backwards out of a narrow place
    any_side: bool  # whether any side of the body may lead
    lever_m: float
    wide: bool  # whether the body is wider than long
    spare_m: float  # what the body takes up less, to either side of the way, when a long side leads than turning
    turn_within_m: float  # of the goal: from there on it turns to the goal's heading, even beside a wall


class Motors(NamedTuple):
    """What a step can change, and what the wheels can do."""

    step_s: float
    acceleration_m_s2: float
    turn_acceleration_rad_s2: float
    max_speed_m_s: float  # of a wheel's rim
    lever_m: float


class _Spot(NamedTuple):
    """Where on the path the robot is, and how much room it has."""

    nearest: int  # index of the path's point
    at_m: float  # along the path
    remaining_m: float
    here_m: float  # clearance at the robot
    room_m: Array  # (k,) clearance at the path's points from the nearest on, as far as the map nearby reaches


@njit(cache=True, nogil=True)
def aim(
    pose: Array, speed_now: float, path: Array, arc: Array, index: int, goal_heading: float, near: LocalMap,
    turning_room: float, pace: Pace,
) -> tuple[Array, float, int, float, bool]:  # fmt: skip
    """Return the velocity and the turn rate wanted next on a path, and how far along it the robot is.

    Parameters
    ----------
    pose : array (3,)
        The robot's [m, m, rad].
    speed_now : float
        Of the last command [m/s].
    index : int
        The path's point that the robot was nearest to, one step ago.
    goal_heading : float
        [rad] to end with, NaN where any will do.
    turning_room : float
        Clearance [m] at which the robot may turn.

    Returns
    -------
    tuple
        Velocity ``(2,)`` [m/s], turn rate [rad/s], the nearest point's index, the way left [m], and whether
        the robot has arrived.
    """
    spot = _locate(pose, path, arc, index, near)
    x, y, reach = _target(pose, speed_now, path, arc, near, spot, pace)
    speed = _speed(speed_now, path, arc, spot, reach, turning_room, pace)
    wanted, tight_in = _wanted_heading(pose[2], path, arc, spot, goal_heading, turning_room, pace)
    error = 0.0 if math.isnan(wanted) else wrap_scalar(wanted - pose[2])
    if abs(error) > pace.align_rad:
        # Turn before a tight passage, not in it.
        gap = max(0.0, tight_in - pace.half_length_m)
        speed = min(speed, math.sqrt(2.0 * pace.deceleration_m_s2 * gap) if gap > 0.02 else 0.04)
    done = spot.remaining_m <= pace.arrived_m
    if done:
        speed = 0.0
    aligned = math.isnan(goal_heading) or abs(wrap_scalar(goal_heading - pose[2])) <= pace.arrived_rad
    turn = min(max(pace.turn_gain * error, -pace.max_turn_rad_s), pace.max_turn_rad_s)
    away = math.hypot(x - pose[0], y - pose[1])
    velocity = np.zeros(2)
    if away > 1e-6:
        velocity[0], velocity[1] = speed * ((x - pose[0]) / away), speed * ((y - pose[1]) / away)
    return velocity, turn, spot.nearest, spot.remaining_m, done and aligned


@njit(cache=True, nogil=True)
def send(
    velocity: Array, turn: float, last_velocity: Array, last_turn: float, pose: Array, near: LocalMap,
    map_gap: float, hits: Array, sides: Array, motors: Motors, guard: Guard, floors: Array,
) -> tuple[Array, Array, bool]:  # fmt: skip
    """Smooth, bound and check a wanted velocity ``(2,)`` [m/s] and turn rate [rad/s].

    ``map_gap`` [m] is what the body keeps from the map, ``hits`` ``(n, 2)`` [m] what the scan shows, ``sides``
    ``(k, 3)`` are the lines that part it from other robots, ``floors`` ``(2,)`` what lasts of the check: see
    :func:`agents.driving.safety.safe_twist`.

    Returns
    -------
    tuple
        The twist ``(3,)`` to send, the velocity ``(2,)`` that it comes to, and whether a motion was wanted of
        which nothing is safe.
    """
    change_x, change_y = velocity[0] - last_velocity[0], velocity[1] - last_velocity[1]
    change = math.hypot(change_x, change_y)
    limit = motors.acceleration_m_s2 * motors.step_s
    share = min(1.0, limit / change) if change > 0.0 else 1.0
    x, y = last_velocity[0] + share * change_x, last_velocity[1] + share * change_y
    spin = motors.turn_acceleration_rad_s2 * motors.step_s
    turn = min(max(turn, last_turn - spin), last_turn + spin)
    # Half a step of turning lies between this heading and the one the twist is driven at, on average.
    heading = pose[2] + 0.5 * turn * motors.step_s
    c, s = math.cos(heading), math.sin(heading)
    twist = np.array([c * x + s * y, c * y - s * x, turn])
    demand = abs(twist[0]) + abs(twist[1]) + motors.lever_m * abs(twist[2])
    if demand > motors.max_speed_m_s:
        twist *= motors.max_speed_m_s / demand
    sent = safe_twist(twist, pose, near, map_gap, hits, sides, guard, floors)
    heading = pose[2] + 0.5 * sent[2] * motors.step_s
    c, s = math.cos(heading), math.sin(heading)
    velocity_sent = np.array([c * sent[0] - s * sent[1], s * sent[0] + c * sent[1]])
    wish = abs(velocity[0]) + abs(velocity[1]) > 0.03 or abs(turn) > 0.05
    return sent, velocity_sent, wish and not sent.any()


@njit(cache=True, nogil=True)
def _locate(pose: Array, path: Array, arc: Array, index: int, near: LocalMap) -> _Spot:
    """Move on to the path point nearest to the robot, never far back."""
    end = min(np.searchsorted(arc, arc[index] + 1.0) + 1, len(arc))
    least = np.inf
    for i in range(index, end):
        away = math.hypot(path[i, 0] - pose[0], path[i, 1] - pose[1])
        if away < least:
            least, index = away, i
    at = arc[index]
    last = len(path) - 1
    rest = math.hypot(path[last, 0] - pose[0], path[last, 1] - pose[1]) if index == last else 0.0
    end = index + 1
    while end < len(arc) and arc[end] - at <= WINDOW_M:
        end += 1
    room = np.empty(end - index)
    for i in range(index, end):
        room[i - index] = clearance_at(near, path[i, 0], path[i, 1])
    return _Spot(index, at, max(arc[last] - at, rest), clearance_at(near, pose[0], pose[1]), room)


@njit(cache=True, nogil=True)
def _point(path: Array, arc: Array, at: float) -> tuple[float, float]:
    """Return the point (x, y) this far along the path; its ends beyond them."""
    i = np.searchsorted(arc, at, side="right") - 1
    if i < 0:
        return path[0, 0], path[0, 1]
    if i >= len(arc) - 1:
        return path[-1, 0], path[-1, 1]
    share = (at - arc[i]) / (arc[i + 1] - arc[i])
    return (path[i, 0] + share * (path[i + 1, 0] - path[i, 0]), path[i, 1] + share * (path[i + 1, 1] - path[i, 1]))


@njit(cache=True, nogil=True)
def _step_between(path: Array, arc: Array, start: float, end: float) -> tuple[float, float]:
    """Return the vector (x, y) from one point of the path to another."""
    (x0, y0), (x1, y1) = _point(path, arc, start), _point(path, arc, end)
    return x1 - x0, y1 - y0


@njit(cache=True, nogil=True)
def _least_room(room: Array, within: float) -> float:
    """Return the least clearance [m] on the path up to a distance [m] ahead."""
    return float(room[: int(within / _SPACING_M) + 1].min())


@njit(cache=True, nogil=True)
def _target(
    pose: Array, speed_now: float, path: Array, arc: Array, near: LocalMap, spot: _Spot, pace: Pace
) -> tuple[float, float, float]:
    """Return the point (x, y) of the path to make for, and how far ahead [m] it is."""
    reach = min(max(pace.look_ahead_s * speed_now, pace.min_look_ahead_m), pace.max_look_ahead_m)
    # Cut no corner: the straight line to the target keeps the clearance that the path has.
    floor = min(_least_room(spot.room_m, reach), spot.here_m) - 0.02
    x, y = _point(path, arc, spot.at_m + reach)
    while reach > 0.1:
        least = np.inf
        for k in range(1, 6):
            px, py = pose[0] + 0.2 * k * (x - pose[0]), pose[1] + 0.2 * k * (y - pose[1])
            least = min(least, clearance_at(near, px, py))
        if least >= floor:
            break
        reach -= 0.1
        x, y = _point(path, arc, spot.at_m + reach)
    return x, y, reach


@njit(cache=True, nogil=True)
def _speed(
    speed_now: float, path: Array, arc: Array, spot: _Spot, reach: float, turning_room: float, pace: Pace
) -> float:
    """Return the speed [m/s] that the walls, the goal and the coming turn allow."""
    braking = speed_now * pace.lag_s + 0.5 * speed_now**2 / pace.deceleration_m_s2
    clear = min(spot.here_m, _least_room(spot.room_m, braking + 0.2))
    spare = min(max((clear - turning_room) / pace.open_m, 0.0), 1.0)
    walls = pace.near_wall_m_s + (pace.max_speed_m_s - pace.near_wall_m_s) * spare
    # From v²/2a + v·lag = rest: the lag's distance is spent before braking shows.
    lag = pace.lag_s * pace.deceleration_m_s2
    stopping = math.sqrt(lag * lag + 2.0 * pace.deceleration_m_s2 * spot.remaining_m) - lag
    turning = _turn_speed(path, arc, spot.at_m, reach, pace)
    return min(pace.max_speed_m_s, walls, max(pace.arrival_m_s, stopping), turning)


@njit(cache=True, nogil=True)
def _turn_speed(path: Array, arc: Array, at: float, reach: float, pace: Pace) -> float:
    """Speed [m/s] at which the coming turn of the path asks for no more than the lateral acceleration."""
    ax, ay = _step_between(path, arc, at, at + 0.5 * reach)
    bx, by = _step_between(path, arc, at + 0.5 * reach, at + 1.5 * reach)
    norm = math.hypot(ax, ay) * math.hypot(bx, by)
    if norm < 1e-9:
        return pace.max_speed_m_s
    angle = math.acos(min(max((ax * bx + ay * by) / norm, -1.0), 1.0))
    if angle < 0.1:
        return pace.max_speed_m_s
    return max(0.15, math.sqrt(pace.lateral_m_s2 * 0.75 * reach / angle))


@njit(cache=True, nogil=True)
def _wanted_heading(
    heading: float, path: Array, arc: Array, spot: _Spot, goal_heading: float, turning_room: float, pace: Pace
) -> tuple[float, float]:
    """Return the heading [rad] to turn to, NaN for none, and the distance [m] to a tight passage, inf for none."""
    wanted, tight_in = np.nan, np.inf
    for k in range(len(spot.room_m) if pace.any_side else min(_TIGHT_POINTS, len(spot.room_m))):
        if spot.room_m[k] >= turning_room + 0.02:
            continue
        middle = arc[spot.nearest + k]
        dx, dy = _step_between(path, arc, max(middle - 0.2, 0.0), middle + 0.3)
        if math.hypot(dx, dy) > 0.05:
            wanted, tight_in = math.atan2(dy, dx), max(0.0, middle - spot.at_m)
            if pace.wide:  # its long side lies along the way where a side leads
                wanted = _nearest_axis(heading, wanted + 0.5 * math.pi, 2)
                break
            back = abs(wrap_scalar(wanted - heading)) > 0.5 * math.pi
            if pace.any_side:
                sideways = spot.room_m[k:].min() >= turning_room - pace.spare_m
                wanted = _nearest_axis(heading, wanted, 4 if sideways else 2)
            elif pace.reversible and spot.here_m < turning_room and back:
                wanted = wrap_scalar(wanted + math.pi)
        break
    if math.isnan(wanted):
        if spot.remaining_m < 0.4:
            wanted = goal_heading
        elif pace.any_side:
            wanted = _soonest_heading(heading, path, arc, spot, pace.lever_m)
        else:
            dx, dy = _step_between(path, arc, spot.at_m + 0.1, spot.at_m + 0.7)
            wanted = math.atan2(dy, dx)
    return goal_heading if spot.remaining_m < pace.turn_within_m else wanted, tight_in


@njit(cache=True, nogil=True)
def _nearest_axis(heading: float, along: float, axes: int) -> float:
    """Return the heading nearest to the present one in which one of the body's axes lies along a direction."""
    apart = 2.0 * math.pi / axes
    off = along - heading
    return heading + off - apart * math.floor(off / apart + 0.5)


@njit(cache=True, nogil=True)
def _soonest_heading(heading: float, path: Array, arc: Array, spot: _Spot, lever_m: float) -> float:
    """Return the heading, kept from now on, with which the path ahead takes least time, turning to it included.

    A mecanum wheel's rim moves at |vx| + |vy| + lever |ω| at most, so that time is what the rims cover: along
    the path Σ ds (|cos φ| + |sin φ|), φ between path and heading, and lever · |turn|. Between kinks this is
    concave: least at the present heading or where an axis of the body lies along a piece of the path.
    """
    pieces = min(max(int((arc[-1] - spot.at_m) / _PIECE_M), 1), _PIECES)
    along = np.empty(pieces)
    for k in range(pieces):
        dx, dy = _step_between(path, arc, spot.at_m + k * _PIECE_M, spot.at_m + (k + 1) * _PIECE_M)
        along[k] = math.atan2(dy, dx) if math.hypot(dx, dy) > 1e-6 else heading
    best, least = heading, np.inf
    for j in range(-1, pieces):
        wanted = heading if j < 0 else _nearest_axis(heading, along[j], 4)
        covered = lever_m * abs(wanted - heading)
        for k in range(pieces):
            off = along[k] - wanted
            covered += _PIECE_M * (abs(math.cos(off)) + abs(math.sin(off)))
        if covered < least - 1e-9:
            best, least = wanted, covered
    return best
