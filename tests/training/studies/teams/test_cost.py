"""What a team's step takes."""

from __future__ import annotations

import json

import pytest

from training.cli import main


def test_a_step_is_measured_for_each_number_of_robots(capsys: pytest.CaptureFixture[str]) -> None:
    argv = ["study", "team-cost", "--robots", "1,2", "--seeds", "0", "--steps", "30"]
    assert main([*argv, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["robots"]
    assert set(found) == {"1", "2"}
    assert all(row["median_ms"] > 0.0 for row in found.values())
    assert main(argv) == 0
    assert "mean ms a robot" in capsys.readouterr().out
    assert main(["study", "team-cost", "--robots", "0"]) == 2
    assert "must be whole numbers in 1 … 64" in capsys.readouterr().err
    assert main([*argv[:2], "--robots", "64", "--seeds", "0", "--rooms", "rectangular", "--steps", "21"]) == 2
    assert "has room for 24 robots, not for 64" in capsys.readouterr().err
