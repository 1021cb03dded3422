"""Kernels of the centralised filter: a turn passes from one robot to another, and one sees another."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from slam.gaussian.stacked_update import cholesky, solve
from slam.gaussian.tiles import add_combination, downdate, subtract
from slam.geometry import wrap_scalar
from slam.types import Array

__all__ = ["correct_by_sighting", "expected_sighting", "swap_robots"]


@njit(cache=True, nogil=True, error_model="numpy")
def swap_robots(x: Array, p: Array, n: int, mean: Array, cov: Array, cross: Array, s: int) -> None:
    """Exchange the robot of a joint Gaussian with the one whose pose stands beside the map from state ``s`` on.

    ``x`` ``(≥ n,)`` and ``p``, an upper triangle, are the map's filter, ``mean`` ``(k,)``, ``cov`` ``(k, k)`` and
    ``cross`` ``(k, ≥ n)`` the states beside it. Every number stays what it is.
    """
    for q in range(3):
        x[q], mean[s + q] = mean[s + q], x[q]
        for j in range(3, n):
            p[q, j], cross[s + q, j] = cross[s + q, j], p[q, j]
        for t in range(mean.shape[0]):
            if t < s or t >= s + 3:
                value = cross[t, q]
                cross[t, q] = cov[t, s + q]
                cov[t, s + q] = cov[s + q, t] = value
        for r in range(q, 3):
            value = p[q, r]
            p[q, r] = cov[s + q, s + r]
            cov[s + q, s + r] = cov[s + r, s + q] = value
            cross[s + q, r], cross[s + r, q] = cross[s + r, q], cross[s + q, r]
    x[2] = wrap_scalar(x[2])


@njit(cache=True, nogil=True, error_model="numpy")
def expected_sighting(seer: Array, seen: Array, hi: Array, hj: Array) -> tuple[float, float, float]:
    """Return range, bearing and relative heading at which a robot at ``seer`` should see one at ``seen``.

    Of poses ``(≥ 3,)``; ``hi`` and ``hj`` ``(3, 3)`` are filled with the Jacobians by either pose.
    """
    dx, dy = seen[0] - seer[0], seen[1] - seer[1]
    rho2 = dx * dx + dy * dy
    rho = math.sqrt(rho2)
    hj[0, 0], hj[0, 1], hj[0, 2] = dx / rho, dy / rho, 0.0
    hj[1, 0], hj[1, 1], hj[1, 2] = -dy / rho2, dx / rho2, 0.0
    hj[2, 0], hj[2, 1], hj[2, 2] = 0.0, 0.0, 1.0
    for e in range(3):
        hi[e, 0], hi[e, 1], hi[e, 2] = -hj[e, 0], -hj[e, 1], 0.0
    hi[1, 2] = hi[2, 2] = -1.0
    return rho, wrap_scalar(math.atan2(dy, dx) - seer[2]), wrap_scalar(seen[2] - seer[2])


@njit(cache=True, nogil=True, error_model="numpy")
def correct_by_sighting(
    x: Array, p: Array, n: int, mean: Array, cov: Array, cross: Array, j: int, z: Array, r: Array, gate: float,
    w: Array, s: Array, we: Array,
) -> float:  # fmt: skip
    """Correct by a sighting of the robot that stands beside the map from state ``j`` on; return the NIS.

    As :mod:`slam.gaussian.stacked_update` and :mod:`slam.gaussian.companions` do it, with H by both poses; ``w``,
    ``s`` and ``we`` ``(3, k)`` are work space.
    """
    k = mean.shape[0]
    hi, hj = np.empty((3, 3)), np.empty((3, 3))
    rho, bearing, turn = expected_sighting(x, mean[j : j + 3], hi, hj)
    for e in range(3):
        for c in range(n):
            w[e, c] = 0.0
            for q in range(3):
                w[e, c] += hi[e, q] * p[min(q, c), max(q, c)] + hj[e, q] * cross[j + q, c]
        for c in range(k):
            we[e, c] = 0.0
            for q in range(3):
                we[e, c] += hi[e, q] * cross[c, q] + hj[e, q] * cov[j + q, c]
    for e in range(3):
        for f in range(e, 3):
            s[e, f] = r[e, f]
            for q in range(3):
                s[e, f] += w[e, q] * hi[f, q] + we[e, j + q] * hj[f, q]
    s[0, 3], s[1, 3], s[2, 3] = z[0] - rho, wrap_scalar(z[1] - bearing), wrap_scalar(z[2] - turn)
    cholesky(s, 3)
    nis = s[0, 3] ** 2 + s[1, 3] ** 2 + s[2, 3] ** 2
    if not nis <= gate:
        return float(nis)
    solve(s, w, n, 3)
    solve(s, we, k, 3)
    add_combination(x, n, s[:3, 3], w)
    x[2] = wrap_scalar(x[2])
    add_combination(mean, k, s[:3, 3], we)
    downdate(p, n, w, w, 3, 0)
    subtract(cross, k, n, we, w, 3)
    for a in range(k):
        for b in range(k):
            for e in range(3):
                cov[a, b] -= we[e, a] * we[e, b]
    return float(nis)
