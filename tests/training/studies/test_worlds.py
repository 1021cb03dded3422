"""``mecanum study worlds``: worlds drawn by lot are worlds; what goes wrong in one is listed and kept."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mecanum_env.config import from_toml
from training.cli import main
from training.episodes import explore
from training.studies import accuracy, worlds

FINE: worlds.Row = {
    "rooms": "cave", "agent": "brisk-tour", "coverage": 0.99, "time_to_95_s": 30.0, "time_s": 60.0,
    "end": "covered", "collisions": 0, "ate_rmse_m": 0.01, "anees": 1.0, "map_iou": 0.9,
    "lost_s": 0.0, "relocalisations": 0,
}  # fmt: skip


def test_every_seed_draws_a_world_of_its_own_and_always_the_same() -> None:
    drawn = [worlds.draw(seed, "ekf") for seed in range(200)]
    assert drawn == [worlds.draw(seed, "ekf") for seed in range(200)]
    assert len({str(world) for world, _ in drawn}) == 200
    assert {world.rooms for world, _ in drawn} == {"apartment", "rectangular", "corridors", "cave", "maze"}
    assert len({agent for _, agent in drawn}) == 4
    assert all(world.robot.wheelbase_m < world.robot.length_m <= 0.8 for world, _ in drawn)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({}, []),
        ({"coverage": 0.92, "time_to_95_s": None}, ["92.0 % covered"]),
        ({"collisions": 2}, ["2 contacts"]),
        ({"ate_rmse_m": 0.3, "anees": 7.0, "lost_s": 12.0}, ["30 cm off", "NEES/3 7.0", "lost for 12 s"]),
    ],
)
def test_what_went_wrong_is_said(change: worlds.Row, words: list[str]) -> None:
    assert worlds.wrong(FINE | change) == words


def test_worlds_are_explored_and_those_that_went_wrong_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worlds, "_LIMIT_S", 2.0)  # too short for any
    command = ["study", "worlds", "--seeds", "0:1", "--workers", "1", "--slam", "ekf", "--out", str(tmp_path)]
    assert main(command) == 0
    first = capsys.readouterr()
    assert "something went wrong in 2 of 2 worlds" in first.out and "worlds: 0/2" in first.err
    assert from_toml(tmp_path / "0_ekf.toml") == worlds.draw(0, "ekf")[0]
    assert len(json.loads((tmp_path / "summary.json").read_text())["wrong"]) == 2
    assert main(command) == 0
    again = capsys.readouterr()
    assert again.out == first.out and "worlds: 0/2" not in again.err, "nothing is run twice"


def test_who_knows_where_it_is_is_not_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["study", "worlds", "--slam", "truth", "--out", str(tmp_path / "out")]) == 2
    assert "there is nothing to ask" in capsys.readouterr().err and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("study", "job"), [(worlds, (0, "ekf")), (accuracy, ("rectangular", "ekf", 0, "nearest-frontier", "nominal"))]
)
def test_an_episode_that_was_broken_off_is_no_result(study, job, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(explore, "run", lambda episode, *_: setattr(episode, "interrupted", True))
    with pytest.raises(KeyboardInterrupt):
        study.run_job(job)
