"""Next best view: of many places in the known free space, the one that promises most for the way there.

A place q that promises the new area A(q) and costs L(q) to reach is worth A(q) · exp(−λ L(q)), with A(q) by
ray casting on the map (González-Baños and Latombe, "Navigation strategies for exploring indoor environments",
IJRR 2002; the same trade-off, over the branches of a tree, in Bircher et al., ICRA 2016).

Places are the points of a lattice over what can be reached, and each frontier's own view point. Only a place that
has a piece of frontier in good sight counts: what promises area through a crack in a wall's drawing, looked at
before, draws the robot nowhere. Where no sampled place does, the frontiers' own view points are what is left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import cv2
import numpy as np

from agents.explorer import Candidates, Explorer, ExplorerConfig
from agents.view_points.gain import expected_area
from agents.view_points.sight import first_in_good_sight, reach_m
from agents.ways.cost_map import CostMap
from agents.ways.planning import TravelCosts
from slam.belief import Belief
from slam.settings import Length, NotNegative, Within
from slam.types import Array, Cells, Flags

__all__ = ["NextBestView", "NextBestViewConfig"]

_SAMPLE_RAYS = 60  # enough to rank places by; six degrees apart


@dataclass(frozen=True, kw_only=True)
class NextBestViewConfig(ExplorerConfig):
    """The parts of the agent, what it expects to see, and how it weighs that against the way."""

    decay_1_m: NotNegative = 0.2  # λ: how fast the worth of a place falls with the cost of the way [1/weighted m]
    range_m: Length = 5.0  # how far it counts on seeing; never beyond 0.8 of the lidar's range
    depth_m: Length = 2.0  # how far into the unknown: behind every frontier there is a wall sooner or later
    spacing_m: Annotated[float, Within("[0.05, 1000]")] = 0.4  # of the lattice of places
    # Places weighed in one choice; beyond that so many drawn from the lattice.
    samples: Annotated[int, Within("[0, 10000]")] = 200
    switch_share: NotNegative = 0.2  # another place must be worth more by this share to be worth turning round


class NextBestView(Explorer):
    """Goes to where the most new area is in view, less what the way there costs."""

    config: NextBestViewConfig
    config_type = NextBestViewConfig

    def pick(self, candidates: Candidates, belief: Belief) -> int:
        """Return the candidate of the highest worth, unless the present one is worth hardly less."""
        worth = self.worth(candidates.cost_map, candidates.cells, candidates.costs)
        best = int(np.argmax(worth))
        current = candidates.current
        if current is None or worth[best] > (1.0 + self.config.switch_share) * worth[current]:
            return best
        return current

    def worth(self, cost_map: CostMap, cells: Cells, costs: Array, *, rays: int = 120) -> Array:
        """Return A · exp(−λ L) ``(m,)`` [m²] of places ``(m, 2)`` at travel costs ``(m,)``; −inf out of reach."""
        reached = np.isfinite(costs)
        config = self.config
        area = expected_area(
            cost_map,
            np.where(reached[:, None], cells, -1),
            range_m=min(config.range_m, 0.8 * self._lidar.range_max_m),
            depth_m=config.depth_m,
            rays=rays,
        )
        # The first term decides; the second keeps nearest first where nothing new is in view from anywhere.
        discount = np.exp(-config.decay_1_m * np.where(reached, costs, 0.0))
        return np.where(reached, (area + 1e-6) * discount, -np.inf)

    def _candidates(self, belief: Belief) -> Candidates:
        """Return the frontiers' candidates, each with the worthiest place that has it in good sight."""
        own = super()._candidates(belief)
        live = np.flatnonzero(np.isfinite(own.costs))
        if not len(live) or self.config.samples == 0:
            return own
        targets = own.cost_map.to_cells(own.frontiers.targets)
        reach = reach_m(self._watch_kept().range_m, self._short_m(), own.cost_map.resolution)
        places = self._places(own.cost_map, own.travel, targets[live], reach)
        cost = own.travel.cost[places[:, 0], places[:, 1]].astype(np.float64)
        worth = self.worth(own.cost_map, places, cost, rays=_SAMPLE_RAYS)
        if self._goal is not None and len(worth):
            worth[0] *= 1.0 + self.config.switch_share  # the present goal: see _places
        least = self.worth(own.cost_map, own.cells, own.costs, rays=_SAMPLE_RAYS)
        order = np.argsort(-worth, kind="stable")
        found = first_in_good_sight(
            own.cost_map, targets[live], own.frontiers.normals[live], own.cost_map.to_points(places[order]),
            worth[order], least[live], reach,
        )  # fmt: skip
        better, chosen = live[found >= 0], order[found[found >= 0]]
        cells, costs = own.cells.copy(), own.costs.copy()
        cells[better], costs[better] = places[chosen], cost[chosen]
        return replace(own, cells=cells, costs=costs)

    def _places(self, cost_map: CostMap, travel: TravelCosts, targets: Cells, reach_m: float) -> Cells:
        """Return the places ``(k, 2)`` to weigh, the present goal first where there is one.

        They are points of a lattice of the belief's frame, so that a growing map does not shift it: within
        ``reach_m`` of one of the frontier cells ``targets`` ``(t, 2)``, and where the robot has room to turn.
        """
        config, resolution = self.config, cost_map.resolution
        step = max(1, round(config.spacing_m / resolution))
        first = [-round(cost_map.origin[axis] / resolution) % step for axis in (1, 0)]
        rows, cols = slice(first[0], None, step), slice(first[1], None, step)
        roomy = cost_map.weight[rows, cols] <= 1.0 + config.planner.near_cost
        near = np.isfinite(travel.cost[rows, cols]) & roomy
        near &= _within(cost_map, targets, reach_m)[rows, cols]
        lattice = np.argwhere(near) * step + first
        if len(lattice) > config.samples:
            lattice = lattice[np.sort(self._rng.choice(len(lattice), config.samples, replace=False))]
        if self._goal is None:
            return lattice
        goal = cost_map.to_cells(self._goal.pose[None, :2])
        return np.vstack([goal, lattice])


def _within(cost_map: CostMap, targets: Cells, reach_m: float) -> Flags:
    """Return the cells within ``reach_m`` of one of the ``targets``: a disc laid over each of these few."""
    span = math.ceil(reach_m / cost_map.resolution)
    apart = np.ones((2 * span + 1, 2 * span + 1), dtype=np.uint8)
    apart[span, span] = 0
    disc = cv2.distanceTransform(apart, cv2.DIST_L2, cv2.DIST_MASK_5) * cost_map.resolution <= reach_m
    rows, cols = cost_map.classes.shape
    within = np.zeros((rows + 2 * span, cols + 2 * span), dtype=np.bool_)
    for row, col in targets.tolist():
        within[row : row + 2 * span + 1, col : col + 2 * span + 1] |= disc
    return within[span : span + rows, span : span + cols]
