"""The tour, driven briskly: what the learned agents, which are driven alike, are to be compared with."""

from __future__ import annotations

from dataclasses import dataclass

from agents.driving.control import ControlConfig
from agents.tour import Tour, TourConfig

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

    config_type = BriskTourConfig
