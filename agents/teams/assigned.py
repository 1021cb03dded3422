"""A frontier for each robot, by the assignment of the least total cost (Kuhn, 1955).

Of frontiers to robots in exploration: Ko, Stewart, Fox, Konolige and Limketkai, "A practical, decision-theoretic
approach to multi-robot mapping and exploration", IROS 2003. Costs are those of the way from where each robot is.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from agents.brisk_tour import BRISK
from agents.driving.control import ControlConfig
from agents.explorer import Candidates
from agents.nearest_frontier import NearestFrontier, NearestFrontierConfig
from agents.teams.crew import Crew
from agents.teams.shared import Shared, SharingConfig
from agents.teams.sharing import assign
from slam.types import Indices

__all__ = ["Assigned", "AssignedConfig"]


@dataclass(frozen=True, kw_only=True)
class AssignedConfig(NearestFrontierConfig):
    """The nearest frontier's, driven briskly, and who is counted on."""

    control: ControlConfig = BRISK
    sharing: SharingConfig = field(default_factory=SharingConfig)


class Assigned(Shared, NearestFrontier):
    """Goes to the frontier that the assignment gives it, or to the nearest where there are not enough for all."""

    config: AssignedConfig
    config_type = AssignedConfig

    def _owned(self, crew: Crew, found: Candidates) -> Indices:
        """Return the column that is assigned to this robot: of each cluster the piece that it is nearest to."""
        costs = crew.held(self.config.sharing.hold_m)
        clusters = found.frontiers.target_labels[crew.pieces]
        kinds = np.unique(clusters)
        # Two robots are not sent to one cluster: what the first sees of it is for the second no longer there.
        by_cluster = np.array([np.where(clusters == kind, costs, np.inf) for kind in kinds])
        nearest = by_cluster.argmin(axis=2).T
        column = assign(by_cluster.min(axis=2).T)[crew.own]
        return nearest[crew.own, [column]] if column >= 0 else np.zeros(0, dtype=np.int64)
