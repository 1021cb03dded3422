from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit, TransformAction

pytest.importorskip("stable_baselines3")

from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from mecanum_env.env import ExploreEnv
from tests.mecanum_env.vector.test_wrapped import three
from training.learning.vec_env import ExploreVecEnv

ID = "mecanum_env:mecanum_env/Explore-v0"
SETTINGS: dict[str, Any] = {"rooms": "rectangular", "slam": "ekf", "max_episode_steps": 8}


def test_every_bit_is_that_of_stable_baselines_own() -> None:
    ours, theirs = (
        ExploreVecEnv(3, seed=5, workers=2, **SETTINGS),
        make_vec_env(ID, 3, seed=5, env_kwargs=SETTINGS),
    )
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    got, want = ours.reset(), theirs.reset()
    assert isinstance(got, dict) and isinstance(want, dict)
    assert got.keys() == want.keys() and all(np.array_equal(got[key], want[key]) for key in want)
    rng, ended = np.random.default_rng(0), 0
    for _ in range(20):
        actions = rng.uniform(-1, 1, (3, 3)).astype(np.float32)
        (got, rewards, done, infos), (want, their_rewards, their_done, their_infos) = (
            ours.step(actions), theirs.step(actions),
        )  # fmt: skip
        assert isinstance(got, dict) and isinstance(want, dict)
        assert all(np.array_equal(got[key], want[key]) for key in want)
        np.testing.assert_array_equal(rewards, their_rewards)
        np.testing.assert_array_equal(done, their_done)
        for info, other in zip(infos, their_infos, strict=True):
            other.pop("episode", None)  # of the Monitor that make_vec_env puts around each
            assert info.keys() == other.keys()
            assert info["TimeLimit.truncated"] == other["TimeLimit.truncated"]
            assert info["coverage"] == other["coverage"] and info["reward_terms"] == other["reward_terms"]
            assert type(info["true_pose"]) is type(other["true_pose"])
            assert np.array_equal(info["true_pose"], other["true_pose"])
            if "terminal_observation" in other:
                ended += 1
                last, their_last = info["terminal_observation"], other["terminal_observation"]
                assert all(np.array_equal(last[key], their_last[key]) for key in their_last)
                assert info["episode_metrics"] == other["episode_metrics"]
        for info, other in zip(ours.reset_infos, theirs.reset_infos, strict=True):
            assert info.keys() == other.keys() and info["coverage"] == other["coverage"]
    assert ended >= 6
    ours.close()
    theirs.close()


def test_what_one_episode_did_not_reach_is_none_beside_one_that_did() -> None:
    settings: dict[str, Any] = {"slam": "ekf", "max_episode_steps": 80, "config": {"coverage_target": 1.0}}
    ours = ExploreVecEnv(2, seed=10, workers=1, **settings)
    ours.reset()
    for _ in range(80):
        *_, infos = ours.step(np.tile(np.array([0.6, 0.0, 0.6], np.float32), (2, 1)))
    ours.close()
    reached, not_reached = (info["episode_metrics"]["time_to_50_s"] for info in infos)
    assert reached > 0.0 and not_reached is None


def _turned() -> gymnasium.Env[Any, Any]:
    env = ExploreEnv(rooms="rectangular", slam="ekf")
    return TransformAction(TimeLimit(env, 8), lambda action: action[::-1], env.action_space)


def test_worlds_of_ones_own_are_those_of_stable_baselines_dummy() -> None:
    ours, theirs = ExploreVecEnv(3, make=_turned, workers=2, max_episode_steps=None), DummyVecEnv([_turned] * 3)
    for envs in (ours, theirs):
        envs.seed(5)
        envs.reset()
    rng = np.random.default_rng(0)
    for _ in range(12):
        actions = rng.uniform(-1, 1, (3, 3)).astype(np.float32)
        (got, rewards, *_), (want, their_rewards, *_) = ours.step(actions), theirs.step(actions)
        assert isinstance(got, dict) and isinstance(want, dict)
        assert all(np.array_equal(got[key], want[key]) for key in want)
        np.testing.assert_array_equal(rewards, their_rewards)
    for envs in (ours, theirs):
        envs.close()
    with pytest.raises(ValueError, match="leave out rooms"):
        ExploreVecEnv(3, make=_turned, rooms="maze")


def _monitored() -> gymnasium.Env[Any, Any]:
    return Monitor(three())


def test_actions_may_be_numbers_and_a_monitor_is_found() -> None:
    ours, theirs = (
        ExploreVecEnv(2, make=_monitored, workers=2, max_episode_steps=None),
        DummyVecEnv([_monitored] * 2),
    )
    for envs in (ours, theirs):
        assert envs.env_is_wrapped(Monitor) == [True, True]
        envs.seed(5)
        envs.reset()
    for actions in ([1, 2], [2, 0], [0, 1]):
        (got, *_, infos), (want, *_, their_infos) = ours.step(np.array(actions)), theirs.step(np.array(actions))
        assert isinstance(got, dict) and isinstance(want, dict)
        assert all(np.array_equal(got[key], want[key]) for key in want)
    assert [info["episode"]["l"] for info in infos] == [info["episode"]["l"] for info in their_infos] == [3, 3]
    ours.close()
    theirs.close()


def test_what_stable_baselines_asks_of_it() -> None:
    envs = ExploreVecEnv(2, workers=1, **SETTINGS)
    envs.reset()
    assert [config.rooms for config in envs.get_attr("config", [1])] == ["rectangular"]
    assert [metrics["steps"] for metrics in envs.env_method("episode_metrics", indices=[1, 0])] == [0, 0]
    assert envs.env_is_wrapped(TimeLimit) == [True, True] and envs.env_is_wrapped(Monitor, [0]) == [False]
    for mark in (3, (4, 5)):
        envs.set_attr("mark", mark)
        assert envs.get_attr("mark") == [mark, mark]
    envs.step(np.zeros((2, 3), np.float32))
    assert envs.has_attr("reset") and envs.has_attr("step") and not envs.has_attr("action_masks")
    assert callable(envs.get_attr("reset")[0]) and envs.get_attr("_elapsed_steps") == [1, 1]  # nothing was called
    with pytest.raises(ValueError, match="leave out indices"):
        envs.set_attr("mark", 3, indices=[0])
    with pytest.raises(ValueError, match="env_method is for every environment: leave out indices"):
        envs.env_method("reset", indices=[0])
    assert envs.get_attr("_elapsed_steps") == [1, 1]
    envs.set_options([{"room_seed": 1}, {"room_seed": 2}])
    with pytest.raises(ValueError, match="must be the same"):
        envs.reset()
    envs.reset()
    envs.close()


def test_observations_stay_as_they_are() -> None:
    with pytest.raises(ValueError, match="leave out copy=False"):
        ExploreVecEnv(2, copy=False, **SETTINGS)
