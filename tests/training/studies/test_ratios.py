"""Ratios of means from a benchmark's rows."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from training.cli import main
from training.studies.ratios import ratio, table

FIELDS = ("suite", "place", "seed", "agent", "time_to_95_s", "time_s", "ate_rmse_m", "corner_mean_m", "limit_s")


def write(path, rows):
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(FIELDS)
        writer.writerows(rows)


def test_the_table_is_of_means_over_shared_seeds(tmp_path, capsys):
    rows = [["caves", "cave", s, "one", 10 + s, 20, 0.002, "", 300] for s in range(4)]
    rows += [["caves", "cave", s, "two", "", 40, 0.004, "", 300] for s in range(4)]
    rows += [["rooms", "rectangular", 0, "one", 1, 1, 1, 1, 300]]
    write(tmp_path / "episodes.csv", rows)
    two = table(tmp_path / "episodes.csv", "caves", "one").splitlines()[-1]
    # Never reached: the limit. No corners in caves: nothing to compare.
    expected = "| `two` | 300.0 | 40.0 | 4.0 | – | 0.04 [0.04, 0.04] | 0.50 [0.50, 0.50] | 0.50 [0.50, 0.50] |  |"
    assert two == expected
    assert main(["study", "ratios", str(tmp_path), "--suite", "caves", "--agent", "one"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == expected


@pytest.mark.filterwarnings("error")
def test_over_a_mean_of_nothing_there_is_no_ratio(tmp_path):
    rows = [["caves", "cave", s, "one", 10 + s, 20, 0.002, 0.01, 300] for s in range(4)]
    rows += [["caves", "cave", s, "known", 10, 20, 0.0, 0.0 if s else 0.01, 300] for s in range(4)]
    write(tmp_path / "episodes.csv", rows)
    *_, ate, corners = table(tmp_path / "episodes.csv", "caves", "one").splitlines()[-1].strip("| ").split(" | ")
    # Some resamples of the corners are of nothing but zeros.
    assert (ate, corners) == ("–", "4.00")


def test_backends_and_teams_are_told_apart(tmp_path, capsys):
    fields = (*FIELDS, "slam", "robots", "communication")
    with (tmp_path / "episodes.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(fields)
        for slam, robots, factor in (("ekf", "", 1), ("odometry", "", 2), ("ekf", "2", 4)):
            for seed in range(3):
                writer.writerow(
                    ["caves", "cave", seed, "one", factor, 1, 1, 1, 300, slam, robots, robots and "range"]
                )
    found = table(tmp_path / "episodes.csv", "caves", "one@ekf").splitlines()
    assert [line.split("|")[1:3] for line in found[2:]] == [
        [" `one@ekf` ", " 1.0 "], [" `one@odometry` ", " 2.0 "], [" `one@ekf ×2` ", " 4.0 "],
    ]  # fmt: skip
    assert main(["study", "ratios", str(tmp_path), "--suite", "caves", "--agent", "one"]) == 2
    assert "one@ekf, one@odometry" in capsys.readouterr().err


def test_the_interval_holds_the_true_ratio_nearly_always():
    rng = np.random.default_rng(0)
    held = 0
    for _ in range(200):
        common = rng.gamma(4.0, 1.0, 50)
        found = ratio(0.7 * common * rng.uniform(0.8, 1.2, 50), common)
        held += found.low <= 0.7 <= found.high
    assert held >= 180


@pytest.mark.parametrize("text", [None, "suite,agent\ncaves,one\n"])
def test_what_cannot_be_read_is_said_in_one_line(tmp_path, capsys, text):
    if text is not None:
        (tmp_path / "episodes.csv").write_text(text)
    assert main(["study", "ratios", str(tmp_path), "--suite", "caves"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_an_agent_without_rows_is_named(tmp_path, capsys):
    write(tmp_path / "episodes.csv", [["caves", "cave", 0, "one", 1, 1, 1, 1, 300]])
    assert main(["study", "ratios", str(tmp_path), "--suite", "caves", "--agent", "active"]) == 2
    assert "no rows of active on caves" in capsys.readouterr().err
