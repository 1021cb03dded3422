"""Robots that hold each other up: one makes way, and both get where they want."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from agents.base import Goal
from agents.explorer import Candidates, Explorer
from agents.ways.cost_map import CostMaps, PlannerConfig, build
from agents.ways.giving_way import GivingWay, GivingWayConfig, costs_from
from agents.ways.planning import travel_costs
from mecanum_env.config import ROBOT_PRESETS, RobotConfig
from mecanum_env.rooms.floor_plan import FloorPlan
from mecanum_env.team.team import Team
from slam.belief import Belief, Teammate
from tests.agents.grids import belief_of, fill, room
from tests.agents.teams.teams import run, touched

ROBOT = RobotConfig()


def corridor_with_bay() -> np.ndarray:
    """10 m long and 1.2 m wide, with a bay on the far side of x = 7 m."""
    classes = room(10.0, 4.0)
    fill(classes, 0.0, 1.2, 10.0, 4.0)
    fill(classes, 7.0, 1.2, 8.6, 3.0, 0)
    return classes


def meeting(
    own: tuple[float, float], other: tuple[float, float], goal, robot: int = 1, *, heard_s: float = 0.0
) -> Belief:
    told = None if goal is None else np.array(goal)
    mate = Teammate(1 - robot, np.array([*other, 0.0]), 0.0, told, heard_s=heard_s)
    return replace(belief_of(corridor_with_bay(), (*own, 0.0)), teammates=(mate,), robot=robot)


def test_it_waits_in_the_bay_that_is_off_the_others_way():
    belief = meeting((5.0, 0.6), (4.0, 0.6), (9.4, 0.6))
    cost_map = build(belief, PlannerConfig(), ROBOT)
    found = GivingWay(GivingWayConfig(), ROBOT).refuge(cost_map, belief, belief.teammates[0])
    assert found is not None
    travel, cell = found
    x, y = cost_map.to_points(np.array([cell]))[0]
    assert 7.0 < x < 8.6 and y > 0.6 + 2 * ROBOT.circumscribed_radius_m
    assert travel.cost[cell] < 8.0


def test_there_is_no_place_behind_the_other_and_none_is_needed_beside_its_way():
    giving = GivingWay(GivingWayConfig(), ROBOT)
    enclosed = meeting((1.0, 0.6), (2.0, 0.6), (0.4, 0.6))  # the bay lies beyond the other
    cost_map = build(enclosed, PlannerConfig(), ROBOT)
    assert giving.refuge(cost_map, enclosed, enclosed.teammates[0]) is None
    beside = meeting((7.8, 2.4), (6.5, 0.6), (9.4, 0.6))
    assert giving.refuge(build(beside, PlannerConfig(), ROBOT), beside, beside.teammates[0]) is None


@pytest.mark.parametrize(("robot", "goal", "speed", "after_s"), [
    (1, (9.4, 0.6), 0.0, 0.8), (0, (9.4, 0.6), 0.0, 4.0), (1, None, 0.0, 4.0), (1, (9.4, 0.6), 0.5, None),
    (0, (9.4, 0.6), None, 0.8), (0, None, None, None),
])  # fmt: skip
def test_who_gives_way_and_when(robot, goal, speed, after_s):
    giving, belief = GivingWay(GivingWayConfig(), ROBOT), meeting((5.0, 0.6), (4.0, 0.6), goal, robot)
    asked = [giving.asked(belief, speed, 0.1) is not None for _ in range(60)]
    assert (asked.index(True) + 1 if True in asked else None) == (None if after_s is None else round(10 * after_s))


def test_large_robots_hold_each_other_up_though_their_centres_are_far_apart():
    """Nose to nose, 0.2 m between the bodies."""
    large = RobotConfig(length_m=1.4, width_m=0.8, wheelbase_m=1.1, track_m=0.6)
    belief = meeting((5.6, 0.6), (4.0, 0.6), (9.4, 0.6))
    for speed in (0.0, None):
        giving = GivingWay(GivingWayConfig(), large)
        asked = [giving.asked(belief, speed, 0.1) is not None for _ in range(60)]
        assert asked.index(True) + 1 == 8
    afar = meeting((6.7, 0.6), (4.0, 0.6), (9.4, 0.6))
    for speed, reached in ((0.0, False), (None, True)):  # without a goal it looks farther
        giving = GivingWay(GivingWayConfig(patience_s=0.1), large)
        assert (giving.asked(afar, speed, 0.1) is not None) is reached


def test_robots_of_the_usual_size_look_as_far_as_the_settings_say():
    for away, speed, asked in ((1.29, 0.0, True), (1.31, 0.0, False), (1.99, None, True), (2.01, None, False)):
        giving = GivingWay(GivingWayConfig(patience_s=0.1), ROBOT)
        belief = meeting((4.0 + away, 0.6), (4.0, 0.6), (9.4, 0.6))
        assert (giving.asked(belief, speed, 0.1) is not None) is asked


def test_a_slow_robot_takes_the_time_that_it_needs_to_get_out_of_the_way():
    belief = meeting((5.0, 0.6), (4.0, 0.6), (9.4, 0.6))
    lasts_s = []
    for max_speed_m_s in (0.8, 0.15):
        agent = Commuter(step_s=0.1, robot=RobotConfig(max_speed_m_s=max_speed_m_s))
        agent.reset(belief)
        agent.to = belief.pose[:2]  # it has nothing to do
        while agent.status != "giving way":
            assert agent._time < 1.0
            agent.act(None, belief)
        lasts_s.append(agent._giving_way.until_s - agent._time)
        way_m = np.hypot(*np.diff(agent.goal.path, axis=0).T).sum()
        assert way_m > 2.0  # into the bay
        assert lasts_s[-1] > 3.0 + way_m / max_speed_m_s
    assert lasts_s[0] < 12.0


@pytest.mark.parametrize(("robot", "speed", "after_s"), [(1, 0.0, 0.8), (0, 0.0, 4.0), (0, None, 0.8)])
def test_one_that_is_not_heard_is_let_past_as_long_as_it_moves(robot, speed, after_s):
    giving = GivingWay(GivingWayConfig(), ROBOT)
    belief = meeting((5.0, 0.6), (4.0, 0.6), None, robot, heard_s=np.inf)
    asked = [giving.asked(belief, speed, 0.1) is not None for _ in range(200)]
    assert asked.index(True) + 1 == round(10 * after_s)
    assert any(asked[100:]) is (speed is not None)  # one without a goal makes way for none that stands
    cost_map = build(belief, PlannerConfig(), ROBOT)
    found = giving.refuge(cost_map, belief, belief.teammates[0])
    assert found is not None
    x, y = cost_map.to_points(np.array([found[1]]))[0]
    assert 7.0 < x < 8.6 and y > 1.2  # in the bay: it will come by here


@pytest.mark.parametrize("askew", [-0.07, 0.07])
def test_two_abreast_in_a_corridor_make_way_along_it_all_the_same(askew):
    """In line with both is a wall a metre and a half on: one that went no farther would be in the way."""
    belief = meeting((3.0, 0.6 + askew), (2.35, 0.6 - askew), None, heard_s=np.inf)
    cost_map = build(belief, PlannerConfig(), ROBOT)
    found = GivingWay(GivingWayConfig(), ROBOT).refuge(cost_map, belief, belief.teammates[0])
    assert found is not None
    assert cost_map.to_points(np.array([found[1]]))[0, 0] > 5.5


def test_nobody_gives_way_to_one_that_has_ended():
    """It will not pass: it is an obstacle."""
    giving, belief = GivingWay(GivingWayConfig(), ROBOT), meeting((5.0, 0.6), (4.0, 0.6), (9.4, 0.6))
    ended = replace(belief, teammates=(belief.teammates[0]._replace(ended=True),))
    assert not any(giving.asked(ended, 0.0, 0.1) for _ in range(60))


def test_ways_lead_round_another_and_are_as_before_when_it_has_gone():
    alone = belief_of(room(6.0, 6.0), (1.0, 3.0, 0.0))
    among = replace(alone, teammates=(Teammate(1, np.array([2.5, 3.0, 0.0]), 0.0),))
    maps = CostMaps(PlannerConfig(), ROBOT)
    before = maps.of(alone).weight.copy()
    cost_map = maps.of(among)
    row, col = (int(v) for v in cost_map.to_cells(np.array([[2.5, 3.0]]))[0])
    assert cost_map.weight[row, col] == before[row, col] + 6.0
    np.testing.assert_array_equal(maps.of(alone).weight, before)


@pytest.mark.parametrize("robot", [ROBOT_PRESETS["cavity"], ROBOT, RobotConfig(length_m=1.2, width_m=0.9)])
def test_another_is_as_large_as_the_robot_itself(robot):
    alone = belief_of(room(8.0, 8.0), (1.0, 4.0, 0.0))
    among = replace(alone, teammates=(Teammate(1, np.array([3.5, 4.0, 0.0]), 0.0),))
    config, maps = PlannerConfig(), CostMaps(PlannerConfig(), robot)
    before = maps.of(alone).weight.copy()
    cost_map = maps.of(among)
    dearer = np.argwhere(cost_map.weight > before)
    away = np.hypot(*(cost_map.to_points(dearer) - (3.5, 4.0)).T).max()
    beside = robot.inscribed_radius_m + robot.circumscribed_radius_m + config.robot_margin_m
    assert beside - 1.5 * cost_map.resolution < away <= beside + 1e-9


def test_costs_from_elsewhere_are_those_that_a_robot_there_would_have():
    cost_map = build(belief_of(room(6.0, 6.0), (1.0, 3.0, 0.0)), PlannerConfig(), ROBOT)
    start = tuple(int(v) for v in cost_map.to_cells(np.array([[4.0, 2.0]]))[0])
    found = costs_from(cost_map, np.array([4.0, 2.0]))
    assert found is not None
    np.testing.assert_array_equal(found.cost, travel_costs(replace(cost_map, start=start)).cost)
    assert costs_from(cost_map, np.array([-3.0, -3.0]), within_m=0.2) is None


class Commuter(Explorer):
    """Drives to one place [m, in the belief's frame] and stays there."""

    to = np.zeros(2)

    def pick(self, candidates: Candidates, belief: Belief) -> int:
        raise NotImplementedError

    def choose(self, belief: Belief) -> Goal | None:
        cost_map = self._cost_maps.of(belief)
        travel = travel_costs(cost_map)
        reached = np.argwhere(np.isfinite(travel.cost))
        away = np.hypot(*(cost_map.to_points(reached) - self.to).T)
        if np.hypot(*(belief.pose[:2] - self.to)) < 0.3:
            self._target = None
            return None
        row, column = reached[int(np.argmin(away))].tolist()
        path = self._path(cost_map, travel, (row, column), belief)
        self._target = self.to
        return Goal(pose=np.array([*path[-1], 0.0]), path=path)

    def _is_frontier(self, belief: Belief, point) -> bool:
        return True


@pytest.mark.parametrize("model", ["unlimited", "none"])
@pytest.mark.parametrize("seed", [0, 2])
@pytest.mark.parametrize("bay", [3.0, 4.2])
@pytest.mark.parametrize("order", [1, -1])
def test_two_that_meet_in_a_corridor_get_past_each_other(bay, order, seed, model):
    """Wherever the bay is, whoever of the two has right of way, and whether or not they hear each other."""
    left, right = bay, bay + 1.6
    walls = [
        [0.0, 0.0, 9.0, 0.0], [9.0, 0.0, 9.0, 1.2], [9.0, 1.2, right, 1.2], [right, 1.2, right, 2.8],
        [right, 2.8, left, 2.8], [left, 2.8, left, 1.2], [left, 1.2, 0.0, 1.2], [0.0, 1.2, 0.0, 0.0],
    ]  # fmt: skip
    free = np.zeros((56, 180), np.bool_)
    free[:24] = True
    free[:, round(left / 0.05) : round(right / 0.05)] = True
    starts = np.array([[0.8, 0.6, 0.0], [8.2, 0.6, 0.0]])[::order]
    plan = FloorPlan(name="bay", walls=np.array(walls), free=free, resolution=0.05, start=tuple(starts[0]))
    team = Team(
        robots=2, floor_plan=plan, config={"coverage_target": 1.0}, team={"communication": {"model": model}}
    )
    observed = team.reset(seed=seed, options={"start_poses": starts})
    crew = {}
    for member in team.members:
        crew[member.number] = agent = Commuter(step_s=0.1)
        agent.reset(member.belief)
        agent.to = starts[1 - member.number][:2] - starts[0][:2]  # the frame is that of the first robot's start

    def announce(k: int) -> object:
        goal = crew[k].goal
        return None if goal is None else goal.pose[:2].copy()

    run(
        team,
        lambda k, seen, belief: crew[k].act(seen, belief),
        observed,
        700 if model == "unlimited" else 1000,
        announce,
    )
    assert touched(team) == 0
    for member in team.members:
        there = starts[1 - member.number][:2]
        assert np.hypot(*(member.truth.world.pose[:2] - there)) < 0.8
