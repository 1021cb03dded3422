"""Smooth random driving: the baseline that any strategy must beat."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from agents.base import Agent, Goal
from slam import geometry
from slam.belief import Belief
from slam.settings import Config, Duration, Within
from slam.types import Floats

__all__ = ["RandomAgent", "RandomConfig"]


@dataclass(frozen=True, kw_only=True)
class RandomConfig(Config):
    """An Ornstein-Uhlenbeck walk of the action."""

    correlation_s: Duration = 1.5  # time in which the action forgets itself by a factor e
    spread: Annotated[float, Within("[0.001, 1000]")] = 0.5  # standard deviation of each component of the action
    preview_s: Duration = 1.0  # how far ahead the goal lies that it shows


class RandomAgent(Agent):
    """Drives at random, smoothly, and never holds a place for explored."""

    config: RandomConfig
    config_type = RandomConfig
    _action: NDArray[np.float64] = np.zeros(3)

    def reset(self, belief: Belief, seed: int = 0) -> None:
        """Start an episode with the walk that ``seed`` gives."""
        super().reset(belief, seed)
        self._action = self._rng.normal(0.0, self.config.spread, 3)
        self._status = "driving"

    def choose(self, belief: Belief) -> Goal:
        """Return the pose that the present action leads to; it draws nothing."""
        limits = (self._robot.max_speed_m_s, self._robot.max_speed_m_s, self._robot.max_turn_rate_rad_s)
        twist = np.clip(self._action, -1.0, 1.0) * limits
        times = np.linspace(0.0, self.config.preview_s, 6)
        poses = [geometry.compose(belief.pose, geometry.exp(twist * t)) for t in times]
        return Goal(pose=poses[-1], path=np.array([p[:2] for p in poses]))

    def act(self, observation: Mapping[str, Any] | None, belief: Belief) -> Floats:
        """Return the next action of the walk; neither observation nor belief has a say."""
        keep = math.exp(-self._step_s / self.config.correlation_s)
        # The exact discretisation: whatever the step, the spread of the walk stays the same.
        noise = self.config.spread * math.sqrt(1.0 - keep * keep)
        self._action = keep * self._action + self._rng.normal(0.0, noise, 3)
        self._goal = self.choose(belief)
        return np.clip(self._action, -1.0, 1.0).astype(np.float32)
