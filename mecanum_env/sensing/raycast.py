"""Exact ray casting of a fan of beams against line segments and circles.

Not every beam against every segment: each segment is met only by the beams of the bearing interval in which it
lies, as a polygon meets only its own columns in a depth buffer. Along a segment the inverse range is linear in
the beam's direction (cos β, sin β), so the buffer holds inverse ranges and an intersection costs two products.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from slam.geometry import wrap_scalar
from slam.types import Array

__all__ = ["beam_directions", "cast_rays"]

_TWO_PI = 2.0 * math.pi
_BEARING_ERROR = 4e-5  # [rad], above what a difference of two results of _bearing can be wrong by
# Rows of what is known of the segments as the sensor sees them: whether they are too far (0), edge on (-1) or
# neither; the beams, not whole numbers, at which they start and stop; the coefficients of their inverse range;
# their ends [m].
_SEEN, _START, _STOP, _P, _Q, _AX, _AY, _BX, _BY = range(9)
_ROWS = 9
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
def _edge_beams(first: int, last: int, where: Array, i: int, directions: Array, inverse: Array) -> None:
    """Draw segment ``i`` into beams ``first`` to ``last``, which may or may not pass between its ends."""
    ax, ay, bx, by = where[_AX, i], where[_AY, i], where[_BX, i], where[_BY, i]
    cross = ax * by - ay * bx
    for k in range(first, last + 1):
        dx, dy = directions[0, k], directions[1, k]
        if ax * dy - ay * dx >= -_SEAM_M and dx * by - dy * bx >= -_SEAM_M:
            value = (dx * (by - ay) - dy * (bx - ax)) / cross
            inverse[k] = max(inverse[k], value)


@njit(cache=True, nogil=True, error_model="numpy")
def _locate(
    segments: Array, x: float, y: float, theta: float, range_max: float, angle_min: float, per_radian: float,
    where: Array,
) -> None:  # fmt: skip
    """Write for each segment where the sensor sees it into the rows of ``where``; ``angle_min`` in [-π, π).

    A loop of its own, without a branch and over columns, so that it vectorises: four segments at a time.
    """
    for i in range(segments.shape[0]):
        where[_AX, i], where[_AY, i] = segments[i, 0], segments[i, 1]
        where[_BX, i], where[_BY, i] = segments[i, 2], segments[i, 3]
    c, s = math.cos(theta), math.sin(theta)
    turn, doubt = _TWO_PI * per_radian, _BEARING_ERROR * per_radian
    for i in range(segments.shape[0]):
        ax, ay, bx, by = where[_AX, i] - x, where[_AY, i] - y, where[_BX, i] - x, where[_BY, i] - y
        beside = ((ax > range_max) & (bx > range_max)) | ((ax < -range_max) & (bx < -range_max))
        beyond = ((ay > range_max) & (by > range_max)) | ((ay < -range_max) & (by < -range_max))
        cross = ax * by - ay * bx
        length_squared = (bx - ax) ** 2 + (by - ay) ** 2
        # … or its whole line is too far.
        away = beside | beyond | (cross * cross > range_max * range_max * length_squared)
        ax, ay, bx, by = c * ax + s * ay, c * ay - s * ax, c * bx + s * by, c * by - s * bx
        cross = ax * by - ay * bx
        turned = cross < 0.0
        ax, ay, bx, by = bx if turned else ax, by if turned else ay, ax if turned else bx, ay if turned else by
        cross = -cross if turned else cross
        on_line = cross <= 1e-12 * (abs(bx - ax) + abs(by - ay))
        # Seen counter-clockwise from a to b, the segment spans less than half a turn.
        bearing_a, bearing_b = _bearing(ax, ay), _bearing(bx, by)
        span = bearing_b - bearing_a
        span = span if bearing_b >= bearing_a else span + _TWO_PI
        span = 0.0 if span > math.pi + 0.01 else span  # the error of two nearly equal bearings
        start = (bearing_a - angle_min) * per_radian
        stop = start + span * per_radian
        past = stop + doubt >= turn
        scale = 1.0 / cross
        where[_SEEN, i] = 0.0 if away else -1.0 if on_line else 1.0
        where[_START, i], where[_STOP, i] = start - turn if past else start, stop - turn if past else stop
        where[_P, i], where[_Q, i] = (by - ay) * scale, (bx - ax) * scale
        where[_AX, i], where[_AY, i], where[_BX, i], where[_BY, i] = ax, ay, bx, by


@njit(cache=True, nogil=True, error_model="numpy")
def _edge_on(
    ax: float, ay: float, bx: float, by: float, angle_min: float, angle_increment: float, directions: Array,
    inverse: Array,
) -> None:  # fmt: skip
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
def _draw_segments(
    where: Array, angle_min: float, angle_increment: float, directions: Array, inverse: Array
) -> None:
    """Draw the segments that :func:`_locate` has found into the buffer.

    All in one function: called for each segment, it took a third longer.
    """
    per_radian = 1.0 / angle_increment
    turn, doubt = _TWO_PI * per_radian, _BEARING_ERROR * per_radian  # beam k + turn is beam k
    beams = inverse.shape[0]
    for i in range(where.shape[1]):
        if where[_SEEN, i] == 0.0:
            continue
        if where[_SEEN, i] < 0.0:
            _edge_on(
                where[_AX, i], where[_AY, i], where[_BX, i], where[_BY, i], angle_min, angle_increment, directions,
                inverse,
            )  # fmt: skip
            continue
        start, stop, p, q = where[_START, i], where[_STOP, i], where[_P, i], where[_Q, i]
        while start - doubt < beams:
            # Beams first to last may meet it; those from inner_first to inner_last do.
            first, last = max(math.ceil(start - doubt), 0), min(math.floor(stop + doubt), beams - 1)
            inner_first, inner_last = max(math.ceil(start + doubt), 0), min(math.floor(stop - doubt), beams - 1)
            if inner_first > inner_last:
                _edge_beams(first, last, where, i, directions, inverse)
            else:
                if first < inner_first:
                    _edge_beams(first, inner_first - 1, where, i, directions, inverse)
                if inner_last < last:
                    _edge_beams(inner_last + 1, last, where, i, directions, inverse)
                # Unsigned, or Numba's check for negative indices keeps the loop from being vectorised: 3 × slower.
                for k in range(np.uint64(inner_first), np.uint64(inner_last + 1)):
                    value = directions[0, k] * p - directions[1, k] * q
                    inverse[k] = value if value > inverse[k] else inverse[k]
            start, stop = start + turn, stop + turn


@njit(cache=True, nogil=True, error_model="numpy")
def _circle(
    x: float, y: float, radius: float, angle_min: float, angle_increment: float, directions: Array, inverse: Array
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
    segments: Array, circles: Array, x: float, y: float, theta: float, directions: Array, angle_min: float,
    angle_increment: float, range_max: float, out: Array,
) -> None:  # fmt: skip
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
    where = np.empty((_ROWS, segments.shape[0]))
    _locate(segments, x, y, theta, range_max, angle_min, 1.0 / angle_increment, where)
    _draw_segments(where, angle_min, angle_increment, directions, out)
    c, s = math.cos(theta), math.sin(theta)
    for i in range(circles.shape[0]):
        cx, cy, radius = circles[i, 0] - x, circles[i, 1] - y, circles[i, 2]
        if cx * cx + cy * cy <= (range_max + radius) ** 2:
            _circle(c * cx + s * cy, c * cy - s * cx, radius, angle_min, angle_increment, directions, out)
    nearest = 1.0 / range_max
    for k in range(out.shape[0]):
        out[k] = 1.0 / out[k] if out[k] >= nearest else np.inf
