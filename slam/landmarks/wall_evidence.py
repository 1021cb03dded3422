"""What their own sightings say of walls: that one of them is none, and that the errors of all last.

**A wall that is none**: two surfaces were taken for one, or one bends more than allowed for. It passes its gate
scan after scan, and turns the robot a little each time. What it does not have is the NIS of a true wall, half of
which is 1 in the mean (0.8 to 0.9 on drives: covariances allow for more than noise). A cumulative sum (Page,
Biometrika 1954) tells of a mean that is larger:

    s ← max(0, s + ½ min(NIS, 20) − 1.6)

From ``LandmarkPolicy.contradicted_after`` on it is no landmark any more: what it is made of becomes new ones.

**Errors that last.** The innovations of a filter that knows its noise are white (Mehra, IEEE Transactions on
Automatic Control 15, 1970). Where walls are not quite straight (facets, the stairs of a coarse plan, rock), what a
line leaves out of them is the same in many scans. As noise of each scan it averages out, the error does not. NIS
sees nothing of it. So each wall's innovation of direction, in units of its σ, is held against the mean of those
before, and the products of all walls are averaged. What is surely above zero is the share of a wall's noise that
lasts, and the noise of all walls is taken for so much larger.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from slam.geometry import wrap_scalar
from slam.landmarks.association import add_expected, predicted
from slam.types import LINE, Array, Indices

__all__ = ["DOUBT", "lasting_factor", "take_back", "take_evidence"]

DOUBT, _MEAN = 11, 13  # columns of a landmark's marks: the sum; the mean of its last innovations of direction
_LAST_SEEN = 5
_ALLOWED = 1.6  # half a NIS, in the mean
_MOST = 10.0  # half a NIS, of one sighting: a single one says little
_SHARE = 0.25  # of the newest innovation in the mean of a wall's
_GAP = 8.0  # scans without a sighting after which that begins anew
_CLIP = 3.0  # σ of an innovation that count at most: what was taken for another wall is no noise
_SCATTER = math.sqrt(_SHARE / (2.0 - _SHARE))  # of one product, where innovations are white
_SURE = 3.0  # σ that the average of all products must be above zero
# How often what lasts counts: what it adds to a wall's noise is the same in some dozen scans, twice the sum of its
# autocorrelations. With it the mean of 16 sightings at the true pose has the variance that it should.
_TIMES = 25.0


@njit(cache=True, nogil=True, error_model="numpy")
def lasting_factor(products: Array) -> float:
    """Return by how much walls' noise is larger than that of single scans; ``products``: their sum and number."""
    count = max(products[1], 1.0)
    lasts = products[0] / count - _SURE * _SCATTER / math.sqrt(count)
    return float(1.0 + _TIMES * max(lasts, 0.0))


@njit(cache=True, nogil=True, error_model="numpy")
def take_evidence(
    x: Array, p: Array, offset: float, z: Array, match: Indices, marks: Array, now: int, products: Array
) -> Array:
    """Count what the walls that are seen say, and enlarge their noise in ``z`` by what lasts of it.

    Returns what :func:`take_back` needs.

    Parameters
    ----------
    x, p, offset, z, match
        As in :func:`slam.landmarks.association.nearest_neighbour`, before the correction.
    marks, now
        Of all landmarks ``(n, 14)``, and the number of updates: :class:`slam.landmarks.book.LandmarkBook`.
    products
        The sum of all products so far, and how many they are.
    """
    before = np.empty((marks.shape[0] + 1, 2))
    before[:-1, 0], before[:-1, 1], before[-1] = marks[:, DOUBT], marks[:, _MEAN], products
    h, factor, counted = np.empty((2, 5)), lasting_factor(products), np.zeros(marks.shape[0], np.bool_)
    for k in range(z.shape[0]):
        if match[k] < 0 or z[k, 5] != LINE:
            continue
        row, mark = z[k], marks[match[k]]
        rho, bearing = predicted(x, match[k], row[5], offset, h)
        s00, s01, s11 = add_expected(row[2], row[3], row[4], p, match[k], h)
        off, turned = row[0] - rho, wrap_scalar(row[1] - bearing)
        nis = (s11 * off * off - 2.0 * s01 * off * turned + s00 * turned * turned) / (s00 * s11 - s01 * s01)
        mark[DOUBT] = max(mark[DOUBT] + min(0.5 * nis, _MOST) - _ALLOWED, 0.0)
        row[2:5] *= factor
        if counted[match[k]]:
            continue  # another piece of the same wall, with the same error of the pose
        counted[match[k]] = True
        innovation = min(max(turned / math.sqrt(s11), -_CLIP), _CLIP)
        if now - mark[_LAST_SEEN] > _GAP:
            mark[_MEAN] = 0.0
        else:
            products[0] += innovation * mark[_MEAN]
            products[1] += 1.0
        mark[_MEAN] += _SHARE * (innovation - mark[_MEAN])
    return before


@njit(cache=True, nogil=True, error_model="numpy")
def take_back(before: Array, marks: Array, products: Array) -> None:
    """Forget the evidence of a match that did not stand; its observations are the caller's to restore."""
    marks[:, DOUBT], marks[:, _MEAN], products[:] = before[:-1, 0], before[:-1, 1], before[-1]
