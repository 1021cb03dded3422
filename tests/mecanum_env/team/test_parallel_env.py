"""PettingZoo's side of a team."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium
import numpy as np
import pytest
import supersuit
from pettingzoo.test import parallel_api_test, parallel_seed_test

import mecanum_env


@pytest.mark.parametrize("robots", [1, 3])
def test_it_is_a_parallel_environment(robots: int) -> None:
    parallel_api_test(mecanum_env.parallel_env(robots=robots, max_steps=30), num_cycles=70)


def test_seeds_make_episodes() -> None:
    parallel_seed_test(lambda: mecanum_env.parallel_env(robots=2, max_steps=20), num_cycles=20)


def test_stable_baselines3_takes_it_by_supersuit() -> None:
    from stable_baselines3 import PPO

    env = supersuit.pettingzoo_env_to_vec_env_v1(mecanum_env.parallel_env(robots=2, max_steps=25))
    envs = supersuit.concat_vec_envs_v1(env, 1, base_class="stable_baselines3")
    model = PPO("MultiInputPolicy", envs, n_steps=16, batch_size=16, n_epochs=1)
    model.learn(64)
    assert model.num_timesteps >= 64
    envs.close()


@pytest.mark.parametrize("robots", [1, 2])
def test_ppo_adds_the_value_of_what_would_follow_where_the_step_limit_cuts(
    robots: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    from stable_baselines3 import PPO

    env = mecanum_env.parallel_env(robots=robots, rooms="rectangular", max_steps=4)
    envs = supersuit.concat_vec_envs_v1(
        supersuit.pettingzoo_env_to_vec_env_v1(env), 1, base_class="stable_baselines3"
    )
    model = PPO("MultiInputPolicy", envs, n_steps=8, batch_size=8, n_epochs=1)
    asked, predict = [], model.policy.predict_values
    monkeypatch.setattr(model.policy, "predict_values", lambda seen: (asked.append(1), predict(seen))[1])
    model.learn(8 * robots)
    assert len(asked) == 2 * robots + 1  # after each robot's two episodes, and at the end of the rollout
    envs.close()


def test_an_end_is_no_cut() -> None:
    env = mecanum_env.parallel_env(robots=2, max_steps=3)
    env.reset(seed=0)
    still = {name: np.zeros(3, np.float32) for name in env.agents}
    cut = [env.step(still)[-1]["robot_0"]["TimeLimit.truncated"] for _ in range(3)]
    assert cut == [False, False, True]
    env = mecanum_env.parallel_env(robots=2, max_steps=1, config={"coverage_target": 0.01})
    env.reset(seed=0)
    assert [info["TimeLimit.truncated"] for info in env.step(still)[-1].values()] == [False, False]


def test_copies_of_a_team_that_is_not_seeded_explore_rooms_of_their_own() -> None:
    env = mecanum_env.parallel_env(robots=2, max_steps=3)
    robots = supersuit.pettingzoo_env_to_vec_env_v1(env)
    envs = supersuit.concat_vec_envs_v1(robots, 2, base_class="gymnasium")
    first, _ = envs.reset()
    assert not np.array_equal(first["scan"][0], first["scan"][2])
    for _ in range(3):
        then, *_ = envs.step(np.zeros((4, 3), np.float32))
    assert not np.array_equal(then["scan"][0], then["scan"][2])
    envs.close()


def test_supersuit_repeats_actions() -> None:
    env = supersuit.frame_skip_v0(mecanum_env.parallel_env(robots=2, rooms="rectangular"), (2, 4))
    times = []
    for seed in (5, 5):
        env.reset(seed=seed)
        for _ in range(4):
            *_, infos = env.step({name: np.zeros(3, np.float32) for name in env.agents})
            times.append(infos["robot_0"]["time_s"])
    assert times[:4] == times[4:]  # how often is drawn from the seed
    assert 0.8 <= times[3] <= 1.6


def test_agents_have_beliefs_goals_and_a_picture() -> None:
    env = mecanum_env.parallel_env(robots=2, render_mode="rgb_array", max_steps=5)
    env.reset(seed=0)
    env.announce("robot_1", np.array([1.0, 2.0]))
    env.step({name: np.zeros(3, np.float32) for name in env.agents})
    (mate,) = env.belief("robot_0").teammates
    assert mate.goal is not None
    assert np.allclose(mate.goal, (1.0, 2.0))
    frame = env.render()
    assert frame is not None
    assert frame.shape == (720, 1280, 3)
    with pytest.raises(ValueError, match="robot_0, robot_1"):
        env.belief("robot_7")
    with pytest.raises(ValueError, match="rgb_array"):
        mecanum_env.parallel_env(render_mode="human")


def test_what_is_missing_or_no_goal_is_said() -> None:
    env = mecanum_env.parallel_env(robots=2, rooms="rectangular", render_mode="rgb_array")
    for early in (env.render, lambda: env.belief("robot_0"), lambda: env.announce("robot_0", None)):
        with pytest.raises(RuntimeError, match=r"call reset\(\) first"):
            early()
    env.reset(seed=1)
    with pytest.raises(ValueError, match="that of robot_1 is missing"):
        env.step({"robot_0": np.zeros(3, np.float32)})
    for goal in (np.array([1.0, 2.0, 3.0]), np.array([np.nan, 0.0]), "there"):
        with pytest.raises(ValueError, match="a goal must be two finite numbers"):
            env.announce("robot_0", goal)  # type: ignore[arg-type]
    still = {name: np.zeros(3, np.float32) for name in (*env.agents, "robot_9")}
    for actions, words in ((still, "unknown agent 'robot_9'"), ([0.0], "actions must be a mapping")):
        with pytest.raises(ValueError, match=words):
            env.step(actions)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"options": "x"}, "options must be a mapping"),
        ({"options": {"floor_plan": 3}}, "floor_plan must be a FloorPlan or a path, got 3"),
        ({"options": {"room_seed": 1.7}}, "room_seed must be a whole number"),
        ({"options": {"start_poses": "here"}}, "start_poses must be 2 poses"),
        ({"seed": "x"}, "Seed must be a python integer"),
    ],
)
def test_a_reset_that_is_refused_leaves_no_episode(given: dict[str, Any], words: str) -> None:
    env = mecanum_env.parallel_env(robots=2, rooms="rectangular")
    env.reset(seed=1)
    with pytest.raises((ValueError, gymnasium.error.Error), match=words):
        env.reset(**given)
    assert env.agents == []
    with pytest.raises(RuntimeError, match=r"call reset\(\)"):
        env.step({})


def test_all_are_done_together_when_the_target_is_covered() -> None:
    env = mecanum_env.parallel_env(robots=2, config={"coverage_target": 0.01})
    env.reset(seed=0)
    _, _, terminated, _, infos = env.step({name: np.zeros(3, np.float32) for name in env.agents})
    assert terminated == {"robot_0": True, "robot_1": True}
    assert env.agents == []
    assert all(info["is_success"] for info in infos.values())


def test_the_team_s_settings_say_how_many_robots_there_are_where_the_argument_does_not() -> None:
    made = (mecanum_env.parallel_env(**given) for given in ({}, {"team": {"robots": 2}}, {"robots": 4}))
    assert [len(env.possible_agents) for env in made] == [3, 2, 4]


def test_a_copy_goes_on_as_the_original_does() -> None:
    env = mecanum_env.parallel_env(robots=2, rooms="apartment")
    env.reset(seed=0)
    twin = copy.deepcopy(env)
    goes = {name: np.array([1.0, 0.3, 0.0], np.float32) for name in env.agents}
    for _ in range(40):
        observations, rewards, *_, infos = env.step(goes)
        others, other_rewards, *_, other_infos = twin.step(goes)
        assert rewards == other_rewards
        for name, observation in observations.items():
            assert all(np.array_equal(observation[key], others[name][key]) for key in observation)
    contacts = [[info[key] for key in ("collisions", "robot_collisions")] for info in infos.values()]
    assert [[info[key] for key in ("collisions", "robot_collisions")] for info in other_infos.values()] == contacts
    assert np.sum(contacts) > 0
