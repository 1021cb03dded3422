"""Environments in wrappers of somebody's own: as from Gymnasium's own, or refused in a line."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import FlattenObservation, TimeLimit

from agents.frontier_env import ExploreFrontierEnv
from mecanum_env.env import ExploreEnv
from mecanum_env.vector.vector_env import ExploreVectorEnv
from tests.mecanum_env.vector.test_vector_env import assert_same

Make = Callable[[], gym.Env[Any, Any]]


def plain() -> gym.Env[Any, Any]:
    return TimeLimit(ExploreEnv(rooms="rectangular", slam="ekf"), 3)


class _Three(gym.ActionWrapper[Any, Any, Any]):
    """Drive ahead, aside, or turn."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.action_space = spaces.Discrete(3)

    def action(self, action: Any) -> Any:
        return np.eye(3, dtype=np.float32)[action]


def three() -> gym.Env[Any, Any]:
    return _Three(plain())


def frontier() -> gym.Env[Any, Any]:
    return ExploreFrontierEnv(rooms="rectangular", slam="odometry", config={"time_limit_s": 5.0})


class _Counted(gym.Wrapper[Any, Any, Any, Any]):
    """Shows the number of the step as well, and in the second one is paid otherwise."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        inner = env.observation_space
        assert isinstance(inner, spaces.Dict)
        self.observation_space = spaces.Dict({**inner, "count": spaces.Discrete(9)})

    def reset(self, **given: Any) -> Any:
        observation, info = self.env.reset(**given)
        self._number = 0
        return {**observation, "count": 0}, info

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._number += 1
        terms: dict[str, float] = info["reward_terms"]
        if self._number == 1:
            info["reward_terms"] = dict(reversed(terms.items()))
        elif action[0] > 0.0:
            terms["bonus"] = 1.0
        elif action[0] < 0.0:
            del terms["time"]
        return {**observation, "count": self._number}, reward, terminated, truncated, info


def counted() -> gym.Env[Any, Any]:
    return _Counted(plain())


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("make", [three, frontier])
def test_actions_may_be_numbers(make: Make, workers: int) -> None:
    ours, theirs = ExploreVectorEnv(2, make=make, workers=workers), SyncVectorEnv([make] * 2)
    assert_same(ours.reset(seed=1), theirs.reset(seed=1))
    for actions in ([1, 2], [2, 0], [0, 1]):
        assert_same(ours.step(np.array(actions)), theirs.step(np.array(actions)))
    for wrong in ([0.5, 1.0], [np.nan, 1.0], [None, 1], [10**30, 1]):
        with pytest.raises(ValueError, match="actions must be whole numbers, got"):
            ours.step(np.array(wrong))
    ours.close()
    theirs.close()


def test_a_choice_s_episode_begun_ahead_changes_nothing_for_who_resets() -> None:
    ours, theirs = ExploreVectorEnv(2, make=frontier, workers=2), SyncVectorEnv([frontier] * 2)
    for envs in (ours, theirs):
        envs.reset(seed=1)
        while not envs.step(np.zeros(2, np.int64))[3].all():
            pass
    options = {"room_seed": 3}
    assert_same(ours.reset(options=dict(options)), theirs.reset(options=dict(options)))
    ours.close()
    theirs.close()


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_observations_and_terms_of_reward_may_be_a_wrapper_s_own(mode: AutoresetMode) -> None:
    ours = ExploreVectorEnv(3, make=counted, workers=2, autoreset_mode=mode)
    theirs = SyncVectorEnv([counted] * 3, autoreset_mode=mode)
    assert_same(ours.reset(seed=1), theirs.reset(seed=1))
    actions, kept = np.outer([0.5, 0.0, -0.5], np.ones(3)).astype(np.float32), []
    for _ in range(7):
        got, want = ours.step(actions), theirs.step(actions)
        assert_same(got, want)
        kept.append((got, want))
    for got, want in kept:
        assert_same(got, want)
    ours.close()
    theirs.close()


def flat() -> gym.Env[Any, Any]:
    return FlattenObservation(plain())


class _Nested(_Three):
    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.observation_space = spaces.Dict({"all": env.observation_space})


def nested() -> gym.Env[Any, Any]:
    return _Nested(plain())


@pytest.mark.parametrize("make", [flat, nested])
def test_what_no_shared_memory_holds_is_refused_in_a_line(make: Make) -> None:
    with pytest.raises(ValueError, match=r'^make: shared memory holds a one-level Dict of .*_mode="sync"\)$'):
        ExploreVectorEnv(2, make=make)


def test_make_is_not_for_make_vec_and_the_error_says_for_what() -> None:
    with pytest.raises(ValueError, match=r"leave out action, .* call ExploreVectorEnv itself"):
        gym.make_vec("mecanum_env/Explore-v0", num_envs=2, make=plain)
