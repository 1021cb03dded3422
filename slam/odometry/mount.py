"""Where the frame that poses are of sits on the base: learnt from how turns of the wheels move it.

Wheels tell the motion of their own centre. A frame at ℓ from it (a laser's, in a log that does not say where the
laser was mounted) moves by R(θ) ℓ - ℓ besides when the base turns by θ. ℓ lasts: it is no noise that is drawn anew
at each turn. A Kalman filter of its two coordinates learns it in a few turns, from what scans make of the motion
that the wheels foretold (part of what Kümmerle, Grisetti and Burgard 2011 estimate, "Simultaneous calibration,
localization, and mapping").
"""

from __future__ import annotations

import math

import numpy as np

from slam.types import Array

__all__ = ["Mount"]

_GATE = 25.0  # chi-square, 3 degrees of freedom, from which the wheels spun: that says nothing of ℓ


class Mount:
    """Mean ``(2,)`` and covariance ``(2, 2)`` of ℓ [m], the frame's place as seen from the wheels' centre.

    With ``sigma_m`` 0 it is known to be there, and stays so.
    """

    def __init__(self, sigma_m: float) -> None:
        self.mean, self.cov = np.zeros(2), np.eye(2) * sigma_m**2
        self.unknown = sigma_m > 0.0

    def velocity(self, vx: float, vy: float, omega: float) -> tuple[float, float]:
        """Return the velocity [m/s] of the frame, in its axes, where that of the wheels' centre is a twist."""
        x, y = self.mean.tolist()
        return vx - omega * y, vy + omega * x

    def motion_cov(self, turn: float) -> Array:
        """Return what ℓ adds to the covariance ``(3, 3)`` of a motion that turned so far, in its first frame."""
        d = _by_mount(turn)
        return np.asarray(d @ self.cov @ d.T, np.float64)

    def learn(self, turn: float, prior_cov: Array, change: Array, cov: Array) -> None:
        """Correct ℓ by what a scan made of a motion that turned by ``turn`` [rad] (Rauch, Tung and Striebel 1965).

        Parameters
        ----------
        prior_cov, cov : Array
            Covariances ``(3, 3)`` of the motion before the scan, :meth:`motion_cov` included, and after it, in
            the motion's first frame.
        change : Array
            ``(3,)`` by which the scan has moved its mean.
        """
        if not self.unknown or float(change @ np.linalg.solve(prior_cov, change)) > _GATE:
            return
        gain = np.linalg.solve(prior_cov, _by_mount(turn) @ self.cov).T
        self.mean = self.mean + gain @ change
        less = self.cov + gain @ (cov - prior_cov) @ gain.T
        self.cov = 0.5 * (less + less.T)


def _by_mount(turn: float) -> Array:
    """Return the Jacobian ``(3, 2)`` of a motion by ℓ."""
    c, s = math.cos(turn), math.sin(turn)
    return np.array([[c - 1.0, -s], [s, c - 1.0], [0.0, 0.0]])
