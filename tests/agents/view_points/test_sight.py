"""How near view points lie: short-sighted robots stop short of them, and their lidars sit off their centres."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import agents
from agents.view_points.frontiers import FrontierConfig, find
from agents.view_points.sight import reach_m, view_points
from agents.ways import cost_map as cost_maps
from agents.ways.cost_map import PlannerConfig
from agents.ways.planning import travel_costs
from mecanum_env.config import LIDAR_PRESETS, LidarConfig, RobotConfig
from mecanum_env.env import ExploreEnv
from tests.agents.grids import belief_of, half_known


@pytest.mark.parametrize(
    ("lidar", "range_m", "short_m", "reach"),
    [
        (LidarConfig(), 4.0, 0.32, 3.4),  # the usual robot keeps to 0.85 of the range …
        (replace(LidarConfig(), range_max_m=1.0), 0.8, 0.32, 0.48),  # … a short-sighted one to what is left
        (replace(LidarConfig(), range_max_m=1.0, offset_m=-0.1), 0.8, 0.22, 0.58),
        (replace(LidarConfig(), range_max_m=1.0, field_of_view_deg=270.0), 0.8, 0.12, 0.68),  # faces the target
        (replace(LidarConfig(), range_max_m=0.4), 0.32, 0.32, 0.1),  # two cells at least
        (LIDAR_PRESETS["cavity"], 4.0, 0.12, 3.4),
    ],
)
def test_view_points_keep_to_what_is_seen_from_where_the_robot_stops(lidar, range_m, short_m, reach):
    agent = agents.make("nearest-frontier", lidar=lidar)
    assert agent._watch_kept().range_m == pytest.approx(range_m)
    assert agent._short_m() == pytest.approx(short_m)
    assert reach_m(range_m, short_m, 0.05) == pytest.approx(reach)


def test_where_the_body_cannot_come_that_near_a_farther_place_will_do():
    cost_map = cost_maps.build(belief_of(half_known(), (1.5, 2.0, 0.0)), PlannerConfig(), RobotConfig())
    travel, found = travel_costs(cost_map), find(cost_map, FrontierConfig())

    def away(short_m):
        cells, costs = view_points(
            cost_map, travel, found.targets, found.normals, range_m=1.0, beyond_m=0.3, short_m=short_m
        )
        assert np.isfinite(costs).all()
        return np.hypot(*(found.targets - cost_map.to_points(cells)).T).max()

    assert away(0.4) <= 0.6 < away(0.0) <= 0.85
    assert away(0.8) > 0.6  # 0.2 m before the unknown there is no room


def test_a_short_sighted_robot_gives_no_frontier_up():
    env = ExploreEnv(rooms="rectangular", slam="truth", lidar={"range_max_m": 1.0})
    observation, _ = env.reset(seed=2)
    agent = agents.make("brisk-tour", lidar=env.config.lidar)
    agent.reset(env.belief)
    for _ in range(1500):
        observation, _, terminated, _, info = env.step(agent.act(observation, env.belief))
        if terminated or agent.ended:
            break
    assert info["coverage"] >= 0.95
