"""Straight surfaces → the corners where they meet or visibly end, and walls, as rows of observations (kernels)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from slam.features.surfaces import (
    CURVATURE,
    EDGE_FACE,
    EDGE_FLOOR,
    EDGE_JUMP,
    EDGE_LENGTH,
    EDGE_POINTS,
    EDGE_SIGMA,
    EDGE_SPACING,
    FIRST,
    FLOOR,
    LAST,
    MAX_GAP,
    MX,
    MY,
    NX,
    NY,
    POINTS,
    SIGMA,
    SIN_MIN_ANGLE,
    SPLIT_FLOOR,
    SPLIT_SIGMAS,
    T0,
    T1,
    VAR_CURVATURE,
    VAR_OFFSET,
    VAR_SLOPE,
    R,
)
from slam.types import CONCAVE, CONVEX, LINE, Array

_LOOSE_M = 0.02
_CLEAR = 3.0  # σ behind a surface from which on a point is of its end face
_MOST_ON_FACE = 40  # points
_NOTHING = 12.0  # by which a log likelihood may lie below the highest
_BACK = 24  # last beams of a surface that may have met its end face
_SAME = 2.0  # σ along the surface by which a point may be off an end face's others


@njit(cache=True, nogil=True, error_model="numpy")
def all_on(xy: Array, first: int, last: int, one: Array, two: Array, limits: Array) -> bool:
    """Tell whether every point from ``first`` to ``last`` lies on one of two lines."""
    near = max(limits[SPLIT_SIGMAS] * limits[SIGMA], limits[SPLIT_FLOOR])
    for i in range(first, last + 1):
        off_one = abs(one[NX] * xy[i, 0] + one[NY] * xy[i, 1] - one[R])
        off_two = abs(two[NX] * xy[i, 0] + two[NY] * xy[i, 1] - two[R])
        if min(off_one, off_two) > near:
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def meet(one: Array, two: Array, increment: float, limits: Array, corner: Array) -> int:
    """Write the corner of two surfaces that follow each other in the scan; return 1 if there is one."""
    cross = one[NX] * two[NY] - one[NY] * two[NX]
    if abs(cross) < limits[SIN_MIN_ANGLE]:
        return 0
    x = (one[R] * two[NY] - two[R] * one[NY]) / cross
    y = (two[R] * one[NX] - one[R] * two[NX]) / cross
    s1 = -one[NY] * (x - one[MX]) + one[NX] * (y - one[MY])
    s2 = -two[NY] * (x - two[MX]) + two[NX] * (y - two[MY])
    # The corner must lie where one surface ends and the other begins, up to the beams' own spacing.
    rho = math.sqrt(x * x + y * y)
    gap = limits[MAX_GAP] + 4.0 * rho * increment
    if abs(s1 - one[T1]) > gap or abs(s2 - two[T0]) > gap:
        return 0
    # Each line's offset at the corner: n·p = r there, with this variance.
    v1 = one[VAR_OFFSET] + s1 * s1 * one[VAR_SLOPE]
    v2 = two[VAR_OFFSET] + s2 * s2 * two[VAR_SLOPE]
    # p = N⁻¹ (r1, r2)  ⇒  cov p = N⁻¹ diag(v1, v2) N⁻ᵀ
    a, b = two[NY] / cross, -one[NY] / cross
    c, d = -two[NX] / cross, one[NX] / cross
    floor = limits[FLOOR] ** 2
    cxx = a * a * v1 + b * b * v2 + floor
    cxy = a * c * v1 + b * d * v2
    cyy = c * c * v1 + d * d * v2 + floor
    # Unit vectors from the corner along both surfaces.
    f = math.copysign(1.0, -s1)
    g = math.copysign(1.0, -s2)
    ax, ay = -one[NY] * f, one[NX] * f
    bx, by = -two[NY] * g, two[NX] * g
    # The scan runs counter-clockwise round the sensor: a left turn is a corner of the room, a right turn
    # one that stands out into it.
    left = (-ax) * by - (-ay) * bx > 0.0
    sign = 1.0 if left else -1.0
    direction = math.atan2(sign * (ay + by), sign * (ax + bx))
    _to_polar(x, y, cxx, cxy, cyy, CONCAVE if left else CONVEX, direction, 0, corner)
    return 1


@njit(cache=True, nogil=True, error_model="numpy")
def _to_polar(
    x: float, y: float, cxx: float, cxy: float, cyy: float, kind: int, direction: float, edge: int, corner: Array
) -> None:
    """Write a point and its covariance as range and bearing."""
    rho = math.sqrt(x * x + y * y)
    ux, uy = x / rho, y / rho
    # The Jacobian's rows are (ux, uy) and (-uy, ux)/ρ.
    corner[0], corner[1] = rho, math.atan2(y, x)
    corner[2] = ux * ux * cxx + 2.0 * ux * uy * cxy + uy * uy * cyy
    corner[3] = (-ux * uy * cxx + (ux * ux - uy * uy) * cxy + ux * uy * cyy) / rho
    corner[4] = (uy * uy * cxx - 2.0 * ux * uy * cxy + ux * ux * cyy) / (rho * rho)
    corner[5], corner[6], corner[7] = kind, direction, edge


@njit(cache=True, nogil=True, error_model="numpy")
def _meets(line: Array, ray: Array) -> float:
    """Return where a beam meets a line, along it from its centroid."""
    reach = line[R] / (line[NX] * ray[0] + line[NY] * ray[1])
    return float(-line[NY] * (reach * ray[0] - line[MX]) + line[NX] * (reach * ray[1] - line[MY]))


@njit(cache=True, nogil=True, error_model="numpy")
def edge(
    line: Array, side: int, ranges: Array, rays: Array, increment: float, range_max: float, limits: Array,
    corner: Array,
) -> int:  # fmt: skip
    """Write the corner at which a surface ends in front of something farther away; return 1 if there is one.

    Where the next beam would still meet the surface's line but passes it, the surface ends: between the two
    beams, uniformly. A short end face may show in between (a wall is as thick as that), all of it behind the
    line; hidden or not, it is taken to recede at a right angle, and where it is seen its points tell the end, up
    to the first that is of another face (a door's frame has steps). That is from beyond the end alone: what shows
    behind the line from elsewhere is another surface, or the same where it bends away.
    (Where a beam stops short of the line, something nearer hides the surface: the rim of a shadow, no landmark.)
    """
    if line[T1] - line[T0] < limits[EDGE_LENGTH] or line[POINTS] < limits[EDGE_POINTS]:
        return 0
    step = 1 if side == 1 else -1
    found, end, t, beyond_it, on_face, stray, weight, mean = _past_the_end(
        line, step, ranges, rays, increment, range_max, limits
    )
    spacing = abs(t - end)
    if not found or spacing > limits[EDGE_SPACING] or (t - end) * step < 0.0:
        return 0
    share = limits[EDGE_SIGMA]
    if on_face == 0 and beyond_it:
        s, along = _likely_end(line, step, ranges, rays, limits)
        if along == math.inf:
            return 0
        s *= step
    elif on_face == 0:
        s = 0.5 * (t + end)
        along = (share * spacing) ** 2
    elif on_face == 1:
        s = end + step * min(0.5 * mean, mean)
        along = (share * mean) ** 2 + 1.0 / weight + limits[SIGMA] ** 2
    else:
        s = end + step * mean
        along = 1.0 / weight
        if stray > 0:  # a face with steps: one nearer the surface's last point may lie hidden between two beams
            along += (share * mean) ** 2
    along += limits[FLOOR] ** 2
    if on_face < 2 or stray > 0:
        along += limits[EDGE_FLOOR] ** 2
    x, y = line[MX] - line[NY] * s, line[MY] + line[NX] * s
    off = line[VAR_OFFSET] + s * s * line[VAR_SLOPE] + limits[FLOOR] ** 2
    nx, ny, ax, ay = line[NX], line[NY], -line[NY], line[NX]
    direction = math.atan2(step * ay - ny, step * ax - nx)
    _to_polar(
        x, y, along * ax * ax + off * nx * nx, along * ax * ay + off * nx * ny, along * ay * ay + off * ny * ny,
        CONVEX, direction, step, corner,
    )  # fmt: skip
    return 1


@njit(cache=True, nogil=True, error_model="numpy")
def _likely_end(line: Array, step: int, ranges: Array, rays: Array, limits: Array) -> tuple[float, float]:
    """Return where a surface ends that is seen from beyond, along it towards ``step``, and its variance.

    An end face hardly thicker than the noise shows points that pass for the surface's. So all is weighed that the
    last beams allow: wherever the end is, the beams that meet the line before it lie on the surface, and others
    as far along as the end is, up to the first that passes. Any place is as good as another beforehand.
    """
    n, sigma = ranges.shape[0], limits[SIGMA]
    past = math.inf
    last, first = (int(line[LAST]), int(line[FIRST])) if step == 1 else (int(line[FIRST]), int(line[LAST]))
    back = min(_BACK, ((last - first) * step) % n)
    meets, cost = np.empty(_BACK + _MOST_ON_FACE + 2), np.zeros(_BACK + _MOST_ON_FACE + 2)
    along, weight = np.empty(_BACK + _MOST_ON_FACE + 2), np.empty(_BACK + _MOST_ON_FACE + 2)
    m = 0
    for k in range(-back, _MOST_ON_FACE + 1):
        index = (last + step * k) % n
        met = _meets(line, rays[index]) * step
        slide = (-line[NY] * rays[index, 0] + line[NX] * rays[index, 1]) * step
        reach = ranges[index]
        if math.isnan(reach):
            continue
        px, py = reach * rays[index, 0], reach * rays[index, 1]
        depth = line[NX] * px + line[NY] * py - line[R]
        if k > 0 and (reach == math.inf or depth >= limits[EDGE_FACE]):  # it passes
            past = met
            break
        if slide >= 0.0 or reach == math.inf:
            continue
        off = depth / (sigma * (line[NX] * rays[index, 0] + line[NY] * rays[index, 1]))
        meets[m], cost[m + 1] = met, cost[m] + 0.5 * off * off
        along[m] = (-line[NY] * (px - line[MX]) + line[NX] * (py - line[MY])) * step
        weight[m] = 1.0 / ((sigma * slide) ** 2 + limits[FLOOR] ** 2)
        m += 1
    if m < 2 or past == math.inf:
        return 0.0, math.inf
    meets[m] = past
    total = mean = square = w = b = c = 0.0
    least, top = cost[m], 0.0
    # From the last beam on the surface, the end lies between it and the next: first, were all of them on it.
    for j in range(m, 0, -1):
        if j < m:
            w, b, c = w + weight[j], b + weight[j] * along[j], c + weight[j] * along[j] ** 2
        width = meets[j] - meets[j - 1]
        if width <= 0.0:
            continue
        at = min(max(b / w, meets[j - 1]), meets[j]) if j < m else past
        highest = least - cost[j] - 0.5 * (w * at * at - 2.0 * b * at + c)
        if highest < top - _NOTHING:
            continue
        top = max(top, highest)
        parts = int(min(4.0 + 2.0 * width * math.sqrt(w), 32.0))
        for i in range(parts):
            at = meets[j - 1] + (i + 0.5) / parts * width
            likely = math.exp(min(least - cost[j] - 0.5 * (w * at * at - 2.0 * b * at + c), 500.0)) * width / parts
            total, mean, square = total + likely, mean + likely * at, square + likely * at * at
    mean /= total
    return mean, max(square / total - mean * mean, 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _past_the_end(
    line: Array, step: int, ranges: Array, rays: Array, increment: float, range_max: float, limits: Array
) -> tuple[bool, float, float, bool, int, int, float, float]:
    """Go on, beam by beam, from a surface's last one until one passes its end.

    Returns whether it ends there; where the surface's last point and the first beam past it meet the line, along
    it; whether the robot is beyond the end; of the points of the end face that are clear of the line how many
    are as far along as each other, how many in a row are not, the weight of those and their mean, beyond the end.
    """
    n = ranges.shape[0]
    index = int(line[LAST]) if step == 1 else int(line[FIRST])
    full = n * increment > 2.0 * math.pi - 1.5 * increment
    near = max(limits[SPLIT_SIGMAS] * limits[SIGMA], limits[SPLIT_FLOOR])
    # The ends by their bearings: the noise of one range would move them along a wall seen at an angle.
    end = _meets(line, rays[index])
    t = slide = weight = mean = 0.0
    faces = on_face = stray = 0
    none = False, end, t, False, 0, 0, 0.0, 0.0
    while faces <= _MOST_ON_FACE:
        index += step
        if index < 0 or index >= n:
            if not full:
                return none
            index %= n
        reach = ranges[index]
        if math.isnan(reach):
            continue
        across = line[NX] * rays[index, 0] + line[NY] * rays[index, 1]
        if across < 0.05:
            return none
        missed = line[R] / across  # range at which the beam would meet the line
        if missed > range_max - 0.1 or reach < missed - limits[SPLIT_SIGMAS] * limits[SIGMA]:
            return none
        px, py = reach * rays[index, 0], reach * rays[index, 1]
        beyond = (-line[NY] * (px - line[MX]) + line[NX] * (py - line[MY]) - end) * step
        depth = line[NX] * px + line[NY] * py - line[R]
        slide = (-line[NY] * rays[index, 0] + line[NX] * rays[index, 1]) * step  # < 0: from beyond the end
        farther = beyond > 3.0 * limits[SIGMA] * max(-slide, 0.0)  # than the last, so not of an end face there
        if farther and depth < near:
            end = _meets(line, rays[index]) if slide >= 0.0 else end + step * beyond
            faces = on_face = 0  # the surface goes on: noise has split it
            continue
        if faces == 0:
            if farther and depth < 2.0 * near:
                return none  # it bends away
            t, stray, weight, mean = _meets(line, rays[index]), 0, 0.0, 0.0
        if reach > missed + limits[EDGE_JUMP]:
            if not (depth < limits[EDGE_FACE] and -limits[EDGE_FACE] < beyond < limits[EDGE_FACE]):
                # Past the end face, or there is none to see.
                return True, end, t, slide < 0.0, on_face, stray, weight, mean
        elif beyond > limits[EDGE_FACE]:
            return none  # the surface goes on, a little off the line
        faces += 1
        if stray < 2 and slide < 0.0 and depth > _CLEAR * limits[SIGMA]:
            w = 1.0 / ((limits[SIGMA] * slide) ** 2 + limits[FLOOR] ** 2)
            off = beyond - mean
            if on_face == 0 or off * off < _SAME**2 * (1.0 / w + 1.0 / weight):
                on_face, weight, stray = on_face + 1, weight + w, 0
                mean += w / weight * off
            else:
                stray += 1
    return none


@njit(cache=True, nogil=True, error_model="numpy")
def walls_first(
    lines: Array, corners: Array, limits: Array, length: float, points: float, sigma_r: float, sigma_alpha: float,
    out: Array,
) -> int:  # fmt: skip
    """Write the rows of :meth:`FeatureExtractor.with_walls`; return their number."""
    count = 0
    for k in range(lines.shape[0]):
        line, row = lines[k], out[count]
        if not _is_wall(line, length, points):
            continue
        middle = line[NX] * line[MY] - line[NY] * line[MX]  # of the centroid along the line, from its foot
        # A slope turns the normal back by as much: δα = −slope, δr = offset − middle · slope.
        row[0], row[1] = line[R], math.atan2(line[NY], line[NX])
        row[2] = line[VAR_OFFSET] + middle * middle * line[VAR_SLOPE] + sigma_r**2
        row[3] = middle * line[VAR_SLOPE]
        row[4] = line[VAR_SLOPE] + sigma_alpha**2
        row[5], row[6], row[7] = LINE, row[1], 0.0
        row[8], row[9] = middle + line[T0], middle + line[T1]
        row[10], row[11] = line[CURVATURE], line[VAR_CURVATURE]
        count += 1
    for k in range(corners.shape[0]):
        row = out[count]
        for j in range(row.shape[0]):
            row[j] = corners[k, j]
        one, two = int(corners[k, 8]), int(corners[k, 9])
        first = _is_wall(lines[one], length, points)
        second = two >= 0 and _is_wall(lines[two], length, points)
        if first and second:
            continue
        if first or second:
            _loosen(row, lines[one if first else two])
        count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _is_wall(line: Array, length: float, points: float) -> bool:
    return bool(line[T1] - line[T0] >= length and line[POINTS] >= points)


@njit(cache=True, nogil=True, error_model="numpy")
def _loosen(row: Array, line: Array) -> None:
    """Add to a corner's covariance across a wall: that much of it the wall's own row says."""
    ux, uy = math.cos(row[1]), math.sin(row[1])
    across, turned = line[NX] * ux + line[NY] * uy, (line[NY] * ux - line[NX] * uy) / row[0]
    row[2] += _LOOSE_M**2 * across * across
    row[3] += _LOOSE_M**2 * across * turned
    row[4] += _LOOSE_M**2 * turned * turned
