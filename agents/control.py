"""Following a path with a body that can move any way: pure pursuit, with the heading turned alongside."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.cost_map import position_sigma
from agents.safety import LocalMap, body_gaps, footprint, local_map, scan_points
from mecanum_env.config import LidarConfig, RobotConfig
from slam import geometry
from slam.settings import require
from slam.types import Belief

__all__ = ["ControlConfig", "PathFollower"]

Array = NDArray[np.float64]

_WINDOW_M = 2.0  # half side of the map that the follower looks at
_SPEEDS = (1.0, 0.7, 0.45, 0.25, 0.1)  # shares of the wanted twist that the safety check tries
_SIDESTEPS = (0.6, -0.6, 1.2, -1.2)  # [rad] off the wanted direction, tried after that


@dataclass(frozen=True, kw_only=True)
class ControlConfig:
    """Speeds, accelerations and gaps of the path follower."""

    speed_share: float = 0.95  # of the robot's limit
    near_wall_m_s: float = 0.4  # speed at the least clearance at which the robot may turn
    open_m: float = 0.25  # clearance beyond that one from which walls no longer slow it
    acceleration_m_s2: float = 1.2
    deceleration_m_s2: float = 0.8  # towards the goal and into turns
    braking_m_s2: float = 1.5  # what the safety check counts on: a slippery floor gives no more
    turn_rate_rad_s: float = 0.8
    turn_gain: float = 2.0  # turn rate per heading error [1/s]
    turn_acceleration_rad_s2: float = 3.0
    lag_s: float = 0.2  # a step and the motors' lag: how long a twist is held before braking shows
    look_ahead_s: float = 0.7
    min_look_ahead_m: float = 0.25
    max_look_ahead_m: float = 0.6
    lateral_m_s2: float = 0.5  # in turns of the path
    align_rad: float = 0.25  # heading error within which a tight passage is entered
    map_gap_m: float = 0.04  # between body and occupied cells, and 2σ of the position more, capped
    max_sigma_gap_m: float = 0.05  # the planner's cap: where a path is planned, it can be driven
    scan_gap_m: float = 0.04  # between body and what the scan hit
    arrival_m_s: float = 0.2  # speed at which the goal is reached; what is left is braked away there
    arrived_m: float = 0.12
    arrived_rad: float = 0.2

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            require(math.isfinite(value) and value > 0, f"ControlConfig.{f.name} must be > 0, got {value}")
        require(self.speed_share <= 1, f"ControlConfig.speed_share must be ≤ 1, got {self.speed_share}")


class PathFollower:
    """Turns a path into body twists, one a step, and never one whose braking distance is blocked."""

    def __init__(self, config: ControlConfig, *, robot: RobotConfig, lidar: LidarConfig, step_s: float) -> None:
        self.config = config
        self._robot, self._lidar, self._step_s = robot, lidar, step_s
        self._rim = footprint(robot)
        self._half = 0.5 * np.array([robot.length_m, robot.width_m])
        self._max_speed = config.speed_share * robot.max_speed_m_s
        self._max_turn = min(config.turn_rate_rad_s, robot.max_turn_rate_rad_s)
        # A sensor that sees all round can as well be driven backwards out of a narrow place.
        self._reversible = lidar.field_of_view_deg >= 270.0
        self.reset()

    def reset(self) -> None:
        """Stand still, with no path."""
        self._map_gap = self.config.map_gap_m
        self._velocity = np.zeros(2)  # last command in the belief's frame [m/s]
        self._turn = 0.0  # last command [rad/s]
        self._path = np.zeros((1, 2))
        self._arc = np.zeros(1)
        self._heading: float | None = None
        self._index = 0
        self.blocked = False  # the last step wanted to move and could not
        self.arrived = False
        self.remaining_m = 0.0

    def set_path(self, path: Array, heading: float | None) -> None:
        """Follow ``path`` ``(n, 2)`` and end with ``heading`` [rad], or with any where it is ``None``."""
        self._path = np.asarray(path, dtype=np.float64)
        self._arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self._path, axis=0).T))])
        self._heading = heading
        self._index = 0
        self.arrived = False
        self.remaining_m = float(self._arc[-1])

    def follow(self, observation: Mapping[str, Any] | None, belief: Belief) -> Array:
        """Return the next body twist ``(3,)`` [m/s, m/s, rad/s] along the path."""
        pose = np.asarray(belief.pose, dtype=np.float64)
        near = self._look_around(belief)
        at = self._locate(pose[:2])
        along = np.minimum(self._arc[self._index :] - at, self._arc[-1] - at)
        room = near.at(self._path[self._index :][along <= _WINDOW_M])
        direction, speed = self._pursue(pose, near, at, room)
        wanted_heading, tight_in = self._wanted_heading(pose, near, at, room)
        error = 0.0 if wanted_heading is None else geometry.wrap_scalar(wanted_heading - pose[2])
        if tight_in is not None and abs(error) > self.config.align_rad:
            # Turn before the passage, not in it.
            gap = max(0.0, tight_in - 0.5 * self._robot.length_m)
            speed = min(speed, math.sqrt(2.0 * self.config.deceleration_m_s2 * gap) if gap > 0.02 else 0.04)
        done = self.remaining_m <= self.config.arrived_m
        aligned = self._heading is None or (
            abs(geometry.wrap_scalar(self._heading - pose[2])) <= self.config.arrived_rad
        )
        self.arrived = done and aligned
        if done:
            speed = 0.0
        turn = float(np.clip(self.config.turn_gain * error, -self._max_turn, self._max_turn))
        return self._send(speed * direction, turn, pose, near, scan_points(observation, self._lidar))

    def drive(self, velocity: Array, turn: float, observation: Mapping[str, Any] | None, belief: Belief) -> Array:
        """Return the twist ``(3,)`` nearest to a velocity ``(2,)`` in the belief's frame that is safe."""
        pose = np.asarray(belief.pose, dtype=np.float64)
        near = self._look_around(belief)
        return self._send(velocity, turn, pose, near, scan_points(observation, self._lidar))

    def _look_around(self, belief: Belief) -> LocalMap:
        """Return the map nearby, and keep the farther from it the less sure the position is."""
        sigma = position_sigma(belief.pose_cov)
        self._map_gap = self.config.map_gap_m + min(2.0 * sigma, self.config.max_sigma_gap_m)
        return local_map(belief, _WINDOW_M)

    @property
    def _turning_room(self) -> float:
        return self._robot.circumscribed_radius_m + self._map_gap

    def room(self, belief: Belief, points: Array) -> Array:
        """Return the clearance [m] at points ``(n, 2)`` near the robot, in the belief's frame."""
        return local_map(belief, _WINDOW_M).at(points)

    def _locate(self, position: Array) -> float:
        """Move on to the path point nearest to the robot, never far back; return how far along it that is."""
        end = int(np.searchsorted(self._arc, self._arc[self._index] + 1.0)) + 1
        away = np.hypot(*(self._path[self._index : end] - position).T)
        self._index += int(np.argmin(away))
        at = float(self._arc[self._index])
        rest = float(np.hypot(*(self._path[-1] - position)))
        self.remaining_m = max(float(self._arc[-1]) - at, rest if self._index == len(self._path) - 1 else 0.0)
        return at

    def _point(self, at: float) -> Array:
        return np.array([np.interp(at, self._arc, self._path[:, axis]) for axis in (0, 1)])

    def _pursue(self, pose: Array, near: LocalMap, at: float, room: Array) -> tuple[Array, float]:
        """Return the direction ``(2,)`` to go in and the speed [m/s] that path and walls allow."""
        config = self.config
        speed_now = float(np.hypot(*self._velocity))
        reach = float(np.clip(config.look_ahead_s * speed_now, config.min_look_ahead_m, config.max_look_ahead_m))
        here = float(near.at(pose[None, :2])[0])
        # Cut no corner: the straight line to the target keeps the clearance that the path has.
        floor = min(float(room[: max(1, int(reach / 0.1) + 1)].min()), here) - 0.02
        target = self._point(at + reach)
        while reach > 0.1:
            shares = np.linspace(0.2, 1.0, 5)[:, None]
            if near.at(pose[:2] + shares * (target - pose[:2])).min() >= floor:
                break
            reach -= 0.1
            target = self._point(at + reach)
        offset = target - pose[:2]
        distance = float(np.hypot(*offset))
        direction = offset / distance if distance > 1e-6 else np.zeros(2)
        braking = speed_now * config.lag_s + 0.5 * speed_now**2 / config.deceleration_m_s2
        ahead = room[: max(1, int((braking + 0.2) / 0.1) + 1)]
        spare = (min(here, float(ahead.min())) - self._turning_room) / config.open_m
        walls = config.near_wall_m_s + (self._max_speed - config.near_wall_m_s) * float(np.clip(spare, 0.0, 1.0))
        # From v²/2a + v·lag = rest: the lag's distance is spent before braking shows.
        rest = self.remaining_m
        lag = config.lag_s * config.deceleration_m_s2
        stopping = max(config.arrival_m_s, math.sqrt(lag * lag + 2.0 * config.deceleration_m_s2 * rest) - lag)
        return direction, min(self._max_speed, walls, stopping, self._turn_speed(at, reach))

    def _turn_speed(self, at: float, reach: float) -> float:
        """Speed [m/s] at which the coming turn of the path asks for no more than the lateral acceleration."""
        before = self._point(at + 0.5 * reach) - self._point(at)
        after = self._point(at + 1.5 * reach) - self._point(at + 0.5 * reach)
        norm = float(np.hypot(*before) * np.hypot(*after))
        if norm < 1e-9:
            return self._max_speed
        angle = math.acos(float(np.clip(np.dot(before, after) / norm, -1.0, 1.0)))
        if angle < 0.1:
            return self._max_speed
        return max(0.15, math.sqrt(self.config.lateral_m_s2 * 0.75 * reach / angle))

    def _wanted_heading(
        self, pose: Array, near: LocalMap, at: float, room: Array
    ) -> tuple[float | None, float | None]:
        """Return the heading [rad] to turn to, if any, and the distance [m] to a tight passage, if any."""
        ahead = room[:13]
        tight = np.flatnonzero(ahead < self._turning_room + 0.02)
        if len(tight) and self._arc[-1] > 0.0:
            first = min(self._index + int(tight[0]), len(self._path) - 1)
            middle = float(self._arc[first])
            along = self._point(middle + 0.3) - self._point(max(middle - 0.2, 0.0))
            if np.hypot(*along) > 0.05:
                wanted = math.atan2(along[1], along[0])
                enclosed = float(near.at(pose[None, :2])[0]) < self._turning_room
                back = abs(geometry.wrap_scalar(wanted - pose[2])) > 0.5 * math.pi
                if self._reversible and enclosed and back:
                    wanted = geometry.wrap_scalar(wanted + math.pi)
                return wanted, max(0.0, middle - at)
        if self.remaining_m < 0.4:
            return self._heading, None
        along = self._point(at + 0.7) - self._point(at + 0.1)
        return math.atan2(along[1], along[0]), None

    def _send(self, velocity: Array, turn: float, pose: Array, near: LocalMap, hits: Array) -> Array:
        """Smooth, bound and check a wanted velocity (belief frame) and turn rate; remember what goes out."""
        config = self.config
        change = velocity - self._velocity
        step = float(np.hypot(*change))
        limit = config.acceleration_m_s2 * self._step_s
        smooth = self._velocity + change * min(1.0, limit / step if step > 0 else 1.0)
        spin = config.turn_acceleration_rad_s2 * self._step_s
        turn = float(np.clip(turn, self._turn - spin, self._turn + spin))
        # Half a step of turning lies between this heading and the one the twist is driven at, on average.
        body = geometry.rotation(-(pose[2] + 0.5 * turn * self._step_s)) @ smooth
        twist = self._within_wheel_limits(np.array([body[0], body[1], turn]))
        sent = self._safe(twist, pose, near, hits)
        wish = abs(velocity[0]) + abs(velocity[1]) > 0.03 or abs(turn) > 0.05
        self.blocked = bool(wish and not sent.any())
        self._velocity = geometry.rotation(pose[2] + 0.5 * sent[2] * self._step_s) @ sent[:2]
        self._turn = float(sent[2])
        return sent

    def _within_wheel_limits(self, twist: Array) -> Array:
        demand = abs(twist[0]) + abs(twist[1]) + self._robot.lever_m * abs(twist[2])
        return twist * (self._robot.max_speed_m_s / demand) if demand > self._robot.max_speed_m_s else twist

    def _safe(self, twist: Array, pose: Array, near: LocalMap, hits: Array) -> Array:
        """Return the first of the twist and its tamer kin whose braking distance is clear; zero if none."""
        if not twist.any():
            return twist
        candidates = [twist * share for share in _SPEEDS]
        candidates += [twist * np.array([share, share, 0.0]) for share in _SPEEDS[:4]]
        candidates.append(twist * np.array([0.0, 0.0, 1.0]))
        slow = 0.12 * twist[:2] / max(float(np.hypot(*twist[:2])), 0.12)
        candidates += [np.append(geometry.rotation(angle) @ slow, 0.0) for angle in _SIDESTEPS]
        for candidate in candidates:
            if candidate.any() and self._is_safe(candidate, pose, near, hits):
                return candidate
        return np.zeros(3)

    def _is_safe(self, twist: Array, pose: Array, near: LocalMap, hits: Array) -> bool:
        config = self.config
        timing = np.array([config.lag_s, config.braking_m_s2, 2.0 * config.turn_acceleration_rad_s2])
        map_now, map_ahead, scan_now, scan_ahead = body_gaps(
            twist, pose, timing, self._half, self._rim, near.clearance, near.origin, near.resolution, hits
        )
        # Already too near: any motion that brings it no nearer is allowed, or it would never get away.
        clear_of_map = map_ahead >= min(self._map_gap, map_now - 0.002)
        clear_of_scan = scan_ahead >= min(config.scan_gap_m, scan_now - 0.002)
        return bool(clear_of_map and clear_of_scan)
