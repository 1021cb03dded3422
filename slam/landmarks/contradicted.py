"""Walls that their own sightings contradict: two surfaces were taken for one, or one bends more than allowed for.

Such a wall passes its gate scan after scan, and turns the robot a little each time. What it does not have is the
NIS of a true wall, half of which is 1 in the mean (0.8 to 0.9 on drives: covariances allow for more than noise). A
cumulative sum (Page, Biometrika 1954) tells of a mean that is larger:

    s ← max(0, s + ½ min(NIS, 20) − 1.6)

From ``LandmarkPolicy.contradicted_after`` on it is no landmark any more: what it is made of becomes new ones.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.landmarks.association import gated_distance
from slam.types import LINE, Array

__all__ = ["DOUBT", "doubt"]

DOUBT = 11  # column of a landmark's marks: the sum
_ALLOWED = 1.6  # half a NIS, in the mean
_MOST = 10.0  # half a NIS, of one sighting: a single one says little


@njit(cache=True, nogil=True, error_model="numpy")
def doubt(x: Array, p: Array, offset: float, z: Array, match: NDArray[np.int64], marks: Array) -> Array:
    """Take the NIS of each wall that is seen to its sum; return all sums ``(n,)`` as they were before.

    Parameters
    ----------
    x, p, offset, z, match
        As in :func:`slam.landmarks.association.nearest_neighbour`, before the correction.
    marks
        Of all landmarks ``(n, 13)``: :class:`slam.landmarks.book.LandmarkBook`.
    """
    h, before = np.empty((2, 5)), marks[:, DOUBT].copy()
    for k in range(z.shape[0]):
        if match[k] >= 0 and z[k, 5] == LINE:
            half = min(0.5 * gated_distance(x, p, match[k], offset, z[k], h), _MOST)
            marks[match[k], DOUBT] = max(marks[match[k], DOUBT] + half - _ALLOWED, 0.0)
    return before
