"""Targets are worth less where others will look (Burgard et al., 2005).

Burgard, Moors, Stachniss and Schneider, "Coordinated multi-robot exploration", IEEE Transactions on Robotics 2005,
algorithm 1: robots and targets are paired one after the other, the pair first whose utility less the price of the
way, U − β V, is largest; each target that is given away lowers the utility of those in sight of it, the more the
nearer they are, by the share 1 − d / d_max at a distance d. Here a robot that has announced its goal keeps it,
and U is what ``cost-utility`` counts, square metres of new area.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from agents.brisk_tour import BRISK
from agents.cost_utility import CostUtility, CostUtilityConfig
from agents.driving.control import ControlConfig
from agents.explorer import Candidates
from agents.stations.lattice import in_sight
from agents.teams.crew import Crew
from agents.teams.shared import Shared, SharingConfig
from agents.view_points.gain import expected_area
from slam.types import Array, Indices

__all__ = ["Coordinated", "CoordinatedConfig", "pair_off"]


@dataclass(frozen=True, kw_only=True)
class CoordinatedConfig(CostUtilityConfig):
    """Cost-utility's, driven briskly, and who is counted on."""

    control: ControlConfig = BRISK
    sharing: SharingConfig = field(default_factory=SharingConfig)


class Coordinated(Shared, CostUtility):
    """Goes where the new area that others leave, less the price of the way, is largest."""

    config: CoordinatedConfig
    config_type = CoordinatedConfig

    def _owned(self, crew: Crew, found: Candidates) -> Indices:
        """Return the column that is paired with this robot."""
        config, cost_map = self.config, found.cost_map
        range_m = min(config.range_m, 0.8 * self._lidar.range_max_m)
        area = expected_area(cost_map, crew.cells, range_m=range_m, depth_m=config.depth_m)
        targets = found.frontiers.targets[crew.pieces]
        away = np.hypot(*(targets[:, None] - targets[None]).transpose(2, 0, 1))
        cells = cost_map.to_cells(targets)
        seen = in_sight(cost_map.classes, cells, cells, range_m / cost_map.resolution)
        overlap = np.where(seen, 1.0 - away / range_m, 0.0)
        np.fill_diagonal(overlap, 1.0)
        # Another's goal stands; the own one is weighed anew, with what it takes to turn round against the others.
        bound = crew.bound.copy()
        bound[crew.own] = -1
        costs = crew.held(config.switch_m2 / max(config.beta_m2_m, 1e-9))
        price = np.where(np.isfinite(costs), config.beta_m2_m * np.where(np.isfinite(costs), costs, 0.0), np.inf)
        column = pair_off(area, overlap, price, bound)[crew.own]
        return np.array([column] if column >= 0 else [], dtype=np.int64)


def pair_off(utility: Array, overlap: Array, price: Array, bound: Indices) -> Indices:
    """Return the target that each robot goes to ``(k,)``, −1 for none.

    Parameters
    ----------
    utility
        ``(n,)`` of each target, while nobody goes there.
    overlap
        ``(n, n)`` share of a target's utility, by column, that is lost when another, by row, is given away.
    price
        ``(k, n)`` of each robot's way; infinite where there is none.
    bound
        ``(k,)`` the target that a robot is on its way to and keeps, −1 for those that are to be paired.
    """
    left, paired = utility.astype(np.float64), bound.copy()
    for target in bound[bound >= 0]:
        left *= 1.0 - overlap[target]
    while (paired < 0).any():
        balance = np.where((paired < 0)[:, None], left - price, -np.inf)
        robot, target = np.unravel_index(int(np.argmax(balance)), balance.shape)
        if not np.isfinite(balance[robot, target]):
            break
        paired[robot] = target
        left *= 1.0 - overlap[target]
    return paired
