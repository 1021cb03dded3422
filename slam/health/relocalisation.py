"""Where on a map was this scan taken? Global scan matching, for a robot that has lost its place.

The body can only be in free space, so the search runs over free cells on a coarse lattice and over all headings.
Each is scored by a likelihood field in which every cell holds the largest value near by, so that a lattice point
next to the right pose scores at least as well as that (Olson 2009). The best ones, apart from each other, are
refined on the fine field (:mod:`slam.grids.scan_matching`) and held against the map: a place counts where next to
no beam ends in the open or comes through a wall, and only where no other place does nearly as well.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated

import cv2
import numpy as np
from numba import njit

from slam.geometry import wrap_scalar
from slam.grids.occupancy import FREE, OCCUPIED, OccupancyGrid
from slam.grids.scan_matching import LikelihoodField, MatchConfig, body_points, match, refine
from slam.health.evidence import agreement, through_walls
from slam.settings import Config, Count, Gap, Share, Within, require
from slam.types import Array, Floats, Scan

__all__ = ["Place", "RelocalisationConfig", "Relocaliser"]


@dataclass(frozen=True, kw_only=True)
class RelocalisationConfig(Config):
    """How far and how finely places are searched, and when one is believed."""

    spacing_m: Annotated[float, Within("[0.05, 10]")] = 0.2  # of the lattice of positions
    spacing_rad: Annotated[float, Within("[0.001, 3.2]")] = 0.04
    beams: Count = 60  # that score a place of the lattice
    candidates: Annotated[int, Within("[2, 1000]")] = 12  # that are looked at closely
    apart_m: Gap = 0.5  # candidates differ by as much …
    apart_rad: Gap = 0.35  # … or by this
    check_beams: Count = 180  # that a candidate is held against the map by
    fewest_beams: Count = 25  # that must say anything of a place
    least_known: Share = 0.35  # share of the beams that must end where the map is known
    most_against: Share = 0.05  # share of those that may end in the open …
    most_through: Share = 0.1  # … and of all, that may come through a wall: some pass close by a corner
    least_sharp: Share = 0.65  # of those on walls, that end in the very cell
    margin: Share = 0.12  # by which the best place must be better than the next, in shares of the beams
    # The same for one on the whole map, against the one right beside where the wheels have the robot: a map that
    # has drifted explains a scan worse than it should, and buildings repeat themselves.
    far_margin: Share = 0.35
    beside_m: Gap = 0.25  # how far off that is beside, …
    mostly: Share = 0.5  # … and the quality from which on it says that the robot is no longer lost, or not yet …
    patience: Count = 3  # … for so many scans: a belief that nothing corrects meanwhile is wrong
    # Around the last known pose, one after the other, …
    radii_m: Annotated[tuple[float, ...], Within("(0, inf]")] = (1.5, 4.0, math.inf)
    # … for so many scans, the last one until it is found.
    scans_each: Annotated[tuple[int, ...], Within("[1, 1000000]")] = (5, 15)
    # Scans between two searches of each radius: they take long.
    every: Annotated[tuple[int, ...], Within("[1, 1000000]")] = (1, 2, 10)
    # Places of the lattice that take so long; of twice as many, half as often.
    places_each: Annotated[int, Within("[1, 1000000]")] = 60_000
    # Times as many scans between two searches of all of the map, where the robot has not moved.
    standing: Annotated[int, Within("[1, 1000000]")] = 8
    confirm: Annotated[int, Within("[1, 1000000]")] = 3  # scans that a place must explain, one after the other
    # Scans in a row that do not speak against where the wheels have it, to go on from there.
    unopposed: Annotated[int, Within("[1, 1000000]")] = 30
    # The same of scans that say nothing of any place: too few beams return, in a wide hall.
    silent: Annotated[int, Within("[1, 1000000]")] = 300
    # Reach of a surface when a place is refined last.
    sharp_smooth_m: Annotated[float, Within("[0.01, 1]")] = 0.05
    matching: MatchConfig = field(
        default_factory=lambda: MatchConfig(window_m=0.15, window_rad=0.04, step_rad=0.01)
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        stages = len(self.radii_m)
        require(
            stages >= 1 and len(self.scans_each) == stages - 1 and len(self.every) == stages,
            "RelocalisationConfig needs one of every and, but the last, of scans_each for each of radii_m, got "
            f"{len(self.every)}, {len(self.scans_each)} and {stages}",
        )
        require(
            self.sharp_smooth_m >= self.matching.cell_m,
            f"RelocalisationConfig.sharp_smooth_m must be at least matching.cell_m, {self.matching.cell_m}, got "
            f"{self.sharp_smooth_m}",
        )


@dataclass(frozen=True, slots=True)
class Place:
    """A pose that may be the robot's."""

    pose: Array  # (3,) of the body: x [m], y [m], θ [rad]
    cov: Array  # (3, 3) from the curvature of the match
    quality: float  # share of the beams that speak for it, less those against
    good: bool  # whether it explains the scan


class Relocaliser:
    """Searches one map, which does not change meanwhile."""

    def __init__(self, config: RelocalisationConfig, grid: OccupancyGrid, offset_m: float) -> None:
        self.config, self._grid, self._offset_m = config, grid, offset_m
        self._sharp_matching = dataclasses.replace(config.matching, smooth_m=config.sharp_smooth_m)
        self._field: LikelihoodField | None = None
        self._sharp_field: LikelihoodField
        self._field_of: tuple[float, float, float] = (math.nan, math.nan, math.nan)

    @cached_property
    def _free(self) -> Array:
        """Lattice points ``(n, 2)`` in free space, with some room for the body."""
        grid, step = self._grid, max(round(self.config.spacing_m / self._grid.resolution), 1)
        room = cv2.erode((grid.classes() == FREE).astype(np.uint8), np.ones((3, 3), np.uint8))
        return grid.to_points(np.argwhere(room[::step, ::step]) * step)

    @property
    def places(self) -> int:
        """Number of the lattice's positions."""
        return len(self._free)

    def find(self, scan: Scan, around: Array, radius_m: float) -> Place | None:
        """Return where within a radius of a pose ``(3,)`` a scan was taken, if that is beyond doubt."""
        config = self.config
        points = body_points(scan, config.matching, offset_m=self._offset_m)
        near = self._free
        if math.isfinite(radius_m):
            near = near[np.hypot(near[:, 0] - around[0], near[:, 1] - around[1]) <= radius_m]
        if len(points) < config.fewest_beams or not len(near):
            return None
        likelihood = self._field_around(around, radius_m)
        places = [
            self._look_at(likelihood, pose, points, scan) for pose in self._candidates(likelihood, near, points)
        ]
        places.sort(key=lambda place: -place.quality)
        best = places[0]
        rival = next((p.quality for p in places[1:] if self._apart(p.pose, best.pose)), -math.inf)
        return best if best.good and best.quality - rival >= config.margin else None

    def check(self, scan: Scan, pose: Array) -> Place:
        """Return the place next to a pose ``(3,)`` where a scan fits best."""
        likelihood = self._field_around(pose, 1.0)
        points = body_points(scan, self.config.matching, offset_m=self._offset_m)
        return self._look_at(likelihood, pose, points, scan)

    def _field_around(self, pose: Array, radius_m: float) -> LikelihoodField:
        """Return the field of the walls that a scan from within the radius may show."""
        x, y, reach = float(pose[0]), float(pose[1]), radius_m + self.config.matching.reach_m
        known_x, known_y, known = self._field_of
        if self._field is None or not (math.hypot(x - known_x, y - known_y) + reach <= known + 0.5):
            walls = self._grid.points_of(OCCUPIED, (x, y), reach + 1.0)
            self._field = LikelihoodField(self.config.matching, walls)
            self._sharp_field = LikelihoodField(self._sharp_matching, walls)
            self._field_of = (x, y, reach + 0.5)
        return self._field

    def _candidates(self, likelihood: LikelihoodField, near: Array, points: Array) -> list[Array]:
        """Return the best poses of the lattice, apart from each other."""
        config = self.config
        few = points[np.linspace(0, len(points) - 1, min(config.beams, len(points))).astype(np.int64)]
        block = round(config.spacing_m / likelihood.cell_m) | 1
        highest = cv2.dilate(likelihood.values, np.ones((block, block), np.uint8)).astype(np.float32)
        turns = math.ceil(2.0 * math.pi / config.spacing_rad)
        scores = np.zeros((len(near), turns), np.float32)
        _score(highest, likelihood.x0, likelihood.y0, likelihood.cell_m, few, near, scores)
        best_turn = scores.argmax(axis=1)
        best = scores[np.arange(len(near)), best_turn]
        headings = [wrap_scalar(2.0 * math.pi * turn / turns) for turn in range(turns)]
        chosen: list[tuple[float, float, float]] = []
        # Of each position its best heading, and all others at the best positions.
        for k in np.argsort(-best, kind="stable")[: 40 * config.candidates].tolist():
            x, y = near[k].tolist()
            beside = [other[2] for other in chosen if math.hypot(x - other[0], y - other[1]) <= config.apart_m]
            for turn in np.argsort(-scores[k], kind="stable")[:8].tolist():
                theta = headings[turn]
                if all(abs(wrap_scalar(theta - other)) > config.apart_rad for other in beside):
                    chosen.append((x, y, theta))
                    beside.append(theta)
            if len(chosen) >= 3 * config.candidates:
                break
        found = [np.array(pose) for pose in chosen]
        order = sorted(found, key=lambda pose: -self._lattice_score(scores, near, pose, turns))
        return order[: config.candidates]

    @staticmethod
    def _lattice_score(scores: Floats, near: Array, pose: Array, turns: int) -> float:
        k = int(np.argmin(np.abs(near - pose[:2]).sum(axis=1)))
        return float(scores[k, round(float(pose[2]) / (2.0 * math.pi) * turns) % turns])

    def _apart(self, a: Array, b: Array) -> bool:
        far = math.hypot(a[0] - b[0], a[1] - b[1]) > self.config.apart_m
        return far or abs(wrap_scalar(float(a[2] - b[2]))) > self.config.apart_rad

    def _look_at(self, likelihood: LikelihoodField, pose: Array, points: Array, scan: Scan) -> Place:
        """Refine a pose, and hold the scan against the map from there."""
        config = self.config
        found = match(likelihood, points, pose, config.matching)
        # Walls that the map does not have yet pull towards those that it has beside them: from near by only.
        found = refine(self._sharp_field, points, found.pose, self._sharp_matching)
        x, y, theta = found.pose.tolist()
        sensor = (x + self._offset_m * math.cos(theta), y + self._offset_m * math.sin(theta), theta)
        # In the open few beams return: all that there are.
        few = np.count_nonzero(scan.ranges <= scan.range_max) < config.check_beams
        looked_at = len(scan.ranges) if few else config.check_beams
        seen = agreement(self._grid, sensor, scan, looked_at)
        crossing, beams = through_walls(self._grid, sensor, scan, looked_at)
        against = seen.in_the_open + crossing
        quality = (seen.on_walls - against) / max(beams, 1)
        known = seen.on_walls + seen.in_the_open
        good = (
            known >= max(config.fewest_beams, config.least_known * beams)
            and seen.in_the_open <= config.most_against * known
            and crossing <= config.most_through * beams
            and seen.sharp >= config.least_sharp * seen.on_walls
        )
        return Place(found.pose, found.cov, quality, good)


@njit(cache=True, nogil=True, error_model="numpy")
def _score(
    values: Floats, x0: float, y0: float, cell: float, points: Array, positions: Array, scores: Floats
) -> None:
    """Write the mean field value of points ``(n, 2)`` from each position ``(m, 2)`` at each heading."""
    rows, cols = values.shape
    turns, n = scores.shape[1], points.shape[0]
    du, dv = np.empty(n), np.empty(n)
    for t in range(turns):
        c, s = math.cos(2.0 * math.pi * t / turns), math.sin(2.0 * math.pi * t / turns)
        for k in range(n):
            du[k] = (c * points[k, 0] - s * points[k, 1]) / cell
            dv[k] = (s * points[k, 0] + c * points[k, 1]) / cell
        for i in range(positions.shape[0]):
            u0, v0 = (positions[i, 0] - x0) / cell + 0.5, (positions[i, 1] - y0) / cell + 0.5
            total = 0.0
            for k in range(n):
                u, v = u0 + du[k], v0 + dv[k]
                if 0.0 <= u < cols and 0.0 <= v < rows:
                    total += values[int(v), int(u)]
            scores[i, t] = total / n
