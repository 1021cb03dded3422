"""How many robots there are, where they begin, what they see and hear of each other."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from slam.settings import not_negative, positive, require, unknown_name

__all__ = ["BELIEFS", "COMMUNICATION", "STARTS", "CommunicationConfig", "SightingConfig", "TeamConfig"]

STARTS = ("together", "scattered")
BELIEFS = ("own", "joint")
COMMUNICATION = ("unlimited", "range", "line-of-sight", "walls", "none")


@dataclass(frozen=True, kw_only=True)
class CommunicationConfig:
    """Who hears whom, and how often maps are exchanged; whoever hears one of a chain hears all of it."""

    model: str = "unlimited"  # "line-of-sight": within range and no wall between; "walls": each wall costs signal
    range_m: float = 10.0  # in the open
    wall_loss_db: float = 5.0  # of a wall in between
    path_loss: float = 2.0  # exponent of the distance: 2 in the open
    every_s: float = 1.0  # between two exchanges of maps; poses and goals are told at every step

    def __post_init__(self) -> None:
        if self.model not in COMMUNICATION:
            raise unknown_name("communication model", self.model, COMMUNICATION)
        positive(self, "range_m", "path_loss", "every_s")
        not_negative(self, "wall_loss_db")


@dataclass(frozen=True, kw_only=True)
class SightingConfig:
    """How well a robot measures another that its lidar sees (by a reflective marker): 1σ."""

    range_sigma_m: float = 0.02
    bearing_sigma_rad: float = math.radians(0.5)
    heading_sigma_rad: float = math.radians(2.0)

    def __post_init__(self) -> None:
        positive(self)

    @property
    def sigmas(self) -> NDArray[np.float64]:
        """Range [m], bearing [rad] and relative heading [rad] ``(3,)``."""
        return np.array([self.range_sigma_m, self.bearing_sigma_rad, self.heading_sigma_rad])


@dataclass(frozen=True, kw_only=True)
class TeamConfig:
    """A team of like robots."""

    robots: int = 3
    starts: str = "together"  # around the plan's start; or "scattered" over all that can be reached
    known_starts: bool = True  # every robot knows where the others start; else each has a frame of its own
    start_sigma_m: float = 0.0  # how far off that knowledge is, 1σ of x and of y
    start_sigma_rad: float = 0.0
    belief: str = "own"  # each robot a filter of its own; or "joint": one over all (slam.teams.centralised)
    communication: CommunicationConfig = field(default_factory=CommunicationConfig)
    sighting: SightingConfig = field(default_factory=SightingConfig)

    @property
    def starts_exact(self) -> bool:
        """Whether beliefs share a frame, but for what they err by themselves."""
        return self.known_starts and self.start_sigma_m == 0.0 and self.start_sigma_rad == 0.0

    def __post_init__(self) -> None:
        require(1 <= self.robots <= 64, f"TeamConfig.robots must be 1 to 64, got {self.robots}")
        if self.starts not in STARTS:
            raise unknown_name("way to start", self.starts, STARTS)
        if self.belief not in BELIEFS:
            raise unknown_name("belief of a team", self.belief, BELIEFS)
        not_negative(self, "start_sigma_m", "start_sigma_rad")
        joint = self.belief == "joint"
        all_known = self.known_starts and self.communication.model == "unlimited"
        require(not joint or all_known, "TeamConfig.belief joint needs known_starts and unlimited communication")
