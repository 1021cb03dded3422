"""Which landmarks were seen, judged together: joint compatibility over a joint Gaussian (kernels).

The joint covariance is passed as its upper triangle; landmark ``i`` stands at state index 3 + 2i.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from slam.geometry import wrap_scalar
from slam.landmarks.association import IGNORED, UNMATCHED, alike, beside, gated_distance, predicted, too_near
from slam.metrics.chi_square import chi2_quantile
from slam.types import LINE, Array, Indices

__all__ = ["JOINT_GATES", "JOINT_LIMITS", "MAX_OBSERVATIONS", "extend", "insert_nearest", "joint_compatibility"]

MAX_OBSERVATIONS = 64
"""Observations that are taken at once."""
JOINT_GATES = np.array([0.0] + [chi2_quantile(0.99, 2 * k) for k in range(1, MAX_OBSERVATIONS + 1)])
"""Largest squared distance of k pairings together: 99 % of chi-square with 2k degrees of freedom."""
JOINT_LIMITS = np.array([0.0] + [chi2_quantile(1.0 - 1e-6, 2 * k) for k in range(1, MAX_OBSERVATIONS + 1)])
"""The same of pairings that were made one by one; beyond it, one at least of them is wrong."""

_WALL_WINDOW_M = 1.0  # farther off, a piece of wall is not tested for being a known wall
_CANDIDATES = 8  # landmarks considered for one observation, the nearest first
_MOST_NODES = 4000  # the search stops there with the best set so far; it is exponential at worst


@njit(cache=True, nogil=True, error_model="numpy")
def joint_compatibility(
    x: Array, p: Array, offset: float, z: Array, marks: Array, near: float, max_turn: float, match: Indices
) -> float:
    """Match as many observations as one pose can explain together; return their joint squared distance.

    Joint compatibility branch and bound (Neira and Tardós 2001): the innovations of all pairings at once, with
    their cross-covariances, must lie within the gate. Among the largest such sets, the nearest one. S is factored
    row by row as the search goes down, so that a pairing costs its own two rows only. The arguments are
    :func:`slam.landmarks.association.nearest_neighbour`'s.
    """
    m = z.shape[0]
    candidate, count = np.zeros((m, _CANDIDATES), np.int64), np.zeros(m + 1, np.int64)
    distance = np.zeros((m, _CANDIDATES))
    for k in range(m):
        match[k] = UNMATCHED
        count[k] = _compatible(x, p, offset, z[k], marks, max_turn, candidate[k], distance[k])
    left = np.zeros(m + 1, np.int64)  # observations from k on that any landmark could be
    for k in range(m - 1, -1, -1):
        left[k] = left[k + 1] + (count[k] > 0)

    h = np.zeros((m, 2, 5))  # one entry a pairing, down the present branch
    landmark = np.zeros(m, np.int64)
    factor, y = np.zeros((2 * m, 2 * m)), np.zeros(2 * m)
    nis = np.zeros(m + 1)
    option, paired = np.zeros(m + 1, np.int64), np.zeros(m + 1, np.bool_)
    chosen = np.full(m, UNMATCHED)
    pairs = best_pairs = 0
    best_nis = 0.0
    k = 0
    for _ in range(_MOST_NODES):
        if paired[k]:  # come back from below
            paired[k] = False
            chosen[k] = UNMATCHED
            pairs -= 1
        hope = pairs + left[k]
        hopeless = hope < best_pairs or (hope == best_pairs and nis[pairs] >= best_nis)
        if k == m and not hopeless:
            best_pairs, best_nis = pairs, nis[pairs]
            for i in range(m):
                match[i] = chosen[i]
        if k == m or hopeless or option[k] > count[k]:
            if k == 0:
                break
            k -= 1
            continue
        o = option[k]
        option[k] += 1
        if o < count[k]:
            i = candidate[k, o]
            if z[k, 5] != LINE and np.any(landmark[:pairs] == i):
                continue
            landmark[pairs] = i
            extend(x, p, offset, z[k], landmark, pairs, h, factor, y)
            more = nis[pairs] + y[2 * pairs] ** 2 + y[2 * pairs + 1] ** 2
            if more > JOINT_GATES[pairs + 1]:
                continue
            pairs += 1
            nis[pairs] = more
            paired[k] = True
            chosen[k] = i
        k += 1
        option[k] = 0
    _set_aside(x, offset, z, marks, near, max_turn, count, match)
    return float(best_nis)


@njit(cache=True, nogil=True, error_model="numpy")
def _compatible(
    x: Array, p: Array, offset: float, z: Array, marks: Array, max_turn: float, candidate: Indices, distance: Array
) -> int:
    """List the landmarks that one observation could be, nearest first; return how many."""
    h = np.zeros((2, 5))
    found = 0
    for i in range(marks.shape[0]):
        if not alike(z, marks[i], x[2], max_turn):
            continue
        if z[5] == LINE and not beside(x, i, offset, z, marks[i], _WALL_WINDOW_M):
            continue
        d2 = gated_distance(x, p, i, offset, z, h)
        if d2 < JOINT_GATES[1]:
            found = insert_nearest(i, d2, candidate, distance, found)
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def insert_nearest(i: int, d2: float, nearest: Indices, distance: Array, count: int) -> int:
    """Put ``i`` into a list, sorted by distance, of the nearest that there is room for; return their number."""
    most = nearest.shape[0]
    if count == most and d2 >= distance[most - 1]:
        return count
    j = min(count, most - 1)
    while j > 0 and distance[j - 1] > d2:
        nearest[j], distance[j] = nearest[j - 1], distance[j - 1]
        j -= 1
    nearest[j], distance[j] = i, d2
    return int(min(count + 1, most))


@njit(cache=True, nogil=True, error_model="numpy")
def extend(
    x: Array, p: Array, offset: float, z: Array, landmark: Indices, pairs: int, h: Array, factor: Array, y: Array
) -> None:
    """Add a pairing's two rows to the Cholesky factor L of S and to y = L⁻¹ ν."""
    i = landmark[pairs]
    rho, bearing = predicted(x, i, z[5], offset, h[pairs])
    row = 2 * pairs
    y[row], y[row + 1] = z[0] - rho, wrap_scalar(z[1] - bearing)
    for e in range(2):
        r = row + e
        for j in range(r + 1):
            v = _cross(p, i, h[pairs, e], landmark[j // 2], h[j // 2, j % 2])
            if j >= row:
                v += z[2 + e + (j - row)]  # R's terms: ρρ, ρφ, φφ
            for q in range(j):
                v -= factor[r, q] * factor[j, q]
            if j < r:
                factor[r, j] = v / factor[j, j]
                y[r] -= factor[r, j] * y[j]
            else:
                factor[r, r] = math.sqrt(v)
                y[r] /= factor[r, r]


@njit(cache=True, nogil=True, error_model="numpy")
def _cross(p: Array, i: int, hi: Array, j: int, hj: Array) -> float:
    """Return Hi P Hjᵀ for a row of either landmark's H, from P's upper triangle."""
    total = 0.0
    for a in range(5):
        ia = a if a < 3 else 3 + 2 * i + a - 3
        for b in range(5):
            jb = b if b < 3 else 3 + 2 * j + b - 3
            total += hi[a] * hj[b] * (p[ia, jb] if ia <= jb else p[jb, ia])
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _set_aside(
    x: Array, offset: float, z: Array, marks: Array, near: float, max_turn: float, count: Indices, match: Indices
) -> None:
    """Mark as IGNORED what is unmatched, yet could be a landmark or is too near to one to be new."""
    c, s = math.cos(x[2]), math.sin(x[2])
    for k in range(z.shape[0]):
        if match[k] != UNMATCHED:
            continue
        if count[k] > 0:
            match[k] = IGNORED
            continue
        bearing = x[2] + z[k, 1]
        px = x[0] + offset * c + z[k, 0] * math.cos(bearing)
        py = x[1] + offset * s + z[k, 0] * math.sin(bearing)
        for i in range(marks.shape[0]):
            if not alike(z[k], marks[i], x[2], max_turn):
                continue
            if too_near(x, i, offset, z[k], marks[i], near, x[3 + 2 * i] - px, x[4 + 2 * i] - py):
                match[k] = IGNORED
