"""Episodes that nobody gave a seed: which one it was can be asked afterwards."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

IDS = ["mecanum_env/Explore-v0", "mecanum_env/ExploreWheels-v0"]


def make(env_id: str = IDS[0]) -> gym.Env[Any, Any]:
    return gym.make(f"mecanum_env:{env_id}", rooms="rectangular")


@pytest.mark.parametrize("early", [False, True])
@pytest.mark.parametrize("env_id", IDS)
def test_an_episode_without_a_seed_can_be_had_again(env_id: str, early: bool) -> None:
    env, other = make(env_id), make(env_id)
    asked = env.unwrapped.np_random_seed if early else None
    observation, info = env.reset()
    seed = env.unwrapped.np_random_seed
    assert asked in (None, seed)
    again, other_info = other.reset(seed=seed)
    assert all(np.array_equal(observation[key], again[key]) for key in again)
    env.action_space.seed(0)
    for _ in range(5):
        action = env.action_space.sample()
        *_, info = env.step(action)
        *_, other_info = other.step(action)
    assert np.array_equal(info["true_pose"], other_info["true_pose"])
    following, other_following = env.reset()[0], other.reset()[0]
    assert all(np.array_equal(following[key], other_following[key]) for key in following)
    assert not np.array_equal(following["scan"], observation["scan"])


def test_a_generator_of_the_callers_own_draws_the_first_episode() -> None:
    envs = [make() for _ in range(2)]
    for env in envs:
        env.unwrapped.np_random = np.random.default_rng(3)
    one, other = (env.reset()[0] for env in envs)
    assert np.array_equal(one["scan"], other["scan"])
