"""``mecanum study scale`` on a small plan: figures by area, a picture, and going on where it stopped."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import pytest

from agents import make
from tests.training.plans import write_room
from training.cli import main
from training.episodes import explore
from training.studies.costs import scale


def test_a_room_is_explored_and_measured(tmp_path: Path) -> None:
    plan, out = write_room(tmp_path / "hall.png"), tmp_path / "out"
    command = ["study", "scale", str(plan), "--agent", "nearest-frontier", "--out", str(out)]
    assert main(command) == 0
    (found,) = json.loads((out / "scale.json").read_text())
    assert found["plan"] == "hall" and found["coverage"] > 0.95 and found["collisions"] == 0
    (row,) = found["rows"]
    assert 5.0 < row["area_m2"] < found["area_m2"] + 2.0
    assert row["steps"] == round(found["time_s"] / 0.1)
    assert row["step_ms"]["median"] < row["decision_ms"]["median"] <= row["decision_ms"]["p99"]
    picture = cv2.imread(str(out / "hall_nearest-frontier.png"))
    assert picture is not None and picture.shape[1] > 500
    (out / "hall_nearest-frontier.png").unlink()
    assert main(command) == 0
    assert not (out / "hall_nearest-frontier.png").exists(), "it is all there: nothing is run again"


def test_pictures_of_like_names_are_told_apart_and_lie_in_the_folder(tmp_path: Path) -> None:
    agents = ("tour", "/some/where/mine.safetensors", "/else/where/mine.safetensors")
    jobs = [(f"{folder}/hall.yaml", agent, 0, 1.0, "out") for folder in ("a", "b") for agent in agents]
    assert list(scale._pictures(jobs).values()) == [
        "hall_tour.png", "hall_mine.png", "hall_mine_2.png", "hall_tour_2.png", "hall_mine_3.png",
        "hall_mine_4.png",
    ]  # fmt: skip


def test_a_policy_s_file_explores_and_a_picture_that_cannot_be_written_costs_no_row(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    shipped = make("ppo-frontier").policy_path  # type: ignore[attr-defined]
    plan, out = write_room(tmp_path / "hall.png"), tmp_path / "out"
    (out / f"hall_{shipped.stem}.png").mkdir(parents=True)  # where the picture would be
    assert main(["study", "scale", str(plan), "--agent", str(shipped), "--minutes", "0", "--out", str(out)]) == 0
    (found,) = json.loads((out / "scale.json").read_text())
    assert found["agent"] == str(shipped) and found["end"] == "minutes"
    assert "no picture of hall.png" in capfd.readouterr().err


def test_an_exploration_that_was_broken_off_is_no_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken_off(episode: explore.Episode, *_: Any) -> None:
        episode.interrupted = True

    job = (str(write_room(tmp_path / "hall.png")), "nearest-frontier", 0, 1.0, str(tmp_path))
    for module in (scale, explore):  # the one that is measured, then the one before it
        monkeypatch.setattr(module, "run", broken_off)
        with pytest.raises(KeyboardInterrupt):
            scale.explore(job, picture="hall.png")


def test_what_was_typed_wrong_is_told_in_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["study", "scale", str(tmp_path / "none.yaml"), "--out", str(tmp_path)]) == 2
    assert "no such file" in capsys.readouterr().err
    plan, out = write_room(tmp_path / "hall.png"), tmp_path / "out"
    (tmp_path / "words.md").write_text("no plan")
    assert main(["study", "scale", str(plan), str(tmp_path / "words.md"), "--out", str(out)]) == 2
    assert "mecanum study scale: floor plan" in capsys.readouterr().err
    assert not out.exists()
    assert main(["study", "scale", str(plan), "--agent", "brisk", "--out", str(tmp_path)]) == 2
    assert "brisk-tour" in capsys.readouterr().err


def test_a_plan_may_be_called_what_a_chart_would_take_for_a_formula() -> None:
    rows = [{"area_m2": 10.0, "step_ms": {"median": 1.0}, "decision_ms": None}]
    assert scale._chart([{"plan": "a$_$", "agent": "tour", "rows": rows}])
