"""``mecanum study scale`` on a small plan: figures by area, a picture, and going on where it stopped."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import pytest

from tests.training.plans import write_room
from training.cli import main
from training.episodes import explore
from training.studies.costs import scale


def test_a_room_is_explored_and_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    monkeypatch.setattr(scale, "explore", None)  # it is all there
    assert main(command) == 0


def test_an_exploration_that_was_broken_off_is_no_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken_off(episode: explore.Episode, *_: Any) -> None:
        episode.interrupted = True

    job = (str(write_room(tmp_path / "hall.png")), "nearest-frontier", 0, 1.0, str(tmp_path))
    for module in (scale, explore):  # the one that is measured, then the one before it
        monkeypatch.setattr(module, "run", broken_off)
        with pytest.raises(KeyboardInterrupt):
            scale.explore(job)


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
