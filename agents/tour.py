"""All frontiers in one tour, planned anew whenever the map has changed.

The lesson of TARE (Cao et al., 2021): going to what is nearest leaves small pockets behind, to be fetched at the
end from far away; an order over everything that is left picks them up while they lie on the way. Of the tour, only
the first leg is carried out.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from agents.explorer import Candidates, Explorer, ExplorerConfig
from agents.stations.lattice import in_sight
from agents.stations.stop import StationAgent, StationsConfig, StationStop
from agents.stations.survey import begin
from agents.view_points.gain import expected_area
from agents.ways.routing import best_tour, draw_luck, tours_begun_with
from agents.ways.travel import between
from slam.belief import Belief
from slam.settings import Few, Gap, NotNegative
from slam.types import Array, Cells, Flags

__all__ = ["Outlook", "Tour", "TourConfig"]


@dataclass(frozen=True, kw_only=True)
class TourConfig(ExplorerConfig):
    """The parts of the agent, and what makes a tour a good one."""

    stations: StationsConfig = field(default_factory=StationsConfig)
    places: Few = 25  # nearest view points that the tour is over; those farther away can wait
    tries: Few = 6  # choices of view points that the best tour is taken from
    # A tour that starts elsewhere must be shorter by this [weighted m] to turn round for.
    hold_m: NotNegative = 1.0
    hurry: NotNegative = 2.0  # 0: the shortest tour; above: what shows much new area is reached early
    depth_m: Gap = 3.0  # how far behind a frontier new area is expected


@dataclass(frozen=True, eq=False)
class Outlook:
    """What a tour is planned from: view points, what is seen from each, and the ways between them."""

    pieces: Cells  # (n,) piece of frontier that each view point belongs to
    sight: Flags  # (n + 1, m) what each place sees of the pieces; row 0 is the robot's
    distance: Array  # (n + 1, n + 1) [weighted m]
    weight: Array  # (n + 1,) price of reaching each place a metre later

    def tour(self, tries: int) -> tuple[Cells, float]:
        """Return the best tour found, as places in order from 0, and what it costs."""
        return best_tour(self.sight, self.distance, self.weight, draw_luck(tries, len(self.sight)))

    def losses_m(self, order: Cells) -> Array:
        """Return how much later [m] all is seen, on average, if a tour begins with each place ``(n,)``.

        ``order`` is the best tour. By the weights, with the same places: 0 where it begins, or less
        where a better one is found on the way.
        """
        costs = tours_begun_with(self.sight, self.distance, self.weight, order)[1:]
        return np.asarray((costs - costs[order[1] - 1]) / (1.0 + float(self.weight.sum())))


class Tour(StationAgent, Explorer):
    """Goes to the first place of the best tour over all that is left to look at."""

    config: TourConfig

    config_type = TourConfig
    _index = 0  # of the piece that the tour begins with

    def _station(self, stop: StationStop) -> int:
        return begin(stop.found, draw_luck(self.config.tries, len(stop.found.places)))

    def pick(self, candidates: Candidates, belief: Belief) -> int:
        """Return the piece of frontier that the tour begins with."""
        return self._index

    def _costs_asked(self) -> int | None:
        return self.config.places  # those that the tour is over

    def _candidates(self, belief: Belief) -> Candidates:
        """Return the candidates, the first place of the tour put in as the view point of what is picked."""
        self._outlook: Outlook | None = None
        self._order = np.zeros(1, dtype=np.int64)  # of the tour, among the outlook's places
        found = super()._candidates(belief)
        open_ = np.flatnonzero(np.isfinite(found.costs))
        if not len(open_):
            return found
        self._index = self._by_views(found, open_)
        return found

    # ---- driving anywhere ----------------------------------------------------------------------------------

    def _by_views(self, found: Candidates, pieces: Cells) -> int:
        """Return the piece that the tour over the pieces' own view points begins with."""
        near = pieces[np.argsort(found.costs[pieces], kind="stable")[: self.config.places]]
        _, first = np.unique(found.cells[near], axis=0, return_index=True)
        first.sort()  # the nearest first, still
        owner = near[first]
        cells = found.cells[owner]
        places = np.vstack([np.asarray(found.cost_map.start)[None], cells])
        distance = between(found.cost_map, found.travel, places)
        sight = self._sight(found, places, near)
        sight[1 + np.arange(len(owner)), first] = True
        if found.current is not None:
            # Shorter is the first leg towards the places that the robot is on the way to.
            kept = np.asarray(sight[:, near == found.current].any(axis=1))
            distance[0, kept] = np.maximum(distance[0, kept] - self.config.hold_m, 0.0)
        self._outlook = Outlook(owner, sight, distance, self._weights(found, places))
        self._order, _ = self._outlook.tour(self.config.tries)
        return int(owner[self._order[1] - 1])

    def _sight(self, found: Candidates, places: Cells, pieces: Cells) -> Flags:
        """Return which pieces are in good sight from which places ``(n, m)``; none from the first, the robot's."""
        reach = self._watch_kept().range_m / found.cost_map.resolution
        targets = found.cost_map.to_cells(found.frontiers.targets[pieces])
        sight = in_sight(found.cost_map.classes, places, targets, reach)
        towards = (targets[None] - places[:, None])[..., ::-1]
        ahead = (towards * found.frontiers.normals[pieces]).sum(axis=-1)
        sight &= (towards**2).sum(axis=-1) <= reach * ahead
        sight[0] = False
        return np.asarray(sight)

    def _weights(self, found: Candidates, places: Cells) -> Array:
        """Return what a metre's delay costs at each place: its share of the area that all of them may show."""
        if self.config.hurry == 0.0:
            return np.zeros(len(places))
        area = expected_area(
            found.cost_map, places, range_m=self._lidar.range_max_m, depth_m=self.config.depth_m, rays=60
        )
        area[0] = 0.0
        return np.asarray(self.config.hurry * area / max(float(area.mean()), 1e-9))
