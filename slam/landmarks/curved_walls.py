"""Walls that are not straight: what a piece of one says about its landmark, the line that was seen first.

A line fitted to a piece of a curved wall is its tangent about the middle of the piece. Which piece is seen depends
on where the robot stands: the tangent turns as the robot moves, and while the view stays alike it is off by the
same. As noise of each scan that averages out; the error does not. So the curvature κ of every wall is estimated
over all its scans, from how its points bulge. What it makes of a piece is taken out; what is not known of it is
noise that lasts.

Whether a wall is curved at all is one of the unknowns: κ is zero with one probability, else normally distributed
("spike and slab", Mitchell and Beauchamp 1988). Without that the noise of κ would bend straight walls, the more
the farther from the place where they were seen first.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from slam.features.extraction import FeatureConfig
from slam.types import LINE, Array, Indices

__all__ = ["along_wall", "curvature", "curvature_model", "first_bend", "forget", "straighten"]

_INFO, _PULL, _AT = 8, 9, 10  # Σ 1/σκ² [m²]; Σ κ/σκ² [m]; where along the wall it is tangent to its line [m]
_KAPPA, _VAR_KAPPA = 10, 11  # columns of an observation row


def curvature_model(config: FeatureConfig) -> Array:
    """Return what :func:`straighten` takes of a config ``(3,)``: odds, 1/τ², share."""
    share = config.wall_curved_share
    odds = share / max(1.0 - share, 1e-12)
    return np.array([odds, config.wall_curvature_sigma**-2, config.wall_shape_share])


def first_bend(along: float, z: Array) -> tuple[float, float, float]:
    """Return a new landmark's marks of curvature; a wall is tangent to its line where ``z`` ``(12,)`` shows it.

    ``along`` is where the sensor stands along the wall [m].
    """
    if z[5] != LINE:
        return 0.0, 0.0, 0.0
    info = 1.0 / float(z[_VAR_KAPPA])
    return info, info * float(z[_KAPPA]), along + float(z[3] / z[4])


@njit(cache=True, nogil=True, error_model="numpy")
def along_wall(sensor_x: float, sensor_y: float, alpha: float) -> float:
    """Return where the sensor stands along a wall of normal ``alpha`` [rad], from the wall's foot [m]."""
    return math.cos(alpha) * sensor_y - math.sin(alpha) * sensor_x


@njit(cache=True, nogil=True, error_model="numpy")
def curvature(info: float, pull: float, model: Array) -> tuple[float, float, float]:
    """Return mean and variance of a wall's curvature [1/m, 1/m²], and the square to reckon its shape with [1/m²].

    Of measurements κ_k with variances σ_k²: ``info`` = Σ 1/σ_k², ``pull`` = Σ κ_k/σ_k². The prior is N(0, τ²) by
    ``model``'s odds, else zero. The square is the curved wall's alone, times the probability that it is one.
    """
    var = 1.0 / (info + model[1])
    mean = pull * var
    # How much better the measurements fit a curved wall: √(var/τ²) exp(mean²/2 var).
    odds = model[0] * math.sqrt(model[1] * var) * math.exp(min(0.5 * pull * mean, 50.0))
    p = odds / (1.0 + odds)
    square = p * mean * mean
    return p * mean, p * var + (1.0 - p) * square, square


@njit(cache=True, nogil=True, error_model="numpy")
def straighten(x: Array, offset: float, z: Array, match: Indices, marks: Array, model: Array) -> None:
    """Turn matched pieces of curved walls, in place, into the lines that their landmarks would show.

    Counts their curvature first. With Δ from where the wall is tangent to its line to the middle of the piece, t
    that middle from the sensor's foot and l the piece's length, its slope is κΔ and its offset κΔ²/2:

        φ ← φ + κΔ,  d ← d cos κΔ + t sin κΔ − κΔ²/2

    The slope's variance grows by σκ² Δ² + κ² q² (l² + Δ²): along the wall κ changes by a share q. The offset's
    grows by as much times l²/12 + Δ²/4. That κΔ changes with the pose, too, is left out of the Jacobian: a pose is
    known to centimetres, and κ is 0.1/m.

    Parameters
    ----------
    x
        The state: pose, then landmarks; ``offset`` [m] the sensor ahead of the robot's centre.
    z, match
        Observation rows ``(m, 12)`` and their landmarks ``(m,)``, negative for none.
    marks
        Of all landmarks ``(n, 14)``: :class:`slam.landmarks.book.LandmarkBook`.
    model
        :func:`curvature_model`.
    """
    sensor_x, sensor_y = x[0] + offset * math.cos(x[2]), x[1] + offset * math.sin(x[2])
    for k in range(z.shape[0]):
        row = z[k]
        if match[k] < 0 or row[5] != LINE:
            continue
        mark = marks[match[k]]
        mark[_INFO] += 1.0 / row[_VAR_KAPPA]
        mark[_PULL] += row[_KAPPA] / row[_VAR_KAPPA]
        kappa, var, square = curvature(mark[_INFO], mark[_PULL], model)
        middle = row[3] / row[4]  # where offset and slope are uncorrelated
        alpha = x[3 + 2 * match[k]]
        lean = x[2] + row[1] - alpha  # of the piece against its landmark's line
        along = row[0] * math.sin(lean) + middle * math.cos(lean)
        beyond = along_wall(sensor_x, sensor_y, alpha) + along - mark[_AT]
        turn = kappa * beyond
        row[0] = row[0] * math.cos(turn) + middle * math.sin(turn) - 0.5 * turn * beyond
        row[1] += turn
        length2, beyond2 = (row[9] - row[8]) ** 2, beyond * beyond
        slope = var * beyond2 + square * model[2] ** 2 * (length2 + beyond2)
        row[2] += slope * (length2 / 12.0 + beyond2 / 4.0 + middle * middle)
        row[3] += slope * middle
        row[4] += slope


@njit(cache=True, nogil=True, error_model="numpy")
def forget(z: Array, match: Indices, marks: Array) -> None:
    """Take back what :func:`straighten` has counted of a match that did not stand; ``z`` as before it."""
    for k in range(z.shape[0]):
        if match[k] >= 0 and z[k, 5] == LINE:
            marks[match[k], _INFO] -= 1.0 / z[k, _VAR_KAPPA]
            marks[match[k], _PULL] -= z[k, _KAPPA] / z[k, _VAR_KAPPA]
