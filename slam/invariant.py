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
from slam.types import LINE

__all__ = ["InvariantEkfSlam"]

Array = NDArray[np.float64]


class InvariantEkfSlam(EkfSlam):
    """The right-invariant EKF-SLAM backend, ``invariant-ekf``."""

    def _correct(self, z: Array, match: NDArray[np.int64]) -> None:
        n, small = self._n, self._n < BLAS_FROM
        self.nis_dof, self.nis = invariant_update(
            self._x, self._p, n, z, match, self.config.lidar_offset_m, self._book.marks, self._h, self._w, self._s,
            self._shift, small,
        )  # fmt: skip
        if not small and self.nis_dof:
            rank_k_downdate(self._p, n, self._w, self.nis_dof)
            _reset(self._p, n, self._shift, self.config.lines)

    def _start(self, pose: Array, pose_cov: Array, seed: int) -> None:
        super()._start(pose, pose_cov, seed)
        self._shift = np.zeros((7, len(self._x)))

    def _enlarge(self) -> None:
        super()._enlarge()
        self._shift = np.zeros((7, len(self._x)))

    def pose_nees(self, true_pose: Array) -> float:
        """Return the pose's NEES in the invariant error, which is the one this filter's covariance speaks of."""
        return float(nees_pose_invariant(self.pose, self.pose_cov, np.asarray(true_pose, dtype=np.float64)))


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def invariant_update(
    x: Array, p: Array, n: int, z: Array, match: NDArray[np.int64], offset: float, marks: Array, h: Array,
    w: Array, s: Array, shift: Array, subtract: bool,
) -> tuple[int, float]:  # fmt: skip
    """Make one right-invariant EKF update of all observations with ``match`` ≥ 0; return the dof and the NIS.

    The gain is the standard filter's (:func:`slam.joint_gaussian.stacked_update`). ``shift`` ``(7, ≥ n)`` is work
    space: the correction δ, then the columns of A and of V by x, y, θ for the reset P ← P + A Vᵀ + V Aᵀ
    (invariant-ekf.md, Retract and Reset). ``marks`` tells walls from points. Without ``subtract``, P − Wᵀ W and
    then the reset are left to the caller.
    """
    rows = whiten(x, p, n, z, match, offset, h, w, s)
    if rows == 0:
        return 0, 0.0
    ns = s.shape[1] - 1
    nis = 0.0
    delta = shift[0, :n]
    delta[:] = 0.0
    for k in range(rows):
        y = s[k, ns]
        nis += y * y
        wk = w[k, :n]
        for j in range(n):
            delta[j] += y * wk[j]
    walls = _retract(x, n, delta, marks, shift[1:4])
    # V = P_:r + ½ A P_rr, P being what it is after the update, P − Wᵀ W.
    for q in range(0 if walls else 2, 3):
        v = shift[4 + q, :n]
        for j in range(n):
            v[j] = p[j, q] if j <= q else p[q, j]
        for k in range(rows):
            wq, wk = w[k, q], w[k, :n]
            for j in range(n):
                v[j] -= wq * wk[j]
    if walls:
        _add_half(shift, n)
    else:
        g, v = shift[3, :n], shift[6, :n]
        half = 0.5 * v[2]
        for j in range(n):
            v[j] += half * g[j]
    if subtract:
        downdate(p, n, w, rows)
        _reset(p, n, shift, walls)
    return rows, nis


@njit(cache=True, nogil=True, error_model="numpy")
def _retract(x: Array, n: int, delta: Array, marks: Array, a: Array) -> bool:
    """Apply a correction along the exponential, write A ``(3, n)``, tell whether there are walls.

    x⁺ = Exp(t) x̂ + V(t) (δ − J x̂ t) for the robot's position and every point, with t = δθ; a wall's α and r are
    added to (a correction of the heading alone leaves it where it is). A's column by θ is J times how far a point
    moved; a wall's r changes coordinates by Δnᵀ [I, −J p̂].
    """
    t = delta[2]
    c, s = math.cos(t), math.sin(t)
    # V(t) = [[va, −vb], [vb, va]]
    if abs(t) > 1e-4:
        va, vb = s / t, (1.0 - c) / t
    else:
        va, vb = 1.0 - t * t / 6.0, 0.5 * t - t * t * t / 24.0
    robot_x, robot_y = x[0], x[1]
    walls = False
    for k in range(-1, (n - 3) // 2):
        i = 0 if k < 0 else 3 + 2 * k
        if k >= 0 and marks[k, 0] == LINE:
            alpha = x[i]
            x[i], x[i + 1] = wrap_scalar(alpha + delta[i]), x[i + 1] + delta[i + 1]
            dx, dy = math.cos(x[i]) - math.cos(alpha), math.sin(x[i]) - math.sin(alpha)
            a[0, i] = a[1, i] = a[2, i] = 0.0
            a[0, i + 1], a[1, i + 1], a[2, i + 1] = dx, dy, dx * robot_y - dy * robot_x
            walls = True
            continue
        px, py = x[i], x[i + 1]
        dx, dy = delta[i] + py * t, delta[i + 1] - px * t  # J p = (−py, px)
        x[i] = c * px - s * py + va * dx - vb * dy
        x[i + 1] = s * px + c * py + vb * dx + va * dy
        a[0, i] = a[0, i + 1] = a[1, i] = a[1, i + 1] = 0.0
        a[2, i], a[2, i + 1] = -(x[i + 1] - py), x[i] - px
    x[2] = wrap_scalar(x[2] + t)
    a[0, 2] = a[1, 2] = a[2, 2] = 0.0
    return walls


@njit(cache=True, nogil=True, error_model="numpy")
def _add_half(shift: Array, n: int) -> None:
    """Turn P_:r in the rows of V into P_:r + ½ A P_rr."""
    rr = np.empty((3, 3))
    for q in range(3):
        for e in range(3):
            rr[q, e] = shift[4 + q, e]
    for q in range(3):
        for j in range(n):
            shift[4 + q, j] += 0.5 * (shift[1, j] * rr[q, 0] + shift[2, j] * rr[q, 1] + shift[3, j] * rr[q, 2])


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _reset(p: Array, n: int, shift: Array, walls: bool) -> None:
    """Add A Vᵀ + V Aᵀ to the upper triangle of p; without walls A has its column by θ only."""
    for q in range(0 if walls else 2, 3):
        a, v = shift[1 + q, :n], shift[4 + q, :n]
        for i in range(n):
            ai, vi = a[i], v[i]
            upper, aj, vj = p[i, i:n], a[i:], v[i:]
            for j in range(upper.shape[0]):
                upper[j] += ai * vj[j] + vi * aj[j]
