"""Advantages where steps take unequal time: γ to the power of what each took (Sutton, Precup and Singh, 1999)."""

from __future__ import annotations

from typing import Any

import numpy as np
from sb3_contrib.common.maskable.buffers import MaskableDictRolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from torch import Tensor, no_grad

__all__ = ["Durations", "SemiMarkovBuffer"]


class SemiMarkovBuffer(MaskableDictRolloutBuffer):
    """A rollout buffer that discounts by ``gamma`` per second, not per step.

    ``durations`` ``(steps, environments)`` are set before each :meth:`add` by :class:`Durations`. λ is per step.
    """

    def reset(self) -> None:
        """Forget the rollout."""
        self.durations = np.ones((self.buffer_size, self.n_envs), dtype=np.float32)
        super().reset()

    def compute_returns_and_advantage(self, last_values: Tensor, dones: np.ndarray[Any, Any]) -> None:
        """Return nothing; set ``advantages`` and ``returns`` (GAE, with γ^duration for γ)."""
        next_values = last_values.clone().cpu().numpy().flatten()
        goes_on = 1.0 - dones.astype(np.float32)
        advantage = np.zeros(self.n_envs, dtype=np.float32)
        for step in reversed(range(self.buffer_size)):
            gamma = self.gamma ** self.durations[step] * goes_on
            delta = self.rewards[step] + gamma * next_values - self.values[step]
            advantage = delta + gamma * self.gae_lambda * advantage
            self.advantages[step] = advantage
            next_values, goes_on = self.values[step], 1.0 - self.episode_starts[step]
        self.returns = self.advantages + self.values


class Durations(BaseCallback):
    """Tells the buffer how many seconds each step took.

    sb3-contrib adds γ V of the last observation to the reward of a step after which an episode is broken off; what
    γ to the power of its duration differs from that is added here.
    """

    def _on_step(self) -> bool:
        infos, rewards = self.locals["infos"], self.locals["rewards"]
        model: Any = self.model
        buffer, policy = model.rollout_buffer, model.policy
        buffer.durations[buffer.pos] = [info["duration_s"] for info in infos]
        for k in np.flatnonzero(self.locals["dones"]).tolist():
            info, gamma = infos[k], buffer.gamma
            if info.get("TimeLimit.truncated", False) and info.get("terminal_observation") is not None:
                seen, _ = policy.obs_to_tensor(info["terminal_observation"])
                with no_grad():
                    value = float(policy.predict_values(seen)[0])
                rewards[k] += (gamma ** info["duration_s"] - gamma) * value
        return True
