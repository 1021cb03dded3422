"""Which landmark was seen: Mahalanobis gating and nearest neighbour over a joint Gaussian.

The joint covariance is passed as its upper triangle; landmark ``i`` stands at state index 3 + 2i.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.geometry import wrap_scalar

__all__ = ["IGNORED", "UNMATCHED", "innovation_blocks", "nearest_neighbour"]

Array = NDArray[np.float64]

UNMATCHED, IGNORED = -1, -2
"""An observation of something new; one too near to a landmark to be new, yet not surely that landmark."""


@njit(cache=True, nogil=True, error_model="numpy")
def innovation_blocks(x: Array, i: int, offset: float, h: Array) -> tuple[float, float]:
    """Write H of landmark ``i`` ``(2, 5)``: by x, y, θ, xi, yi; return the predicted range and bearing.

    theory.md A, observe; ``offset`` is L.
    """
    c, s = math.cos(x[2]), math.sin(x[2])
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
def _gate(x: Array, p: Array, i: int, offset: float, z: Array, h: Array) -> float:
    """Return the squared Mahalanobis distance of an observation row from landmark ``i``."""
    rho, bearing = innovation_blocks(x, i, offset, h)
    m = 3 + 2 * i
    # S = H P Hᵀ + R over the five states that H touches, read from the upper triangle.
    s00, s01, s11 = z[2], z[3], z[4]
    for a in range(5):
        ia = a if a < 3 else m + a - 3
        for b in range(5):
            ib = b if b < 3 else m + b - 3
            v = p[ia, ib] if ia <= ib else p[ib, ia]
            s00 += h[0, a] * v * h[0, b]
            s01 += h[0, a] * v * h[1, b]
            s11 += h[1, a] * v * h[1, b]
    dr, db = z[0] - rho, wrap_scalar(z[1] - bearing)
    det = s00 * s11 - s01 * s01
    return float((s11 * dr * dr - 2.0 * s01 * dr * db + s00 * db * db) / det)


@njit(cache=True, nogil=True, error_model="numpy")
def nearest_neighbour(
    x: Array, p: Array, landmarks: int, offset: float, z: Array, marks: Array, gate: float, near: float,
    max_turn: float, match: NDArray[np.int64], distance: Array, h: Array,
) -> None:  # fmt: skip
    """Match each observation to the nearest landmark of its kind within the gate, each landmark once.

    Parameters
    ----------
    z : Array
        ``(m, ≥ 7)`` rows: range, bearing, covariance (3 distinct terms), kind, direction in the sensor frame.
    marks : Array
        ``(n, ≥ 2)`` of each landmark: kind, direction in the belief's frame [rad].
    gate : float
        Largest squared Mahalanobis distance (chi-square with two degrees of freedom).
    near : float
        An unmatched observation this near [m] to a landmark of its kind is IGNORED, not taken for new.
    max_turn : float
        Largest difference in direction [rad]. Kind 0 matches any kind and direction.
    match, distance : NDArray
        ``(m,)`` filled: landmark index, UNMATCHED or IGNORED; squared Mahalanobis distance.
    """
    c, s = math.cos(x[2]), math.sin(x[2])
    spread = math.sqrt(p[0, 0] + p[1, 1])
    for k in range(z.shape[0]):
        match[k] = UNMATCHED
        distance[k] = np.inf
        bearing = x[2] + z[k, 1]
        px = x[0] + offset * c + z[k, 0] * math.cos(bearing)
        py = x[1] + offset * s + z[k, 0] * math.sin(bearing)
        window = 0.3 + 4.0 * (spread + z[k, 0] * math.sqrt(p[2, 2]))
        for i in range(landmarks):
            dx, dy = x[3 + 2 * i] - px, x[4 + 2 * i] - py
            if abs(dx) > window or abs(dy) > window:
                continue
            if z[k, 5] != 0.0 and marks[i, 0] != 0.0 and (
                z[k, 5] != marks[i, 0] or abs(wrap_scalar(z[k, 6] + x[2] - marks[i, 1])) > max_turn
            ):  # fmt: skip
                continue
            d2 = _gate(x, p, i, offset, z[k], h)
            if d2 < gate and d2 < distance[k]:
                match[k], distance[k] = i, d2
            elif match[k] == UNMATCHED and dx * dx + dy * dy < near * near:
                match[k] = IGNORED
    # Two observations cannot be one landmark: the farther gives way.
    for k in range(z.shape[0]):
        for j in range(k):
            if match[k] >= 0 and match[k] == match[j]:
                match[k if distance[k] >= distance[j] else j] = IGNORED
