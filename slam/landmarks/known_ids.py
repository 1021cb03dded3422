"""Landmarks that are told apart by a label: what a filter's gate refused, and what it means where it agrees.

A label is misread now and then, so that association which is known is not association that is true. A gate refuses
what lies too far from where it is expected (:func:`slam.landmarks.association.refuse_unlikely`). One such sighting
says nothing more. Several that agree do, and a gate that went on refusing them would never let the truth in again:

- Nearly all is refused for a while, and three landmarks or more agree on one pose other than the believed one.
  Then the robot is elsewhere (its wheels spun, it was pushed).
- Most sightings of one landmark agree on a place, and are more than those that were ever believed, while others
  are where they should be. Then the place was wrong, for it was put there by a misread label. One that was never
  seen again where it was put says nothing of others, so that nothing is lost by putting it elsewhere.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from slam.geometry import compose, inverse, transform_points
from slam.landmarks.association import IGNORED, UNMATCHED
from slam.metrics.measures import align_se2
from slam.types import Array, Flags, Indices

__all__ = ["Elsewhere", "KnownIds"]

_LATELY = 24  # sightings that are looked back upon
_LONGEST_WAY_M = 1.0  # of the robot since a sighting that still counts: odometry alone relates the two
_FEWEST = 3  # two landmarks that agree on a pose need only be as far apart as they should be
_HELD_BY_CHANCE = 0.15  # of the sightings from a pose that is wrong
_SLACK_M = 0.1  # of a place, beyond two standard deviations of the sighting …
_WIDEST_M = 0.4  # … and altogether
_DRIFT = 0.05  # of odometry over the way between two sightings, and of the turn


class _Sighting(NamedTuple):
    landmark: int
    row: Array  # (12,) the observation: see slam.landmark_backend.observation_rows
    pose: Array  # (3,) believed then
    held: bool  # whether the gate let it through
    believed: int  # how often the gate had let the landmark through before


class _Refusal(NamedTuple):
    place: Array  # (2,) where the landmark would be
    slack: float  # [m]
    number: int  # of refusals since the landmark was last believed, this one included


class Elsewhere(NamedTuple):
    """A pose at which the landmarks lately refused would be where they are."""

    pose: Array  # (3,)
    ids: list[int]
    rows: Array  # (m, 12) their observations as they would be made now


class KnownIds:
    """What was lately seen of landmarks with labels, and how often each was believed."""

    def __init__(self, offset: float) -> None:
        self._offset = offset
        self._lately: deque[_Sighting] = deque(maxlen=_LATELY)
        self._held: dict[int, int] = {}
        self._refused: dict[int, deque[_Refusal]] = {}  # of each landmark, since it was last believed

    def note(self, ids: Sequence[int], z: Array, match: Indices, pose: Array) -> None:
        """Take note of observations ``(m, 12)`` from a pose ``(3,)``, and of those that were refused."""
        for k, landmark in enumerate(ids):
            if match[k] == UNMATCHED:
                continue  # new: not believed before it is seen again
            held = match[k] != IGNORED
            self._lately.append(_Sighting(landmark, z[k].copy(), pose, held, self._held.get(landmark, 0)))
            if held:
                self._held[landmark] = self._held.get(landmark, 0) + 1
                self._refused.pop(landmark, None)
            else:
                place = transform_points(pose, self._point(z[k])[None])[0]
                refused = self._refused.setdefault(landmark, deque(maxlen=_LATELY))
                refused.append(_Refusal(place, _slack(z[k]), refused[-1].number + 1 if refused else 1))

    def misplaced(self) -> list[int]:
        """Return the landmarks whose place is wrong, and forget what was known of them."""
        found = []
        for landmark, refused in self._refused.items():
            held, count = self._held.get(landmark, 0), refused[-1].number
            if count <= held:
                continue
            places = np.array([r.place for r in refused])
            off = np.hypot(*(places - np.median(places, axis=0)).T)
            agree = int(np.count_nonzero(off < [r.slack for r in refused]))
            strays = len(refused) - agree  # labels that were misread in between
            if agree > strays and count - strays > held and (held == 0 or self._others_hold(landmark, count)):
                found.append(landmark)
        for landmark in found:
            self._held.pop(landmark, None)
            del self._refused[landmark]
        if found:
            self._lately = deque((s for s in self._lately if s.landmark not in found), maxlen=_LATELY)
        return found

    def elsewhere(self, pose: Array, place_of: Callable[[int], Array | None]) -> Elsewhere | None:
        """Return where the robot is if not at ``pose`` ``(3,)``; ``None`` where there is no reason to ask.

        ``place_of`` returns a landmark's place ``(2,)`` in the map, or ``None``.
        """
        seen = [s for s in self._doubted_twice() if math.hypot(*(s.pose - pose)[:2]) < _LONGEST_WAY_M]
        places = [place_of(s.landmark) for s in seen]
        pairs = [(s, p) for s, p in zip(seen, places, strict=True) if p is not None]
        if len(pairs) < _FEWEST:
            return None
        motions = [compose(inverse(pose), s.pose) for s, _ in pairs]
        points = np.array([
            transform_points(m, self._point(s.row)[None])[0] for m, (s, _) in zip(motions, pairs, strict=True)
        ])  # fmt: skip
        slack = np.array([_slack(s.row) for s, _ in pairs])
        other, agree = _best_pose(points, np.array([p for _, p in pairs]), slack)
        if np.count_nonzero(agree) < max(_FEWEST, len(pairs) - 1):
            return None
        taken = np.flatnonzero(agree).tolist()
        rows = np.array([self._row(points[k], pairs[k][0].row, motions[k]) for k in taken])
        return Elsewhere(other, [pairs[k][0].landmark for k in taken], rows)

    def forget(self) -> None:
        """Begin anew, as after the robot was found elsewhere: what was refused was refused from a wrong pose."""
        self._lately.clear()
        self._refused.clear()

    def _others_hold(self, landmark: int, refused: int) -> bool:
        """Tell whether other landmarks were where they should be since this one was refused so many times."""
        lately, begin = list(self._lately), 0
        for k in range(len(lately) - 1, -1, -1):
            refused -= lately[k].landmark == landmark
            if refused == 0:
                begin = k
                break
        others = [s.held for s in _of_old_ones(lately[begin:]) if s.landmark != landmark]
        return 2 * sum(others) > len(others)

    def _doubted_twice(self) -> list[_Sighting]:
        """Return the last sighting of each landmark that was refused twice and not believed since nearly all were.

        Of misread labels few are in a row and few are the same, and others in between are where they should be.
        """
        lately = list(self._lately)
        doubted: list[_Sighting] = []
        for begin in range(len(lately)):
            seen = _of_old_ones(lately[begin:])
            if sum(s.held for s in seen) > _HELD_BY_CHANCE * len(seen):
                continue
            of: dict[int, list[_Sighting]] = {}
            for s in seen:
                of.setdefault(s.landmark, []).append(s)
            doubted = [all_[-1] for all_ in of.values() if len(all_) > 1 and not any(s.held for s in all_)]
            break
        return doubted

    def _point(self, row: Array) -> Array:
        """Return where an observation was ``(2,)`` in the body frame."""
        return np.array([self._offset + row[0] * math.cos(row[1]), row[0] * math.sin(row[1])])

    def _row(self, point: Array, row: Array, motion: Array) -> Array:
        """Return an observation as it would be made now of ``point`` ``(2,)`` in the body frame."""
        out = row.copy()
        ahead = point - [self._offset, 0.0]
        out[0], out[1] = math.hypot(*ahead), math.atan2(ahead[1], ahead[0])
        drift = _DRIFT * math.hypot(*motion[:2])
        out[2] += drift**2
        out[4] += (drift / max(float(out[0]), 1e-3)) ** 2 + (_DRIFT * float(motion[2])) ** 2
        return out


def _of_old_ones(sightings: list[_Sighting]) -> list[_Sighting]:
    """Return those of landmarks that were well known before: new ones are where a wrong pose has put them."""
    at_first: dict[int, int] = {}
    for s in sightings:
        at_first.setdefault(s.landmark, s.believed)
    return [s for s in sightings if at_first[s.landmark] >= _FEWEST]


def _slack(row: Array) -> float:
    """Return how far off [m] a sighting's place may be."""
    return float(min(_SLACK_M + 2.0 * math.sqrt(row[2] + row[0] ** 2 * row[4]), _WIDEST_M))


def _best_pose(points: Array, places: Array, slack: Array) -> tuple[Array, Flags]:
    """Return the pose on which most agree, fitted to those, and who they are ``(n,)``; tried pair by pair."""
    best, most = np.zeros(len(points), bool), 0
    for i in range(len(points)):
        for j in range(i):
            pair = align_se2(places[[i, j]], points[[i, j]])
            agree = np.hypot(*(transform_points(pair, points) - places).T) < slack
            if np.count_nonzero(agree) > most:
                best, most = agree, int(np.count_nonzero(agree))
    if not most:
        return np.zeros(3), best
    pose = align_se2(places[best], points[best])
    return pose, best & (np.hypot(*(transform_points(pose, points) - places).T) < slack)
