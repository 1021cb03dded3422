"""Right-invariant EKF-SLAM: the standard filter with another error, so that it never grows sure of a heading.

After Barrau and Bonnabel, and Zhang et al. 2017, as worked out in the design's invariant-ekf.md. The covariance
stays in ordinary coordinates, where the two filters predict, observe and add landmarks alike. What differs is how
a correction is applied: along the exponential of SE(2), by which the whole map turns about the origin with the
robot's heading, and with a change of the covariance's coordinates to the new estimate (the *reset*).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.blas import rank_k_downdate
from slam.ekf import BLAS_FROM, EkfSlam
from slam.geometry import wrap_scalar
from slam.joint_gaussian import downdate, whiten
from slam.metrics import nees_pose_invariant

__all__ = ["InvariantEkfSlam"]

Array = NDArray[np.float64]


class InvariantEkfSlam(EkfSlam):
    """The right-invariant EKF-SLAM backend, ``invariant-ekf``."""

    def _correct(self, z: Array, match: NDArray[np.int64]) -> None:
        n, small = self._n, self._n < BLAS_FROM
        self.nis_dof, self.nis = invariant_update(
            self._x,
            self._p,
            n,
            z,
            match,
            self.config.lidar_offset_m,
            self._h,
            self._w,
            self._s,
            self._shift,
            small,
        )
        if not small and self.nis_dof:
            rank_k_downdate(self._p, n, self._w, self.nis_dof)
            _reset(self._p, n, self._shift[1], self._shift[2])

    def _start(self, pose: Array, pose_cov: Array, seed: int) -> None:
        super()._start(pose, pose_cov, seed)
        self._shift = np.zeros((3, len(self._x)))

    def _enlarge(self) -> None:
        super()._enlarge()
        self._shift = np.zeros((3, len(self._x)))

    def pose_nees(self, true_pose: Array) -> float:
        """Return the pose's NEES in the invariant error, which is the one this filter's covariance speaks of."""
        return float(nees_pose_invariant(self.pose, self.pose_cov, np.asarray(true_pose, dtype=np.float64)))


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def invariant_update(
    x: Array, p: Array, n: int, z: Array, match: NDArray[np.int64], offset: float, h: Array, w: Array, s: Array,
    shift: Array, subtract: bool,
) -> tuple[int, float]:  # fmt: skip
    """Make one right-invariant EKF update of all observations with ``match`` ≥ 0; return the dof and the NIS.

    The gain is the standard filter's (:func:`slam.joint_gaussian.stacked_update`). ``shift`` ``(3, ≥ n)`` is work
    space: the correction δ, then g and v of the reset P ← P + g vᵀ + v gᵀ (invariant-ekf.md, Retract and Reset).
    Without ``subtract``, P − Wᵀ W and then the reset are left to the caller.
    """
    rows = whiten(x, p, n, z, match, offset, h, w, s)
    if rows == 0:
        return 0, 0.0
    ns = s.shape[1] - 1
    nis = 0.0
    delta, g, v = shift[0, :n], shift[1, :n], shift[2, :n]
    delta[:] = 0.0
    # v starts as the heading's column of P after the update, P − Wᵀ W.
    for j in range(n):
        v[j] = p[j, 2] if j <= 2 else p[2, j]
    for k in range(rows):
        y, w2 = s[k, ns], w[k, 2]
        nis += y * y
        wk = w[k, :n]
        for j in range(n):
            delta[j] += y * wk[j]
            v[j] -= w2 * wk[j]
    _retract(x, n, delta, g)
    half = 0.5 * v[2]
    for j in range(n):
        v[j] += half * g[j]
    if subtract:
        downdate(p, n, w, rows)
        _reset(p, n, g, v)
    return rows, nis


@njit(cache=True, nogil=True, error_model="numpy")
def _retract(x: Array, n: int, delta: Array, g: Array) -> None:
    """Apply a correction along the exponential; write g: J times how far the robot and each landmark moved.

    x⁺ = Exp(t) x̂ + V(t) (δ − J x̂ t) for the robot's position and every landmark's, with t = δθ.
    """
    t = delta[2]
    c, s = math.cos(t), math.sin(t)
    # V(t) = [[a, −b], [b, a]]
    if abs(t) > 1e-4:
        a, b = s / t, (1.0 - c) / t
    else:
        a, b = 1.0 - t * t / 6.0, 0.5 * t - t * t * t / 24.0
    for k in range(-1, (n - 3) // 2):
        i = 0 if k < 0 else 3 + 2 * k
        px, py = x[i], x[i + 1]
        dx, dy = delta[i] + py * t, delta[i + 1] - px * t  # J p = (−py, px)
        x[i] = c * px - s * py + a * dx - b * dy
        x[i + 1] = s * px + c * py + b * dx + a * dy
        g[i], g[i + 1] = -(x[i + 1] - py), x[i] - px
    x[2] = wrap_scalar(x[2] + t)
    g[2] = 0.0


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _reset(p: Array, n: int, g: Array, v: Array) -> None:
    """Add g vᵀ + v gᵀ to the upper triangle of p."""
    for i in range(n):
        gi, vi = g[i], v[i]
        upper, gj, vj = p[i, i:n], g[i:n], v[i:n]
        for j in range(upper.shape[0]):
            upper[j] += gi * vj[j] + vi * gj[j]
