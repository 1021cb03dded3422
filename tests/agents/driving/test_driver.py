"""What drives from goal to goal: waiting while lost, what lies beside, looking round."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import agents
from mecanum_env.config import LidarConfig, RobotConfig
from mecanum_env.env import ExploreEnv
from tests.agents.grids import belief_of, half_known


def test_lost_it_stands_and_no_time_runs_out():
    belief = belief_of(half_known(), (1.5, 2.0, 0.0))
    agent = agents.make("nearest-frontier", config={"frontiers": {"view_range_m": 0.8}})
    agent.reset(belief)
    for _ in range(10):
        agent.act(None, belief)
    left_s = agent._deadline - agent._time
    for _ in range(15):
        assert not agent.act(None, replace(belief, health=0.0)).any()
    assert agent._follower.speed_m_s == 0.0 and agent._deadline - agent._time == pytest.approx(left_s)
    first = agent.act(None, belief)
    assert 0.0 < np.hypot(*first[:2]) < 0.3  # it sets off as from rest


def test_a_short_sighted_robot_takes_what_lies_beside_for_something_else():
    for range_m, same_m in ((8.0, 0.6), (1.0, 0.2)):
        agent = agents.make("nearest-frontier", lidar=replace(LidarConfig(), range_max_m=range_m))
        agent.reset(belief_of(half_known(), (1.5, 2.0, 0.0)))
        assert agent._troubles._reach_m == pytest.approx(0.6 * same_m)


def test_who_sees_a_wedge_turns_round_before_it_gives_up():
    """Where all that was seen is too near to the unknown to be driven to, the way on is beside or behind."""
    env = ExploreEnv(rooms="rectangular", lidar={"field_of_view_deg": 20.0, "beams": 20})
    observation, _ = env.reset(seed=1)
    agent = agents.make("nearest-frontier", lidar=env.config.lidar)
    agent.reset(env.belief)
    idle, coverage = 0, 0.0
    for _ in range(600):
        observation, _, terminated, _, info = env.step(agent.act(observation, env.belief))
        idle, coverage = idle + 1 if agent.goal is None else 0, info["coverage"]
        if terminated or idle > 20:
            break
    assert coverage >= 0.95


def test_looking_round_counts_what_was_turned():
    robot = replace(RobotConfig(), max_turn_rate_rad_s=6.0)
    agent = agents.make("nearest-frontier", robot=robot, lidar=replace(LidarConfig(), field_of_view_deg=30.0))
    agent.reset(belief_of(half_known(), (1.5, 2.0, 0.0)))
    agent._turning = True

    def turns(*, heading, by, steps):
        """Return by how much the turn that is left shrinks while the heading changes by so much a step [rad]."""
        agent._turned_to, left = None, agent._to_turn_rad
        for k in range(steps + 1):
            agent._turn(None, belief_of(half_known(), (1.5, 2.0, heading + k * by)))
        return left - agent._to_turn_rad

    least = 0.1 * 0.1 * robot.max_speed_m_s / robot.lever_m  # a tenth of what is asked, no more than wheels can
    assert turns(heading=3.0, by=0.1, steps=5) == pytest.approx(0.5 + least)  # past ±π
    assert turns(heading=0.0, by=0.0, steps=5) == pytest.approx(6 * least)  # held fast, it ends some time
