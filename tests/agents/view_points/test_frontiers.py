from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from agents.view_points.frontiers import FrontierConfig, find, frontier_cells
from agents.view_points.sight import Watch, in_good_sight, view_points
from agents.ways import cost_map as cost_maps
from agents.ways.cost_map import PlannerConfig
from agents.ways.planning import travel_costs
from mecanum_env.config import RobotConfig
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN
from tests.agents.grids import RESOLUTION, belief_of, fill, half_known, room

ROBOT = RobotConfig()
rasters = arrays(
    np.int8, st.tuples(st.integers(1, 14), st.integers(1, 14)), elements=st.sampled_from([-1, 0, 100])
)


@settings(max_examples=60, deadline=None)
@given(rasters)
def test_frontier_cells_against_their_definition(classes):
    rows, cols = classes.shape
    expected = 0
    for r in range(1, rows - 1):
        for c in range(1, cols - 1):
            expected += classes[r, c] == FREE and (classes[r - 1 : r + 2, c - 1 : c + 2] == UNKNOWN).any()
    assert frontier_cells(classes) == expected


def test_one_straight_frontier():
    belief = belief_of(half_known(), (1.5, 2.0, 0.0))
    cost_map = cost_maps.build(belief, PlannerConfig(), ROBOT)
    found = find(cost_map, FrontierConfig())
    assert found.extents.shape == (1,)
    assert found.extents[0] == pytest.approx(3.7, abs=0.25)  # 4 m less what lies too near to the walls
    np.testing.assert_allclose(found.points[:, 0], 3.95, atol=1e-9)
    np.testing.assert_allclose(found.normals, np.tile([1.0, 0.0], (len(found.normals), 1)), atol=0.5)
    # Pieces of about the size asked for, that together hold all of the cluster.
    assert len(found.targets) == pytest.approx(3.7 / 0.6, abs=1.5)
    # Crumbs of one or two cells at its ends excepted.
    assert len(found.points) - 4 <= found.sizes.sum() <= len(found.points)


def test_view_points_see_and_are_reachable():
    classes = half_known()
    fill(classes, 2.4, 1.2, 2.6, 2.8)  # a wall between the robot and the middle of the frontier
    belief = belief_of(classes, (1.5, 2.0, 0.0))
    cost_map = cost_maps.build(belief, PlannerConfig(), ROBOT)
    travel = travel_costs(cost_map)
    found = find(cost_map, FrontierConfig())
    cells, costs = view_points(cost_map, travel, found.targets, found.normals, range_m=2.4, beyond_m=0.3)
    assert np.isfinite(costs).all()
    places = cost_map.to_points(cells)
    np.testing.assert_allclose(costs, travel.cost[cells[:, 0], cells[:, 1]])
    away = np.hypot(*(found.targets - places).T)
    assert (away <= 2.4).all()
    for place, target in zip(places, found.targets, strict=True):
        line = place + np.linspace(0, 1, 60)[:, None] * (target - place)
        cells = cost_map.to_cells(line)
        assert not (cost_map.classes[cells[:, 0], cells[:, 1]] == OCCUPIED).any()
    # Standing there settles it: what they lead to is in good sight from them, by the other rule too.
    cells = cost_map.to_cells(found.targets)
    for i, place in enumerate(places):
        watch = Watch(np.array([[*place, 0.0]]), 2.4, np.pi)
        assert in_good_sight(cost_map, cells[i : i + 1], found.normals[i : i + 1], watch)[0]


@pytest.mark.parametrize(
    ("x", "y", "heading", "half_view", "seen"),
    [
        (2.1, 2.0, 0.0, np.pi, True),  # 1.9 m away, squarely
        (1.9, 2.0, 0.0, np.pi, False),  # too far
        (2.6, 2.0 - 1.4, 0.0, np.pi, False),  # 2 m away at 45°: the beams fall as far apart as from 2.8 m
        (3.05, 2.0 - 0.9, 0.0, np.pi, True),  # 1.3 m at 45°: as from 1.8 m
        (2.1, 2.0, 0.5, 0.6, True),  # to a side, but within the field of view
        (2.1, 2.0, 0.7, 0.6, False),
        (2.1, 2.0, np.pi, np.pi, True),
    ],
)
def test_good_sight_is_a_circle_that_touches_the_frontier(x, y, heading, half_view, seen):
    cost_map = cost_maps.build(belief_of(half_known(), (1.5, 2.0, 0.0)), PlannerConfig(), ROBOT)
    cell, normal = cost_map.to_cells(np.array([[3.95, 2.0]])), np.array([[1.0, 0.0]])
    watch = Watch(np.array([[x, y, heading]]), 2.0, half_view)
    assert in_good_sight(cost_map, cell, normal, watch)[0] == seen
    # Nothing is seen through a wall, and nothing from nowhere.
    classes = half_known()
    fill(classes, 3.4, 0.0, 3.6, 4.0)
    walled = cost_maps.build(belief_of(classes, (1.5, 2.0, 0.0)), PlannerConfig(), ROBOT)
    assert not in_good_sight(walled, cell, normal, watch)[0]
    assert not in_good_sight(cost_map, cell, normal, Watch(np.zeros((0, 3)), 2.0, half_view))[0]


def test_what_was_in_good_sight_is_no_frontier():
    cost_map = cost_maps.build(belief_of(half_known(), (1.5, 2.0, 0.0)), PlannerConfig(), ROBOT)
    watch = Watch(np.array([[3.0, 1.0, 0.0]]), 2.0, np.pi)
    found = find(cost_map, FrontierConfig(), watch)
    # A circle of 2 m through (4, 1) and (3, 1): what lies within 1 m of y = 1 on the frontier is settled.
    assert 0 < len(found.points) < len(find(cost_map, FrontierConfig()).points)
    assert found.points[:, 1].min() == pytest.approx(2.0, abs=0.15)


def test_insides_of_walls_and_unsettled_walls_are_no_frontiers():
    classes = room(6.0, 4.0)
    fill(classes, 3.0, 0.05, 3.2, 3.0, UNKNOWN)  # both faces of a thin wall worn off the map
    cost_map = cost_maps.build(belief_of(classes, (1.5, 2.0, 0.0)), PlannerConfig(), ROBOT)
    assert len(find(cost_map, FrontierConfig()).points) == 0
    assert len(find(cost_map, FrontierConfig(min_unknown_width_m=0.1)).points) > 0
    belief = belief_of(half_known(), (1.5, 2.0, 0.0))
    col = belief.grid.to_cells(np.array([[4.01, 2.0]]))[0, 1]
    assert len(find(cost_maps.build(belief, PlannerConfig(), ROBOT), FrontierConfig()).points) > 0
    rows = slice(*belief.grid.to_cells(np.array([[4.0, 0.1], [4.0, 3.9]]))[:, 0])
    belief.grid.log_odds[rows, col] = 9  # hit once, and once seen through: not occupied, but hardly an opening
    assert len(find(cost_maps.build(belief, PlannerConfig(), ROBOT), FrontierConfig()).points) == 0


def test_the_farther_the_more_there_must_be():
    config = FrontierConfig(min_extent_m=0.4, far_extent_m=0.8, far_m=4.0)
    np.testing.assert_allclose(config.wanted_extent(np.array([0.0, 2.0, 4.0, np.inf])), [0.4, 0.6, 0.8, 0.8])
    small = config.for_body(0.16)
    assert (small.min_extent_m, small.far_extent_m) == (0.16, 0.32)
    assert config.for_body(0.5) == config


def test_small_clusters_and_small_pockets_are_left_out():
    classes = room(6.0, 4.0)
    fill(classes, 3.0, 2.0, 3.2, 2.1, UNKNOWN)  # 0.02 m²
    cost_map = cost_maps.build(belief_of(classes, (1.5, 2.0, 0.0)), PlannerConfig(), ROBOT)
    assert len(find(cost_map, FrontierConfig()).points) == 0
    fill(classes, 3.0, 2.0, 3.8, 2.8, UNKNOWN)
    cost_map = cost_maps.build(belief_of(classes, (1.5, 2.0, 0.0)), PlannerConfig(), ROBOT)
    assert len(find(cost_map, FrontierConfig()).extents) == 1
    assert len(find(cost_map, FrontierConfig(min_extent_m=2.0, far_extent_m=2.0)).extents) == 0


def test_crumbs_that_single_beams_leave_are_joined_where_that_is_asked_for():
    classes = room(6.0, 4.0)
    fill(classes, 3.0, 1.0, 6.0, 4.0, UNKNOWN)
    fill(classes, 2.9, 1.0, 3.0, 4.0)  # closed, …
    fill(classes, 3.0, 0.9, 6.0, 1.0)
    for k in range(6):  # … but for a beam, seen in every fourth cell
        fill(classes, 3.2 + 0.2 * k, 1.8 + 0.2 * k, 3.3 + 0.2 * k, 1.9 + 0.2 * k, FREE)
    cost_map = cost_maps.build(belief_of(classes, (1.5, 2.0, 0.0)), PlannerConfig(), ROBOT)
    assert len(find(cost_map, FrontierConfig()).extents) == 0
    extents = find(cost_map, FrontierConfig(joined_cells=2)).extents
    assert len(extents) == 1 and extents[0] == pytest.approx(1.1, abs=0.11)


@settings(max_examples=40, deadline=None)
@given(rasters, st.sampled_from([(0.0, 0.0), (-0.35, 0.05), (0.1, -0.15)]))
def test_coarse_cells_are_conservative(classes, origin):
    belief = belief_of(classes, (0.1, 0.1, 0.0), origin=origin)
    cost_map = cost_maps.build(belief, PlannerConfig(), ROBOT)
    fine, grid = belief.grid.classes(), belief.grid
    occupied = grid.to_points(np.argwhere(fine == OCCUPIED))
    cells = cost_map.to_cells(occupied)
    assert (cost_map.classes[cells[:, 0], cells[:, 1]] == OCCUPIED).all()
    # A free coarse cell is free in most of its fine ones: nothing takes the unknown for free.
    fine_classes = np.stack([fine == FREE, fine != FREE], axis=-1).reshape(-1, 2)
    every = grid.to_points(np.argwhere(np.ones(fine.shape, dtype=bool)))
    cells = cost_map.to_cells(every)
    flat = cells[:, 0] * cost_map.classes.shape[1] + cells[:, 1]
    free = np.bincount(flat, fine_classes[:, 0], cost_map.classes.size)
    other = np.bincount(flat, fine_classes[:, 1], cost_map.classes.size)
    assert (free > other)[cost_map.classes.ravel() == FREE].all()
    # The robot's own cell apart, it is allowed only where the map is free, or under its body.
    passable = np.argwhere((cost_map.weight > 0) & (cost_map.classes != FREE))
    reach = ROBOT.circumscribed_radius_m + 2 * cost_map.resolution
    assert (np.hypot(*(cost_map.to_points(passable) - belief.pose[:2]).T) <= reach).all()


def test_clearance_is_exact_along_a_wall():
    belief = belief_of(room(4.0, 4.0), (2.0, 2.0, 0.0))
    cost_map = cost_maps.build(belief, PlannerConfig(), ROBOT)
    points = np.array([[x, 2.0] for x in (0.35, 0.75, 1.45)])
    cells = cost_map.to_cells(points)
    centres = cost_map.to_points(cells)[:, 0]
    got = cost_map.clearance[cells[:, 0], cells[:, 1]]
    np.testing.assert_allclose(got, centres - RESOLUTION, atol=0.02)
