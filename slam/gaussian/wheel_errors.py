"""The wheels' lasting errors as states of the filter: each wheel's radius and the lever, off by as much all along.

A wheel a hundredth too large claims a hundredth too little in every step. A filter that takes that for white noise
is too unsure at first, when little has added up, and too sure in the end. With the errors e as states, which stay
as they are, the twist is

    u = ũ + B(ũ) e,   B's column of wheel i: uᵢ/4 (1, yᵢ, tᵢ/l),  of the lever: (0, 0, ω)

ũ being the twist that the wheels claim and uᵢ = vx + yᵢ vy + tᵢ l ω how fast wheel i rolls. As states beside the
map (:mod:`slam.gaussian.companions`) of covariance E and cross-covariance C they make prediction

    C_r ← C_r Fxᵀ + E Dᵀ,   P_rm += D C_m,   P_rr += D C_r Fxᵀ + (D C_r Fxᵀ)ᵀ + D E Dᵀ,   D = Fu B

Driving one way shows one combination of the four radii; twists in all three components show all five errors.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from slam.gaussian.companions import Companions
from slam.motion import LastingErrors, Twist, predict_robot
from slam.types import Array

__all__ = ["WheelErrors"]

_STATES = 5
# The rollers' directions: every combination of signs occurs on one wheel; which one, e does not mind.
_SIDE = np.array([-1.0, 1.0, 1.0, -1.0])
_TURN = np.array([-1.0, 1.0, -1.0, 1.0])


class WheelErrors(Companions):
    """Estimates of the five errors, the first states, and how they hang together with everything else."""

    def __init__(
        self, declared: LastingErrors, lever_m: float, observations: int, size: int, *, direction: bool = False
    ) -> None:
        cov = np.diag([declared.radius_sigma**2] * 4 + [declared.lever_sigma**2])
        cov[:4, :4] += declared.difference_sigma**2 * np.outer(_TURN, _TURN)
        super().__init__(observations, size, cov, direction=direction)
        self._lever_m = lever_m
        self._b = np.zeros((3, _STATES))

    @property
    def errors(self) -> tuple[Array, Array]:
        """The five errors ``(5,)`` and their covariance."""
        return self.mean[:_STATES].copy(), self.cov[:_STATES, :_STATES].copy()

    def corrected(self, twist: Twist) -> Twist:
        """Return the twist of which the wheels claim ``twist``: body frame, m/s, m/s, rad/s."""
        vx, vy, omega = twist
        return _corrected(vx, vy, omega, self._lever_m, self.mean, self._b)

    def corrected_by(self, twist: Twist, errors: Array) -> tuple[Twist, Array]:
        """Return what :meth:`corrected` does with other errors ``(5,)``, and the Jacobian ``(3, 5)`` by them."""
        b = np.zeros((3, _STATES))
        return _corrected(*twist, self._lever_m, errors, b), b

    def predict(self, x: Array, p: Array, n: int, dt: float, twist: Twist, var_v: float, var_w: float) -> None:
        """Do :func:`slam.motion.predict_robot` with a twist that was :meth:`corrected` last, errors included."""
        _predict(x, p, n, self.cross, self.cov, self._b, *twist, dt, var_v, var_w)


@njit(cache=True, nogil=True, error_model="numpy")
def _corrected(vx: float, vy: float, omega: float, lever: float, mean: Array, b: Array) -> Twist:
    """Write B, the Jacobian ``(3, 5)`` of the twist by the errors; return the twist less what these make of it."""
    for i in range(4):
        quarter = 0.25 * (vx + _SIDE[i] * vy + _TURN[i] * lever * omega)
        b[0, i], b[1, i], b[2, i] = quarter, _SIDE[i] * quarter, _TURN[i] * quarter / lever
    b[2, 4] = omega
    for i in range(_STATES):
        vx, vy, omega = vx + b[0, i] * mean[i], vy + b[1, i] * mean[i], omega + b[2, i] * mean[i]
    return vx, vy, omega


@njit(cache=True, nogil=True, error_model="numpy")
def _predict(
    x: Array, p: Array, n: int, cross: Array, cov: Array, b: Array, vx: float, vy: float, omega: float, dt: float,
    var_v: float, var_w: float,
) -> None:  # fmt: skip
    """Predict the robot; C_r ← C_r Fxᵀ + E Dᵀ, and what the errors add to the robot's rows of P."""
    before_x, before_y, middle = x[0], x[1], x[2] + 0.5 * omega * dt
    predict_robot(x, p, n, vx, vy, omega, dt, var_v, var_w)
    # Fx's entries by θ are J times the step, Fu's a rotation by the heading half way and half of Fx's.
    fx, fy = -(x[1] - before_y), x[0] - before_x
    c, s = math.cos(middle) * dt, math.sin(middle) * dt
    d = np.empty((3, _STATES))
    for i in range(_STATES):
        d[0, i] = c * b[0, i] - s * b[1, i] + 0.5 * dt * fx * b[2, i]
        d[1, i] = s * b[0, i] + c * b[1, i] + 0.5 * dt * fy * b[2, i]
        d[2, i] = dt * b[2, i]
    for i in range(cross.shape[0]):
        cross[i, 0] += fx * cross[i, 2]
        cross[i, 1] += fy * cross[i, 2]
    for q in range(3):
        for i in range(_STATES):
            for j in range(3, n):
                p[q, j] += d[q, i] * cross[i, j]
    ed = np.zeros((cross.shape[0], 3))  # E Dᵀ
    for i in range(cross.shape[0]):
        for q in range(3):
            for j in range(_STATES):
                ed[i, q] += cov[i, j] * d[q, j]
    for q in range(3):
        for r in range(q, 3):
            for i in range(_STATES):
                p[q, r] += d[q, i] * (cross[i, r] + ed[i, r]) + cross[i, q] * d[r, i]
    for i in range(cross.shape[0]):
        for q in range(3):
            cross[i, q] += ed[i, q]
