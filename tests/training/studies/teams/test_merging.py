from __future__ import annotations

from training.studies.teams.merging import RIGHT_M, run_job, summarise


def test_two_robots_and_what_is_said_of_them() -> None:
    job = ("apartment", 3, 0.7, 60.0)
    row = run_job(job)
    assert 0.0 < row["overlap"] <= 1.0 and min(row["coverages"]) >= 0.7
    assert row["known"]["outcome"] == "right" and row["known"]["off_m"] < RIGHT_M
    none = {**row, "unknown": {"outcome": "none"}}
    summary = summarise({job: row, ("apartment", 4, 0.7, 60.0): none})
    assert summary["unknown"]["none"] == 1 and summary["known"]["right"] == 2
    assert summary["unknown"]["overlap_of_none"] == row["overlap"]
