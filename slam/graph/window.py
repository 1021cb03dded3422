"""What is in reach: the joint Gaussian of the last key scan and the patches around, corrected scan by scan.

Between two solutions of the whole graph this is the same least squares problem, solved incrementally and without
what lies far away (a Kalman filter over the patches in reach).
"""

from __future__ import annotations

import math

import numpy as np

from slam.geometry import compose, wrap
from slam.graph.matching import Links
from slam.graph.pose_graph import relative_jacobians
from slam.types import Array, Flags, Indices

__all__ = ["Window", "moved"]


def moved(pose: Array, motion: Array) -> tuple[Array, Array, Array]:
    """Return pose ∘ motion, with its Jacobians ``(3, 3)`` by pose and by motion."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    dx, dy = c * motion[0] - s * motion[1], s * motion[0] + c * motion[1]
    by_pose = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    by_motion = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return compose(pose, motion), by_pose, by_motion


class Window:
    """Mean and covariance of the key scan (rows 0 … 2) and the patches in reach (three rows each)."""

    def __init__(self, pose: Array, pose_cov: Array) -> None:
        self.pose, self.cov = np.array(pose, np.float64), np.array(pose_cov, np.float64)
        self.frames = np.zeros((0, 3))  # of the patches
        self.nodes = np.zeros(0, np.int64)  # their numbers in the graph

    def ahead(self, motion: Array, motion_cov: Array) -> tuple[Array, Array]:
        """Return where the robot is after a motion from the key scan, mean ``(3,)`` and rows of the joint cov."""
        pose, f, g = moved(self.pose, motion)
        rows = f @ self.cov[:3]  # (3, 3 + 3m) with everything, the key scan's own columns first
        rows[:, :3] = rows[:, :3] @ f.T + g @ motion_cov @ g.T
        return pose, rows

    def step(self, motion: Array, motion_cov: Array) -> None:
        """Let the robot's pose after a motion stand in the key scan's place."""
        pose, rows = self.ahead(motion, motion_cov)
        self.pose = pose
        self.cov[:3] = rows
        self.cov[3:, :3] = rows[:, 3:].T

    def corrected(self, at: Array, links: Links, pose: Array, rows: Array) -> tuple[Array, Array]:
        """Return pose and covariance of a robot ahead (see :meth:`ahead`) that a scan aligned at ``at`` links."""
        if not len(links.patches):
            return pose, rows[:, :3]
        part = self._part(links)
        p = self.cov[np.ix_(part, part)]
        p[:3] = rows[:, part]
        p[3:, :3] = p[:3, 3:].T
        info, gain = self._normal(at, links, pose)
        # P - P (I + Λ P)⁻¹ Λ P
        m = np.linalg.solve(np.eye(len(part)) + info @ p, np.column_stack([gain, info @ p[:, :3]]))
        mean = pose - p[:3] @ m[:, 0]
        mean[2] = float(wrap(mean[2]))
        cov = p[:3, :3] - p[:3] @ m[:, 1:]
        return mean, 0.5 * (cov + cov.T)

    def correct(self, at: Array, links: Links) -> None:
        """Correct everything by a scan from the pose that stands in the key scan's place, aligned at ``at``."""
        if not len(links.patches):
            return
        part = self._part(links)
        rows = self.cov[part]  # (k, all)
        info, gain = self._normal(at, links, self.pose)
        m = np.linalg.solve(np.eye(len(part)) + info @ rows[:, part], np.column_stack([gain, info @ rows]))
        change = -(rows.T @ m[:, 0]).reshape(-1, 3)
        self.pose = self.pose + change[0]
        self.pose[2] = float(wrap(self.pose[2]))
        self.frames = self.frames + change[1:]
        self.frames[:, 2] = wrap(self.frames[:, 2])
        cov = self.cov - rows.T @ m[:, 1:]
        self.cov = 0.5 * (cov + cov.T)

    def _part(self, links: Links) -> Indices:
        return np.concatenate([np.arange(3), (3 + 3 * links.patches[:, None] + np.arange(3)).ravel()])

    def _normal(self, at: Array, links: Links, pose: Array) -> tuple[Array, Array]:
        """Return information Λ and its gradient at the prior mean, of the robot and the linked patches."""
        frames = self.frames[links.patches]
        _, by_frame, by_pose = relative_jacobians(frames, np.tile(at, (len(frames), 1)))
        k = len(frames)
        j = np.zeros((k, 3, 3 + 3 * k))
        j[:, :, :3] = by_pose
        for g in range(k):
            j[g, :, 3 + 3 * g : 6 + 3 * g] = by_frame[g]
        flat = j.reshape(3 * k, -1)
        weighted = (links.info @ j).reshape(3 * k, -1)
        info = flat.T @ weighted
        off = np.zeros(3 + 3 * k)
        off[:3] = pose - at
        off[2] = float(wrap(off[2]))
        return info, flat.T @ links.gradient.ravel() + info @ off

    def add(self, node: int, info: Array) -> None:
        """Add a patch of the key scan: its frame is the key scan's, known to an information ``(3, 3)``."""
        _, f, g = moved(self.pose, np.zeros(3))
        n = len(self.cov)
        cov = np.zeros((n + 3, n + 3))
        cov[:n, :n] = self.cov
        cov[n:, :n] = f @ self.cov[:3]
        cov[:n, n:] = cov[n:, :n].T
        cov[n:, n:] = f @ self.cov[:3, :3] @ f.T + g @ np.linalg.inv(info) @ g.T
        self.cov = cov
        self.frames = np.vstack([self.frames, self.pose])
        self.nodes = np.append(self.nodes, node)

    def keep(self, rows: Flags) -> None:
        """Leave only some of the patches ``(m,)`` in reach."""
        part = np.concatenate([np.ones(3, bool), np.repeat(rows, 3)])
        self.cov = self.cov[np.ix_(part, part)]
        self.frames, self.nodes = self.frames[rows], self.nodes[rows]

    def replace(self, pose: Array, frames: Array, nodes: Indices, cov: Array) -> None:
        """Take over the graph's solution: the key scan's pose, the patches' frames and their joint covariance."""
        self.pose, self.frames, self.nodes, self.cov = pose.copy(), frames.copy(), nodes.copy(), cov
