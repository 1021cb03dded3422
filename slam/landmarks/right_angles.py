"""Walls of buildings stand at right angles: the direction of one wall says that of most others.

After some corridors and halls the heading is known to some milliradians from scan to scan, and no scan says more:
what is mapped there is turned as a whole. But of the walls of real buildings most run in two directions, within a
milliradian or two. So the building's direction is a state of the filter, beside the map
(:class:`slam.gaussian.companions.Companions`), and each wall is held against it once. It differs by a multiple of
90°, up to an error of its own of ``EkfConfig.right_angle_sigma_rad``, and the first is what the direction is known
from (Nguyen, Harati, Siegwart, "A lightweight SLAM algorithm using orthogonal planes", IROS 2007, keep nothing but
such walls; here the others stay what they are).

Which walls do is found from the map: a wall that counts is straight, long, seen often, and two thirds of the walls
whose direction against it is well known agree with it, three at least. Where walls bend or stand askew, none does.

In a hall one or two walls are all there is for a minute. So a very long one counts alone where nothing else tells:
it errs by three times as much, and is the building's direction only until most walls of some place do not bear it
out. It is held once more as one of most, which makes little of a ninth; what it has corrected stays.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from slam.landmarks.curved_walls import curvature
from slam.types import LINE, Array

__all__ = ["HELD", "HELD_ALONE", "SQUARE", "find_square"]

SQUARE = 12  # column of a landmark's marks: 0, or of a wall that was held against the building's direction
HELD_ALONE, HELD = 1.0, 2.0  # … as a very long one alone, or as one of most
_SIGHTINGS = 10  # of a wall that counts; it is asked about at every so many
_LENGTH_M, _BEND_RAD = 1.0, 0.002  # at least, and at most
_KNOWN_RAD, _SURE_RAD = 0.03, 0.003  # 1σ of a wall against the building's direction, and against those that agree
_ALONE_M, _ALONE = 8.0, 3.0  # a wall counts alone that is as long, its error so many times as large, …
_LOST = 3.0  # … and its direction known so many times worse than that
_AGREE, _SHARE = 3, 2.0 / 3.0
_SIGMAS = 3.0  # within which others agree
_FITS = 2.0  # within which it fits the direction: a wall that is left out costs little, one that is askew much
_RIGHT = 0.5 * math.pi


@njit(cache=True, nogil=True, error_model="numpy")
def find_square(
    x: Array, p: Array, marks: Array, now: int, sigma: float, model: Array, direction: float, variance: float,
    cross: Array, sure: bool,
) -> tuple[int, float, float, bool]:  # fmt: skip
    """Return a wall that this update showed and that tells of the building's direction; -1 where there is none.

    The wall is marked. Besides, how far it is off the direction, the 1σ of that [rad], and whether the direction
    is to be taken from it instead: as it is not known yet, or from a wall alone, which this one does not bear out.

    Parameters
    ----------
    x, p
        The state and the upper triangle of its covariance.
    marks
        Of all landmarks ``(n, 14)``: :class:`slam.landmarks.book.LandmarkBook`.
    now
        The number of updates reviewed.
    sigma
        1σ of a wall about a multiple of 90° from the building's direction [rad].
    model
        :func:`slam.landmarks.curved_walls.curvature_model`.
    direction, variance, cross
        The building's direction [rad], its variance, 0 if not known, and its covariance ``(≥ n,)`` with ``x``.
    sure
        Whether most walls of some place told of it.
    """
    for k in range(marks.shape[0]):
        mark, a = marks[k], 3 + 2 * k
        due = mark[5] == now and mark[SQUARE] != HELD and mark[2] % _SIGHTINGS == 0.0
        if not due or not _counts(mark, model):
            continue
        most = _majority(x, p, marks, k, sigma, model)
        if not most and (mark[SQUARE] == HELD_ALONE or mark[7] - mark[6] < _ALONE_M):
            continue
        own = sigma if most else _ALONE * sigma
        off, of_both = _from_square(x[a] - direction), p[a, a] + variance - 2.0 * cross[a]
        fits = of_both < _KNOWN_RAD**2 and off * off < _FITS**2 * (of_both + own * own)
        first = variance == 0.0 or (most and not sure and not fits)
        if first or (fits and (most or of_both > (_LOST * own) ** 2)):
            mark[SQUARE] = HELD if most else HELD_ALONE
            return k, off, own, first
    return -1, 0.0, 0.0, False


@njit(cache=True, nogil=True, error_model="numpy")
def _counts(mark: Array, model: Array) -> bool:
    """Tell whether a landmark is a wall that is straight, long, and was seen often."""
    length = mark[7] - mark[6]
    if mark[0] != LINE or mark[2] < _SIGHTINGS or length < _LENGTH_M:
        return False
    kappa, _, _ = curvature(mark[8], mark[9], model)
    return bool(abs(kappa) * length < _BEND_RAD)


@njit(cache=True, nogil=True, error_model="numpy")
def _majority(x: Array, p: Array, marks: Array, k: int, sigma: float, model: Array) -> bool:
    """Tell whether most of the walls whose direction against this one is well known stand square to it."""
    agree = others = 0
    for j in range(marks.shape[0]):
        if j == k or not _counts(marks[j], model):
            continue
        off, variance = _against(x, p, j, k)
        if variance < _SURE_RAD**2:
            others += 1
            agree += off * off < _SIGMAS**2 * (variance + 2.0 * sigma * sigma)
    return agree >= _AGREE and agree >= _SHARE * others


@njit(cache=True, nogil=True, error_model="numpy")
def _against(x: Array, p: Array, k: int, j: int) -> tuple[float, float]:
    """Return how far wall k's direction is off a multiple of 90° from wall j's [rad], and its variance."""
    a, b = 3 + 2 * k, 3 + 2 * j
    return _from_square(x[a] - x[b]), p[a, a] + p[b, b] - 2.0 * p[min(a, b), max(a, b)]


@njit(cache=True, nogil=True, error_model="numpy")
def _from_square(angle: float) -> float:
    """Return what an angle is beyond the nearest multiple of 90° [rad]."""
    return float(angle - _RIGHT * np.round(angle / _RIGHT))
