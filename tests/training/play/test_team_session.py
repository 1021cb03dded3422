"""``mecanum play --robots N``: one robot by hand, the others by agents; no end but the person's."""

from __future__ import annotations

import numpy as np
import pytest

from mecanum_env.team.picture import render_team
from tests.training.cli.test_bad_input import refused
from training.cli import main
from training.episodes.team import read_team
from training.play.controls import Command
from training.play.picture import PICTURE_SHAPE, play_picture
from training.play.team_session import TeamSession

REST = np.zeros(3, np.float32)


def session(robots: int = 2, **options: object) -> TeamSession:
    return TeamSession(team=read_team(robots=robots), **({"rooms": "apartment", "seed": 3} | options))


def test_the_person_drives_the_first_robot_alone() -> None:
    played = session()
    for _ in range(30):
        played.step(REST)
    mine, other = (member.truth.record.path_length_m for member in played.team.members)
    assert mine < 0.05 < 0.5 < other
    assert played.driver == "You drive the blue one" and played.team.members[0].knowledge.goal is None
    assert played.info["coverage"] == played.team.coverage_share
    played.obey(Command.HAND_OVER)
    for _ in range(30):
        played.step(REST)
    assert played.team.members[0].truth.record.path_length_m > 0.3
    assert played.team.members[0].knowledge.goal is not None
    picture = play_picture(played, steps_per_s=None)
    assert picture.shape == (*PICTURE_SHAPE, 3) and np.array_equal(picture[40:], render_team(played.team))


def test_it_goes_on_when_all_is_mapped() -> None:
    played = session(rooms="rectangular", agent="brisk-tour")
    played.team.active = []  # as when the team has covered all
    for _ in range(3):
        played.step(REST)
    assert played.info["time_s"] == pytest.approx(0.3)


def test_commands_start_teams() -> None:
    played = session()
    played.step(REST)
    played.obey(Command.NEXT_ROOM)
    assert played.seed == 4 and played.info["time_s"] == 0.0 and len(played.team.members) == 2
    assert played.env is played.team.members[0]
    above_the_panels = played.frame()[:40]
    played.obey(Command.NEXT_BACKEND)
    assert np.any(played.frame()[:40] != above_the_panels), "the backend is named"


def test_the_command(pygame: object, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["play", "--robots", "3", "--rooms", "rectangular", "--frames", "5", "--speed", "100"]) == 0
    assert "rectangular, seed 0, invariant-ekf: 0.5 s" in capsys.readouterr().out
    assert "is for several robots" in refused(["play", "--starts", "scattered"], capsys)
