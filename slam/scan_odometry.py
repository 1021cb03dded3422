"""Odometry made nearly exact by scans: each is matched to the few before it (Hähnel et al. 2003).

What is left to the particles is the slow drift of this local motion. The local map is the key scans of the last
metres, in a frame of its own, so a loop that a particle closes never tears it.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.geometry import transform_points
from slam.motion import OdometryNoise, predict_robot
from slam.scan_matching import LikelihoodField, MatchConfig, match, refine
from slam.settings import require
from slam.types import Odometry

__all__ = ["ScanOdometry", "ScanOdometryConfig"]

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ScanOdometryConfig:
    """The local map, and when a match to it is believed."""

    scans: int = 10  # key scans in the local map
    spacing_m: float = 0.25  # a scan becomes a key scan when the robot has moved or turned so far
    spacing_rad: float = 0.25
    fewest_points: int = 20  # a scan with fewer ends is not matched …
    least_score: float = 0.3  # … and a match with a lower mean field value is not believed
    # Odometry known to less than this is searched over the window of ``MatchConfig``, else only refined.
    search_sigma_m: float = 0.03
    search_sigma_rad: float = 0.015

    def __post_init__(self) -> None:
        require(self.scans >= 1, "ScanOdometryConfig.scans must be at least 1")
        require(self.fewest_points >= 1, "ScanOdometryConfig.fewest_points must be at least 1")
        require(0 <= self.least_score <= 1, "ScanOdometryConfig.least_score must be in [0, 1]")


class ScanOdometry:
    """Tracks the pose against the last key scans.

    Attributes
    ----------
    pose : Array
        ``(3,)`` in the local frame, which drifts.
    cov : Array
        ``(3, 3)`` of the motion since :meth:`settle`, in the local frame.
    """

    def __init__(self, config: ScanOdometryConfig, matching: MatchConfig, noise: OdometryNoise) -> None:
        self.config, self.matching, self.noise = config, matching, noise
        self.pose, self._upper = np.zeros(3), np.zeros((3, 3))
        self._scans: deque[tuple[Array, Array]] = deque(maxlen=config.scans)
        self._field: LikelihoodField | None = None
        self._twist = (0.0, 0.0, 0.0)
        self.settled = np.zeros(3)  # the pose at the last :meth:`settle`

    @property
    def cov(self) -> Array:
        """Covariance ``(3, 3)`` of the motion since :meth:`settle`."""
        return np.triu(self._upper) + np.triu(self._upper, 1).T

    def predict(self, odometry: Odometry) -> None:
        """Move on by what the wheels measured."""
        vx, vy, omega = twist = tuple(np.asarray(odometry.twist, dtype=np.float64).tolist())
        dt, noise = odometry.dt, self.noise
        slip = noise.slip(self._twist, twist, dt) if dt > 0 else 0.0
        var_v, var_w = noise.variances(vx, vy, omega, slip=slip)
        predict_robot(self.pose, self._upper, 3, vx, vy, omega, dt, var_v, var_w)
        self._twist = twist

    def correct(self, points: Array) -> bool:
        """Match a scan's ends ``(n, 2)`` [m, body frame] to the local map; tell whether that was believed."""
        config = self.config
        believed = False
        if self._field is not None and len(points) >= config.fewest_points:
            cov = self.cov + np.diag([1e-8, 1e-8, 1e-8])
            wide = max(cov[0, 0], cov[1, 1]) > config.search_sigma_m**2 or cov[2, 2] > config.search_sigma_rad**2
            info = np.linalg.inv(cov)
            if wide:
                found = match(self._field, points, self.pose, self.matching, prior_info=info)
            else:
                found = refine(
                    self._field, points, self.pose, self.matching, prior=self.pose, prior_info=info
                )
            believed = found.score >= config.least_score
            if believed:
                self.pose, self._upper = found.pose.copy(), found.cov
        if len(points) >= config.fewest_points and (believed or not self._scans) and self._moved_on():
            self._keep(points)
        elif not believed and self._moved_on():
            self._start_over(points)
        return believed

    def settle(self) -> None:
        """Begin to count motion and its covariance from here."""
        self.settled = self.pose.copy()
        self._upper = np.zeros((3, 3))

    def _moved_on(self) -> bool:
        if not self._scans:
            return True
        last, config = self._scans[-1][0], self.config
        return (
            math.hypot(self.pose[0] - last[0], self.pose[1] - last[1]) >= config.spacing_m
            or math.cos(self.pose[2] - last[2]) <= math.cos(min(config.spacing_rad, math.pi))
        )

    def _keep(self, points: Array) -> None:
        self._scans.append((self.pose.copy(), points))
        seen = [transform_points(pose, ends) for pose, ends in self._scans]
        self._field = LikelihoodField.of_points(self.matching, np.vstack(seen))

    def _start_over(self, points: Array) -> None:
        """Nothing fits any more, the wheels alone were believed for a while: forget the old surroundings."""
        if len(points) >= self.config.fewest_points:
            self._scans.clear()
            self._keep(points)
