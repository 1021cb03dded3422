"""The end-to-end policy's memory: it reads the map as it is now, and finds ways over all of it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

import agents
from agents.learned.drive_memory import CHANNELS, LOG_PRICES, MapMemory, PlanSettings, draw_memory
from agents.ppo import Ppo
from mecanum_env.env import ExploreEnv
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid


def belief(classes: np.ndarray, x: float, y: float, theta: float = 0.0) -> SimpleNamespace:
    """Classes in cells of 5 cm, the first one's corner at the origin."""
    grid = OccupancyGrid.from_classes(classes.astype(np.int8), 0.05, (0.0, 0.0))
    return SimpleNamespace(grid=grid, pose=np.array([x, y, theta]))


def corridor(length_m: float) -> np.ndarray:
    """Along x, walls beside it, both ends open to the unknown."""
    classes = np.full((40, round(length_m / 0.05)), FREE)
    classes[:2] = classes[-2:] = OCCUPIED
    return classes


class Plainly:
    """Reads a map by rule: walls are dear, and what is half known is a goal."""

    def of_map(self, maps: np.ndarray) -> np.ndarray:
        free = maps[2] > 0
        beside = np.zeros_like(free)
        unknown = maps[1] == 0
        beside[1:-1, 1:-1] = unknown[1:-1, :-2] | unknown[1:-1, 2:]
        return np.stack([np.where(maps[0] > 150, 3.5, 0.0), np.where(free & beside, 6.0, -6.0)]).astype(np.float32)


def test_the_map_is_drawn_block_by_block():
    classes = np.full((64, 64), UNKNOWN)
    classes[10:12, 20:22] = [[OCCUPIED, FREE], [FREE, UNKNOWN]]
    classes[30:32, 40:42] = FREE
    grid = OccupancyGrid.from_classes(classes.astype(np.int8), 0.05, (0.0, 0.0))
    grid.mark_visited(2.05, 1.55, 0.05)
    maps = draw_memory(grid, 2)
    row, col = (-n // 2 for n in grid.lattice_origin)
    wall, floor = maps[:, row + 5, col + 10], maps[:, row + 15, col + 20]
    assert maps.shape == (CHANNELS, grid.shape[0] // 2, grid.shape[1] // 2)
    assert wall[0] > 200 and wall[1] == 255 * 3 // 4 and wall[2] == 255 // 2
    assert floor[0] < 60 and floor[1] == floor[2] == floor[3] == 255
    assert tuple(maps[:3, row, col]) == (128, 0, 0)
    # Nearness falls evenly, to nothing at 3.2 m.
    assert maps[3, row + 15, col + 4] == pytest.approx(255 * 0.5, abs=8)


def test_what_was_kept_is_what_would_be_made_anew():
    env = ExploreEnv(rooms="apartment")
    observation, _ = env.reset(seed=4)
    agent = agents.make("ppo")
    assert isinstance(agent, Ppo)
    agent.reset(env.belief)
    for _ in range(96):
        observation, *_ = env.step(agent.act(observation, env.belief))
    memory = agent._memory
    while memory._calls % memory._every:
        memory.way(env.belief)
    memory.way(env.belief)
    anew = agent._network.of_map(draw_memory(env.belief.grid, 2))
    np.testing.assert_allclose(memory._log_price, np.clip(anew[0], *LOG_PRICES), atol=1e-4)
    np.testing.assert_allclose(memory._goal_m, 8.0 * np.log1p(np.exp(-anew[1])), atol=1e-3)


def test_it_goes_to_what_is_nearest_and_back_over_all_of_the_building():
    seen = belief(corridor(40.0), 12.0, 1.0)
    way = MapMemory(Plainly().of_map, PlanSettings()).way(seen)
    assert way.likely and way.path[-1][0] < -11.5
    assert way.length == pytest.approx(12.0, abs=0.5) and way.cost == pytest.approx(12.0, abs=1.0)
    turned = MapMemory(Plainly().of_map, PlanSettings()).way(belief(corridor(40.0), 12.0, 1.0, np.pi / 2))
    assert turned.path[-1][1] > 11.5  # the same place lies to the left of it
    np.testing.assert_allclose(np.hypot(*turned.points[4]), 1.0, atol=0.05)
    closed = corridor(40.0)
    closed[:, :2] = OCCUPIED
    assert MapMemory(Plainly().of_map, PlanSettings()).way(belief(closed, 12.0, 1.0)).length > 27.0
    closed[:, -2:] = OCCUPIED
    assert not MapMemory(Plainly().of_map, PlanSettings()).way(belief(closed, 12.0, 1.0)).likely


def test_it_keeps_to_its_goal_until_another_is_much_nearer():
    memory = MapMemory(Plainly().of_map, PlanSettings(keep_m=1.5, stall_m=0.0), step_s=0.5)
    classes = corridor(20.0)
    ends = [memory.way(belief(classes, x, 1.0)).path[-1][0] for x in (9.7, 10.5, 11.5)]
    assert ends[0] < 0.0 and ends[1] < 0.0 and ends[2] > 0.0


def test_a_goal_that_does_not_yield_is_left():
    memory = MapMemory(Plainly().of_map, PlanSettings(stall_m=4.0), step_s=0.5)
    ends = [memory.way(belief(corridor(8.0), 0.5, 1.0)).path[-1][0] for _ in range(12)]
    assert ends[0] < 0.0 and ends[-1] > 7.0
