"""Which landmark was seen: Mahalanobis gating, nearest neighbour and joint compatibility over a joint Gaussian.

The joint covariance is passed as its upper triangle; landmark ``i`` stands at state index 3 + 2i.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.geometry import wrap_scalar
from slam.metrics.chi_square import chi2_quantile
from slam.types import LINE

__all__ = [
    "IGNORED",
    "JOINT_GATES",
    "MAX_OBSERVATIONS",
    "UNMATCHED",
    "joint_compatibility",
    "line_blocks",
    "nearest_neighbour",
    "predicted",
    "refuse_unlikely",
]

Array = NDArray[np.float64]

UNMATCHED, IGNORED = -1, -2
"""An observation of something new; one too near to a landmark to be new, yet not surely that landmark."""


MAX_OBSERVATIONS = 64
"""Observations that are taken at once."""
JOINT_GATES = np.array([0.0] + [chi2_quantile(0.99, 2 * k) for k in range(1, MAX_OBSERVATIONS + 1)])
"""Largest squared distance of k pairings together: 99 % of chi-square with 2k degrees of freedom."""


@njit(cache=True, nogil=True, error_model="numpy")
def _point_blocks(x: Array, i: int, offset: float, c: float, s: float, h: Array) -> tuple[float, float]:
    """Write H of landmark ``i`` ``(2, 5)``: by x, y, θ, xi, yi; return the predicted range and bearing.

    theory.md A, observe; ``offset`` is L, ``c`` and ``s`` are the heading's cosine and sine.
    """
    dx = x[0] + offset * c - x[3 + 2 * i]
    dy = x[1] + offset * s - x[4 + 2 * i]
    rho2 = dx * dx + dy * dy
    rho = math.sqrt(rho2)
    h[0, 0], h[0, 1] = dx / rho, dy / rho
    h[1, 0], h[1, 1] = -dy / rho2, dx / rho2
    h[0, 2] = offset * (dy * c - dx * s) / rho
    h[1, 2] = offset * (dx * c + dy * s) / rho2 - 1.0
    h[0, 3], h[0, 4] = -h[0, 0], -h[0, 1]
    h[1, 3], h[1, 4] = -h[1, 0], -h[1, 1]
    return rho, wrap_scalar(math.atan2(-dy, -dx) - x[2])


@njit(cache=True, nogil=True, error_model="numpy")
def line_blocks(x: Array, i: int, offset: float, h: Array) -> tuple[float, float]:
    """Write H of line ``i`` (α, r) ``(2, 5)``: by x, y, θ, α, r; return its predicted distance and bearing.

    invariant-ekf.md, Line, with the distance first, so that a line's row looks like a point's range and bearing.
    """
    alpha, r = x[3 + 2 * i], x[4 + 2 * i]
    nx, ny = math.cos(alpha), math.sin(alpha)
    c, s = math.cos(x[2]), math.sin(x[2])
    sx, sy = x[0] + offset * c, x[1] + offset * s
    h[0, 0], h[0, 1] = -nx, -ny
    h[0, 2] = offset * (nx * s - ny * c)
    h[0, 3], h[0, 4] = ny * sx - nx * sy, 1.0
    h[1, 0], h[1, 1], h[1, 2], h[1, 3], h[1, 4] = 0.0, 0.0, -1.0, 1.0, 0.0
    return r - nx * sx - ny * sy, wrap_scalar(alpha - x[2])


@njit(cache=True, nogil=True, error_model="numpy")
def predicted(x: Array, i: int, kind: float, offset: float, h: Array) -> tuple[float, float]:
    """Write H of a landmark of a kind ``(2, 5)`` and return what should be seen of it."""
    if kind == LINE:
        return line_blocks(x, i, offset, h)
    return _point_blocks(x, i, offset, math.cos(x[2]), math.sin(x[2]), h)


@njit(cache=True, nogil=True, error_model="numpy")
def _gate(x: Array, p: Array, i: int, offset: float, z: Array, h: Array) -> float:
    """Return the squared Mahalanobis distance of an observation row from landmark ``i``."""
    rho, bearing = predicted(x, i, z[5], offset, h)
    return _distance(p, i, rho, bearing, z, h)


@njit(cache=True, nogil=True, error_model="numpy")
def _distance(p: Array, i: int, rho: float, bearing: float, z: Array, h: Array) -> float:
    """Return the squared Mahalanobis distance of an observation row from what is predicted of landmark ``i``."""
    s00, s01, s11 = add_expected(z[2], z[3], z[4], p, i, h)
    dr, db = z[0] - rho, wrap_scalar(z[1] - bearing)
    det = s00 * s11 - s01 * s01
    return float((s11 * dr * dr - 2.0 * s01 * dr * db + s00 * db * db) / det)


@njit(cache=True, nogil=True, error_model="numpy")
def add_expected(
    s00: float, s01: float, s11: float, p: Array, i: int, h: Array
) -> tuple[float, float, float]:  # fmt: skip
    """Return a covariance of range and bearing, R or zeros, plus H P Hᵀ of landmark ``i``.

    Over the five states that H touches, read from the upper triangle.
    """
    for a in range(5):
        ia = a if a < 3 else 2 * i + a
        for b in range(5):
            ib = b if b < 3 else 2 * i + b
            v = p[ia, ib] if ia <= ib else p[ib, ia]
            s00 += h[0, a] * v * h[0, b]
            s01 += h[0, a] * v * h[1, b]
            s11 += h[1, a] * v * h[1, b]
    return s00, s01, s11


@njit(cache=True, nogil=True, error_model="numpy")
def refuse_unlikely(x: Array, p: Array, offset: float, z: Array, gate: float, match: NDArray[np.int64]) -> None:
    """Set to IGNORED the matches, given from outside, that lie beyond a squared Mahalanobis distance."""
    h = np.empty((2, 5))
    for k in range(z.shape[0]):
        if match[k] >= 0 and _gate(x, p, match[k], offset, z[k], h) > gate:
            match[k] = IGNORED


@njit(cache=True, nogil=True, error_model="numpy")
def _alike(z: Array, mark: Array, theta: float, max_turn: float) -> bool:
    """Tell whether an observation has a landmark's kind and direction, as far as both are known."""
    if (z[5] == 0.0 and mark[0] != LINE) or (mark[0] == 0.0 and z[5] != LINE):
        return True
    return bool(z[5] == mark[0] and abs(wrap_scalar(z[6] + theta - mark[1])) <= max_turn)


@njit(cache=True, nogil=True, error_model="numpy")
def _beside(x: Array, i: int, offset: float, z: Array, mark: Array, window: float) -> bool:
    """Tell whether a piece of wall that is seen lies within a window [m] of wall ``i``, along it and across."""
    alpha, r = x[3 + 2 * i], x[4 + 2 * i]
    nx, ny = math.cos(alpha), math.sin(alpha)
    sx, sy = x[0] + offset * math.cos(x[2]), x[1] + offset * math.sin(x[2])
    # The two ends of the piece, in the belief's frame.
    c, s = math.cos(x[2] + z[1]), math.sin(x[2] + z[1])
    ax, ay = sx + z[0] * c - z[8] * s, sy + z[0] * s + z[8] * c
    bx, by = sx + z[0] * c - z[9] * s, sy + z[0] * s + z[9] * c
    if abs(nx * ax + ny * ay - r) > window or abs(nx * bx + ny * by - r) > window:
        return False
    ta, tb = nx * ay - ny * ax, nx * by - ny * bx
    return bool(max(ta, tb) > mark[6] - window and min(ta, tb) < mark[7] + window)


@njit(cache=True, nogil=True, error_model="numpy")
def _too_near(x: Array, i: int, offset: float, z: Array, mark: Array, near: float, dx: float, dy: float) -> bool:
    """Tell whether what is seen lies too near to landmark ``i``, of a point ``dx`` and ``dy`` away, to be new.

    How near that is [m] has nothing to do with how well the robot knows where it is: the longer the way from the
    start, the more of the walls beside others would be taken for neither known nor new, and be of no use at all.
    """
    if z[5] == LINE:
        return _beside(x, i, offset, z, mark, near)
    return bool(dx * dx + dy * dy < near * near)


_LIES_ON = -3  # less the wall's index: an observation that lies on more than one piece of wall
_FEWEST_SURE = 2  # matches without which a scan takes those, too


@njit(cache=True, nogil=True, error_model="numpy")
def nearest_neighbour(
    x: Array, p: Array, offset: float, z: Array, marks: Array, gate: float, near: float, max_turn: float,
    only_sure: bool, match: NDArray[np.int64], distance: Array,
) -> None:  # fmt: skip
    """Match each observation to the nearest landmark of its kind within the gate, each landmark once.

    Parameters
    ----------
    z : Array
        ``(m, ≥ 7)`` rows: range, bearing, covariance (3 distinct terms), kind, direction in the sensor frame;
        of a LINE distance and bearing of its foot, and in columns 8 and 9 from where to where it was seen [m].
    marks : Array
        ``(n, ≥ 2)`` of each landmark: kind, direction in the belief's frame [rad]; of a LINE in columns 6 and 7
        from where to where it goes [m], and in column 5 when it was seen last.
    gate : float
        Largest squared Mahalanobis distance (chi-square with two degrees of freedom).
    near : float
        An unmatched observation this near [m] to a landmark of its kind is IGNORED, not taken for new.
    max_turn : float
        Largest difference in direction [rad]. Kind 0 matches any kind and direction.
    only_sure : bool
        Take no match where more than one landmark is within the gate (individual gating), unless they are pieces
        of wall on which the observed one lies, and little else is seen: then the one seen last.
    match, distance : NDArray
        ``(m,)`` filled: landmark index, UNMATCHED or IGNORED; squared Mahalanobis distance.
    """
    c, s = math.cos(x[2]), math.sin(x[2])
    spread = math.sqrt(p[0, 0] + p[1, 1])
    h = np.empty((2, 5))
    for k in range(z.shape[0]):
        match[k] = UNMATCHED
        distance[k] = np.inf
        bearing = x[2] + z[k, 1]
        px = x[0] + offset * c + z[k, 0] * math.cos(bearing)
        py = x[1] + offset * s + z[k, 0] * math.sin(bearing)
        window = 0.3 + 4.0 * (spread + z[k, 0] * math.sqrt(p[2, 2]))
        candidates, surface = 0, -1
        for i in range(marks.shape[0]):
            dx, dy = x[3 + 2 * i] - px, x[4 + 2 * i] - py
            if z[k, 5] != LINE and (abs(dx) > window or abs(dy) > window):
                continue
            if not _alike(z[k], marks[i], x[2], max_turn):
                continue
            if z[k, 5] == LINE:
                if not _beside(x, i, offset, z[k], marks[i], window):
                    continue
                rho, phi = line_blocks(x, i, offset, h)
            else:
                rho, phi = _point_blocks(x, i, offset, c, s, h)
            d2 = _distance(p, i, rho, phi, z[k], h)
            candidates += d2 < gate
            if d2 < gate and z[k, 5] == LINE and _beside(x, i, offset, z[k], marks[i], near):
                surface = i if surface < 0 or marks[i, 5] > marks[surface, 5] else surface
            if d2 < gate and d2 < distance[k]:
                match[k], distance[k] = i, d2
            elif match[k] == UNMATCHED and _too_near(x, i, offset, z[k], marks[i], near, dx, dy):
                match[k] = IGNORED
        if only_sure and candidates > 1:
            match[k] = _LIES_ON - surface if surface >= 0 else IGNORED
    # One straight surface that lies on two pieces of wall is most likely of both. It is left out nevertheless,
    # unless the scan shows next to nothing else, as in a corridor: that would be going blind.
    blind = np.sum(match[: z.shape[0]] >= 0) < _FEWEST_SURE
    for k in range(z.shape[0]):
        if match[k] <= _LIES_ON:
            match[k] = _LIES_ON - match[k] if blind else IGNORED
    # Two observations cannot be one point: the farther gives way. Of a wall any number of pieces may be seen.
    for k in range(z.shape[0]):
        for j in range(k):
            if match[k] >= 0 and match[k] == match[j] and z[k, 5] != LINE:
                match[k if distance[k] >= distance[j] else j] = IGNORED


_WALL_WINDOW_M = 1.0  # farther off, a piece of wall is not tested for being a known wall
_CANDIDATES = 8  # landmarks considered for one observation, the nearest first
_MOST_NODES = 4000  # the search stops there with the best set so far; it is exponential at worst


@njit(cache=True, nogil=True, error_model="numpy")
def joint_compatibility(
    x: Array, p: Array, offset: float, z: Array, marks: Array, near: float, max_turn: float,
    match: NDArray[np.int64],
) -> float:  # fmt: skip
    """Match as many observations as one pose can explain together; return their joint squared distance.

    Joint compatibility branch and bound (Neira and Tardós 2001): the innovations of all pairings at once, with
    their cross-covariances, must lie within the gate. Among the largest such sets, the nearest one. S is factored
    row by row as the search goes down, so that a pairing costs its own two rows only. The arguments are
    :func:`nearest_neighbour`'s.
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
            match[:] = chosen
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
    x: Array, p: Array, offset: float, z: Array, marks: Array, max_turn: float, candidate: NDArray[np.int64],
    distance: Array,
) -> int:  # fmt: skip
    """List the landmarks that one observation could be, nearest first; return how many."""
    h = np.zeros((2, 5))
    found = 0
    for i in range(marks.shape[0]):
        if not _alike(z, marks[i], x[2], max_turn):
            continue
        if z[5] == LINE and not _beside(x, i, offset, z, marks[i], _WALL_WINDOW_M):
            continue
        d2 = _gate(x, p, i, offset, z, h)
        if d2 < JOINT_GATES[1]:
            found = insert_nearest(i, d2, candidate, distance, found)
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def insert_nearest(i: int, d2: float, nearest: NDArray[np.int64], distance: Array, count: int) -> int:
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
    x: Array, p: Array, offset: float, z: Array, landmark: NDArray[np.int64], pairs: int, h: Array, factor: Array,
    y: Array,
) -> None:  # fmt: skip
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
    x: Array, offset: float, z: Array, marks: Array, near: float, max_turn: float, count: NDArray[np.int64],
    match: NDArray[np.int64],
) -> None:  # fmt: skip
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
            if not _alike(z[k], marks[i], x[2], max_turn):
                continue
            if _too_near(x, i, offset, z[k], marks[i], near, x[3 + 2 * i] - px, x[4 + 2 * i] - py):
                match[k] = IGNORED
