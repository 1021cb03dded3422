from __future__ import annotations

import json
from pathlib import Path

import pytest

from training.cli import main
from training.studies.teams.merging import RIGHT_M, run_job, summarise


def test_two_robots_and_what_is_said_of_them() -> None:
    job = ("apartment", 3, 0.7, 60.0)
    row = run_job(job)
    assert 0.0 < row["overlap"] <= 1.0 and min(row["coverages"]) >= 0.7
    assert row["known"]["outcome"] == "right" and row["known"]["off_m"] < RIGHT_M
    # Corners that are nowhere near a true one are the falsest.
    json.dumps(row)
    odd = {**row, "known": {**row["known"], "corners_nowhere": 2}}
    said, more = (summarise({job: one})["known"] for one in (row, odd))
    assert row["known"]["corners_nowhere"] == 0
    assert more["false_corners"] == said["false_corners"] + 2 and more["corners"] == said["corners"] + 2
    none = {**row, "unknown": {"outcome": "none"}}
    summary = summarise({job: row, ("apartment", 4, 0.7, 60.0): none})
    assert summary["unknown"]["none"] == 1 and summary["known"]["right"] == 2
    assert summary["unknown"]["overlap_of_none"] == row["overlap"]


def test_rooms_that_there_are_not_are_refused_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["study", "merging", "--rooms", "apartmnt", "--out", str(tmp_path)]) == 2
    assert "did you mean 'apartment'" in capsys.readouterr().err and not any(tmp_path.iterdir())
