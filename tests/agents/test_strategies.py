"""Strategies that weigh what there is to see: on maps where it is known which way is right."""

from __future__ import annotations

import numpy as np
import pytest

import agents
from agents.nearest_frontier import NearestFrontier
from mecanum_env.config import RobotConfig
from mecanum_env.env import ExploreEnv
from slam.grids.occupancy import FREE, UNKNOWN
from tests.agents.grids import belief_of, drive, fill, half_known, room, two_rooms

WEIGHING = ("cost-utility", "next-best-view")
# These maps stand still: with the usual range their frontiers would count as seen from where the robot stands.
SHORT = {"view_range_m": 1.2}


def nook_and_hall(nook_m: float = 0.8) -> np.ndarray:
    """A known corridor, x from 0 to 10 m: a nook above x = 3 m, a hall from x = 8 m on, both unknown."""
    classes = room(14.0, 8.0)
    fill(classes, 0.05, 3.0, 8.0, 7.95)
    fill(classes, 3.0, 3.0, 3.0 + nook_m, 3.0 + nook_m, UNKNOWN)
    fill(classes, 8.0, 0.05, 13.95, 7.95, UNKNOWN)
    return classes


def chosen(name: str, classes: np.ndarray, x: float, y: float, config: dict | None = None, seed: int = 0):
    belief = belief_of(classes, (x, y, 0.0))
    agent = agents.make(name, config={"frontiers": SHORT} | (config or {}))
    agent.reset(belief, seed)
    return agent.choose(belief)


def driven(agent: agents.Agent, classes: np.ndarray, pose: np.ndarray, steps: int) -> np.ndarray:
    """Let an agent drive over a map that stands still, until it has no goal; return its last pose ``(3,)``."""
    agent.reset(belief_of(classes, tuple(pose)))
    for _ in range(steps):
        pose = drive(pose, agent.act(None, belief_of(classes, tuple(pose))), RobotConfig())
        if agent.goal is None:
            break
    return pose


@pytest.mark.parametrize("name", WEIGHING)
def test_a_hall_farther_away_before_a_nook_nearby(name):
    assert chosen("nearest-frontier", nook_and_hall(), 4.8, 1.5).pose[0] < 4.8
    assert chosen(name, nook_and_hall(), 4.8, 1.5).pose[0] > 5.5


@pytest.mark.parametrize(
    ("name", "config"), [("cost-utility", {"beta_m2_m": 50.0}), ("next-best-view", {"decay_1_m": 20.0})]
)
def test_where_the_way_is_all_that_counts_it_is_the_nook(name, config):
    assert chosen(name, nook_and_hall(), 4.8, 1.5, config).pose[0] < 4.8


@pytest.mark.parametrize("name", WEIGHING)
def test_of_two_alike_the_nearer_and_it_is_kept(name):
    classes = room(10.0, 4.0)
    fill(classes, 0.0, 0.0, 1.0, 4.0, UNKNOWN)
    fill(classes, 9.0, 0.0, 10.0, 4.0, UNKNOWN)
    agent = agents.make(name, config={"frontiers": SHORT})
    for x, side in ((3.5, -1), (6.5, 1)):
        belief = belief_of(classes, (x, 2.0, 0.0))
        agent.reset(belief)
        assert np.sign(agent.choose(belief).pose[0] - x) == side
    # A little past the middle: by itself it would go right, but it is on its way to the left.
    agent.reset(belief_of(classes, (4.8, 2.0, 0.0)))
    assert agent.choose(belief_of(classes, (4.8, 2.0, 0.0))).pose[0] < 4.8
    assert agent.choose(belief_of(classes, (5.2, 2.0, 0.0))).pose[0] < 4.8
    assert agent.choose(belief_of(classes, (8.0, 2.0, 0.0))).pose[0] > 7.0


@pytest.mark.parametrize("name", [*WEIGHING, "rrt"])
def test_a_frontier_that_never_yields_ends_it(name):
    """The map stands still whatever is looked at: the agent looks, from near enough, and ends."""
    classes = room(5.0, 4.0)
    fill(classes, 4.5, 1.5, 5.0, 2.5, UNKNOWN)
    pose = np.array([1.0, 2.0, 0.0])
    agent = agents.make(name, config={"frontiers": SHORT})
    pose = driven(agent, classes, pose, 400)
    assert agent.status == "covered"
    assert pose[0] > 2.5  # it did go there


@pytest.mark.parametrize(("x", "comes_back"), [(3.3, True), (7.3, False)])
def test_a_door_that_vanished_as_seen_from_afar_is_looked_at_when_nothing_else_is_left(x, comes_back):
    """From near by, that look has been had."""

    def hall(*doors: float) -> np.ndarray:
        classes = room(11.0, 4.0)
        fill(classes, 0.0, 0.0, 1.0, 4.0, UNKNOWN)
        fill(classes, 8.0, 0.0, 11.0, 4.0, UNKNOWN)
        for wall in (1.0, 8.0):
            fill(classes, wall - 0.1, 0.0, wall + 0.1, 4.0)
        for door in doors:
            half = 0.4 if door > 5.0 else 0.7
            fill(classes, door - 0.1, 2.0 - half, door + 0.1, 2.0 + half, FREE)
        return classes

    agent = agents.make("nearest-frontier", config={"frontiers": SHORT})
    agent.reset(belief_of(hall(8.0), (x, 2.0, 0.0)))
    assert agent.choose(belief_of(hall(8.0), (x, 2.0, 0.0))).pose[0] > 6.5
    assert agent.choose(belief_of(hall(1.0), (x, 2.0, 0.0))).pose[0] < 2.5  # the other, once that is gone
    for _ in range(3):
        goal = agent.choose(belief_of(hall(8.0), (x, 2.0, 0.0)))
        assert (goal is not None) == comes_back
        assert agent.status == ("driving" if comes_back else "covered")


@pytest.mark.parametrize(
    ("name", "config", "match"),
    [
        ("cost-utility", {"beta": 1.0}, "beta_m2_m"),
        ("cost-utility", {"beta_m2_m": -1.0}, "beta_m2_m"),
        ("cost-utility", {"depth_m": 0.0}, "depth_m"),
        ("next-best-view", {"decay": 1.0}, "decay_1_m"),
        ("next-best-view", {"spacing_m": 0.0}, "spacing_m"),
        ("next-best-view", {"switch_share": float("nan")}, "switch_share"),
        ("next-best-view", {"samples": -1}, "samples"),
    ],
)
def test_config_is_checked(name, config, match):
    with pytest.raises(ValueError, match=match):
        agents.make(name, config=config)


# ---- next best view ----------------------------------------------------------------------------------------


def alcove() -> np.ndarray:
    """A known room with a niche 2 m deep in its upper wall, its end unknown, and a wide hall beyond."""
    classes = room(9.0, 8.0)
    fill(classes, 0.05, 4.0, 8.95, 7.95)
    fill(classes, 4.0, 4.0, 5.2, 6.0, FREE)
    fill(classes, 0.05, 6.0, 8.95, 7.95, UNKNOWN)
    return classes


def test_a_sampled_place_sees_more_than_the_cheapest_one():
    """The cheapest view of the niche's end is from before it; a place in it looks round the corners."""
    plain = chosen("next-best-view", alcove(), 4.6, 1.5, {"samples": 0, "frontiers": {"view_range_m": 4.0}})
    sampled = chosen("next-best-view", alcove(), 4.6, 1.5, {"frontiers": {"view_range_m": 4.0}})
    assert sampled.pose[1] > plain.pose[1] + 0.5
    assert 4.0 < sampled.pose[0] < 5.2


def test_falls_back_on_the_frontiers_view_points():
    """A lattice too wide for any of its points to see the frontier."""
    config = {"samples": 1, "spacing_m": 30.0}
    with_one = chosen("next-best-view", half_known(), 1.5, 2.0, config)
    without = chosen("next-best-view", half_known(), 1.5, 2.0, {"samples": 0})
    np.testing.assert_array_equal(with_one.pose, without.pose)


def test_places_stay_where_they_are_when_the_map_grows():
    whole = half_known(10.0, 4.0, 6.0)
    smaller = whole[:, 10:].copy()
    agent = agents.make("next-best-view", config={"frontiers": SHORT})
    points = []
    for classes, origin in ((whole, (0.0, 0.0)), (smaller, (0.5, 0.0))):
        belief = belief_of(classes, (3.0, 2.0, 0.0), origin=origin)
        agent.reset(belief)
        own = agent._candidates(belief)
        targets = own.cost_map.to_cells(own.frontiers.targets)
        places = own.cost_map.to_points(agent._places(own.cost_map, own.travel, targets, 3.0))
        # Its cut-off side is a frontier, too: beyond the reach of that one they are the same.
        away = np.hypot(*(places[:, None] - own.frontiers.targets[None]).transpose(2, 0, 1)).min(axis=1)
        assert (away < 3.2).all()  # all of them near enough to see something
        points.append({tuple(p) for p in places.round(6) if p[0] > 4.0})
    assert points[0] and points[0] == points[1]


def test_more_places_than_are_weighed_are_drawn_by_the_seed():
    belief = belief_of(half_known(), (1.5, 2.0, 0.0))
    agent = agents.make("next-best-view", config={"frontiers": SHORT, "samples": 5, "spacing_m": 0.2})
    drawn = []
    for seed in (1, 1, 2):
        agent.reset(belief, seed)
        own = agent._candidates(belief)
        targets = own.cost_map.to_cells(own.frontiers.targets)
        drawn.append(agent._places(own.cost_map, own.travel, targets, 3.0))
    assert len(drawn[0]) == 5
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert not np.array_equal(drawn[0], drawn[2])


@pytest.mark.parametrize("name", ["nearest-frontier", "brisk-tour"])
def test_a_door_that_the_margin_for_an_unsure_position_closes_is_gone_through(name):
    classes = two_rooms(0.0)
    fill(classes, 3.9, 1.65, 4.1, 2.25, FREE)  # 0.3 m to either side: enough for the body, but not with the margin
    for sigma in (0.001, 1.0):
        agent = agents.make(name, config={"frontiers": SHORT})
        belief = belief_of(classes, (1.0, 2.0, 0.0), sigma=sigma)
        agent.reset(belief)
        goal = agent.choose(belief)
        assert goal is not None
        assert goal.pose[0] > 4.5
    assert agent.choose(belief_of(two_rooms(0.4), (1.0, 2.0, 0.0), sigma=1.0)) is None
    assert agent.status == "unreachable"


class Fickle(NearestFrontier):
    """Wants what is farthest, wherever it stands: on its way it changes its mind again and again."""

    def pick(self, candidates, belief):
        return int(np.argmax(np.where(np.isfinite(candidates.costs), candidates.costs, -1.0)))


@pytest.mark.parametrize(("doubts", "ends"), [(5, True), (10_000, False)])
def test_a_robot_does_not_go_to_and_fro_between_two_goals_for_ever(doubts, ends):
    classes = room(12.0, 4.0)
    fill(classes, 0.0, 0.0, 1.0, 4.0, UNKNOWN)
    fill(classes, 11.0, 0.0, 12.0, 4.0, UNKNOWN)
    pose = np.array([5.5, 2.0, 0.0])
    agent = Fickle({"frontiers": SHORT, "patience": {"doubts": doubts, "looks": 1}})
    driven(agent, classes, pose, 1200)
    assert (agent.goal is None) is ends


@pytest.mark.parametrize("name", ["cost-utility", "coordinated"])
def test_who_weighs_no_ways_goes_where_it_can_all_the_same(name):
    env = ExploreEnv(rooms="apartment")
    observation, _ = env.reset(seed=1)
    agent = agents.make(name, config={"beta_m2_m": 0.0})
    agent.reset(env.belief)
    for _ in range(150):
        observation, *_ = env.step(agent.act(observation, env.belief))
    assert env.truth.record.path_length_m > 2.0
