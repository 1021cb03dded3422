"""What an explorer remembers of pieces of frontier that did not work out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.types import Array

__all__ = ["Trouble", "Troubles"]


@dataclass(slots=True)
class Trouble:
    """A piece of frontier that was looked at in vain, or could not be driven to."""

    looks: int = 0
    failures: int = 0
    avoid_until_s: float = 0.0


class Troubles:
    """Troubles by place; what lies within ``reach_m`` of one is the same.

    Parameters
    ----------
    reach_m : float
        Largest distance [m] at which a piece of frontier is taken for one dealt with before.
    """

    def __init__(self, reach_m: float) -> None:
        self._reach_m = reach_m
        self.clear()

    def clear(self) -> None:
        """Forget them all."""
        self._all: list[Trouble] = []
        self._points = np.zeros((0, 2))

    def near(self, points: Array) -> list[Trouble | None]:
        """Return, for each of the points ``(m, 2)`` [m], the trouble nearest to it and within reach, if any."""
        points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        if not self._all:
            return [None] * len(points)
        away = np.hypot(*(points[:, None] - self._points).transpose(2, 0, 1))
        nearest = np.argmin(away, axis=1)
        close = away[np.arange(len(points)), nearest] <= self._reach_m
        return [self._all[i] if c else None for i, c in zip(nearest.tolist(), close.tolist(), strict=True)]

    def note(self, point: Array) -> Trouble:
        """Return the trouble at a point ``(2,)`` [m], a new one where there is none."""
        found = self.near(point)[0]
        if found is None:
            found = Trouble()
            self._all.append(found)
            self._points = np.vstack([self._points, point])
        return found
