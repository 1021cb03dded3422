"""Exact ray casting of a fan of beams against line segments and circles.

Not every beam against every segment: each segment is met only by the beams of the bearing interval in which it
lies, as a polygon meets only its own columns in a depth buffer. Along a segment the inverse range is linear in
the beam's direction (cos β, sin β), so the buffer holds inverse ranges and an intersection costs two products.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.geometry import wrap_scalar

__all__ = ["beam_directions", "cast_rays"]

Array = NDArray[np.float64]

_TWO_PI = 2.0 * math.pi
_BEARING_ERROR = 4e-5  # [rad], above what a difference of two results of _bearing can be wrong by
_SEAM_M = 1e-9  # a beam that passes an end point within this hits it: no ray slips through where walls meet


def beam_directions(beams: int, angle_min: float, angle_increment: float) -> Array:
    """Return the beams' directions in the sensor frame ``(2, beams)``: cosines, then sines."""
    angles = angle_min + angle_increment * np.arange(beams)
    return np.vstack([np.cos(angles), np.sin(angles)])


@njit(cache=True, nogil=True, error_model="numpy")
def _bearing(x: float, y: float) -> float:
    """Return atan2(y, x) to within 2e-5 rad, some three times faster: it only has to find the beams' numbers.

    The polynomial is Abramowitz & Stegun 4.4.47 (error ≤ 1e-5 on [0, 1]).
    """
    ax, ay = abs(x), abs(y)
    low, high = min(ax, ay), max(ax, ay)
    t = low / high if high > 0.0 else 0.0
    u = t * t
    angle = t * (0.9998660 + u * (-0.3302995 + u * (0.1801410 + u * (-0.0851330 + u * 0.0208351))))
    if ay > ax:
        angle = 0.5 * math.pi - angle
    if x < 0.0:
        angle = math.pi - angle
    return -angle if y < 0.0 else angle


@njit(cache=True, nogil=True, error_model="numpy")
def _edge_beams(
    first: int, last: int, ax: float, ay: float, bx: float, by: float, directions: Array, inverse: Array
) -> None:
    """Draw a segment into beams ``first`` to ``last``, which may or may not pass between its ends."""
    cross = ax * by - ay * bx
    for k in range(first, last + 1):
        dx, dy = directions[0, k], directions[1, k]
        if ax * dy - ay * dx >= -_SEAM_M and dx * by - dy * bx >= -_SEAM_M:
            value = (dx * (by - ay) - dy * (bx - ax)) / cross
            inverse[k] = max(inverse[k], value)


@njit(cache=True, nogil=True, error_model="numpy")
def _segment(
    ax: float,
    ay: float,
    bx: float,
    by: float,
    angle_min: float,
    angle_increment: float,
    directions: Array,
    inverse: Array,
) -> None:
    """Draw a segment, given in the sensor frame, into the buffer; ``angle_min`` in [-π, π)."""
    cross = ax * by - ay * bx
    if cross < 0.0:
        ax, ay, bx, by, cross = bx, by, ax, ay, -cross
    if cross <= 1e-12 * (abs(bx - ax) + abs(by - ay)):
        _edge_on(ax, ay, bx, by, angle_min, angle_increment, directions, inverse)
        return
    # Seen counter-clockwise from a to b, the segment spans less than half a turn.
    bearing_a, bearing_b = _bearing(ax, ay), _bearing(bx, by)
    span = bearing_b - bearing_a if bearing_b >= bearing_a else bearing_b - bearing_a + _TWO_PI
    if span > math.pi + 0.01:
        span = 0.0  # the error of two nearly equal bearings
    per_radian = 1.0 / angle_increment
    turn = _TWO_PI * per_radian  # beams to a full turn; beam k + turn is beam k
    doubt = _BEARING_ERROR * per_radian
    start = (bearing_a - angle_min) * per_radian
    stop = start + span * per_radian
    scale = 1.0 / cross
    p, q = (by - ay) * scale, (bx - ax) * scale
    beams = inverse.shape[0]
    if stop + doubt >= turn:
        start, stop = start - turn, stop - turn
    while start - doubt < beams:
        # Beams first to last may meet it; those from inner_first to inner_last do.
        first, last = max(math.ceil(start - doubt), 0), min(math.floor(stop + doubt), beams - 1)
        inner_first, inner_last = max(math.ceil(start + doubt), 0), min(math.floor(stop - doubt), beams - 1)
        if inner_first > inner_last:
            _edge_beams(first, last, ax, ay, bx, by, directions, inverse)
        else:
            if first < inner_first:
                _edge_beams(first, inner_first - 1, ax, ay, bx, by, directions, inverse)
            if inner_last < last:
                _edge_beams(inner_last + 1, last, ax, ay, bx, by, directions, inverse)
            # Unsigned, or Numba's check for negative indices keeps the loop from being vectorised: 3 × slower.
            for k in range(np.uint64(inner_first), np.uint64(inner_last + 1)):
                value = directions[0, k] * p - directions[1, k] * q
                inverse[k] = value if value > inverse[k] else inverse[k]
        start, stop = start + turn, stop + turn


@njit(cache=True, nogil=True, error_model="numpy")
def _edge_on(
    ax: float,
    ay: float,
    bx: float,
    by: float,
    angle_min: float,
    angle_increment: float,
    directions: Array,
    inverse: Array,
) -> None:
    """Draw a segment on whose line the sensor lies: its nearer end, or nothing but walls if it is on it."""
    if ax * bx + ay * by <= 0.0:
        inverse[:] = np.inf
        return
    if ax * ax + ay * ay > bx * bx + by * by:
        ax, ay = bx, by
    near = math.sqrt(ax * ax + ay * ay)
    beam = round((math.atan2(ay, ax) - angle_min) % _TWO_PI / angle_increment)
    turn = round(_TWO_PI / angle_increment)
    for k in (beam, beam - turn):
        if (
            0 <= k < inverse.shape[0]
            and abs(directions[0, k] * ay - directions[1, k] * ax) <= _SEAM_M
            and directions[0, k] * ax + directions[1, k] * ay > 0.0
        ):
            inverse[k] = max(inverse[k], 1.0 / near)


@njit(cache=True, nogil=True, error_model="numpy")
def _circle(
    x: float,
    y: float,
    radius: float,
    angle_min: float,
    angle_increment: float,
    directions: Array,
    inverse: Array,
) -> None:
    """Draw a circle whose centre is given in the sensor frame into the buffer of inverse ranges."""
    gap = x * x + y * y - radius * radius
    if gap <= 0.0:
        inverse[:] = np.inf  # inside something solid
        return
    beams = inverse.shape[0]
    turn = _TWO_PI / angle_increment
    half = math.asin(min(1.0, radius / math.sqrt(x * x + y * y)))
    start = (math.atan2(y, x) - half - angle_min) % _TWO_PI / angle_increment
    for shift in (-1, 0, 1):
        first = math.floor(start + shift * turn) - 1
        last = math.ceil(start + 2.0 * half / angle_increment + shift * turn) + 1
        for k in range(max(first, 0), min(last, beams - 1) + 1):
            along = x * directions[0, k] + y * directions[1, k]
            reach = along * along - gap
            if along > 0.0 and reach >= 0.0:
                # The nearer root, written so that it does not cancel: t = gap / (along + √reach).
                inverse[k] = max(inverse[k], (along + math.sqrt(reach)) / gap)


@njit(cache=True, nogil=True, error_model="numpy")
def cast_rays(
    segments: Array,
    circles: Array,
    x: float,
    y: float,
    theta: float,
    directions: Array,
    angle_min: float,
    angle_increment: float,
    range_max: float,
    out: Array,
) -> None:
    """Fill ``out`` with the range of each beam [m], ``inf`` where it meets nothing within ``range_max``.

    Parameters
    ----------
    segments
        ``(n, 4)`` x1, y1, x2, y2 in the world frame [m].
    circles
        ``(c, 3)`` x, y, radius in the world frame [m]; discs, solid.
    x, y, theta
        Pose of the sensor in the world frame [m, m, rad].
    directions
        From :func:`beam_directions` with the same beams; a table, since turning a direction on from beam to
        beam would lose digits.
    angle_min, angle_increment
        Bearing of the first beam, and from each to the next [rad]; beams do not go round more than once.
    range_max
        [m].
    out
        ``(beams,)``.
    """
    out[:] = 0.0
    angle_min = wrap_scalar(angle_min)
    c, s = math.cos(theta), math.sin(theta)
    for i in range(segments.shape[0]):
        ax, ay, bx, by = segments[i, 0] - x, segments[i, 1] - y, segments[i, 2] - x, segments[i, 3] - y
        if (
            min(ax, bx) > range_max
            or max(ax, bx) < -range_max
            or min(ay, by) > range_max
            or max(ay, by) < -range_max
        ):
            continue
        cross = ax * by - ay * bx
        length_squared = (bx - ax) ** 2 + (by - ay) ** 2
        if cross * cross > range_max * range_max * length_squared:  # its whole line is too far
            continue
        _segment(
            c * ax + s * ay,
            c * ay - s * ax,
            c * bx + s * by,
            c * by - s * bx,
            angle_min,
            angle_increment,
            directions,
            out,
        )
    for i in range(circles.shape[0]):
        cx, cy, radius = circles[i, 0] - x, circles[i, 1] - y, circles[i, 2]
        if cx * cx + cy * cy <= (range_max + radius) ** 2:
            _circle(c * cx + s * cy, c * cy - s * cx, radius, angle_min, angle_increment, directions, out)
    nearest = 1.0 / range_max
    for k in range(out.shape[0]):
        out[k] = 1.0 / out[k] if out[k] >= nearest else np.inf
