from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from agents.driving.safety import local_map
from agents.ways import cost_map as cost_maps
from agents.ways.cost_map import CostMap, PlannerConfig, comfortable_clearance, tight_clearance
from agents.ways.planning import _segment, resample, shortest_path, travel_costs
from mecanum_env.config import RobotConfig
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN
from tests.agents.grids import belief_of, fill, half_known, room, two_rooms

ROBOT = RobotConfig()


def oracle(weight, start, resolution):
    rows, cols = weight.shape
    index = np.arange(rows * cols).reshape(rows, cols)
    sources, targets, prices = [], [], []
    for r, c in np.argwhere(weight > 0):
        for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
            i, j = r + dr, c + dc
            if not (0 <= i < rows and 0 <= j < cols) or weight[i, j] <= 0:
                continue
            if dr and dc and (weight[r, j] <= 0 or weight[i, c] <= 0):
                continue
            sources.append(index[r, c])
            targets.append(index[i, j])
            prices.append(np.hypot(dr, dc) * 0.5 * (weight[r, c] + weight[i, j]) * resolution)
    graph = coo_matrix((prices, (sources, targets)), shape=(rows * cols, rows * cols)).tocsr()
    return dijkstra(graph, directed=False, indices=index[start]).reshape(rows, cols)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(4, 22), st.integers(4, 22), st.floats(0.0, 0.5))
def test_travel_costs_against_scipy(seed, rows, cols, share):
    rng = np.random.default_rng(seed)
    weight = rng.uniform(1.0, 9.0, (rows, cols)).astype(np.float32)
    weight[rng.random((rows, cols)) < share] = 0.0
    weight[[0, -1], :] = 0.0
    weight[:, [0, -1]] = 0.0
    start = (int(rng.integers(1, rows - 1)), int(rng.integers(1, cols - 1)))
    weight[start] = 1.0
    cost_map = CostMap(
        classes=np.where(weight > 0, FREE, OCCUPIED).astype(np.int8),
        clearance=weight,
        weight=weight,
        resolution=0.1,
        origin=(0.0, 0.0),
        start=start,
        suspect=np.zeros(weight.shape, dtype=np.bool_),
        plain=weight,
    )
    travel = travel_costs(cost_map)
    np.testing.assert_allclose(travel.cost, oracle(weight.astype(np.float64), start, 0.1), rtol=1e-4)
    assert (travel.step[~np.isfinite(travel.cost)] == -1).all()


def planned(classes, pose, target, **kwargs):
    belief = belief_of(classes, pose)
    cost_map = cost_maps.build(belief, PlannerConfig(**kwargs), ROBOT)
    travel = travel_costs(cost_map)
    cell = tuple(int(v) for v in cost_map.to_cells(np.array([target]))[0])
    return belief, cost_map, travel, cell


def test_path_in_the_open_is_straight():
    belief, cost_map, travel, cell = planned(room(8.0, 8.0), (1.5, 1.5, 0.0), (6.0, 5.0))
    path = shortest_path(cost_map, travel, cell, start=belief.pose)
    np.testing.assert_allclose(path[0], [1.5, 1.5])
    np.testing.assert_allclose(path[-1], [6.0, 5.0], atol=0.051)
    length = np.hypot(*np.diff(path, axis=0).T).sum()
    assert length == pytest.approx(np.hypot(*(path[-1] - path[0])), rel=0.01)
    assert np.hypot(*np.diff(path, axis=0).T).max() <= 0.1 + 1e-9


@pytest.mark.parametrize("door_m", [1.2, 0.9, 0.7])
def test_clearance_is_respected_everywhere(door_m):
    classes = two_rooms(door_m)
    fill(classes, 5.0, 2.6, 6.0, 3.2)
    belief, cost_map, travel, cell = planned(classes, (1.0, 1.0, 0.0), (6.2, 3.5))
    path = shortest_path(cost_map, travel, cell, start=belief.pose)
    walls = belief.grid.to_points(np.argwhere(belief.grid.classes() == OCCUPIED))
    dense = resample(path, 0.01)
    away = np.abs(dense[:, None] - walls[None]) - 0.025  # to the squares, by brute force
    gap = np.hypot(*np.moveaxis(np.maximum(away, 0.0), -1, 0)).min()
    # The follower's own margin lies within this, so the path can be driven with the body along it.
    assert gap >= ROBOT.inscribed_radius_m + 0.04
    assert gap >= min(0.5 * door_m, comfortable_clearance(PlannerConfig(), ROBOT, 0.01)) - 0.05


def test_a_gap_too_narrow_stays_shut():
    _, _, travel, cell = planned(two_rooms(0.45), (1.0, 1.0, 0.0), (6.0, 2.0))
    assert not np.isfinite(travel.cost[cell])
    with pytest.raises(ValueError, match="cannot be reached"):
        shortest_path(planned(two_rooms(0.45), (1.0, 1.0, 0.0), (6.0, 2.0))[1], travel, cell, start=np.zeros(2))


def test_a_narrow_gap_needs_a_sure_position():
    """A door of 0.7 m for a body of 0.38 m: the lattice takes some of it, 7 cm a side and 2σ the rest."""
    reached = []
    for sigma in (0.0, 0.05):
        belief = belief_of(two_rooms(0.7), (1.0, 1.0, 0.0), sigma=sigma)
        cost_map = cost_maps.build(belief, PlannerConfig(), ROBOT)
        cell = tuple(cost_map.to_cells(np.array([[6.0, 2.0]]))[0])
        reached.append(np.isfinite(travel_costs(cost_map).cost[cell]))
    assert reached == [True, False]


def test_walls_push_the_path_away():
    """Two ways of about equal length: the one along the wall costs more."""
    _, cost_map, _, _ = planned(room(6.0, 6.0), (3.0, 3.0, 0.0), (5.0, 5.0))
    weights = cost_map.weight[cost_map.start[0]]
    assert weights[cost_map.start[1]] == 1.0
    inner = weights[weights > 0]
    assert (np.diff(inner[: len(inner) // 2]) <= 1e-6).all()
    assert inner[0] == pytest.approx(1.0 + 1.0 + 3.0, abs=1.0)


def test_a_line_that_leaves_the_map_has_no_price():
    """A belief may put the robot outside of it: Numba wraps indices below zero, and reads on past the end."""
    weight, inside = np.ones((6, 8), np.float32), np.array([0.4, 0.3])
    for outside in ([-0.3, 0.3], [0.4, -0.3], [0.9, 0.3], [0.4, 0.7]):
        for a, b in ((inside, np.array(outside)), (np.array(outside), inside)):
            assert _segment(a, b, weight, weight, 0.1, np.zeros(2)) == (np.inf, 0.0)


def test_unknown_is_never_crossed():
    classes = half_known(8.0, 4.0, 4.0)
    belief, cost_map, travel, _ = planned(classes, (1.5, 2.0, 0.0), (6.0, 2.0))
    reached = cost_map.to_points(np.argwhere(np.isfinite(travel.cost)))
    assert reached[:, 0].max() < 4.0
    fine = belief.grid.classes()
    cells = belief.grid.to_cells(reached)
    assert (fine[cells[:, 0], cells[:, 1]] != UNKNOWN).all()


def test_a_robot_too_near_a_wall_gets_out():
    belief, cost_map, travel, cell = planned(room(6.0, 6.0), (0.25, 3.0, 0.5 * np.pi), (3.0, 3.0))
    assert cost_map.clearance[cost_map.start] < tight_clearance(PlannerConfig(), ROBOT, 0.01)
    path = shortest_path(cost_map, travel, cell, start=belief.pose)
    assert local_map(belief, 2.0).at(path[:10])[0] < local_map(belief, 2.0).at(path[:10])[-1]
