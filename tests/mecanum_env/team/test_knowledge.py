"""What a robot knows of where the others are, and how well."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mecanum_env.team.team import Team
from tests.mecanum_env.team.test_team import _hall

STILL = np.zeros(3, np.float32)


def _sigmas(team: dict[str, Any], headings: tuple[float, float]) -> list[float]:
    """What each of two says of where the other is, 4 m apart in a hall, after a step."""
    two = Team(2, team=team, lidar={"field_of_view_deg": 120.0, "beams": 180})
    starts = np.array([(4.0, 3.0, headings[0]), (8.0, 3.0, headings[1])])
    two.reset(seed=0, options={"floor_plan": _hall(), "start_poses": starts})
    two.step({0: STILL, 1: STILL})
    return [member.belief.teammates[0].sigma_m for member in two.members]


@pytest.mark.parametrize("belief", ["own", "joint"])
def test_what_is_told_is_known_as_well_as_the_starts_are(belief: str) -> None:
    """Back to back they do not see each other."""
    rough = {"belief": belief, "start_sigma_m": 0.3, "start_sigma_rad": 0.035}
    own, other = _sigmas(rough, (np.pi, 0.0))
    assert 0.2 < own < 0.6 and 0.2 < other < 0.6
    assert _sigmas({"belief": belief}, (np.pi, 0.0)) == [0.0, 0.0]


def test_what_is_seen_is_known_well_however_the_starts_are_known() -> None:
    assert _sigmas({"start_sigma_m": 0.3, "start_sigma_rad": 0.035}, (0.0, np.pi)) == [0.0, 0.0]
