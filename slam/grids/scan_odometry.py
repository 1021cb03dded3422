"""Odometry made nearly exact by scans: each is matched to the few before it (Hähnel et al. 2003).

What is left to the particles is the slow drift of this local motion. The local map is the key scans of the last
metres, in a frame of its own, so a loop that a particle closes never tears it.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from slam.geometry import symmetric, transform_points
from slam.grids.flat_walls import along_walls
from slam.grids.scan_matching import LikelihoodField, Match, MatchConfig, match, refine
from slam.motion import OdometryNoise, predict_robot
from slam.settings import Config, Count, Few, Gap, NotNegative, Positive, Share
from slam.types import Array, Odometry

__all__ = ["ScanOdometry", "ScanOdometryConfig"]


@dataclass(frozen=True, kw_only=True)
class ScanOdometryConfig(Config):
    """The local map, and when a match to it is believed."""

    scans: Few = 10  # key scans in the local map
    spacing_m: Gap = 0.25  # a scan becomes a key scan when the robot has moved or turned so far
    spacing_rad: Gap = 0.25
    fewest_points: Count = 20  # a scan with fewer ends is not matched …
    least_score: Share = 0.3  # … and a match with a lower mean field value is not believed
    # Odometry known to less than this is searched over the window of ``MatchConfig``, else only refined.
    search_sigma_m: NotNegative = 0.03
    search_sigma_rad: NotNegative = 0.015
    # Wheels that spin in vain are in no odometry noise. Where a motion of anything from none to twice what they
    # claim fits better by this (twice the log-likelihood; 99 % of chi-square with 3 degrees of freedom), they did.
    spin_gate: Positive = 11.34


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
        self._body = (0.0, 0.0, 0.0)  # twist that the floor has passed on
        self._claimed = (0.0, 0.0)  # [m, rad] by the wheels since a scan was last believed
        self.settled = np.zeros(3)  # the pose at the last :meth:`settle`

    @property
    def cov(self) -> Array:
        """Covariance ``(3, 3)`` of the motion since :meth:`settle`."""
        return symmetric(self._upper)

    def predict(self, odometry: Odometry) -> None:
        """Move on by what the wheels measured."""
        (vx, vy, omega), var_v, var_w, self._body = self.noise.of_step(odometry, self._body)
        dt = odometry.dt
        predict_robot(self.pose, self._upper, 3, vx, vy, omega, dt, var_v, var_w)
        way, turn = self._claimed
        self._claimed = (way + math.hypot(vx, vy) * dt, turn + abs(omega) * dt)

    def correct(self, points: Array) -> bool:
        """Match a scan's ends ``(n, 2)`` [m, body frame] to the local map; tell whether that was believed."""
        config = self.config
        believed = False
        matched, drawn = along_walls(points, self.matching)
        if self._field is not None and len(points) >= config.fewest_points:
            found = self._match(self._field, matched)
            believed = found.score >= config.least_score
            if believed:
                self.pose, self._upper = found.pose.copy(), found.cov
                self._claimed = (0.0, 0.0)
        if len(points) >= config.fewest_points and (believed or not self._scans) and self._moved_on():
            self._keep(drawn)
        elif not believed and self._moved_on() and len(points) >= config.fewest_points:
            self._scans.clear()  # nothing fits any more, the wheels alone were believed for a while
            self._keep(drawn)
        return believed

    def _match(self, field: LikelihoodField, points: Array) -> Match:
        """Match to the local map by what the wheels say, or by what they could have said where they spun."""
        config, (way, turn) = self.config, self._claimed
        cov = self.cov + np.eye(3) * 1e-8
        info = np.asarray(np.linalg.inv(cov), np.float64)
        if max(cov[0, 0], cov[1, 1]) > config.search_sigma_m**2 or cov[2, 2] > config.search_sigma_rad**2:
            found = match(field, points, self.pose, self.matching, prior_info=info)
        else:
            found = refine(field, points, self.pose, self.matching, prior=self.pose, prior_info=info)
        if way == turn == 0.0:
            return found
        spun = np.linalg.inv(cov + np.diag(np.square([way, way, max(turn, way / self.noise.lever_m)])))
        other = refine(field, points, found.pose, self.matching, prior=self.pose, prior_info=spun)
        better = 2.0 * (other.log_likelihood - found.log_likelihood) > config.spin_gate
        return other if better else found

    def settle(self) -> None:
        """Begin to count motion and its covariance from here."""
        self.settled = self.pose.copy()
        self._upper = np.zeros((3, 3))

    def forget(self) -> None:
        """Begin with new surroundings, and count motion from here."""
        self._scans.clear()
        self._field, self._claimed = None, (0.0, 0.0)
        self.settle()

    def _moved_on(self) -> bool:
        if not self._scans:
            return True
        last, config = self._scans[-1][0], self.config
        return math.hypot(self.pose[0] - last[0], self.pose[1] - last[1]) >= config.spacing_m or math.cos(
            self.pose[2] - last[2]
        ) <= math.cos(min(config.spacing_rad, math.pi))

    def _keep(self, surfaces: Array) -> None:
        self._scans.append((self.pose.copy(), surfaces))
        seen = [transform_points(pose, ends) for pose, ends in self._scans]
        self._field = LikelihoodField(self.matching, np.vstack(seen))
