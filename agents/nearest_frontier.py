"""Nearest frontier first (Yamauchi, 1997), by the cost of the way there.

Of a robot that hops over the stations of a lattice and looks only where it stops, the nearest station from which
enough of the frontier is in sight: the rule that the benchmark of ``docs/studies/dungeons.md`` has under this
name.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from agents.explorer import Candidates, Explorer, ExplorerConfig
from agents.stations.stop import StationAgent, StationsConfig, StationStop
from slam.belief import Belief
from slam.settings import NotNegative

__all__ = ["NearestFrontier", "NearestFrontierConfig"]


@dataclass(frozen=True, kw_only=True)
class NearestFrontierConfig(ExplorerConfig):
    """The parts of the agent, and how firmly it holds on to a goal."""

    stations: StationsConfig = field(default_factory=StationsConfig)
    switch_m: NotNegative = 0.5  # another frontier must be cheaper by this [weighted m] …
    switch_share: NotNegative = 0.15  # … and by this share of the present goal's cost, to be worth turning round


class NearestFrontier(StationAgent, Explorer):
    """Goes to the view point that is cheapest to reach, and on to the next as soon as it has seen."""

    config: NearestFrontierConfig
    config_type = NearestFrontierConfig

    def _station(self, stop: StationStop) -> int:
        return int(np.argmin(np.where(stop.found.worth, stop.found.way, math.inf)))

    def pick(self, candidates: Candidates, belief: Belief) -> int:
        """Return the cheapest, unless the present one costs hardly more."""
        best = int(np.argmin(candidates.costs))
        if candidates.current is None:
            return best
        cost = float(candidates.costs[candidates.current])
        worth = max(self.config.switch_m, self.config.switch_share * cost)
        return best if candidates.costs[best] < cost - worth else candidates.current
