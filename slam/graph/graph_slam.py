"""Pose-graph SLAM, backend ``graph-slam``."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from slam.backend import Backend
from slam.belief import Belief
from slam.features.surfaces import MAX_LINES
from slam.geometry import compose, relative, wrap
from slam.graph.loop_closing import Candidate, agreeing, find_candidate
from slam.graph.matching import Alignment, Links, SurfaceMap, align, links
from slam.graph.patches import Patch, extended, new_patches
from slam.graph.pose_graph import PoseGraph, relative_jacobians
from slam.graph.settings import GraphSlamConfig
from slam.graph.surfaces import BeamEnds, beam_ends
from slam.graph.window import Window
from slam.grids.scan_matching import LikelihoodField, search
from slam.motion import predict_robot
from slam.types import Observations, Odometry, Scan

__all__ = ["GraphSlam"]

Array = NDArray[np.float64]

_SPUN = 25.0  # chi-square, 3 degrees of freedom, from which the wheels are not believed
_KNOWN, _SOONER = 0.7, 0.4  # share of a scan that is known, below which the next key scan comes so much sooner
_LEAST_HELD = 5  # beams on a patch, for their surface to be the patch's
_EXACT = 1e-9  # [m², rad²] added to a motion's covariance, so that it has an inverse


class GraphSlam(Backend):
    """Key scans, and the patches each was the first to see, in a sparse graph."""

    observes_landmarks = False
    config: GraphSlamConfig

    def __init__(self, config: GraphSlamConfig | None = None) -> None:
        super().__init__(config or GraphSlamConfig())
        self._start(np.zeros(3), np.eye(3) * 1e-8, 0)

    def _start(self, pose: Array, pose_cov: Array, seed: int) -> None:
        del seed
        self.graph = PoseGraph(pose, pose_cov)
        self.window = Window(pose, pose_cov)
        self._patches: dict[int, Patch] = {}  # node → patch
        self._key_nodes: list[int] = []  # nodes of key scans, in order of time
        self._map: SurfaceMap | None = None
        self._motion, self._upper = np.zeros(3), np.zeros((3, 3))  # since the key scan, in its frame
        self._step, self._step_upper = np.zeros(3), np.zeros((3, 3))  # since the last scan, in its frame
        self._claimed = (0.0, 0.0)  # [m, rad] by the wheels since the key scan
        self._twist = (0.0, 0.0, 0.0)
        self._last = pose.copy()  # where the last scan was aligned
        self._mean, self._cov = pose.copy(), pose_cov.copy()
        self._way = self._looked = 0.0  # [m] driven, from key scan to key scan; … when it last looked back
        self._reach = 0.0  # of the beams [m]
        self._candidates: list[Candidate] = []
        self._closings = 0
        self._drawn: list[tuple[Scan, NDArray[np.int16]]] = []  # the scans the grid can be redrawn from …
        self._drawn_at: list[int] = []  # … which updates they are of
        self._shown: list[Array] = []  # … and the sensor poses they are drawn from
        self._at: list[int] = []  # the key scan before each update …
        self._from: list[Array] = []  # … and the pose as seen from it
        self.last_links: Links | None = None

    # ---- the steps -----------------------------------------------------------------------------------------

    def predict(self, odometry: Odometry) -> None:
        """Move on by what the wheels measured."""
        vx, vy, omega = twist = tuple(np.asarray(odometry.twist, dtype=np.float64).tolist())
        dt, noise = odometry.dt, self.config.odometry
        slip = noise.slip(self._twist, twist, dt) if dt > 0 else 0.0
        var_v, var_w = noise.variances(vx, vy, omega, slip=slip)
        predict_robot(self._motion, self._upper, 3, vx, vy, omega, dt, var_v, var_w)
        predict_robot(self._step, self._step_upper, 3, vx, vy, omega, dt, var_v, var_w)
        self._twist = twist
        way, turn = self._claimed
        self._claimed = (way + math.hypot(vx, vy) * dt, turn + abs(omega) * dt)
        self._ahead()

    def _ahead(self) -> None:
        pose, rows = self.window.ahead(self._motion, _full(self._upper))
        self._mean, self._cov = pose, rows[:, :3]

    def update(self, scan: Scan) -> None:
        """Align the scan with the patches in reach; where the robot has moved on, make it a key scan."""
        config = self.config
        self.extractor.extract(scan)
        ends = beam_ends(
            scan, self.extractor, offset_m=config.lidar_offset_m, reach_m=config.reach_m,
            sigma_m=config.features.range_sigma_m, rough_m=config.rough_m,
        )  # fmt: skip
        self._reach = min(scan.range_max, config.reach_m)
        if self._map is None:
            self._key_nodes.append(0)
            self._add_patches(ends, None)
            self._chart()
        else:
            self._follow(ends)
        self._step, self._step_upper = np.zeros(3), np.zeros((3, 3))
        self._at.append(self._key_nodes[-1])
        self._from.append(relative(self.window.pose[None], self._mean[None])[0])
        self._draw_it(scan)

    def _follow(self, ends: BeamEnds) -> None:
        assert self._map is not None
        config, window = self.config, self.window
        guess = compose(self._last, self._step)
        turned = _about_z(float(self._last[2]))
        prior = turned @ _full(self._step_upper) @ turned.T + np.diag([1e-5, 1e-5, 1e-6])
        prior_info = np.asarray(np.linalg.inv(prior), np.float64)
        start = guess
        if max(prior[0, 0], prior[1, 1]) > config.search_sigma_m**2 or prior[2, 2] > config.search_sigma_rad**2:
            start = self._searched(ends, guess, prior_info)
        found = align(self._map, ends, start, prior=guess, prior_info=prior_info, gate_m=config.gate_m)
        found_links = links(self._map, ends, found, window.frames, self._common)
        self.last_links = found_links
        motion_cov = _full(self._upper) + _EXACT * np.eye(3)
        pose, rows = window.ahead(self._motion, motion_cov)
        mean, cov = window.corrected(found.pose, found_links, pose, rows)
        change = mean - pose
        change[2] = float(wrap(change[2]))
        spread = rows[:, :3] - cov + _EXACT * np.eye(3)
        self.spin = float(change @ np.linalg.solve(spread, change))
        if self.spin > _SPUN:
            way, turn = self._claimed
            lost = np.square([way, way, max(turn, way / config.odometry.lever_m)])
            self._upper = self._upper + np.diag(lost)
            motion_cov = _full(self._upper) + _EXACT * np.eye(3)
            pose, rows = window.ahead(self._motion, motion_cov)
            mean, cov = window.corrected(found.pose, found_links, pose, rows)
        self._mean, self._cov = mean, cov
        self._last = found.pose
        self.found = found
        if self._moved_on(found.share):
            self._make_key(ends, found, found_links, motion_cov)

    def _searched(self, ends: BeamEnds, guess: Array, prior_info: Array) -> Array:
        """Return the best pose ``(3,)`` of the window of ``MatchConfig`` around a guess."""
        assert self._map is not None
        matching = self.config.matching
        near = np.hypot(*(self._map.points - guess[:2]).T) < self._reach
        field = LikelihoodField(matching, self._map.points[near])
        every = max(1, len(ends) // matching.beams)
        return search(field, ends.points[::every], guess, matching, prior_info=prior_info)

    def _moved_on(self, share: float) -> bool:
        """Tell whether it is time for a key scan: sooner where much is new, as in a door."""
        x, y, theta = self._motion.tolist()
        part = 1.0 if share >= _KNOWN else _SOONER
        return math.hypot(x, y) >= part * self.config.key_m or abs(theta) >= part * self.config.key_rad

    def _make_key(self, ends: BeamEnds, found: Alignment, seen: Links, motion_cov: Array) -> None:
        window, graph = self.window, self.graph
        before, motion = self._key_nodes[-1], self._motion
        window.step(self._motion, motion_cov)
        window.correct(found.pose, seen)
        node = graph.add_node(window.pose)
        self._key_nodes.append(node)
        graph.add_link(before, node, self._motion, np.linalg.inv(motion_cov))
        for k, p in enumerate(seen.patches.tolist()):
            graph.add_link(
                int(window.nodes[p]), node, seen.relative[k], seen.info[k], seen.gradient[k]
            )
        self._motion, self._upper, self._claimed = np.zeros(3), np.zeros((3, 3)), (0.0, 0.0)
        graph.poses[window.nodes] = window.frames
        self._add_patches(ends, found)
        self._way += math.hypot(motion[0], motion[1])
        self._leave_behind()
        self._look_back(ends)
        self._chart()
        self._last = window.pose.copy()
        self._mean, self._cov = window.pose.copy(), window.cov[:3, :3].copy()

    def _add_patches(self, ends: BeamEnds, found: Alignment | None) -> None:
        config = self.config
        unexplained = ends.spacing <= config.spacing_m
        if found is not None:
            unexplained &= found.beside < 0
            self._extend_patches(ends, found, unexplained)
        common = config.features.wall_sigma_m**2, config.common_m**2
        for patch in new_patches(ends, unexplained, common_var=common):
            node = self.graph.add_node(self.window.pose)
            self._patches[node] = patch
            self.graph.add_link(self._key_nodes[-1], node, np.zeros(3), patch.info)
            self.window.add(node, patch.info)

    def _extend_patches(self, ends: BeamEnds, found: Alignment, unexplained: NDArray[np.bool_]) -> None:
        """Let straight patches reach as far as their surface is seen to go on, and count those beams explained."""
        assert self._map is not None
        window = self.window
        number = np.where(found.beside >= 0, self._map.patch[found.beside], -1)
        for label in np.unique(ends.surface[unexplained & (ends.surface < MAX_LINES)]):
            on = ends.surface == label
            held = number[on & (number >= 0)]
            if len(held) < _LEAST_HELD:
                continue
            p = int(np.bincount(held).argmax())
            node = int(window.nodes[p])
            if not self._patches[node].straight or np.count_nonzero(held == p) < _LEAST_HELD:
                continue
            rows = np.flatnonzero(on & unexplained)
            seen = relative(window.frames[p][None], window.pose[None])[0]
            longer = extended(self._patches[node], ends, rows, seen)
            if longer is not None:
                self._patches[node] = longer
                unexplained[rows] = False

    # ---- what comes into reach, and what leaves it ---------------------------------------------------------

    def _leave_behind(self) -> None:
        """Let patches out of reach leave the window."""
        window = self.window
        away = self._distances(window.nodes)
        window.keep(away <= self._reach + self.config.beyond_m)

    def _distances(self, nodes: NDArray[np.int64]) -> Array:
        """Return how far from the robot patches begin ``(k,)`` [m]."""
        frames, (centres, radii) = self.graph.poses[nodes], self._extents(nodes)
        c, s = np.cos(frames[:, 2]), np.sin(frames[:, 2])
        x = frames[:, 0] + c * centres[:, 0] - s * centres[:, 1] - self.window.pose[0]
        y = frames[:, 1] + s * centres[:, 0] + c * centres[:, 1] - self.window.pose[1]
        return np.asarray(np.hypot(x, y) - radii, np.float64)

    def _extents(self, nodes: NDArray[np.int64]) -> tuple[Array, Array]:
        """Return centres ``(k, 2)`` and radii ``(k,)`` of patches [m], in their frames."""
        rows = np.array([self._patches[node].extent for node in nodes.tolist()]).reshape(-1, 3)
        return rows[:, :2], rows[:, 2]

    def _look_back(self, ends: BeamEnds) -> None:
        """Bring old patches in reach back into the window, those that are not surely known by closing a loop."""
        closing, graph, window = self.config.closing, self.graph, self.window
        if self._way - self._looked < closing.every_m:
            return
        known = np.fromiter(self._patches, np.int64, len(self._patches))
        away = np.setdiff1d(known, window.nodes)
        away = away[self._distances(away) <= self._reach]
        if not len(away):
            return
        self._looked = self._way
        self._solve()
        cov = graph.covariance([self._key_nodes[-1], *away])
        sigmas = self._seen_sigmas(away, cov)
        sure = sigmas <= closing.sigma_m
        if np.count_nonzero(~sure) > np.count_nonzero(sure):
            unsure = np.flatnonzero(~sure)
            if self._close_loop(ends, away[unsure], cov, unsure):
                self._solve()
                cov = graph.covariance([self._key_nodes[-1], *away])
                sure = self._seen_sigmas(away, cov) <= closing.sigma_m
        nodes = np.concatenate([window.nodes, away[sure]])
        key = self._key_nodes[-1]
        window.replace(graph.poses[key], graph.poses[nodes], nodes, graph.covariance([key, *nodes]))

    def _solve(self) -> None:
        """Solve the whole graph; redraw the grid where that moves a scan by more than half a cell."""
        self.graph.solve()
        key = self._key_nodes[-1]
        self.window.pose, self.window.frames = self.graph.poses[key].copy(), self.graph.poses[self.window.nodes]
        self._redraw_if_moved()

    def _seen_sigmas(self, nodes: NDArray[np.int64], cov: Array) -> Array:
        """Return how well the middle of patches is known as seen from the robot ``(k,)``: 1σ [m] where it is worst.

        ``cov`` is of the key scan and the patches, jointly.
        """
        frames, (centres, _) = self.graph.poses[nodes], self._extents(nodes)
        pose = np.tile(self.window.pose, (len(nodes), 1))
        d, by_pose, by_patch = relative_jacobians(pose, frames)
        c, s = np.cos(d[:, 2]), np.sin(d[:, 2])
        out = np.zeros(len(nodes))
        for k in range(len(nodes)):
            part = np.r_[0:3, 3 + 3 * k : 6 + 3 * k]
            j = np.hstack([by_pose[k], by_patch[k]])
            seen = j @ cov[np.ix_(part, part)] @ j.T
            x, y = centres[k]
            at = np.array([[1.0, 0.0, -s[k] * x - c[k] * y], [0.0, 1.0, c[k] * x - s[k] * y]])
            out[k] = math.sqrt(max(float(np.linalg.eigvalsh(at @ seen @ at.T)[-1]), 0.0))
        return out

    def _close_loop(self, ends: BeamEnds, nodes: NDArray[np.int64], cov: Array, rows: NDArray[np.int64]) -> bool:
        """Hold the scan against old patches; where it and others before it agree, close the loop."""
        config, graph, key = self.config, self.graph, self._key_nodes[-1]
        nearest = int(rows[np.argmin(self._distances(nodes))])
        part = np.r_[0:3, 3 + 3 * nearest : 6 + 3 * nearest]
        patch = graph.poses[self._away_node(nodes, rows, nearest)]
        _, by_patch, by_pose = relative_jacobians(patch[None], self.window.pose[None])
        j = np.hstack([by_pose[0], by_patch[0]])
        turn = _about_z(float(patch[2]))
        seen = turn @ (j @ cov[np.ix_(part, part)] @ j.T) @ turn.T
        surfaces, frames, common = self._charted(nodes, graph.poses[nodes])
        candidate = find_candidate(
            surfaces, frames, common, nodes, ends, self.window.pose, seen, config.closing, config.matching,
            node=key, way_m=self._way,
        )  # fmt: skip
        if candidate is None:
            return False
        self._candidates.append(candidate)
        group = agreeing(self._candidates, config.closing)
        if not group:
            return False
        self._candidates.clear()
        self._closings += 1
        for member in group:
            for k, p in enumerate(member.links.patches.tolist()):
                # Half of it: the same beams link the scan to what is in the window, too.
                graph.add_link(
                    int(member.nodes[p]), member.node, member.links.relative[k], 0.5 * member.links.info[k],
                    0.5 * member.links.gradient[k], closing=self._closings,
                )  # fmt: skip
        graph.solve(iterations=15)
        loss, count = graph.closing_loss(self._closings)
        if loss > config.closing.loss * 2.0 * count:
            graph.drop_closing(self._closings)
            return False
        return True

    def _away_node(self, nodes: NDArray[np.int64], rows: NDArray[np.int64], row: int) -> int:
        return int(nodes[np.flatnonzero(rows == row)[0]])

    def _chart(self) -> None:
        """Put the window's patches where they are believed now, for the next scans to be held against."""
        self._map, _, self._common = self._charted(self.window.nodes, self.window.frames)

    def _charted(self, nodes: NDArray[np.int64], frames: Array) -> tuple[SurfaceMap, Array, Array]:
        """Return patches in their frames ``(k, 3)`` as a surface map, with frames and common variances ``(k,)``."""
        patches = [self._patches[node] for node in nodes.tolist()]
        number = np.repeat(np.arange(len(patches)), [len(p.points) for p in patches])
        points = np.concatenate([np.zeros((0, 2)), *(p.points for p in patches)])
        normals = np.concatenate([np.zeros((0, 2)), *(p.normals for p in patches)])
        reach = np.concatenate([np.zeros(0), *(p.reach for p in patches)])
        x, y, theta = frames[number].T
        c, s = np.cos(theta), np.sin(theta)
        placed = np.column_stack([x + c * points[:, 0] - s * points[:, 1], y + s * points[:, 0] + c * points[:, 1]])
        turned = np.column_stack([c * normals[:, 0] - s * normals[:, 1], s * normals[:, 0] + c * normals[:, 1]])
        config = self.config
        straight = np.array([p.straight for p in patches], bool)
        common = np.where(straight, config.features.wall_sigma_m**2, config.common_m**2)
        return SurfaceMap(placed, turned, reach, number), frames, common

    # ---- the map that is shown -----------------------------------------------------------------------------

    def _draw_it(self, scan: Scan) -> None:
        body, surface = self._mean, self.extractor.surface
        sensor = self.sensor_pose(body)
        self.grid.integrate(
            sensor, scan, surface, body=(float(body[0]), float(body[1]), self.config.body_radius_m)
        )
        x, y, theta = sensor.tolist()
        if self.key_scans.wants(x, y, theta):
            self.key_scans.keep(sensor, scan, surface, np.zeros(0, np.int64), np.zeros((0, 2)))
            self._drawn.append((scan, surface.copy()))
            self._drawn_at.append(len(self._at) - 1)
            self._shown.append(sensor)

    def _redraw_if_moved(self) -> None:
        """Redraw the grid where a scan would be drawn from more than half a cell from where it was."""
        if not self._drawn:
            return
        bodies, drawn = self._poses_of(self._drawn_at), np.array(self._shown)
        path = np.array([self.sensor_pose(body) for body in bodies])
        off = np.hypot(*(path - drawn)[:, :2].T) + np.abs(wrap(path[:, 2] - drawn[:, 2])) * (
            self.config.key_scans.lever_m
        )
        if float(off.max()) > 0.5 * self.grid.resolution:
            self.grid.redraw(path, self._drawn)
            self._shown = list(path)

    def observe(self, observations: Observations) -> None:
        """Refuse: surfaces have no use for landmark observations."""
        raise ValueError(
            "graph-slam maps surfaces, not landmarks: it takes scans (`update`), not landmark observations; "
            "use ekf or fastslam2 for those"
        )

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
        """The poses at every update ``(updates, 3)`` as they are known by now."""
        return self._poses_of(range(len(self._at)))

    def _poses_of(self, updates: Sequence[int]) -> Array:
        """Return the poses at some of the updates ``(k, 3)``."""
        keys = self.graph.poses[[self._at[k] for k in updates]]
        seen = np.array([self._from[k] for k in updates]).reshape(-1, 3)
        c, s = np.cos(keys[:, 2]), np.sin(keys[:, 2])
        x = keys[:, 0] + c * seen[:, 0] - s * seen[:, 1]
        y = keys[:, 1] + s * seen[:, 0] + c * seen[:, 1]
        return np.column_stack([x, y, wrap(keys[:, 2] + seen[:, 2])])

    @property
    def belief(self) -> Belief:
        """Pose and grid; landmarks are empty, and there is no joint covariance."""
        return Belief(
            pose=self.pose,
            pose_cov=self.pose_cov,
            landmarks=np.zeros((0, 2)),
            landmark_cov=np.zeros((0, 2, 2)),
            landmark_ids=np.zeros(0, np.int64),
            grid=self.grid,
        )


def _full(upper: Array) -> Array:
    return np.asarray(np.triu(upper) + np.triu(upper, 1).T, np.float64)


def _about_z(turn: float) -> Array:
    c, s = math.cos(turn), math.sin(turn)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
