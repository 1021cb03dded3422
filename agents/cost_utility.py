"""Information against the cost of the way there (Burgard et al., 2000 and 2005, for a single robot).

Burgard, Moors, Stachniss and Schneider, "Coordinated multi-robot exploration", IEEE Transactions on Robotics 2005,
algorithm 1: of all frontier targets t the one that maximises U(t) − β V(t) is gone to, V the cost of the way.
Their utility U is a share that falls with what other robots see of t; for a single robot it is the same
everywhere, which makes their rule that of the nearest frontier. Here U is the new area that may be expected to
come into view, in square metres, and β says how many of those a metre of the way must bring.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agents.explorer import Candidates, Explorer, ExplorerConfig
from agents.view_points.gain import expected_area
from slam.belief import Belief
from slam.settings import Length, NotNegative
from slam.types import Array

__all__ = ["CostUtility", "CostUtilityConfig"]


@dataclass(frozen=True, kw_only=True)
class CostUtilityConfig(ExplorerConfig):
    """The parts of the agent, what it expects to see, and what a metre of the way must bring."""

    beta_m2_m: NotNegative = 2.0  # β [m² per weighted m]
    range_m: Length = 5.0  # how far it counts on seeing; never beyond 0.8 of the lidar's range
    depth_m: Length = 2.0  # how far into the unknown: behind every frontier there is a wall sooner or later
    switch_m2: NotNegative = 0.5  # another target must be better by this …
    # … and by this share of what the present one is worth, to be worth turning round
    switch_share: NotNegative = 0.2


class CostUtility(Explorer):
    """Goes where the expected new area, less the price of the way, is largest."""

    config: CostUtilityConfig
    config_type = CostUtilityConfig

    def pick(self, candidates: Candidates, belief: Belief) -> int:
        """Return the target with the best balance, unless the present one's is hardly worse."""
        balance = self.balance(candidates)
        best = int(np.argmax(balance))
        if candidates.current is None:
            return best
        present = balance[candidates.current]
        worth = max(self.config.switch_m2, self.config.switch_share * abs(present))
        return best if balance[best] > present + worth else candidates.current

    def balance(self, candidates: Candidates) -> Array:
        """Return U − β V ``(m,)`` [m²] of each target; −inf where it is out of reach."""
        config = self.config
        reached = np.isfinite(candidates.costs)
        utility = expected_area(
            candidates.cost_map,
            np.where(reached[:, None], candidates.cells, -1),
            range_m=min(config.range_m, 0.8 * self._lidar.range_max_m),
            depth_m=config.depth_m,
        )
        costs = config.beta_m2_m * np.where(reached, candidates.costs, 0.0)
        return np.where(reached, utility - costs, -np.inf)
