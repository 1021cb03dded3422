"""An explorer that keeps to its part of what is left: what falls to it when tours are shared out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from agents.explorer import Candidates, Explorer
from agents.teams.crew import Crew, muster
from agents.teams.sharing import FAR_M, share_tours
from agents.ways.travel import between
from slam.belief import Belief
from slam.settings import Config, Duration, Few, NotNegative
from slam.types import Indices

__all__ = ["Shared", "SharingConfig"]


@dataclass(frozen=True, kw_only=True)
class SharingConfig(Config):
    """How what is left is shared out."""

    trust_s: Duration = 20.0  # how long a robot that is no longer heard is counted on, where it was
    most: Few = 40  # pieces of frontier that are shared out: those nearest to any robot
    # Shorter is the way to what a robot is on its way to: parts that change hands cost turns.
    hold_m: NotNegative = 3.0


_USUAL = SharingConfig()


class Shared(Explorer):
    """To be put before a strategy: leaves it the candidates that fall to this robot."""

    def _sharing(self) -> SharingConfig:
        """Return how what is left is shared out; a policy's configuration does not say."""
        sharing: SharingConfig = getattr(self.config, "sharing", _USUAL)
        return sharing

    def _owned(self, crew: Crew, found: Candidates) -> Indices:
        """Return the crew's columns that fall to this robot: the tour that does when all are shared out."""
        config = self._sharing()
        near = np.argsort(crew.costs.min(axis=0), kind="stable")[: config.most]
        starts = np.ascontiguousarray(np.minimum(crew.held(config.hold_m)[:, near], FAR_M), np.float64)
        cells = crew.cells[near]
        distance = np.full((len(cells), len(cells)), FAR_M)
        for travel in crew.travels:  # what the first cannot get to, another can
            if (distance < FAR_M).all():
                break
            ways = between(found.cost_map, travel, cells, searched=0)
            distance = np.where(distance < FAR_M, distance, np.nan_to_num(ways, nan=FAR_M, posinf=FAR_M))
        owner = share_tours(starts, distance)
        return np.asarray(near[owner == crew.own])

    def _own_part(self, found: Candidates, belief: Belief) -> Candidates:
        """Return the candidates that fall to this robot; where none does, all: it goes along with another."""
        patience, troubles = self.config.patience, self._troubles.near(found.frontiers.targets)
        left = np.array([t is None or t.looks < patience.looks for t in troubles], dtype=np.bool_)
        crew = muster(
            belief, found, None if self._goal is None else self._goal.pose[:2], left,
            trust_s=self._sharing().trust_s, range_m=self._watch_kept().range_m,
            beyond_m=self.config.frontiers.beyond_m, short_m=self._short_m(), same_m=patience.same_m,
        )  # fmt: skip
        if crew is None:
            return found
        # The farther the way, the more there must be to see: for whoever is nearest. What nobody can reach is
        # no work to share: whoever was given it would leave real places to others for it.
        extents = found.frontiers.extents[found.frontiers.target_labels[crew.pieces]]
        nearest = crew.costs.min(axis=0)
        worth = extents >= self._frontier_config.wanted_extent(nearest) - 1e-9
        crew = crew.of(worth & np.isfinite(nearest))
        own = crew.pieces[self._owned(crew, found)] if len(crew.pieces) else crew.pieces
        own = own[np.isfinite(found.costs[own])]
        if not len(own):
            return found
        costs = np.full_like(found.costs, np.inf)
        costs[own] = found.costs[own]
        current = found.current
        if current is not None and not np.isfinite(costs[current]):
            self._target = current = None  # handed over: that is not the same as looked at
        return replace(found, costs=costs, current=current)

    def _costs_asked(self) -> int | None:
        return None  # what is near to another robot may be far from this one
