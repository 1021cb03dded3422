"""Step limits, each in the steps of whoever set it."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit

from mecanum_env.env import ExploreEnv

STILL = np.zeros(3, np.float32)


def bare() -> ExploreEnv:
    return ExploreEnv(rooms="rectangular", slam="odometry", config={"coverage_target": 1.0})


class _Repeat(gym.Wrapper[Any, Any, Any, Any]):
    """Does everything four times, or until it is over."""

    def step(self, action: Any) -> Any:
        for _ in range(4):
            observation, reward, terminated, truncated, info = self.env.step(action)
            if terminated or truncated:
                break
        return observation, reward, terminated, truncated, info


@pytest.mark.parametrize(
    ("outer", "inner", "shares"),
    [
        (4, None, [0.25, 0.5, 0.75, 1.0]),
        (4, 3000, [0.25, 0.5, 0.75, 1.0]),
        (10, 12, [1 / 3, 2 / 3, 1.0]),  # the least, in steps of its own, comes last
    ],
)
def test_a_limit_counts_its_own_steps(outer: int, inner: int | None, shares: list[float]) -> None:
    env = TimeLimit(_Repeat(bare() if inner is None else TimeLimit(bare(), inner)), outer)
    for seed in (0, 1):
        observation, _ = env.reset(seed=seed)
        assert observation["progress"][0] == 0.0
        for share in shares:
            observation, _, terminated, truncated, info = env.step(STILL)
            assert observation["progress"][0] == np.float32(share)
            assert ("episode_metrics" in info) == ("is_success" in info) == truncated == (share == 1.0)
            assert not terminated


def test_steps_that_no_wrapper_sees_count_too() -> None:
    env = TimeLimit(bare(), 8)
    env.reset(seed=0)
    env.step(STILL)
    twin = copy.deepcopy(env.unwrapped)
    for world in (env.unwrapped, twin):
        shares = [world.step(STILL)[0]["progress"][0] for _ in range(3)]
        assert shares == [0.25, 0.375, 0.5]
