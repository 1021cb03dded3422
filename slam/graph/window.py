"""What is in reach: the joint Gaussian of the last key scan and the patches around, corrected scan by scan.

Between two solutions of the whole graph this is the same least squares problem, solved incrementally and without
what lies far away (a Kalman filter over the patches in reach). No scan says which way the whole is turned, but a
filter whose covariance stays where it is while its means move would learn it, linearised here and there. So the
covariance is carried along (:func:`carried`), which makes this an invariant filter (Barrau and Bonnabel, "An
EKF-SLAM algorithm with consistency properties", arXiv:1510.06263).
"""

from __future__ import annotations

import math

import numpy as np

from slam.geometry import compose, exp, log, wrap
from slam.graph.matching import Links
from slam.graph.pose_graph import relative_jacobians
from slam.types import Array, Flags, Indices

__all__ = ["Window", "carried", "moved"]


def moved(pose: Array, motion: Array) -> tuple[Array, Array, Array]:
    """Return pose ∘ motion, with its Jacobians ``(3, 3)`` by pose and by motion."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    dx, dy = c * motion[0] - s * motion[1], s * motion[0] + c * motion[1]
    by_pose = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    by_motion = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return compose(pose, motion), by_pose, by_motion


def carried(cov: Array, by: Array) -> Array:
    """Return the covariance ``(3k, 3k)`` of poses whose means have moved by so much ``(k, 2)`` [m].

    An error that turns them all turns them about the same point as before: G P Gᵀ, where a pose that has moved by
    (dx, dy) errs by δθ (-dy, dx) more.
    """
    out = cov.copy()
    out[0::3] -= by[:, 1:] * cov[2::3]
    out[1::3] += by[:, :1] * cov[2::3]
    turned = out[:, 2::3].copy()
    out[:, 0::3] -= by[:, 1] * turned
    out[:, 1::3] += by[:, 0] * turned
    return out


def _retracted(poses: Array, change: Array) -> Array:
    """Return poses ``(k, 3)`` after a change ``(k, 3)`` of their errors, along the exponential: p + V(δθ) δp."""
    return np.array([
        [*(pose[:2] + step[:2]), float(wrap(pose[2] + delta[2]))]
        for pose, delta, step in zip(poses, change, map(exp, change), strict=True)
    ])  # fmt: skip


def _change(to: Array, at: Array) -> Array:
    """Return the change ``(3,)`` by which a pose ``at`` becomes another: what :func:`_retracted` undoes."""
    return log(np.array([*(to[:2] - at[:2]), float(wrap(to[2] - at[2]))]))


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
        poses = np.vstack([pose, self.frames[links.patches]])
        mean, cov = self._updated(poses, p, np.arange(len(part)), at, links)
        return mean[0], cov[:3, :3]

    def correct(self, at: Array, links: Links) -> None:
        """Correct everything by a scan from the pose that stands in the key scan's place, aligned at ``at``."""
        if not len(links.patches):
            return
        poses = np.vstack([self.pose, self.frames])
        mean, self.cov = self._updated(poses, self.cov, self._part(links), at, links)
        self.pose, self.frames = mean[0], mean[1:]

    def _updated(self, poses: Array, cov: Array, part: Indices, at: Array, links: Links) -> tuple[Array, Array]:
        """Return mean ``(k, 3)`` and covariance of the robot and patches after a scan that is aligned ``at``.

        ``part`` are the rows of ``cov`` that the links are between. The robot is linearised where the scan lies.
        """
        around, off = poses.copy(), np.zeros(3 * len(poses))
        around[0], off[:3] = at, _change(poses[0], at)
        cov = carried(cov, around[:, :2] - poses[:, :2])
        info, gradient = self._normal(at, links)
        rows = cov[part]  # (linked, all)
        # P - P (I + Λ P)⁻¹ Λ P
        gain = gradient + info @ off[part]
        m = np.linalg.solve(np.eye(len(part)) + info @ rows[:, part], np.column_stack([gain, info @ rows]))
        mean = _retracted(around, (off - rows.T @ m[:, 0]).reshape(-1, 3))
        cov = carried(cov - rows.T @ m[:, 1:], mean[:, :2] - around[:, :2])
        return mean, 0.5 * (cov + cov.T)

    def _part(self, links: Links) -> Indices:
        return np.concatenate([np.arange(3), (3 + 3 * links.patches[:, None] + np.arange(3)).ravel()])

    def _normal(self, at: Array, links: Links) -> tuple[Array, Array]:
        """Return information Λ and gradient ``at`` the aligned scan, of the robot and the linked patches."""
        frames = self.frames[links.patches]
        _, by_frame, by_pose = relative_jacobians(frames, np.tile(at, (len(frames), 1)))
        k = len(frames)
        j = np.zeros((k, 3, 3 + 3 * k))
        j[:, :, :3] = by_pose
        for g in range(k):
            j[g, :, 3 + 3 * g : 6 + 3 * g] = by_frame[g]
        flat = j.reshape(3 * k, -1)
        weighted = (links.info @ j).reshape(3 * k, -1)
        return flat.T @ weighted, flat.T @ links.gradient.ravel()

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

    def moved_to(self, pose: Array, frames: Array) -> None:
        """Take over means of the graph's solution; the covariance is known as well as it was."""
        by = np.vstack([pose - self.pose, frames - self.frames])[:, :2]
        self.pose, self.frames, self.cov = pose.copy(), frames.copy(), carried(self.cov, by)

    def replace(self, pose: Array, frames: Array, nodes: Indices, cov: Array) -> None:
        """Take over the graph's solution: the key scan's pose, the patches' frames and their joint covariance."""
        self.pose, self.frames, self.nodes, self.cov = pose.copy(), frames.copy(), nodes.copy(), cov
