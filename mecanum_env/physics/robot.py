"""The mecanum robot: exact kinematics, and its wheels' dynamics as one Numba kernel.

Equations and signs are those of docs/reference/robot.md. Wheels are always in the order front left,
front right, rear left, rear right (FL, FR, RL, RR); the body frame has x forward, y left, θ counter-clockwise.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from mecanum_env.config import RobotConfig
from slam.files import quoted
from slam.types import Array

__all__ = [
    "GRAVITY_M_S2",
    "INCREMENTS",
    "POSE",
    "REFERENCES",
    "STATE_SIZE",
    "SUBSTEP_S",
    "TWIST",
    "WHEELS",
    "WheelTargets",
    "dynamics_constants",
    "forward_kinematics",
    "forward_matrix",
    "inverse_kinematics",
    "motor_constants",
    "pull",
    "turn_wheels",
    "wheel_positions",
]

_FLOAT32 = np.dtype(np.float32)  # of what agents send

GRAVITY_M_S2 = 9.80665

ROLLER_SIGN = (-1.0, 1.0, 1.0, -1.0)
"""t_i: the ground roller's axis is (1, t_i)/√2 in the body frame."""
LEVER_SIGN = (-1.0, 1.0, -1.0, 1.0)
"""Sign of the yaw moment of a unit force along each roller's axis: (x_i t_i − y_i)/l."""

SUBSTEP_S = 1e-3
"""Longest inner step of :func:`turn_wheels` [s]; its error is of this order, its stability is not at stake."""
_MORE_ROUNDS = 2  # of finding how the wheels grip, where the motors move the slip by more than s₀ in a substep

# The state that the kernels carry: one array, so that a call unpacks one argument.
POSE = slice(0, 3)
"""x [m], y [m], θ [rad, not wrapped] of the centre of mass in the world frame."""
TWIST = slice(3, 6)
"""vx, vy [m/s], ω [rad/s] in the body frame."""
WHEELS = slice(6, 10)
"""Wheel speeds [rad/s]."""
REFERENCES = slice(10, 14)
"""The speeds that the motors' controllers follow: the lagged commands [rad/s]."""
INCREMENTS = slice(14, 18)
"""Wheel rotation summed since the caller last cleared it [rad]."""
STATE_SIZE = 18


def forward_matrix(robot: RobotConfig) -> Array:
    """Return the matrix ``(3, 4)`` that takes wheel speeds [rad/s] to the body twist that fits them best."""
    return _matrices(robot)[1].copy()


def inverse_kinematics(robot: RobotConfig, twist: ArrayLike) -> Array:
    """Return the wheel speeds ``(4,)`` [rad/s] at which a body twist ``(3,)`` rolls without slip."""
    return np.asarray(_matrices(robot)[0] @ np.asarray(twist, dtype=np.float64))


def forward_kinematics(robot: RobotConfig, wheels: ArrayLike) -> Array:
    """Return the body twist ``(3,)`` that fits wheel speeds ``(4,)`` [rad/s] best (least squares)."""
    return np.asarray(_matrices(robot)[1] @ np.asarray(wheels, dtype=np.float64))


def wheel_positions(robot: RobotConfig) -> Array:
    """Return where the wheels stand in the body frame ``(4, 2)`` [m]."""
    x, y = 0.5 * robot.wheelbase_m, 0.5 * robot.track_m
    return np.array([[x, y], [x, -y], [-x, y], [-x, -y]])


class WheelTargets:
    """Wheel speed targets ``(4,)`` [rad/s] from the actions for one robot, whose limits are looked up only once.

    Parameters
    ----------
    robot
        Its limits are ``max_speed_m_s`` along x and along y, ``max_turn_rate_rad_s`` and
        ``max_wheel_speed_rad_s``.
    """

    def __init__(self, robot: RobotConfig) -> None:
        self._limits = np.array([
            robot.max_speed_m_s, robot.max_turn_rate_rad_s, robot.lever_m, 1.0 / robot.wheel_radius_m,
            robot.max_wheel_speed_rad_s,
        ])  # fmt: skip

    def of_twist(self, action: ArrayLike) -> Array:
        """Return the targets for a body twist ``(3,)`` in fractions of the limits, clipped.

        Where a wheel would have to exceed its limit, all are slowed alike: the motion keeps its direction.
        """
        wheels = np.empty(4)
        fractions = _numbers(action)
        if fractions.shape != (3,) or not _twist_to_wheels(fractions, self._limits, wheels):
            raise _no_action(action, 3)
        return wheels

    def of_wheels(self, action: ArrayLike) -> Array:
        """Return the targets for wheel speeds ``(4,)`` in fractions of the limit, clipped."""
        wheels = np.empty(4)
        fractions = _numbers(action)
        if fractions.shape != (4,) or not _scale_wheels(fractions, self._limits, wheels):
            raise _no_action(action, 4)
        return wheels


def _numbers(action: ArrayLike) -> NDArray[Any]:
    """Return an action as a contiguous array of float32 or float64: the kernels are compiled for nothing else."""
    if type(action) is np.ndarray and action.dtype is _FLOAT32 and action.flags.c_contiguous:
        return action
    try:
        numbers = np.asarray(action)
        return np.empty(0) if numbers.dtype.kind == "c" else np.array(numbers, np.float64)
    except (TypeError, ValueError, OverflowError):
        return np.empty(0)


def _no_action(action: ArrayLike, size: int) -> ValueError:
    return ValueError(f"an action must be {size} finite numbers in [-1, 1], got {quoted(action)}")


@njit(cache=True, nogil=True, error_model="numpy")
def _twist_to_wheels(fractions: NDArray[Any], limits: Array, wheels: Array) -> bool:
    """Write the wheel speeds of a twist; tell whether its numbers are finite (see :class:`WheelTargets`)."""
    for i in range(3):  # each: large ones add up to infinity
        if not math.isfinite(fractions[i]):
            return False
    fx = min(max(fractions[0], -1.0), 1.0)
    fy = min(max(fractions[1], -1.0), 1.0)
    fw = min(max(fractions[2], -1.0), 1.0)
    speed, turn_rate, lever, scale, fastest = limits[0], limits[1], limits[2], limits[3], limits[4]
    vx, vy, turn = fx * speed * scale, fy * speed * scale, fw * turn_rate * lever * scale
    wheels[0], wheels[1], wheels[2], wheels[3] = vx - vy - turn, vx + vy + turn, vx + vy - turn, vx - vy + turn
    excess = max(max(abs(wheels[0]), abs(wheels[1])), max(abs(wheels[2]), abs(wheels[3]))) / fastest
    if excess > 1.0:
        for i in range(4):
            wheels[i] /= excess
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _scale_wheels(fractions: NDArray[Any], limits: Array, wheels: Array) -> bool:
    """Write wheel speeds from fractions of the limit; tell whether these are finite."""
    for i in range(4):
        if not math.isfinite(fractions[i]):
            return False
        wheels[i] = min(max(fractions[i], -1.0), 1.0) * limits[4]
    return True


@lru_cache(maxsize=32)
def _matrices(robot: RobotConfig) -> tuple[Array, Array]:
    lever = robot.lever_m
    columns = [np.ones(4), np.array(ROLLER_SIGN), lever * np.array(LEVER_SIGN)]
    inverse = np.column_stack(columns) / robot.wheel_radius_m
    # The columns are orthogonal, so the pseudo-inverse is the scaled transpose.
    forward = np.vstack([columns[0], columns[1], columns[2] / lever**2]) * (robot.wheel_radius_m / 4.0)
    return inverse, forward


def dynamics_constants(robot: RobotConfig, *, lever_m: float | None = None) -> Array:
    """Return what :func:`turn_wheels` needs to know of a robot, in its order.

    Parameters
    ----------
    robot
        The nominal robot.
    lever_m
        The true lever l [m] where it differs from the nominal one.
    """
    return np.array(
        [
            robot.mass_kg,
            robot.inertia_kg_m2,
            robot.lever_m if lever_m is None else lever_m,
            robot.wheel_inertia_kg_m2,
            robot.wheel_friction,
            robot.motor_gain,
            robot.motor_torque_nm,
            robot.motor_lag_s,
            robot.slip_speed_m_s,
            robot.mass_kg * GRAVITY_M_S2 / 4.0,
        ]
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _motor(wheel: float, reference: float, m: Array) -> float:
    """Return a wheel's speed after motor and bearing have acted on it for a substep (implicit Euler).

    The torque is gain (reference − speed) + friction · reference, within ± limit: the controller knows the
    bearing's viscous friction, so that a freely rolling wheel settles at its reference.
    """
    new: float = wheel + m[1] * (reference - wheel)
    torque: float = m[2] * (reference - new) + m[3] * new
    return new if abs(torque) <= m[4] else m[5] * wheel + math.copysign(m[6], torque)


@njit(cache=True, nogil=True, error_model="numpy")
def motor_constants(constants: Array, h: float, m: Array) -> None:
    """Write the constants ``(7,)`` of a substep of ``h`` [s]: the lag's share, then those of :func:`_motor`."""
    inertia, friction, limit = constants[3], constants[4], constants[6]
    stiffness = constants[5] + friction
    m[0] = 1.0 - math.exp(-h / constants[7]) if constants[7] > 0.0 else 1.0
    m[1] = h * stiffness / (inertia + h * stiffness)
    m[2], m[3], m[4] = stiffness, friction, limit
    m[5], m[6] = inertia / (inertia + h * friction), h * limit / (inertia + h * friction)


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(
    a: float, b: float, d: float, e: float, f: float, x: float, y: float, z: float
) -> tuple[float, float, float]:
    """Solve [[a, b, e], [b, a, f], [e, f, d]] · result = (x, y, z) for a positive definite matrix."""
    ca, cb, ce, cf = a * d - f * f, e * f - b * d, b * f - a * e, b * e - a * f
    scale = 1.0 / (a * ca + b * cb + e * ce)
    return (
        scale * (ca * x + cb * y + ce * z),
        scale * (cb * x + (a * d - e * e) * y + cf * z),
        scale * (ce * x + cf * y + (a * a - b * b) * z),
    )


@njit(nogil=True, error_model="numpy", forceinline=True)
def pull(
    q0: float, q1: float, q2: float, q3: float, g0: float, g1: float, g2: float, g3: float, mass: float,
    lever_inertia: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Return by how much wheels change the body's vx, vy and l ω: (M + ½ Σ g A Aᵀ) Δv = −½ Σ g q A.

    q_i is √2 times wheel i's slip, g_i its impulse per slip; A_i = (1, t_i, ± 1), and M has the inertia over l².
    """
    f0, f1, f2, f3 = -0.5 * g0 * q0, -0.5 * g1 * q1, -0.5 * g2 * q2, -0.5 * g3 * q3
    total = 0.5 * ((g0 + g1) + (g2 + g3))
    return _solve(
        mass + total,
        0.5 * ((g1 - g0) + (g2 - g3)),
        lever_inertia + total,
        0.5 * ((g1 - g0) + (g3 - g2)),
        0.5 * ((g0 + g1) - (g2 + g3)),
        (f0 + f1) + (f2 + f3),
        (f1 - f0) + (f2 - f3),
        (f1 - f0) + (f3 - f2),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def turn_wheels(
    state: Array, targets: Array, radii: Array, friction: Array, constants: Array, m: Array, h: float,
    substeps: int, motion: Array,
) -> None:  # fmt: skip
    """Integrate wheels, motors, traction and body velocity over substeps (docs/reference/robot.md).

    Each substep splits into motors, traction and drift. Traction is semi-implicit: with k_i = μ N/√(s_i² + s₀²)
    frozen at the slip s_i that the motors leave, the forces −k_i s_i are taken at its end, which costs a 3 × 3
    solve and makes the substep dissipative whatever its length (the wheels and the body form M q' = −AᵀKA q with
    K positive semidefinite). Explicit integration would need rates of over 1000/s resolved. Motors that are strong
    for their wheels move the slip by more than s₀ in a substep: then k_i is found again, from the slip at its end.

    Parameters
    ----------
    state
        ``(STATE_SIZE,)``, advanced in place, except its pose: how far the body went is left in ``motion``.
    targets
        Commanded wheel speeds ``(4,)`` [rad/s].
    radii
        Ground speed per wheel speed ``(4,)`` [m]: the true radius times one less the share lost to slip. The
        same lever arm turns the ground force into the wheel's torque, without which slip would make energy.
    friction
        μ under each wheel ``(4,)``.
    constants
        From :func:`dynamics_constants`.
    m
        From :func:`motor_constants`, for substeps of ``h``.
    h, substeps
        Length of a substep [s], and how many to take.
    motion
        ``(3,)``, filled: displacement in the world frame [m, m] and rotation [rad].
    """
    mass, lever, s0_squared = constants[0], constants[2], constants[8] * constants[8]
    lever_inertia = constants[1] / (lever * lever)
    # Per wheel: radius, μ N h, and by how much a wheel's own yielding softens the grip on it.
    r0, r1, r2, r3 = radii[0], radii[1], radii[2], radii[3]
    load, arm = h * constants[9], 0.5 / constants[3]
    grip0, grip1, grip2, grip3 = load * friction[0], load * friction[1], load * friction[2], load * friction[3]
    arm0, arm1, arm2, arm3 = arm * r0, arm * r1, arm * r2, arm * r3
    give0, give1, give2, give3 = grip0 * arm0 * r0, grip1 * arm1 * r1, grip2 * arm2 * r2, grip3 * arm3 * r3

    vx, vy, vl = state[3], state[4], state[5] * lever  # the turn rate as a speed, so that the lever is 1
    w0, w1, w2, w3 = state[6], state[7], state[8], state[9]
    ref0, ref1, ref2, ref3 = state[10], state[11], state[12], state[13]
    sum0, sum1, sum2, sum3 = 0.0, 0.0, 0.0, 0.0
    x, y, angle = 0.0, 0.0, 0.0
    c, s = math.cos(state[2]), math.sin(state[2])
    quarter_h = 0.25 * h / lever
    kick = m[6] * max(max(r0, r1), max(r2, r3))  # √2 times what the motors move the slip by in a substep, at most
    more_rounds = _MORE_ROUNDS if 0.5 * kick * kick > s0_squared else 0
    for _ in range(substeps):
        old_vx, old_vy, old_vl = vx, vy, vl
        sum0, sum1, sum2, sum3 = sum0 + w0, sum1 + w1, sum2 + w2, sum3 + w3

        # Motors.
        ref0, ref1 = ref0 + m[0] * (targets[0] - ref0), ref1 + m[0] * (targets[1] - ref1)
        ref2, ref3 = ref2 + m[0] * (targets[2] - ref2), ref3 + m[0] * (targets[3] - ref3)
        w0, w1, w2, w3 = _motor(w0, ref0, m), _motor(w1, ref1, m), _motor(w2, ref2, m), _motor(w3, ref3, m)

        # Traction, with q_i = √2 s_i. Unrolled: the loop over the wheels ran 1.5 × slower.
        q0, q1 = vx - vy - vl - r0 * w0, vx + vy + vl - r1 * w1
        q2, q3 = vx + vy - vl - r2 * w2, vx - vy + vl - r3 * w3
        g0 = grip0 / (math.sqrt(0.5 * q0 * q0 + s0_squared) + give0)
        g1 = grip1 / (math.sqrt(0.5 * q1 * q1 + s0_squared) + give1)
        g2 = grip2 / (math.sqrt(0.5 * q2 * q2 + s0_squared) + give2)
        g3 = grip3 / (math.sqrt(0.5 * q3 * q3 + s0_squared) + give3)
        dvx, dvy, dvl = pull(q0, q1, q2, q3, g0, g1, g2, g3, mass, lever_inertia)
        for _ in range(more_rounds):
            e0 = (1.0 - g0 * arm0 * r0) * (q0 + dvx - dvy - dvl)
            e1 = (1.0 - g1 * arm1 * r1) * (q1 + dvx + dvy + dvl)
            e2 = (1.0 - g2 * arm2 * r2) * (q2 + dvx + dvy - dvl)
            e3 = (1.0 - g3 * arm3 * r3) * (q3 + dvx - dvy + dvl)
            g0 = grip0 / (math.sqrt(0.5 * e0 * e0 + s0_squared) + give0)
            g1 = grip1 / (math.sqrt(0.5 * e1 * e1 + s0_squared) + give1)
            g2 = grip2 / (math.sqrt(0.5 * e2 * e2 + s0_squared) + give2)
            g3 = grip3 / (math.sqrt(0.5 * e3 * e3 + s0_squared) + give3)
            dvx, dvy, dvl = pull(q0, q1, q2, q3, g0, g1, g2, g3, mass, lever_inertia)
        # J (ω' − ω) = −R f h/√2 with f = −k s': the wheel gains what the ground took from the body.
        w0 += g0 * arm0 * (q0 + dvx - dvy - dvl)
        w1 += g1 * arm1 * (q1 + dvx + dvy + dvl)
        w2 += g2 * arm2 * (q2 + dvx + dvy - dvl)
        w3 += g3 * arm3 * (q3 + dvx - dvy + dvl)
        vx, vy, vl = vx + dvx, vy + dvy, vl + dvl
        sum0, sum1, sum2, sum3 = sum0 + w0, sum1 + w1, sum2 + w2, sum3 + w3

        # Drift at the mean of the old and the new velocity; then the body's axes turn under the velocity. The
        # heading's cosine and sine advance by a Cayley rotation: norm kept, angle right to O(h⁵).
        mean_vx, mean_vy = 0.5 * (old_vx + vx), 0.5 * (old_vy + vy)
        x += h * (c * mean_vx - s * mean_vy)
        y += h * (s * mean_vx + c * mean_vy)
        half = quarter_h * (old_vl + vl)
        angle += 2.0 * half
        half *= 1.0 + half * half / 3.0
        norm = 1.0 / (1.0 + half * half)
        turn_c, turn_s = (1.0 - half * half) * norm, 2.0 * half * norm
        c, s = c * turn_c - s * turn_s, s * turn_c + c * turn_s
        vx, vy = turn_c * vx + turn_s * vy, turn_c * vy - turn_s * vx
    # A robot at rest would coast on into denormal numbers, on which arithmetic is ten times slower.
    if abs(vx) + abs(vy) + abs(vl) < 1e-12:
        vx = vy = vl = 0.0
    state[3], state[4], state[5] = vx, vy, vl / lever
    w0, w1 = 0.0 if abs(w0) < 1e-12 else w0, 0.0 if abs(w1) < 1e-12 else w1
    w2, w3 = 0.0 if abs(w2) < 1e-12 else w2, 0.0 if abs(w3) < 1e-12 else w3
    ref0, ref1 = 0.0 if abs(ref0) < 1e-12 else ref0, 0.0 if abs(ref1) < 1e-12 else ref1
    ref2, ref3 = 0.0 if abs(ref2) < 1e-12 else ref2, 0.0 if abs(ref3) < 1e-12 else ref3
    state[6], state[7], state[8], state[9] = w0, w1, w2, w3
    state[10], state[11], state[12], state[13] = ref0, ref1, ref2, ref3
    half = 0.5 * h
    state[14], state[15] = state[14] + half * sum0, state[15] + half * sum1
    state[16], state[17] = state[16] + half * sum2, state[17] + half * sum3
    motion[0], motion[1], motion[2] = x, y, angle
