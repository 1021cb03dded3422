"""What backends with landmarks share: what the wheels claim, observations as rows, the book of landmarks."""

from __future__ import annotations

import abc
import math
from collections.abc import Sequence

import numpy as np

from slam.backend import Backend
from slam.files import quoted
from slam.landmarks.book import LandmarkBook, LandmarkPolicy
from slam.landmarks.known_ids import KnownIds
from slam.landmarks.spinning_wheels import SpinningWheels, touches
from slam.motion import OdometryNoise, Twist
from slam.types import LINE, VIRTUAL, Array, Indices, Observations, Odometry, Scan

__all__ = ["LARGEST_ID", "LandmarkBackend", "observation_rows"]

LARGEST_ID = 1_000_000
"""Of a landmark, where whoever observes it says which it is."""


class LandmarkBackend(Backend):
    """A backend that keeps a book of landmarks."""

    relocalises = True

    def _begin(self, policy: LandmarkPolicy) -> None:
        self._book = LandmarkBook(policy)
        self._known = KnownIds(self.config.lidar_offset_m)
        self._body = (0.0, 0.0, 0.0)  # twist that the floor has passed on
        self._spinning = SpinningWheels()

    def _measured(self, odometry: Odometry, noise: OdometryNoise) -> tuple[Twist, float, float]:
        """Count a step by the wheels; return its twist and V's variances of speed and turn rate."""
        twist, var_v, var_w, self._body = noise.of_step(odometry, self._body)
        way = math.hypot(twist[0], twist[1], noise.lever_m * twist[2]) * odometry.dt
        self._spinning.claim(way, way / noise.lever_m)
        return twist, var_v, var_w

    def _may_spin(self, scan: Scan, match: Indices, recent: int, still: int) -> bool:
        """Tell whether the wheels may have turned in vain; see :meth:`SpinningWheels.suspected`."""
        spinning, c = self._spinning, self.config
        if not spinning.suspected(self.grid, self.sensor_pose, scan, recent, still, match):
            return False
        sigma_m = c.features.range_sigma_m
        spinning.touching = touches(scan, c.lidar_offset_m, c.body_length_m, c.body_width_m, sigma_m)
        return True

    # ---- landmarks with labels -----------------------------------------------------------------------------

    @property
    def label_ids(self) -> dict[int, int]:
        """The ids that landmarks with labels have, by label: the same, but where another has that number."""
        return dict(self._book.label_ids)

    def _ids_told(self, observations: Observations) -> list[int] | None:
        """Return the ids of what was observed, where the association is known."""
        labels = observations.ids
        return None if labels is None else self._book.of_labels(np.asarray(labels).tolist())

    def _rows(self, ids: Sequence[int]) -> Indices:
        """Return the book's row of each landmark ``(m,)``, or -1."""
        return np.array([self._book.row(i) for i in ids], np.int64)

    def _place_of(self, landmark: int) -> Array | None:
        row = self._book.row(landmark)
        return None if row < 0 else self._points[row]

    def _drop_misplaced(self) -> None:
        """Take out landmarks that a misread label put where they are not: they are new at their next sighting."""
        for landmark in self._known.misplaced():
            if (row := self._book.row(landmark)) >= 0:
                self._drop(row)

    @abc.abstractmethod
    def _drop(self, row: int) -> None:
        """Take a landmark out of the map and the book."""

    @property
    @abc.abstractmethod
    def _points(self) -> Array:
        """Estimates ``(n, 2)`` of the book's landmarks: x, y, of walls α, r."""

    @property
    def _marks(self) -> Array:
        """Marks ``(n, 14)`` of every landmark, see :class:`slam.landmarks.book.LandmarkBook`."""
        return self._book.marks

    @property
    def landmark_count(self) -> int:
        """Number of confirmed landmarks, walls included."""
        return int(np.count_nonzero(self._marks[:, 0] != VIRTUAL))

    def landmark_details(self) -> tuple[Indices, Array]:
        """Return per point landmark how often it was seen and its direction in the belief's frame [rad]."""
        marks = self._marks
        marks = marks[marks[:, 0] < LINE]
        return marks[:, 2].astype(np.int64), np.where(marks[:, 0] == 0, np.nan, marks[:, 1])

    def _keep(self, sensor_pose: Array, scan: Scan) -> None:
        rows, ids, marks = self._book.just_seen(self._points)
        beside = self._places_beside()
        if len(beside):
            rows, ids = np.append(rows, beside), np.append(ids, self._book.ids[beside])
            marks = np.vstack([marks, np.column_stack([self._points[beside], np.zeros(len(beside))])])
        self.key_scans.keep(
            sensor_pose, scan, self.extractor.surface, ids, marks, self._cov_with(rows), *self._map_points(),
            ahead_m=self.config.lidar_offset_m, variance=self._end_variance(),
        )  # fmt: skip

    def _places_beside(self) -> Indices:
        """Return the book's rows of virtual points that tell of this pose, where landmarks do not."""
        return np.zeros(0, np.int64)

    @abc.abstractmethod
    def _cov_with(self, rows: Indices) -> Array:
        """Return the covariance ``(3 + 2k, 3 + 2k)`` of the pose and some of the book's landmarks."""

    def _map_points(self) -> tuple[Array, Indices]:
        """Return every landmark's estimate ``(n, 2)``, and which row an id has."""
        return self._points, self._book.row_of_id

    def _redraw_if_moved(self) -> bool:
        return self.key_scans.redraw_if_moved(self.grid, *self._map_points())


def observation_rows(observations: Observations) -> Array:
    """Return landmark observations as rows ``(m, 12)`` like the feature extractor's, of unknown kind.

    Raises ``ValueError``, before anything has changed, where they are none: see
    :class:`slam.types.Observations`.
    """
    rb = np.asarray(observations.range_bearing, dtype=np.float64)
    cov = np.asarray(observations.cov, dtype=np.float64)
    m = len(rb) if rb.size else 0
    if rb.size + cov.size and (rb.shape, cov.shape) != ((m, 2), (m, 2, 2)):
        raise ValueError(
            f"observations need range_bearing (m, 2) and cov (m, 2, 2), got {rb.shape} and {cov.shape}"
        )
    rb, cov = rb.reshape(m, 2), cov.reshape(m, 2, 2)
    if not (np.all(np.isfinite(rb)) and np.all(np.isfinite(cov))):
        raise ValueError("range_bearing and cov of observations must be finite")
    if np.any(cov[:, 0, 0] <= 0.0) or np.any(cov[:, 0, 0] * cov[:, 1, 1] <= cov[:, 0, 1] ** 2):
        raise ValueError("covariances of observations must be positive definite; what is not known is large")
    if observations.ids is not None:
        ids = np.asarray(observations.ids)
        if ids.shape != (len(rb),) or (len(ids) and ids.dtype.kind not in "iu"):
            raise ValueError(f"ids of {len(rb)} observations must be as many whole numbers, got {quoted(ids)}")
        if len(ids) and not 0 <= ids.min() <= ids.max() <= LARGEST_ID:
            raise ValueError(f"ids of observations must be in [0, {LARGEST_ID}], got {ids.min()} to {ids.max()}")
    z = np.zeros((len(rb), 12))
    z[:, :2], z[:, 2], z[:, 3], z[:, 4] = rb, cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    return z
