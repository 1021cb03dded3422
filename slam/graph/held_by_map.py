"""Gaussian filters held by the drawn map: pose in doubt, places without landmarks, and lost and found again."""

from __future__ import annotations

import abc
import math

import numpy as np

from slam.backend import found_cov
from slam.gaussian import joint_gaussian as joint
from slam.gaussian.beliefs import GaussianBackend
from slam.gaussian.companions import Companions
from slam.gaussian.settings import EkfConfig
from slam.gaussian.stacked_update import NO_LIMITS
from slam.graph.places import Places
from slam.health.relocalisation import Place, Relocaliser
from slam.landmarks.joint_compatibility import JOINT_LIMITS
from slam.landmarks.seen_from import seen_from, sightings
from slam.types import Array, Indices, Scan

__all__ = ["HeldByMap"]

_LATELY = 30  # scans since a landmark was seen that the drawn map is held against


class HeldByMap(GaussianBackend):
    """What a filter does where a scan, held against the drawn map, says more than its features do."""

    config: EkfConfig
    nis: float
    nis_dof: int
    _places: Places
    _beside: Companions
    _held: tuple[Array, Array, Array, Array, Indices] | None
    """Of a robot that was given up, when scans agreed last: pose, covariance, and that with the states beside."""

    @abc.abstractmethod
    def _correct(self, z: Array, match: Indices, limits: Array = NO_LIMITS) -> None: ...

    @abc.abstractmethod
    def _add(self, z: Array, known_id: int | None) -> None: ...

    def _hold_by_map(self, scan: Scan) -> None:
        """Correct by where beside the believed pose a scan fits the drawn map, where landmarks do not hold it."""
        recovery = self.recovery
        if self._doubtful:  # the pose is wrong if the scan contradicts the map from there, and from beside not
            if recovery.opposed(self.grid, self._x[:3], scan):
                place = self._place_beside(scan)
                if not recovery.opposed(self.grid, place.pose, scan):
                    self._correct_by_map(place, JOINT_LIMITS, within=_LATELY)
        elif self.config.lines and self._places.due(self.nis_dof // 2, scan) and not self._spinning.touching:
            self._hold_by_place(scan)

    def _hold_by_place(self, scan: Scan) -> None:
        """Correct by the nearest place, if the scan fits it; where none is near, remember this one."""
        x, book, places = self._x[: self._n], self._book, self._places
        ends = places.ends(scan, self.extractor)
        seen, away = places.seen(x, book.marks, book.ids, ends)
        fits = seen is not None and self._correct_aside(*seen, JOINT_LIMITS)
        if places.wanted(away, fits=fits):
            for z in places.make(book.next_id, ends):
                self._add(z, None)

    def _carry_on(self, pose: Array, pose_cov: Array) -> None:
        """Go on from what was copied, at the pose ``(3,)`` that the wheels have reached by now."""
        before, cov = self.pose, self.pose_cov
        jump, back = joint.jump_jacobian(before, pose), joint.jump_jacobian(pose, before)
        grown, axes = np.linalg.eigh(pose_cov - jump @ cov @ jump.T)
        self._place(pose, (axes * np.maximum(grown, 1e-8)) @ axes.T)
        shared = back @ self._p[:3, 3 : self._n]  # with the landmarks
        self._held = before, cov, self._beside.cross[:, :3] @ back.T, shared, self._book.ids.copy()

    def _find(self, pose: Array, pose_cov: Array) -> None:
        """Go on from a pose ``(3,)`` on the map, as though it were carried there from where it was lost.

        So what it shares with the map is that of then, and what the wheels have claimed since is forgotten.
        """
        if self._held is not None and np.array_equal(self._held[-1], self._book.ids):
            before, cov, cross, shared, _ = self._held
            jump = joint.jump_jacobian(before, self._x)
            self._p[:3, :3] = np.triu(jump @ cov @ jump.T)
            # Wheels whose lasting errors landmarks tell of share more and more with them while they are believed.
            self._p[:3, 3 : self._n] = jump @ shared
            self._beside.cross[:, :3] = cross @ jump.T
        self._place(pose, pose_cov)

    def _places_beside(self) -> Indices:
        return self._places.beside(self._x[: self._n], self._book.marks, self._book.ids)

    def _place_beside(self, scan: Scan) -> Place:
        """Return where beside the believed pose a scan fits the drawn map best."""
        c = self.config
        return Relocaliser(c.relocalisation, self.grid, c.lidar_offset_m).check(scan, self._x[:3].copy())

    def _correct_by_map(self, place: Place, limits: Array, within: float = math.inf) -> None:
        """Correct by a place on the drawn map, which is one among the landmarks; they are not counted as seen.

        It is one among those seen within so many scans: what is drawn since others were has drifted with the pose.
        Where there are none, what is drawn hangs on the place that the robot is at.
        """
        x, marks, offset, cov = self._x, self._book.marks, self.config.lidar_offset_m, place.cov + found_cov()
        z, match = seen_from(x, marks, offset, place.pose, cov, since=self._book.now - within)
        if not len(match):
            match = self._places_beside()
            z = sightings(x, marks, match, offset, place.pose, cov)
        self._correct_aside(z, match, limits)

    def _correct_aside(self, z: Array, match: Indices, limits: Array) -> bool:
        """Correct by what no feature of the scan shows, nor counts to its NIS; tell whether it stands."""
        kept = self.nis, self.nis_dof
        self._correct(z, match, limits)
        stands = self.nis_dof > 0
        self.nis, self.nis_dof = kept
        return stands
