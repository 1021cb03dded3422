"""What driving a path would leave of a belief's uncertainty: the filter's covariance, propagated before driving.

Along a path without noise the innovations are zero, the estimate stays where it is, and so do the Jacobians: the
filter's own prediction and update (theory.md A; :mod:`slam.motion`, :mod:`slam.gaussian.stacked_update`) yield the
covariance that it will have, with the corners and walls that the belief's grid lets the sensor see from each
place. Then the right-invariant filter's reset is the identity, and the change to its error coordinates has
determinant one, so this is its covariance, too (invariant-ekf.md).

How much uncertainty that is, D-optimality says (Carrillo, Reid and Castellanos, "On the comparison of uncertainty
criteria for active SLAM", ICRA 2012): the n-th root of the determinant, which alone of the usual criteria keeps
proportions between errors of different units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.view_points.sightings import BEAM, SensorModel, expected_sightings
from agents.ways.cost_map import CostMap
from mecanum_env.config import LidarConfig
from slam import geometry
from slam.belief import Belief
from slam.gaussian.lanes import aligned_zeros
from slam.gaussian.stacked_update import whiten, work_space
from slam.gaussian.tiles import downdate
from slam.landmarks.association import predicted
from slam.motion import OdometryNoise, predict_robot, twist_between
from slam.settings import Config, Few, Length, Rate, Within
from slam.types import LINE, Array

__all__ = [
    "Foreseen",
    "Foresight",
    "ForesightConfig",
    "Marks",
    "anchoring",
    "d_optimality",
    "marks_of",
    "spread_m",
]

_MOST = 32  # landmarks in one update: those that the sensor sees best


@dataclass(frozen=True, kw_only=True)
class ForesightConfig(Config):
    """How a path is thought through."""

    # The scans of a leg are taken together, as seen from its end.
    leg_m: Annotated[float, Within("[0.05, 1000]")] = 0.75
    most_legs: Few = 8  # of a path: those of a long one are longer
    speed_m_s: Rate = 0.45  # at which paths are driven, on average
    turn_rate_rad_s: Rate = 0.8
    lever_m: Length = 4.0  # an error of the heading counts as what it moves at this distance
    sensor: SensorModel = field(default_factory=SensorModel)


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


@dataclass(frozen=True, eq=False)
class Foreseen:
    """What the end of a path would find."""

    pose_cov: Array  # (3, 3) [m², m·rad, rad²]
    information: float  # [nat] that its sightings bring: ½ Σ log(|S| / |R|)
    sightings: NDArray[np.int64]  # (legs + 1,) corners and walls in sight of each leg's end, the start's first


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


class Foresight:
    """Thinks paths through on one belief and planning grid.

    Parameters
    ----------
    config : ForesightConfig
        How a path is thought through.
    lidar : LidarConfig
        The sensor that will look.
    odometry : OdometryNoise
        How well the wheels are believed to tell the motion.
    step_s : float
        Time between two scans [s].
    """

    def __init__(
        self, config: ForesightConfig, *, lidar: LidarConfig, odometry: OdometryNoise, step_s: float = 0.1
    ) -> None:
        self.config = config
        self._lidar, self._odometry, self._step_s = lidar, odometry, step_s

    def along(self, marks: Marks, cost_map: CostMap, path: Array) -> Foreseen:
        """Return what is left of the uncertainty at the end of a path ``(n, 2)`` [m] from the robot's place."""
        poses, times = self.legs(marks.x[:3], path)
        return self.through(marks, cost_map, poses, times)

    def legs(self, pose: Array, path: Array) -> tuple[Array, Array]:
        """Return the poses ``(k, 3)`` at the ends of a path's legs, the start's first, and the legs' times [s]."""
        config = self.config
        steps = np.hypot(*np.diff(path, axis=0).T) if len(path) > 1 else np.zeros(0)
        arc = np.concatenate([[0.0], np.cumsum(steps)])
        count = min(max(1, math.ceil(float(arc[-1]) / config.leg_m)), config.most_legs)
        at = np.linspace(0.0, float(arc[-1]), count + 1)
        points = np.column_stack([np.interp(at, arc, path[:, axis]) for axis in (0, 1)])
        ways = np.diff(points, axis=0)
        headings = np.concatenate([[pose[2]], np.arctan2(ways[:, 1], ways[:, 0])])
        poses = np.column_stack([points, headings])
        turns = np.abs([geometry.wrap_scalar(float(v)) for v in np.diff(headings)])
        driven = np.hypot(*ways.T) / config.speed_m_s
        return poses, np.concatenate([[0.0], np.maximum(driven, turns / config.turn_rate_rad_s)])

    def through(self, marks: Marks, cost_map: CostMap, poses: Array, times: Array) -> Foreseen:
        """Return the same for poses ``(k, 3)`` and the time ``(k,)`` [s] that each takes to be reached."""
        seen, cov = expected_sightings(
            cost_map, poses, marks.x[3:].reshape(-1, 2), marks.kinds, marks.ends,
            lidar=self._lidar, model=self.config.sensor, most=_MOST,
        )  # fmt: skip
        # What is never seen has no part in how the rest goes on: it is left out, which is exact.
        used = np.flatnonzero(seen.any(axis=0))
        rows = np.concatenate([np.arange(3), np.column_stack([3 + 2 * used, 4 + 2 * used]).ravel()])
        n = len(rows)
        x, p = marks.x[rows], aligned_zeros(n, n)
        p[:, :n] = marks.cov[np.ix_(rows, rows)]
        h, w, s = work_space(_MOST, n)
        twists, variances = self._motion(poses, times)
        information = _propagate(
            x, p, n, poses, times, twists, variances, np.maximum(times / self._step_s, 1.0), self._lidar.offset_m,
            np.ascontiguousarray(seen[:, used]), np.ascontiguousarray(cov[:, used]), marks.kinds[used], h, w, s,
        )  # fmt: skip
        upper = np.triu(p[:3, :3])
        return Foreseen(upper + np.triu(upper, 1).T, information, seen.sum(axis=1))

    def _motion(self, poses: Array, times: Array) -> tuple[Array, Array]:
        """Return each leg's twist ``(k, 3)`` and variances ``(k, 2)``, for a leg taken as one step.

        The noise of its steps is independent: over a leg of m steps the mean twist has 1/m of their variance.
        """
        twists, variances = np.zeros((len(times), 3)), np.zeros((len(times), 2))
        for k in range(len(times)):
            if times[k] <= 0.0:
                continue
            if k > 0:
                twists[k] = twist_between(poses[k - 1], poses[k], float(times[k]))
            vx, vy, omega = twists[k].tolist()
            share = min(self._step_s / float(times[k]), 1.0)
            variances[k] = share * np.array(self._odometry.variances(vx, vy, omega))
        return twists, variances


def anchoring(marks: Marks, seen: NDArray[np.bool_], offset_m: float) -> Array:
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


@njit(cache=True, nogil=True, error_model="numpy")
def _propagate(
    x: Array, p: Array, n: int, poses: Array, times: Array, twists: Array, variances: Array, scans: Array,
    offset: float, seen: NDArray[np.bool_], cov: Array, kinds: Array, h: Array, w: Array, s: Array,
) -> float:  # fmt: skip
    """Predict and update the upper triangle ``p`` leg by leg; return ½ Σ log(|S| / |R|).

    The scans of a leg are worth one of as many times the information. The start ``poses[0]`` counts where it takes
    time.
    """
    information = 0.0
    most = h.shape[0]
    z = np.zeros((most, BEAM))
    match = np.empty(most, np.int64)
    for k in range(poses.shape[0]):
        if times[k] <= 0.0:
            continue
        if k > 0:
            predict_robot(
                x, p, n, twists[k, 0], twists[k, 1], twists[k, 2], times[k], variances[k, 0], variances[k, 1]
            )
        x[:3] = poses[k]
        count = 0
        for i in range(kinds.shape[0]):
            if seen[k, i] and count < most:
                z[count, 2:5] = cov[k, i] / scans[k]
                z[count, 5] = kinds[i]
                match[count] = i
                information -= 0.5 * math.log(z[count, 2] * z[count, 4] - z[count, 3] ** 2)
                count += 1
        rows = whiten(x, p, n, z[:count], match[:count], offset, h, w, s)
        for j in range(rows):
            information -= math.log(s[j, j])  # 1 / L_jj
        if rows > 0:
            downdate(p, n, w, w, rows, 0)
    return information
