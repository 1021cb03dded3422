"""Where a body stands among surfaces: on its own, so that it may judge the physics."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from slam.types import Array

__all__ = ["gap", "towards", "went_through"]


@njit(cache=True, nogil=True)
def gap(pose: Array, half_x: float, half_y: float, segments: Array, circles: Array) -> float:
    """Return how far a rectangle is from the nearest surface; negative: how deep the deepest reaches into it [m].

    Parameters
    ----------
    pose
        ``(3,)`` of its middle.
    half_x, half_y
        Half its sides [m].
    segments, circles
        Surfaces ``(s, 4)`` x1, y1, x2, y2 and ``(k, 3)`` x, y, radius [m].
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    best = math.inf
    for i in range(segments.shape[0]):
        ax, ay = segments[i, 0] - pose[0], segments[i, 1] - pose[1]
        bx, by = segments[i, 2] - pose[0], segments[i, 3] - pose[1]
        ax, ay = c * ax + s * ay, c * ay - s * ax
        bx, by = c * bx + s * by, c * by - s * bx
        if _to_point(ax, ay, bx, by, 0.0, 0.0) - half_x - half_y > best:
            continue
        best = min(best, _to_segment(ax, ay, bx, by, half_x, half_y))
    for i in range(circles.shape[0]):
        dx, dy = circles[i, 0] - pose[0], circles[i, 1] - pose[1]
        best = min(best, _outside(c * dx + s * dy, c * dy - s * dx, half_x, half_y) - circles[i, 2])
    return best


@njit(cache=True, nogil=True)
def _outside(x: float, y: float, half_x: float, half_y: float) -> float:
    """Return the signed distance of a point from the rectangle about the origin."""
    over_x, over_y = abs(x) - half_x, abs(y) - half_y
    return math.hypot(max(over_x, 0.0), max(over_y, 0.0)) + min(max(over_x, over_y), 0.0)


@njit(cache=True, nogil=True)
def _to_point(ax: float, ay: float, bx: float, by: float, x: float, y: float) -> float:
    """Return the distance of a point from a segment."""
    ex, ey = bx - ax, by - ay
    squared = ex * ex + ey * ey
    t = 0.0 if squared == 0.0 else min(max(((x - ax) * ex + (y - ay) * ey) / squared, 0.0), 1.0)
    return math.hypot(ax + t * ex - x, ay + t * ey - y)


@njit(cache=True, nogil=True)
def _to_segment(ax: float, ay: float, bx: float, by: float, half_x: float, half_y: float) -> float:
    """Return the signed distance of a segment from the rectangle about the origin."""
    # How deep a point lies is concave along the segment, and bends only where an axis or a diagonal is crossed.
    ex, ey, lead = bx - ax, by - ay, half_x - half_y
    deepest = min(_outside(ax, ay, half_x, half_y), _outside(bx, by, half_x, half_y))
    for value, slope in (
        (ax, ex), (ay, ey), (ax - ay - lead, ex - ey), (ax + ay - lead, ex + ey), (-ax - ay - lead, -ex - ey),
        (ay - ax - lead, ey - ex),
    ):  # fmt: skip
        if slope != 0.0 and 0.0 < -value / slope < 1.0:
            t = -value / slope
            deepest = min(deepest, _outside(ax + t * ex, ay + t * ey, half_x, half_y))
    if deepest < 0.0:
        return deepest
    for x, y in ((half_x, half_y), (-half_x, half_y), (-half_x, -half_y), (half_x, -half_y)):
        deepest = min(deepest, _to_point(ax, ay, bx, by, x, y))
    return deepest


@njit(cache=True, nogil=True)
def went_through(start: Array, end: Array, segments: Array, circles: Array) -> bool:
    """Tell whether the straight way between two points ``(2,)`` crosses a surface."""
    px, py, qx, qy = start[0], start[1], end[0], end[1]
    for i in range(segments.shape[0]):
        ax, ay, bx, by = segments[i, 0], segments[i, 1], segments[i, 2], segments[i, 3]
        first = (bx - ax) * (py - ay) - (by - ay) * (px - ax)
        second = (bx - ax) * (qy - ay) - (by - ay) * (qx - ax)
        third = (qx - px) * (ay - py) - (qy - py) * (ax - px)
        fourth = (qx - px) * (by - py) - (qy - py) * (bx - px)
        if first * second < 0.0 and third * fourth < 0.0:
            return True
    for i in range(circles.shape[0]):
        if _to_point(px, py, qx, qy, circles[i, 0], circles[i, 1]) < circles[i, 2]:
            return True
    return False


def towards(pose: Array, segments: Array, circles: Array) -> Array:
    """Return the unit vector ``(2,)`` in the body's frame that points to the nearest surface."""
    at = pose[:2]
    start, along = segments[:, :2], segments[:, 2:] - segments[:, :2]
    squared = np.maximum((along**2).sum(axis=1), 1e-18)
    share = np.clip(((at - start) * along).sum(axis=1) / squared, 0.0, 1.0)
    rim = at - circles[:, :2]
    far = np.maximum(np.hypot(*rim.T), 1e-9)
    ways = np.vstack([start + share[:, None] * along - at, -rim * ((far - circles[:, 2]) / far)[:, None]])
    x, y = ways[np.hypot(*ways.T).argmin()] if len(ways) else (1.0, 0.0)
    norm = max(math.hypot(x, y), 1e-9)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return np.array([c * x + s * y, c * y - s * x]) / norm
