"""FastSLAM (docs/reference/fastslam.md): particles of the path, each with independent filters of its landmarks.

FastSLAM 1.0 draws a particle's pose from the motion model; 2.0 from the motion model given what is seen now,
which leaves the weights more even. Both are one computation: a particle has a Gaussian of its pose since the last
measurement, which the measurement narrows before the pose is drawn, and 1.0 is the case in which the pose was
drawn before, so that nothing is left to narrow.
"""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from slam.backend import BackendConfig
from slam.belief import Belief
from slam.gaussian.joint_gaussian import ANYWHERE_COV, OBSERVED_LIMIT, state_rows
from slam.geometry import rotation
from slam.landmark_backend import LandmarkBackend, observation_rows
from slam.landmarks.association import IGNORED, UNMATCHED
from slam.landmarks.book import DIRECTION, EDGE, KIND, LandmarkPolicy, count_recent
from slam.landmarks.joint_compatibility import MAX_OBSERVATIONS, joint_compatibility
from slam.landmarks.spinning_wheels import FEWEST_BACK
from slam.metrics.measures import align_se2
from slam.particles.filter import correct_particles, narrow, predict_particles
from slam.particles.gate import refuse_unlikely
from slam.particles.inherited import InheritedError, beyond, common_descent
from slam.particles.maps import ParticleMaps, associate, refresh_extents
from slam.particles.resampling import (
    ResamplingPolicy,
    effective_particles,
    normalise,
    pose_moments,
    scattered,
    systematic,
)
from slam.settings import Count, NotNegative, Positive, Within
from slam.types import Array, Floats, Indices, Observations, Odometry, Scan

__all__ = ["FastSlam", "FastSlam1", "FastSlam2", "FastSlamConfig"]


@dataclass(frozen=True, kw_only=True)
class FastSlamConfig(BackendConfig):
    """FastSLAM: particles, resampling, gating and landmark management."""

    particles: Count = 100
    resampling: ResamplingPolicy = field(default_factory=ResamplingPolicy)
    gate: Positive = 11.83  # squared Mahalanobis: 99.7 % of chi-square with two degrees of freedom
    max_turn_deg: Annotated[float, Within("[0, 180]")] = 35.0  # difference in a corner's direction
    # The gate of observations with ids: a finite one refuses misread labels.
    known_gate: Annotated[float, Within("(0, inf]")] = math.inf
    # An observation that no landmark of a particle explains weighs as one at this squared distance from a
    # landmark that is known exactly: as the gate, so that to leave it unexplained never pays.
    unexplained: NotNegative = 11.83
    landmarks: LandmarkPolicy = field(default_factory=LandmarkPolicy)


class FastSlam(LandmarkBackend):
    """What both versions share.

    ``n_eff`` is that of the last update, before resampling; ``resampled`` tells whether it resampled. Once all
    particles descend from one (``ancestors``), their spread says nothing of the error that all inherit from it:
    the covariances of the belief are no less than that error's (:mod:`slam.particles.inherited`).
    """

    config: FastSlamConfig

    def __init__(self, config: FastSlamConfig | None = None) -> None:
        super().__init__(config or FastSlamConfig())
        self._start(np.zeros(3), np.eye(3) * 1e-8, 0)

    def _start(self, pose: Array, pose_cov: Array, seed: int) -> None:
        n = self.config.particles
        self._rng = np.random.Generator(np.random.PCG64(seed))
        self._poses = scattered(pose, pose_cov, n, self._rng)  # (particles, 3)
        self._covs = np.zeros((n, 3, 3))  # of the motion since the pose was last drawn; upper triangles
        self._log_weights = np.full(n, -math.log(n))
        self._weights = np.full(n, 1.0 / n)
        self._origin = np.arange(n)  # the particle of the start that each one descends from
        self._inherited = InheritedError(pose_cov)
        self._maps = ParticleMaps(n)
        self._begin(self.config.landmarks)
        self._match = np.zeros(n * MAX_OBSERVATIONS, np.int64)
        self._ancestors = np.zeros(n, np.int64)
        self._updates = 0  # since the last resampling
        self.n_eff = float(n)
        self.resampled = False
        self._believe()

    # ---- the filter ----------------------------------------------------------------------------------------

    def predict(self, odometry: Odometry) -> None:
        """Move every particle on by what the wheels measured (docs/reference/fastslam.md, Proposal)."""
        (vx, vy, omega), var_v, var_w = self._measured(odometry, self.config.odometry)
        twist = np.array([vx, vy, omega])
        self._inherited.predict(self._mean, twist, odometry.dt, var_v, var_w)
        self._move(twist, odometry.dt, var_v, var_w)
        self._believe()

    @abc.abstractmethod
    def _move(self, twist: Array, dt: float, var_v: float, var_w: float) -> None:
        """Move every particle by a measured twist of these variances."""

    def _update(self, scan: Scan) -> None:
        """Correct by the corners of a scan, keep the book of landmarks, draw the scan."""
        z = self.extractor.extract(scan)[:MAX_OBSERVATIONS]
        match, leader = self._associate(z)
        recent, still = count_recent(self._book.marks, match[leader], self._book.now)
        if self._may_spin(scan, match[leader], recent, still):
            self._allow_for_spinning_wheels(z, match, leader, scan)
        if np.count_nonzero(match[leader] >= 0) >= FEWEST_BACK:
            self._spinning.forget_motion()
        best = self._correct(z, match)
        self._spinning.note(scan, self._poses[best], recent, int(np.count_nonzero(match[leader] >= 0)))
        self._manage(z, match[best], best, scan)
        self._resample(len(z))
        self._believe()
        self._draw(scan)
        if self.key_scans.due():
            self._redraw_if_moved()

    def observe(self, observations: Observations) -> None:
        """Correct by landmark observations without a scan; known ids are believed (up to ``known_gate``)."""
        z, ids = observation_rows(observations), self._ids_told(observations)
        if ids is None:
            match, _ = self._associate(z)
            best = self._correct(z, match)
            self._manage(z, match[best], best, None)
        else:
            self._take_known(z, ids)
        self._resample(len(z))
        self._believe()

    def _take_known(self, z: Array, ids: list[int]) -> None:
        """Correct by observations of these landmarks, but those that cannot be theirs, and add new ones."""
        gate = self.config.known_gate
        if gate < math.inf:
            self._drop_misplaced()
        rows = self._rows(ids)
        if gate < math.inf:
            refuse_unlikely(
                self._poses, self._covs, self._weights, self._maps, self.config.lidar_offset_m, z, gate, rows
            )
        match = self._match_buffer(len(z))
        match[:] = rows
        best = self._correct(z, match)
        self._book.count_sightings(rows)
        for k in np.flatnonzero(rows == UNMATCHED):
            if self._book.row(ids[k]) < 0:  # not added by this very call
                self._add(z[k], best, ids[k])
        if gate < math.inf:
            self._believe()
            self._known.note(ids, z, rows, self.pose)
            if np.any(rows == IGNORED):
                self._look_elsewhere()

    def _look_elsewhere(self) -> None:
        """Start every particle over at the pose that landmarks lately refused agree on, in its own map."""
        found = self._known.elsewhere(self.pose, self._place_of)
        if found is None:
            return
        rows, offset = self._rows(found.ids), self.config.lidar_offset_m
        ahead = np.column_stack([
            offset + found.rows[:, 0] * np.cos(found.rows[:, 1]), found.rows[:, 0] * np.sin(found.rows[:, 1])
        ])  # fmt: skip
        for i in range(len(self._poses)):
            self._poses[i] = align_se2(self._maps.of(i)[rows, :2], ahead)
        self._covs[:] = ANYWHERE_COV
        self._inherited.widen(ANYWHERE_COV)
        match = self._match_buffer(len(rows))
        match[:] = rows
        self._correct(found.rows, match)
        self._known.forget()

    def _drop(self, row: int) -> None:
        self._maps.drop(row)
        self._inherited.drop(row)
        self._book.drop(row)

    def _match_buffer(self, observations: int) -> Indices:
        size = self.config.particles * observations
        if len(self._match) < size:
            self._match = np.zeros(size, np.int64)
        return self._match[:size].reshape(self.config.particles, observations)

    def _associate(self, z: Array) -> tuple[Indices, int]:
        """Return the landmark of every observation in every particle, and the particle that matches most."""
        match, maps = self._match_buffer(len(z)), self._maps
        leader = associate(
            self._poses, self._covs, self.config.lidar_offset_m, z, self._book.marks, self.config.gate,
            self.config.landmarks.new_distance_m, math.radians(self.config.max_turn_deg), maps.table, maps.records,
            maps.extents, match,
        )  # fmt: skip
        return match, leader

    def _correct(self, z: Array, match: Indices) -> int:
        """Draw the poses, weigh the particles, correct their landmarks; return the heaviest particle."""
        maps, config = self._maps, self.config
        if not len(z):
            return int(np.argmax(self._log_weights))
        maps.reserve(match.size)
        known = maps.of(int(np.argmax(self._log_weights)))[:, 2:]
        drawn = not self._covs.any()
        normals = np.zeros_like(self._poses) if drawn else self._rng.standard_normal(self._poses.shape)
        correct_particles(
            self._poses, self._covs, normals, self._log_weights, z, match, config.lidar_offset_m,
            config.unexplained, maps.table, maps.records, maps.references, maps.free, maps.free_count,
        )  # fmt: skip
        refresh_extents(maps.table, maps.records, match, maps.extents)
        normalise(self._log_weights, self._weights)
        best = int(np.argmax(self._weights))
        self._inherited.correct(
            self._poses[best], maps.of(best)[:, :2], known, z, match[best], config.lidar_offset_m,
            1.0 / effective_particles(self._weights),
        )  # fmt: skip
        return best

    def _resample(self, observations: int) -> None:
        self.resampled = False
        if not observations:
            return
        n = self.config.particles
        self.n_eff = effective_particles(self._weights)
        self._updates += 1
        if not self.config.resampling.due(self.n_eff, n, self._updates):
            return
        systematic(self._weights, self._rng.random(), self._ancestors)
        self._maps.resample(self._ancestors)
        self._poses, self._covs = self._poses[self._ancestors], self._covs[self._ancestors]
        self._origin = self._origin[self._ancestors]
        self._weights[:] = 1.0 / n
        self._log_weights[:] = -math.log(n)
        self._updates, self.resampled = 0, True

    # ---- wheels that turn in vain --------------------------------------------------------------------------

    def _allow_for_spinning_wheels(self, z: Array, match: Indices, leader: int, scan: Scan) -> None:
        """Associate anew as though the wheels had turned in vain, where one pose then explains more.

        See :mod:`slam.landmarks.spinning_wheels`. The leader's map decides for all; its landmarks
        are independent, given the path. Where the wheels did spin, the poses are drawn by what is seen in either
        version: a thousand times the usual volume is more than any number of blind draws could fill.
        """
        n, config, policy = self._maps.count, self.config, self.config.landmarks
        spinning, wide = self._spinning, np.diag(self._spinning.variances)
        lately, spun = spinning.lately, False
        pose, cov, landmarks = self._poses[leader], self._covs[leader], self._maps.of(leader)
        x, p = np.concatenate([pose, landmarks[:, :2].ravel()]), np.zeros((3 + 2 * n, 3 + 2 * n))
        p[:3, :3] = cov + wide
        index = 3 + 2 * np.arange(n)
        p[index, index], p[index, index + 1], p[index + 1, index + 1] = landmarks[:, 2:].T
        found = np.zeros(len(z), np.int64)
        joint_compatibility(
            x, p, config.lidar_offset_m, z, self._book.marks, policy.new_distance_m,
            math.radians(config.max_turn_deg), found,
        )  # fmt: skip
        if spinning.enough(found, match[leader]):
            usual_fit = self._fit(pose, cov, landmarks, z, match[leader], scan)
            spun = spinning.explain(self._fit(pose, cov + wide, landmarks, z, found, scan), usual_fit)
        if spun or lately:
            self._covs += wide
            self._inherited.widen(wide)
        if spun:
            match[:] = found

    def _fit(self, pose: Array, cov: Array, landmarks: Array, z: Array, match: Indices, scan: Scan) -> float:
        """Correct a particle's pose by a match; return how well the scan fits the map from there."""
        pose, offset = pose.copy(), self.config.lidar_offset_m
        narrow(pose, cov.copy(), landmarks, np.arange(len(landmarks)), z, match, offset, 0.0)
        return self.grid.agreement(self.sensor_pose(pose), scan)

    # ---- a pose from elsewhere -------------------------------------------------------------------------------

    def _place(self, pose: Array, pose_cov: Array) -> None:
        # Drawn by what is seen, as after wheels that spun: in three dimensions none of the particles would hit it.
        n = self.config.particles
        self._poses[:], self._covs[:] = pose, np.triu(pose_cov)
        self._weights[:], self._log_weights[:] = 1.0 / n, -math.log(n)
        self._inherited.place(pose_cov)
        self._spinning.forget_motion()
        self._believe()

    # ---- the book of landmarks -----------------------------------------------------------------------------

    def _manage(self, z: Array, match: Indices, best: int, scan: Scan | None) -> None:
        """Tentative → confirmed → dropped (:mod:`slam.landmarks.book`), for all particles as the best has it.

        So a row is the same landmark in every particle, which has it where it saw it from its own pose.
        """
        x = np.concatenate([self._poses[best], self._maps.of(best)[:, :2].ravel()])
        new, gone = self._book.review(x, self.config.lidar_offset_m, z, match, scan)
        for k in new:
            self._add(z[k], best, None)
        for row in gone:
            self._drop(row)

    def _add(self, z: Array, best: int, known_id: int | None) -> None:
        direction, extent = float(z[DIRECTION]) + float(self._poses[best, 2]), (float(z[EDGE]), 0.0)
        self._book.add(float(z[KIND]), direction, known_id, extent=extent)
        self._maps.add(self._poses, z, self.config.lidar_offset_m)
        self._inherited.add(self._poses[best], z, self.config.lidar_offset_m)

    # ---- the belief ----------------------------------------------------------------------------------------

    def _believe(self) -> None:
        """Sum the particles up; of the landmarks, only when somebody asks."""
        config = self.config
        self._mean, self._spread = np.zeros(3), np.zeros((3, 3))
        floor = np.array([config.start_sigma_m, config.start_sigma_m, config.start_sigma_rad])
        pose_moments(self._poses, self._covs, self._weights, floor, self._mean, self._spread)
        self._cov: Array | None = None
        self._mixture: tuple[Array, Array] | None = None

    def _landmark_moments(self) -> tuple[Array, Array]:
        # Of all particles, not of the heaviest: the mean has the least expected error, goes with the mean pose,
        # and does not jump (nor make the map be redrawn) each time another particle becomes the heaviest.
        if self._mixture is None:
            self._mixture = self._maps.mixture(self._weights)
            beyond(self._inherited.of_landmarks(), self._mixture[1], common_descent(self._origin, self._weights))
        return self._mixture

    @property
    def _points(self) -> Array:
        return self._landmark_moments()[0]

    def _cov_with(self, rows: Indices) -> Array:
        states = state_rows(rows, robot=True)
        return self._inherited.cov[np.ix_(states, states)]

    @property
    def ancestors(self) -> int:
        """Number of particles of the start that still have descendants."""
        return len(np.unique(self._origin))

    @property
    def pose(self) -> Array:
        """Pose mean ``(3,)``."""
        return self._mean.copy()

    @property
    def pose_cov(self) -> Array:
        """Pose covariance ``(3, 3)``."""
        if self._cov is None:
            self._cov = self._spread.copy()
            inherited = self._inherited.cov[:3, :3].copy()
            beyond(inherited[None], self._cov[None], common_descent(self._origin, self._weights))
        return self._cov.copy()

    def near_landmarks(self, out: Floats) -> None:
        """Write the nearest landmarks in the robot frame (see the base class)."""
        points, covs = self._landmark_moments()
        ahead = points - self._mean[:2]
        nearest = np.argsort(np.sum(ahead**2, axis=1), kind="stable")[: len(out)]
        k, from_body = len(nearest), rotation(float(self._mean[2]))
        turned = from_body.T @ covs[nearest] @ from_body
        out[:] = 0.0
        out[:k, :2] = ahead[nearest] @ from_body
        out[:k, 2], out[:k, 3], out[:k, 4] = turned[:, 0, 0], turned[:, 0, 1], turned[:, 1, 1]
        np.clip(out, -OBSERVED_LIMIT, OBSERVED_LIMIT, out=out)
        out[:k, 5] = 1.0

    @property
    def belief(self) -> Belief:
        """Pose, landmarks and grid; there is no joint covariance."""
        points, cov = self._landmark_moments()
        return Belief(
            pose=self.pose,
            pose_cov=self.pose_cov,
            landmarks=points.copy(),
            landmark_cov=cov.copy(),
            landmark_ids=self._book.ids.copy(),
            grid=self.grid,
            health=self.health,
            landmark_kinds=self._marks[:, 0].astype(np.int8),
        )


class FastSlam1(FastSlam):
    """FastSLAM 1.0, backend ``fastslam1``: poses are drawn from the motion model."""

    def _move(self, twist: Array, dt: float, var_v: float, var_w: float) -> None:
        sigma = np.sqrt([var_v, var_v, var_w])
        twists = twist + sigma * self._rng.standard_normal(self._poses.shape)
        predict_particles(self._poses, self._covs, twists, dt, 0.0, 0.0)


class FastSlam2(FastSlam):
    """FastSLAM 2.0, backend ``fastslam2``: poses are drawn once the measurement is known, and given it."""

    def _move(self, twist: Array, dt: float, var_v: float, var_w: float) -> None:
        predict_particles(self._poses, self._covs, np.tile(twist, (len(self._poses), 1)), dt, var_v, var_w)
