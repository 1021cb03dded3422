"""A chooser's patience on large maps: how long a choice lasts, and how far ways are searched for."""

from __future__ import annotations

import numpy as np
import pytest

from agents.learned.choice import STATE
from agents.learned.chooser import Chooser
from mecanum_env.config import LidarConfig, RobotConfig
from slam.grids.occupancy import UNKNOWN
from tests.agents.grids import Walk, belief_of, fill, room


class AsksForAll(Chooser):
    """The chooser, with ways to every frontier searched for at every choice."""

    def _costs_asked(self) -> None:
        return None


def made(kind, **config):
    return kind(config, robot=RobotConfig(), lidar=LidarConfig(), step_s=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_what_is_shown_is_that_of_ways_to_everywhere_but_for_how_many_views_there_are(seed, monkeypatch):
    monkeypatch.setattr("agents.explorer._WITHIN_M", 0.5)
    monkeypatch.setattr("agents.learned.chooser._MANY", 2)
    settings = {
        "places": 2, "frontiers": {"far_m": 1.0, "min_unknown_m2": 0.01},
        "choice": {"most": 2, "uncertainty": False},
    }  # fmt: skip
    walk, within = Walk(seed), []
    some, every = made(Chooser, **settings), made(AsksForAll, **settings)
    for agent in (some, every):
        agent.reset(walk.go(1), seed)
    views = STATE.index("share_visited")
    for _ in range(12):
        belief = walk.go(2)
        short, whole = some.survey(belief), every.survey(belief)
        assert (short is None) == (whole is None)
        if short is None or whole is None:
            continue
        within.append(some._within_m)
        for name in ("index", "candidates", "patches", "distances"):
            np.testing.assert_array_equal(getattr(short, name), getattr(whole, name))
        np.testing.assert_array_equal(np.delete(short.state, views), np.delete(whole.state, views))
    assert within and max(within) > min(within)  # it was not always as far as the least


@pytest.mark.parametrize(("side_m", "lasts_s"), [(10.0, 0.3), (30.0, 2.0)])
def test_a_choice_lasts_longer_on_a_large_map(side_m, lasts_s):
    classes = room(side_m, side_m)
    fill(classes, 0.0, 0.0, 1.0, side_m, UNKNOWN)
    belief = belief_of(classes, (0.5 * side_m, 0.5 * side_m, 0.0))
    agent = made(Chooser, patience={"replan_s": 0.3})
    agent.reset(belief)
    waited = 0
    agent.take(agent.survey(belief), 0)
    agent.act(None, belief)
    while not agent.due(belief):
        agent.act(None, belief)
        waited += 1
    assert waited + 1 == pytest.approx(lasts_s / 0.1)


def test_where_there_is_nothing_to_choose_it_is_soon_looked_at_again():
    belief = belief_of(room(30.0, 30.0), (15.0, 15.0, 0.0))
    agent = made(Chooser, patience={"replan_s": 0.3})
    agent.reset(belief)
    assert agent.survey(belief) is None
    agent.act(None, belief)
    assert agent.goal is None and not agent.due(belief)
    for _ in range(2):
        agent.act(None, belief)
    assert agent.due(belief)
