"""What a joint Gaussian of the robot and every landmark is asked for: the pose, covariances, the belief.

A belief is given out cheaply: landmarks and covariances are read when someone asks for them, or just before the
state changes.
"""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np

from slam.belief import Belief
from slam.gaussian import joint_gaussian as joint
from slam.gaussian.settings import EkfConfig
from slam.landmark_backend import LandmarkBackend
from slam.metrics.measures import nees_pose
from slam.types import LINE, VIRTUAL, Array, Floats, Indices

__all__ = ["GaussianBackend"]


class GaussianBackend(LandmarkBackend):
    """A backend whose state is ``_x``, robot before landmarks; ``_p`` is the upper triangle of its covariance."""

    _x: Array
    _p: Array
    _n: int  # states: of both, what comes behind them is room to grow

    def __init__(self, config: EkfConfig) -> None:
        super().__init__(config)
        self._given: list[weakref.ref[Belief]] = []  # beliefs, since the state last changed

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_given": []}  # a copy has given none

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
        joint.symmetric_block(self._p, out)
        return out

    def pose_nees(self, true_pose: Array) -> float:
        """Return the NEES of the pose against the truth ``(3,)``."""
        return float(nees_pose(self._x, self._p, np.asarray(true_pose, dtype=np.float64)))

    @property
    def joint_cov(self) -> Array:
        """Covariance ``(3 + 2n, 3 + 2n)`` of the robot and every landmark, walls included."""
        return self._covariance(np.flatnonzero(self._marks[:, 0] != VIRTUAL))

    def _covariance(self, landmarks: Indices) -> Array:
        """Return the covariance of the robot and some landmarks."""
        return self._cov_with(landmarks)

    def _cov_with(self, rows: Indices) -> Array:
        return joint.with_robot(self._p, rows)

    def _own_covariances(self, landmarks: Indices) -> Array:
        """Return the covariances ``(n, 2, 2)`` of some landmarks, each by itself."""
        i, p = 3 + 2 * landmarks, self._p
        return np.stack([p[i, i], p[i, i + 1], p[i, i + 1], p[i + 1, i + 1]], axis=-1).reshape(-1, 2, 2)

    @property
    def _ids(self) -> Indices:
        """Ids ``(n,)`` of every landmark."""
        return self._book.ids

    def near_landmarks(self, out: Floats) -> None:
        """Write the nearest landmarks in the robot frame (see the base class)."""
        joint.near_landmarks(self._x, self._p, self._book.marks, out)

    @property
    def belief(self) -> Belief:
        """Pose, landmarks, joint covariance (of pose and points) and grid."""
        belief = Belief.postponed(
            self._landmarks, lambda: self._own_covariances(self._points_and_walls()[0]),
            lambda: self._covariance(np.concatenate(self._points_and_walls())),
            pose=self.pose, pose_cov=self.pose_cov, grid=self.grid, health=self.health,
        )  # fmt: skip
        self._given.append(weakref.ref(belief))
        return belief

    def _points_and_walls(self) -> tuple[Indices, Indices]:
        """Return the rows of both among all landmarks."""
        kinds = self._marks[:, 0]
        return np.flatnonzero(kinds < LINE), np.flatnonzero(kinds == LINE)

    def _landmarks(self) -> dict[str, Any]:
        """Return what the belief says of landmarks, but for their covariance."""
        marks, (points, _), (rows, walls) = self._marks, self._map_points(), self._points_and_walls()
        return {
            "landmarks": points[rows], "landmark_ids": self._ids[rows],
            "landmark_kinds": marks[rows, 0].astype(np.int8), "lines": points[walls],
            "line_ends": joint.line_ends(points[walls], marks[walls, 6:8]),
        }  # fmt: skip

    def _settle_beliefs(self) -> None:
        """Have the beliefs that were given, and that someone still holds, read what changes now."""
        for given in self._given:
            if (belief := given()) is not None:
                belief.settle()
        self._given.clear()
