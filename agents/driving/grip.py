"""How well the wheels tell the motion, learnt on the way; and how to drive as gently as they slip.

Nobody tells the agent on what floor it drives. What the wheels claim and what the filter makes of it, with the
landmarks' help, differ by the odometry's error: V's share of the wheels' speed (:mod:`slam.motion`), and what a
wheel that slips adds to it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from agents.driving.control import ControlConfig, PathFollower
from mecanum_env.config import RobotConfig
from slam.belief import Belief
from slam.motion import twist_between
from slam.settings import Config, PositiveShare, Rate, require
from slam.types import Array

__all__ = ["GentleFollower", "SlipConfig", "WheelWatch"]

_MEMORY = 200.0  # steps at full weight of what was expected before any was driven
_FORGET = 0.998  # share of the past that a step leaves: what was learnt fades over some fifty seconds


class WheelWatch:
    """Learns the odometry's error, as a share of the wheels' speed, from twists claimed and believed.

    Parameters
    ----------
    robot : RobotConfig
        Its limits scale the observation's twist; its lever turns a turn rate into a speed of the wheels.
    step_s : float
        Time between two observations [s].
    share : float
        The error that is expected before anything is driven.
    """

    def __init__(self, robot: RobotConfig, *, step_s: float, share: float) -> None:
        self._limits = np.array([robot.max_speed_m_s, robot.max_speed_m_s, robot.max_turn_rate_rad_s])
        self._lever, self._step_s, self._expected = robot.lever_m, step_s, share
        self.reset()

    def reset(self) -> None:
        """Forget what was learnt."""
        speed = 0.4  # m/s: what is expected weighs as much as so many steps at this speed
        self._driven = _MEMORY * speed**2
        self._missed = self._driven * self._expected**2
        self._pose: Array | None = None

    @property
    def share(self) -> float:
        """1σ of a linear component of the twist, as a share of the wheels' speed."""
        return math.sqrt(self._missed / self._driven)

    def look(self, observation: Mapping[str, Any] | None, belief: Belief) -> None:
        """Take in one step: the observation's ``twist``, where there is one, and where the belief has moved."""
        before, self._pose = self._pose, np.array(belief.pose, dtype=np.float64)
        if before is None or not isinstance(observation, Mapping) or "twist" not in observation:
            return
        claimed = np.asarray(observation["twist"], dtype=np.float64) * self._limits
        missed = claimed - twist_between(before, self._pose, self._step_s)
        wheels = np.array([1.0, 1.0, self._lever])
        self._driven = _FORGET * self._driven + float(np.sum((claimed * wheels) ** 2))
        # Three components of like variance. A jump of the whole estimate, a loop closed, is no slip.
        error = float(np.sum((missed * wheels) ** 2)) / 3.0
        self._missed = _FORGET * self._missed + min(error, 0.25)


@dataclass(frozen=True, kw_only=True)
class SlipConfig(Config):
    """How a floor found slippery is driven on: beyond what it grips wheels slide, and odometry tells less."""

    acceleration_m_s2: Rate = 1.0
    lateral_m_s2: Rate = 1.2  # in turns of the path
    firm_share: PositiveShare = 0.012  # of the wheels' speed: no greater error of the odometry is taken for slip …
    slippery_share: PositiveShare = 0.02  # … from here on it is driven as gently as it can be

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.firm_share < self.slippery_share,
            f"SlipConfig.firm_share {self.firm_share} must be below slippery_share {self.slippery_share}",
        )

    def eased(self, usual: ControlConfig, share: float) -> ControlConfig:
        """Return how to drive where odometry errs by ``share`` of the wheels' speed: as usual, or gentler."""
        slippery = float(np.interp(share, [self.firm_share, self.slippery_share], [0.0, 1.0]))
        gentle = {"acceleration_m_s2": self.acceleration_m_s2, "lateral_m_s2": self.lateral_m_s2}
        before = {name: getattr(usual, name) for name in gentle}
        return replace(usual, **{k: v + slippery * (min(v, gentle[k]) - v) for k, v in before.items()})


class GentleFollower(PathFollower):
    """Brakes to a stand where others drop their path."""

    _sent = (np.zeros(2), 0.0)

    def stand(self) -> None:
        """Take note that the robot was told to stand; the path stays."""
        super().stand()
        self._sent = (np.zeros(2), 0.0)

    def brake(self, observation: Mapping[str, Any] | None, belief: Belief) -> Array:
        """Return the next twist ``(3,)`` on the way to a stand: wheels stopped at once slide, and tell nothing."""
        self._velocity, self._turn = self._sent
        return self.drive(np.zeros(2), 0.0, observation, belief)

    def _send(self, velocity: Array, turn: float, *rest: Any) -> Array:
        sent = super()._send(velocity, turn, *rest)
        self._sent = (self._velocity, self._turn)
        return sent
