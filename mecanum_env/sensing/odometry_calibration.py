"""Odometry calibration: V of the simulated robot, found by experiment (docs/reference/motion.md).

The robot is driven over an open floor, and what its wheels say is held against where it truly went. A wheel's
radius stays wrong for a whole episode, so there are two answers: the *white* one, of single steps, and the
*lasting* one, from the drift over a second, which a filter needs that takes all steps' errors for independent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mecanum_env.config import NoiseConfig, RobotConfig
from mecanum_env.physics.robot import WheelTargets
from mecanum_env.physics.world import World
from mecanum_env.rooms.floor_plan import FloorPlan
from mecanum_env.sensing.sensors import WheelEncoders
from slam.motion import OdometryNoise, twist_between
from slam.types import Array

__all__ = ["Calibration", "Drives", "drift_ratios", "drive", "fit", "open_floor"]

WINDOW_S = 0.8
"""Over which drift is measured: about as long as it takes the landmarks to correct the pose."""

_SIDE_M = 16.0  # of the floor
_TURN_BACK_M = 5.0  # from its middle
_ACCELERATION_M_S2 = 0.8  # less than what makes the wheels slip, as the agents drive
_SEGMENT_S = (1.0, 3.0)  # how long a twist is asked for
_STOPS = 0.2  # share of the segments
_BINS = 8  # of speed
_MOVING_M_S = 0.05  # windows slower than that tell nothing of V's shares


@dataclass(frozen=True, eq=False)
class Drives:
    """What was measured and what was true, of several episodes."""

    measured: Array  # (episodes, steps, 3) body twist by the wheels: m/s, m/s, rad/s
    true: Array  # (episodes, steps, 3) the twist that leads from each true pose to the next
    slips: Array  # (episodes, steps, 2) 1σ of what the wheels slipped: m/s, rad/s
    dt: float  # [s]

    @property
    def errors(self) -> Array:
        """Measured minus true ``(episodes, steps, 3)``."""
        return self.measured - self.true

    def speeds(self, lever_m: float) -> Array:
        """Return the wheels' speed ``(episodes, steps)`` [m/s], as :class:`slam.motion.OdometryNoise` has it."""
        v = self.measured
        return np.asarray(np.sqrt(v[..., 0] ** 2 + v[..., 1] ** 2 + (lever_m * v[..., 2]) ** 2))

    def windows(self) -> tuple[int, int]:
        """Return how many windows of :data:`WINDOW_S` an episode has, and the steps of each."""
        size = round(WINDOW_S / self.dt)
        return self.measured.shape[1] // size, size


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """V as measured, white and lasting: σ = floor + share · wheels' speed, of either linear component and of ω."""

    white: OdometryNoise
    lasting: OdometryNoise
    gain: Array  # (3,) by which share of it the wheels claim more than was driven, on average: vx, vy, ω
    bins: Array  # (bins, 5) the wheels' speed [m/s]; σ white of v [m/s] and ω [rad/s]; σ lasting of v and ω
    steps: int


# ---- driving ---------------------------------------------------------------------------------------------------


def drive(
    robot: RobotConfig, noise: NoiseConfig, *, episodes: int = 60, steps: int = 400, seed: int = 0
) -> Drives:
    """Drive a robot by smooth random twists, with stops, over an open floor.

    Parameters
    ----------
    robot, noise
        Each episode draws its own wheel radii, lever and slippery patches.
    episodes, steps
        How many, and the control steps of each.
    seed
        Of the first episode; the others follow.
    """
    step_s, physics_step_s = 0.1, 0.02  # as the environments have them
    measured, true, slips = (np.empty((episodes, steps, n)) for n in (3, 3, 2))
    plan = open_floor()
    for episode in range(episodes):
        world_rng, sensor_rng, drive_rng = (
            np.random.Generator(np.random.PCG64(s)) for s in np.random.SeedSequence(seed + episode).spawn(3)
        )
        encoders = WheelEncoders(robot, noise, world_rng)
        world = World(
            plan, robot, noise, world_rng, true_radii=encoders.true_radii, true_lever=encoders.true_lever
        )
        driver, targets = _Driver(robot, drive_rng, step_s), WheelTargets(robot)
        for k in range(steps):
            before = world.pose
            world.step(targets.of_twist(driver.action(before)), step_s, physics_step_s)
            odometry = encoders.odometry(world.wheel_readings, step_s, sensor_rng)
            measured[episode, k], slips[episode, k] = odometry.twist, odometry.slip
            true[episode, k] = twist_between(before, world.pose, step_s)
    return Drives(measured, true, slips, step_s)


def open_floor() -> FloorPlan:
    """Return an empty square, wide enough that nothing is touched."""
    half, resolution = 0.5 * _SIDE_M, 0.1
    corners = np.array([(-half, -half), (half, -half), (half, half), (-half, half)])
    cells = round(_SIDE_M / resolution)
    return FloorPlan(
        name="open floor",
        walls=np.hstack([corners, np.roll(corners, -1, axis=0)]),
        free=np.ones((cells, cells), np.bool_),
        resolution=resolution,
        origin=(-half, -half),
        start=(0.0, 0.0, 0.0),
    )


class _Driver:
    """Asks for one random twist after another, and lets the robot speed up to it gently."""

    def __init__(self, robot: RobotConfig, rng: np.random.Generator, step_s: float) -> None:
        self._rng, self._step_s = rng, step_s
        self._limits = np.array([robot.max_speed_m_s, robot.max_speed_m_s, robot.max_turn_rate_rad_s])
        self._most = _ACCELERATION_M_S2 * step_s  # [m/s] change of the wheels' speed in a step
        self._metric = np.array([1.0, 1.0, robot.lever_m])
        self._twist, self._target = np.zeros(3), np.zeros(3)
        self._left = 0.0

    def action(self, pose: Array) -> Array:
        """Return the next action ``(3,)``, fractions of the limits, of a robot at a pose in the world frame."""
        self._left -= self._step_s
        if self._left <= 0.0:
            self._left = self._rng.uniform(*_SEGMENT_S)
            self._target = self._choose(pose)
        change = self._target - self._twist
        size = float(np.linalg.norm(self._metric * change))
        self._twist = self._twist + change * min(1.0, self._most / max(size, 1e-12))
        return np.asarray(self._twist / self._limits)

    def _choose(self, pose: Array) -> Array:
        rng = self._rng
        way, speed, turn = rng.uniform(-math.pi, math.pi), math.sqrt(rng.random()), rng.uniform(-1.0, 1.0)
        if rng.random() < _STOPS:
            return np.zeros(3)
        if math.hypot(pose[0], pose[1]) > _TURN_BACK_M:  # straight back to the middle
            way, turn = math.atan2(-pose[1], -pose[0]) - float(pose[2]), 0.0
        # Together within what the wheels can do: |vx| + |vy| + l |ω| ≤ the speed limit.
        share = rng.random() if turn else 1.0
        linear = share * speed * self._limits[0] / (abs(math.cos(way)) + abs(math.sin(way)))
        most_turn = min(self._limits[2], (1.0 - share) * self._limits[0] / self._metric[2])
        return np.array([linear * math.cos(way), linear * math.sin(way), turn * most_turn])


# ---- from errors to V ------------------------------------------------------------------------------------------


def fit(drives: Drives, lever_m: float) -> Calibration:
    """Fit V to drives, white and lasting.

    White is the errors' scatter about their mean of the window. Lasting is W · (mean error of the window)², W the
    steps of a window: the variance that W independent errors would need to drift as far, biases counted in.
    """
    count, size = drives.windows()
    windows = len(drives.measured) * count
    errors = drives.errors[:, : count * size].reshape(windows, size, 3)
    speed = np.sqrt(np.mean(drives.speeds(lever_m)[:, : count * size].reshape(windows, size) ** 2, axis=1))
    mean = errors.mean(axis=1)  # (windows, 3)
    white = np.sum((errors - mean[:, None]) ** 2, axis=1) / (size - 1)
    variances = np.column_stack([_by_kind(white), _by_kind(size * mean**2)])  # (windows, 4)
    bins = [b for b in np.array_split(np.argsort(speed, kind="stable"), _BINS) if len(b)]
    squares = np.array([[np.mean(speed[b] ** 2), *variances[b].mean(axis=0)] for b in bins])
    table = np.sqrt(squares)
    every = drives.measured.reshape(-1, 3)
    return Calibration(
        white=_as_noise(table[:, 0], table[:, 1:3], lever_m),
        lasting=_as_noise(table[:, 0], table[:, 3:5], lever_m),
        gain=np.sum(drives.errors.reshape(-1, 3) * every, axis=0) / np.sum(every**2, axis=0),
        bins=table,
        steps=len(every),
    )


def drift_ratios(drives: Drives, noise: OdometryNoise) -> tuple[float, float]:
    """Return how much larger than declared the drift over a window is: of vx and vy, and of ω.

    The mean of (Σ e)² / Σ V over the windows in which the robot moves: ideal 1, above it V is
    too small.
    """
    count, size = drives.windows()
    v, w = np.empty(drives.measured.shape[:2]), np.empty(drives.measured.shape[:2])
    for step in np.ndindex(v.shape):
        along, turning = drives.slips[step]
        v[step], w[step] = noise.variances(*drives.measured[step], slip=(along, turning))
    shape = (len(v), count, size)
    sums = drives.errors[:, : count * size].reshape(*shape, 3).sum(axis=2)
    var_v, var_w = (a[:, : count * size].reshape(shape).sum(axis=2) for a in (v, w))
    speeds = drives.speeds(noise.lever_m)[:, : count * size].reshape(shape)
    moving = np.sqrt(np.mean(speeds**2, axis=2)) > _MOVING_M_S
    linear = 0.5 * (sums[..., 0] ** 2 + sums[..., 1] ** 2)
    return float(np.mean(linear[moving] / var_v[moving])), float(np.mean(sums[moving, 2] ** 2 / var_w[moving]))


def _by_kind(variances: Array) -> Array:
    """Return of the variances ``(n, 3)`` of vx, vy, ω the mean of the first two and the last ``(n, 2)``."""
    return np.column_stack([0.5 * (variances[:, 0] + variances[:, 1]), variances[:, 2]])


def _as_noise(speed: Array, sigmas: Array, lever_m: float) -> OdometryNoise:
    (floor_v, share_v), (floor_w, share_w) = (_line(speed, column) for column in sigmas.T)
    return OdometryNoise(
        lever_m=lever_m, speed_floor_m_s=floor_v, speed_share=share_v, turn_floor_rad_s=floor_w,
        turn_share_rad_m=share_w,
    )  # fmt: skip


def _line(speed: Array, sigma: Array) -> tuple[float, float]:
    """Fit σ = floor + share · speed, neither below zero."""
    share, floor = np.polyfit(speed, sigma, 1)
    if floor < 0.0:
        return 0.0, float(speed @ sigma / (speed @ speed))
    return (float(floor), float(share)) if share > 0.0 else (float(sigma.mean()), 0.0)
