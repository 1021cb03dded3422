"""Pose-graph SLAM, backend ``graph-slam``: what a scan changes, what is drawn, what is believed.

Every scan is aligned with the patches in reach and corrects the belief, as though it were the last there is; where
the robot has moved on, it becomes a key scan and stays in the graph. See ``docs/reference/graph_slam.md``.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from slam.backend import SurfaceBackend, found_cov
from slam.geometry import about_z, compose, relative, wrap
from slam.graph.atlas import Atlas
from slam.graph.lasting import LastingStates, Motion
from slam.graph.matching import Alignment, Links, align, lasting, links
from slam.graph.pose_graph import PoseGraph
from slam.graph.settings import GraphSlamConfig
from slam.graph.surfaces import BeamEnds, beam_ends
from slam.graph.window import carried
from slam.grids.key_scans import largest_shift
from slam.grids.scan_matching import LikelihoodField, search
from slam.types import Array, Odometry, Scan

__all__ = ["GraphSlam"]

_SPUN = 25.0  # chi-square, 3 degrees of freedom, from which the wheels are not believed
_KNOWN, _SOONER = 0.7, 0.4  # share of a scan that is known, below which the next key scan comes so much sooner
_STILL = 10.0  # how much more the model's error counts, at most, where the robot has hardly moved
_EXACT = 1e-9  # [m², rad²] added to a motion's covariance, so that it has an inverse
_ALIGNED = np.diag([1e-5, 1e-5, 1e-6])  # covariance of where the scan before was aligned, as far as a guess goes

# BLAS adds up in another order with each number of threads; one seed is the same on any number of cores.
_ONE_THREAD = ThreadpoolController().select(user_api="blas").wrap(limits=1)


class GraphSlam(SurfaceBackend):
    """Key scans, and the patches each was the first to see, in a sparse graph."""

    relocalises = True
    maps = "graph-slam maps surfaces"
    config: GraphSlamConfig

    def __init__(self, config: GraphSlamConfig | None = None) -> None:
        super().__init__(config or GraphSlamConfig())
        self._start(np.zeros(3), np.eye(3) * 1e-8, 0)

    def _start(self, pose: Array, pose_cov: Array, seed: int) -> None:
        del seed
        self.atlas = Atlas(self.config, pose, pose_cov)
        self.calibration = LastingStates(self.config.odometry)
        self._noise = self.config.odometry.white()
        self._begun = False
        self._motion = Motion()  # since the key scan
        self._step = Motion()  # since the last scan
        self._claimed = (0.0, 0.0)  # [m, rad] by the wheels since the key scan
        self._blind = (0.0, 0.0)  # [m, rad] up to the key scan that nothing but the wheels told all about
        self._body = (0.0, 0.0, 0.0)  # twist that the floor has passed on
        self._last = pose.copy()  # where the last scan was aligned
        self._mean, self._cov = pose.copy(), pose_cov.copy()
        self._at: list[int] = []  # the key scan before each update …
        self._from: list[Array] = []  # … and the pose as seen from it
        self._drawn: list[tuple[Scan, NDArray[np.int16]]] = []  # the scans the grid can be redrawn from …
        self._drawn_at: list[int] = []  # … which updates they are of
        self._shown: list[Array] = []  # … and the sensor poses they are drawn from

    # ---- the steps -----------------------------------------------------------------------------------------

    def predict(self, odometry: Odometry) -> None:
        """Move on by what the wheels measured."""
        claimed, var_v, var_w, self._body = self._noise.of_step(odometry, self._body)
        twist, by = self.calibration.twist(claimed)
        (vx, vy, omega), dt = twist, odometry.dt
        self._motion.add(twist, by, dt, var_v, var_w)
        self._step.add(twist, by, dt, var_v, var_w)
        way, turn = self._claimed
        self._claimed = (way + math.hypot(vx, vy) * dt, turn + abs(omega) * dt)
        self._mean, rows = self.atlas.window.ahead(self._motion.mean, self._motion_cov())
        self._cov = rows[:, :3]

    @_ONE_THREAD
    def _update(self, scan: Scan) -> None:
        """Align the scan with the patches in reach; where the robot has moved on, make it a key scan."""
        config, atlas = self.config, self.atlas
        self.extractor.extract(scan)
        ends = beam_ends(
            scan, self.extractor, offset_m=config.lidar_offset_m, reach_m=config.reach_m,
            sigma_m=config.features.range_sigma_m, rough_m=config.rough_m,
        )  # fmt: skip
        solutions = atlas.solutions
        if self._begun:
            self._follow(ends, min(scan.range_max, config.reach_m))
        else:
            atlas = self._begin(ends)
        self._step = Motion()
        self._at.append(atlas.key)
        self._from.append(relative(atlas.window.pose[None], self._mean[None])[0])
        if atlas.solutions > solutions:
            self._redraw_if_moved()
        self._draw_it(scan)

    def _begin(self, ends: BeamEnds) -> Atlas:
        """Make the first scan the first key scan, where the wheels have led the robot by then."""
        if self._motion.mean.any() or self._motion.white.any():
            pose, rows = self.atlas.window.ahead(self._motion.mean, self._motion_cov())
            self.atlas = Atlas(self.config, pose, 0.5 * (rows[:, :3] + rows[:, :3].T))
            self._motion, self._claimed = Motion(), (0.0, 0.0)
            self._last, self._mean, self._cov = pose.copy(), pose.copy(), self.atlas.window.cov[:3, :3].copy()
        self.atlas.begin(ends)
        self._begun = True
        return self.atlas

    def _follow(self, ends: BeamEnds, reach_m: float) -> None:
        """Correct the belief by a scan."""
        found = self._aligned(ends, reach_m)
        window = self.atlas.window
        seen = links(self.atlas.surfaces, ends, found, window.frames, self._lasting() * self.atlas.common_var)
        self._correct(found, seen)
        if self.calibration.unknown:
            self._learn(found, self._information(found, seen))
        if self._moved_on(found.share):
            motion_cov = self._motion_cov()
            way, turn = self._claimed
            blind = self._is_blind(motion_cov, self._information(found, seen))
            self.atlas.add_key(self._motion.mean, motion_cov, ends, found, seen, reach_m)
            self._blind = (self._blind[0] + way, self._blind[1] + turn) if blind else (0.0, 0.0)
            self._motion, self._claimed = Motion(), (0.0, 0.0)
            self._last = window.pose.copy()
            self._mean, self._cov = window.pose.copy(), window.cov[:3, :3].copy()
        else:
            self._last = found.pose

    def _aligned(self, ends: BeamEnds, reach_m: float) -> Alignment:
        """Return where the scan fits the patches in reach: near to where the wheels say, unless they spun."""
        config, surfaces = self.config, self.atlas.surfaces
        guess = compose(self._last, self._step.mean)
        turn = about_z(float(self._last[2]))
        cov = turn @ self._step_cov() @ turn.T + _ALIGNED
        near = np.hypot(*(surfaces.points - guess[:2]).T) < reach_m

        def aligned(cov: Array) -> Alignment:
            info, start = np.asarray(np.linalg.inv(cov), np.float64), guess
            if max(cov[0, 0], cov[1, 1]) > config.search_sigma_m**2 or cov[2, 2] > config.search_sigma_rad**2:
                field = LikelihoodField(config.matching, surfaces.points[near])
                points = ends.points[:: max(1, len(ends) // config.matching.beams)]
                start = search(field, points, guess, config.matching, prior_info=info)
            return align(surfaces, ends, start, prior=guess, prior_info=info, gate_m=config.gate_m)

        found = aligned(cov)
        # Surfaces are near, and yet the scan does not lie on them: as where an old place is held against a scan.
        if found.in_sight < config.closing.in_sight:
            other = aligned(cov + self._spun())
            return other if other.in_sight > found.in_sight and other.share > found.share else found
        return found

    def _step_cov(self) -> Array:
        """Return the covariance ``(3, 3)`` of the motion since the last scan, in the frame of then."""
        return self._step.white + self.calibration.motion_cov(self._step)

    def _spun(self) -> Array:
        """Return what wheels that may have spun add to a motion's covariance ``(3, 3)``: all that they claim."""
        way, turn = self._claimed
        return np.diag(np.square([way, way, max(turn, way / self.config.odometry.lever_m)]))

    def _correct(self, found: Alignment, seen: Links) -> None:
        """Set the belief to that of the window and this scan; wheels that contradict it are not believed."""
        window = self.atlas.window
        for _ in range(2):
            pose, rows = window.ahead(self._motion.mean, self._motion_cov())
            self._mean, self._cov = window.corrected(found.pose, seen, pose, rows)
            change = self._mean - pose
            change[2] = float(wrap(change[2]))
            left = carried(self._cov, -change[None, :2])
            if float(change @ np.linalg.solve(rows[:, :3] - left + _EXACT * np.eye(3), change)) <= _SPUN:
                break
            self._motion.doubt(self._spun())

    def _motion_cov(self) -> Array:
        """Return the covariance ``(3, 3)`` of the motion since the key scan, in its frame.

        Where nothing but the wheels has told the motion for a way L, their lasting errors add up along all of it:
        after d more, (L + d)² - L² = (1 + 2 L / d) d² times their variance.
        """
        lever = self.config.odometry.lever_m
        before, rolled = (math.hypot(way, lever * turn) for way, turn in (self._blind, self._claimed))
        share = 1.0 + 2.0 * before / rolled if rolled > 0.0 else 1.0
        return self._motion.white + _EXACT * np.eye(3) + share * self.calibration.motion_cov(self._motion)

    def _information(self, found: Alignment, seen: Links) -> Array:
        """Return what a scan tells ``(3, 3)`` of its pose on the patches as they are, in the body's directions."""
        turns = found.pose[2] - self.atlas.window.frames[seen.patches, 2]
        turn = np.zeros((len(turns), 3, 3))
        turn[:, 0, 0] = turn[:, 1, 1] = np.cos(turns)
        turn[:, 1, 0] = np.sin(turns)
        turn[:, 0, 1], turn[:, 2, 2] = -turn[:, 1, 0], 1.0
        return np.asarray((turn.transpose(0, 2, 1) @ seen.info @ turn).sum(axis=0), np.float64)

    def _learn(self, found: Alignment, info: Array) -> None:
        """Learn what lasts of the odometry's errors, by what a scan made of the last motion."""
        moved, prior = relative(self._last[None], found.pose[None])[0], self._step_cov() + _ALIGNED
        turn = about_z(float(moved[2]))  # from the body's directions now to those of the last scan
        cov = np.asarray(np.linalg.inv(np.linalg.inv(prior) + turn @ info @ turn.T), np.float64)
        change = moved - self._step.mean
        change[2] = float(wrap(change[2]))
        self.calibration.learn(self._step, prior, change, cov)

    def _is_blind(self, motion_cov: Array, info: Array) -> bool:
        """Tell whether there is a direction in which the scan tells less of the motion than the wheels do."""
        left = np.linalg.eigvals(np.eye(3) + motion_cov @ info).real
        return bool(left.min() < 2.0)

    def _lasting(self) -> float:
        """Return what :func:`.matching.lasting` does of the way since the last key scan."""
        x, y, theta = self._motion.mean.tolist()
        config = self.config
        return lasting(math.hypot(x, y), theta, key_m=config.key_m, key_rad=config.key_rad, most=_STILL)

    def _moved_on(self, share: float) -> bool:
        """Tell whether it is time for a key scan: sooner where much is new, as in a door."""
        x, y, theta = self._motion.mean.tolist()
        part = 1.0 if share >= _KNOWN else _SOONER
        return math.hypot(x, y) >= part * self.config.key_m or abs(theta) >= part * self.config.key_rad

    # ---- the map that is shown -----------------------------------------------------------------------------

    def _draw_it(self, scan: Scan) -> None:
        x, y, theta = self._mean.tolist()
        if self._doubtful and self._recovers and self._contradicts((x, y, theta), scan):
            return
        sensor, surface = self.sensor_pose(self._mean), self.extractor.surface
        self.grid.integrate(sensor, scan, surface, body=(x, y, self.config.body_radius_m))
        if self.key_scans.wants(*sensor.tolist()):
            self._keep(sensor, scan)
            self._drawn.append((scan.kept(), surface.copy()))
            self._drawn_at.append(len(self._at) - 1)
            self._shown.append(sensor)

    def _place(self, pose: Array, pose_cov: Array) -> None:
        """Have the motion since the key scan lead to a pose ``(3,)``, as well known as that is."""
        key = self.atlas.window.pose
        back = about_z(float(-key[2]))
        self._motion = Motion(relative(key[None], pose[None])[0], back @ pose_cov @ back.T)
        back = about_z(float(-pose[2]))
        self._step = Motion(np.zeros(3), back @ pose_cov @ back.T)
        self._last, self._mean, self._cov = pose.copy(), pose.copy(), pose_cov.copy()

    def _relocate(self, pose: Array, cov: Array, scan: Scan) -> None:
        if not self.atlas.found_at(pose, cov + found_cov(), min(scan.range_max, self.config.reach_m)):
            super()._relocate(pose, cov, scan)
            return
        window = self.atlas.window
        self._motion, self._step = Motion(), Motion()
        self._claimed, self._blind = (0.0, 0.0), (0.0, 0.0)
        self._last, self._mean, self._cov = window.pose.copy(), window.pose.copy(), window.cov[:3, :3].copy()
        self._update(scan)

    def _redraw_kept(self, poses: Array) -> None:
        super()._redraw_kept(poses)
        if self._drawn:
            self.grid.redraw(np.array(self._shown), self._drawn)

    def _redraw_if_moved(self) -> bool:
        if not self._drawn:
            return False
        path = np.array([self.sensor_pose(body) for body in self._poses_of(self._drawn_at, self.atlas.graph)])
        shift = largest_shift(path, np.array(self._shown), self.config.key_scans.lever_m)
        if shift <= 0.5 * self.grid.resolution:
            return False
        self.grid.redraw(path, self._drawn)
        self._shown = list(path)
        return True

    # ---- the belief ----------------------------------------------------------------------------------------

    @property
    def pose(self) -> Array:
        """Pose mean ``(3,)``."""
        return self._mean.copy()

    @property
    def pose_cov(self) -> Array:
        """Pose covariance ``(3, 3)``."""
        return self._cov.copy()

    @property
    def scan_poses(self) -> Array:
        """The poses at every update ``(updates, 3)`` as they are known by now; a copy of the graph is solved."""
        graph = copy.deepcopy(self.atlas.graph)  # the window is of the graph as it was solved last
        graph.solve()
        return self._poses_of(range(len(self._at)), graph)

    def _poses_of(self, updates: Sequence[int], graph: PoseGraph) -> Array:
        """Return the poses at some of the updates ``(k, 3)``."""
        keys = graph.poses[[self._at[k] for k in updates]]
        seen = np.array([self._from[k] for k in updates]).reshape(-1, 3)
        c, s = np.cos(keys[:, 2]), np.sin(keys[:, 2])
        x = keys[:, 0] + c * seen[:, 0] - s * seen[:, 1]
        y = keys[:, 1] + s * seen[:, 0] + c * seen[:, 1]
        return np.column_stack([x, y, wrap(keys[:, 2] + seen[:, 2])])
