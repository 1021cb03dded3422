"""Landmarks that left their gate, matched again from a pose that the others have put right (kernel).

Where wheels slip more than is allowed for, the pose that observations are matched from is off, and what is far
away leaves its gate first: in a corridor its end, and with that all that tells how far along it the robot is. The
walls beside it, still matched, put the heading right, and the end is where it was (high-innovation inliers:
Civera, Grasa, Davison and Montiel, "1-Point RANSAC for extended Kalman filtering", J. Field Robotics 27, 2010).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.landmarks.association import UNMATCHED, nearest_neighbour
from slam.landmarks.book import LAST_SEEN, RECENT
from slam.types import Array

__all__ = ["match_missed"]


@njit(cache=True, nogil=True, error_model="numpy")
def match_missed(
    x: Array, p: Array, offset: float, z: Array, marks: Array, now: int, gates: Array, match: NDArray[np.int64],
    more: NDArray[np.int64],
) -> int:  # fmt: skip
    """Match what ``match`` has not to landmarks that the last updates showed and that it has not, either.

    Parameters
    ----------
    x, p, offset, z, marks
        As in :func:`slam.landmarks.association.nearest_neighbour`, corrected by ``match``.
    now
        Number of the update.
    gates
        The gate, how near is too near, the largest turn.
    match, more
        ``(m,)`` landmark of each observation, negative for none; ``more`` is filled.

    Returns
    -------
    int
        How many there are.
    """
    distance, found = np.empty(z.shape[0]), 0
    nearest_neighbour(x, p, offset, z, marks, gates[0], gates[1], gates[2], True, more, distance)
    for k in range(z.shape[0]):
        i = more[k]
        if match[k] >= 0 or (i >= 0 and marks[i, LAST_SEEN] <= now - RECENT):
            i = UNMATCHED
        for j in range(z.shape[0]):
            if i >= 0 and match[j] == i:
                i = UNMATCHED
        more[k] = i
        found += i >= 0
    return found
