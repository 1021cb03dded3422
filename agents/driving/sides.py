"""What parts a robot from others nearby: each keeps to its own half of the way between them.

A robot that brakes for another as though that stood still is hit by it where both drive. Both cannot know what the
other is about to do; but each can see to it that it comes to a stand on its own side of the line halfway between
them, and then they do not touch, whatever each does. Zhou, Wang, Bandyopadhyay and Schwager, "Fast, on-line
collision avoidance for dynamic vehicles using buffered Voronoi cells", IEEE RA-L 2017: such lines bound the cell;
here the body is a rectangle that brakes (:func:`agents.driving.safety.safe_twist`).
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from agents.driving.safety import LocalMap
from slam.belief import Belief

__all__ = ["parting_lines"]

Array = NDArray[np.float64]

_NONE = np.zeros((0, 3))
_OLD_S = 1.5  # what is older says no longer where a robot is
_ROUND_M = 0.6  # how far round a corner two robots may be in each other's way


def parting_lines(belief: Belief, near: LocalMap, *, gap_m: float, speed_m_s: float) -> Array:
    """Return the lines ``(k, 3)`` that the robot's body must not cross, as rows nx, ny, d: n·p ≤ d.

    In the body frame [m]; one for each robot that is on the map nearby and that no wall keeps away. ``gap_m`` is what
    the body keeps from it, ``speed_m_s`` what another may have driven since it was where it is believed to be.
    """
    if not belief.teammates:
        return _NONE
    x, y, heading = (float(v) for v in belief.pose)
    c, s = math.cos(heading), math.sin(heading)
    rows, cols = near.clearance.shape
    reach = 0.5 * max(rows, cols) * near.resolution + 0.5
    lines = []
    for mate in belief.teammates:
        dx, dy = float(mate.pose[0]) - x, float(mate.pose[1]) - y
        apart = math.hypot(dx, dy)
        if not 1e-6 < apart < reach or mate.age_s > _OLD_S or _walled_off(near, (x, y), (x + dx, y + dy)):
            continue
        half = 0.5 * (apart - speed_m_s * mate.age_s) - gap_m
        lines.append(((c * dx + s * dy) / apart, (c * dy - s * dx) / apart, half))
    return np.array(lines) if lines else _NONE


def _walled_off(near: LocalMap, a: tuple[float, float], b: tuple[float, float]) -> bool:
    """Tell whether walls stand between two places, so that there is no way round them that is not a long one."""
    rows, cols = near.clearance.shape
    middle = 0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1])
    reach = 0.5 * math.hypot(b[0] - a[0], b[1] - a[1]) + _ROUND_M

    def cell(value: float, axis: int) -> int:
        return math.floor((value - float(near.origin[axis])) / near.resolution)

    low_r, high_r = max(cell(middle[1] - reach, 1), 0), min(cell(middle[1] + reach, 1) + 1, rows)
    low_c, high_c = max(cell(middle[0] - reach, 0), 0), min(cell(middle[0] + reach, 0) + 1, cols)
    ends = [(cell(p[1], 1), cell(p[0], 0)) for p in (a, b)]
    if not all(low_r <= r < high_r and low_c <= c < high_c for r, c in ends):
        return False  # beyond the map that is looked at: nothing is known to be between
    free = (near.clearance[low_r:high_r, low_c:high_c] > 0.0).view(np.uint8)
    _, labels = cv2.connectedComponents(free, connectivity=4)
    here, there = (int(labels[r - low_r, c - low_c]) for r, c in ends)
    return here != there and here > 0 and there > 0
