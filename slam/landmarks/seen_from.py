"""What a scan that was matched against the drawn map says of landmarks, whether it shows them or not.

The map is drawn from the estimates. So the place where a scan fits it best is no pose in the world, but one among
the landmarks around: it says where from there each of them is (Nieto, Bailey and Nebot, "Recursive scan-matching
SLAM", Robotics and Autonomous Systems 55, 2007, keep the drawing itself as the landmark). What is off with the
place is off with all of them at once. Each sighting gets the place's covariance as many times as there are
sightings: together they say no more than the match did, however they are correlated.
"""

from __future__ import annotations

import math

import numpy as np

from slam.geometry import wrap_scalar
from slam.landmarks.association import predicted
from slam.landmarks.book import KIND, LAST_SEEN
from slam.types import VIRTUAL, Array, Indices

__all__ = ["seen_from", "sightings"]

_SIGHTINGS = 3  # two points or walls say where the robot is; one more, should two walls be parallel


def seen_from(
    x: Array, marks: Array, offset: float, pose: Array, cov: Array, *, since: float = -math.inf
) -> tuple[Array, Indices]:
    """Return observation rows ``(k, 12)`` of the landmarks seen last, and which they are ``(k,)``; of one none.

    Parameters
    ----------
    x, marks
        The state ``(3 + 2n,)``, and the landmarks' marks ``(n, 14)``: :class:`slam.landmarks.book.LandmarkBook`.
    offset
        The sensor's, ahead of the robot's centre [m].
    pose, cov
        Where a scan fits the map that is drawn of these landmarks ``(3,)``, and its covariance there ``(3, 3)``.
    since
        The update, of those counted by the marks, that the landmarks were seen at or later.
    """
    real = np.flatnonzero((marks[:, 0] != VIRTUAL) & (marks[:, LAST_SEEN] >= since))
    match = real[np.argsort(-marks[real, LAST_SEEN], kind="stable")[:_SIGHTINGS]]
    if len(match) == 1:  # which may be the newest, that was not there when the map was drawn
        match = match[:0]
    return sightings(x, marks, match, offset, pose, cov), match


def sightings(x: Array, marks: Array, match: Indices, offset: float, pose: Array, cov: Array) -> Array:
    """Return observation rows ``(k, 12)`` of landmarks ``(k,)`` as they are seen from a pose known to ``cov``.

    The other arguments are those of :func:`seen_from`. All err with the one pose. They are linear in its
    difference from the believed pose, as the correction is: it may be known to a millimetre across a wall and to
    half a metre along it, and the one must not be taken for the other.
    """
    z, h, away = np.zeros((len(match), 12)), np.zeros((2, 5)), pose - x[:3]
    away[2] = wrap_scalar(float(away[2]))
    for k, row in enumerate(match.tolist()):
        z[k, KIND] = marks[row, 0]
        z[k, :2] = np.array(predicted(x, row, z[k, KIND], offset, h)) + h[:, :3] @ away
        r = len(match) * h[:, :3] @ cov @ h[:, :3].T
        z[k, 2:5] = r[0, 0], r[0, 1], r[1, 1]
    return z
