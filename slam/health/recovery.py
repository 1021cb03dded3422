"""Lost, and found again: what a backend does where scans contradict its map.

A scan that speaks against the predicted pose is *doubtful*. The estimator is copied before the first one of a row,
and tries to correct itself by them; one that still contradicts the map from the corrected pose is not drawn. Where
the monitor gives the belief up, the copy is put back, so that neither wrong matches nor wrong drawings stay, and
nothing is written any more until a place is found that explains several scans in a row, or until many scans in a
row no longer speak against where the wheels have it: it was the map that was wrong, or the robot has come to where
there is none, or where no scan can say anything. Buildings repeat themselves, so from there no other place is
looked for on the whole map, and one that is found there must explain the scan far better than the believed one. A
scan that fits for the most part right beside the belief does not give it up at once: where the robot comes back to
a map that has drifted, it is a little off, and landmarks put that right. Scans that agree with the map cost one
look at them and nothing else.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam.geometry import compose, inverse, wrap_scalar
from slam.grids.occupancy import OccupancyGrid
from slam.health.evidence import Agreement, agreement, agrees
from slam.health.monitor import HealthConfig, HealthMonitor
from slam.health.relocalisation import Place, RelocalisationConfig, Relocaliser
from slam.types import Array, Scan

__all__ = ["Recovery"]


@dataclass
class _Trail:
    """A place that may be it, and where the belief, which is carried on by the wheels, was then."""

    place: Place
    believed: Array  # (3,)
    scans: int = 1


_WITHIN = 5.0  # σ of where the wheels have it, for a robot that was unsure of its pose before it was lost
_ANOTHER_VIEW = (0.3, 0.3)  # [m, rad] from which on a place looks otherwise


class Recovery:
    """Watches a backend's scans; knows whether it is lost, and looks for the way back.

    Attributes
    ----------
    lost : bool
        Whether the belief is given up.
    times_lost, relocalisations, scans_lost : int
        How often it was given up and found again, and for how many scans it was lost in all.
    """

    def __init__(self, config: HealthConfig, relocalisation: RelocalisationConfig, offset_m: float) -> None:
        self.config, self._relocalisation, self._offset_m = config, relocalisation, offset_m
        self.monitor = HealthMonitor(config)
        self.reset()

    def reset(self) -> None:
        """Start over, with a belief that is true."""
        self.monitor.restart(1.0 - self.config.lost_per_scan)
        self.lost = False
        self.times_lost = self.relocalisations = self.scans_lost = 0
        self.waited = 0  # scans for which it would have been given up, but for a place right beside
        self.kept: Any = None  # what the backend was before the first doubtful scan of a row
        self.unsure = False  # whether its pose was then known worse than its map is drawn
        self._relocaliser: Relocaliser | None = None
        self._trail: _Trail | None = None

    @property
    def health(self) -> float:
        """Probability that the true pose lies within the 99.7 % region of the belief."""
        return self.config.while_lost if self.lost else self.monitor.health

    def calm(self, grid: OccupancyGrid, body: Array, scan: Scan) -> bool:
        """Tell by a glance, at few beams, whether a scan from a pose of the body agrees as ever; most do."""
        return self.monitor.sure and agrees(grid, body, self._offset_m, scan, self.config.glance_beams)

    def look(self, grid: OccupancyGrid, body: tuple[float, float, float], scan: Scan) -> Agreement:
        """Return what a scan says of a pose of the body (x, y, θ)."""
        x, y, theta = body
        offset = self._offset_m
        sensor = (x + offset * math.cos(theta), y + offset * math.sin(theta), theta)
        seen = agreement(grid, sensor, scan, self.config.beams)
        if seen.beams < self.config.fewest_beams:  # in the open few beams return: all that there are
            return agreement(grid, sensor, scan, len(scan.ranges))
        return seen

    def opposed(self, grid: OccupancyGrid, body: Array, scan: Scan) -> bool:
        """Tell whether a scan speaks against a pose of the body ``(3,)``."""
        x, y, theta = body.tolist()
        return self.monitor.doubtful(self.look(grid, (x, y, theta), scan))

    def gone(self, grid: OccupancyGrid, body: Array, scan: Scan) -> bool:
        """Tell whether the belief is to be given up: it contradicts the scans, and not by a little or for long."""
        if self.monitor.fine >= self.config.give_up:
            self.waited = 0
            return False
        self.waited += 1
        if self.waited > self._relocalisation.patience:
            return True
        return not self._beside(Relocaliser(self._relocalisation, grid, self._offset_m), body, scan)

    def _beside(self, relocaliser: Relocaliser, body: Array, scan: Scan) -> bool:
        """Tell whether a scan fits the map for the most part right beside a pose of the body ``(3,)``.

        Then the pose is a little off, or the map is; a robot that is elsewhere sees something else.
        """
        config, place = self._relocalisation, relocaliser.check(scan, body)
        away = math.hypot(place.pose[0] - body[0], place.pose[1] - body[1])
        return away <= config.beside_m and place.quality >= config.mostly

    def give_up(self) -> None:
        """Note that the belief is lost."""
        self.lost = True
        self.times_lost += 1
        self.kept, self._relocaliser, self._trail = None, None, None
        self._searched = self._unopposed = self._silent = 0
        self._searched_from: Array | None = None  # where the wheels had it when all of the map was last searched

    def search(self, grid: OccupancyGrid, scan: Scan, believed: Array, cov: Array) -> Place | None:
        """Look for the place of a scan; return it once several scans agree on it, else None.

        ``believed`` ``(3,)`` is the pose that the wheels have carried on since the belief was lost, with its
        covariance ``(3, 3)``. A robot that was unsure of its pose before has hardly been carried away as well: its
        place is looked for within that. Where scans have not spoken against where the wheels have it for long
        enough, or could say nothing of any place for longer, nothing is returned, and it is no longer lost.
        """
        self.scans_lost += 1
        if self._relocaliser is None:
            self._relocaliser = Relocaliser(self._relocalisation, grid, self._offset_m)
        relocaliser, trail = self._relocaliser, self._trail
        if np.count_nonzero(scan.ranges <= scan.range_max) >= self._relocalisation.fewest_beams:
            opposed = self.opposed(grid, believed, scan) and not self._beside(relocaliser, believed, scan)
            self._unopposed, self._silent = 0 if opposed else self._unopposed + 1, 0
        else:
            self._silent += 1
        if self._unopposed >= self._relocalisation.unopposed or self._silent >= self._relocalisation.silent:
            self._end()
            return None
        if trail is not None:
            pose = compose(trail.place.pose, compose(inverse(trail.believed), believed))
            place: Place | None = relocaliser.check(scan, pose)
            if place is not None and place.good:
                self._trail = _Trail(place, believed, trail.scans + 1)
            else:
                self._trail = None
        else:
            place = self._first(relocaliser, scan, believed, cov)
            self._trail = None if place is None else _Trail(place, believed)
        if self._trail is None or self._trail.scans < self._relocalisation.confirm:
            return None
        self.relocalisations += 1
        self._end()
        return self._trail.place

    def _end(self) -> None:
        """Be lost no longer."""
        self.lost = False
        self._relocaliser = None
        self.monitor.restart(self.config.found)

    def _first(self, relocaliser: Relocaliser, scan: Scan, believed: Array, cov: Array) -> Place | None:
        """Search the radius that is due, where it is."""
        config, count = self._relocalisation, self._searched
        self._searched += 1
        stage = 0
        for scans in config.scans_each:
            if count < scans:
                break
            count -= scans
            stage += 1
        radius, every = config.radii_m[stage], config.every[stage]
        if self.unsure:
            radius = min(radius, config.apart_m + _WITHIN * math.sqrt(max(cov[0, 0], cov[1, 1])))
        if math.isinf(radius):
            if self._unopposed:
                return None
            every *= 1 + relocaliser.places // config.places_each
            if self._searched_from is not None and not self._moved(believed, self._searched_from):
                every *= config.standing  # the same view says the same again
        if count % every:
            return None
        if math.isinf(radius):
            self._searched_from = believed.copy()
        place = relocaliser.find(scan, believed, radius)
        if place is None:
            return None
        if self.unsure:
            away = place.pose - believed
            away[2] = wrap_scalar(float(away[2]))
            return place if away @ np.linalg.solve(cov + place.cov, away) < _WITHIN**2 else None
        if math.isfinite(radius):
            return place
        return place if place.quality >= relocaliser.check(scan, believed).quality + config.far_margin else None

    @staticmethod
    def _moved(now: Array, before: Array) -> bool:
        """Tell whether the view from one pose ``(3,)`` is another than from the other."""
        away = math.hypot(now[0] - before[0], now[1] - before[1])
        turned = abs(wrap_scalar(float(now[2] - before[2])))
        return away > _ANOTHER_VIEW[0] or turned > _ANOTHER_VIEW[1]
