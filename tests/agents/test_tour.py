"""Tours: as good as brute force where that is possible, covering all, and driven one leg at a time."""

from __future__ import annotations

from itertools import pairwise, permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import agents
from agents.stations.lattice import count_in_sight, in_sight, join, line_is_free, ways
from agents.tour import Outlook, Tour, TourConfig
from agents.ways import cost_map as cost_maps
from agents.ways.cost_map import PlannerConfig
from agents.ways.planning import travel_costs
from agents.ways.routing import best_tour, cover, draw_luck, improve, nearest_order, order_cost, tours_begun_with
from agents.ways.travel import between
from mecanum_env.config import LidarConfig, RobotConfig
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN
from tests.agents.grids import Walk, belief_of, fill, room, two_rooms

SHORT = {"view_range_m": 0.8}
seeds = st.integers(0, 2**31 - 1)


def places(seed: int, n: int) -> np.ndarray:
    points = np.random.default_rng(seed).uniform(0.0, 10.0, (n, 2))
    return np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1))


@settings(max_examples=40, deadline=None)
@given(seed=seeds, n=st.integers(2, 8), weight=st.sampled_from([0.0, 0.1, 1.0]))
def test_an_improved_order_is_hardly_ever_longer_than_the_best(seed, n, weight):
    distance = places(seed, n)
    weights = weight * np.random.default_rng(seed + 1).uniform(0.0, 1.0, n)
    order = nearest_order(distance)
    before = order_cost(distance, weights, order)
    cost = improve(distance, weights, order)
    assert sorted(order) == list(range(n)) and order[0] == 0
    assert cost == pytest.approx(order_cost(distance, weights, order)) and cost <= before + 1e-9
    best = min(order_cost(distance, weights, np.array((0, *rest))) for rest in permutations(range(1, n)))
    # A local search: all moves were tried in vain, which leaves little, and most often nothing.
    assert best - 1e-9 <= cost <= 1.15 * best + 1e-9


def test_improved_orders_are_the_best_ones_nearly_always():
    hits = 0
    for seed in range(60):
        distance = places(seed, 7)
        order = nearest_order(distance)
        cost = improve(distance, np.zeros(7), order)
        best = min(order_cost(distance, np.zeros(7), np.array((0, *p))) for p in permutations(range(1, 7)))
        hits += cost < best + 1e-6
    assert hits >= 54


def test_the_cost_of_an_order_by_hand():
    distance = np.array([[0.0, 1.0, 5.0], [1.0, 0.0, 2.0], [5.0, 2.0, 0.0]])
    assert order_cost(distance, np.zeros(3), np.array([0, 1, 2])) == 3.0
    # Reached after 1 and 3 m, at a price of 10 and 1 a metre.
    assert order_cost(distance, np.array([0.0, 10.0, 1.0]), np.array([0, 1, 2])) == 3.0 + 10.0 + 3.0


@settings(max_examples=60, deadline=None)
@given(seed=seeds, n=st.integers(2, 12), m=st.integers(1, 15), tries=st.integers(1, 4))
def test_a_tour_sees_all_that_can_be_seen(seed, n, m, tries):
    rng = np.random.default_rng(seed)
    sight = rng.random((n, m)) < 0.3
    sight[0] = False
    distance = places(seed, n)
    visible = sight.any(axis=0)
    chosen = cover(sight, distance[0], np.ones(n))
    assert 0 not in chosen and len(set(chosen)) == len(chosen)
    np.testing.assert_array_equal(sight[chosen].any(axis=0), visible)
    order, cost = best_tour(sight, distance, np.zeros(n), draw_luck(tries, n))
    assert order[0] == 0 and len(set(order)) == len(order)
    np.testing.assert_array_equal(sight[order].any(axis=0), visible)
    assert cost == pytest.approx(order_cost(distance, np.zeros(n), order))
    again, _ = best_tour(sight, distance, np.zeros(n), draw_luck(tries, n))
    np.testing.assert_array_equal(order, again)


def begun_with(outlook: Outlook, place: int, tries: int) -> float:
    """What the best tour found to begin with a place costs."""
    others = np.arange(len(outlook.sight)) != place
    distance = outlook.distance.copy()
    distance[0, others] += 1e6
    sight = np.column_stack([outlook.sight, ~others])  # what only this place sees, so that it must be on the tour
    return best_tour(sight, distance, outlook.weight, draw_luck(tries, len(sight)))[1]


@settings(max_examples=30, deadline=None)
@given(seed=seeds, n=st.integers(2, 6))
def test_the_cost_of_a_tour_that_begins_somewhere_against_all_that_do(seed, n):
    """Every place sees one piece of its own, so that a tour is an order of them all."""
    distance, rng = places(seed, n), np.random.default_rng(seed)
    weight = rng.uniform(0.0, 1.0, n) * (np.arange(n) > 0)
    outlook = Outlook(np.arange(n - 1), np.eye(n, dtype=bool)[:, 1:], distance, weight)
    for place in range(1, n):
        others = [k for k in range(1, n) if k != place]
        best = min(order_cost(distance, weight, np.array((0, place, *rest))) for rest in permutations(others))
        assert best - 1e-9 <= begun_with(outlook, place, 2) <= 1.15 * best + 1e-9
    order, cost = outlook.tour(2)
    assert begun_with(outlook, int(order[1]), 2) == pytest.approx(cost, rel=0.15)


@settings(max_examples=40, deadline=None)
@given(seed=seeds, n=st.integers(2, 6))
def test_what_a_tour_loses_by_beginning_somewhere_else_against_all_that_do(seed, n):
    rng = np.random.default_rng(seed)
    distance, weight = places(seed, n), rng.uniform(0.0, 1.0, n)
    sight = np.eye(n, dtype=bool)  # each alone sees a piece: all are on every tour
    sight[0] = False
    outlook = Outlook(np.arange(n - 1), sight, distance, weight)
    order, _ = outlook.tour(2)
    costs = tours_begun_with(sight, distance, weight, order)
    for place in range(1, n):
        others = [i for i in range(1, n) if i != place]
        best = min(order_cost(distance, weight, np.array((0, place, *rest))) for rest in permutations(others))
        assert best - 1e-9 <= costs[place] <= 1.15 * best + 1e-9
    losses = outlook.losses_m(order)
    assert losses[order[1] - 1] == 0.0
    np.testing.assert_allclose(losses * (1.0 + weight.sum()), costs[1:] - costs[order[1]], atol=1e-9)


def test_a_place_that_is_put_first_makes_those_idle_that_see_no_more_than_it():
    sight = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], dtype=bool)
    distance = 3.0 * (1.0 - np.eye(4))
    order = np.array([0, 1, 2])
    # By 1 or 2 first the other is left to see; from 3 there is nothing left.
    assert tours_begun_with(sight, distance, np.zeros(4), order).tolist() == [0.0, 6.0, 6.0, 3.0]


def test_a_tour_can_be_made_to_begin_with_a_place_that_it_does_not_need():
    sight = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], dtype=bool)
    distance = np.array([[0, 3, 3, 1], [3, 0, 6, 2], [3, 6, 0, 2], [1, 2, 2, 0]], dtype=float)
    outlook = Outlook(np.arange(3), sight, distance, np.zeros(4))
    assert begun_with(outlook, 3, 3) == 1.0 and begun_with(outlook, 1, 3) == 3.0 + 2.0


def test_one_place_that_sees_both_is_enough():
    sight = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], dtype=bool)
    distance = np.array([[0, 3, 3, 1], [3, 0, 6, 2], [3, 6, 0, 2], [1, 2, 2, 0]], dtype=float)
    order, cost = best_tour(sight, distance, np.zeros(4), draw_luck(3, 4))
    assert order.tolist() == [0, 3] and cost == 1.0


# ---- stations --------------------------------------------------------------------------------------------------


def test_lines_and_sight_against_brute_force():
    rng = np.random.default_rng(0)
    classes = np.where(rng.random((30, 30)) < 0.15, OCCUPIED, FREE).astype(np.int8)
    cells, points = rng.integers(0, 30, (20, 2)), rng.integers(0, 30, (25, 2))

    def free(a, b):
        count = max(abs(b - a))
        line = [np.floor(a + i / count * (b - a) + 0.5).astype(int) for i in range(count)]
        return all(classes[tuple(cell)] == FREE for cell in line)

    expected = np.array([[np.hypot(*(p - c)) < 12.0 and free(c, p) for p in points] for c in cells])
    np.testing.assert_array_equal(in_sight(classes, cells, points, 12.0), expected)
    np.testing.assert_array_equal(count_in_sight(classes, cells, points, 12.0), expected.sum(axis=1))


def test_hops_go_round_a_wall():
    classes = np.full((11, 21), FREE, np.int8)
    classes[0:6, 9] = OCCUPIED  # open in the rows below
    index = np.arange(15).reshape(3, 5)
    lattice = np.argwhere(index >= 0)
    cells = lattice * 5
    joined = join(classes, cells, lattice, index, 2)
    assert not line_is_free(classes, 0, 5, 0, 10)
    assert index[0, 2] not in joined[index[0, 1]] and index[0, 1] in joined[index[0, 0]]
    assert index[0, 2] in joined[index[0, 4]] and index[0, 1] not in joined[index[0, 4]]
    for i, row in enumerate(joined):
        assert all(i in joined[j] for j in row if j >= 0)  # both ways
    length, before = ways(cells, joined, 0)
    assert length[index[0, 4]] > 20.0  # the straight line is 20 cells long
    way = [index[0, 4]]
    while before[way[-1]] >= 0:
        way.append(before[way[-1]])
    assert way[-1] == 0
    legs = sum(float(np.hypot(*(cells[a] - cells[b]))) for a, b in pairwise(way))
    assert legs == pytest.approx(length[index[0, 4]])
    # Two stations down it is one hop, or two of the same length that look once more.
    assert before[index[2, 0]] == index[1, 0] and before[index[1, 0]] == 0


def test_costs_between_places():
    belief = belief_of(two_rooms(0.9), (1.0, 2.0, 0.0))
    cost_map = cost_maps.build(belief, PlannerConfig(), RobotConfig())
    travel = travel_costs(cost_map)
    reachable = np.argwhere(np.isfinite(travel.cost))
    cells = np.vstack([np.array(cost_map.start), reachable[:: len(reachable) // 6]])
    costs = between(cost_map, travel, cells)
    np.testing.assert_allclose(costs[0], travel.cost[tuple(cells.T)], rtol=1e-5)
    np.testing.assert_allclose(costs, costs.T, rtol=1e-5)
    np.testing.assert_allclose(np.diag(costs), 0.0, atol=1e-4)
    straight = np.hypot(*(cells[:, None] - cells[None]).transpose(2, 0, 1)) * cost_map.resolution
    assert (costs >= straight - 1e-3).all()


# ---- the agent -------------------------------------------------------------------------------------------------


def test_settings_are_checked():
    for bad in ({"hold_m": -1.0}, {"places": 0}, {"stations": {"hop": 0}}, {"stations": {"spacing_m": -1.0}}):
        with pytest.raises(ValueError, match="must be"):
            agents.make("tour", config=bad)
    assert agents.make("tour", config={"tries": 2}).config == TourConfig(tries=2)


def test_takes_the_small_corner_along_before_the_long_way():
    """A near pocket to the left, and far more to the right: what lies behind is fetched first, not at the end."""
    classes = room(14.0, 4.0)
    fill(classes, 0.0, 0.0, 1.0, 4.0, UNKNOWN)
    fill(classes, 12.0, 0.0, 14.0, 4.0, UNKNOWN)
    belief = belief_of(classes, (4.0, 2.0, 0.0))
    agent = agents.make("tour", config={"frontiers": SHORT, "hurry": 0.0})
    agent.reset(belief)
    goal = agent.choose(belief)
    assert goal is not None and goal.pose[0] < 4.0
    np.testing.assert_allclose(goal.path[0], belief.pose[:2])
    np.testing.assert_allclose(goal.path[-1], goal.pose[:2])


def test_holds_on_to_a_tour_that_costs_hardly_more():
    classes = room(10.0, 4.0)
    fill(classes, 0.0, 0.0, 1.0, 4.0, UNKNOWN)
    fill(classes, 9.0, 0.0, 10.0, 4.0, UNKNOWN)
    agent = agents.make("tour", config={"frontiers": SHORT, "hurry": 0.0})
    first = belief_of(classes, (4.9, 2.0, 0.0))
    agent.reset(first)
    assert agent.choose(first).pose[0] < 4.9
    assert agent.choose(belief_of(classes, (5.1, 2.0, 0.0))).pose[0] < 4.9
    assert agent.choose(belief_of(classes, (8.0, 2.0, 0.0))).pose[0] > 8.0


def test_stops_on_stations_only():
    classes = np.full((60, 120), FREE, np.int8)
    classes[[0, -1], :] = OCCUPIED
    classes[:, 0] = OCCUPIED
    classes[:, 90:] = UNKNOWN
    belief = belief_of(classes, (0.2, 0.2, 0.0), resolution=0.4, origin=(-8.0, -12.0))
    config = {
        "stations": {"spacing_m": 4.0},
        "planner": {"resolution_m": 0.4},
        "frontiers": {"view_range_m": 12.0},
    }
    agent = agents.make("tour", config=config, robot={"length_m": 0.1, "width_m": 0.8})
    agent.reset(belief)
    goal = agent.choose(belief)
    assert goal is not None
    hops = (goal.pose[:2] - 0.2) / 4.0
    np.testing.assert_allclose(hops, np.round(hops), atol=1e-9)
    assert goal.pose[0] > 10.0


class AsksForAll(Tour):
    """The tour, with ways to every frontier searched for at every choice."""

    def _costs_asked(self) -> None:
        return None


@pytest.mark.parametrize("seed", range(3))
def test_choices_are_those_made_with_ways_to_everywhere(seed, monkeypatch):
    monkeypatch.setattr("agents.explorer._WITHIN_M", 0.5)
    config = {"places": 2, "frontiers": {"far_m": 1.0, "min_unknown_m2": 0.01}}
    walk, within = Walk(seed), []
    lidar = LidarConfig()
    some, every = (kind(config, robot=RobotConfig(), lidar=lidar, step_s=0.1) for kind in (Tour, AsksForAll))
    for agent in (some, every):
        agent.reset(walk.go(1), seed)
    for _ in range(12):
        belief = walk.go(2)
        goals = []
        for agent in (some, every):
            agent.looked(belief)
            goals.append(agent.choose(belief))
            if goals[-1] is not None and agent is some:
                within.append(agent._within_m)
        assert (goals[0] is None) == (goals[1] is None) and some.status == every.status
        if goals[0] is not None:
            np.testing.assert_array_equal(goals[0].path, goals[1].path)
            np.testing.assert_array_equal(goals[0].pose, goals[1].pose)
    assert within and max(within) > min(within)  # it was not always as far as the least
