from __future__ import annotations

import json
from pathlib import Path

import pytest

from training.cli import main


def test_shared_maps_cost_less_than_copies_and_are_the_same_filter(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["--out", str(tmp_path / "out"), "--particles", "20,5", "--steps", "20", "--rooms", "rectangular"]
    assert main(["study", "dp-slam-cost", *argv, "--limit-mb", "60"]) == 0
    rows = json.loads((tmp_path / "out" / "dp_slam_cost.json").read_text())["rows"]
    assert [row["particles"] for row in rows] == [5, 20]
    for row in rows:
        assert row["shared"]["nodes"] <= 2 * row["particles"] - 1
        assert row["shared"]["mb"] < 0.7 * row["copies_mb"]
        if row["copies"] is not None:
            assert row["copies"]["last_pose"] == row["shared"]["last_pose"]
            assert row["copies"]["mb"] == pytest.approx(row["copies_mb"])
    assert rows[0]["copies"] is not None
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"dp_slam_cost.json", "memory.png", "time.png"}
    assert "shared MB" in capsys.readouterr().out


@pytest.mark.parametrize("bad", [["--particles", "0"], ["--particles", "a"], ["--rooms", "castle"]])
def test_bad_input_is_one_line(bad: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["study", "dp-slam-cost", "--out", str(tmp_path / "out"), *bad]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not (tmp_path / "out").exists()
