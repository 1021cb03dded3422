"""EKF-SLAM over corner points (docs/reference/ekf.md): one joint Gaussian of the robot and every landmark.

The covariance is kept as its upper triangle. All observations of a scan make one stacked update, a rank-2m
downdate of the triangle; a scan's own cost is linear in the landmarks but for that.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from slam.backend import found_cov
from slam.gaussian import joint_gaussian as joint
from slam.gaussian.companions import Companions
from slam.gaussian.lanes import aligned_zeros
from slam.gaussian.settings import EkfConfig
from slam.gaussian.stacked_update import NO_LIMITS, stacked_update, whiten_difference, work_space
from slam.gaussian.tiles import add_combination, downdate
from slam.gaussian.wheel_errors import WheelErrors
from slam.geometry import wrap_scalar
from slam.graph.held_by_map import HeldByMap
from slam.graph.places import Places
from slam.health.relocalisation import Place
from slam.landmark_backend import observation_rows
from slam.landmarks.association import IGNORED, UNMATCHED, refuse_unlikely
from slam.landmarks.book import DIRECTION, EDGE, FROM, KIND, TO, count_recent, match_and_recall
from slam.landmarks.curved_walls import along_wall, curvature_model, first_bend, forget, straighten
from slam.landmarks.innovations import Innovation, innovations
from slam.landmarks.joint_compatibility import JOINT_LIMITS, MAX_OBSERVATIONS, joint_compatibility
from slam.landmarks.loop_closing import agreeing, put_off
from slam.landmarks.rescue import match_missed
from slam.landmarks.right_angles import find_square
from slam.landmarks.spinning_wheels import FEWEST_BACK, seen_again, walls_cross
from slam.landmarks.wall_evidence import take_back, take_evidence
from slam.metrics.chi_square import chi2_quantile
from slam.types import LINE, Array, Indices, Observations, Odometry, Scan

__all__ = ["EkfSlam"]

_WIDE = (0.5, 0.5, 0.2)  # [m, m, rad] 1σ of a pose that landmarks shall decide


class EkfSlam(HeldByMap):
    """The standard EKF-SLAM backend, ``ekf``; with ``lines`` ``ekf-lines``.

    What lasts of the wheels' errors, if the odometry's noise tells, is states (:mod:`slam.gaussian.wheel_errors`).
    """

    config: EkfConfig

    def __init__(self, config: EkfConfig | None = None) -> None:
        super().__init__(config or EkfConfig())
        c = self.config
        self.witness: Callable[[list[Innovation]], object] | None = None  # told of every match before it corrects
        self._max_turn = math.radians(c.max_turn_deg)
        self._curved = curvature_model(c.features)
        self._gates = np.array([c.gate, c.landmarks.new_distance_m, self._max_turn])
        self._start(np.zeros(3), np.eye(3) * 1e-8, 0)

    def _start(self, pose: Array, pose_cov: Array, seed: int) -> None:
        del seed  # nothing here is drawn
        self._settle_beliefs()
        self._noise = self.config.odometry
        # Wheels that may slip can be all that says how far along some walls the robot is.
        self._may_slip_along = self.config.lines and self._noise.slip_share > 0.0
        self._n, self._x = 3, np.zeros(3 + 2 * 32)
        self._p = aligned_zeros(len(self._x), len(self._x))  # upper triangle
        self._x[:3], self._p[:3, :3] = pose, np.triu(pose_cov)
        self._begin(self.config.landmarks)
        self._h, self._w, self._s = work_space(MAX_OBSERVATIONS, len(self._x))
        self._match = np.zeros(MAX_OBSERVATIONS, np.int64)
        self._distance = np.zeros(MAX_OBSERVATIONS)
        self._beside = self._companions()
        self._held = None
        self._places = Places(self.config.lidar_offset_m, self.config.features.range_sigma_m)
        self._lasting = np.zeros(2)  # see slam.landmarks.wall_evidence
        self._recall = (0, 0)  # see slam.landmarks.book.count_recent
        self.nis, self.nis_dof = 0.0, 0

    def _companions(self) -> Companions:
        """Return the states beside the map, and leave the noise that they do not stand for."""
        noise, sizes = self.config.odometry, (len(self._match), len(self._x))
        if noise.lasting is None or not self.config.wheel_states:
            return Companions(*sizes, direction=self._squares)
        self._noise = noise.white()
        return WheelErrors(noise.lasting, noise.lever_m, *sizes, direction=self._squares)

    @property
    def wheel_errors(self) -> tuple[Array, Array] | None:
        """Relative errors of the four radii and the lever ``(5,)`` and their covariance; ``None`` if no states."""
        return self._beside.errors if isinstance(self._beside, WheelErrors) else None

    @property
    def _squares(self) -> bool:
        return self.config.lines and self.config.right_angle_sigma_rad > 0.0

    def predict(self, odometry: Odometry) -> None:
        """Move on by what the wheels measured, less what they are known to be off by (docs/reference/ekf.md)."""
        self._settle_beliefs()
        if isinstance(self._beside, WheelErrors):
            odometry = Odometry(self._beside.corrected(odometry.numbers), odometry.dt, odometry.slip)
        self._beside.predict(self._x, self._p, self._n, odometry.dt, *self._measured(odometry, self._noise))

    def _update(self, scan: Scan) -> None:
        """Correct by the corners of a scan, keep the book of landmarks, draw the scan."""
        self._take(self._features(scan), scan)
        if self._recovers:
            self._hold_by_map(scan)
        self._draw(scan)
        if self.key_scans.due():
            self._redraw_if_moved()

    def _features(self, scan: Scan) -> Array:
        """Return what a scan shows as observation rows ``(m, 12)``."""
        corners = self.extractor.extract(scan)
        return (self.extractor.with_walls() if self.config.lines else corners)[:MAX_OBSERVATIONS]

    def _take(self, z: Array, scan: Scan | None) -> None:
        """Match observations, of a scan or not, correct by them and keep the book of landmarks."""
        self._settle_beliefs()
        match = self._associate(z)
        loop = self._put_off(z, match)
        missed = scan is not None and self._recall[1] < self._recall[0]
        if scan is not None and (missed or self._spinning.lately):
            self._spinning.untold = self._may_slip_along and not seen_again(z, match)[1]
            if self._may_spin(scan, match, *self._recall):
                match = self._allow_for_spinning_wheels(z, match, scan)
        if not self._accept(z, match, JOINT_LIMITS):  # each of them may be right, but not all together
            match = self._associate_jointly(z)
            loop = self._put_off(z, match)
            self._accept(z, match)
        if missed and self.nis_dof > 0:
            self._rescue(z, match)
        if loop:
            self._close_loop(z, match)
        if scan is not None:
            matched, told = seen_again(z, match)
            self._spinning.note(scan, self._x[:3], self._recall[0], matched)
            if self.nis_dof >= 2 * FEWEST_BACK:
                self._spinning.untold = self._may_slip_along and not told
                self._spinning.forget_motion()
        self._manage(z, match, scan)
        if self._squares:
            self._square()

    def _square(self) -> None:
        """Hold walls against the direction of the building (:mod:`slam.landmarks.right_angles`)."""
        book, beside, sigma = self._book, self._beside, self.config.right_angle_sigma_rad
        while True:
            known = beside.direction
            wall, off, own, first = find_square(
                self._x, self._p, book.marks, book.now, sigma, self._curved, *known, beside.sure
            )
            if wall < 0:
                return
            i = 3 + 2 * wall
            if first:
                beside.take_direction(self._x, self._p, self._n, i, own * own)
            else:
                whiten_difference(self._p, self._n, i, *known[1:], -off, own * own, self._w, self._s)
                self._correct_direction(i)
            beside.sure = beside.sure or own == sigma

    def _correct_direction(self, i: int) -> None:
        """Correct by what :func:`slam.gaussian.stacked_update.whiten_difference` left of a wall's direction."""
        add_combination(self._x, self._n, self._s[:2, 2], self._w)
        self._x[2] = wrap_scalar(float(self._x[2]))
        downdate(self._p, self._n, self._w, self._w, 2, 0)
        self._beside.correct_direction(self._n, i, self._w, self._s)

    def observe(self, observations: Observations) -> None:
        """Correct by observations without a scan; known ids are believed up to ``known_gate``, new ones added."""
        z, ids = observation_rows(observations), self._ids_told(observations)
        nis, dof = 0.0, 0
        for begin in range(0, len(z), MAX_OBSERVATIONS):
            part = z[begin : begin + MAX_OBSERVATIONS]
            if ids is None:
                self._take(part, None)
            else:
                self._take_known(part, ids[begin : begin + MAX_OBSERVATIONS])
            if self.nis_dof:
                nis, dof = nis + self.nis, dof + self.nis_dof
        self.recovery.monitor.take_innovations(nis, dof)

    def _take_known(self, z: Array, ids: list[int]) -> None:
        """Correct by observations of these landmarks, but those that cannot be theirs, and add new ones."""
        self._settle_beliefs()
        doubting = self.config.known_gate < math.inf
        if doubting:
            self._drop_misplaced()
        match = self._rows(ids)
        if doubting:
            refuse_unlikely(self._x, self._p, self.config.lidar_offset_m, z, self.config.known_gate, match)
        self._accept(z, match)
        self._book.count_sightings(match)
        for k in np.flatnonzero(match == UNMATCHED):
            if self._book.row(ids[k]) < 0:  # not added by this very call
                self._add(z[k], ids[k])
        if doubting:
            self._known.note(ids, z, match, self.pose)
            if np.any(match == IGNORED):
                self._look_elsewhere()

    def _look_elsewhere(self) -> None:
        """Start over at the pose that landmarks lately refused agree on, with the map as it is, if they do."""
        found = self._known.elsewhere(self.pose, self._place_of)
        if found is None:
            return
        match, n = self._rows(found.ids), self._n
        x, p = self._x.copy(), self._p.copy()
        joint.place(x, p, n, found.pose, joint.ANYWHERE_COV)
        offset, work = self.config.lidar_offset_m, (self._h, self._w, self._s)
        dof, nis = stacked_update(x, p, n, found.rows, match, offset, *work, NO_LIMITS)
        if nis < chi2_quantile(0.999, dof - 3):  # three of them went into the pose
            self._place(found.pose, joint.ANYWHERE_COV)
            self._correct(found.rows, match)
            self._known.forget()

    def _associate(self, z: Array) -> Indices:
        config, book = self.config, self._book
        if config.association == "joint":
            match = self._associate_jointly(z)
            self._recall = count_recent(book.marks, match, book.now)
            return match
        match = self._match[: len(z)]
        self._recall = match_and_recall(
            self._x, self._p, config.lidar_offset_m, z, book.marks, book.now, self._gates,
            config.association == "individual", match, self._distance,
        )  # fmt: skip
        return match

    def _associate_jointly(self, z: Array) -> Indices:
        config, match = self.config, self._match[: len(z)]
        joint_compatibility(
            self._x, self._p, config.lidar_offset_m, z, self._book.marks, config.landmarks.new_distance_m,
            self._max_turn, match,
        )  # fmt: skip
        return match

    def _put_off(self, z: Array, match: Indices) -> bool:
        """Leave out old landmarks that one match alone does not make sure, at first; tell whether there are."""
        book, sigma, offset = self._book, self.config.loop_sigma_m, self.config.lidar_offset_m
        return sigma < math.inf and put_off(self._x, self._p, offset, z, book.marks, book.now, sigma, match) > 0

    def _close_loop(self, z: Array, match: Indices) -> None:
        """Match and correct by old landmarks, after all the others, where several of them agree."""
        config, book = self.config, self._book
        rows, closing = np.flatnonzero(match < 0), np.full(len(match), UNMATCHED)
        more = closing[rows]
        if agreeing(
            self._x, self._p, config.lidar_offset_m, z[rows], book.marks, book.now, config.loop_sigma_m,
            config.landmarks.new_distance_m, self._max_turn, more,
        ):  # fmt: skip
            closing[rows] = more
            self._accept_also(z, match, closing)

    def _rescue(self, z: Array, match: Indices) -> None:
        """Match and correct by what left its gate, now that the others have put the pose right."""
        more, gates = np.empty(len(z), np.int64), self._gates
        offset, book = self.config.lidar_offset_m, self._book
        if match_missed(self._x, self._p, offset, z, book.marks, book.now, gates, match, more) > 0:
            self._accept_also(z, match, more, JOINT_LIMITS)

    def _accept_also(self, z: Array, match: Indices, more: Indices, limits: Array = NO_LIMITS) -> None:
        """Correct by further matches, and count them to those that there are."""
        nis, dof = self.nis, self.nis_dof
        if self._accept(z, more, limits):
            match[more >= 0] = more[more >= 0]
            nis, dof = nis + self.nis, dof + self.nis_dof
        self.nis, self.nis_dof = nis, dof

    def _allow_for_spinning_wheels(self, z: Array, usual: Indices, scan: Scan) -> Indices:
        """Associate again as though the wheels had turned in vain; return ``usual`` unless that explains more.

        See :mod:`slam.landmarks.spinning_wheels`.
        """
        n, spinning = self._n, self._spinning
        x, p = self._x[:n].copy(), self._p[:n, :n].copy()
        usual, lately = usual.copy(), spinning.lately
        self._p[[0, 1, 2], [0, 1, 2]] += spinning.variances
        wide = self._p[:3, :3].copy()
        match, spun = self._associate_jointly(z), False
        if spinning.enough(match, usual) and (not spinning.untold or walls_cross(z, match)):
            fit, there = self._fit(z, match, scan), self._x[:2].copy()
            self._x[:n], self._p[:n, :n] = x, p
            usual_fit = self._fit(z, usual, scan)
            shift = math.hypot(*(there - self._x[:2]))
            spun = spinning.explain(fit, usual_fit, unseen=shift < self.grid.resolution)
        self._x[:n], self._p[:n, :n] = x, p
        if not spun and (place := self._held_back(z, usual, scan)) is not None:
            self._p[:3, :3] = wide
            self._correct_by_map(place, NO_LIMITS)
            spinning.allowed_for()
            return self._associate(z)
        if spun or lately:
            self._p[:3, :3] = wide
            spinning.allowed_for()
        return match if spun else usual

    def _held_back(self, z: Array, usual: Indices, scan: Scan) -> Place | None:
        """Return where a robot that touches something stayed while its wheels went on, by the scan alone."""
        n, spinning = self._n, self._spinning
        if not spinning.touching:
            return None
        place = self._place_beside(scan)
        dx, dy, turn = (place.pose - self._x[:3]).tolist()
        if not place.good or not spinning.claims(math.hypot(dx, dy), abs(wrap_scalar(turn))):
            return None
        x, p = self._x[:n].copy(), self._p[:n, :n].copy()
        usual_fit = self._fit(z, usual, scan)
        self._x[:n], self._p[:n, :n] = x, p
        fit = self.grid.agreement(self.sensor_pose(place.pose), scan)
        return place if spinning.surely(fit, usual_fit) else None

    def _fit(self, z: Array, match: Indices, scan: Scan) -> float:
        """Correct by a match; return how well the scan fits the map from there. It is only a trial."""
        kept = self._beside.snapshot()
        self._correct(z, match)
        self._beside.restore(kept)
        return self.grid.agreement(self.sensor_pose(), scan)

    def _accept(self, z: Array, match: Indices, limits: Array = NO_LIMITS) -> bool:
        """Correct by a match, curved walls made straight; tell whether it stands: its joint NIS may be refused."""
        offset, marks, lines = self.config.lidar_offset_m, self._book.marks, self.config.lines
        if lines:
            given = z.copy()
            straighten(self._x, offset, z, match, marks, self._curved)
            before = take_evidence(self._x, self._p, offset, z, match, marks, self._book.now, self._lasting)
        if self.witness is not None:
            self.witness(innovations(self._x, self._p, offset, z, match, self._book.ids))
        self._correct(z, match, limits)
        stands = self.nis_dof > 0 or self.nis == 0.0
        if lines and not stands:
            z[:] = given
            forget(z, match, marks)
            take_back(before, marks, self._lasting)
        return stands

    def _correct(self, z: Array, match: Indices, limits: Array = NO_LIMITS) -> None:
        """Make one stacked update of all matched observations, unless their NIS is above the limit of so many."""
        self.nis_dof, self.nis = stacked_update(
            self._x, self._p, self._n, z, match, self.config.lidar_offset_m, self._h, self._w, self._s, limits
        )
        self._beside.correct(self._n, match, self._h, self._w, self._s, self.nis_dof)

    def _manage(self, z: Array, match: Indices, scan: Scan | None) -> None:
        """Tentative → confirmed → dropped (see :mod:`slam.landmarks.book`)."""
        # The start's pose is known; landmarks that had to wait would be placed by the wheels alone.
        at_once = scan is not None and self._book.now == 0
        new, gone = self._book.review(self._x, self.config.lidar_offset_m, z, match, scan, at_once=at_once)
        for k in new:
            self._add(z[k], None)
        for row in gone:
            self._drop(row)

    def _add(self, z: Array, known_id: int | None) -> None:
        if self._n + 2 > len(self._x):
            self._enlarge()
        offset = self.config.lidar_offset_m
        self._beside.add(self._n, joint.landmark_by_pose(self._x, z, offset))
        joint.add_landmark(self._x, self._p, self._n, z, offset)
        direction = float(z[DIRECTION]) + float(self._x[2])
        x, y, _ = self.sensor_pose().tolist()
        along = along_wall(x, y, direction)
        extent = (along + float(z[FROM]), along + float(z[TO])) if z[KIND] == LINE else (float(z[EDGE]), 0.0)
        self._n += 2
        self._book.add(float(z[KIND]), direction, known_id, extent=extent, bend=first_bend(along, z))

    def _drop(self, row: int) -> None:
        """Take a landmark out of the state: marginalisation is leaving out its rows and columns."""
        self._beside.drop(self._n, 3 + 2 * row)
        joint.leave_out(self._x, self._p, self._n, 3 + 2 * row)
        self._n -= 2
        self._book.drop(row)

    def _enlarge(self) -> None:
        self._x, self._p = joint.enlarged(self._x, self._p, self._n)
        self._h, self._w, self._s = work_space(MAX_OBSERVATIONS, len(self._x))
        self._beside.enlarge(len(self._x))

    def _foreseen(self, scan: Scan) -> Array:
        return self._x

    def _place(self, pose: Array, pose_cov: Array) -> None:
        self._settle_beliefs()
        self._beside.jump(joint.jump_jacobian(self._x, pose))
        joint.place(self._x, self._p, self._n, pose, pose_cov)

    def _relocate(self, pose: Array, cov: Array, scan: Scan) -> None:
        """Go on from a pose ``(3,)`` of a scan: the landmarks it shows say where it is, and how surely."""
        self._find(pose, cov + found_cov())
        z = self._features(scan)
        match = self._associate(z).copy()
        self._place(pose, np.diag(np.square(_WIDE)))
        self._correct(z, match)
        self._spinning.forget_motion()
        self._manage(z, match, scan)
        self._draw(scan)
