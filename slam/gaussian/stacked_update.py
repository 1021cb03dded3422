"""The stacked update of EKF-SLAM: all observations of a scan at once, as Numba kernels.

    S = H P Hᵀ + R = L Lᵀ,  W = L⁻¹ H P,  x += Wᵀ L⁻¹ ν,  P ← P − Wᵀ W

(docs/reference/ekf.md; the same as P − K S Kᵀ). From fifty landmarks on most of the time goes into the last
product, which is :mod:`slam.gaussian.tiles`'.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from slam.gaussian.lanes import LANES, add_product, aligned_zeros, first, load, store, subtract_product, times
from slam.gaussian.tiles import add_combination, downdate
from slam.geometry import wrap_scalar
from slam.landmarks.association import predicted
from slam.types import LINE, Array, Indices

__all__ = [
    "NO_LIMITS", "SPARE_ROWS", "cholesky", "solve", "stacked_update", "whiten", "whiten_difference", "work_space",
]  # fmt: skip

SPARE_ROWS = 6
"""Rows of w beyond the observations', for what a filter may want to subtract beside Wᵀ W."""

NO_LIMITS = np.array([math.inf])
"""Limits of an update that is made however large its NIS."""


def work_space(observations: int, size: int) -> tuple[Array, Array, Array]:
    """Return h, w and s: the work space of updates by so many observations, of a state of ``size`` at most."""
    rows = 2 * observations
    h = np.zeros((observations, 2, 5))
    w = aligned_zeros(rows + SPARE_ROWS, size)
    s = aligned_zeros(rows, rows + 1 + LANES)  # S and ν, and room for the last vector of a row
    return h, w, s


@njit(cache=True, nogil=True, error_model="numpy")
def stacked_update(
    x: Array,
    p: Array,
    n: int,
    z: Array,
    match: Indices,
    offset: float,
    h: Array,
    w: Array,
    s: Array,
    limits: Array,
) -> tuple[int, float]:
    """Make one EKF update of all observations with ``match`` ≥ 0; return the degrees of freedom and the NIS.

    ``p`` is an upper triangle; the lower one is undefined after. ``h``, ``w``, ``s`` are a :func:`work_space`.
    ``limits[k]`` is how large the NIS of k observations may be, the last one holding for all that are more. Where
    it is larger, nothing is done and the degrees of freedom are 0.
    """
    rows = whiten(x, p, n, z, match, offset, h, w, s)
    nis = 0.0
    for k in range(rows):
        nis += s[k, rows] * s[k, rows]
    if nis > limits[min(rows // 2, limits.shape[0] - 1)]:
        return 0, nis
    add_combination(x, n, s[:rows, rows], w)
    x[2] = wrap_scalar(x[2])
    if rows > 0:
        downdate(p, n, w, w, rows, 0)
    return rows, nis


@njit(cache=True, nogil=True, error_model="numpy")
def whiten(
    x: Array, p: Array, n: int, z: Array, match: Indices, offset: float, h: Array, w: Array, s: Array
) -> int:
    """Write W = L⁻¹ H P into ``w``; return the number of rows.

    ``s`` holds in row k, from the diagonal on, 1 / L_kk, the rest of L's column k and, after that, (L⁻¹ ν)_k.

    A wall's foot seems too far by ½ d e² where its direction is seen wrong by e, whatever R says of the two. So
    much is taken off, as far as the innovation tells of that e (docs/reference/ekf.md, Walls).
    """
    rows = 0
    for j in range(3):  # the robot's block is read as rows, so both its triangles are
        for q in range(j):
            p[j, q] = p[q, j]
    for k in range(z.shape[0]):
        if match[k] >= 0:
            _landmark_rows(p, n, 3 + 2 * match[k], w[rows], w[rows + 1])
            rows += 2
    a = 0
    for k in range(z.shape[0]):
        if match[k] >= 0:
            rho, bearing = predicted(x, match[k], z[k, 5], offset, h[a // 2])
            s[a, rows], s[a + 1, rows] = z[k, 0] - rho, wrap_scalar(z[k, 1] - bearing)
            a += 2
    _h_times_rows(h, p, n, w, rows)
    a = 0
    for k in range(z.shape[0]):
        if match[k] >= 0:
            _innovation_columns(w, 3 + 2 * match[k], h[a // 2], a, s)
            if z[k, 5] == LINE:
                expected = s[a + 1, a + 1]
                share = z[k, 4] / (z[k, 4] + expected)  # of the innovation that is the observation's own
                s[a, rows] -= 0.5 * z[k, 0] * share * (share * s[a + 1, rows] ** 2 + expected)
            s[a, a] += z[k, 2]
            s[a, a + 1] += z[k, 3]
            s[a + 1, a + 1] += z[k, 4]
            a += 2
    cholesky(s, rows)
    solve(s, w, n, rows)
    return rows


@njit(cache=True, nogil=True, error_model="numpy")
def whiten_difference(
    p: Array, n: int, i: int, e_variance: float, cross: Array, nu: float, variance: float, w: Array, s: Array
) -> int:  # fmt: skip
    """Do :func:`whiten` for one observation, that of x_i − e, with its innovation; return the number of rows.

    e is a state beside the map (:mod:`slam.gaussian.companions`) of a variance, and ``cross`` ``(≥ n,)`` its
    covariance with the state. There are two rows, of which the second is nought: they are worked on in pairs.
    """
    for k in range(n):
        w[0, k] = p[min(i, k), max(i, k)] - cross[k]
        w[1, k] = 0.0
    s[0, 0], s[0, 1], s[0, 2] = w[0, i] - cross[i] + e_variance + variance, 0.0, nu
    s[1, 1], s[1, 2] = 1.0, 0.0
    cholesky(s, 2)
    solve(s, w, n, 2)
    return 2


@njit(cache=True, nogil=True, error_model="numpy")
def _landmark_rows(p: Array, n: int, m: int, out0: Array, out1: Array) -> None:
    """Write the rows m and m + 1 of the symmetric P: left of the diagonal they stand in its columns."""
    for j in range(m):
        out0[j], out1[j] = p[j, m], p[j, m + 1]
    out1[m] = p[m, m + 1]
    for j in range(m, n):
        out0[j] = p[m, j]
    for j in range(m + 1, n):
        out1[j] = p[m + 1, j]


@njit(cache=True, nogil=True, error_model="numpy")
def _h_times_rows(h: Array, p: Array, n: int, w: Array, rows: int) -> None:
    """Turn the observed landmarks' rows of P in ``w`` into H P, with the robot's rows of ``p``."""
    for j in range(0, n, LANES):
        mask = first(n - j)
        p0, p1, p2 = load(p, (0, j), mask), load(p, (1, j), mask), load(p, (2, j), mask)
        for k in range(0, rows, 2):
            g, pa, pb = h[k // 2], load(w, (k, j), mask), load(w, (k + 1, j), mask)
            for e in range(2):
                row = times(g[e, 3], pa)
                row = add_product(row, g[e, 4], pb)
                row = add_product(row, g[e, 0], p0)
                row = add_product(row, g[e, 1], p1)
                row = add_product(row, g[e, 2], p2)
                store(w, (k + e, j), mask, row)


@njit(cache=True, nogil=True, error_model="numpy")
def _innovation_columns(w: Array, m: int, h: Array, a: int, s: Array) -> None:
    """Write the columns a and a + 1 of H P Hᵀ down to the diagonal, H P standing in ``w``."""
    for b in range(a + 2):
        hp = w[b]
        for e in range(2):
            s[b, a + e] = (h[e, 3] * hp[m] + h[e, 4] * hp[m + 1] + h[e, 0] * hp[0]) + (
                h[e, 1] * hp[1] + h[e, 2] * hp[2]
            )


@njit(cache=True, nogil=True, error_model="numpy")
def cholesky(s: Array, rows: int) -> None:
    """Factor the upper triangle S = L Lᵀ in place, and multiply the column right of it, ν, by L⁻¹."""
    for k in range(rows):
        inverse = 1.0 / math.sqrt(s[k, k])
        for j in range(k + 1, rows + 1):
            s[k, j] *= inverse
        s[k, k] = inverse
        for i in range(k + 1, rows):
            factor = s[k, i]
            # Whole vectors: those left of the diagonal and right of ν are of no account.
            for j in range(i - i % LANES, rows + 1, LANES):
                store(s, (i, j), None, subtract_product(load(s, (i, j), None), factor, load(s, (k, j), None)))


@njit(cache=True, nogil=True, error_model="numpy")
def solve(s: Array, w: Array, n: int, rows: int) -> None:
    """Multiply W by L⁻¹ in place, a few columns at a time from top to bottom."""
    j = 0
    while j + 2 * LANES <= n:
        _solve_tile(s, w, j, rows, None, None)
        j += 2 * LANES
    if j < n:
        _solve_tile(s, w, j, rows, first(n - j), first(n - j - LANES))


@njit(nogil=True, error_model="numpy", forceinline=True)
def _solve_tile(s: Array, w: Array, j: int, rows: int, mask0: Any, mask1: Any) -> None:
    for i in range(rows):
        v0, v1 = load(w, (i, j), mask0), load(w, (i, j + LANES), mask1)
        for k in range(i):
            factor = s[k, i]
            v0 = subtract_product(v0, factor, load(w, (k, j), mask0))
            v1 = subtract_product(v1, factor, load(w, (k, j + LANES), mask1))
        store(w, (i, j), mask0, times(s[i, i], v0))
        store(w, (i, j + LANES), mask1, times(s[i, i], v1))
