"""Which landmark was seen: Mahalanobis gating and nearest neighbour over a joint Gaussian.

The joint covariance is passed as its upper triangle; landmark ``i`` stands at state index 3 + 2i.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from slam.geometry import wrap_scalar
from slam.types import LINE, Array, Indices

__all__ = [
    "IGNORED",
    "UNMATCHED",
    "add_expected",
    "alike",
    "beside",
    "gated_distance",
    "line_blocks",
    "nearest_neighbour",
    "own_reach",
    "predicted",
    "refuse_unlikely",
    "too_near",
]

UNMATCHED, IGNORED = -1, -2
"""An observation of something new; one too near to a landmark to be new, yet not surely that landmark."""


@njit(cache=True, nogil=True, error_model="numpy")
def _point_blocks(x: Array, i: int, offset: float, c: float, s: float, h: Array) -> tuple[float, float]:
    """Write H of landmark ``i`` ``(2, 5)``: by x, y, θ, xi, yi; return the predicted range and bearing.

    As in docs/reference/ekf.md, Observe; ``offset`` is L, ``c`` and ``s`` are the heading's cosine and sine.
    """
    dx = x[0] + offset * c - x[3 + 2 * i]
    dy = x[1] + offset * s - x[4 + 2 * i]
    rho2 = max(dx * dx + dy * dy, 1e-12)  # a landmark on the sensor itself has no bearing, but must do no harm
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

    The distance comes first, so that a line's row looks like a point's range and bearing.
    """
    alpha = x[3 + 2 * i]
    return _line_blocks(x, i, offset, math.cos(x[2]), math.sin(x[2]), math.cos(alpha), math.sin(alpha), h)


@njit(cache=True, nogil=True, error_model="numpy")
def _line_blocks(
    x: Array, i: int, offset: float, c: float, s: float, nx: float, ny: float, h: Array
) -> tuple[float, float]:  # fmt: skip
    """Do what :func:`line_blocks` does, with cosine and sine of the heading and of the line's direction."""
    alpha, r = x[3 + 2 * i], x[4 + 2 * i]
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
def gated_distance(x: Array, p: Array, i: int, offset: float, z: Array, h: Array) -> float:
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
def add_expected(s00: float, s01: float, s11: float, p: Array, i: int, h: Array) -> tuple[float, float, float]:
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
def refuse_unlikely(x: Array, p: Array, offset: float, z: Array, gate: float, match: Indices) -> None:
    """Set to IGNORED the matches, given from outside, that lie beyond a squared Mahalanobis distance."""
    h = np.empty((2, 5))
    for k in range(z.shape[0]):
        if match[k] >= 0 and gated_distance(x, p, match[k], offset, z[k], h) > gate:
            match[k] = IGNORED


@njit(cache=True, nogil=True, error_model="numpy")
def alike(z: Array, mark: Array, theta: float, max_turn: float) -> bool:
    """Tell whether an observation has a landmark's kind and direction, as far as both are known.

    Points are also told apart by what makes them: the left or the right end of a surface, or two that meet. Where
    the corner of a pier is notched, the ends of its two faces and the place where these would meet lie decimetres
    apart.
    """
    return bool(_alike(z[5], z[6] + theta, z[7], mark[0], mark[1], mark[6], max_turn))


@njit(cache=True, nogil=True, inline="always")
def _alike(
    kind: float, turn: float, end: float, of_kind: float, direction: float, of_end: float, max_turn: float
) -> bool:
    """Do what :func:`alike` does; a call that hands on rows of arrays takes 30 ns."""
    if kind == LINE or of_kind >= LINE or (kind != 0.0 and of_kind != 0.0):
        return (
            kind == of_kind and (kind == LINE or end == of_end) and abs(wrap_scalar(turn - direction)) <= max_turn
        )
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def beside(x: Array, i: int, offset: float, z: Array, mark: Array, window: float) -> bool:
    """Tell whether a piece of wall that is seen lies within a window [m] of wall ``i``, along it and across."""
    ends = _ends(x[0] + offset * math.cos(x[2]), x[1] + offset * math.sin(x[2]), x[2], z)
    return _lies_on(math.cos(x[3 + 2 * i]), math.sin(x[3 + 2 * i]), x[4 + 2 * i], ends, mark, window)


@njit(cache=True, nogil=True, error_model="numpy")
def _ends(sx: float, sy: float, theta: float, z: Array) -> tuple[float, float, float, float]:
    """Return the two ends of a piece of wall, in the belief's frame, that is seen from a sensor at a pose."""
    c, s = math.cos(theta + z[1]), math.sin(theta + z[1])
    return (
        sx + z[0] * c - z[8] * s, sy + z[0] * s + z[8] * c,
        sx + z[0] * c - z[9] * s, sy + z[0] * s + z[9] * c,
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _lies_on(
    nx: float, ny: float, r: float, ends: tuple[float, float, float, float], mark: Array, window: float
) -> bool:  # fmt: skip
    """Do what :func:`beside` does, with the two ends of a piece and a wall's normal and distance."""
    ax, ay, bx, by = ends
    if abs(nx * ax + ny * ay - r) > window or abs(nx * bx + ny * by - r) > window:
        return False
    ta, tb = nx * ay - ny * ax, nx * by - ny * bx
    return bool(max(ta, tb) > mark[6] - window and min(ta, tb) < mark[7] + window)


@njit(cache=True, nogil=True, error_model="numpy")
def too_near(x: Array, i: int, offset: float, z: Array, mark: Array, near: float, dx: float, dy: float) -> bool:
    """Tell whether what is seen lies too near to landmark ``i``, of a point ``dx`` and ``dy`` away, to be new.

    How near that is [m] has nothing to do with how well the robot knows where it is: the longer the way from the
    start, the more of the walls beside others would be taken for neither known nor new, and be of no use at all.
    """
    if z[5] == LINE:
        return beside(x, i, offset, z, mark, near)
    return bool(dx * dx + dy * dy < near * near)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def own_reach(z: Array) -> float:
    """Return how far off [m] an observation may be by itself, beyond what a window allows for.

    Features of a scan are centimetres exact, for which the window's own 0.3 m is more than enough. Of what is
    observed without a scan its covariance says how exact it is: a tree may well be seen metres off.
    """
    return 4.0 * (math.sqrt(z[2]) + z[0] * math.sqrt(z[4])) if z[5] == 0.0 else 0.0


_LIES_ON = -3  # less the wall's index: an observation that lies on more than one piece of wall
_FEWEST_SURE = 2  # matches without which a scan takes those, too


@njit(cache=True, nogil=True, error_model="numpy")
def nearest_neighbour(
    x: Array, p: Array, offset: float, z: Array, marks: Array, gate: float, near: float, max_turn: float,
    only_sure: bool, match: Indices, distance: Array,
) -> None:  # fmt: skip
    """Match each observation to the nearest landmark of its kind within the gate, each landmark once.

    Parameters
    ----------
    z : Array
        ``(m, 12)`` rows: range, bearing, covariance (3 distinct terms), kind, direction in the sensor frame, which
        end; of a LINE distance and bearing of its foot, in columns 8 and 9 from where to where it was seen [m].
    marks : Array
        ``(n, ≥ 8)`` of each landmark: kind, direction in the belief's frame [rad]; of a LINE in columns 6 and 7
        from where to where it goes [m], and in column 5 when it was seen last; of a point in column 6 which end.
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
    sx, sy = x[0] + offset * c, x[1] + offset * s
    spread = math.sqrt(p[0, 0] + p[1, 1])
    h, nx, ny = np.empty((2, 5)), 0.0, 0.0
    for k in range(z.shape[0]):
        match[k] = UNMATCHED
        distance[k] = np.inf
        bearing = x[2] + z[k, 1]
        px, py = sx + z[k, 0] * math.cos(bearing), sy + z[k, 0] * math.sin(bearing)
        kind, turn, end, of_wall = z[k, 5], z[k, 6] + x[2], z[k, 7], z[k, 5] == LINE
        ends = _ends(sx, sy, x[2], z[k]) if of_wall else (0.0, 0.0, 0.0, 0.0)
        window = 0.3 + 4.0 * (spread + z[k, 0] * math.sqrt(p[2, 2])) + own_reach(z[k])
        candidates, surface = 0, -1
        for i in range(marks.shape[0]):
            dx, dy = x[3 + 2 * i] - px, x[4 + 2 * i] - py
            if not of_wall and (abs(dx) > window or abs(dy) > window):
                continue
            if not _alike(kind, turn, end, marks[i, 0], marks[i, 1], marks[i, 6], max_turn):
                continue
            if of_wall:
                nx, ny = math.cos(x[3 + 2 * i]), math.sin(x[3 + 2 * i])
                if not _lies_on(nx, ny, x[4 + 2 * i], ends, marks[i], window):
                    continue
                rho, phi = _line_blocks(x, i, offset, c, s, nx, ny, h)
            else:
                rho, phi = _point_blocks(x, i, offset, c, s, h)
            d2 = _distance(p, i, rho, phi, z[k], h)
            candidates += d2 < gate
            if of_wall:  # as too_near has it
                close = _lies_on(nx, ny, x[4 + 2 * i], ends, marks[i], near)
            else:
                close = dx * dx + dy * dy < near * near
            if d2 < gate and of_wall and close:
                surface = i if surface < 0 or marks[i, 5] > marks[surface, 5] else surface
            if d2 < gate and d2 < distance[k]:
                match[k], distance[k] = i, d2
            elif match[k] == UNMATCHED and close:
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
