from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, VectorEnv

import mecanum_env  # noqa: F401 - registers the environments
from mecanum_env.env import ExploreEnv
from mecanum_env.rooms import FloorPlanError
from mecanum_env.vector.vector_env import ExploreVectorEnv

ID = "mecanum_env/Explore-v0"
SETTINGS: dict[str, Any] = {"rooms": "rectangular", "slam": "ekf", "max_episode_steps": 12}


def batch(count: int = 3, **more: Any) -> ExploreVectorEnv:
    made = gym.make_vec(ID, num_envs=count, vectorization_mode="vector_entry_point", **SETTINGS, **more)
    assert isinstance(made, ExploreVectorEnv)
    return made


def like(count: int = 3, mode: AutoresetMode = AutoresetMode.NEXT_STEP) -> VectorEnv[Any, Any, Any]:
    return gym.make_vec(
        ID, num_envs=count, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **SETTINGS
    )


@pytest.fixture
def envs() -> Iterator[ExploreVectorEnv]:
    made = batch(workers=2)
    yield made
    made.close()


def assert_same(got: Any, want: Any, at: str = "") -> None:
    if isinstance(want, tuple):
        assert_same(dict(enumerate(got)), dict(enumerate(want)), at)
    elif isinstance(want, dict):
        assert isinstance(got, dict) and got.keys() == want.keys(), (at, sorted(got), sorted(want))
        for key, value in want.items():
            assert_same(got[key], value, f"{at}.{key}")
    elif isinstance(want, np.ndarray) and want.dtype == object:
        assert got.dtype == object and len(got) == len(want), at
        for k, value in enumerate(want):
            assert_same(got[k], value, f"{at}[{k}]")
    elif isinstance(want, np.ndarray):
        assert got.dtype == want.dtype, (at, got.dtype, want.dtype)
        np.testing.assert_array_equal(got, want, err_msg=at)
    else:
        assert got == want, at


@pytest.mark.parametrize("context", ["fork", "forkserver", "spawn"])
def test_memory_is_shared_however_processes_are_started(context: str) -> None:
    ours, theirs = batch(2, workers=2, context=context), like(2)
    assert_same(ours.reset(seed=3), theirs.reset(seed=3))
    actions = np.full((2, 3), 0.5, np.float32)
    assert_same(ours.step(actions), theirs.step(actions))
    ours.close()
    theirs.close()


@pytest.mark.parametrize("workers", [1, 2, 3])
@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_every_bit_is_that_of_gymnasium_s_own(mode: AutoresetMode, workers: int) -> None:
    ours, theirs = batch(workers=workers, autoreset_mode=mode), like(mode=mode)
    assert ours.metadata["autoreset_mode"] is mode
    assert ours.observation_space == theirs.observation_space
    assert_same(ours.reset(seed=5), theirs.reset(seed=5))
    ours.action_space.seed(1)
    ended = 0
    for _ in range(40):
        actions = ours.action_space.sample()
        got, want = ours.step(actions), theirs.step(actions)
        assert_same(got, want)
        over = got[2] | got[3]
        ended += int(over.sum())
        if mode is AutoresetMode.DISABLED and over.any():
            mask = {"reset_mask": over}
            assert_same(ours.reset(options=dict(mask)), theirs.reset(options=dict(mask)))
    assert ended >= 6
    ours.close()
    theirs.close()


def test_an_episode_begun_ahead_changes_nothing_for_who_resets(envs: ExploreVectorEnv) -> None:
    """After the last step a worker has begun the next episode; a reset takes that, or another with options."""
    theirs = like()
    for options in (None, {"room_seed": 3}):
        envs.reset(seed=7)
        theirs.reset(seed=7)
        for _ in range(12):
            actions = np.zeros((3, 3), np.float32)
            envs.step(actions)
            theirs.step(actions)
        assert_same(envs.reset(options=options), theirs.reset(options=options))
        assert_same(envs.step(actions)[0], theirs.step(actions)[0])
    theirs.close()


def test_copies_last_and_views_do_not(envs: ExploreVectorEnv) -> None:
    first, _ = envs.reset(seed=0)
    kept = {key: value.copy() for key, value in first.items()}
    envs.step(np.full((3, 3), 0.5, np.float32))
    assert_same(first, kept)
    views = batch(copy=False, workers=1)
    first, _ = views.reset(seed=0)
    after = views.step(np.full((3, 3), 0.5, np.float32))[0]
    assert all(np.shares_memory(first[key], after[key]) for key in first)
    views.close()


def test_what_is_held_is_not_written_again() -> None:
    """However little of a step the caller keeps: one array, a view of a view, one column of the infos."""
    envs, kept = batch(workers=2), []
    observations, infos = envs.reset(seed=0)
    rng = np.random.default_rng(0)
    for k in range(24):
        held = [
            observations["scan"], observations["map_local"][1, 0][:3], infos["coverage"][1:], infos["_nees"],
            infos["true_pose"].T, infos.get("reward_terms", {}).get("area", np.zeros(0)),
            memoryview(observations["pose"]),
        ][k % 7]  # fmt: skip
        kept.append((held, np.array(held)))
        if k % 3 == 2:
            kept = kept[1:]
        observations, *_, infos = envs.step(rng.uniform(-1, 1, (3, 3)).astype(np.float32))
        for held, then in kept:
            np.testing.assert_array_equal(held, then)
    envs.close()


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_a_reset_of_some_shows_the_others_as_they_are_whatever_the_caller_has_written(mode: AutoresetMode) -> None:
    ours, theirs = batch(workers=2, autoreset_mode=mode), like(mode=mode)
    got, want = ours.reset(seed=5)[0], theirs.reset(seed=5)[0]
    for k in range(13):
        actions = np.full((3, 3), 0.3, np.float32)
        for mask in (np.arange(3) == k % 3, np.arange(3) != k % 3):
            if k in (2, 12):  # in the last, all have ended
                for value in got.values():
                    value[:] = 1
                once, again = ours.reset(options={"reset_mask": mask}), theirs.reset(options={"reset_mask": mask})
                assert_same(once, again)
                got = once[0]
        if k < 12:
            got, want = ours.step(actions)[0], theirs.step(actions)[0]
            assert_same(got, want)
    ours.close()
    theirs.close()


class _Nearsighted(ExploreEnv):
    """Shows another observation than it is asked to fill, and keeps the one before."""

    def observe(self) -> Any:
        seen = dict(super().observe())
        return seen | {"scan": np.minimum(seen["scan"], 0.5)}


def nearsighted() -> gym.Env[Any, Any]:
    return _Nearsighted(rooms="rectangular", slam="ekf", config={"time_limit_s": 1.2})


def test_an_environment_of_ones_own_shows_what_it_shows() -> None:
    ours, theirs = ExploreVectorEnv(2, make=nearsighted, workers=2), gym.vector.SyncVectorEnv([nearsighted] * 2)
    assert_same(ours.reset(seed=1), theirs.reset(seed=1))
    for _ in range(3):
        actions = np.full((2, 3), 0.5, np.float32)
        assert_same(ours.step(actions), theirs.step(actions))
    mask = {"reset_mask": np.array([True, False])}
    assert_same(ours.reset(options=dict(mask)), theirs.reset(options=dict(mask)))
    ours.close()
    theirs.close()


def test_attributes_of_each(envs: ExploreVectorEnv) -> None:
    envs.reset(seed=4)
    assert envs.np_random_seed == (4, 5, 6)
    assert [config.rooms for config in envs.get_attr("config")] == ["rectangular"] * 3
    envs.set_attr("mark", [1, 2, 3])
    assert envs.get_attr("mark") == (1, 2, 3)
    assert [metrics["steps"] for metrics in envs.call("episode_metrics")] == [0, 0, 0]
    shown, *_ = envs.step(np.full((3, 3), 0.5, np.float32))
    kept = {key: value.copy() for key, value in shown.items()}
    for _ in range(2):  # behind the back of the board
        envs.call("step", np.full(3, 0.5, np.float32))
    assert_same(shown, kept)
    with pytest.raises(ValueError, match="2 values for 3"):
        envs.set_attr("mark", [1, 2])


def test_what_one_raises_the_caller_raises_and_goes_on(envs: ExploreVectorEnv) -> None:
    envs.reset(seed=0)
    with pytest.raises(FloorPlanError, match="start"):
        envs.reset(options={"start_pose": (99.0, 99.0, 0.0)})
    with pytest.raises(ValueError, match="actions must be finite numbers"):
        envs.step(np.full((3, 3), np.nan, np.float32))
    envs.reset(seed=0)
    envs.step(np.zeros((3, 3), np.float32))


def test_an_action_that_is_refused_has_moved_nobody(envs: ExploreVectorEnv) -> None:
    theirs = like()
    assert_same(envs.reset(seed=7), theirs.reset(seed=7))
    for wrong in (np.inf, 1e300, 1j, "left", None):  # 1e300 is infinite in single precision
        bad = np.full((3, 3), 0.5, np.result_type(type(wrong)) if isinstance(wrong, float | complex) else object)
        bad[2, 1] = wrong
        with pytest.raises(ValueError, match=r"actions must be finite numbers in \[-1, 1\], got"):
            envs.step(bad)
    assert_same(envs.step(np.full((3, 3), 0.5, np.float32)), theirs.step(np.full((3, 3), 0.5, np.float32)))
    theirs.close()


def test_minus_one_is_no_step_limit_as_for_a_single_environment() -> None:
    envs = gym.make_vec(ID, num_envs=1, **SETTINGS | {"max_episode_steps": -1, "workers": 1})
    envs.reset(seed=0)
    for _ in range(3):
        observation, _, _, truncated, _ = envs.step(np.zeros((1, 3), np.float32))
    assert not truncated.any()
    assert observation["progress"][0, 0] == np.float32(3 / 3000)  # of time_limit_s
    envs.close()


def test_other_processes_warn_of_no_more_than_this_one(capfd: pytest.CaptureFixture[str]) -> None:
    envs = batch(2, workers=2, config={"rooms": "cave"})  # whose outlines underflow
    envs.call("reset", options={"room_seed": 3})
    envs.close()
    assert "Warning" not in capfd.readouterr().err


def test_bad_arguments_are_told_before_any_process_starts() -> None:
    with pytest.raises(ValueError, match="did you mean 'apartment'"):
        ExploreVectorEnv(2, rooms="apartmnt")
    with pytest.raises(ValueError, match=r"num_envs must be a whole number in \[1, 4096\], got 0"):
        ExploreVectorEnv(0)
    with pytest.raises(ValueError, match=r"workers must be a whole number in \[1, 4096\], got 0"):
        ExploreVectorEnv(2, workers=0)


def test_bad_calls(envs: ExploreVectorEnv) -> None:
    with pytest.raises(ValueError, match=r"actions must be \(3, 3\)"):
        envs.step(np.zeros((2, 3), np.float32))
    with pytest.raises(ValueError, match="2 seeds for 3"):
        envs.reset(seed=[1, 2])
    with pytest.raises(ValueError, match="reset_mask must be 3 booleans"):
        envs.reset(options={"reset_mask": np.ones(2, np.bool_)})
    with pytest.raises(ValueError, match="chooses no environment"):
        envs.reset(options={"reset_mask": np.zeros(3, np.bool_)})


def test_without_autoreset_a_step_after_the_end_is_an_error() -> None:
    envs = batch(2, workers=2, autoreset_mode="Disabled")
    envs.reset(seed=0)
    for _ in range(12):
        envs.step(np.zeros((2, 3), np.float32))
    with pytest.raises(RuntimeError, match="has ended: reset it"):
        envs.step(np.zeros((2, 3), np.float32))
    envs.close()


def test_closing_ends_the_processes_and_so_does_a_dead_one() -> None:
    envs = batch(workers=3)
    envs.reset(seed=0)
    processes = [worker.process for worker in envs._workers]
    envs.close()
    envs.close()
    assert not any(process.is_alive() for process in processes)
    with pytest.raises(gym.error.ClosedEnvironmentError):
        envs.reset(seed=0)
    envs = batch(workers=3)
    envs.reset(seed=0)
    processes = [worker.process for worker in envs._workers]
    os.kill(processes[0].pid or 0, signal.SIGKILL)
    with pytest.raises(RuntimeError, match="worker process has ended"):
        for _ in range(3):
            envs.step(np.zeros((3, 3), np.float32))
    assert not any(process.is_alive() for process in processes)


def test_where_a_process_cannot_be_started_none_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    started, start = [], multiprocessing.process.BaseProcess.start

    def once(self: multiprocessing.process.BaseProcess) -> None:
        if started:
            raise OSError("no more processes")
        start(self)
        started.append(self)

    monkeypatch.setattr(multiprocessing.process.BaseProcess, "start", once)
    with pytest.raises(OSError, match="no more processes"):
        batch(workers=3)
    assert len(started) == 1 and not started[0].is_alive()


def test_a_program_that_closes_nothing_ends() -> None:
    program = (
        "from mecanum_env.vector.vector_env import ExploreVectorEnv\n"
        "envs = ExploreVectorEnv(2, workers=2, context='fork', rooms='rectangular', slam='odometry')\n"
        "kept = [envs]; kept.append(kept); envs.reset(seed=0); print('done')"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert ended.stdout == "done\n"


def test_wheels_frames_and_spawned_processes() -> None:
    envs = gym.make_vec(
        "mecanum_env/ExploreWheels-v0", num_envs=2, vectorization_mode="vector_entry_point", rooms="rectangular",
        slam="odometry", render_mode="rgb_array", workers=2, context="spawn",
    )  # fmt: skip
    envs.reset(seed=0)
    envs.step(np.ones((2, 4), np.float32))
    frames = envs.render()
    assert frames is not None and len(frames) == 2 and frames[0].ndim == 3
    envs.close()
