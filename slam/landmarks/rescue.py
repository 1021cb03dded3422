"""Landmarks that left their gate, matched again from a pose that the others have put right (kernel).

Where wheels slip more than is allowed for, the pose that observations are matched from is off, and what is far
away leaves its gate first: in a corridor its end, and with that all that tells how far along it the robot is. The
walls beside it, still matched, put the heading right, and the end is where it was (high-innovation inliers:
Civera, Grasa, Davison and Montiel, "1-Point RANSAC for extended Kalman filtering", J. Field Robotics 27, 2010).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from slam.landmarks.association import UNMATCHED, alike, gated_distance, nearest_neighbour
from slam.landmarks.book import LAST_SEEN, RECENT
from slam.types import Array, Indices

__all__ = ["match_missed"]


@njit(cache=True, nogil=True, error_model="numpy")
def match_missed(
    x: Array, p: Array, offset: float, z: Array, marks: Array, now: int, gates: Array, match: Indices,
    more: Indices,
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
    if not _worth_it(x, p, offset, z, marks, now, gates, match):
        more[:] = UNMATCHED
        return 0
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


@njit(cache=True, nogil=True, error_model="numpy")
def _worth_it(
    x: Array, p: Array, offset: float, z: Array, marks: Array, now: int, gates: Array, match: Indices
) -> bool:
    """Tell whether any observation without a match may be a landmark that is missed: one scan in eighty."""
    h, again = np.empty((2, 5)), np.zeros(marks.shape[0], np.bool_)
    for k in range(z.shape[0]):
        if match[k] >= 0:
            again[match[k]] = True
    for i in range(marks.shape[0]):
        if again[i] or marks[i, LAST_SEEN] <= now - RECENT:
            continue
        for k in range(z.shape[0]):
            if match[k] >= 0 or not alike(z[k], marks[i], x[2], gates[2]):
                continue
            if gated_distance(x, p, i, offset, z[k], h) < gates[0]:
                return True
    return False
