"""The path follower once more, step by step in plain NumPy: slow, and easy to check against what it is to do."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.driving.control import PathFollower
from agents.driving.follow import WINDOW_M
from agents.driving.safety import LocalMap, body_gaps, local_map
from mecanum_env.config import LidarConfig
from slam import geometry
from slam.belief import Belief

Array = NDArray[np.float64]

SPEEDS = (1.0, 0.7, 0.45, 0.25, 0.1)  # shares of the wanted twist that the safety check tries
SIDESTEPS = (0.6, -0.6, 1.2, -1.2)  # [rad] off the wanted direction, tried after that


class PlainFollower(PathFollower):
    """Takes every decision that the kernels take, in the same order."""

    def follow(self, observation: Mapping[str, Any] | None, belief: Belief) -> Array:
        config, pose = self.config, belief.pose
        near, gap = local_map(belief, WINDOW_M), self._map_gap(belief)
        turning_room = self._robot.circumscribed_radius_m + gap
        at = self._locate(pose[:2])
        room = near.at(self._path[self._index :][self._arc[self._index :] - at <= WINDOW_M])
        direction, speed = self._pursue(pose, near, at, room, turning_room)
        wanted_heading, tight_in = self._wanted_heading(pose, near, at, room, turning_room)
        if self.remaining_m < self._turn_within_m:
            wanted_heading = self._heading
        error = 0.0 if wanted_heading is None else geometry.wrap_scalar(wanted_heading - pose[2])
        if tight_in is not None and abs(error) > config.align_rad:
            before = max(0.0, tight_in - 0.5 * self._robot.length_m)
            speed = min(speed, math.sqrt(2.0 * config.deceleration_m_s2 * before) if before > 0.02 else 0.04)
        done = self.remaining_m <= config.arrived_m
        aligned = self._heading is None or (
            abs(geometry.wrap_scalar(self._heading - pose[2])) <= config.arrived_rad
        )
        self.arrived = done and aligned
        if done:
            speed = 0.0
        most = min(config.turn_rate_rad_s, self._robot.max_turn_rate_rad_s)
        turn = float(np.clip(config.turn_gain * error, -most, most))
        return self._send(speed * direction, turn, observation, belief, near, gap)

    def _locate(self, position: Array) -> float:
        end = int(np.searchsorted(self._arc, self._arc[self._index] + 1.0)) + 1
        away = np.hypot(*(self._path[self._index : end] - position).T)
        self._index += int(np.argmin(away))
        at = float(self._arc[self._index])
        rest = float(np.hypot(*(self._path[-1] - position)))
        self.remaining_m = max(float(self._arc[-1]) - at, rest if self._index == len(self._path) - 1 else 0.0)
        return at

    def _point(self, at: float) -> Array:
        return np.array([np.interp(at, self._arc, self._path[:, axis]) for axis in (0, 1)])

    def _pursue(
        self, pose: Array, near: LocalMap, at: float, room: Array, turning_room: float
    ) -> tuple[Array, float]:
        config = self.config
        max_speed = config.speed_share * self._robot.max_speed_m_s
        speed_now = float(np.hypot(*self._velocity))
        reach = float(np.clip(config.look_ahead_s * speed_now, config.min_look_ahead_m, config.max_look_ahead_m))
        here = float(near.at(pose[None, :2])[0])
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
        spare = (min(here, float(ahead.min())) - turning_room) / config.open_m
        walls = config.near_wall_m_s + (max_speed - config.near_wall_m_s) * float(np.clip(spare, 0.0, 1.0))
        lag = config.lag_s * config.deceleration_m_s2
        stopping = math.sqrt(lag * lag + 2.0 * config.deceleration_m_s2 * self.remaining_m) - lag
        turning = self._turn_speed(at, reach, max_speed)
        return direction, min(max_speed, walls, max(config.arrival_m_s, stopping), turning)

    def _turn_speed(self, at: float, reach: float, max_speed: float) -> float:
        before = self._point(at + 0.5 * reach) - self._point(at)
        after = self._point(at + 1.5 * reach) - self._point(at + 0.5 * reach)
        norm = float(np.hypot(*before) * np.hypot(*after))
        if norm < 1e-9:
            return max_speed
        angle = math.acos(float(np.clip(np.dot(before, after) / norm, -1.0, 1.0)))
        if angle < 0.1:
            return max_speed
        return max(0.15, math.sqrt(self.config.lateral_m_s2 * 0.75 * reach / angle))

    def _wanted_heading(
        self, pose: Array, near: LocalMap, at: float, room: Array, turning_room: float
    ) -> tuple[float | None, float | None]:
        tight = np.flatnonzero(room[: None if self._any_side() else 13] < turning_room + 0.02)
        if len(tight) and self._arc[-1] > 0.0:
            middle = float(self._arc[self._index + int(tight[0])])
            along = self._point(middle + 0.3) - self._point(max(middle - 0.2, 0.0))
            if np.hypot(*along) > 0.05:
                wanted = math.atan2(along[1], along[0])
                if self._any_side():
                    spare = self._robot.circumscribed_radius_m - self._half_across()
                    sideways = room[tight[0] :].min() >= turning_room - spare
                    return nearest_axis(pose[2], wanted, 4 if sideways else 2), max(0.0, middle - at)
                enclosed = float(near.at(pose[None, :2])[0]) < turning_room
                back = abs(geometry.wrap_scalar(wanted - pose[2])) > 0.5 * math.pi
                if self._lidar.field_of_view_deg >= 270.0 and enclosed and back:
                    wanted = geometry.wrap_scalar(wanted + math.pi)
                return wanted, max(0.0, middle - at)
        if self.remaining_m < 0.4:
            return self._heading, None
        if self._any_side():
            return self._soonest_heading(float(pose[2]), at), None
        along = self._point(at + 0.7) - self._point(at + 0.1)
        return math.atan2(along[1], along[0]), None

    def _any_side(self) -> bool:
        return self.config.any_side and self._lidar.field_of_view_deg >= 360.0

    def _soonest_heading(self, heading: float, at: float) -> float:
        pieces = int(np.clip(int((self._arc[-1] - at) / 0.2), 1, 15))
        steps = [self._point(at + 0.2 * (k + 1)) - self._point(at + 0.2 * k) for k in range(pieces)]
        along = np.array([math.atan2(s[1], s[0]) if np.hypot(*s) > 1e-6 else heading for s in steps])
        best, least = heading, math.inf
        for wanted in [heading, *(nearest_axis(heading, a, 4) for a in along)]:
            covered = rims_cover(along, wanted, 0.2) + self._robot.lever_m * abs(wanted - heading)
            if covered < least - 1e-9:
                best, least = wanted, covered
        return best

    def _send(
        self, velocity: Array, turn: float, observation: Mapping[str, Any] | None, belief: Belief, near: LocalMap,
        gap: float,
    ) -> Array:  # fmt: skip
        config, pose, seen = self.config, belief.pose, hits(observation, self._lidar)
        change = velocity - self._velocity
        step = float(np.hypot(*change))
        limit = config.acceleration_m_s2 * self._step_s
        smooth = self._velocity + change * min(1.0, limit / step if step > 0 else 1.0)
        spin = config.turn_acceleration_rad_s2 * self._step_s
        turn = float(np.clip(turn, self._turn - spin, self._turn + spin))
        body = geometry.rotation(-(pose[2] + 0.5 * turn * self._step_s)) @ smooth
        twist = self._within_wheel_limits(np.array([body[0], body[1], turn]))
        sent = self._safe(twist, pose, near, gap, seen)
        wish = abs(velocity[0]) + abs(velocity[1]) > 0.03 or abs(turn) > 0.05
        self.blocked = bool(wish and not sent.any())
        self._velocity = geometry.rotation(pose[2] + 0.5 * sent[2] * self._step_s) @ sent[:2]
        self._turn = float(sent[2])
        return sent

    def _within_wheel_limits(self, twist: Array) -> Array:
        demand = abs(twist[0]) + abs(twist[1]) + self._robot.lever_m * abs(twist[2])
        return twist * (self._robot.max_speed_m_s / demand) if demand > self._robot.max_speed_m_s else twist

    def _safe(self, twist: Array, pose: Array, near: LocalMap, gap: float, seen: Array) -> Array:
        now = body_gaps(np.zeros(3), pose, near, seen, self._guard)[::2]
        slack = []
        for which, (gap_now, least) in enumerate(zip(now, (gap, self.config.scan_gap_m), strict=True)):
            # From step to step 2 mm nearer would be at the wall in the end: they are from the farthest since.
            self._floors[which] = max(self._floors[which], gap_now - 0.002) if gap_now < least else -math.inf
            slack.append(min(max(gap_now - self._floors[which], 1e-6), 0.002))
        if not twist.any():
            return twist
        candidates = [twist * share for share in SPEEDS]
        candidates += [twist * np.array([share, share, 0.0]) for share in SPEEDS[:4]]
        candidates.append(twist * np.array([0.0, 0.0, 1.0]))
        slow = 0.12 * twist[:2] / max(float(np.hypot(*twist[:2])), 0.12)
        candidates += [np.append(geometry.rotation(angle) @ slow, 0.0) for angle in SIDESTEPS]
        for candidate in candidates:
            if candidate.any() and self._is_safe(candidate, pose, near, gap, seen, *slack):
                return candidate
        return np.zeros(3)

    def _is_safe(
        self,
        twist: Array,
        pose: Array,
        near: LocalMap,
        gap: float,
        seen: Array,
        map_slack: float,
        scan_slack: float,
    ) -> bool:
        map_now, map_ahead, scan_now, scan_ahead = body_gaps(twist, pose, near, seen, self._guard)
        clear_of_map = map_ahead >= min(gap, map_now - map_slack)
        clear_of_scan = scan_ahead >= min(self.config.scan_gap_m, scan_now - scan_slack)
        return bool(clear_of_map and clear_of_scan)


def nearest_axis(heading: float, along: float, axes: int) -> float:
    """Return the nearest heading in which one of so many axes of the body lies along a direction."""
    choices = along + 2.0 * math.pi / axes * np.arange(-2 * axes, 2 * axes)
    return float(choices[np.argmin(np.abs(choices - heading))])


def rims_cover(along: Array, heading: float, piece_m: float) -> float:
    """Return the way [m] of the busiest wheel's rim along pieces of a path, at one heading."""
    return piece_m * float((np.abs(np.cos(along - heading)) + np.abs(np.sin(along - heading))).sum())


def hits(observation: Mapping[str, Any] | None, lidar: LidarConfig, within_m: float = 2.0) -> Array:
    """Return what the scan hit nearby ``(n, 2)`` [m], in the body frame."""
    if observation is None:
        return np.zeros((0, 2))
    share = np.asarray(observation["scan"], dtype=np.float64)
    ranges = share * lidar.range_max_m
    hit = (share < 1.0) & (ranges > lidar.range_min_m) & (ranges < within_m)
    angles = lidar.angle_min + lidar.angle_increment * np.flatnonzero(hit)
    return np.stack([lidar.offset_m + ranges[hit] * np.cos(angles), ranges[hit] * np.sin(angles)], axis=1)
