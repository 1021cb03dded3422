"""When robots meet and where; on the way to an appointment, and waiting there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from agents.teams.rendezvous import Rendezvous
from mecanum_env.config import RobotConfig
from slam.belief import Belief, Teammate
from tests.agents.grids import belief_of, half_known

OF_TWO = {"teammates": np.zeros((1, 6))}


def standing(x: float, age_s: float | None, *, ended: bool = False) -> Belief:
    """Where the robot is, the meeting place at x = 0; the other was last heard so long ago near that, or never."""
    mates = () if age_s is None else (Teammate(1, np.array([0.0, -1.0, 0.0]), age_s, ended=ended, heard_s=age_s),)
    return replace(belief_of(half_known(), (x, 0.0, 0.0), origin=(-1.0, -2.0)), teammates=mates, robot=0)


def agent_of(appointments: dict[str, float], **config: object) -> Rendezvous:
    agent = Rendezvous({"appointments": appointments, "frontiers": {"view_range_m": 1.0}, **config})
    agent.reset(standing(0.0, 0.0))
    return agent


def words(places: list[float], **appointments: float) -> list[str]:
    """What a robot says of itself that heard the other at x = 0, and then at these places no more."""
    agent = agent_of(appointments)
    agent.act(OF_TWO, standing(0.0, 0.0))
    said = []
    for x in places:
        agent.act(OF_TWO, standing(x, 5.0))
        said.append(agent.status)
    return said


def test_who_does_not_get_on_the_way_to_the_meeting_backs_off():
    moving, stopped = [2.4, 2.6] * 50, [2.6] * 60
    said = words(moving + stopped, every_s=10.0, wait_s=30.0)
    assert set(said[90:130]) == {"meeting"} and "recovering" in said[130:]


def test_who_has_waited_at_the_meeting_place_is_not_stuck_when_it_leaves():
    said = words([0.0] * 120, every_s=2.0, wait_s=3.0)
    assert set(said[20:45]) == {"meeting"} and "recovering" not in said[45:70]


def test_the_time_between_appointments_doubles():
    said = words([0.0, 0.1] * 240, every_s=6.0, wait_s=3.0)
    met = np.array([word == "meeting" for word in said])
    for begins, ends in ((60, 90), (180, 210), (420, 450)):
        assert met[begins + 12 : ends - 2].mean() > 0.8  # it has to turn round first, or backs off
        assert not met[ends + 12 : 2 * ends - 20].any()


@pytest.mark.parametrize(("max_speed_m_s", "early"), [(0.8, False), (0.15, True)])
def test_a_slow_robot_leaves_off_in_time_to_be_there(max_speed_m_s, early):
    """It is 2.5 m off, and at 0.15 m/s has to set off half a minute before: halfway to the appointment."""
    agent = Rendezvous(
        {"appointments": {"every_s": 40.0}, "frontiers": {"view_range_m": 1.0}},
        robot=RobotConfig(max_speed_m_s=max_speed_m_s),
    )
    agent.reset(standing(0.0, 0.0))
    said = []
    for step in range(210):
        agent.act(OF_TWO, standing(2.4 + 0.2 * (step % 2), 5.0))
        said.append(agent.status)
    assert ("meeting" in said) is early


@pytest.mark.parametrize("last", [12, 28, 32, 50])
def test_robots_agree_on_whether_they_have_met_whenever_they_choose(last):
    """They hear each other up to some step; from halfway to the appointment (3 s) on they are as good as met."""
    for replan_s in (0.7, 1.0, 1.7):
        agent = agent_of({"every_s": 6.0, "wait_s": 3.0}, patience={"replan_s": replan_s})
        said = []
        for step in range(85):
            agent.act(OF_TWO, standing(0.0, max(step - last, 0) * 0.1))
            said.append(agent.status)
        assert ("meeting" in said) is (last < 30)


def test_robots_that_know_of_nobody_meet_at_one_place():
    places = []
    for x in (0.5, 2.4):
        agent = agent_of({"every_s": 1.0})
        for _ in range(20):
            agent.act(OF_TWO, standing(x, None))
        assert agent.goal is not None and agent.status == "meeting"
        places.append(agent.goal.pose[:2])
    assert np.hypot(*(places[0] - places[1])) < 0.15 and np.hypot(*places[0]) < 0.15


def test_nobody_is_met_who_has_ended():
    agent = agent_of({"every_s": 1.0})
    for step in range(40):
        agent.act(OF_TWO, standing(0.0, 0.1 * step, ended=True))
        assert agent.status != "meeting"
