"""The frontier-choosing environment: Gymnasium's rules, time, masks, the same episode from the same seed."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import agents
import mecanum_env  # noqa: F401 - registers
from agents.frontier_env import ExploreFrontierEnv
from agents.learned.choice import CANDIDATE, STATE
from agents.ppo_frontier import load_choice_policy

ID = "mecanum_env:mecanum_env/ExploreFrontier-v0"
TIME_ALONE = {"area": 0.0, "pose_entropy": 0.0, "map_entropy": 0.0, "collision": 0.0, "effort": 0.0, "time": -1.0}


def play(env, seed, *, pick=lambda env, observation: 0, most=400):
    observation, info = env.reset(seed=seed)
    trace = [(observation, 0.0, info)]
    for _ in range(most):
        observation, reward, terminated, truncated, info = env.step(pick(env.unwrapped, observation))
        trace.append((observation, reward, info))
        if terminated or truncated:
            break
    return trace


def test_it_is_an_environment_after_gymnasiums_rules():
    env = gymnasium.make(ID, rooms="rectangular")
    assert isinstance(env.unwrapped, ExploreFrontierEnv)
    check_env(env.unwrapped, skip_render_check=True)


def test_before_the_first_reset_it_says_what_to_do():
    env = ExploreFrontierEnv(rooms="rectangular", render_mode="rgb_array")
    with pytest.raises(RuntimeError, match=r"call reset\(\) before step\(\)"):
        env.step(0)
    with pytest.raises(RuntimeError, match=r"call reset\(\) before render\(\)"):
        env.render()


@pytest.mark.parametrize("rooms", ["rectangular", "apartment", "corridors", "cave", "maze"])
def test_an_episode_adds_up(rooms):
    env = gymnasium.make(ID, rooms=rooms, reward=TIME_ALONE, config={"time_limit_s": 12.0})
    trace = play(env, 3)
    info = trace[-1][2]
    durations = [i["duration_s"] for _, _, i in trace]
    assert sum(durations) == pytest.approx(info["time_s"])
    assert sum(r for _, r, _ in trace) == pytest.approx(-info["time_s"])
    assert info["end"] in ("covered", "time") and "episode_metrics" in info
    assert info["time_s"] <= 12.0 + 1e-9
    # A choice is due at least as often as an agent replans, but for the time with no choice.
    assert min(durations[1:]) > 0.0
    for observation, _, _ in trace[:-1]:
        assert env.observation_space.contains(observation)
        m = int(observation["present"].sum())
        assert (observation["present"][:m] == 1.0).all() and not observation["candidates"][m:].any()
        ways = observation["candidates"][:m, CANDIDATE.index("way")]
        assert (np.diff(ways) >= 0).all()  # cheapest first


def test_out_of_time_the_last_observation_shows_what_would_follow():
    """Who bootstraps from it is not told of a blank map at the time 0."""
    env = gymnasium.make(ID, rooms="apartment", config={"time_limit_s": 3.0})
    observation, _, info = play(env, 3)[-1]
    assert info["end"] == "time" and observation["present"].any()
    assert env.observation_space.contains(observation)
    assert observation["state"][STATE.index("time")] == pytest.approx(3.0 / 300.0, abs=1e-3)
    np.testing.assert_array_equal(env.unwrapped.action_masks(), observation["present"] > 0.5)


def test_the_masks_are_those_of_the_candidates():
    env = gymnasium.make(ID, rooms="apartment").unwrapped
    observation, _ = env.reset(seed=0)
    for _ in range(5):
        masks = env.action_masks()
        np.testing.assert_array_equal(masks, observation["present"] > 0.5)
        assert masks.dtype == bool and masks[0]
        observation, *_ = env.step(int(np.flatnonzero(masks)[-1]))


def test_pieces_of_frontier_at_one_view_point_are_one_candidate():
    env = gymnasium.make(ID, rooms="apartment", driver={"choice": {"most": 200}}).unwrapped
    env.reset(seed=0)
    shared = 0
    for _ in range(12):
        choice, found = env.agent.described
        cells = found.cells[choice.index]
        assert len(np.unique(cells, axis=0)) == len(cells)
        reachable = found.cells[np.isfinite(found.costs)]
        for cell, row in zip(cells, choice.candidates, strict=True):
            pieces = (reachable == cell).all(axis=1).sum()
            assert row[CANDIDATE.index("pieces")] == pytest.approx(pieces / 3.0)
            shared += pieces > 1
        assert len(np.unique(reachable, axis=0)) == len(cells)
        if found.current is not None:
            current = choice.candidates[:, CANDIDATE.index("current")]
            np.testing.assert_array_equal(current == 1.0, choice.index == found.current)
            assert current.sum() == 1.0
        env.step(len(cells) // 2)
    assert shared > 0


def test_the_tour_that_is_shown_is_that_of_the_agent_tour():
    # All are shown: a tour may begin farther away than the two dozen that are cheapest to reach.
    env = gymnasium.make(ID, rooms="apartment", driver={"choice": {"most": 200}}).unwrapped
    observation, _ = env.reset(seed=0)
    driver, body = env.driver, env.config
    shared = {"frontiers": driver.frontiers, "planner": driver.planner, "control": driver.control}
    tour = agents.make("tour", config=shared, robot=body.robot, lidar=body.lidar, step_s=body.step_s)
    tour.reset(env.belief)
    first, place, loss = (CANDIDATE.index(f"tour_{name}") for name in ("first", "place", "loss"))
    for _ in range(12):
        rows = observation["candidates"][observation["present"] > 0.5]
        assert rows[:, first].sum() == 1.0 and (rows[:, place] >= 0.0).all()
        np.testing.assert_array_equal(rows[:, first] == 1.0, rows[:, place] == 0.0)
        assert rows[np.argmax(rows[:, first]), loss] == 0.0
        choice, found = env.agent.described
        cell = found.cells[tour._by_views(found, np.flatnonzero(np.isfinite(found.costs)))]
        # Pieces at one view point are one candidate.
        action = int(np.flatnonzero((found.cells[choice.index] == cell).all(axis=1))[0])
        assert rows[action, first] == 1.0
        observation, *_ = env.step(action)


def test_without_uncertainty_nothing_is_shown_of_it_and_all_else_is_the_same():
    columns = [CANDIDATE.index(name) for name in ("corners", "walls", "sigma_left")]
    numbers = [STATE.index(name) for name in ("sigma_m", "sigma_rad")]
    shown, blind = (
        play(gymnasium.make(ID, rooms="apartment", driver={"choice": {"uncertainty": u}}), 4, most=6)
        for u in (True, False)
    )
    for (one, _, _), (other, _, _) in zip(shown, blind, strict=True):
        m = int(one["present"].sum())
        assert one["candidates"][:m, columns].any() and one["state"][numbers].all()
        assert not other["candidates"][:, columns].any() and not other["state"][numbers].any()
        one["candidates"][:, columns], one["state"][numbers] = 0.0, 0.0
        for key in one:
            np.testing.assert_array_equal(one[key], other[key])


def test_one_seed_is_one_episode_and_whatever_is_no_candidate_is_the_first():
    def last(env, observation):
        return int(np.flatnonzero(env.action_masks())[-1])

    traces = [play(gymnasium.make(ID, rooms="apartment"), 5, pick=last, most=12) for _ in range(2)]
    for one, other in zip(*traces, strict=True):
        assert one[1] == other[1] and one[2]["true_pose"].tolist() == other[2]["true_pose"].tolist()
        for key in one[0]:
            np.testing.assert_array_equal(one[0][key], other[0][key])
    many = {"choice": {"most": 200}}
    first = play(gymnasium.make(ID, rooms="rectangular", driver=many), 5, most=5)
    none = play(gymnasium.make(ID, rooms="rectangular", driver=many), 5, pick=lambda *_: 199, most=5)
    assert all(o["present"].sum() < len(o["present"]) for o, _, _ in none)  # so that the last is no candidate
    assert [i["time_s"] for _, _, i in first] == [i["time_s"] for _, _, i in none]


@pytest.mark.parametrize("early", [False, True])
def test_an_episode_without_a_seed_can_be_had_again(early):
    env, other = (gymnasium.make(ID, rooms="rectangular") for _ in range(2))
    asked = env.unwrapped.np_random_seed if early else None
    seen = [env.reset()[0]]
    seed = env.unwrapped.np_random_seed
    assert asked in (None, seed)
    again = [other.reset(seed=seed)[0]]
    for its, those in ((env, seen), (other, again)):
        those += [its.step(0)[0], its.reset()[0]]
    for one, same in zip(seen, again, strict=True):
        assert all(np.array_equal(one[key], same[key]) for key in one)
    assert env.unwrapped.np_random is env.unwrapped.base.np_random
    assert env.unwrapped.np_random_seed == env.unwrapped.base.np_random_seed == seed


def test_what_the_reward_is_made_of_adds_up_to_it_and_a_copy_goes_on_alike():
    env = gymnasium.make(ID, rooms="rectangular", discount=0.99)
    env.reset(seed=0)
    env.step(0)
    twin = pickle.loads(pickle.dumps(env))
    for _ in range(3):
        (observation, reward, *_, info), (other, *_) = env.step(0), twin.step(0)
        assert sum(info["reward_terms"].values()) == reward
        assert all(np.array_equal(observation[key], other[key]) for key in other)


def test_the_discount_is_per_control_step():
    whole = play(gymnasium.make(ID, rooms="apartment", reward=TIME_ALONE), 2, most=6)
    less = play(gymnasium.make(ID, rooms="apartment", reward=TIME_ALONE, discount=0.9), 2, most=6)
    for (_, _, info), (_, reward, _) in list(zip(whole, less, strict=True))[1:]:
        steps = round(info["duration_s"] / 0.1)
        assert reward == pytest.approx(-0.1 * (1 - 0.9**steps) / (1 - 0.9))


def test_choosing_the_nearest_drives_as_the_nearest_frontier_agent_does_until_it_would_not():
    """The same first choice, the same driving."""
    env = gymnasium.make(ID, rooms="apartment").unwrapped
    env.reset(seed=1)
    base = gymnasium.make("mecanum_env:mecanum_env/Explore-v0", rooms="apartment").unwrapped
    observation, _ = base.reset(seed=1)
    agent = agents.make("nearest-frontier")
    agent.reset(base.belief, 1)
    *_, info = env.step(0)
    for _ in range(round(info["duration_s"] / 0.1)):
        observation, *_, other = base.step(agent.act(observation, base.belief))
    np.testing.assert_array_equal(info["true_pose"], other["true_pose"])


@pytest.mark.parametrize("noise", ["nominal", "slippery"])
def test_a_policy_is_driven_here_as_by_its_agent(noise):
    """Choices by the policy, in either environment: one and the same way, to the last bit."""
    base = gymnasium.make("mecanum_env:mecanum_env/Explore-v0", rooms="apartment", noise=noise).unwrapped
    observation, _ = base.reset(seed=1)
    agent = agents.make("ppo-frontier")
    agent.reset(base.belief, 1)
    env = gymnasium.make(ID, rooms="apartment", noise=noise, driver=agent.config).unwrapped
    env.reset(seed=1)
    network = load_choice_policy(agent.policy_path)[0]
    for _ in range(20):
        *_, info = env.step(int(np.argmax(network.scores(env.agent.described[0]))))
        for _ in range(round(info["duration_s"] / 0.1)):
            observation, *_, other = base.step(agent.act(observation, base.belief))
        np.testing.assert_array_equal(info["true_pose"], other["true_pose"])


def test_a_lost_robot_is_asked_nothing_and_has_not_ended():
    env = gymnasium.make(ID, rooms="apartment", driver={"choice": {"most": 1}}).unwrapped
    env.reset(seed=1)
    belief = type(env.base).outline

    class Lost(type(env.base)):
        @property
        def outline(self):
            told = belief.fget(self)
            return replace(told, health=0.0) if 20 <= self._steps < 60 else told

    env.base.__class__ = Lost
    assert not env.agent.due(replace(env.base.outline, health=0.0))
    *_, info = env.step(0)  # all of it, where there is one to choose from
    assert info["end"] == "covered" and info["duration_s"] > 6.0


def test_the_limit_of_the_caller_ends_an_episode_as_any_other():
    env = gymnasium.make(ID, rooms="apartment", max_episode_steps=3)
    for _ in range(2):
        env.reset(seed=1)
        ends = [env.step(0) for _ in range(3)]
        assert [truncated for *_, truncated, _ in ends] == [False, False, True]
        assert "end" not in ends[1][4]
        assert ends[2][4]["end"] == "time" and "episode_metrics" in ends[2][4] and not ends[2][4]["is_success"]


def test_it_says_what_is_wrong():
    env = gymnasium.make(ID, rooms="rectangular").unwrapped
    env.reset(seed=0)
    for nonsense in (24, -1, 10**30, 2.7, math.nan, math.inf, None, "first", "3", [0, 1], np.zeros((9, 9))):
        with pytest.raises(ValueError, match=r"^action must be 0 … 23, got .*$"):
            env.step(nonsense)
    with pytest.raises(ValueError, match="discount"):
        ExploreFrontierEnv(discount=0.0)
    with pytest.raises(ValueError, match="valid"):
        ExploreFrontierEnv(driver={"speed": 1.0})
    with pytest.raises(ValueError, match=r"control\.lateral_m_s2 must be in \[0.001, 100\], got"):
        ExploreFrontierEnv(driver={"control": {"lateral_m_s2": 0.0}})
    assert len(STATE) == env.observation_space["state"].shape[0]
