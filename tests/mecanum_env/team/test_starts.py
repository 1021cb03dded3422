"""Where the robots of a team begin."""

from __future__ import annotations

import numpy as np
import pytest

from mecanum_env.config import RobotConfig
from mecanum_env.rooms.files.importers import from_raster
from mecanum_env.rooms.floor_plan import FloorPlan, FloorPlanError
from mecanum_env.team.starts import start_poses

ROBOT = RobotConfig()
APART_M = 2.0 * ROBOT.circumscribed_radius_m + 0.4


def corridor(length_m: float) -> FloorPlan:
    """So narrow that robots stand in it one behind the other."""
    half = ROBOT.circumscribed_radius_m + 0.15
    free = np.zeros((round(2.0 * half / 0.05) + 10, round((length_m + 2.0 * half) / 0.05) + 10), bool)
    free[5:-5, 5:-5] = True
    return from_raster(free, name="corridor", resolution=0.05, start=(0.25 + half, 0.25 + half, 0.0))


@pytest.mark.parametrize("scattered", [False, True])
def test_where_there_is_room_for_three_three_start(scattered: bool) -> None:
    """Though the second of them, where it is drawn, may stand where it leaves none for the third."""
    plan = corridor(2.0 * APART_M + 0.15)
    for seed in range(20):
        poses = start_poses(plan, ROBOT, 3, scattered=scattered, rng=np.random.default_rng(seed))
        away = np.hypot(*(poses[:, None, :2] - poses[None, :, :2]).transpose(2, 0, 1))
        assert away[np.triu_indices(3, 1)].min() >= APART_M
    with pytest.raises(FloorPlanError, match="room for 3 robots, not for 4"):
        start_poses(plan, ROBOT, 4, scattered=scattered, rng=np.random.default_rng(0))
