"""What the robot senses: a planar lidar, and encoders on its wheels; with the noise that the config declares.

Each sensor draws the same number of random numbers every step, whatever there is to see: two runs with the same
seed have the same noise even where another agent or estimator takes the robot elsewhere.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from mecanum_env.config import LidarConfig, NoiseConfig, RobotConfig
from mecanum_env.raycast import beam_directions, cast_rays
from mecanum_env.robot import forward_matrix
from slam.types import Odometry, Scan

__all__ = ["Lidar", "WheelEncoders"]

Array = NDArray[np.float64]


@njit(cache=True, nogil=True)
def _measure(
    ranges: Array,
    normals: Array,
    uniforms: Array,
    sigma: float,
    dropout: float,
    range_min: float,
    range_max: float,
) -> None:
    """Turn true ranges [m] into measured ones, in place (REP 117: ``inf`` no return, ``nan`` no measurement)."""
    for k in range(ranges.shape[0]):
        measured = ranges[k] + sigma * normals[k]
        if measured > range_max:
            measured = np.inf
        if uniforms[k] < dropout or measured < range_min:
            measured = np.nan
        ranges[k] = measured


class Lidar:
    """A planar lidar at A, ``offset_m`` ahead of the robot's centre (theory.md A).

    Parameters
    ----------
    config
        Beams, field of view, range limits and mounting.
    noise
        ``range_sigma_m`` and ``dropout``.
    """

    def __init__(self, config: LidarConfig, noise: NoiseConfig) -> None:
        self.config = config
        self.noise = noise
        self._angle_min, self._angle_increment = config.angle_min, config.angle_increment
        self._directions = beam_directions(config.beams, self._angle_min, self._angle_increment)

    def true_ranges(self, segments: Array, circles: Array, pose: ArrayLike) -> Array:
        """Return the exact range of each beam ``(beams,)`` [m], ``inf`` beyond ``range_max_m``.

        Parameters
        ----------
        segments, circles
            Surfaces ``(n, 4)`` and discs ``(c, 3)`` in the world frame [m]: ``FloorPlan.segments``, ``.circles``.
        pose
            Of the robot's centre in the world frame ``(3,)``; the sensor is ``offset_m`` ahead of it.
        """
        config = self.config
        x, y, theta = np.asarray(pose, dtype=np.float64).tolist()
        out = np.empty(config.beams)
        cast_rays(
            segments,
            circles,
            x + config.offset_m * math.cos(theta),
            y + config.offset_m * math.sin(theta),
            theta,
            self._directions,
            self._angle_min,
            self._angle_increment,
            config.range_max_m,
            out,
        )
        return out

    def scan(self, segments: Array, circles: Array, pose: ArrayLike, rng: np.random.Generator) -> Scan:
        """Return one sweep from a robot at ``pose``; arguments as in :meth:`true_ranges`.

        ``rng`` yields ``beams`` normal and ``beams`` uniform numbers.
        """
        config = self.config
        ranges = self.true_ranges(segments, circles, pose)
        _measure(
            ranges,
            rng.standard_normal(config.beams),
            rng.random(config.beams),
            self.noise.range_sigma_m,
            self.noise.dropout,
            config.range_min_m,
            config.range_max_m,
        )
        return Scan(
            ranges=ranges,
            angle_min=self._angle_min,
            angle_increment=self._angle_increment,
            range_max=config.range_max_m,
            range_min=config.range_min_m,
        )


class WheelEncoders:
    """Encoders on the four wheels, and the systematic errors of the robot they are mounted on.

    Odometry is reckoned with the nominal wheel radius and lever. The true ones differ, each wheel's radius and
    the lever by a relative error drawn uniformly when this is built: once an episode.

    Parameters
    ----------
    robot
        The nominal robot.
    noise
        ``encoder``, ``radius_error`` and ``base_error``.
    rng
        Yields five uniform numbers.

    Attributes
    ----------
    true_radii
        ``(4,)`` [m], for :class:`mecanum_env.world.World`.
    true_lever
        [m], likewise.
    """

    def __init__(self, robot: RobotConfig, noise: NoiseConfig, rng: np.random.Generator) -> None:
        self.robot = robot
        self.noise = noise
        self._forward = forward_matrix(robot)  # (3, 4)
        u = rng.uniform(-1.0, 1.0, size=5)
        self.true_radii: Array = robot.wheel_radius_m * (1.0 + noise.radius_error * u[:4])
        self.true_lever = float(robot.lever_m * (1.0 + noise.base_error * u[4]))

    def odometry(self, wheel_increments: ArrayLike, dt: float, rng: np.random.Generator) -> Odometry:
        """Return the body twist that the wheels' measured rotation stands for.

        Parameters
        ----------
        wheel_increments
            How far each wheel turned ``(4,)`` [rad].
        dt
            In what time [s].
        rng
            Yields four normal numbers: a measured increment is the true one times 1 + ``encoder`` · N(0, 1).
        """
        factors = (self.noise.encoder / dt) * rng.standard_normal(4)
        factors += 1.0 / dt
        factors *= np.asarray(wheel_increments, dtype=np.float64)
        return Odometry(twist=self._forward @ factors, dt=dt)
