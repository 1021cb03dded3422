from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import agents
from agents.view_points.rrt_tree import Tree, mean_shift
from agents.ways import cost_map as cost_maps
from agents.ways.cost_map import CostMap, PlannerConfig
from mecanum_env.config import RobotConfig
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN
from tests.agents.grids import belief_of, fill, half_known, room, two_rooms

SHORT = {"view_range_m": 1.2}


def costs_of(classes: np.ndarray, pose=(1.5, 2.0, 0.0)) -> CostMap:
    return cost_maps.build(belief_of(classes, pose), PlannerConfig(), RobotConfig())


def draws(cost_map: CostMap, count: int, seed: int = 0) -> np.ndarray:
    size = np.array(cost_map.classes.shape[::-1]) * cost_map.resolution
    return np.random.default_rng(seed).uniform(cost_map.origin, np.asarray(cost_map.origin) + size, (count, 2))


def kinds_along(cost_map: CostMap, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Classes of the cells under points 1 mm apart; whoever steps over a corner is caught there."""
    count = 2 + int(np.hypot(*(b - a)) / 1e-3)
    cells = cost_map.to_cells(a + np.linspace(0.0, 1.0, count)[:, None] * (b - a))
    return cost_map.classes[cells[:, 0], cells[:, 1]]


def assert_edges_are_free(tree: Tree, cost_map: CostMap) -> None:
    nodes, parents = tree.nodes, tree.parents
    assert (parents <= np.arange(len(parents))).all()
    for i, parent in enumerate(parents):
        assert (kinds_along(cost_map, nodes[parent], nodes[i]) == FREE).all()


rasters = arrays(
    np.int8, st.tuples(st.integers(4, 40), st.integers(4, 40)), elements=st.sampled_from([-1, 0, 0, 0, 0, 100])
)


@settings(max_examples=25, deadline=None)
@given(rasters, rasters, st.integers(0, 9))
def test_edges_never_cross_walls_even_when_the_map_changes(before, after, seed):
    for classes in (before, after):
        classes[0, 0] = FREE
    cost_map = costs_of(np.kron(before, np.ones((4, 4), np.int8)), (0.1, 0.1, 0.0))
    tree = Tree(1.0, 200)
    tree.plant(np.array([0.1, 0.1]))
    hits = tree.grow(cost_map, draws(cost_map, 150, seed))
    assert_edges_are_free(tree, cost_map)
    cells = cost_map.to_cells(hits)
    assert (cost_map.classes[cells[:, 0], cells[:, 1]] == FREE).all()
    padded = np.pad(cost_map.classes, 1, constant_values=UNKNOWN)
    for row, col in cells:  # and beside the unknown
        assert (padded[row : row + 3, col : col + 3] == UNKNOWN).any()
    changed = costs_of(np.kron(after, np.ones((4, 4), np.int8)), (0.1, 0.1, 0.0))
    tree.prune(changed)
    assert_edges_are_free(tree, changed)
    tree.grow(changed, draws(changed, 50, seed))
    assert_edges_are_free(tree, changed)


def test_no_edge_slips_between_walls_that_touch_at_a_corner():
    classes = room(4.0, 4.0)
    fill(classes, 0.0, 2.0, 2.0, 2.2)
    fill(classes, 2.0, 1.8, 4.0, 2.0)
    cost_map = costs_of(classes, (1.0, 1.0, 0.0))
    tree = Tree(1.0, 500)
    tree.plant(np.array([1.0, 1.0]))
    tree.grow(cost_map, draws(cost_map, 400))
    assert len(tree.nodes) > 50
    assert tree.nodes[:, 1].max() < 2.01


def test_fills_the_room_and_finds_its_frontier():
    cost_map = costs_of(half_known())
    tree = Tree(1.0, 1000)
    tree.plant(np.array([1.5, 2.0]))
    hits = tree.grow(cost_map, draws(cost_map, 300))
    assert len(tree.nodes) > 50 and len(hits) > 5
    np.testing.assert_allclose(hits[:, 0], 4.0, atol=0.11)
    assert np.ptp(hits[:, 1]) > 2.0
    # The local tree shrinks back to the robot whenever it has found something.
    local = Tree(1.0, 1000)
    local.plant(np.array([3.5, 2.0]))
    assert len(local.grow(cost_map, draws(cost_map, 300), restart=True)) > 5
    assert len(local.nodes) < 0.7 * len(tree.nodes)
    # Full, it still finds what borders on the unknown.
    full = Tree(8.0, 1)
    full.plant(np.array([1.5, 2.0]))
    assert len(full.grow(cost_map, draws(cost_map, 100))) > 0 and len(full.nodes) == 1


def test_pruning_drops_what_hangs_on_a_lost_edge():
    classes = two_rooms(0.9)
    cost_map = costs_of(classes)
    tree = Tree(1.0, 2000)
    tree.plant(np.array([1.5, 2.0]))
    tree.grow(cost_map, draws(cost_map, 1500))
    nodes = tree.nodes
    assert (nodes[:, 0] > 4.2).sum() > 50
    fill(classes, 3.9, 0.0, 4.1, 4.0, OCCUPIED)  # the door is shut
    shut = costs_of(classes)
    tree.prune(shut)
    assert_edges_are_free(tree, shut)
    assert len(tree.nodes) > 50 and tree.nodes[:, 0].max() < 3.9
    assert {tuple(n) for n in tree.nodes} < {tuple(n) for n in nodes}


def test_mean_shift_finds_the_clusters():
    rng = np.random.default_rng(0)
    centres = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 2.0]])
    points = np.vstack([c + rng.normal(0.0, 0.1, (20, 2)) for c in centres])
    chosen = mean_shift(points, 0.6)
    assert len(chosen) == 3
    for centre in centres:
        assert np.hypot(*(points[chosen] - centre).T).min() < 0.1
    assert len(mean_shift(np.zeros((0, 2)), 0.6)) == 0


# ---- the agent ---------------------------------------------------------------------------------------------


def choices(seed: int, config: dict) -> tuple[np.ndarray, np.ndarray]:
    agent = agents.make("rrt", config={"frontiers": SHORT} | config)
    belief = belief_of(half_known(), (1.5, 2.0, 0.0))
    agent.reset(belief, seed)
    goals = [agent.choose(belief_of(half_known(), (x, 2.0, 0.0))).pose for x in (1.5, 1.8, 2.1)]
    return np.array(goals), agent.tree.nodes


def test_the_seed_gives_the_trees():
    (goals, nodes), (same_goals, same_nodes), (_, others) = choices(3, {}), choices(3, {}), choices(4, {})
    np.testing.assert_array_equal(goals, same_goals)
    np.testing.assert_array_equal(nodes, same_nodes)
    assert len(nodes) > 20 and not np.array_equal(nodes[: len(others)], others[: len(nodes)])


def test_without_trees_the_frontiers_are_weighed_all_the_same():
    goals, nodes = choices(0, {"draws": 0})
    assert len(nodes) == 1
    assert (goals[:, 0] > 2.0).all()


def test_revenue_and_its_hysteresis():
    """A hall to the right, a nook to the left and nearer: the weight of the gain decides."""
    classes = room(14.0, 4.0)
    fill(classes, 0.0, 0.0, 5.0, 4.0)
    fill(classes, 4.0, 1.5, 5.0, 2.5, UNKNOWN)
    fill(classes, 9.0, 0.05, 13.95, 3.95, UNKNOWN)
    belief = belief_of(classes, (6.4, 2.0, 0.0))
    for config, side in (
        ({"weight_m_m2": 5.0}, 1),
        ({"weight_m_m2": 0.0}, -1),
        ({"weight_m_m2": 0.3, "near_m": 2.0, "near_gain": 20.0}, -1),  # the nook alone is near
    ):
        agent = agents.make("rrt", config={"frontiers": SHORT} | config)
        agent.reset(belief)
        assert np.sign(agent.choose(belief).pose[0] - 6.4) == side


@pytest.mark.parametrize(
    ("config", "match"),
    [
        ({"stride": 1.0}, "stride_m"),
        ({"stride_m": 0.0}, "stride_m"),
        ({"draws": -1}, "draws"),
        ({"capacity": 0}, "capacity"),
        ({"near_gain": 0.5}, "near_gain"),
        ({"weight_m_m2": float("inf")}, "weight_m_m2"),
    ],
)
def test_config_is_checked(config, match):
    with pytest.raises(ValueError, match=match):
        agents.make("rrt", config=config)
