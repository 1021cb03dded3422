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
from mecanum_env.physics.robot import GRAVITY_M_S2, forward_matrix
from mecanum_env.sensing.noise import NoiseStream, RandomNumbers, fill_normal, fill_uniform
from mecanum_env.sensing.raycast import beam_directions, cast_rays
from mecanum_env.sensing.slip import add_up, follow, mean_of_slipperiest, slipperiest, spread, traction_constants
from slam.odometry.filters import OdometryFilter
from slam.types import Array, Flags, Odometry, Scan

__all__ = ["FilteredEncoders", "Lidar", "WheelEncoders"]

# What encoders remember of the step before, and what stays the same: one array each, since arguments take time.
_LAST_TWIST, _SPEEDS = slice(0, 3), slice(3, 7)
_BODY, _BODY_ON_PATCH, _SLID = slice(7, 10), slice(10, 13), slice(13, 16)
_SIGMA, _ROLLING, _RADIUS, _PATCHES, _SPREAD = range(5)
_CREEP, _FLOOR, _PATCH, _FORWARD = slice(5, 8), slice(8, 12), slice(12, 16), slice(16, 28)

_ON_AND_OFF = 0.7  # share of what slips along that turns a body which may stand with one side on a patch
_CREEP_ERROR = 0.33  # σ of the creep, of which the mean is taken out: measured


@njit(cache=True, nogil=True)
def _sweep(
    segments: Array, circles: Array, pose: Array, directions: Array, limits: Array, normals: Array,
    uniforms: Array, out: Array,
) -> None:  # fmt: skip
    """Cast the rays of a robot at a pose, and measure them (REP 117: ``inf`` no return, ``nan`` no measurement).

    ``limits`` are those of :class:`Lidar`.
    """
    offset, angle_min, angle_increment = limits[0], limits[1], limits[2]
    range_max, range_min, sigma, dropout = limits[3], limits[4], limits[5], limits[6]
    theta = pose[2]
    x, y = pose[0] + offset * math.cos(theta), pose[1] + offset * math.sin(theta)
    cast_rays(segments, circles, x, y, theta, directions, angle_min, angle_increment, range_max, out)
    for k in range(out.shape[0]):
        measured = out[k] + sigma * normals[k]
        if measured > range_max:
            measured = np.inf
        if uniforms[k] < dropout or measured < range_min:
            measured = np.nan
        out[k] = measured


@njit(cache=True, nogil=True)
def _noisy_sweep(
    segments: Array, circles: Array, pose: Array, directions: Array, limits: Array, words: NDArray[np.uint64],
    out: Array,
) -> None:  # fmt: skip
    """Draw the noise of a sweep from the words of a :class:`NoiseStream`, and do :func:`_sweep`."""
    noise = np.empty((2, out.shape[0]))
    fill_normal(words, noise[0])
    fill_uniform(words, noise[1])
    _sweep(segments, circles, pose, directions, limits, noise[0], noise[1], out)


@njit(cache=True, nogil=True)
def _without(
    bodies: Array, segments: Array, circles: Array, pose: Array, directions: Array, limits: Array, ranges: Array,
    seen: Flags,
) -> None:  # fmt: skip
    """Write NaN for the ranges of beams that come back from bodies, and tell of which bodies some do."""
    offset, angle_min, angle_increment, range_max = limits[0], limits[1], limits[2], limits[3]
    x, y, theta = pose[0] + offset * math.cos(pose[2]), pose[1] + offset * math.sin(pose[2]), pose[2]
    beams, nearest = np.empty((len(bodies), ranges.shape[0])), np.full(ranges.shape[0], np.inf)
    for k in range(len(bodies)):
        cast_rays(
            bodies[k], circles[:0], x, y, theta, directions, angle_min, angle_increment, range_max, beams[k]
        )  # fmt: skip
        for i in range(ranges.shape[0]):
            nearest[i] = min(nearest[i], beams[k, i])
    if nearest.min() == np.inf:
        return
    surfaces = np.empty(ranges.shape[0])
    cast_rays(segments, circles, x, y, theta, directions, angle_min, angle_increment, range_max, surfaces)
    for i in range(ranges.shape[0]):
        if nearest[i] < surfaces[i]:
            ranges[i] = np.nan
            for k in range(len(bodies)):
                seen[k] |= beams[k, i] == nearest[i]


class Lidar:
    """A planar lidar at A, ``offset_m`` ahead of the robot's centre (docs/reference/sensors.md).

    Parameters
    ----------
    config
        Beams, field of view, range limits and mounting.
    noise
        ``range_sigma_m`` and ``dropout``.
    """

    def __init__(self, config: LidarConfig, noise: NoiseConfig) -> None:
        self.config = config
        self._angle_min, self._angle_increment = config.angle_min, config.angle_increment
        self._directions = beam_directions(config.beams, self._angle_min, self._angle_increment)
        # One array, since each argument of a call takes time to unpack.
        self._limits = np.array([
            config.offset_m, self._angle_min, self._angle_increment, config.range_max_m, config.range_min_m,
            noise.range_sigma_m, noise.dropout,
        ])  # fmt: skip
        self._beams = config.beams
        self._of_scan = self._angle_min, self._angle_increment, config.range_max_m, config.range_min_m

    def true_ranges(self, segments: Array, circles: Array, pose: ArrayLike) -> Array:
        """Return the exact range of each beam ``(beams,)`` [m], ``inf`` beyond ``range_max_m``.

        Parameters
        ----------
        segments, circles
            Surfaces ``(n, 4)`` and discs ``(c, 3)`` in the world frame [m]: ``FloorPlan.segments``, ``.circles``.
        pose
            Of the robot's centre in the world frame ``(3,)``; the sensor is ``offset_m`` ahead of it.
        """
        config, out = self.config, np.empty(self._beams)
        x, y, theta = np.asarray(pose, dtype=np.float64).tolist()
        x, y = x + config.offset_m * math.cos(theta), y + config.offset_m * math.sin(theta)
        cast_rays(
            segments, circles, x, y, theta, self._directions, self._angle_min, self._angle_increment,
            config.range_max_m, out,
        )  # fmt: skip
        return out

    def scan(self, segments: Array, circles: Array, pose: ArrayLike, rng: RandomNumbers) -> Scan:
        """Return one sweep from a robot at ``pose``; arguments as in :meth:`true_ranges`.

        ``rng`` yields ``beams`` normal and ``beams`` uniform numbers.
        """
        ranges, pose = np.empty(self._beams), np.asarray(pose, dtype=np.float64)
        if isinstance(rng, NoiseStream):
            _noisy_sweep(segments, circles, pose, self._directions, self._limits, rng.words, ranges)
        else:
            normals, uniforms = rng.standard_normal(self._beams), rng.random(self._beams)
            _sweep(segments, circles, pose, self._directions, self._limits, normals, uniforms, ranges)
        return Scan(ranges, *self._of_scan)

    def without(
        self, bodies: Array, segments: Array, circles: Array, pose: Array, scan: Scan
    ) -> tuple[Scan, Flags]:
        """Return a scan with NaN for each beam that a body sent back, and of which bodies ``(n,)`` there are such.

        Parameters
        ----------
        bodies
            The sides of bodies ``(n, sides, 4)`` in the world frame [m], all of one number of sides.
        segments, circles
            As in :meth:`true_ranges`: what stands before a body hides it.
        pose
            ``(3,)`` that the scan was taken from.
        scan
            Of :meth:`scan`, with the bodies among its surfaces. It stays as it is.
        """
        ranges, seen = scan.ranges.copy(), np.zeros(len(bodies), np.bool_)
        _without(bodies, segments, circles, pose, self._directions, self._limits, ranges, seen)
        return (scan._replace(ranges=ranges) if seen.any() else scan), seen


def creep(robot: RobotConfig, noise: NoiseConfig) -> Array:
    """Return by how much of a second's acceleration the wheels run ahead of the body ``(3,)`` [s]: vx, vy, ω.

    A wheel drives by slipping a little: each passes on μ N / s₀ times its slip along the roller's axis
    (:mod:`mecanum_env.physics.robot`), a quarter of the force at 45° to it.
    """
    linear = 2.0 * robot.slip_speed_m_s / (noise.friction * GRAVITY_M_S2)
    return np.array([linear, linear, linear * robot.inertia_kg_m2 / (robot.mass_kg * robot.lever_m**2)])


class WheelEncoders:
    """Encoders on the four wheels, and the systematic errors of the robot they are mounted on.

    Odometry is reckoned with the nominal wheel radius and lever, less the mean share that is lost to slip and the
    creep of wheels that accelerate, as one who has calibrated it would. The true ones differ, each wheel's radius
    and the lever by a relative error drawn uniformly when this is built: once an episode.

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
        ``(4,)`` [m], for :class:`mecanum_env.physics.world.World`.
    true_lever
        [m], likewise.
    """

    def __init__(self, robot: RobotConfig, noise: NoiseConfig, rng: np.random.Generator) -> None:
        self._fixed = np.concatenate([
            [noise.encoder, 1.0 - noise.slip, robot.wheel_radius_m],
            # All patches make slip as much as these of the slipperiest kind would.
            [noise.patch_share * mean_of_slipperiest(noise), spread(noise)],
            creep(robot, noise), traction_constants(robot, noise.friction),
            traction_constants(robot, slipperiest(noise)), forward_matrix(robot).ravel(),
        ])  # fmt: skip
        self._last = np.zeros(16)  # see _LAST_TWIST and those after it
        u = rng.uniform(-1.0, 1.0, size=5)
        self.true_radii: Array = robot.wheel_radius_m * (1.0 + noise.radius_error * u[:4])
        self.true_lever = float(robot.lever_m * (1.0 + noise.base_error * u[4]))

    def odometry(self, readings: ArrayLike, dt: float, rng: RandomNumbers) -> Odometry:
        """Return the body twist that the wheels' measured rotation stands for, and what of it may be slip.

        Parameters
        ----------
        readings
            How far each wheel had turned at some moments, as far apart as each other ``(k, 4)`` [rad].
        dt
            From nought to the last of them [s].
        rng
            Yields four normal numbers: a measured increment is the true one times 1 + ``encoder`` · N(0, 1).
        """
        turned = np.asarray(readings, dtype=np.float64)
        twist = np.empty(3)
        if isinstance(rng, NoiseStream):
            slip = _read_noisy_encoders(turned, rng.words, dt, self._fixed, self._last, twist)
        else:
            slip = _read_encoders(turned, rng.standard_normal(4), dt, self._fixed, self._last, twist)
        vx, vy, omega = twist.tolist()
        return Odometry((vx, vy, omega), dt, slip)


class FilteredEncoders:
    """Wheel encoders with a filter behind them, reset when this is built: once an episode."""

    def __init__(self, encoders: WheelEncoders, behind: OdometryFilter) -> None:
        self._encoders, self._filter = encoders, behind
        behind.reset()

    def odometry(self, readings: ArrayLike, dt: float, rng: RandomNumbers) -> Odometry:
        """Return the filtered twist; see :meth:`WheelEncoders.odometry`."""
        return self._filter.filter(self._encoders.odometry(readings, dt, rng))


@njit(cache=True, nogil=True, error_model="numpy")
def _read_encoders(
    readings: Array, normals: Array, dt: float, fixed: Array, memory: Array, twist: Array
) -> tuple[float, float]:
    """Write the body's twist: that of the wheels, less what is lost to slip in the mean and to creep.

    Each wheel's measured rotation is the true one times 1 + σ normal. Returned is 1σ of what slips beside that
    [m/s, rad/s].
    """
    last, before, slid = memory[_LAST_TWIST], memory[_SPEEDS], memory[_SLID]
    creep, forward, count, patches = fixed[_CREEP], fixed[_FORWARD], readings.shape[0], fixed[_PATCHES]
    scale, measured = np.empty(4), np.empty(4)
    wheels, creeps, may = np.empty(3), np.empty(3), np.empty(3)
    for k in range(4):
        scale[k] = 1.0 + fixed[_SIGMA] * normals[k]
    for i in range(3):
        total = 0.0
        for k in range(4):
            total += forward[4 * i + k] * (readings[count - 1, k] * scale[k])
        wheels[i] = fixed[_ROLLING] / dt * total
    lost, lost_on_patch, to_speed = np.zeros(3), np.zeros(3), fixed[_ROLLING] * fixed[_RADIUS] * count / dt
    slips, slips_on_patch = 0, 0
    for step in range(count):
        for k in range(4):
            turned = readings[step, k] - (readings[step - 1, k] if step else 0.0)
            measured[k] = to_speed * scale[k] * turned
        slips += follow(memory[_BODY], before, measured, dt / count, fixed[_FLOOR], lost)
        if patches > 0.0:
            slips_on_patch += follow(
                memory[_BODY_ON_PATCH], before, measured, dt / count, fixed[_PATCH], lost_on_patch
            )
        for k in range(4):
            before[k] = measured[k]
    lever = fixed[_FLOOR][3]
    lost[2] /= lever
    lost_on_patch[2] /= lever
    # Wheels that grip creep: by the acceleration of a body whose axes turn with it.
    vx, vy, omega = wheels[0], wheels[1], wheels[2]
    creeps[0] = creep[0] * ((vx - last[0]) / dt - omega * vy)
    creeps[1] = creep[1] * ((vy - last[1]) / dt + omega * vx)
    creeps[2] = creep[2] * ((omega - last[2]) / dt)
    last[0], last[1], last[2] = vx, vy, omega
    grips = 1.0 - ((1.0 - patches) * slips + patches * slips_on_patch) / count
    for i in range(3):
        expected = (1.0 - patches) * lost[i] + patches * lost_on_patch[i]
        twist[i] = wheels[i] - grips * creeps[i] - expected / dt
        may[i] = fixed[_SPREAD] * (lost_on_patch[i] - lost[i] if patches > 0.0 else lost[i])
    along, turned = add_up(slid, may, dt, slips + slips_on_patch > 0)
    turned = math.hypot(turned, _ON_AND_OFF * along / lever)
    crept, twisted = _CREEP_ERROR * math.hypot(creeps[0], creeps[1]), _CREEP_ERROR * abs(creeps[2])
    return max(along / dt, crept), max(turned / dt, twisted)


@njit(cache=True, nogil=True)
def _read_noisy_encoders(
    readings: Array, words: NDArray[np.uint64], dt: float, fixed: Array, memory: Array, twist: Array
) -> tuple[float, float]:
    """Draw the normals from the words of a :class:`NoiseStream`, and do :func:`_read_encoders`."""
    normals = np.empty(4)
    fill_normal(words, normals)
    return _read_encoders(readings, normals, dt, fixed, memory, twist)
