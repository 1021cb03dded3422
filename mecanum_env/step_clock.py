"""How much of an episode's steps are used: what Gymnasium's ``TimeLimit`` counts, and tells nobody."""

from __future__ import annotations

import inspect
import math
from typing import Any

import gymnasium
from gymnasium.wrappers import TimeLimit

__all__ = ["StepClock"]


class StepClock:
    """The step limits on an episode, each in the steps of whoever set it.

    ``gym.make(…, max_episode_steps=N)`` tells nobody but a ``TimeLimit`` wrapper, yet ``progress`` and the last
    step's ``episode_metrics`` depend on it; a wrapper of our own to pass it on would rule out
    ``vector_entry_point``.

    Parameters
    ----------
    most : float
        Steps of the episode, where no wrapper limits them.
    limiters : sequence of TimeLimit
        The wrappers that do.

    Attributes
    ----------
    used : float
        Share of its steps that the episode has used; 0 where nothing limits them.
    """

    def __init__(self, most: float = math.inf, limiters: tuple[TimeLimit[Any, Any], ...] = ()) -> None:
        self._limits = [_Limit(limiter._max_episode_steps, limiter) for limiter in limiters] or [_Limit(most)]
        self.used = 0.0

    @classmethod
    def of_caller(cls, env: gymnasium.Env[Any, Any]) -> StepClock:
        """Return the clock of an episode of ``env`` that begins by this very call of its ``reset``."""
        most = env.spec.max_episode_steps if env.spec else None
        # Another environment may step this one: what limits that one's steps limits none of these.
        limiters = [caller for caller in _callers() if isinstance(caller, TimeLimit) and caller.unwrapped is env]
        return cls(most or math.inf, tuple({id(limiter): limiter for limiter in limiters}.values()))

    def tick(self) -> None:
        """Count a step."""
        self.used = max([limit.tick() for limit in self._limits])


class _Limit:
    """One of the limits."""

    def __init__(self, most: float, by: TimeLimit[Any, Any] | None = None) -> None:
        self._most, self._by = most, by
        self._steps = 0
        self._elapsed: int | None = None  # when it was asked last

    def tick(self) -> float:
        """Count a step; return the share that is used."""
        if self._by is not None:
            elapsed, before = self._by._elapsed_steps, self._elapsed
            self._elapsed = elapsed
            if elapsed == before and any(caller is self._by for caller in _callers()):
                return self._steps / self._most  # a wrapper between them takes several steps for one
        self._steps += 1
        return self._steps / self._most


def _callers() -> list[object]:
    """Return the objects whose methods are being called, the innermost first."""
    found, frame = [], inspect.currentframe()
    while frame is not None:
        found.append(frame.f_locals.get("self"))
        frame = frame.f_back
    return found
