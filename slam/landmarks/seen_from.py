"""What a scan that was matched against the drawn map says of landmarks, whether it shows them or not.

The map is drawn from the estimates. So the place where a scan fits it best is no pose in the world, but one among
the landmarks around: it says where from there each of them is (Nieto, Bailey and Nebot, "Recursive scan-matching
SLAM", Robotics and Autonomous Systems 55, 2007, keep the drawing itself as the landmark). What is off with the
place is off with all of them at once. Each sighting gets the place's covariance as many times as there are
sightings: together they say no more than the match did, however they are correlated.

Where landmarks are few, in a cave with a beam every three degrees, such a scan now and then holds the pose
(:class:`Loose`).
"""

from __future__ import annotations

import numpy as np

from slam.landmarks.association import predicted
from slam.landmarks.book import KIND, LAST_SEEN
from slam.types import Array, Indices, Scan

__all__ = ["LEAST_NAT", "Loose", "seen_from"]

LEAST_NAT = 0.03
"""What a match where :class:`Loose` says so must tell of the landmarks: where it is less, its bias weighs more."""

_SIGHTINGS = 3  # two points or walls say where the robot is; one more, should two walls be parallel
_SCANS = 10  # in a row with fewer landmarks than that: the next is matched; what lasts of a drawing is used once
_FRESH = 20  # scans ago: what is drawn around was drawn of landmarks seen since, not by the wheels alone
_RETURNS = 0.8  # share of the beams; in halls few return, and a match says how far along a wall where it cannot


class Loose:
    """Counts the scans that showed too few landmarks to hold the pose."""

    def __init__(self) -> None:
        self._scans = 0

    def held(self) -> None:
        """Note that something else says where the robot is, or nothing can."""
        self._scans = 0

    def due(self, matched: int, scan: Scan, last_seen: Array, now: float) -> bool:
        """Tell whether to match this scan, which showed so many landmarks, against the map.

        ``last_seen`` ``(n,)`` and ``now`` are the landmark book's, in scans.
        """
        self._scans = 0 if matched >= _SIGHTINGS else self._scans + 1
        if self._scans < _SCANS:
            return False
        self._scans = 0
        return bool(
            np.count_nonzero(last_seen >= now - _FRESH) >= _SIGHTINGS - 1
            and np.count_nonzero(scan.ranges <= scan.range_max) >= _RETURNS * len(scan.ranges)
        )


def seen_from(x: Array, marks: Array, offset: float, pose: Array, cov: Array) -> tuple[Array, Indices]:
    """Return observation rows ``(k, 12)`` of the landmarks seen last, and which they are ``(k,)``.

    Parameters
    ----------
    x, marks
        The state ``(3 + 2n,)``, and the landmarks' marks ``(n, 11)``: :class:`slam.landmarks.book.LandmarkBook`.
    offset
        The sensor's, ahead of the robot's centre [m].
    pose, cov
        Where a scan fits the map that is drawn of these landmarks ``(3,)``, and its covariance there ``(3, 3)``.
    """
    match = np.argsort(-marks[:, LAST_SEEN], kind="stable")[:_SIGHTINGS]
    z, h, there = np.zeros((len(match), 12)), np.zeros((2, 5)), x.copy()
    there[:3] = pose
    for k, row in enumerate(match.tolist()):
        z[k, KIND] = marks[row, 0]
        z[k, :2] = predicted(there, row, z[k, KIND], offset, h)
        r = len(match) * h[:, :3] @ cov @ h[:, :3].T
        z[k, 2:5] = r[0, 0], r[0, 1], r[1, 1]
    return z, match
