"""Motion between two scans: twist model, Jacobians and odometry noise (docs/reference/motion.md)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numba import njit

from slam.geometry import wrap_scalar
from slam.settings import Config, NotNegative, Positive, Within
from slam.types import Array, Odometry

__all__ = ["LastingErrors", "OdometryNoise", "Twist", "jacobians", "move", "predict_robot", "twist_between"]

Twist = tuple[float, float, float]

NO_SLIP = (0.0, 0.0)

_UNEVEN = 0.25  # share of what slips along that turns the body: found on the simulated robot, on patches of ice


@dataclass(frozen=True, kw_only=True)
class LastingErrors(Config):
    """How far off a wheel's radius and the lever may be, and the noise that is left of V when they are known."""

    radius_sigma: Annotated[float, Within("[0, 10]")] = 0.0  # relative
    lever_sigma: Annotated[float, Within("[0, 10]")] = 0.0  # relative
    # Relative, of the right wheels' radii and, by as much less, of the left ones'.
    difference_sigma: Annotated[float, Within("[0, 10]")] = 0.0
    white_speed_share: NotNegative | None = None  # OdometryNoise's shares without what lasts; None: all of them
    white_turn_share_rad_m: NotNegative | None = None


@dataclass(frozen=True, kw_only=True)
class OdometryNoise(Config):
    """V, the covariance of the measured twist, diagonal: each σ is a floor plus a share of the wheels' speed.

    The wheels' speed is √(vx² + vy² + (lω)²). The shares are larger than the encoders' white noise alone, since
    wheel radius errors stay the same from step to step; ``mecanum_env.sensing.calibration`` derives a robot's own
    from its declared noise. A change of speed that the floor cannot pass on makes the wheels slip: what exceeds
    ``grip_m_s2`` adds its own share.
    """

    lever_m: Annotated[float, Within("[0.01, 10]")] = 0.3855  # l: half the wheelbase plus half the track
    speed_floor_m_s: Annotated[float, Within("[0, 100]")] = 0.002
    speed_share: Annotated[float, Within("[0, 100]")] = 0.012
    turn_floor_rad_s: Annotated[float, Within("[0, 100]")] = 0.003
    turn_share_rad_m: Annotated[float, Within("[0, 100]")] = 0.03
    grip_m_s2: Positive = 1.5  # change of the wheels' speed over time from which they slip
    slip_share: Annotated[float, Within("[0, 100]")] = 0.55  # σ, of what may slip where nobody tells
    slide_m_s2: Positive = 1.5  # by which the floor lets the body follow wheels that slip
    # 1σ, by either coordinate, of where the frame that poses are of sits, away from the wheels' centre: graph-slam
    # learns it (slam.graph.lasting). 0: that is where it sits.
    mount_sigma_m: Annotated[float, Within("[0, 10]")] = 0.0
    lasting: LastingErrors | None = None  # what filters take for states: slam.gaussian.wheel_errors, …

    def variances(
        self, vx: float, vy: float, omega: float, *, slip: tuple[float, float] = NO_SLIP
    ) -> tuple[float, float]:
        """Return the variance of either linear component [m²/s²] and of the turn rate [rad²/s²].

        ``slip`` [m/s, rad/s] is 1σ of what the wheels slip, along and in turning. Wheels that slip along do not do
        so all alike, which turns the body.
        """
        speed = math.sqrt(vx * vx + vy * vy + (self.lever_m * omega) ** 2)
        along, turning = slip
        return (
            (self.speed_floor_m_s + self.speed_share * speed) ** 2 + along**2,
            (self.turn_floor_rad_s + self.turn_share_rad_m * speed) ** 2
            + turning**2 + (_UNEVEN * along / self.lever_m) ** 2,
        )  # fmt: skip

    def of_step(self, odometry: Odometry, body: Twist) -> tuple[Twist, float, float, Twist]:
        """Return the twist of a step, its variances as :meth:`variances`, and the body's twist after it.

        Where the odometry does not tell what slipped, :meth:`slip` does, from the twist ``body`` before the step.
        Raises ``ValueError`` where it is not finite: a belief that has once taken that in has lost everything.
        """
        twist, slip = odometry.numbers, odometry.slip
        slipped = 0.0 if slip is None else slip[0] + slip[1]
        if not (math.isfinite(twist[0] + twist[1] + twist[2] + odometry.dt + slipped) and odometry.dt >= 0.0):
            told = f"{twist}, {odometry.dt}" if slip is None else f"{twist}, {odometry.dt} and {slip}"
            raise ValueError(
                f"vx, vy, ω, dt and slip of an odometry are finite, and no time goes back; got {told}"
            )
        if slip is None:
            slip, body = self.slip(body, twist, odometry.dt) if odometry.dt > 0.0 else (NO_SLIP, body)
        return twist, *self.variances(*twist, slip=slip), body

    def white(self) -> OdometryNoise:
        """Return V of a filter that has the lasting errors as states."""
        if self.lasting is None:
            return self
        share, turn = self.lasting.white_speed_share, self.lasting.white_turn_share_rad_m
        return replace(
            self,
            speed_share=self.speed_share if share is None else share,
            turn_share_rad_m=self.turn_share_rad_m if turn is None else turn,
            lasting=None,
        )

    def slip(self, body: Twist, wheels: Twist, dt: float) -> tuple[tuple[float, float], Twist]:
        """Return 1σ of what wheels slip [m/s, rad/s], ``dt`` [s] after a step, and the body's twist then.

        ``body`` is the twist that the floor had passed on before. It follows that of the wheels by ``slide_m_s2``
        at most: on a slippery floor, where they stop too fast, it slides on after they stand. Wheels that jerk
        within a step may slip on any floor.
        """
        x, y, w = wheels[0] - body[0], wheels[1] - body[1], wheels[2] - body[2]
        change = math.sqrt(x * x + y * y + (self.lever_m * w) ** 2)
        # Which may all be along, or all in turning.
        slip = self.slip_share * max(change - self.grip_m_s2 * dt, 0.0)
        left = max(1.0 - self.slide_m_s2 * dt / change, 0.0) if change > 0.0 else 0.0
        return (slip, slip / self.lever_m), (wheels[0] - left * x, wheels[1] - left * y, wheels[2] - left * w)


def move(pose: Array, twist: Array, dt: float) -> Array:
    """Return the pose ``(3,)`` after a body twist ``(3,)`` held for ``dt`` [s]: f(X, u) of docs/reference/ekf.md.

    The heading half way through the step is used, which agrees with the exact SE(2) exponential to third
    order in ω dt, where the paper's own formula agrees to first.
    """
    out = np.array(pose, dtype=np.float64)
    _move(out, float(twist[0]), float(twist[1]), float(twist[2]), dt)
    return out


def twist_between(pose: Array, after: Array, dt: float) -> Array:
    """Return the body twist ``(3,)`` that, held for ``dt`` > 0 [s], brings :func:`move` from one pose to another.

    The inverse of the motion model itself, exact to rounding: the logarithm of SE(2) would differ from it by
    (ω dt)² / 24 of the way. The turn is the short one.
    """
    turn = wrap_scalar(float(after[2]) - float(pose[2]))
    middle = float(pose[2]) + 0.5 * turn
    dx, dy = float(after[0]) - float(pose[0]), float(after[1]) - float(pose[1])
    c, s = math.cos(middle), math.sin(middle)
    return np.array([c * dx + s * dy, c * dy - s * dx, turn]) / dt


def jacobians(pose: Array, twist: Array, dt: float) -> tuple[Array, Array]:
    """Return Fx ``(3, 3)`` and Fu ``(3, 3)``, the Jacobians of :func:`move` by pose and by twist."""
    vx, vy, omega = (float(v) for v in twist)
    middle = float(pose[2]) + 0.5 * omega * dt
    c, s = math.cos(middle), math.sin(middle)
    dx_dtheta = -(vx * s + vy * c) * dt
    dy_dtheta = (vx * c - vy * s) * dt
    fx = np.array([[1.0, 0.0, dx_dtheta], [0.0, 1.0, dy_dtheta], [0.0, 0.0, 1.0]])
    half = 0.5 * dt
    fu = np.array([[c * dt, -s * dt, dx_dtheta * half], [s * dt, c * dt, dy_dtheta * half], [0.0, 0.0, dt]])
    return fx, fu


@njit(cache=True, nogil=True, error_model="numpy")
def _move(pose: Array, vx: float, vy: float, omega: float, dt: float) -> None:
    middle = pose[2] + 0.5 * omega * dt
    c, s = math.cos(middle), math.sin(middle)
    pose[0] += (vx * c - vy * s) * dt
    pose[1] += (vx * s + vy * c) * dt
    pose[2] = wrap_scalar(pose[2] + omega * dt)


@njit(cache=True, nogil=True, error_model="numpy")
def predict_robot(
    x: Array, p: Array, n: int, vx: float, vy: float, omega: float, dt: float, var_v: float, var_w: float
) -> None:
    """Move the robot part of a joint Gaussian: x[:3], and the first three rows of p's upper triangle.

    P_rr ← Fx P_rr Fxᵀ + Fu V Fuᵀ, P_rm ← Fx P_rm (docs/reference/ekf.md, Predict); ``n`` is the size of the state.
    """
    middle = x[2] + 0.5 * omega * dt
    c, s = math.cos(middle), math.sin(middle)
    a = -(vx * s + vy * c) * dt
    b = (vx * c - vy * s) * dt
    _move(x, vx, vy, omega, dt)
    # Fx P: rows 0 and 1 gain a multiple of row 2. Its part left of the diagonal is column 2's upper part.
    p02, p12, p22 = p[0, 2], p[1, 2], p[2, 2]
    for j in range(3, n):
        p[0, j] += a * p[2, j]
        p[1, j] += b * p[2, j]
    p[0, 0] += 2.0 * a * p02 + a * a * p22
    p[0, 1] += a * p12 + b * p02 + a * b * p22
    p[1, 1] += 2.0 * b * p12 + b * b * p22
    p[0, 2] += a * p22
    p[1, 2] += b * p22
    # Fu V Fuᵀ: the linear part is a rotation of an isotropic covariance; the turn acts through the half step.
    half = 0.5 * dt
    qv = var_v * dt * dt
    p[0, 0] += qv + a * a * half * half * var_w
    p[0, 1] += a * b * half * half * var_w
    p[1, 1] += qv + b * b * half * half * var_w
    p[0, 2] += a * half * dt * var_w
    p[1, 2] += b * half * dt * var_w
    p[2, 2] += dt * dt * var_w
