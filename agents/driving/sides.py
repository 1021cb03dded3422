"""What parts a robot from others nearby: each keeps to its own half of the way between them.

A robot that brakes for another as though that stood still is hit by it where both drive. Both cannot know what the
other is about to do; but each can see to it that it comes to a stand on its own side of a line halfway between
them, and then they do not touch, whatever each does. Zhou, Wang, Bandyopadhyay and Schwager, "Fast, on-line
collision avoidance for dynamic vehicles using buffered Voronoi cells", IEEE RA-L 2017: such lines bound the cell;
here bodies are rectangles that brake (:func:`agents.driving.safety.safe_twist`), and the line lies halfway between
their nearest points.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numba import njit

from agents.driving.safety import LocalMap
from slam.belief import Belief
from slam.types import Array

__all__ = ["parting_lines"]

_NONE = np.zeros((0, 3))
_OLD_S = 1.5  # what is older says no longer where a robot is
_SURE = 2.0  # so many σ of where another is believed to be it may be nearer
_ROUND_M = 0.6  # how far round a corner two robots may be in each other's way


def parting_lines(
    belief: Belief, near: LocalMap, half: Array, *, gap_m: float, speed_m_s: float, stop_m: float
) -> Array:
    """Return the lines ``(k, 3)`` that the robot's body must not cross, as rows nx, ny, d: n·p ≤ d.

    In the body frame [m]; one for each robot that is on the map nearby, or so near that two at full speed might
    not stop apart, and that no wall keeps away. ``half`` ``(2,)`` are half the length and width [m] of all bodies,
    ``gap_m`` is what the body keeps from the line, ``speed_m_s`` at what speed another may have driven on since it
    was where it is believed to be, ``stop_m`` the way that a body takes to come to a stand from full speed.
    """
    if not belief.teammates:
        return _NONE
    x, y, heading = (float(v) for v in belief.pose)
    c, s = math.cos(heading), math.sin(heading)
    rows, cols = near.clearance.shape
    # A line that begins later than this would lie where two large bodies can no longer come to a stand.
    stopping = 2.0 * (math.hypot(half[0], half[1]) + stop_m + gap_m)
    reach = max(0.5 * max(rows, cols) * near.resolution + 0.5, stopping)
    lines = []
    for mate in belief.teammates:
        dx, dy = float(mate.pose[0]) - x, float(mate.pose[1]) - y
        apart = math.hypot(dx, dy)
        if not 1e-6 < apart < reach or mate.age_s > _OLD_S or _walled_off(near, (x, y), (x + dx, y + dy)):
            continue
        ahead, aside = c * dx + s * dy, c * dy - s * dx
        nx, ny, own, free = _parting(half, ahead, aside, float(mate.pose[2]) - heading)
        free -= speed_m_s * mate.age_s + _SURE * mate.sigma_m
        lines.append((nx, ny, own + 0.5 * free - gap_m))
    return np.array(lines) if lines else _NONE


@njit(cache=True, nogil=True)
def _parting(half: Array, x: float, y: float, turn: float) -> tuple[float, float, float, float]:
    """Return the direction in which two bodies are farthest apart, in the frame of the first.

    The second is at x, y [m], turned by ``turn`` [rad]. The direction is a side's normal, or goes from corner to
    corner.

    Returns
    -------
    tuple
        Unit vector, how far the first body reaches along it, and the free way from there to the second [m]: the
        distance between the bodies, negative where they overlap.
    """
    c, s = math.cos(turn), math.sin(turn)
    best_x, best_y, best_own, best = 1.0, 0.0, 0.0, -np.inf
    for k in range(20):
        if k < 4:
            nx, ny = (1.0, 0.0) if k == 0 else (0.0, 1.0) if k == 1 else (c, s) if k == 2 else (-s, c)
            if nx * x + ny * y < 0.0:
                nx, ny = -nx, -ny
        else:
            i, j = (k - 4) // 4, (k - 4) % 4
            bx, by = half[0] * (1 - 2 * (j & 1)), half[1] * (1 - (j & 2))
            nx = x + c * bx - s * by - half[0] * (1 - 2 * (i & 1))
            ny = y + s * bx + c * by - half[1] * (1 - (i & 2))
            length = math.hypot(nx, ny)
            if length < 1e-9:
                continue
            nx, ny = nx / length, ny / length
        own = half[0] * abs(nx) + half[1] * abs(ny)
        other = half[0] * abs(c * nx + s * ny) + half[1] * abs(c * ny - s * nx)
        free = nx * x + ny * y - own - other
        if free > best:
            best_x, best_y, best_own, best = nx, ny, own, free
    return best_x, best_y, best_own, best


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
