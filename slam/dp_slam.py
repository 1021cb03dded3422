"""DP-SLAM: particles over occupancy grids without landmarks, backend ``dp-slam`` (docs/reference/dp_slam.md).

Eliazar and Parr's shared grid and ancestry tree (2003, 2004) hold the maps, so that memory and time do not
multiply by the particles. Each particle's pose is drawn around where the scan fits its own map (Grisetti,
Stachniss and Burgard 2007), starting from scan-matched odometry (Hähnel et al. 2003), so that few particles
suffice. They are updated when the robot has moved on; between two updates the scan-matched odometry carries all
of them along.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from slam.backend import BackendConfig, SurfaceBackend, found_cov
from slam.geometry import about_z, compose, inverse, wrap
from slam.grids.flat_walls import along_walls
from slam.grids.key_scans import largest_shift
from slam.grids.scan_matching import MatchConfig, body_points
from slam.grids.scan_odometry import ScanOdometry, ScanOdometryConfig
from slam.health.monitor import HealthConfig
from slam.particles.grids import ParticleGrids, ScanCells
from slam.particles.inherited import beyond, common_descent
from slam.particles.map_error import MapError, transport
from slam.particles.match import ParticleMatcher
from slam.particles.paths import Paths
from slam.particles.resampling import (
    ResamplingPolicy,
    effective_particles,
    normalise,
    pose_moments,
    scattered,
    systematic,
)
from slam.particles.shared_grid import CopiedGrids, SharedGrid
from slam.settings import Few, Gap, PositiveShare, Sigma, Within
from slam.types import Array, Indices, Odometry, Scan

__all__ = ["DpSlam", "DpSlamConfig"]

_LEAD_SHARE = 0.5  # the map's particle is followed until another weighs more than twice as much


@dataclass(frozen=True, kw_only=True)
class DpSlamConfig(BackendConfig):
    """DP-SLAM: particles, when they are updated, how freely they are drawn."""

    particles: Few = 30
    update_m: Gap = 0.2  # the particles are updated when the robot has moved …
    update_rad: Gap = 0.2  # … or turned so far since the last time
    # What scan-matched odometry may have drifted from one update to the next, besides its own covariance. More
    # than it does: particles that all go one way cannot close a loop (docs/reference/dp_slam.md).
    drift_m: Sigma = 0.02
    drift_rad: Sigma = 0.01
    # Side of the pieces of the map that have an error each, in the covariance.
    tile_m: Annotated[float, Within("[0.1, 1000]")] = 2.0
    # Likelihood of a beam's end, against 1 on a surface, where a particle's map knows nothing, and where it knows
    # of no surface: what is new says less against a particle than what contradicts its map.
    unknown: PositiveShare = 0.3
    free: PositiveShare = 0.1
    resampling: ResamplingPolicy = field(default_factory=ResamplingPolicy)
    matching: MatchConfig = field(default_factory=MatchConfig)
    scan_odometry: ScanOdometryConfig = field(default_factory=ScanOdometryConfig)
    # Particles close loops by themselves: until another one leads, the leading one's map contradicts the scans.
    # How often a scan of a robot that is fine falls into each bin is that of the Intel log.
    health: HealthConfig = field(default_factory=lambda: HealthConfig(
        against_fine=(0.60, 0.25, 0.10, 0.04, 0.01), sharp_fine=(0.02, 0.12, 0.33, 0.33, 0.20), bias=2.7
    ))  # fmt: skip
    copies: bool = False  # a grid of its own for each particle instead of the shared one: the same, dearer


class DpSlam(SurfaceBackend):
    """Particles with maps of their own in one grid.

    ``n_eff`` is that of the last update, before resampling; ``resampled`` tells whether it resampled. The pose's
    covariance is no less than that of the error which all particles inherit with their ancestors' map
    (:mod:`slam.particles.map_error`).
    """

    relocalises = True
    maps = "dp-slam maps occupied cells"
    config: DpSlamConfig

    def __init__(self, config: DpSlamConfig | None = None) -> None:
        super().__init__(config or DpSlamConfig())
        self._start(np.zeros(3), np.eye(3) * 1e-8, 0)

    def _start(self, pose: Array, pose_cov: Array, seed: int) -> None:
        config = self.config
        n = config.particles
        self._rng = np.random.Generator(np.random.PCG64(seed))
        self._poses = scattered(pose, pose_cov, n, self._rng)  # (particles, 3) at the last update
        self._log_weights = np.full(n, -math.log(n))
        self._weights = np.full(n, 1.0 / n)
        grids = CopiedGrids if config.copies else SharedGrid
        self.grids: ParticleGrids = grids(n, config.matching.cell_m)
        self._map_error = MapError(pose_cov, config.tile_m)
        self._origin = np.arange(n)  # the particle of the start that each one descends from
        self._matcher, self._cells = ParticleMatcher(config.matching), ScanCells()
        self._paths, self._shown = Paths(n), np.zeros((0, 3))  # poses that the grid was drawn from
        self._key: list[tuple[Scan, NDArray[np.int16]]] = []  # one scan an update
        self._odometry = ScanOdometry(config.scan_odometry, config.matching, config.odometry)
        self._lead, self._drawn_from = 0, pose.copy()  # the lead's pose at the last update
        self._drift = np.diag(np.square([config.drift_m, config.drift_m, config.drift_rad]))
        self._points = np.zeros((0, 2))  # where the scan's beams ended, in the body frame
        self._updates = 0  # since the last resampling
        self.n_eff = float(n)
        self.resampled = False
        self._believed: tuple[Array, Array] | None = None

    # ---- the filter ----------------------------------------------------------------------------------------

    def predict(self, odometry: Odometry) -> None:
        """Move on by what the wheels measured."""
        self._odometry.predict(odometry)
        self._believed = None

    def _update(self, scan: Scan) -> None:
        """Follow the motion by the scan; where the robot has moved on, weigh and correct the particles by it."""
        self._take(scan, self._points, due=self._moved_on())

    def _foreseen(self, scan: Scan) -> Array:
        """Follow the motion by the scan; return where that has the leading particle."""
        self._points = body_points(scan, self.config.matching, offset_m=self.config.lidar_offset_m)
        self._odometry.correct(self._points)
        self._believed = None
        return compose(self._poses[self._lead], self._motion())

    def _take(self, scan: Scan, points: Array, *, due: bool) -> None:
        """Update the particles where that is due; draw the scan, unless it contradicts the map."""
        self.extractor.extract(scan)  # the surfaces that the grid is drawn with
        if due:
            self._update_particles(points)
            self._key.append((scan.kept(), self.extractor.surface.copy()))
            self._redraw_if_moved()
            self._shown = np.vstack([self._shown, self.sensor_pose(self._poses[self._lead])])
        self._believed = None
        body = compose(self._poses[self._lead], self._motion())
        x, y, theta = body.tolist()
        if not (self._doubtful and self._recovers and self._contradicts((x, y, theta), scan)):
            self.grid.integrate(
                self.sensor_pose(body), scan, self.extractor.surface, body=(x, y, self.config.body_radius_m)
            )

    def _motion(self) -> Array:
        """Return how the robot has moved since the last update, in the body frame of then ``(3,)``."""
        return compose(inverse(self._odometry.settled), self._odometry.pose)

    def _moved_on(self) -> bool:
        if not self._key:
            return True
        x, y, theta = self._motion().tolist()
        return math.hypot(x, y) >= self.config.update_m or abs(theta) >= self.config.update_rad

    def _update_particles(self, points: Array) -> None:
        """Draw each particle's pose around where the scan fits its map, weigh it, write its map; resample."""
        config = self.config
        motion = self._motion()
        guesses = np.array([compose(pose, motion) for pose in self._poses])
        reach = float(np.sqrt((points * points).sum(axis=1).max(initial=0.0))) + abs(config.lidar_offset_m)
        self.grids.enclose(guesses[:, :2].min(axis=0) - reach, guesses[:, :2].max(axis=0) + reach)
        matched, _ = along_walls(points, config.matching)
        if self._key:
            self._draw_poses(guesses, matched)
        else:
            self._poses = guesses
        ancestors = self._choose_survivors()
        self._follow_the_error(matched)
        self._odometry.settle()
        for i in np.unique(ancestors):  # the others' maps are forgotten at once
            self._cells.trace(self.grids.lattice, self._poses[i], config.lidar_offset_m, points)
            self.grids.write(int(i), self._cells)
        self._paths.append(self._poses)
        if self.resampled:
            self._resample(ancestors)

    def _draw_poses(self, guesses: Array, points: Array) -> None:
        """Sample from the Gaussian around each particle's best fit; its weight is the evidence, at the peak."""
        config = self.config
        normals = self._rng.standard_normal(self._poses.shape)
        for i, guess in enumerate(guesses):
            info = np.linalg.inv(self._motion_cov(float(guess[2])) + self._drift)
            best, curvature, log_likelihood = self._matcher.fit(
                self.grids, i, points, guess, info, unknown=config.unknown, free=config.free
            )
            self._log_weights[i] += log_likelihood
            best += np.linalg.solve(np.linalg.cholesky(curvature).T, normals[i])
            best[2] = float(wrap(best[2]))
            self._poses[i] = best
        normalise(self._log_weights, self._weights)

    def _motion_cov(self, heading: float) -> Array:
        """Return the covariance ``(3, 3)`` of the motion since the last update, for a particle that heads so."""
        # From the local frame, in which the covariance is kept, to the particle's.
        r = about_z(heading - float(self._odometry.pose[2]))
        cov: Array = r @ self._odometry.cov @ r.T
        return cov

    def _follow_the_error(self, points: Array) -> None:
        """Follow the error that all inherit: how the lead was matched, and from where its scan will be drawn.

        The match was weighed by ``sigma_m``; how exact it is here, the distances of the beams' ends from the map
        tell. Of a drawn pose's covariance 1/N_eff stays as an error.
        """
        config, error, pose = self.config, self._map_error, self._poses[self._lead]
        c, s = math.cos(pose[2]), math.sin(pose[2])
        ends = pose[:2] + points @ np.array([[c, s], [-s, c]])
        groups, tiles = error.tiles(ends)
        infos, distance2 = self._matcher.informations(self.grids, self._lead, points, pose, groups, len(tiles))
        motion = self._motion_cov(float(pose[2]))
        prior = np.linalg.inv(motion + self._drift)
        noise = distance2 / config.matching.sigma_m**2
        drawn = 1.0 / self.n_eff if self._key else 0.0  # the first poses are where the motion led
        draw = drawn * np.linalg.inv(prior + infos.sum(axis=0))
        error.match(self._drawn_from, pose, motion, prior, tiles, infos, noise, draw)
        error.draw(pose, tiles, np.bincount(groups, minlength=len(tiles)).astype(np.float64))
        self._drawn_from = pose.copy()

    def _choose_survivors(self) -> Indices:
        """Return whom each particle descends from after this update; ``resampled`` tells whether that is news."""
        n = self.config.particles
        self.n_eff = effective_particles(self._weights)
        self._updates += 1
        self.resampled = self.config.resampling.due(self.n_eff, n, self._updates)
        ancestors = np.arange(n)
        if self.resampled:
            systematic(self._weights, self._rng.random(), ancestors)
        if self._weights[self._lead] < _LEAD_SHARE * self._weights.max() or not np.any(ancestors == self._lead):
            self._lead = int(np.argmax(self._weights))
        return ancestors

    def _resample(self, ancestors: Indices) -> None:
        n = self.config.particles
        self._lead = int(np.flatnonzero(ancestors == self._lead)[0])
        self.grids.resample(ancestors)
        self._paths.resample(ancestors)
        self._poses, self._origin = self._poses[ancestors], self._origin[ancestors]
        self._weights[:] = 1.0 / n
        self._log_weights[:] = -math.log(n)
        self._updates = 0

    def _place(self, pose: Array, pose_cov: Array) -> None:
        n = self.config.particles
        self._poses = scattered(pose, pose_cov, n, self._rng)
        self._weights[:], self._log_weights[:] = 1.0 / n, -math.log(n)
        self._odometry.forget()
        self._believed = None

    def _relocate(self, pose: Array, cov: Array, scan: Scan) -> None:
        """Draw every particle where the scan fits its map, next to a pose ``(3,)``."""
        self._place(pose, cov + found_cov())
        self._poses[:] = pose  # they are drawn anew, around the best fit
        self._take(scan, body_points(scan, self.config.matching, offset_m=self.config.lidar_offset_m), due=True)

    def _redraw_kept(self, poses: Array) -> None:
        self.grid.redraw(self._shown, self._key)

    # ---- the map that is shown -----------------------------------------------------------------------------

    def _redraw_if_moved(self) -> bool:
        """Redraw the grid where the leading particle took another way than it was drawn from; tell whether."""
        drawn = self._shown
        bodies = self._paths.of(self._lead)[: len(drawn)]
        path = np.array([self.sensor_pose(body) for body in bodies]).reshape(-1, 3)
        if largest_shift(path, drawn, self.config.key_scans.lever_m) <= 0.5 * self.grid.resolution:
            return False
        # What contradicts the map is not drawn, whatever it is drawn from.
        kept = self.recovery.kept if self._doubtful and self._recovers else None
        sound = len(self._key) if kept is None else len(kept["_key"])
        self.grid.redraw(path[:sound], self._key[:sound])
        self._shown = path
        return True

    # ---- the belief ----------------------------------------------------------------------------------------

    def _moments(self) -> tuple[Array, Array]:
        """Return mean and covariance of the particles, carried along by the motion since their last update."""
        if self._believed is None:
            config, motion = self.config, self._motion()
            c, s = np.cos(self._poses[:, 2]), np.sin(self._poses[:, 2])
            now = self._poses + np.column_stack(
                [c * motion[0] - s * motion[1], s * motion[0] + c * motion[1], np.full(len(c), motion[2])]
            )
            mean, cov = np.zeros(3), np.zeros((3, 3))
            floor = np.array([config.start_sigma_m, config.start_sigma_m, config.start_sigma_rad])
            pose_moments(now, np.zeros((len(now), 3, 3)), self._weights, floor, mean, cov)
            moved = transport(self._drawn_from[:2], mean[:2])
            inherited = moved @ self._map_error.pose_cov @ moved.T
            beyond(inherited[None], cov[None], common_descent(self._origin, self._weights))
            self._believed = mean, cov + self._motion_cov(float(mean[2]))
        return self._believed

    @property
    def pose(self) -> Array:
        """Pose mean ``(3,)``."""
        return self._moments()[0].copy()

    @property
    def pose_cov(self) -> Array:
        """Pose covariance ``(3, 3)``."""
        return self._moments()[1].copy()

    @property
    def path(self) -> Array:
        """The leading particle's poses at every update ``(updates, 3)``: the path that its map belongs to."""
        return self._paths.of(self._lead)
