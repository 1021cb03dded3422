"""What an explorer remembers of pieces of frontier that did not work out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.settings import Config, Count, Duration, Length, NotNegative, Rate
from slam.types import Array

__all__ = ["PatienceConfig", "Trouble", "Troubles"]


@dataclass(frozen=True, kw_only=True)
class PatienceConfig(Config):
    """When to choose anew, when to give up, and for how long."""

    replan_s: Duration = 1.0
    min_replan_s: Duration = 0.3  # between two choices, whatever happens
    far_m: Length = 15.0  # to a goal farther off, where less than …
    news_m2: NotNegative = 0.1  # … has come to light since it was chosen, the robot drives on for …
    stale_s: Duration = 5.0  # … so long before it chooses anew
    settle_s: Duration = 0.2  # how long to look from a view point before it counts as looked from
    looks: Count = 1  # at one piece of frontier before it is let be
    stuck_s: Duration = 4.0  # without moving or turning: recover
    recover_s: Duration = 1.5
    lost_s: Duration = 2.0  # how long to stand still when the belief is lost, before creeping on
    avoid_s: Duration = 20.0  # how long a goal that did not work out is put last; doubled each time
    attempts: Count = 3  # at one goal that does not work out
    doubts: Count = 5  # changes of mind, after which a goal is kept until …
    progress_m2: NotNegative = 1.0  # … so much more has come to light
    detour_m: Length = 3.0  # by which a way grows that turns out to be closed; after `doubts` the goal is put off
    slowest_m_s: Rate = 0.15  # a goal gets 10 s and the time its path takes at this speed
    same_m: Length = 0.6  # frontier pieces nearer than this to one dealt with before are the same


@dataclass(slots=True)
class Trouble:
    """A piece of frontier that was looked at in vain, or could not be driven to."""

    looks: int = 0
    afar: int = 0  # of these, that were no more than its vanishing, seen from afar
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
