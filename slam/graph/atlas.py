"""Everything that is mapped: the graph, its patches, and the window of what is in reach."""

from __future__ import annotations

import math

import numpy as np

from slam.features.surfaces import MAX_LINES
from slam.geometry import about_z, relative
from slam.graph.loop_closing import Candidate, agreeing, find_candidate
from slam.graph.matching import Alignment, Links, SurfaceMap, align
from slam.graph.patches import ModelError, Patch, extended, new_patches
from slam.graph.pose_graph import PoseGraph, relative_jacobians
from slam.graph.settings import GraphSlamConfig
from slam.graph.surfaces import BeamEnds
from slam.graph.window import Window
from slam.types import Array, Flags, Indices

__all__ = ["Atlas"]

_LEAST_HELD = 5  # beams on a patch, for their surface to be the patch's
_PROBES = 6  # old patches by which it is asked whether those in reach are surely known
_HALF = 0.5  # of a closing's information counts: the same beams link the scan to what is in the window, too
_WITNESSES = 3  # patches that tell where a robot was found
_NEAR_M = 0.1  # 1σ of the pose up to which old patches in sight are known by being near what is seen
_PATIENCE = 3.0  # how much rarer it looks, at most, where it looks in vain


class Atlas:
    """Key scans and patches.

    Attributes
    ----------
    graph : PoseGraph
        All of them.
    window : Window
        The last key scan and the patches in reach.
    surfaces : SurfaceMap
        The patches in reach, to hold scans against.
    common_var : Array
        ``(m,)`` [m²] of what the beams of a scan on one of these patches have in common.
    key : int
        Node of the last key scan.
    solutions : int
        How often the whole graph was solved.
    """

    def __init__(self, config: GraphSlamConfig, pose: Array, pose_cov: Array) -> None:
        self.config = config
        self.graph, self.window = PoseGraph(pose, pose_cov), Window(pose, pose_cov)
        self.key, self.solutions, self.closings = 0, 0, 0
        self._patches: dict[int, Patch] = {}  # node → patch
        self._way = 0.0  # [m] driven, from key scan to key scan
        self._look_at = 0.0  # way from which on it looks back again
        self._rest = config.closing.every_m  # way from one look to the next: longer where they are in vain
        self._candidates: list[Candidate] = []
        features = config.features
        ledge = max(features.split_sigmas * features.range_sigma_m, features.split_floor_m)
        self._model = ModelError(config.straight_m, config.common_m, ledge)
        self.chart()

    # ---- key scans -----------------------------------------------------------------------------------------

    def begin(self, ends: BeamEnds) -> None:
        """Make patches of the first scan."""
        self._add_patches(ends, ends.spacing <= self.config.spacing_m)
        self.chart()

    def add_key(
        self, motion: Array, motion_cov: Array, ends: BeamEnds, found: Alignment, seen: Links, reach_m: float
    ) -> None:
        """Make a scan a key scan, ``motion`` ``(3,)`` away from the last one, and bring the window up to date."""
        window, graph = self.window, self.graph
        window.step(motion, motion_cov)
        window.correct(found.pose, seen)
        node = graph.add_node(window.pose)
        graph.add_link(self.key, node, motion, np.asarray(np.linalg.inv(motion_cov), np.float64))
        for k, p in enumerate(seen.patches.tolist()):
            graph.add_link(int(window.nodes[p]), node, seen.relative[k], seen.info[k], seen.gradient[k])
        self.key = node
        graph.poses[window.nodes] = window.frames
        unexplained = (ends.spacing <= self.config.spacing_m) & (found.beside < 0)
        self._extend_patches(ends, found, unexplained)
        self._add_patches(ends, unexplained)
        self._way += math.hypot(motion[0], motion[1])
        window.keep(self._distances(window.nodes, window.pose) <= reach_m + self.config.beyond_m)
        self._look_back(ends, reach_m)
        self.chart()

    def found_at(self, pose: Array, cov: Array, reach_m: float) -> bool:
        """Make a key scan of where the robot was found, whatever led it there; tell whether patches are near.

        ``cov`` ``(3, 3)`` is of the pose as seen from what is mapped around. The nearest patches tell where that
        is, each with as many times the covariance as there are of them: they all err with the one pose.
        """
        graph, nodes = self.graph, np.fromiter(self._patches, np.int64, len(self._patches))
        distance = self._distances(nodes, pose)
        nodes = nodes[np.argsort(distance, kind="stable")][: np.count_nonzero(distance <= reach_m)]
        if not len(nodes):
            return False
        self.key = graph.add_node(pose)
        told_by = nodes[:_WITNESSES]
        for node in told_by.tolist():
            frame = graph.poses[node]
            turn = about_z(-float(frame[2]))
            info = np.asarray(np.linalg.inv(len(told_by) * turn @ cov @ turn.T), np.float64)
            graph.add_link(node, self.key, relative(frame[None], pose[None])[0], info)
        graph.solve()
        self.solutions += 1
        self.window.replace(graph.poses[self.key], graph.poses[nodes], nodes, graph.covariance([self.key, *nodes]))
        self._candidates.clear()
        self.chart()
        return True

    def _add_patches(self, ends: BeamEnds, unexplained: Flags) -> None:
        for patch in new_patches(ends, unexplained, self._model):
            node = self.graph.add_node(self.window.pose)
            self._patches[node] = patch
            self.graph.add_link(self.key, node, np.zeros(3), patch.info)
            self.window.add(node, patch.info)

    def _extend_patches(self, ends: BeamEnds, found: Alignment, unexplained: Flags) -> None:
        """Let straight patches reach as far as their surface is seen to go on, and count those beams explained."""
        window = self.window
        if not np.any(found.beside >= 0):
            return
        number = np.where(found.beside >= 0, self.surfaces.patch[found.beside], -1)
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
            longer = extended(self._patches[node], ends, rows, seen, self._model)
            if longer is not None:
                self._patches[node] = longer
                unexplained[rows] = False

    # ---- what there is, and where --------------------------------------------------------------------------

    def chart(self) -> None:
        """Put the window's patches where they are believed now, for the next scans to be held against."""
        self.surfaces, self.common_var = self._charted(self.window.nodes, self.window.frames)

    def _charted(self, nodes: Indices, frames: Array) -> tuple[SurfaceMap, Array]:
        """Return patches in their frames ``(k, 3)`` as a surface map, with their common variances ``(k,)``."""
        patches = [self._patches[node] for node in nodes.tolist()]
        number = np.repeat(np.arange(len(patches)), [len(p.points) for p in patches])
        points = np.concatenate([np.zeros((0, 2)), *(p.points for p in patches)])
        normals = np.concatenate([np.zeros((0, 2)), *(p.normals for p in patches)])
        reach = np.concatenate([np.zeros(0), *(p.reach for p in patches)])
        x, y, theta = frames[number].reshape(-1, 3).T
        c, s = np.cos(theta), np.sin(theta)
        (px, py), (nx, ny) = points.T, normals.T
        placed = np.column_stack([x + c * px - s * py, y + s * px + c * py])
        turned = np.column_stack([c * nx - s * ny, s * nx + c * ny])
        return SurfaceMap(placed, turned, reach, number), np.array([p.common_var for p in patches])

    def _extents(self, nodes: Indices) -> tuple[Array, Array]:
        """Return centres ``(k, 2)`` and radii ``(k,)`` of patches [m], in their frames."""
        rows = np.array([self._patches[node].extent for node in nodes.tolist()]).reshape(-1, 3)
        return rows[:, :2], rows[:, 2]

    def _distances(self, nodes: Indices, pose: Array) -> Array:
        """Return how far from a pose ``(3,)`` patches begin ``(k,)`` [m]."""
        frames, (centres, radii) = self.graph.poses[nodes], self._extents(nodes)
        c, s = np.cos(frames[:, 2]), np.sin(frames[:, 2])
        x = frames[:, 0] + c * centres[:, 0] - s * centres[:, 1] - pose[0]
        y = frames[:, 1] + s * centres[:, 0] + c * centres[:, 1] - pose[1]
        return np.asarray(np.hypot(x, y) - radii, np.float64)

    # ---- old places ----------------------------------------------------------------------------------------

    def _look_back(self, ends: BeamEnds, reach_m: float) -> None:
        """Bring old patches in reach back into the window, those that are not surely known by closing a loop."""
        closing, graph, window = self.config.closing, self.graph, self.window
        if self._way < self._look_at:
            return
        patches = np.fromiter(self._patches, np.int64, len(self._patches))
        away = np.setdiff1d(patches, window.nodes)
        distance = self._distances(away, window.pose)
        order = np.argsort(distance, kind="stable")
        away = away[order[distance[order] <= reach_m]]
        if not len(away):
            return
        if float(window.cov[0, 0] + window.cov[1, 1]) < _NEAR_M**2:
            away = self._in_sight(away, ends)
            if len(away) < _PROBES:
                return
        self._look_at = self._way + self._rest
        self._rest = min(2.0 * self._rest, _PATIENCE * closing.every_m)
        self._solve()
        probes = away[:_PROBES]
        sigmas, near = self._seen(probes, graph.covariance([self.key, *probes]))
        known = np.count_nonzero(sigmas <= closing.sigma_m) >= 0.5 * len(probes)
        if not known and not self._close_loop(ends, away, near):
            return
        self._rest = closing.every_m
        nodes = np.concatenate([window.nodes, away])
        cov = graph.covariance([self.key, *nodes])
        first = np.r_[0:3, 3 + 3 * len(window.nodes) : len(cov)]
        sure = self._seen(away, cov[np.ix_(first, first)])[0] <= closing.sigma_m
        window.replace(graph.poses[self.key], graph.poses[nodes], nodes, cov)
        window.keep(np.concatenate([np.ones(len(nodes) - len(away), bool), sure]))

    def _in_sight(self, nodes: Indices, ends: BeamEnds) -> Indices:
        """Return those of the patches that some beam ends near to."""
        surfaces, _ = self._charted(nodes, self.graph.poses[nodes])
        pose = self.window.pose
        found = align(surfaces, ends, pose, prior=pose, prior_info=np.eye(3), gate_m=2.0 * _NEAR_M, iterations=0)
        seen = np.unique(surfaces.patch[found.beside[found.beside >= 0]])
        return np.asarray(nodes[seen], np.int64)

    def _solve(self) -> None:
        self.graph.solve()
        self.solutions += 1
        self.window.moved_to(self.graph.poses[self.key], self.graph.poses[self.window.nodes])

    def _seen(self, nodes: Indices, cov: Array) -> tuple[Array, Array]:
        """Return how well the middle of patches is known as seen from the robot ``(k,)``: the largest 1σ [m].

        ``cov`` is of the last key scan and the patches, jointly. Also returned is the covariance ``(3, 3)`` of the
        key scan's pose as seen from the first of them, in the directions of the map.
        """
        frames, (centres, _) = self.graph.poses[nodes], self._extents(nodes)
        pose = np.tile(self.graph.poses[self.key], (len(nodes), 1))
        d, by_pose, by_patch = relative_jacobians(pose, frames)
        c, s = np.cos(d[:, 2]), np.sin(d[:, 2])
        out = np.zeros(len(nodes))
        for k in range(len(nodes)):
            part = np.r_[0:3, 3 + 3 * k : 6 + 3 * k]
            j = np.hstack([by_pose[k], by_patch[k]])
            x, y = centres[k]
            at = np.array([[1.0, 0.0, -s[k] * x - c[k] * y], [0.0, 1.0, c[k] * x - s[k] * y]]) @ j
            out[k] = math.sqrt(max(float(np.linalg.eigvalsh(at @ cov[np.ix_(part, part)] @ at.T)[-1]), 0.0))
        _, by_patch, by_pose = relative_jacobians(frames[:1], pose[:1])
        j = about_z(float(frames[0, 2])) @ np.hstack([by_pose[0], by_patch[0]])
        return out, np.asarray(j @ cov[:6, :6] @ j.T, np.float64)

    def _close_loop(self, ends: BeamEnds, nodes: Indices, pose_cov: Array) -> bool:
        """Hold the scan against old patches; where it and others before it agree, close the loop."""
        config, graph = self.config, self.graph
        frames = graph.poses[nodes].copy()
        surfaces, common = self._charted(nodes, frames)
        candidate = find_candidate(
            surfaces, frames, common, nodes, ends, self.window.pose, pose_cov, config.closing, config.matching,
            node=self.key, way_m=self._way,
        )  # fmt: skip
        if candidate is None:
            return False
        recent = [c for c in self._candidates if candidate.way_m - c.way_m <= config.closing.recent_m]
        self._candidates = [*recent, candidate]
        self._rest = config.closing.every_m
        self._look_at = self._way + self._rest
        group = agreeing(self._candidates, config.closing)
        if not group:
            return False
        self._candidates.clear()
        before = graph.poses.copy()
        for member in group:
            for k, p in enumerate(member.links.patches.tolist()):
                graph.add_link(
                    int(member.nodes[p]), member.node, member.links.relative[k], _HALF * member.links.info[k],
                    _HALF * member.links.gradient[k], closing=self.closings,
                )  # fmt: skip
        self._solve()
        if graph.closing_loss(self.closings) > _HALF * config.closing.loss:
            graph.drop_closing(self.closings)
            graph.poses[:] = before
            self._solve()
            return False
        self.closings += 1
        return True
