"""What lasts of an odometry's errors, learnt from what scans make of the motions that it foretold.

Two things are the same in every step, so they are no noise that is drawn anew:

- **The wheels.** Relative errors ε ``(5,)`` of the radii and the lever make of the twist that wheels claim, ũ, the
  twist ũ + B(ũ) ε (:mod:`slam.gaussian.wheel_errors`).
- **Where the frame sits.** Wheels tell the motion of their own centre. A frame at ℓ ``(2,)`` [m] from it moves by
  ω × ℓ besides: that of a laser in a log that does not say where it was mounted.

A Kalman filter of c = (ℓ, ε) learns them (part of what Kümmerle, Grisetti and Burgard 2011 estimate, "Simultaneous
calibration, localization, and mapping"). That c is correlated with pose and map is left out.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from slam.gaussian.wheel_errors import WheelErrors
from slam.geometry import symmetric
from slam.motion import OdometryNoise, Twist, predict_robot
from slam.types import Array

__all__ = ["LastingStates", "Motion"]

_GATE = 25.0  # chi-square, 3 degrees of freedom, from which the wheels spun: that says nothing of what lasts
_PLACE, _STATES = 2, 7


class Motion:
    """A motion by the wheels, seen from where it began.

    Attributes
    ----------
    mean : Array
        ``(3,)`` [m, m, rad].
    by : Array
        ``(3, 7)`` its Jacobian by what lasts.
    """

    def __init__(self, mean: Array | None = None, cov: Array | None = None) -> None:
        self.mean = np.zeros(3) if mean is None else mean
        self.by = np.zeros((3, _STATES))
        self._upper = np.zeros((3, 3)) if cov is None else np.triu(cov)

    def add(self, twist: Twist, by: Array, dt: float, var_v: float, var_w: float) -> None:
        """Go on by a twist, its Jacobian ``by`` ``(3, 7)`` and the variances of its speed and turn rate."""
        _add(self.mean, self._upper, self.by, *twist, by, dt, var_v, var_w)

    def doubt(self, cov: Array) -> None:
        """Add to the covariance ``(3, 3)``."""
        self._upper += np.triu(cov)

    @property
    def white(self) -> Array:
        """The covariance ``(3, 3)`` of what is drawn anew in each step."""
        return symmetric(self._upper)


class LastingStates:
    """Mean ``(7,)`` and covariance ``(7, 7)`` of c = (ℓ, ε); what has no σ to begin with is 0 and stays so."""

    def __init__(self, noise: OdometryNoise) -> None:
        self.mean, self.cov = np.zeros(_STATES), np.zeros((_STATES, _STATES))
        self.cov[:_PLACE, :_PLACE] = np.eye(_PLACE) * noise.mount_sigma_m**2
        self._wheels = None if noise.lasting is None else WheelErrors(noise.lasting, noise.lever_m, 1, 3)
        if self._wheels is not None:
            self.cov[_PLACE:, _PLACE:] = self._wheels.errors[1]
        self.unknown = bool(self.cov.any())

    def twist(self, claimed: Twist) -> tuple[Twist, Array]:
        """Return the twist of the frame where wheels claim one, of their centre, and its Jacobian ``(3, 7)``."""
        (vx, vy, omega), by = claimed, np.zeros((3, _STATES))
        if self._wheels is not None:
            (vx, vy, omega), by[:, _PLACE:] = self._wheels.corrected_by(claimed, self.mean[_PLACE:])
        x, y = self.mean[:_PLACE].tolist()
        by[0] -= y * by[2]
        by[1] += x * by[2]
        by[0, 1], by[1, 0] = -omega, omega
        return (vx - omega * y, vy + omega * x, omega), by

    def motion_cov(self, motion: Motion) -> Array:
        """Return what lasts adds to the covariance ``(3, 3)`` of a motion."""
        return np.asarray(motion.by @ self.cov @ motion.by.T, np.float64)

    def learn(self, motion: Motion, prior_cov: Array, change: Array, cov: Array) -> None:
        """Correct c by what a scan made of a motion (Rauch, Tung and Striebel 1965).

        Parameters
        ----------
        motion : Motion
            What the wheels foretold.
        prior_cov, cov : Array
            Covariances ``(3, 3)`` of the motion before the scan, :meth:`motion_cov` included, and after it.
        change : Array
            ``(3,)`` by which the scan has moved its mean.
        """
        if self.unknown:
            _learn(self.mean, self.cov, motion.by, prior_cov, change, cov)


@njit(cache=True, nogil=True, error_model="numpy")
def _add(
    mean: Array, upper: Array, by: Array, vx: float, vy: float, omega: float, twist_by: Array, dt: float,
    var_v: float, var_w: float,
) -> None:  # fmt: skip
    """Predict a motion, and D ← Fx D + Fu B, B being ``twist_by``."""
    before_x, before_y, middle = mean[0], mean[1], mean[2] + 0.5 * omega * dt
    predict_robot(mean, upper, 3, vx, vy, omega, dt, var_v, var_w)
    # Fx's entries by θ are J times the step, Fu's a rotation by the heading half way and half of Fx's.
    fx, fy = -(mean[1] - before_y), mean[0] - before_x
    c, s = math.cos(middle) * dt, math.sin(middle) * dt
    for i in range(by.shape[1]):
        by[0, i] += fx * (by[2, i] + 0.5 * dt * twist_by[2, i]) + c * twist_by[0, i] - s * twist_by[1, i]
        by[1, i] += fy * (by[2, i] + 0.5 * dt * twist_by[2, i]) + s * twist_by[0, i] + c * twist_by[1, i]
        by[2, i] += dt * twist_by[2, i]


@njit(cache=True, nogil=True, error_model="numpy")
def _learn(mean: Array, c_cov: Array, by: Array, prior_cov: Array, change: Array, cov: Array) -> None:
    info = np.linalg.inv(prior_cov)
    if change @ (info @ change) > _GATE:
        return
    gain = c_cov @ by.T @ info
    mean += gain @ change
    c_cov += gain @ (cov - prior_cov) @ gain.T
