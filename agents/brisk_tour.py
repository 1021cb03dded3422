"""The tour, driven briskly: what the learned agents, which are driven alike, are to be compared with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from agents.driving.control import ControlConfig
from agents.tour import Tour, TourConfig
from mecanum_env.config import LidarConfig, RobotConfig
from slam.settings import from_mapping

__all__ = ["BRISK", "BriskTour", "BriskTourConfig"]

BRISK = ControlConfig(any_side=True, speed_share=1.0, near_wall_m_s=0.8, lateral_m_s2=2.0, acceleration_m_s2=2.0)
"""Whichever side leads, no slower beside walls than elsewhere, quick in turns: what is left is the check of the
braking distance."""


@dataclass(frozen=True, kw_only=True)
class BriskTourConfig(TourConfig):
    """The tour's, with another driver."""

    control: ControlConfig = BRISK


class BriskTour(Tour):
    """Goes to the first place of the best tour over all that is left to look at, and loses no time on the way."""

    def __init__(
        self,
        config: BriskTourConfig | Mapping[str, Any] | None = None,
        *,
        robot: RobotConfig | Mapping[str, Any] | str | None = None,
        lidar: LidarConfig | Mapping[str, Any] | str | None = None,
        step_s: float = 0.1,
    ) -> None:
        super().__init__(from_mapping(BriskTourConfig, config), robot=robot, lidar=lidar, step_s=step_s)
