"""What every agent owes in a team, and what the strategies for teams do."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import agents
from agents.teams.assigned import Assigned
from agents.teams.crew import Crew
from agents.ways.cost_map import CostMaps, PlannerConfig
from agents.ways.giving_way import costs_from
from mecanum_env.config import RobotConfig
from mecanum_env.team.team import Team
from slam.belief import Teammate
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN
from tests.agents.grids import belief_of, fill, room
from tests.agents.teams.teams import crew_of, explore, run, touched

NAMES = agents.names()
TEAMS = ("assigned", "coordinated", "rendezvous", "team-frontier", "team-tour")
PLANNING = tuple(name for name in NAMES if name not in ("random", "ppo"))


@pytest.mark.parametrize("name", NAMES)
def test_suite_in_a_team_of_three(name):
    def actions() -> list[np.ndarray]:
        team = Team(robots=3, rooms="maze", team={"communication": {"model": "range"}})
        sent = explore(team, name, seed=4, steps=100)
        assert [member.belief.robot for member in team.members] == [0, 1, 2]
        if name in PLANNING:
            assert touched(team) == 0
        return sent

    first, again = actions(), actions()
    assert len(first) == 100
    for sent, same in zip(first, again, strict=True):
        assert sent.shape == (3, 3) and sent.dtype == np.float32 and (np.abs(sent) <= 1.0).all()
        np.testing.assert_array_equal(sent, same)


def crossroads() -> np.ndarray:
    """A known middle with four arms that go on into the unknown."""
    classes = room(12.0, 12.0)
    fill(classes, 0.0, 0.0, 12.0, 12.0)
    fill(classes, 5.0, 1.0, 7.0, 11.0, 0)
    fill(classes, 1.0, 5.0, 11.0, 7.0, 0)
    for x, y in ((5.0, 0.0), (5.0, 11.0)):
        fill(classes, x, y, x + 2.0, y + 1.0, UNKNOWN)
    for x, y in ((0.0, 5.0), (11.0, 5.0)):
        fill(classes, x, y, x + 1.0, y + 2.0, UNKNOWN)
    return classes


def closed_off() -> np.ndarray:
    """The crossroads, and two places between the arms that were seen and that no way leads to."""
    classes = crossroads()
    for x in (1.5, 8.5):
        fill(classes, x, 1.5, x + 2.0, 3.0, 0)
        fill(classes, x, 1.0, x + 2.0, 1.5, UNKNOWN)
    return classes


def goals(name: str, poses: list[tuple[float, float, float]], config=None, classes=None) -> np.ndarray:
    """Where robots at these poses, who know of each other, go; each decides by itself."""
    classes = crossroads() if classes is None else classes
    chosen = []
    for k, pose in enumerate(poses):
        mates = tuple(Teammate(j, np.array(p), 0.0) for j, p in enumerate(poses) if j != k)
        belief = replace(belief_of(classes, pose), teammates=mates, robot=k)
        agent = agents.make(name, config=config)
        agent.reset(belief, 0)
        goal = agent.choose(belief)
        assert goal is not None
        chosen.append(goal.pose[:2])
    return np.array(chosen)


@pytest.mark.parametrize("classes", [crossroads(), closed_off()], ids=["all reachable", "some closed off"])
@pytest.mark.parametrize("name", TEAMS)
def test_each_goes_to_an_arm_of_its_own(name, classes):
    short = {"frontiers": {"view_range_m": 1.5}}
    config = {"driver": short} if name == "team-frontier" else short
    at = goals(name, [(6.0, 6.0, 0.0), (5.6, 5.2, 0.0), (6.5, 6.6, 0.0), (5.4, 6.5, 0.0)], config, classes)
    apart = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))[np.triu_indices(4, 1)]
    assert apart.min() > 2.0, at


@pytest.mark.parametrize("name", TEAMS)
def test_nothing_is_left_to_one_that_has_ended(name):
    """Though it stands before the only arm that there is still to see."""
    classes = crossroads()
    for x0, y0, x1, y1 in ((0, 5, 1, 7), (11, 5, 12, 7), (5, 0, 7, 1)):
        fill(classes, x0, y0, x1, y1)
    mate = Teammate(1, np.array([5.4, 9.5, 0.0]), 0.0)
    for ended in (False, True):
        crews = []
        agent = agents.make(name)
        agent._owned = lambda crew, found, crews=crews: crews.append(crew) or np.arange(len(crew.pieces))
        belief = replace(belief_of(classes, (6.0, 2.0, 0.0)), teammates=(mate._replace(ended=ended),), robot=0)
        agent.reset(belief, 0)
        assert agent.choose(belief) is not None
        assert bool(crews) is not ended  # alone, it shares nothing out


def test_a_cluster_that_one_cannot_reach_is_left_to_whoever_can():
    costs = np.array([[1.0, 4.0], [2.0, np.inf]])
    crew = Crew(
        robots=np.arange(2), own=0, pieces=np.arange(2), costs=costs, bound=np.full(2, -1),
        cells=np.zeros((2, 2), np.int64), travels=(),
    )  # fmt: skip
    found = cast(Any, SimpleNamespace(frontiers=SimpleNamespace(target_labels=np.arange(2))))
    assert Assigned()._owned(crew, found).tolist() == [1]


def test_places_that_the_first_cannot_get_to_are_as_far_apart_as_the_others_find():
    classes = np.full((80, 200), FREE, np.int8)
    classes[:, 98:102] = OCCUPIED  # robot 0 is to the left of a wall, robots 1 and 2 to the right
    cost_map = CostMaps(PlannerConfig(), RobotConfig()).of(belief_of(classes, (2.0, 2.0, 0.0)))
    starts = [np.array([x, y]) for x, y in ((2.0, 2.0), (6.0, 2.0), (9.0, 2.0))]
    travels = tuple(costs_from(cost_map, start) for start in starts)
    cells = cost_map.to_cells(np.array([[6.5, 1.0], [6.5, 3.0], [9.5, 2.0]]))
    costs = np.array([[travel.cost[tuple(cell)] for cell in cells] for travel in travels])
    crew = Crew(
        robots=np.arange(3), own=1, pieces=np.arange(3), costs=costs, bound=np.full(3, -1), cells=cells,
        travels=cast(Any, travels),
    )  # fmt: skip
    agent = agents.make("team-tour")
    assert agent._owned(crew, cast(Any, SimpleNamespace(cost_map=cost_map))).tolist() == [0, 1]


@pytest.mark.parametrize(("name", "alone"), [("team-tour", "brisk-tour"), ("team-frontier", "ppo-frontier")])
def test_alone_it_is_the_strategy_that_it_is_made_of(name, alone):
    def actions(name: str) -> list[np.ndarray]:
        return explore(Team(robots=1, rooms="apartment"), name, seed=3, steps=40)

    np.testing.assert_array_equal(actions(name), actions(alone))


def test_robots_that_do_not_hear_each_other_meet_when_it_is_time():
    communication = {"model": "range", "range_m": 3.0}
    apart: list[bool] = []
    team = Team(robots=3, rooms="maze", team={"communication": communication})
    observed = team.reset(seed=1)
    crew = crew_of(team, "rendezvous", 1, config={"appointments": {"every_s": 16.0}})

    def act(k, seen, belief):
        if k == 0:
            apart.append(len(set(team.groups.tolist())) > 1)
        return crew[k].act(seen, belief)

    run(team, act, observed, 280)
    assert any(apart[80:140])  # they had lost each other …
    together = [k for k in range(140, 280) if not apart[k]]
    assert together and together[0] <= 270  # … and met, when it was time or soon after
    assert touched(team) == 0
