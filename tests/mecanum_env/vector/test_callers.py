"""What callers and their environments may do: nothing hangs, and nothing is shown that is not so."""

from __future__ import annotations

import os
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from mecanum_env.env import ExploreEnv
from mecanum_env.vector.vector_env import ExploreVectorEnv
from tests.mecanum_env.vector.test_vector_env import assert_same, nearsighted


@pytest.mark.parametrize("workers", [1, 2])
def test_a_wrapper_may_keep_the_action_that_it_was_given(workers: int) -> None:
    ours, theirs = ExploreVectorEnv(2, make=_delayed, workers=workers), gym.vector.SyncVectorEnv([_delayed] * 2)
    assert_same(ours.reset(seed=1), theirs.reset(seed=1))
    ours.action_space.seed(2)
    for _ in range(4):
        actions = ours.action_space.sample()
        assert_same(ours.step(actions), theirs.step(actions))
    ours.close()
    theirs.close()


class _Delayed(gym.ActionWrapper[Any, Any, Any]):
    """What is asked for is done a step later."""

    _before = np.zeros(3, np.float32)

    def action(self, action: Any) -> Any:
        before, self._before = self._before, action
        return before


def _delayed() -> gym.Env[Any, Any]:
    return _Delayed(nearsighted())


class _Numbered(ExploreEnv):
    """Begins where its ``room`` says, and cannot begin in the ninth; does as told."""

    room = 1

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        if self.room == 9:
            raise ValueError("no ninth room")
        return super().reset(seed=seed, options={"room_seed": self.room})

    def take_room(self, room: int) -> None:
        self.room = room


def _numbered() -> gym.Env[Any, Any]:
    return gym.wrappers.TimeLimit(_Numbered(rooms="rectangular", slam="ekf"), 3)


@pytest.mark.parametrize("by_call", [True, False])
def test_what_is_set_after_an_end_holds_for_the_episode_begun_ahead(by_call: bool) -> None:
    ours, theirs = ExploreVectorEnv(2, make=_numbered, workers=2), gym.vector.SyncVectorEnv([_numbered] * 2)
    for envs in (ours, theirs):
        envs.reset(seed=1)
        for _ in range(3):
            envs.step(np.zeros((2, 3), np.float32))
        if by_call:
            envs.call("take_room", 5)
        else:
            envs.set_attr("room", 5)
    for _ in range(2):
        actions = np.full((2, 3), 0.5, np.float32)
        assert_same(ours.step(actions), theirs.step(actions))
    ours.close()
    theirs.close()


def test_an_episode_that_cannot_begin_says_so_where_it_is_asked_for() -> None:
    envs = ExploreVectorEnv(2, make=_numbered, workers=2)
    envs.reset(seed=1)
    envs.step(np.zeros((2, 3), np.float32))
    envs.set_attr("room", [1, 9])
    for _ in range(2):
        envs.step(np.zeros((2, 3), np.float32))
    with pytest.raises(ValueError, match="no ninth room"):
        envs.step(np.zeros((2, 3), np.float32))
    envs.set_attr("room", 2)
    envs.reset(seed=1)
    envs.close()


class _Unsendable(Exception):
    def __init__(self, one: str, other: str) -> None:
        super().__init__(one + other)


class _Odd(ExploreEnv):
    def lambda_(self) -> Any:
        return lambda: None

    def fail(self) -> None:
        raise _Unsendable("a", "b")


def _odd() -> gym.Env[Any, Any]:
    return _Odd(rooms="rectangular", slam="ekf")


def test_what_cannot_be_sent_is_an_error_and_nothing_hangs() -> None:
    envs = ExploreVectorEnv(3, make=_odd, workers=3)
    envs.reset(seed=0)
    assert [len(belief.pose) for belief in envs.get_attr("belief")] == [3, 3, 3]
    with pytest.raises(Exception, match="pickle"):
        envs.set_attr("hook", [1, 2, lambda: 1])
    with pytest.raises(RuntimeError, match="in a worker process, where it cannot be sent from"):
        envs.call("lambda_")
    with pytest.raises(_Unsendable):  # the caller's own
        envs.call("fail")
    envs.step(np.zeros((3, 3), np.float32))
    envs.close()


class _Interrupted(ExploreEnv):
    def step(self, action: Any) -> Any:
        if os.getpid() == int(os.environ["CALLER"]) and action[0] > 0.9:
            raise KeyboardInterrupt
        return super().step(action)


def _interrupted() -> gym.Env[Any, Any]:
    return _Interrupted(rooms="rectangular", slam="ekf")


def test_ctrl_c_in_the_middle_of_a_step_closes_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of them have stepped: whoever went on with them would be shown the steps of before."""
    monkeypatch.setenv("CALLER", str(os.getpid()))
    envs = ExploreVectorEnv(2, make=_interrupted, workers=2)
    envs.reset(seed=0)
    processes = [worker.process for worker in envs._workers]
    with pytest.raises(KeyboardInterrupt):
        envs.step(np.ones((2, 3), np.float32))
    assert not any(process.is_alive() for process in processes)
    with pytest.raises(gym.error.ClosedEnvironmentError, match="make them anew"):
        envs.step(np.zeros((2, 3), np.float32))
