"""On the way to an appointment, and waiting there: what is held for stuck and what is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from agents.teams.rendezvous import Rendezvous
from slam.belief import Belief, Teammate
from tests.agents.grids import belief_of, half_known


def standing(x: float, age_s: float) -> Belief:
    """Where the robot is; the other was last heard so long ago, beside the start."""
    mate = Teammate(1, np.array([1.0, 1.0, 0.0]), age_s)
    return replace(belief_of(half_known(), (x, 2.0, 0.0)), teammates=(mate,), robot=0)


def words(places: list[float], **appointments: float) -> list[str]:
    """What a robot says of itself that was at x = 1 m when it heard the other, and then at these places."""
    agent = Rendezvous({"appointments": appointments, "frontiers": {"view_range_m": 1.0}})
    agent.reset(standing(1.0, 0.0))
    agent.act(None, standing(1.0, 0.0))
    said = []
    for x in places:
        agent.act(None, standing(x, 5.0))
        said.append(agent.status)
    return said


def test_who_does_not_get_on_the_way_to_the_meeting_backs_off():
    moving, stopped = [3.4, 3.6] * 50, [3.6] * 60
    said = words(moving + stopped, every_s=10.0, wait_s=30.0)
    assert set(said[90:130]) == {"meeting"} and "recovering" in said[130:]


def test_who_has_waited_at_the_meeting_place_is_not_stuck_when_it_leaves():
    said = words([1.0] * 120, every_s=2.0, wait_s=8.0)
    assert set(said[10:90]) == {"meeting"} and said[110] == "driving" and "recovering" not in said
