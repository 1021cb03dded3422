from __future__ import annotations

import math

from training.studies.teams.filters import SINGLE, TEAM, explore, table


def test_all_filters_are_fed_alike_and_the_joint_one_is_consistent() -> None:
    row = explore((3, 2, 40, 0.02, math.radians(0.5), "nominal"))
    assert set(row) == {TEAM, *SINGLE}
    for name, found in row.items():
        assert found["steps"] == 40
        assert len(found["nees"]) == len(found["ate_m"]) == 2
        assert max(found["nees"]) < 5
        assert max(found["ate_m"]) < 0.1
        assert (found["joint_nees"] is not None) == (name == TEAM)
    assert row[TEAM]["landmarks"][0] == row[TEAM]["landmarks"][1]
    assert row[TEAM]["joint_nees"] < 5
    lines = table([row]).splitlines()
    assert len(lines) == 1 + 2 * 3
    assert lines[1].startswith("centralised, first")


def test_one_robot_is_a_team_too() -> None:
    row = explore((3, 1, 15, 0.02, 0.01, "nominal"))
    assert row[TEAM]["ate_m"] == row["ekf-lines"]["ate_m"]
    assert row[TEAM]["nees"] == row["ekf-lines"]["nees"]
    assert "–" in table([row])
