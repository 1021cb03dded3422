"""Explore and return: when it turns back, where it goes then, and what it says at the end."""

from __future__ import annotations

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

import agents
from agents.explore_and_return import ExploreAndReturnConfig, HomingConfig
from mecanum_env.config import ROBOT_PRESETS, RobotConfig
from slam.belief import Teammate
from slam.geometry import wrap_scalar
from slam.grids.occupancy import OCCUPIED, UNKNOWN
from tests.agents.grids import belief_of, body_gap, drive, fill, half_known, room

ROBOT = RobotConfig()
SHORT = {"view_range_m": 0.8}
# The known room reaches from (-2, -2) m on: the start, (0, 0), is within it.
CORNER = (-2.0, -2.0)


def agent_in(belief, *, start=(0.0, 0.0, 0.0), **kwargs):
    """An agent that began at ``start`` and is where the belief says by now."""
    agent = agents.make("explore-and-return", **kwargs)
    agent.reset(replace(belief, pose=np.array(start)))
    return agent


def go(agent, classes, pose, *, robot=ROBOT, steps=600, origin=CORNER):
    """Drive in a map that stands still until the agent has no goal; return the pose and the words it used."""
    words, gaps = [], []
    for _ in range(steps):
        action = agent.act(None, belief_of(classes, tuple(pose), origin=origin))
        words.append(agent.status)
        if agent.goal is None:
            break
        pose = drive(pose, action, robot)
        gaps.append(body_gap(classes, pose - np.array([*origin, 0.0]), robot))
    return pose, words, min(gaps, default=1.0)


def test_explores_like_the_nearest_frontier_agent_while_there_is_something_left():
    belief = belief_of(half_known(), (1.5, 2.0, 0.4))
    config = {"frontiers": SHORT}
    agent, explorer = agent_in(belief, config=config), agents.make("nearest-frontier", config=config)
    explorer.reset(belief)
    goal, other = agent.choose(belief), explorer.choose(belief)
    np.testing.assert_array_equal(goal.path, other.path)
    np.testing.assert_array_equal(goal.pose, other.pose)
    assert agent.status == "driving"


def test_with_nothing_left_it_chooses_the_start():
    classes = room(8.0, 5.0)
    belief = belief_of(classes, (4.0, 1.0, 0.7), origin=CORNER)
    agent = agent_in(belief)
    goal = agent.choose(belief)
    assert agent.status == "returning"
    np.testing.assert_allclose(goal.path[0], belief.pose[:2])
    np.testing.assert_array_equal(goal.path[-1], (0.0, 0.0))
    np.testing.assert_array_equal(goal.pose, np.zeros(3))
    # What turns up on the way back does not call it off.
    fill(classes, 7.0, 1.0, 8.0, 4.0, UNKNOWN)
    goal = agent.choose(belief_of(classes, (3.0, 1.0, 0.7), origin=CORNER))
    np.testing.assert_array_equal(goal.path[-1], (0.0, 0.0))
    # The next episode explores again.
    agent.reset(belief_of(half_known(), (1.5, 2.0, 0.4)))
    assert agent.choose(belief_of(half_known(), (1.5, 2.0, 0.4))) is not None
    assert agent.status == "driving"


def test_in_a_frame_that_is_another_s_the_start_is_its_own():
    classes = room(8.0, 5.0)
    agent = agent_in(belief_of(classes, (3.5, 1.5, -1.0), origin=CORNER), start=(3.0, 1.0, 0.5))
    pose, words, _ = go(agent, classes, np.array([3.5, 1.5, -1.0]))
    assert words[-1] == "returned"
    np.testing.assert_allclose(pose, (3.0, 1.0, 0.5), atol=0.11)


@pytest.mark.parametrize("preset", ["youbot", "cavity"])
def test_goes_round_what_is_in_the_way_and_stops_on_the_start(preset):
    classes = room(8.0, 5.0)
    fill(classes, 3.5, 0.0, 3.7, 3.5)
    agent = agent_in(belief_of(classes, (4.0, -1.0, 2.0), origin=CORNER), robot=preset, lidar=preset)
    pose, words, gap = go(agent, classes, np.array([4.0, -1.0, 2.0]), robot=ROBOT_PRESETS[preset])
    assert words[-1] == "returned" and set(words) == {"returning", "returned"}
    assert np.hypot(*pose[:2]) <= 0.05 and abs(wrap_scalar(pose[2])) <= 0.1
    assert gap > 0.0
    # That is its end, also where the belief slips afterwards.
    assert agent.choose(belief_of(classes, (0.3, 0.2, 0.5), origin=CORNER)) is None
    assert agent.status == "returned"
    np.testing.assert_array_equal(
        agent.act(None, belief_of(classes, (0.3, 0.2, 0.5), origin=CORNER)), np.zeros(3, np.float32)
    )


def test_one_that_has_made_way_for_another_goes_back_to_the_start():
    classes, agent = room(8.0, 5.0), agents.make("explore-and-return")
    agent.reset(belief_of(classes, (0.0, 0.0, 0.0), origin=CORNER))
    pose, words, _ = go(agent, classes, np.array([2.0, 0.5, 0.0]))
    assert words[-1] == "returned"
    mate = Teammate(0, np.array([-1.0, 0.0, 0.0]), 0.0, np.array([3.0, 0.0]))  # its way is over the start
    for _ in range(30):
        belief = replace(belief_of(classes, tuple(pose), origin=CORNER), teammates=(mate,), robot=1)
        pose = drive(pose, agent.act(None, belief), ROBOT)
    assert agent.status == "giving way" and np.hypot(*pose[:2]) > 0.3
    pose, words, _ = go(agent, classes, pose)
    assert words[-1] == "returned" and np.hypot(*pose[:2]) < 0.05


def test_a_start_too_near_to_a_wall_to_plan_to_is_reached_all_the_same():
    """0.25 m from it, the body along it: 0.06 m are between them, and it could not stand there askew."""
    classes = room(8.0, 5.0)
    fill(classes, 0.0, 0.0, 8.0, 1.75)
    agent = agent_in(belief_of(classes, (4.0, 1.0, 0.0), origin=CORNER))
    pose, words, gap = go(agent, classes, np.array([4.0, 1.0, 0.0]))
    assert words[-1] == "returned"
    assert np.hypot(*pose[:2]) <= 0.05 and gap > 0.0


def test_with_the_way_back_gone_it_goes_as_near_as_it_can_and_ends_stuck():
    classes = room(8.0, 5.0)
    fill(classes, 3.5, 0.0, 3.7, 5.0)  # between the robot and the start, from wall to wall
    agent = agent_in(belief_of(classes, (4.0, 1.0, 0.0), origin=CORNER))
    goal = agent.choose(belief_of(classes, (4.0, 1.0, 0.0), origin=CORNER))
    assert 1.7 < goal.path[-1, 0] < 2.3 and agent.status == "returning"
    pose, words, gap = go(agent, classes, np.array([4.0, 1.0, 0.0]))
    assert words[-1] == "stuck" and "recovering" in words
    assert np.hypot(*pose[:2]) < 3.0 and gap > 0.0
    assert agent.choose(belief_of(room(8.0, 5.0), (2.0, 0.0, 0.0), origin=CORNER)) is None


def test_a_robot_that_does_not_move_gives_up():
    belief = belief_of(room(8.0, 5.0), (4.0, 1.0, 0.0), origin=CORNER)
    agent = agent_in(belief, config={"patience": {"stuck_s": 1.0, "recover_s": 0.5, "attempts": 2}})
    words = []
    for _ in range(100):
        agent.act(None, belief)
        words.append(agent.status)
        if agent.goal is None:
            break
    assert words[-1] == "stuck" and set(words) == {"returning", "recovering", "stuck"}


def test_enclosed_where_nothing_can_be_reached():
    classes = np.full((40, 40), OCCUPIED, np.int8)
    belief = belief_of(classes, (1.0, 1.0, 0.0))
    agent = agent_in(belief)
    for _ in range(3):
        assert np.isfinite(agent.act(None, belief)).all()


def test_configuration():
    assert ExploreAndReturnConfig().switch_m == 0.5
    agent = agents.make("explore-and-return", config={"homing": {"arrived_m": 0.1}, "switch_m": 1})
    assert agent.config.homing.arrived_m == 0.1
    with pytest.raises(ValueError, match=r"arrived_rad must be in \[0.001, 6.3\], got 0.0"):
        HomingConfig(arrived_rad=0.0)
    with pytest.raises(ValueError, match="arrived_m"):
        agents.make("explore-and-return", config={"homing": {"arived_m": 0.1}})


def test_a_whole_episode_ends_where_it_began():
    env = gym.make(
        "mecanum_env:mecanum_env/Explore-v0",
        rooms={"name": "rectangular", "length_m": (5.0, 5.0), "width_m": (4.0, 4.0), "furniture": 0.3},
        config={"coverage_target": 1.0},
        max_episode_steps=1200,
    )
    world = env.unwrapped
    agent = agents.make(
        "explore-and-return", robot=world.config.robot, lidar=world.config.lidar, step_s=world.config.step_s
    )
    observation, _ = env.reset(seed=3)
    agent.reset(world.belief, 3)
    farthest, truncated = 0.0, False
    while not truncated:
        action = agent.act(observation, world.belief)
        if agent.goal is None:
            break
        observation, _, _, truncated, info = env.step(action)
        farthest = max(farthest, float(np.hypot(*info["true_pose"][:2])))
    assert agent.status == "returned"
    assert info["coverage"] > 0.95 and info["collisions"] == 0
    assert farthest > 0.5
    assert np.hypot(*info["true_pose"][:2]) < 0.1 and abs(info["true_pose"][2]) < 0.15
