"""The error that a map starts with: how badly the landmarks in sight of the start would tell the pose alone.

How much uncertainty that is, D-optimality says (Carrillo, Reid and Castellanos, "On the comparison of uncertainty
criteria for active SLAM", ICRA 2012): the n-th root of the determinant, which alone of the usual criteria keeps
proportions between errors of different units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from slam.belief import Belief
from slam.landmarks.association import predicted
from slam.types import LINE, Array, Flags

__all__ = ["Marks", "anchoring", "d_optimality", "marks_of", "spread_m"]


@dataclass(frozen=True, eq=False)
class Marks:
    """A belief's landmarks, corners before walls, with their joint covariance, which is read when asked for."""

    x: Array  # (3 + 2m,) robot, then x, y [m] of corners and α [rad], r [m] of walls
    kinds: Array  # (m,) 0 for a corner, LINE for a wall
    ends: Array  # (m, 4) x1, y1, x2, y2 of walls [m]; zeros for corners
    belief: Belief

    @cached_property
    def cov(self) -> Array:
        """Joint covariance ``(3 + 2m, 3 + 2m)``."""
        belief = self.belief
        known = belief.whole_cov if belief.has_whole_cov else belief.joint_cov
        if known is not None:
            return np.array(known)
        cov = np.zeros((len(self.x), len(self.x)))
        cov[:3, :3] = belief.pose_cov
        for i in range(len(belief.landmarks)):
            cov[3 + 2 * i : 5 + 2 * i, 3 + 2 * i : 5 + 2 * i] = belief.landmark_cov[i]
        return cov


def marks_of(belief: Belief) -> Marks:
    """Return what a belief knows of its landmarks.

    Where the backend has no joint covariance, the pose and each corner stand for themselves; walls are left out,
    of which nothing is known then but where they are.
    """
    n = len(belief.landmarks)
    walls = belief.lines if belief.has_whole_cov else belief.lines[:0]
    ends = np.zeros((n + len(walls), 4))
    ends[n:] = belief.line_ends[: len(walls)]
    x = np.concatenate([belief.pose, belief.landmarks.ravel(), walls.ravel()])
    return Marks(x, np.repeat([0.0, float(LINE)], [n, len(walls)]), ends, belief)


def d_optimality(cov: Array) -> float:
    """Return det(cov)^(1/n), the geometric mean of the variances along the principal axes; 0 where singular."""
    sign, log_det = np.linalg.slogdet(cov)
    return math.exp(float(log_det) / len(cov)) if sign > 0 else 0.0


def spread_m(pose_cov: Array, lever_m: float) -> float:
    """Return the pose's D-optimality as a length [m], its heading counted by what it moves ``lever_m`` away."""
    scale = np.array([1.0, 1.0, lever_m])
    return math.sqrt(d_optimality(pose_cov * scale * scale[:, None]))


def anchoring(marks: Marks, seen: Flags, offset_m: float) -> Array:
    """Return how badly the landmarks in sight alone would tell the pose ``(3, 3)``: the error a map starts with.

    Each speaks by what is uncertain of it *relative to the robot*, H P Hᵀ. A robot that leaves its well known
    place takes their word for where it is, and what it maps from there on has this error in common.
    """
    information = np.zeros((3, 3))
    h = np.zeros((2, 5))
    for i in np.flatnonzero(seen):
        predicted(marks.x, int(i), float(marks.kinds[i]), offset_m, h)
        rows = np.array([0, 1, 2, 3 + 2 * i, 4 + 2 * i])
        relative = h @ marks.cov[np.ix_(rows, rows)] @ h.T + 1e-14 * np.eye(2)
        information += h[:, :3].T @ np.linalg.solve(relative, h[:, :3])
    if np.linalg.matrix_rank(information) < 3:
        return np.diag([math.inf] * 3)
    return np.asarray(np.linalg.inv(information))
