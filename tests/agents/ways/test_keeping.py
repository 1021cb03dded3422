"""What is kept between decisions, against the same made from nothing: bit for bit, whatever happens to the map."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

from agents.ways.boxes import NOTHING, Box
from agents.ways.cost_map import CostMap, CostMaps, PlannerConfig, build
from mecanum_env.config import RobotConfig
from tests.agents.grids import Walk

ROBOT = RobotConfig()


def assert_same(kept: CostMap, made: CostMap) -> None:
    for name in ("classes", "clearance", "weight", "suspect"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(made, name), err_msg=name)
    assert (kept.origin, kept.start, kept.resolution) == (made.origin, made.start, made.resolution)


@pytest.mark.parametrize("resolution_m", [0.05, 0.1, 0.15])
@pytest.mark.parametrize("seed", range(4))
def test_cost_maps_are_those_made_from_nothing(seed, resolution_m):
    config = PlannerConfig(resolution_m=resolution_m)
    walk, maps, seldom = Walk(seed), CostMaps(config, ROBOT), CostMaps(config, ROBOT)
    for turn in range(30):
        belief = walk.redraw() if turn % 11 == 10 else walk.go(int(walk.rng.integers(0, 4)))
        made = build(belief, config, ROBOT)
        assert_same(maps.of(belief), made)
        assert_same(maps.of(belief), made)  # nothing was drawn since
        if turn % 5 == 4:  # another reader, that asks when it likes
            assert_same(seldom.of(belief), made)


def test_a_corner_may_be_drawn_after_the_robot_left_it_and_copies_of_grids_are_others():
    walk, maps = Walk(7), CostMaps(PlannerConfig(), ROBOT)
    maps.of(walk.go(5))
    twin = copy.deepcopy(walk.grid)
    walk.grid.mark_visited(6.0, -5.0, 0.3)
    assert_same(maps.of(walk.belief()), build(walk.belief(), PlannerConfig(), ROBOT))
    here = walk.belief()
    assert_same(maps.of(replace(here, grid=twin)), build(replace(here, grid=twin), PlannerConfig(), ROBOT))
    far = replace(here, pose=np.array([40.0, -40.0, 0.0]))  # off the grid, and back
    for belief in (far, here):
        assert_same(maps.of(belief), build(belief, PlannerConfig(), ROBOT))


def test_what_is_not_in_a_box_is_in_bands_that_do_not_overlap():
    rng = np.random.default_rng(0)
    for _ in range(200):
        corners = np.sort(rng.integers(-5, 6, (2, 2, 2)), axis=1)
        outer, inner = (Box(*corner.ravel().tolist()) for corner in corners)
        marks = np.zeros((12, 12), dtype=int)
        for band in [] if outer.empty else outer.without(inner):
            marks[band.moved(5, 5).slices] += 1
        expected = np.zeros((12, 12), dtype=int)
        expected[outer.moved(5, 5).slices] = 1
        if not inner.empty:
            expected[inner.moved(5, 5).slices] = 0
        np.testing.assert_array_equal(marks, expected)
        assert Box.of(expected > 0) == NOTHING or outer.around(Box.of(expected > 0).moved(-5, -5)) == outer


def test_another_robot_beyond_the_edge_leaves_nothing_to_weigh() -> None:
    walk, maps = Walk(3), CostMaps(PlannerConfig(), ROBOT)
    belief = walk.belief()
    maps.of(belief)
    maps._passing.append(Box(0, 3, 1, 6))  # in the outermost ring, which is unknown
    assert_same(maps.of(belief), build(belief, PlannerConfig(), ROBOT))
