"""Walls of buildings stand at right angles: the direction of one wall says that of most others.

After some corridors and halls the heading is known to some milliradians from scan to scan, and no scan says more:
what is mapped there is turned as a whole. But of the walls of real buildings most run in two directions, within a
milliradian or two. So each wall is held, once, against one wall of the map: their directions differ by a multiple
of 90°, up to ``EkfConfig.right_angle_sigma_rad`` (Nguyen, Harati, Siegwart, "A lightweight SLAM algorithm using
orthogonal planes", IROS 2007, keep nothing but such walls; here the others stay what they are).

Which walls do is found from the map: a wall that counts is straight, long, seen often, and two thirds of the walls
whose direction against it is well known agree with it, three at least. Where walls bend or stand askew, none does.

The one wall may itself be askew by as much. Then all are, and their covariance does not know: so this is off by
default (docs/studies/buildings.md, Right angles).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from slam.landmarks.curved_walls import curvature
from slam.types import LINE, Array

__all__ = ["REFERENCE", "SQUARE", "find_square"]

SQUARE = 12  # column of a landmark's marks: 0, or 1 of a wall that was held against the reference
REFERENCE = 2.0  # … or this, of the reference itself
_SIGHTINGS = 10  # of a wall that counts; it is asked about at every so many
_LENGTH_M, _BEND_RAD = 1.0, 0.002  # at least, and at most
_KNOWN_RAD, _SURE_RAD = 0.008, 0.003  # 1σ of a direction against the reference, and against those that agree
_AGREE, _SHARE = 3, 2.0 / 3.0
_SIGMAS = 3.0  # within which others agree
_FITS = 2.0  # within which it fits the reference: a wall that is left out costs little, one that is askew much
_RIGHT = 0.5 * math.pi


@njit(cache=True, nogil=True, error_model="numpy")
def find_square(x: Array, p: Array, marks: Array, now: int, sigma: float, model: Array) -> tuple[int, int, float]:
    """Return a wall that this update showed and that stands square, the reference, and how far it is off [rad].

    The wall is marked as square; -1 where there is none. The first such wall becomes the reference.

    Parameters
    ----------
    x, p
        The state and the upper triangle of its covariance.
    marks
        Of all landmarks ``(n, 13)``: :class:`slam.landmarks.book.LandmarkBook`.
    now
        The number of updates reviewed.
    sigma
        1σ of a direction about a multiple of 90° from another's [rad].
    model
        :func:`slam.landmarks.curved_walls.curvature_model`.
    """
    reference = -1
    for k in range(marks.shape[0]):
        if marks[k, SQUARE] == REFERENCE:
            reference = k
    for k in range(marks.shape[0]):
        mark = marks[k]
        due = mark[5] == now and mark[SQUARE] == 0.0 and mark[2] % _SIGHTINGS == 0.0
        if not due or not _counts(mark, model) or not _majority(x, p, marks, k, sigma, model):
            continue
        if reference < 0:
            mark[SQUARE] = REFERENCE
            reference = k
            continue
        off, variance = _against(x, p, k, reference)
        if variance < _KNOWN_RAD**2 and off * off < _FITS**2 * (variance + sigma * sigma):
            mark[SQUARE] = 1.0
            return k, reference, off
    return -1, -1, 0.0


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
    off = x[a] - x[b]
    off -= _RIGHT * np.round(off / _RIGHT)
    return off, p[a, a] + p[b, b] - 2.0 * p[min(a, b), max(a, b)]
