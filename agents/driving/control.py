"""Following a path with a body that can move any way: pure pursuit, with the heading turned alongside."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from agents.driving.follow import WINDOW_M, Motors, Pace, aim, send
from agents.driving.safety import (
    Guard,
    LocalMap,
    escape_twist,
    footprint,
    local_map,
    scan_points,
    scan_shares,
)
from agents.driving.sides import parting_lines
from agents.ways.cost_map import position_sigma
from mecanum_env.config import LidarConfig, RobotConfig
from slam.belief import Belief
from slam.geometry import rotation
from slam.settings import Angle, Config, Duration, Length, Rate, Within
from slam.types import Array

__all__ = ["ControlConfig", "PathFollower"]

_CREEP_M_S, _CREEP_ROOM_M = 0.2, 1.0
_CREPT_M = 0.2  # between two places that it has crept over
_CREEP_HALF_RAD = 0.35  # half the width of the way that must be free


@dataclass(frozen=True, kw_only=True)
class ControlConfig(Config):
    """Speeds, accelerations and gaps of the path follower."""

    speed_share: Annotated[float, Within("[0.01, 1]")] = 0.95  # of the robot's limit
    near_wall_m_s: Rate = 0.4  # speed at the least clearance at which the robot may turn
    open_m: Length = 0.25  # clearance beyond that one from which walls no longer slow it
    acceleration_m_s2: Rate = 1.2
    deceleration_m_s2: Rate = 0.8  # towards the goal and into turns
    braking_m_s2: Rate = 1.5  # what the safety check counts on: a slippery floor gives no more
    turn_rate_rad_s: Rate = 0.8
    turn_gain: Rate = 2.0  # turn rate per heading error [1/s]
    turn_acceleration_rad_s2: Rate = 3.0
    any_side: bool = False  # whichever side leads is quickest; for lidars that see all round
    lag_s: Duration = 0.2  # a step and the motors' lag: how long a twist is held before braking shows
    look_ahead_s: Duration = 0.7
    min_look_ahead_m: Length = 0.25
    max_look_ahead_m: Length = 0.6
    lateral_m_s2: Rate = 0.5  # in turns of the path
    align_rad: Angle = 0.25  # heading error within which a tight passage is entered
    map_gap_m: Length = 0.04  # between body and occupied cells, and 2σ of the position more, capped
    max_sigma_gap_m: Length = 0.05  # the planner's cap: where a path is planned, it can be driven
    scan_gap_m: Length = 0.04  # between body and what the scan hit
    robot_gap_m: Length = 0.05  # between body and the line that parts it from another robot
    arrival_m_s: Rate = 0.2  # speed at which the goal is reached; what is left is braked away there
    arrived_m: Length = 0.12
    arrived_rad: Angle = 0.2


class PathFollower:
    """Turns a path into body twists, one a step, and never one whose braking distance is blocked.

    The sums of a step are kernels, in :mod:`agents.driving.follow` and :mod:`agents.driving.safety`; here is what
    lasts.
    """

    _turn_within_m = 0.0  # of the goal, where it turns to the goal's heading whatever walls are there

    def __init__(self, config: ControlConfig, *, robot: RobotConfig, lidar: LidarConfig, step_s: float) -> None:
        self._robot, self._lidar, self._step_s = robot, lidar, step_s
        self._rim = footprint(robot)
        self._half = 0.5 * np.array([robot.length_m, robot.width_m])
        self.config = config
        self.reset()

    @property
    def config(self) -> ControlConfig:
        """Speeds, accelerations and gaps; they may be changed on the way."""
        return self._config

    @config.setter
    def config(self, config: ControlConfig) -> None:
        self._config = config
        robot, view_deg = self._robot, self._lidar.field_of_view_deg
        can_m_s2, can_rad_s2 = _motors_can(robot)
        lag_s = max(config.lag_s, self._step_s + robot.motor_lag_s)
        braking = min(config.braking_m_s2, can_m_s2)
        # From v·lag + v²/2a: faster than this it could not stop within what the check looks at.
        ahead = WINDOW_M - robot.circumscribed_radius_m
        self._fastest = math.sqrt((lag_s * braking) ** 2 + 2.0 * braking * max(ahead, 0.1)) - lag_s * braking
        fastest = min(self._fastest, robot.max_speed_m_s)
        self._stop_m = fastest * (lag_s + 0.5 * fastest / braking)  # way to a stand from there, at most
        as_they_are = {name: getattr(config, name) for name in Pace._fields if hasattr(config, name)}
        self._pace = Pace(**as_they_are | {
            "max_speed_m_s": min(config.speed_share * robot.max_speed_m_s, self._fastest),
            "deceleration_m_s2": min(config.deceleration_m_s2, can_m_s2),
            "lag_s": lag_s,
            "max_turn_rad_s": min(config.turn_rate_rad_s, robot.max_turn_rate_rad_s),
            "half_length_m": 0.5 * max(robot.length_m, robot.width_m),
            # A sensor that sees all round can as well be driven backwards out of a narrow place.
            "reversible": view_deg >= 270.0,
            "turn_within_m": self._turn_within_m,
            "any_side": config.any_side and view_deg >= 360.0,
            "lever_m": robot.lever_m,
            "wide": robot.width_m > robot.length_m,
            "spare_m": robot.circumscribed_radius_m - self._half_across(),
        })  # fmt: skip
        self._motors = Motors(
            step_s=self._step_s,
            acceleration_m_s2=min(config.acceleration_m_s2, can_m_s2),
            turn_acceleration_rad_s2=min(config.turn_acceleration_rad_s2, can_rad_s2),
            max_speed_m_s=robot.max_speed_m_s,
            lever_m=robot.lever_m,
        )
        self._guard = Guard(
            rim=self._rim,
            half=self._half,
            lag_s=lag_s,
            braking_m_s2=braking,
            turn_braking_rad_s2=min(2.0 * config.turn_acceleration_rad_s2, can_rad_s2),
            scan_gap_m=config.scan_gap_m,
        )

    def _half_across(self) -> float:
        """Return what the body takes up to either side of the way [m] where a long side leads, and askew."""
        askew = self.config.align_rad
        return float(self._half.max() * math.cos(askew) + self._half.min() * math.sin(askew))

    def reset(self) -> None:
        """Stand still, with no path."""
        self._floors = np.full(2, -math.inf)  # see agents.driving.safety.safe_twist
        self._velocity = np.zeros(2)  # last command in the belief's frame [m/s]
        self._turn = 0.0  # last command [rad/s]
        self._path = np.zeros((1, 2))
        self._arc = np.zeros(1)
        self._heading: float | None = None
        self._creeping: float | None = None  # direction [rad, belief's frame] that it creeps in
        self._crept: list[tuple[float, float]] = []  # places [m, belief's frame] that it has crept over
        self._index = 0
        self.blocked = False  # the last step wanted to move and could not
        self.arrived = False
        self.remaining_m = 0.0

    def stand(self) -> None:
        """Take note that the robot was told to stand; the path stays."""
        self._velocity, self._turn = np.zeros(2), 0.0

    @property
    def speed_m_s(self) -> float:
        """Of the last twist that was sent; where it has arrived, as though it drove."""
        return math.inf if self.arrived else math.hypot(*self._velocity)

    def set_path(self, path: Array, heading: float | None) -> None:
        """Follow ``path`` ``(n, 2)`` and end with ``heading`` [rad], or with any where it is ``None``."""
        self._path = np.ascontiguousarray(path, dtype=np.float64)
        self._creeping, self._crept = None, []
        self._arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self._path, axis=0).T))])
        self._heading = heading
        self._index = 0
        self.arrived = False
        self.remaining_m = float(self._arc[-1])

    def follow(self, observation: Mapping[str, Any] | None, belief: Belief) -> Array:
        """Return the next body twist ``(3,)`` [m/s, m/s, rad/s] along the path."""
        pose = np.asarray(belief.pose, dtype=np.float64)
        near, gap = local_map(belief, WINDOW_M), self._map_gap(belief)
        velocity, turn, self._index, self.remaining_m, self.arrived = aim(
            pose,
            math.hypot(*self._velocity),
            self._path,
            self._arc,
            self._index,
            math.nan if self._heading is None else self._heading,
            near,
            self._robot.circumscribed_radius_m + gap,
            self._pace,
        )
        return self._send(velocity, turn, observation, belief, near, gap)

    def drive(self, velocity: Array, turn: float, observation: Mapping[str, Any] | None, belief: Belief) -> Array:
        """Return the twist ``(3,)`` nearest to a velocity ``(2,)`` in the belief's frame that is safe."""
        near, gap = local_map(belief, WINDOW_M), self._map_gap(belief)
        return self._send(velocity, turn, observation, belief, near, gap)

    def escape(self, observation: Mapping[str, Any] | None, belief: Belief) -> Array:
        """Return the twist ``(3,)`` that gets the body to more room, whichever way that is; zero if none does."""
        near, pose = local_map(belief, WINDOW_M), np.asarray(belief.pose, dtype=np.float64)
        hits = scan_points(observation, self._lidar)
        twist: Array = escape_twist(
            pose, near, self._map_gap(belief), hits, self._sides(belief, near), self._guard, self._floors
        )
        self._velocity, self._turn = rotation(float(pose[2])) @ twist[:2], float(twist[2])
        return twist

    def creep(self, observation: Mapping[str, Any] | None, belief: Belief) -> Array:
        """Return a slow twist ``(3,)`` to where the scan shows room, whatever the map says, and rather back.

        For a robot that does not know where on the map it is; where it came from, the map shows most. Where no
        beam returns, from too wide a hall or a blind lidar, it goes back over what it has crept, and then stands.
        """
        lidar, pose = self._lidar, np.asarray(belief.pose, dtype=np.float64)
        scan = scan_shares(observation, lidar)
        if scan is None:
            return np.zeros(3)
        share = scan.astype(np.float64)
        if share.min() >= 1.0:
            return self._creep_back(pose, observation, belief)
        if not self._crept or math.dist(self._crept[-1], pose[:2]) >= _CREPT_M:
            self._crept.append((float(pose[0]), float(pose[1])))
        width = min(max(round(_CREEP_HALF_RAD / lidar.angle_increment), 1), (lidar.beams - 1) // 2)
        # Beside a view that is not all round nothing is known to be free.
        beyond = np.pad(share, width, mode="wrap") if lidar.field_of_view_deg >= 360.0 else np.pad(share, width)
        room = sliding_window_view(beyond, 2 * width + 1).min(axis=1) * lidar.range_max_m
        angles = pose[2] + lidar.angle_min + lidar.angle_increment * np.arange(lidar.beams)
        if self._creeping is None:
            back = self._path[0] - pose[:2]
            self._creeping = math.atan2(back[1], back[0])
        worth = np.minimum(room, _CREEP_ROOM_M) * (2.0 + np.cos(angles - self._creeping))
        self._creeping = angle = float(angles[int(np.argmax(worth))])
        velocity = _CREEP_M_S * np.array([math.cos(angle), math.sin(angle)])
        return self._send(velocity, 0.0, observation, belief, local_map(belief, WINDOW_M), -math.inf)

    def _creep_back(self, pose: Array, observation: Mapping[str, Any] | None, belief: Belief) -> Array:
        """Return the twist ``(3,)`` that creeps to the last place that it crept over, and from there on back."""
        if self._crept and math.dist(self._crept[-1], pose[:2]) < 0.5 * _CREPT_M:
            self._crept.pop()
        if not self._crept:
            return np.zeros(3)
        way = np.array(self._crept[-1]) - pose[:2]
        self._creeping = math.atan2(way[1], way[0])
        velocity = _CREEP_M_S * way / math.hypot(*way)
        return self._send(velocity, 0.0, observation, belief, local_map(belief, WINDOW_M), -math.inf)

    def room(self, belief: Belief, points: Array) -> Array:
        """Return the clearance [m] at points ``(n, 2)`` near the robot, in the belief's frame."""
        return local_map(belief, WINDOW_M).at(points)

    def _map_gap(self, belief: Belief) -> float:
        """Return what the body keeps from the map [m]: the more, the less sure the position is."""
        sigma = position_sigma(belief.pose_cov)
        return self.config.map_gap_m + min(2.0 * sigma, self.config.max_sigma_gap_m)

    def _sides(self, belief: Belief, near: LocalMap) -> Array:
        """Return the lines ``(k, 3)`` that part the body from other robots."""
        return parting_lines(
            belief, near, self._half, gap_m=self.config.robot_gap_m, speed_m_s=self._robot.max_speed_m_s,
            stop_m=self._stop_m,
        )  # fmt: skip

    def _send(
        self, velocity: Array, turn: float, observation: Mapping[str, Any] | None, belief: Belief, near: LocalMap,
        gap: float,
    ) -> Array:  # fmt: skip
        """Smooth, bound and check a wanted velocity (belief frame) and turn rate; remember what goes out."""
        speed = math.hypot(*velocity)
        velocity = velocity * min(1.0, self._fastest / speed) if speed > 0.0 else velocity
        sent, self._velocity, self.blocked = send(
            velocity, turn, self._velocity, self._turn, np.asarray(belief.pose, dtype=np.float64), near, gap,
            scan_points(observation, self._lidar), self._sides(belief, near), self._motors, self._guard,
            self._floors,
        )  # fmt: skip
        self._turn = float(sent[2])
        return np.asarray(sent)


def _motors_can(robot: RobotConfig) -> tuple[float, float]:
    """Return the acceleration that the motors can give along every direction [m/s²], and in turning [rad/s²].

    Along the body's axes all four wheels drive; on a diagonal two do, and give 1/√2 of that.
    """
    wheels_kg = 4.0 * robot.wheel_inertia_kg_m2 / robot.wheel_radius_m**2
    force_n = 4.0 * robot.motor_torque_nm / robot.wheel_radius_m
    along = force_n / (robot.mass_kg + wheels_kg)
    turning = force_n * robot.lever_m / (robot.inertia_kg_m2 + wheels_kg * robot.lever_m**2)
    return along / math.sqrt(2.0), turning
