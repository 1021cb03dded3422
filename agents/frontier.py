"""Nearest frontier first (Yamauchi, 1997), by the cost of the way there."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from agents.explorer import Candidates, Explorer, ExplorerConfig
from mecanum_env.config import LidarConfig, RobotConfig
from slam.settings import from_mapping, require
from slam.types import Belief

__all__ = ["NearestFrontier", "NearestFrontierConfig"]


@dataclass(frozen=True, kw_only=True)
class NearestFrontierConfig(ExplorerConfig):
    """The parts of the agent, and how firmly it holds on to a goal."""

    switch_m: float = 0.5  # another frontier must be cheaper by this [weighted m] …
    switch_share: float = 0.15  # … and by this share of the present goal's cost, to be worth turning round

    def __post_init__(self) -> None:
        for name in ("switch_m", "switch_share"):
            value = getattr(self, name)
            require(math.isfinite(value) and value >= 0, f"NearestFrontierConfig.{name} must be ≥ 0, got {value}")


class NearestFrontier(Explorer):
    """Goes to the view point that is cheapest to reach, and on to the next as soon as it has seen."""

    def __init__(
        self,
        config: NearestFrontierConfig | Mapping[str, Any] | None = None,
        *,
        robot: RobotConfig | Mapping[str, Any] | str | None = None,
        lidar: LidarConfig | Mapping[str, Any] | str | None = None,
        step_s: float = 0.1,
    ) -> None:
        self._config = from_mapping(NearestFrontierConfig, config)
        super().__init__(self._config, robot=robot, lidar=lidar, step_s=step_s)

    def pick(self, candidates: Candidates, belief: Belief) -> int:
        """Return the cheapest, unless the present one costs hardly more."""
        best = int(np.argmin(candidates.costs))
        if candidates.current is None:
            return best
        cost = float(candidates.costs[candidates.current])
        worth = max(self._config.switch_m, self._config.switch_share * cost)
        return best if candidates.costs[best] < cost - worth else candidates.current
