"""The arithmetic of EKF-SLAM on a joint Gaussian of the robot and its landmarks, as Numba kernels.

The covariance is the upper triangle of a square array, the robot's three states first; landmark ``i`` stands at
index 3 + 2i. Association reads it, too (:mod:`slam.association`).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.association import predicted
from slam.geometry import wrap_scalar
from slam.types import LINE

__all__ = [
    "OBSERVED_LIMIT",
    "add_landmark",
    "downdate",
    "near_landmarks",
    "stacked_update",
    "symmetric_block",
    "whiten",
]

Array = NDArray[np.float64]

OBSERVED_LIMIT = 1e4
"""Bound of what :func:`near_landmarks` writes, m and m²: Gymnasium asks for finite spaces."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def stacked_update(
    x: Array, p: Array, n: int, z: Array, match: NDArray[np.int64], offset: float, h: Array, w: Array, s: Array,
    subtract: bool,
) -> tuple[int, float]:  # fmt: skip
    """Make one EKF update of all observations with ``match`` ≥ 0; return the degrees of freedom and the NIS.

    S = H P Hᵀ + R = L Lᵀ, W = L⁻¹ H P, x += Wᵀ L⁻¹ ν, P ← P − Wᵀ W (theory.md A, observe; the same as
    P − K S Kᵀ). ``p`` is an upper triangle; ``h``, ``w``, ``s`` are work space. Without ``subtract``, P − Wᵀ W is
    left to the caller.
    """
    rows = whiten(x, p, n, z, match, offset, h, w, s)
    ns = s.shape[1] - 1
    nis = 0.0
    for k in range(rows):
        y = s[k, ns]
        nis += y * y
        wk = w[k]
        for j in range(n):
            x[j] += y * wk[j]
    x[2] = wrap_scalar(x[2])
    if subtract:
        downdate(p, n, w, rows)
    return rows, nis


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def whiten(
    x: Array, p: Array, n: int, z: Array, match: NDArray[np.int64], offset: float, h: Array, w: Array, s: Array
) -> int:  # fmt: skip
    """Write W = L⁻¹ H P into ``w`` and L⁻¹ ν into the last column of ``s``; return the number of rows."""
    rows = 0
    ns = s.shape[1] - 1  # the last column holds the innovation
    for k in range(z.shape[0]):
        if match[k] < 0:
            continue
        m = 3 + 2 * match[k]
        hk = h[rows // 2]
        rho, bearing = predicted(x, match[k], z[k, 5], offset, hk)
        s[rows, ns] = z[k, 0] - rho
        s[rows + 1, ns] = wrap_scalar(z[k, 1] - bearing)
        _h_times_p(p, n, m, hk, w[rows], w[rows + 1])
        rows += 2
    # S, its lower triangle: H W' row by row.
    a = 0
    for k in range(z.shape[0]):
        if match[k] < 0:
            continue
        m = 3 + 2 * match[k]
        hk = h[a // 2]
        for e in range(2):
            for b in range(a + 2):
                v = hk[e, 3] * w[b, m] + hk[e, 4] * w[b, m + 1]
                for q in range(3):
                    v += hk[e, q] * w[b, q]
                s[a + e, b] = v
        s[a, a] += z[k, 2]
        s[a + 1, a] += z[k, 3]
        s[a + 1, a + 1] += z[k, 4]
        a += 2
    _cholesky_solve(s, rows, ns, w, n)
    return rows


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _h_times_p(p: Array, n: int, m: int, h: Array, out0: Array, out1: Array) -> None:
    """Write both rows of H P for the landmark at state index ``m``, reading P's upper triangle."""
    # Left of the landmark its part of P stands in the columns m and m + 1.
    for j in range(m):
        a, b = p[j, m], p[j, m + 1]
        out0[j] = h[0, 3] * a + h[0, 4] * b
        out1[j] = h[1, 3] * a + h[1, 4] * b
    out0[m] = h[0, 3] * p[m, m] + h[0, 4] * p[m, m + 1]
    out1[m] = h[1, 3] * p[m, m] + h[1, 4] * p[m, m + 1]
    right0, right1, pa, pb = out0[m + 1 : n], out1[m + 1 : n], p[m, m + 1 : n], p[m + 1, m + 1 : n]
    for j in range(right0.shape[0]):
        right0[j] = h[0, 3] * pa[j] + h[0, 4] * pb[j]
        right1[j] = h[1, 3] * pa[j] + h[1, 4] * pb[j]
    for j in range(3):
        for q in range(3):
            c = p[q, j] if q <= j else p[j, q]
            out0[j] += h[0, q] * c
            out1[j] += h[1, q] * c
    map0, map1, p0, p1, p2 = out0[3:n], out1[3:n], p[0, 3:n], p[1, 3:n], p[2, 3:n]
    for j in range(map0.shape[0]):
        map0[j] += h[0, 0] * p0[j] + h[0, 1] * p1[j] + h[0, 2] * p2[j]
        map1[j] += h[1, 0] * p0[j] + h[1, 1] * p1[j] + h[1, 2] * p2[j]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _cholesky_solve(s: Array, rows: int, column: int, w: Array, n: int) -> None:
    """Factor S in place (lower triangle), and turn its last column and the rows of w into L⁻¹ times them."""
    for i in range(rows):
        wi = w[i, :n]
        for j in range(i):
            v = s[i, j]
            for k in range(j):
                v -= s[i, k] * s[j, k]
            v /= s[j, j]
            s[i, j] = v
            s[i, column] -= v * s[j, column]
            wj = w[j, :n]
            for q in range(n):
                wi[q] -= v * wj[q]
        d = s[i, i]
        for k in range(i):
            d -= s[i, k] * s[i, k]
        root = math.sqrt(d)
        s[i, i] = root
        inverse = 1.0 / root
        s[i, column] *= inverse
        for q in range(n):
            wi[q] *= inverse


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def downdate(p: Array, n: int, w: Array, rows: int) -> None:
    """Subtract Wᵀ W from the upper triangle of p; two spare rows of w may be overwritten. ``rows`` is even.

    Four rows of p and four of W at a time, to spare memory traffic; the rows are sliced first, without which the
    inner loop does not vectorise and takes three times as long. The lower triangle is undefined after.
    """
    if rows % 4 != 0:
        w[rows : rows + 2, :n] = 0.0
    whole = n - n % 4
    for i in range(0, whole, 4):
        p0, p1, p2, p3 = p[i, i:n], p[i + 1, i:n], p[i + 2, i:n], p[i + 3, i:n]
        for k in range(0, rows, 4):
            a0, a1, a2, a3 = w[k, i], w[k + 1, i], w[k + 2, i], w[k + 3, i]
            b0, b1, b2, b3 = w[k, i + 1], w[k + 1, i + 1], w[k + 2, i + 1], w[k + 3, i + 1]
            c0, c1, c2, c3 = w[k, i + 2], w[k + 1, i + 2], w[k + 2, i + 2], w[k + 3, i + 2]
            d0, d1, d2, d3 = w[k, i + 3], w[k + 1, i + 3], w[k + 2, i + 3], w[k + 3, i + 3]
            w0, w1, w2, w3 = w[k, i:n], w[k + 1, i:n], w[k + 2, i:n], w[k + 3, i:n]
            for j in range(p0.shape[0]):
                x0, x1, x2, x3 = w0[j], w1[j], w2[j], w3[j]
                p0[j] -= a0 * x0 + a1 * x1 + (a2 * x2 + a3 * x3)
                p1[j] -= b0 * x0 + b1 * x1 + (b2 * x2 + b3 * x3)
                p2[j] -= c0 * x0 + c1 * x1 + (c2 * x2 + c3 * x3)
                p3[j] -= d0 * x0 + d1 * x1 + (d2 * x2 + d3 * x3)
    for i in range(whole, n):
        for j in range(i, n):
            for k in range(rows):
                p[i, j] -= w[k, i] * w[k, j]


@njit(cache=True, nogil=True, error_model="numpy")
def add_landmark(x: Array, p: Array, n: int, z: Array, offset: float) -> None:
    """Append a landmark seen at (ρ, φ) = z[:2] with covariance z[2:5] (theory.md A, add a landmark)."""
    if z[5] == LINE:
        _add_line(x, p, n, z, offset)
        return
    c, s = math.cos(x[2]), math.sin(x[2])
    cb, sb = math.cos(x[2] + z[1]), math.sin(x[2] + z[1])
    rx, ry = offset * c + z[0] * cb, offset * s + z[0] * sb
    x[n], x[n + 1] = x[0] + rx, x[1] + ry
    # Gr = [[1, 0, -ry], [0, 1, rx]];  cross = Gr P_r:, written into the new columns of the upper triangle.
    for j in range(n):
        p0 = p[0, j]
        p1 = p[1, j] if j >= 1 else p[0, 1]
        p2 = p[2, j] if j >= 2 else p[j, 2]
        p[j, n] = p0 - ry * p2
        p[j, n + 1] = p1 + rx * p2
    # Gz = [[cb, -ρ sb], [sb, ρ cb]]
    a, b, d, e = cb, -z[0] * sb, sb, z[0] * cb
    r00 = a * a * z[2] + 2.0 * a * b * z[3] + b * b * z[4]
    r01 = a * d * z[2] + (a * e + b * d) * z[3] + b * e * z[4]
    r11 = d * d * z[2] + 2.0 * d * e * z[3] + e * e * z[4]
    p[n, n] = p[0, n] - ry * p[2, n] + r00
    p[n, n + 1] = p[0, n + 1] - ry * p[2, n + 1] + r01
    p[n + 1, n + 1] = p[1, n + 1] + rx * p[2, n + 1] + r11


@njit(cache=True, nogil=True, error_model="numpy")
def _add_line(x: Array, p: Array, n: int, z: Array, offset: float) -> None:
    """Append a line (α, r) seen at distance z[0] and bearing z[1]: α = θ + φ, r = ρ + n(α)ᵀ s."""
    alpha = wrap_scalar(x[2] + z[1])
    nx, ny = math.cos(alpha), math.sin(alpha)
    c, s = math.cos(x[2]), math.sin(x[2])
    sx, sy = x[0] + offset * c, x[1] + offset * s
    lever = nx * sy - ny * sx  # (J n)ᵀ s: by how much r grows with α
    turn = lever + offset * (ny * c - nx * s)
    x[n], x[n + 1] = alpha, z[0] + nx * sx + ny * sy
    # Gr = [[0, 0, 1], [nx, ny, turn]], Gz (by distance, bearing) = [[0, 1], [1, lever]]
    for j in range(n):
        p0 = p[0, j]
        p1 = p[1, j] if j >= 1 else p[0, 1]
        p2 = p[2, j] if j >= 2 else p[j, 2]
        p[j, n] = p2
        p[j, n + 1] = nx * p0 + ny * p1 + turn * p2
    p[n, n] = p[2, n] + z[4]
    p[n, n + 1] = p[2, n + 1] + z[3] + lever * z[4]
    p[n + 1, n + 1] = (
        nx * p[0, n + 1] + ny * p[1, n + 1] + turn * p[2, n + 1]
        + z[2] + 2.0 * lever * z[3] + lever * lever * z[4]
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def symmetric_block(p: Array, out: Array) -> None:
    """Write the leading block of an upper triangle as the full symmetric matrix."""
    for i in range(out.shape[0]):
        for j in range(i, out.shape[0]):
            out[i, j] = out[j, i] = p[i, j]


@njit(cache=True, nogil=True, error_model="numpy")
def near_landmarks(x: Array, p: Array, marks: Array, out: NDArray[np.float32]) -> None:
    """Write the nearest point landmarks in the robot frame, by insertion into a list sorted by distance."""
    out[:] = 0.0
    c, s = math.cos(x[2]), math.sin(x[2])
    size = out.shape[0]
    nearest, distance = np.empty(size, np.int64), np.empty(size)
    filled = 0
    for i in range(marks.shape[0]):
        if marks[i, 0] == LINE:
            continue
        dx, dy = x[3 + 2 * i] - x[0], x[4 + 2 * i] - x[1]
        d2 = dx * dx + dy * dy
        j = filled if filled < size else size - 1
        if filled == size and d2 >= distance[j]:
            continue
        while j > 0 and distance[j - 1] > d2:
            nearest[j], distance[j] = nearest[j - 1], distance[j - 1]
            j -= 1
        nearest[j], distance[j] = i, d2
        filled = min(filled + 1, size)
    for j in range(filled):
        k = 3 + 2 * nearest[j]
        dx, dy = x[k] - x[0], x[k + 1] - x[1]
        a, b, d = p[k, k], p[k, k + 1], p[k + 1, k + 1]
        out[j, 0] = c * dx + s * dy
        out[j, 1] = -s * dx + c * dy
        out[j, 2] = c * c * a + 2.0 * c * s * b + s * s * d
        out[j, 3] = -c * s * a + (c * c - s * s) * b + c * s * d
        out[j, 4] = s * s * a - 2.0 * c * s * b + c * c * d
        for q in range(5):
            out[j, q] = min(max(out[j, q], -OBSERVED_LIMIT), OBSERVED_LIMIT)
        out[j, 5] = 1.0
