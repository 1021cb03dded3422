"""Backends that map without estimating the pose: ``odometry`` (dead reckoning) and ``truth`` (pose given).

They stand beside the estimators so that what SLAM brings is seen. Given the pose, landmarks are independent of
each other, so each has its own two-dimensional Kalman filter.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from slam.belief import Belief
from slam.ekf import EkfSlam
from slam.gaussian.stacked_update import NO_LIMITS
from slam.geometry import wrap
from slam.metrics.measures import nees_pose_invariant
from slam.types import Array, Indices, Odometry, Scan

__all__ = ["OdometrySlam", "TruthSlam"]


class OdometrySlam(EkfSlam):
    """Dead reckoning: the pose is what the wheels say, with the covariance that follows from their noise."""

    relocalises = False  # the pose is not for the scan to doubt

    def _start(self, pose: Array, pose_cov: Array, seed: int) -> None:
        super()._start(pose, pose_cov, seed)
        self._robot_cov = np.array(pose_cov)

    def predict(self, odometry: Odometry) -> None:
        """Move on by what the wheels measured; the covariance grows beside the map's, never into it."""
        self._p[:3, :3] = np.triu(self._robot_cov)
        super().predict(odometry)
        upper = self._p[:3, :3]
        self._robot_cov = upper + np.triu(upper, 1).T
        self._pin()

    def _pin(self) -> None:
        # Landmarks are mapped as though the pose were known: (almost) no variance, no correlation.
        self._p[:3, : self._n] = 0.0
        self._p[:3, :3] = np.eye(3) * 1e-18

    def _correct(self, z: Array, match: Indices, limits: Array = NO_LIMITS) -> None:
        # Without limits: what is believed to be known of the pose is untrue, and scans will say so.
        self._pin()
        pose, kept = self._x[:3].copy(), self._beside.snapshot()
        super()._correct(z, match)
        self._x[:3] = pose
        self._beside.restore(kept)

    def _may_spin(self, scan: Scan, match: Indices, recent: int, still: int) -> bool:
        return False  # the pose is not for the scan to doubt

    @property
    def pose_cov(self) -> Array:
        """Pose covariance ``(3, 3)``."""
        return self._robot_cov.copy()

    def pose_nees(self, true_pose: Array) -> float:
        """Return the pose's NEES in the invariant error: a heading that drifts bends the ellipse in x and y."""
        return float(nees_pose_invariant(self._x, self._robot_cov, np.asarray(true_pose, dtype=np.float64)))

    @property
    def belief(self) -> Belief:
        """Pose, landmarks and grid; there is no joint covariance."""
        return dataclasses.replace(
            super().belief, pose_cov=self.pose_cov, joint_cov=None, whole_cov=None, _read=None
        )


class TruthSlam(OdometrySlam):
    """Mapping with the true pose given: the bound on what an estimator can reach."""

    def give_pose(self, pose: Array) -> None:
        """Set the pose ``(3,)``; to be called between ``predict`` and ``update``."""
        if not np.all(np.isfinite(pose)):
            raise ValueError("a given pose must be finite")
        self._x[:3] = pose
        self._x[2] = wrap(self._x[2])
        self._robot_cov = np.eye(3) * 1e-12

    def predict(self, odometry: Odometry) -> None:
        """Do nothing: the pose is given."""
        del odometry
        self._pin()
