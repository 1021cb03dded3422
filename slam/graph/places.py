"""Places: where landmarks are few, the EKF family holds on to scans instead.

A place is a pose that the robot once had, with the surfaces that scans have shown from there and near by. In the
state it is two virtual points, ahead of that pose and behind it: correlated with robot and map like any landmark,
though no scan shows them. A later scan that is held against the surfaces tells where they are as seen from the
robot: EKF-SLAM whose landmarks are scans (Nieto, Bailey and Nebot, "Recursive scan-matching SLAM", Robotics and
Autonomous Systems 55, 2007). In a cave with a beam every three degrees there is little else to hold on to
(docs/reference/ekf.md, Places).
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import numpy as np

from slam.features.extraction import FeatureExtractor
from slam.geometry import about_z, compose, inverse, rotation, wrap, wrap_scalar
from slam.graph.matching import SurfaceMap, align, lasting, links
from slam.graph.patches import ModelError, Patch, new_patches
from slam.graph.surfaces import BeamEnds, beam_ends
from slam.landmarks.book import EDGE, FROM_MARK, KIND
from slam.landmarks.seen_from import sightings
from slam.types import VIRTUAL, Array, Flags, Indices, Scan

__all__ = ["Places"]

# Landmarks that hold the pose: two do, and one more, should two walls be parallel. In less than half the circle
# all are to one side, and what is wrong with them, as with bent walls, is too.
_HELD, _HELD_AHEAD = 3, 5
_SCANS = 5  # in a row with fewer; and between two that are held against a place: what lasts in a scan is used once
_LEVER_M = 3.0  # of a place's points: a heading known to 3 mrad weighs as much as a position known to 1 cm
_NEAR_M = 1.5  # a place is asked from so far; another one is made …
_SPACING_M, _AGAIN_M = 1.0, 0.4  # … so far from the nearest where that fits, and where it does not
_TURN_M = 1.0  # by which a turn [rad] counts as a distance for a lidar that looks in one direction only
_REACH_M, _ROUGH_M = 20.0, 0.005  # as graph-slam has them by default, and so …
_MODEL = ModelError(straight_m=0.0003, rough_m=0.01, ledge_m=0.1)  # … what surfaces leave out …
_LASTS_M, _LASTS_RAD, _STILL = 0.4, 0.5, 20.0  # … as far as it is the same, and how often it counts at most
_GATE_M = 0.3
_SHARE, _IN_SIGHT = 0.3, 0.8  # of beams that lie on the place's surfaces; of those that are near them, at least
_GROW_M, _GROW_RAD = 0.04, 0.02  # 1σ: a scan that fits less exactly adds nothing to a place
_LOOSE = np.array([0.5, 0.5, 0.2])  # 1σ: keeps an alignment along a single wall from running away …
_PRIOR = np.diag(_LOOSE**-2)
_NOTHING = 1e-4  # … and what a scan tells so little of it tells next to nothing of, as a share of that
_FEWEST_NEW = 5  # beams on surfaces that a place does not have


@dataclass(frozen=True)
class _Place:
    surfaces: SurfaceMap  # in the place's frame
    common_var: Array  # (patches,) [m²]: see slam.graph.patches.Patch


def _with_patches(old: _Place | None, patches: list[Patch], at: Array) -> _Place:
    """Return a place with more patches, which a scan shows from a pose ``(3,)`` in its frame; or a new one."""
    turn, first = rotation(float(at[2])).T, 0 if old is None else len(old.common_var)
    points = [patch.points @ turn + at[:2] for patch in patches]
    normals, reach = [patch.normals @ turn for patch in patches], [patch.reach for patch in patches]
    numbers = [np.full(len(patch.points), first + k) for k, patch in enumerate(patches)]
    common = np.array([patch.common_var for patch in patches])
    if old is not None:
        had = old.surfaces
        points, normals, reach = [had.points, *points], [had.normals, *normals], [had.reach, *reach]
        numbers, common = [had.patch, *numbers], np.append(old.common_var, common)
    surfaces = SurfaceMap(
        np.concatenate(points), np.concatenate(normals), np.concatenate(reach), np.concatenate(numbers)
    )
    return _Place(surfaces, common)


class Places:
    """The places of one robot, and when they are asked for."""

    def __init__(self, offset_m: float, sigma_m: float) -> None:
        """Begin with none; the sensor is so far ahead of the body's centre, its ranges have that 1σ [m]."""
        self._offset_m, self._sigma_m = offset_m, sigma_m
        self._places: dict[int, _Place] = {}  # by the id of the first of the two points
        self._few = 0
        self._view_rad = 2.0 * math.pi
        self._last = np.full(3, 1e6)  # where a scan was last held against a place

    def __deepcopy__(self, _: object) -> Places:
        """Return a copy with the same places: what one holds is replaced, not changed."""
        other = copy.copy(self)
        other._places = dict(self._places)
        return other

    @property
    def needed(self) -> bool:
        """Whether landmarks have been too few lately to hold the pose."""
        return self._few >= _SCANS

    def due(self, matched: int, scan: Scan) -> bool:
        """Count a scan that showed so many landmarks; tell whether it is to be held against a place."""
        self._view_rad = len(scan.ranges) * scan.angle_increment
        self._few = 0 if matched >= (_HELD if self._view_rad > math.pi else _HELD_AHEAD) else self._few + 1
        return self.needed and self._few % _SCANS == 0

    def ends(self, scan: Scan, extractor: FeatureExtractor) -> BeamEnds:
        """Return what the beams of the scan that ``extractor`` has just seen ended on."""
        return beam_ends(
            scan, extractor, offset_m=self._offset_m, reach_m=_REACH_M, sigma_m=self._sigma_m, rough_m=_ROUGH_M
        )

    def seen(
        self, x: Array, marks: Array, ids: Indices, ends: BeamEnds
    ) -> tuple[tuple[Array, Indices] | None, float]:
        """Return what a scan says of the nearest place, and how far that is away [m]: infinity without one.

        What it says is observation rows ``(2, 12)`` of the place's points, and which landmarks they are; None
        where it does not fit. ``x`` ``(3 + 2n,)`` is the state, ``marks`` ``(n, 14)`` and ``ids`` ``(n,)`` are the
        landmarks'.
        """
        match, away = self._near(x, marks, ids)
        if away >= _NEAR_M:
            return None, away
        number = int(marks[match[0], FROM_MARK])
        place, frame = self._places[number], _frame(x[3:].reshape(-1, 2)[match])
        start = compose(inverse(frame), x[:3])
        found = align(place.surfaces, ends, start, prior=start, prior_info=_PRIOR, gate_m=_GATE_M)
        if found.share < _SHARE or found.in_sight < _IN_SIGHT:
            return None, away
        common = self._lasting(x[:3]) * place.common_var
        told = links(place.surfaces, ends, found, np.zeros((len(common), 3)), common)
        step, cov = _told(told.gradient.sum(axis=0), told.info.sum(axis=0))
        at = found.pose + step
        if cov[0, 0] + cov[1, 1] < _GROW_M**2 and cov[2, 2] < _GROW_RAD**2:
            self._grow(number, ends, found.beside < 0, at)
        turn = about_z(float(frame[2]))
        fit, cov = compose(frame, at), turn @ cov @ turn.T
        return (sightings(x, marks, match, self._offset_m, fit, cov), match), away

    def wanted(self, away: float, *, fits: bool) -> bool:
        """Tell whether to make a place so far from the nearest one, which a scan has just fitted or not."""
        return away > (_SPACING_M if fits else _AGAIN_M)

    def make(self, number: int, ends: BeamEnds) -> Array:
        """Remember what a scan shows; return observation rows ``(2, 12)`` of the points that stand for the place.

        None where the scan shows no surface. ``number`` is the id that the first of the points will have. Along a
        single wall the place is where the robot believed to be: nothing is ever held against it there.
        """
        patches = new_patches(ends, np.ones(len(ends), np.bool_), _MODEL)
        if not patches:
            return np.zeros((0, 12))
        cov = np.linalg.inv(np.sum([patch.info for patch in patches], axis=0))
        self._places[number] = _with_patches(None, patches, np.zeros(3))
        return _rows_of(cov, number, self._offset_m)

    def beside(self, x: Array, marks: Array, ids: Indices) -> Indices:
        """Return the rows of the points of the place that the robot is at, if landmarks do not hold it."""
        match, away = self._near(x, marks, ids) if self.needed else (np.zeros(0, np.int64), math.inf)
        return match if away < _NEAR_M else match[:0]

    def _lasting(self, pose: Array) -> float:
        """Return what :func:`.matching.lasting` does of the way since a scan was last held against a place."""
        dx, dy, turn = (pose - self._last).tolist()
        self._last = pose.copy()
        return lasting(math.hypot(dx, dy), wrap_scalar(turn), key_m=_LASTS_M, key_rad=_LASTS_RAD, most=_STILL)

    def _near(self, x: Array, marks: Array, ids: Indices) -> tuple[Indices, float]:
        """Return the rows of the nearest place's points, ahead and behind, and how far it is [m]."""
        rows = np.flatnonzero(marks[:, 0] == VIRTUAL)
        rows = rows[np.argsort(ids[rows])]  # the point ahead has the lower one; rows may be in any order
        numbers = marks[rows, FROM_MARK]
        first = np.flatnonzero(numbers[1:] == numbers[:-1])  # of those whose two points are both in the region
        first = first[np.isin(numbers[first], list(self._places))]
        if not len(first):
            return np.zeros(0, np.int64), math.inf
        points = x[3:].reshape(-1, 2)
        ahead, behind = points[rows[first]], points[rows[first + 1]]
        away = np.hypot(*(0.5 * (ahead + behind) - x[:2]).T)
        dx, dy = (ahead - behind).T
        blind = max(0.0, 1.0 - self._view_rad / (2.0 * math.pi))
        away += _TURN_M * blind * np.abs(wrap(np.arctan2(dy, dx) - x[2]))
        k = int(np.argmin(away))
        return rows[first[k] : first[k] + 2], float(away[k])

    def _grow(self, number: int, ends: BeamEnds, new: Flags, at: Array) -> None:
        """Add to a place what these beams ``(n,)`` of a scan from ``at`` ``(3,)`` in its frame show besides."""
        if np.count_nonzero(new) >= _FEWEST_NEW and (patches := new_patches(ends, new, _MODEL)):
            self._places[number] = _with_patches(self._places[number], patches, at)


def _told(gradient: Array, info: Array) -> tuple[Array, Array]:
    """Return how far from its alignment ``(3,)`` a scan puts the robot, and to what covariance ``(3, 3)``.

    Where it tells less than the prior of the alignment does, that prior would decide on the step: nothing is told
    there, as along a corridor (Zhang, Kaess and Singh, "On degeneracy of optimization-based state estimation
    problems", ICRA 2016).
    """
    values, axes = np.linalg.eigh(_LOOSE[:, None] * info * _LOOSE)
    told = values >= 1.0
    axes = _LOOSE[:, None] * axes
    step = -axes @ np.where(told, axes.T @ gradient / np.where(told, values, 1.0), 0.0)
    return step, axes @ np.diag(1.0 / np.where(told, values, _NOTHING)) @ axes.T


def _rows_of(cov: Array, number: int, offset: float) -> Array:
    """Return observation rows of a new place's points, the place being known to ``cov`` in the robot's frame."""
    z = np.zeros((2, 12))
    z[:, KIND], z[:, EDGE] = VIRTUAL, number
    lever = max(_LEVER_M, 2.0 * abs(offset))  # the sensor is at neither of them
    for k, a in enumerate((lever, -lever)):
        rho = abs(a - offset)
        j = np.array([[1.0, 0.0, 0.0], [0.0, 1.0 / rho, a / rho]]) * math.copysign(1.0, a)
        r = 2.0 * j @ cov @ j.T
        z[k, :5] = rho, 0.0 if a > 0.0 else math.pi, r[0, 0], r[0, 1], r[1, 1]
    return z


def _frame(points: Array) -> Array:
    """Return the pose ``(3,)`` that the points ahead and behind ``(2, 2)`` stand for."""
    x, y = (0.5 * (points[0] + points[1])).tolist()
    dx, dy = (points[0] - points[1]).tolist()
    return np.array([x, y, math.atan2(dy, dx)])
