"""How many robots there are, where they begin, what they see and hear of each other."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from slam.settings import Config, Duration, Length, NotNegative, OneOf, Sigma, Within, require

__all__ = ["BELIEFS", "COMMUNICATION", "STARTS", "CommunicationConfig", "Robots", "SightingConfig", "TeamConfig"]

STARTS = ("together", "scattered")
BELIEFS = ("own", "joint")
COMMUNICATION = ("unlimited", "range", "line-of-sight", "walls", "none")

Robots = Annotated[int, Within("[1, 64]")]

_HALF_DEGREE, _TWO_DEGREES = math.radians(0.5), math.radians(2.0)


@dataclass(frozen=True, kw_only=True)
class CommunicationConfig(Config):
    """Who hears whom, and how often maps are exchanged; whoever hears one of a chain hears all of it."""

    # "line-of-sight": within range and nothing between that a lidar's beam ends at, wall or furniture;
    # "walls": each wall costs signal, furniture does not
    model: Annotated[str, OneOf(COMMUNICATION)] = "unlimited"
    range_m: Length = 10.0  # in the open
    wall_loss_db: NotNegative = 5.0  # of a wall in between
    path_loss: Annotated[float, Within("[0.01, 100]")] = 2.0  # exponent of the distance: 2 in the open
    every_s: Duration = 1.0  # between two exchanges of maps; poses and goals are told at every step


@dataclass(frozen=True, kw_only=True)
class SightingConfig(Config):
    """How well a robot measures another that its lidar sees (by a reflective marker): 1σ."""

    range_sigma_m: Sigma = 0.02
    bearing_sigma_rad: Sigma = _HALF_DEGREE
    heading_sigma_rad: Sigma = _TWO_DEGREES

    @property
    def sigmas(self) -> NDArray[np.float64]:
        """Range [m], bearing [rad] and relative heading [rad] ``(3,)``."""
        return np.array([self.range_sigma_m, self.bearing_sigma_rad, self.heading_sigma_rad])


@dataclass(frozen=True, kw_only=True)
class TeamConfig(Config):
    """A team of like robots."""

    robots: Robots = 3
    # Around the plan's start; or "scattered" over all that can be reached.
    starts: Annotated[str, OneOf(STARTS)] = "together"
    known_starts: bool = True  # every robot knows where the others start; else each has a frame of its own
    start_sigma_m: Annotated[float, Within("[0, 10]")] = 0.0  # how far off that knowledge is, 1σ of x and of y
    start_sigma_rad: Annotated[float, Within("[0, 10]")] = 0.0
    # Each robot a filter of its own; or "joint": one over all (slam.teams.centralised).
    belief: Annotated[str, OneOf(BELIEFS)] = "own"
    communication: CommunicationConfig = field(default_factory=CommunicationConfig)
    sighting: SightingConfig = field(default_factory=SightingConfig)

    @property
    def starts_exact(self) -> bool:
        """Whether beliefs share a frame, but for what they err by themselves."""
        return self.known_starts and self.start_sigma_m == 0.0 and self.start_sigma_rad == 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        joint = self.belief == "joint"
        all_known = self.known_starts and self.communication.model == "unlimited"
        require(
            not joint or all_known,
            "one belief over all robots (joint) needs known starts and unlimited communication, got known_starts "
            f"{self.known_starts} and {self.communication.model}; leave out what it is, or the joint belief",
        )
