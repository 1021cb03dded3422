"""Robots whose episode is over while the others' goes on, and what all of a team share."""

from __future__ import annotations

import numpy as np
import pytest

from mecanum_env.team.team import Team
from slam.grids.occupancy import UNKNOWN
from tests.mecanum_env.team.test_team import ALL, _drive, _hall
from training.episodes.recording import TeamRecorder

TOUCHED = ALL | {"terminate_on_collision": True}


@pytest.mark.parametrize("belief", ["own", "joint"])
def test_one_that_has_ended_goes_on_to_sense_and_believe(belief: str) -> None:
    team = Team(2, team={"belief": belief}, config=TOUCHED, max_steps=300)
    starts = np.array([(11.5, 3.0, 0.0), (6.0, 3.5, 0.0)])
    team.reset(seed=2, options={"floor_plan": _hall(), "start_poses": starts})
    ahead, slow = np.array([0.6, 0.0, 0.0], np.float32), np.array([-0.1, 0.0, 0.2], np.float32)
    while 0 in team.active:
        team.step({0: ahead, 1: slow})
    rows = len(team.members[0].truth.record)
    before = team.members[0].sightings
    for _ in range(40):
        assert set(team.step({1: slow})) == {1}
    ended, other = team.members
    assert len(ended.truth.record) == rows, "its own episode is over"
    assert ended.sightings and ended.sightings[0].measured[0] != before[0].measured[0], "it sees what is there now"
    error = np.hypot(*(ended.backend.pose - ended.truth.pose)[:2])
    assert error < 0.03
    ages = {mate.robot: mate.age_s for mate in ended.belief.teammates}
    assert ages[1] == pytest.approx(0.0) and other.belief.teammates[0].age_s == pytest.approx(0.0)


def test_what_touches_one_that_has_ended_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    team = Team(2, config=TOUCHED, max_steps=300)
    team.reset(seed=2, options={"floor_plan": _hall(), "start_poses": [(11.5, 3.0, 0.0), (6.0, 3.5, 0.0)]})
    ahead, still = np.array([0.6, 0.0, 0.0], np.float32), np.zeros(3, np.float32)
    while 0 in team.active:
        team.step({0: ahead, 1: still})
    ended = team.members[0].truth
    assert ended.record.collisions == 1
    monkeypatch.setattr(type(ended.world), "collisions", property(lambda _: 2))
    team.step({1: still})
    assert ended.record.collisions == 2


@pytest.mark.parametrize("belief", ["own", "joint"])
def test_one_that_has_ended_is_told_to_have_no_goal_and_to_be_done(belief: str) -> None:
    team = Team(2, team={"belief": belief}, config=TOUCHED, max_steps=300)
    team.reset(seed=2, options={"floor_plan": _hall(), "start_poses": [(11.5, 3.0, 0.0), (6.0, 3.5, 0.0)]})
    ahead, still = np.array([0.6, 0.0, 0.0], np.float32), np.zeros(3, np.float32)
    team.members[0].knowledge.goal = np.array([1.0, 2.0])
    while 0 in team.active:
        (mate,) = team.members[1].belief.teammates
        assert not mate.ended
        team.step({0: ahead, 1: still})
    team.step({1: still})
    (mate,) = team.members[1].belief.teammates
    assert mate.goal is None and mate.ended and mate.age_s == pytest.approx(0.0)
    (other,) = team.members[0].belief.teammates
    assert not other.ended


def test_who_writes_into_what_it_is_told_changes_nobody_else_s_belief() -> None:
    team = Team(3, rooms="apartment", max_steps=20)
    team.reset(seed=1)
    team.members[0].knowledge.goal = np.array([1.0, 2.0])
    _drive(team, 5)
    mate = next(m for m in team.members[1].belief.teammates if m.robot == 0)
    assert mate.goal is not None
    mate.pose[:], mate.goal[:] = 77.0, 77.0
    again = [next(m for m in team.members[k].belief.teammates if m.robot == 0) for k in (1, 2)]
    assert all(abs(m.pose[0]) < 20.0 and m.goal is not None and m.goal[0] == 1.0 for m in again)
    assert team.members[0].knowledge.goal[0] == 1.0


def test_one_map_is_recorded_whole_and_paid_for_once() -> None:
    team, recorder = Team(3, team={"belief": "joint"}, rooms="apartment", config=ALL, max_steps=50), TeamRecorder()
    team.reset(seed=3)
    recorder.take(team, [None] * 3)
    begun, paid = team.members[0].backend.grid.known_area_m2, 0.0
    rng = np.random.default_rng(0)
    for _ in range(50):
        outcomes = team.step({k: rng.uniform(-1, 1, 3).astype(np.float32) for k in team.active})
        paid += sum(outcome.info["reward_terms"]["area"] for outcome in outcomes.values())
        recorder.take(team, [None] * 3)
    grid = team.members[0].backend.grid
    gain = (grid.known_area_m2 - begun) * team.config.reward.area
    assert paid == pytest.approx(gain, rel=1e-6)
    classes, (row0, col0) = grid.classes(), grid.lattice_origin
    for recording in recorder.recording():
        told = {(r, c): now for change in recording.map_changes.values for r, c, now in change.tolist()}
        known = {(r + row0, c + col0): int(classes[r, c]) for r, c in np.argwhere(classes != UNKNOWN).tolist()}
        assert {cell: now for cell, now in told.items() if now != UNKNOWN} == known


def test_what_a_team_covers_is_up_to_date_however_seldom_maps_are_told() -> None:
    shares = []
    for every_s in (1.0, 30.0):
        seldom = {"known_starts": False, "communication": {"every_s": every_s}}
        team = Team(2, team=seldom, rooms="apartment", config=ALL, max_steps=60)
        team.reset(seed=4)
        _drive(team, 60, seed=5)
        shares.append(team.coverage_share)
    assert shares[0] == pytest.approx(shares[1], abs=1e-9)
