"""RRT exploration: random trees find where to look (Umari and Mukhopadhyay, IROS 2017).

"Autonomous robotic exploration based on multiple rapidly-exploring randomized trees": two of them grow through
the known free space at every choice. The global one, kept for the whole episode, gets into every corner in time;
the local one, from the robot, starts anew whenever one of its edges meets the unknown, and so finds at once what
is near. Where edges meet the unknown are frontier points; they are filtered (what has been seen since), clustered
by mean shift, and the one of the highest revenue is gone to.

The trees say where to look; from which place, and what has been looked at in vain, is the explorer's bookkeeping
of frontier pieces, as for every strategy here. A frontier point stands for the piece that it lies at. While the
trees have found none of the pieces that are left, all of them are weighed: random trees alone cannot tell that
nothing is left, and would leave what lies behind a narrow door to chance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from agents.explorer import Candidates, Explorer, ExplorerConfig
from agents.view_points.gain import expected_area
from agents.view_points.rrt_tree import Tree, mean_shift
from agents.ways.cost_map import CostMap
from slam.belief import Belief
from slam.settings import Gap, Length, NotNegative, Within
from slam.types import Array

__all__ = ["Rrt", "RrtConfig"]

_REMEMBERED = 400  # frontier points; the latest stay


@dataclass(frozen=True, kw_only=True)
class RrtConfig(ExplorerConfig):
    """The parts of the agent, its trees, and what a frontier point is worth."""

    stride_m: Annotated[float, Within("[0.05, 1000]")] = 1.0  # η, longest edge
    draws: Annotated[int, Within("[0, 100000]")] = 300  # points that each tree is grown towards in one choice
    capacity: Annotated[int, Within("[1, 100000]")] = 4000  # nodes of the global tree
    bandwidth_m: Length = 0.5  # of the mean shift
    near_piece_m: Length = 0.8  # a frontier point farther than this from every piece has been seen since
    # Information gain: the unknown in view within this.
    gain_radius_m: Annotated[float, Within("[0.05, 50]")] = 2.0
    min_gain_m2: NotNegative = 0.1  # frontier points with less in view are dropped
    weight_m_m2: NotNegative = 1.0  # λ: weighted metres that a square metre of gain is worth
    near_gain: Annotated[float, Within("[1, 1e6]")] = 2.0  # hysteresis h of frontier points …
    near_m: Gap = 3.0  # … that are this near to the robot
    switch_m: NotNegative = 1.0  # another piece must earn more by this [weighted m] to be worth turning round


class Rrt(Explorer):
    """Goes to the frontier point of the highest revenue among those that random trees have found."""

    config: RrtConfig
    config_type = RrtConfig

    def _forget(self) -> None:
        super()._forget()
        self.tree = Tree(self.config.stride_m, self.config.capacity)  # the global one
        self._found: Array = np.zeros((0, 2))  # frontier points [m], the latest last

    def pick(self, candidates: Candidates, belief: Belief) -> int:
        """Return the piece of the highest revenue, unless the present one earns hardly less."""
        self._grow(candidates.cost_map, np.asarray(belief.pose[:2], dtype=np.float64))
        points, gains = self._frontier_points(candidates.cost_map)
        revenue = self._revenue(candidates, points, gains, belief)
        best = int(np.argmax(revenue))
        current = candidates.current
        if current is None or revenue[best] > revenue[current] + self.config.switch_m:
            return best
        return current

    def _grow(self, cost_map: CostMap, here: Array) -> None:
        """Grow both trees and remember the frontier points that they find."""
        config = self.config
        self.tree.prune(cost_map)
        if not len(self.tree.nodes):
            self.tree.plant(here)
            self.tree.prune(cost_map)  # a robot on a cell that is not free grows nothing yet
        local = Tree(config.stride_m, config.draws + 1)
        local.plant(here)
        local.prune(cost_map)
        low = np.asarray(cost_map.origin)
        high = low + np.array(cost_map.classes.shape[::-1]) * cost_map.resolution
        # A stride beyond what is known: out there is what the edges at its rim are to be drawn towards.
        draws = self._rng.uniform(low - config.stride_m, high + config.stride_m, (2, config.draws, 2))
        hits = [self.tree.grow(cost_map, draws[0]), local.grow(cost_map, draws[1], restart=True)]
        self._found = np.vstack([self._found, *hits])[-_REMEMBERED:]

    def _frontier_points(self, cost_map: CostMap) -> tuple[Array, Array]:
        """Return one point ``(k, 2)`` [m] per cluster of those found, and its information gain ``(k,)`` [m²]."""
        config = self.config
        cells = cost_map.to_cells(self._found)
        _, first = np.unique(cells, axis=0, return_index=True)
        self._found = self._found[np.sort(first)]
        gains = self._gain(cost_map, self._found)
        kept = gains >= config.min_gain_m2
        self._found, gains = self._found[kept], gains[kept]
        chosen = mean_shift(self._found, config.bandwidth_m)
        return self._found[chosen], gains[chosen]

    def _gain(self, cost_map: CostMap, points: Array) -> Array:
        """Return the unknown area ``(k,)`` [m²] around points ``(k, 2)`` [m]: in view, not behind walls."""
        radius = self.config.gain_radius_m
        return expected_area(cost_map, cost_map.to_cells(points), range_m=radius, rays=60)

    def _revenue(self, candidates: Candidates, points: Array, gains: Array, belief: Belief) -> Array:
        """Return λ h I − N ``(m,)`` [weighted m] of each piece of frontier; −inf where it is not to be had."""
        config, targets = self.config, candidates.frontiers.targets
        live = np.isfinite(candidates.costs)
        gain = np.zeros(len(targets))
        found = np.zeros(len(targets), dtype=np.bool_)
        for point, area in zip(points, gains, strict=True):
            away = np.where(live, np.hypot(*(targets - point).T), np.inf)
            nearest = int(np.argmin(away))
            if away[nearest] <= config.near_piece_m:
                found[nearest] = True
                gain[nearest] = max(gain[nearest], area)
        if not found.any():
            found = live.copy()
        if candidates.current is not None:
            found[candidates.current] = True  # the trees found it before
        bare = found & (gain == 0.0)
        gain[bare] = self._gain(candidates.cost_map, targets[bare])
        near = np.hypot(*(targets - np.asarray(belief.pose[:2])).T) < config.near_m
        bias = np.where(near, config.near_gain, 1.0)
        cost = np.where(found, candidates.costs, np.inf)
        return np.asarray(config.weight_m_m2 * bias * gain - cost)
