"""EKF-SLAM over corner points (theory.md A): one joint Gaussian of the robot and every landmark.

The covariance is kept as its upper triangle. All observations of a scan make one stacked update, a rank-2m
downdate of the triangle; a scan's own cost is linear in the landmarks but for that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from slam.backend import Backend, BackendConfig
from slam.belief import Belief
from slam.gaussian.joint_gaussian import add_landmark, leave_out, near_landmarks, read_block, symmetric_block
from slam.gaussian.lanes import aligned_zeros
from slam.gaussian.stacked_update import stacked_update, work_space
from slam.landmarks.association import UNMATCHED, joint_compatibility, refuse_unlikely
from slam.landmarks.book import DIRECTION, FROM, KIND, TO, LandmarkBook, LandmarkPolicy, match_and_recall
from slam.landmarks.loop_closing import agreeing, put_off
from slam.metrics.chi_square import chi2_quantile
from slam.metrics.measures import nees_pose
from slam.motion import predict_robot
from slam.settings import require, unknown_name
from slam.types import LINE, Observations, Odometry, Scan

__all__ = ["ASSOCIATIONS", "EkfConfig", "EkfLinesConfig", "EkfSlam"]

Array = NDArray[np.float64]

ASSOCIATIONS = ("nearest", "individual", "joint")
"""How observations are matched: each to the nearest landmark within its gate; only where a single landmark is
within the gate; or as many as one pose can explain together (JCBB)."""

_MAX_OBSERVATIONS = 64
_MOST_NODES = 4000
_FEWEST_BACK = 2  # landmarks; one alone says nothing about the heading
# Of k pairings together: 99 % of chi-square with 2k degrees of freedom.
_JOINT_GATES = np.array([0.0] + [chi2_quantile(0.99, 2 * k) for k in range(1, _MAX_OBSERVATIONS + 1)])


@dataclass(frozen=True, kw_only=True)
class EkfConfig(BackendConfig):
    """EKF-SLAM: gating and landmark management."""

    association: str = "nearest"  # or "individual", "joint": see ASSOCIATIONS
    gate: float = 11.83  # squared Mahalanobis: 99.7 % of chi-square with two degrees of freedom
    known_gate: float = math.inf  # the same for observations with ids: a finite one refuses misread labels
    max_turn_deg: float = 35.0  # difference in a corner's direction
    loop_sigma_m: float = math.inf  # old landmarks expected no better than to this count only together
    lines: bool = False  # take straight walls for landmarks, too (theory.md A)
    landmarks: LandmarkPolicy = field(default_factory=LandmarkPolicy)

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.gate > 0 and self.known_gate > 0, "EkfConfig.gate and known_gate must be > 0")
        if self.association not in ASSOCIATIONS:
            raise unknown_name("EkfConfig.association", self.association, ASSOCIATIONS)


@dataclass(frozen=True, kw_only=True)
class EkfLinesConfig(EkfConfig):
    """EKF-SLAM over walls and what corners say beside them."""

    lines: bool = True
    # What two landmarks could have made is left alone: a wall's corners lie close together, and one taken for
    # another bends the map. Over apartments of the training seeds 100-149 at three times the noise, the average
    # pose NEES/3 was 1.15 with the nearest and 1.00 so; at nominal noise the error was the same.
    association: str = "individual"
    loop_sigma_m: float = 0.1  # parallel walls stand apart by a few times that


class EkfSlam(Backend):
    """The standard EKF-SLAM backend, ``ekf``; with ``lines`` ``ekf-lines``."""

    config: EkfConfig

    def __init__(self, config: EkfConfig | None = None) -> None:
        super().__init__(config or EkfConfig())
        c = self.config
        self._max_turn = math.radians(c.max_turn_deg)
        self._gates = np.array([c.gate, c.landmarks.new_distance_m, self._max_turn])
        self._start(np.zeros(3), np.eye(3) * 1e-8, 0)

    def _start(self, pose: Array, pose_cov: Array, seed: int) -> None:
        del seed  # nothing here is drawn
        self._noise = self.config.odometry
        self._n = 3
        self._x = np.zeros(3 + 2 * 32)
        self._p = aligned_zeros(len(self._x), len(self._x))  # upper triangle
        self._x[:3] = pose
        self._p[:3, :3] = np.triu(pose_cov)
        self._book = LandmarkBook(self.config.landmarks)
        self._h, self._w, self._s = work_space(_MAX_OBSERVATIONS, len(self._x))
        self._match = np.zeros(_MAX_OBSERVATIONS, np.int64)
        self._distance = np.zeros(_MAX_OBSERVATIONS)
        self._recall = (0, 0)  # see LandmarkBook.recently_seen
        self._twist = (0.0, 0.0, 0.0)
        self._unseen_motion = (0.0, 0.0)  # [m, rad] what the wheels claim since the landmarks were last in sight
        self.nis = 0.0
        self.nis_dof = 0

    # ---- the filter ----------------------------------------------------------------------------------------

    def predict(self, odometry: Odometry) -> None:
        """Move on by what the wheels measured (theory.md A, predict)."""
        measured, dt = odometry
        vx, vy, omega = np.asarray(measured, dtype=np.float64).tolist()
        twist = vx, vy, omega
        noise = self._noise
        var_v, var_w = noise.variances(vx, vy, omega, slip=noise.slip(self._twist, twist, dt))
        predict_robot(self._x, self._p, self._n, vx, vy, omega, dt, var_v, var_w)
        self._twist = twist
        lever = noise.lever_m
        way = math.hypot(vx, vy, lever * omega) * dt
        moved, turned = self._unseen_motion
        self._unseen_motion = moved + way, turned + way / lever

    def update(self, scan: Scan) -> None:
        """Correct by the corners of a scan, keep the book of landmarks, draw the scan."""
        z = self._observed(scan)
        match = self._associate(z)
        loop = self._put_off(z, match)
        if self._out_of_sight(match):
            match = self._allow_for_spinning_wheels(z, match, scan)
        self._correct(z, match)
        if loop:
            self._close_loop(z, match)
        if self.nis_dof >= 2 * _FEWEST_BACK:
            self._unseen_motion = (0.0, 0.0)
        self._manage(z, match, scan)
        self._draw(scan)
        if self.key_scans.due():
            self.key_scans.redraw_if_moved(self.grid, *self._map_points())

    def _observed(self, scan: Scan) -> Array:
        corners = self.extractor.extract(scan)
        return (self.extractor.with_walls() if self.config.lines else corners)[:_MAX_OBSERVATIONS]

    def observe(self, observations: Observations) -> None:
        """Correct by landmark observations without a scan; known ids are believed (up to ``known_gate``).

        New ids are added at once; without ids, landmarks are confirmed as with scans.
        """
        rb = np.asarray(observations.range_bearing, dtype=np.float64).reshape(-1, 2)
        cov = np.asarray(observations.cov, dtype=np.float64).reshape(-1, 2, 2)
        if len(rb) != len(cov) or not (np.all(np.isfinite(rb)) and np.all(np.isfinite(cov))):
            raise ValueError("observations need finite range_bearing (m, 2) and cov (m, 2, 2) of one length")
        z = np.zeros((len(rb), 10))
        z[:, :2], z[:, 2], z[:, 3], z[:, 4] = rb, cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
        for begin in range(0, len(z), _MAX_OBSERVATIONS):
            part = z[begin : begin + _MAX_OBSERVATIONS]
            if observations.ids is None:
                match = self._associate(part)
                loop = self._put_off(part, match)
                self._correct(part, match)
                if loop:
                    self._close_loop(part, match)
                self._manage(part, match, None)
                continue
            ids = np.asarray(observations.ids)[begin : begin + _MAX_OBSERVATIONS]
            match = np.array([self._book.row(int(i)) for i in ids], np.int64)
            if self.config.known_gate < math.inf:
                refuse_unlikely(
                    self._x, self._p, self.config.lidar_offset_m, part, self.config.known_gate, match, self._h[0]
                )
            self._correct(part, match)
            self._book.count_sightings(match)
            for k in np.flatnonzero(match == UNMATCHED):
                if self._book.row(int(ids[k])) < 0:  # not added by this very call
                    self._add(part[k], int(ids[k]))

    def _associate(self, z: Array) -> NDArray[np.int64]:
        config = self.config
        if config.association == "joint":
            match = self._associate_jointly(z)
            self._recall = self._book.recently_seen(match)
            return match
        match, book = self._match[: len(z)], self._book
        self._recall = match_and_recall(
            self._x, self._p, config.lidar_offset_m, z, book.marks, book.now, self._gates,
            config.association == "individual", match, self._distance,
        )  # fmt: skip
        return match

    def _associate_jointly(self, z: Array) -> NDArray[np.int64]:
        config, match = self.config, self._match[: len(z)]
        joint_compatibility(
            self._x, self._p, self._book.count, config.lidar_offset_m, z, self._book.marks, _JOINT_GATES,
            config.landmarks.new_distance_m, self._max_turn, _MOST_NODES, match,
        )  # fmt: skip
        return match

    def _put_off(self, z: Array, match: NDArray[np.int64]) -> bool:
        """Leave out old landmarks that one match alone does not make sure; tell whether there are any."""
        sigma, book = self.config.loop_sigma_m, self._book
        if sigma == math.inf:
            return False
        x, p, offset = self._x, self._p, self.config.lidar_offset_m
        return put_off(x, p, offset, z, book.marks, book.now, sigma, match) > 0

    def _close_loop(self, z: Array, match: NDArray[np.int64]) -> None:
        """Match and correct by old landmarks, after all the others, where several of them agree."""
        config, book = self.config, self._book
        rows = np.flatnonzero(match < 0)
        more = np.empty(len(rows), np.int64)
        old = agreeing(
            self._x, self._p, config.lidar_offset_m, z[rows], book.marks, book.now, config.loop_sigma_m,
            _JOINT_GATES, config.landmarks.new_distance_m, self._max_turn, _MOST_NODES, more,
        )  # fmt: skip
        if old == 0:
            return
        nis, dof = self.nis, self.nis_dof
        closing = np.full(len(match), UNMATCHED)
        closing[rows] = more
        self._correct(z, closing)
        self.nis, self.nis_dof = self.nis + nis, self.nis_dof + dof
        match[closing >= 0] = closing[closing >= 0]

    def _out_of_sight(self, match: NDArray[np.int64]) -> bool:
        """Tell whether many of the landmarks that the last scans showed are missing all at once."""
        del match  # counted when it was made
        recent, still = self._recall
        return recent >= 3 and still < 0.6 * recent

    def _allow_for_spinning_wheels(self, z: Array, usual: NDArray[np.int64], scan: Scan) -> NDArray[np.int64]:
        """Associate again as though the wheels had turned in vain; return ``usual`` unless that explains more.

        Against a wall, or pulling away too hard, the wheels turn and the robot does not follow. V knows nothing
        of that, and a filter that trusts it has every gate closed within two steps and is lost for good. So the
        pose may be off by as much as the wheels claim to have moved since the landmarks were last in sight.
        Gates as wide as that would take any corner near by for a landmark. So one pose must explain them all, and
        the scan must fit the map better from there: what changed may be the view, through a door, say.
        """
        n = self._n
        x, p = self._x[:n].copy(), self._p[:n, :n].copy()
        usual = usual.copy()
        fit = self._fit(z, usual, scan)
        self._x[:n], self._p[:n, :n] = x, p
        moved, turned = self._unseen_motion
        self._p[0, 0] += moved**2
        self._p[1, 1] += moved**2
        self._p[2, 2] += turned**2
        match = self._associate_jointly(z)
        found = np.count_nonzero(match >= 0)
        back = found >= _FEWEST_BACK and found > np.count_nonzero(usual >= 0)
        p_wide = self._p[:3, :3].copy()
        if back and self._fit(z, match, scan) > fit:
            p[:3, :3] = p_wide
            usual = match
        self._x[:n], self._p[:n, :n] = x, p
        return usual

    def _fit(self, z: Array, match: NDArray[np.int64], scan: Scan) -> float:
        """Correct by a match; return how well the scan fits the map from there."""
        self._correct(z, match)
        return self.grid.agreement(self.sensor_pose(), scan)

    def _correct(self, z: Array, match: NDArray[np.int64]) -> None:
        """Make one stacked update of all matched observations."""
        self.nis_dof, self.nis = stacked_update(
            self._x, self._p, self._n, z, match, self.config.lidar_offset_m, self._h, self._w, self._s
        )

    def _manage(self, z: Array, match: NDArray[np.int64], scan: Scan | None) -> None:
        """Tentative → confirmed → dropped (see :mod:`slam.landmarks.book`)."""
        book, offset = self._book, self.config.lidar_offset_m
        if scan is None:
            new, gone = book.review(self._x, offset, z, match).tolist(), list[int]()
        else:
            new, gone = book.review_scan(self._x, offset, z, match, scan)
        for k in new:
            self._add(z[k], None)
        for row in gone:
            self._drop(row)

    def _add(self, z: Array, known_id: int | None) -> None:
        if self._n + 2 > len(self._x):
            self._enlarge()
        add_landmark(self._x, self._p, self._n, z, self.config.lidar_offset_m)
        direction = float(z[DIRECTION]) + float(self._x[2])
        extent = (0.0, 0.0)
        if z[KIND] == LINE:
            # Where the sensor stands along the wall, from the wall's foot; its own foot is there.
            sensor_x, sensor_y, _ = self.sensor_pose().tolist()
            along = math.cos(direction) * sensor_y - math.sin(direction) * sensor_x
            extent = (along + float(z[FROM]), along + float(z[TO]))
        self._n += 2
        self._book.add(float(z[KIND]), direction, known_id, extent=extent)

    def _drop(self, row: int) -> None:
        """Take a landmark out of the state: marginalisation is leaving out its rows and columns."""
        leave_out(self._x, self._p, self._n, 3 + 2 * row)
        self._n -= 2
        self._book.drop(row)

    def _enlarge(self) -> None:
        size = 2 * len(self._x)
        x, p = np.zeros(size), aligned_zeros(size, size)
        x[: self._n] = self._x[: self._n]
        p[: self._n, : self._n] = self._p[: self._n, : self._n]
        self._x, self._p = x, p
        self._h, self._w, self._s = work_space(_MAX_OBSERVATIONS, size)

    def _map_points(self) -> tuple[Array, NDArray[np.int64]]:
        """Return every landmark's estimate ``(n, 2)``, and which row an id has."""
        return self._points, self._book.row_of_id

    def _landmarks_in_view(self) -> tuple[NDArray[np.int64], Array]:
        rows = self._book.just_seen()
        return self._book.ids[rows], self._points[rows]

    # ---- the belief ----------------------------------------------------------------------------------------

    @property
    def _points(self) -> Array:
        return self._x[3 : self._n].reshape(-1, 2)

    @property
    def pose(self) -> Array:
        """Pose mean ``(3,)``."""
        return self._x[:3].copy()

    @property
    def pose_cov(self) -> Array:
        """Pose covariance ``(3, 3)``."""
        out = np.empty((3, 3))
        symmetric_block(self._p, out)
        return out

    def pose_nees(self, true_pose: Array) -> float:
        """Return the NEES of the pose against the truth ``(3,)``."""
        # The kernel reads nothing but the upper triangle: no copies.
        return float(nees_pose(self._x, self._p, np.asarray(true_pose, dtype=np.float64)))

    @property
    def joint_cov(self) -> Array:
        """Covariance ``(3 + 2n, 3 + 2n)`` of the robot and every landmark, walls included."""
        upper = np.triu(self._p[: self._n, : self._n])
        return upper + np.triu(upper, 1).T

    @property
    def landmark_count(self) -> int:
        """Number of confirmed landmarks, walls included."""
        return self._book.count

    def _point_rows(self) -> NDArray[np.int64]:
        return np.flatnonzero(self._book.marks[:, 0] != LINE)

    def landmark_details(self) -> tuple[NDArray[np.int64], Array]:
        """Return per point landmark how often it was seen and its direction in the belief's frame [rad]."""
        rows = self._point_rows()
        return self._book.times_seen()[rows], self._book.directions()[rows]

    def near_landmarks(self, out: NDArray[np.float32]) -> None:
        """Write the nearest landmarks in the robot frame (see the base class)."""
        near_landmarks(self._x, self._p, self._book.marks, out)

    @property
    def belief(self) -> Belief:
        """Pose, landmarks, joint covariance (of pose and points) and grid."""
        are_lines = self._book.marks[:, 0] == LINE
        rows, lines = np.flatnonzero(~are_lines), np.flatnonzero(are_lines)
        marks = np.concatenate([rows, lines])
        order = np.concatenate([np.arange(3), np.column_stack([3 + 2 * marks, 4 + 2 * marks]).ravel()])
        whole = np.empty((self._n, self._n))
        read_block(self._p, order, whole)
        joint = whole[: 3 + 2 * len(rows), : 3 + 2 * len(rows)].copy() if len(lines) else whole
        index = 3 + 2 * np.arange(len(rows))
        cov = np.empty((len(index), 2, 2))
        for a in range(2):
            for b in range(2):
                cov[:, a, b] = joint[index + a, index + b]
        return Belief(
            pose=self.pose,
            pose_cov=joint[:3, :3].copy(),
            landmarks=self._points[rows],
            landmark_cov=cov,
            landmark_ids=self._book.ids[rows],
            grid=self.grid,
            joint_cov=joint,
            landmark_kinds=self._book.kinds()[rows],
            lines=self._points[lines],
            line_ends=self._ends_of(self._points[lines], self._book.marks[lines, 6:8]),
            whole_cov=whole,
        )

    @staticmethod
    def _ends_of(lines: Array, extent: Array) -> Array:
        """Return the ends ``(k, 4)`` of walls (α, r): as far as they were seen, along them from their feet."""
        alpha, r = lines.T
        n = np.column_stack([np.cos(alpha), np.sin(alpha)])
        along = np.column_stack([-n[:, 1], n[:, 0]])
        return np.hstack([r[:, None] * n + extent[:, [e]] * along for e in range(2)])
