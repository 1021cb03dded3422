"""Places over the true map: what they take for visible is so."""

from __future__ import annotations

import numpy as np

from agents.ways.cost_map import PlannerConfig
from mecanum_env.config import LidarConfig, RobotConfig
from mecanum_env.ground_truth import GroundTruth
from mecanum_env.rooms import make
from training.truth.places import TruePlaces, cells_per_tile, greedy_tour


def test_tiles_seen_are_in_the_line_of_sight():
    plan = make("apartment", seed=3)
    ground = GroundTruth(plan, plan.start, robot=RobotConfig(), lidar=LidarConfig(), resolution=0.05)
    places = TruePlaces(ground, PlannerConfig(), robot=RobotConfig(), lidar=LidarConfig())
    whole = cells_per_tile(ground.mappable)
    rng = np.random.default_rng(0)
    checked = 0
    for place in rng.choice(len(places.cells), 6, replace=False):
        eye = places.map.to_points(places.cells[[place]])[0] / ground.resolution
        eye -= np.array(ground.lattice_origin[::-1])
        tiles = np.argwhere(places.sight[place].reshape(whole.shape))
        for tile in tiles[rng.choice(len(tiles), min(10, len(tiles)), replace=False)]:
            cells = np.argwhere(ground.mappable[6 * tile[0] : 6 * tile[0] + 6, 6 * tile[1] : 6 * tile[1] + 6])
            clear = [is_clear(ground.walls, eye, 6 * tile[::-1] + cell[::-1] + 0.5) for cell in cells]
            assert np.mean(clear) > 0.5
            checked += 1
    assert checked > 20


def is_clear(walls, a, b):
    line = a + np.linspace(0.0, 1.0, 200)[:, None] * (b - a)
    cells = np.floor(line).astype(int)
    return not walls[cells[:, 1], cells[:, 0]].any()


def test_greedy_tours_by_hand():
    # On a line: robot at 0, places at 1, 2 and 10; the one at 2 sees what the one at 1 sees, and more.
    at = np.array([0.0, 1.0, 2.0, 10.0])
    distance = np.abs(at[:, None] - at)
    seen = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 1]], dtype=bool)
    cells = np.array([10.0, 5.0, 5.0])

    def greedy(offset: float) -> np.ndarray:
        tiles = np.ascontiguousarray(seen.T)
        return greedy_tour(tiles, distance, cells.copy(), cells @ tiles, cells.sum(), 0, -1.0, offset)[0]

    np.testing.assert_array_equal(greedy(0.5), [0, 1, 2, 3])
    np.testing.assert_array_equal(greedy(5.0), [0, 2, 3])
