"""Who hears whom: by distance, and by what is in between."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from scipy.sparse.csgraph import connected_components

from mecanum_env.rooms.floor_plan import FloorPlan
from mecanum_env.team.config import CommunicationConfig
from slam.types import Array, Indices

__all__ = ["groups", "walls_between"]


def groups(config: CommunicationConfig, places: Array, plan: FloorPlan) -> Indices:
    """Return for each robot ``(n,)`` the number of its group: those that hear each other, directly or by others.

    Parameters
    ----------
    places : Array
        Where they are ``(n, 2)`` [m], in the plan's frame.
    plan : FloorPlan
        What is in between.
    """
    n = len(places)
    if config.model == "unlimited" or n == 1:
        return np.zeros(n, np.int64)
    if config.model == "none":
        return np.arange(n)
    hears = np.zeros((n, n), np.bool_)
    for i in range(n):
        for j in range(i):
            hears[i, j] = _hears(config, places[i], places[j], plan)
    return np.asarray(connected_components(hears, directed=False)[1], np.int64)


def _hears(config: CommunicationConfig, a: Array, b: Array, plan: FloorPlan) -> bool:
    """Tell whether two robots hear each other: log-distance path loss, and a loss for each wall.

    Sight ends where a beam of the lidar does, at furniture as well. A signal loses next to nothing there.
    """
    distance = math.hypot(*(a - b))
    if distance > config.range_m or config.model == "range":
        return distance <= config.range_m
    if config.model == "line-of-sight":
        return walls_between(a, b, plan.segments) == 0 and not _meets_disc(a, b, plan.circles)
    walls = walls_between(a, b, plan.walls)
    if walls == 0:
        return True
    spare_db = 10.0 * config.path_loss * math.log10(config.range_m / max(distance, 1e-3))
    return spare_db >= config.wall_loss_db * walls


def walls_between(a: Array, b: Array, walls: Array) -> int:
    """Return how many walls the line between two points ``(2,)`` crosses: half of the surfaces ``(w, 4)``."""
    return (_crossings(a[0], a[1], b[0], b[1], walls) + 1) // 2


def _meets_disc(a: Array, b: Array, circles: Array) -> bool:
    """Tell whether the straight line between two points ``(2,)`` meets a disc ``(c, 3)``: x, y, radius [m]."""
    along, out = b - a, circles[:, :2] - a
    share = np.clip(out @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
    return bool((np.hypot(*(share[:, None] * along - out).T) < circles[:, 2]).any())


@njit(cache=True, nogil=True)
def _crossings(ax: float, ay: float, bx: float, by: float, segments: Array) -> int:
    """Return how many segments ``(s, 4)`` the line from a to b crosses."""
    total = 0
    dx, dy = bx - ax, by - ay
    for i in range(segments.shape[0]):
        px, py, qx, qy = segments[i, 0] - ax, segments[i, 1] - ay, segments[i, 2] - ax, segments[i, 3] - ay
        # The segment's ends lie on either side of the line, the line's on either side of the segment.
        if (dx * py - dy * px > 0.0) != (dx * qy - dy * qx > 0.0):
            ex, ey = qx - px, qy - py
            side_a, side_b = ex * -py - ey * -px, ex * (dy - py) - ey * (dx - px)
            total += (side_a > 0.0) != (side_b > 0.0)
    return total
