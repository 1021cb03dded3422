"""How the EKF family is set: what it takes for landmarks, and how observations are matched with them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

from slam.backend import BackendConfig
from slam.landmarks.book import LandmarkPolicy
from slam.settings import OneOf, Positive, Within

__all__ = ["ASSOCIATIONS", "EkfConfig", "EkfLinesConfig"]

ASSOCIATIONS = ("nearest", "individual", "joint")
"""How observations are matched: each to the nearest landmark within its gate; only where a single landmark is
within the gate; or as many as one pose can explain together (JCBB)."""

Association = Annotated[str, OneOf(ASSOCIATIONS)]


@dataclass(frozen=True, kw_only=True)
class EkfConfig(BackendConfig):
    """EKF-SLAM: gating and landmark management."""

    association: Association = "nearest"  # or "individual", "joint": see ASSOCIATIONS
    gate: Positive = 11.83  # squared Mahalanobis: 99.7 % of chi-square with two degrees of freedom
    # The same for observations with ids: a finite one refuses misread labels.
    known_gate: Annotated[float, Within("(0, inf]")] = math.inf
    max_turn_deg: Annotated[float, Within("[0, 180]")] = 35.0  # difference in a corner's direction
    # Old landmarks expected no better than to this count only together.
    loop_sigma_m: Annotated[float, Within("(0, inf]")] = math.inf
    lines: bool = False  # take straight walls for landmarks, too
    wheel_states: bool = True  # estimate what lasts of the odometry's errors, where ``lasting`` tells of it
    # 1σ of walls about the building's direction, if most stand square: slam.landmarks.right_angles; 0: left alone.
    right_angle_sigma_rad: Annotated[float, Within("[0, 0.003]")] = 0.001
    landmarks: LandmarkPolicy = field(default_factory=LandmarkPolicy)


@dataclass(frozen=True, kw_only=True)
class EkfLinesConfig(EkfConfig):
    """EKF-SLAM over walls and what corners say beside them."""

    lines: bool = True
    # What two landmarks could have made is left alone: a wall's corners lie close together, and one taken for
    # another bends the map. Over apartments of the training seeds 100-149 at three times the noise, the average
    # pose NEES/3 was 1.15 with the nearest and 1.00 so; at nominal noise the error was the same.
    association: Association = "individual"
    loop_sigma_m: Annotated[float, Within("(0, inf]")] = 0.02  # ledges at doors stand apart by a few times that
