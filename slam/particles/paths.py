"""Where particles have been: paths that share their beginnings, as their maps do."""

from __future__ import annotations

import numpy as np
from numba import njit

from slam.types import Array, Indices

__all__ = ["Paths"]


class Paths:
    """The poses of every particle at every update, those of common ancestors kept once."""

    def __init__(self, particles: int) -> None:
        self._poses = np.zeros((4 * particles, 3))
        self._before = np.zeros(4 * particles, np.int64)
        self._last = np.full(particles, -1, np.int64)  # each particle's newest pose
        self._count = 0

    def append(self, poses: Array) -> None:
        """Go on with every particle at its pose ``(particles, 3)``."""
        n = len(self._last)
        if self._count + n > len(self._poses):
            self._count = compact(self._poses, self._before, self._last, self._count)
            if 2 * self._count > len(self._poses):
                self._poses = np.vstack([self._poses, np.zeros_like(self._poses)])
                self._before = np.append(self._before, np.zeros_like(self._before))
        new = np.arange(self._count, self._count + n)
        self._poses[new], self._before[new] = poses, self._last
        self._last = new
        self._count += n

    def resample(self, ancestors: Indices) -> None:
        """Let particle i have the path of particle ``ancestors[i]``."""
        self._last = self._last[ancestors]

    def of(self, particle: int) -> Array:
        """Return a particle's path ``(updates, 3)``, oldest first."""
        rows, row = [], int(self._last[particle])
        while row >= 0:
            rows.append(row)
            row = int(self._before[row])
        return self._poses[rows[::-1]].copy()


@njit(cache=True, nogil=True, error_model="numpy")
def compact(poses: Array, before: Indices, last: Indices, count: int) -> int:
    """Move the poses that some particle descends from together; return how many there are."""
    place = np.full(count, -1, np.int64)
    for k in range(last.shape[0]):
        row = last[k]
        while row >= 0 and place[row] < 0:
            place[row] = 0
            row = before[row]
    kept = 0
    for row in range(count):
        if place[row] == 0:
            place[row] = kept
            poses[kept] = poses[row]
            before[kept] = place[before[row]] if before[row] >= 0 else -1  # an older one: already moved
            kept += 1
    for k in range(last.shape[0]):
        if last[k] >= 0:
            last[k] = place[last[k]]
    return kept
