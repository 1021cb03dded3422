"""Straight surfaces → the corners where they meet or visibly end, with covariances from the fits (kernels)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.surfaces import (
    EDGE_FACE,
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
    VAR_OFFSET,
    VAR_SLOPE,
    R,
)
from slam.types import CONCAVE, CONVEX

Array = NDArray[np.float64]

_SIMPLER = 6.0  # by how much an end face must lower the misfit to be believed
_MOST_BEAMS = 40  # after the last on a surface, in search of the first that passes it
_LEAN = 0.1  # how much a beam must lean towards a surface to be taken for one that reaches its end face
_POOR = 2.0  # range sigmas: largest 1σ of a convex corner that two fits make


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
    if not left:
        # A short face gives a corner that is worse than its covariance; as the end of the other surface it is not.
        half = 0.5 * (cxx - cyy)
        if 0.5 * (cxx + cyy) + math.sqrt(half * half + cxy * cxy) > (_POOR * limits[SIGMA]) ** 2 + floor:
            return 0
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
def _misfit(line: Array, reach: float, ray: Array, sigma: float) -> float:
    """Return the squared distance, in units of its noise, of a range from where its beam meets a line."""
    off = (reach - line[R] / (line[NX] * ray[0] + line[NY] * ray[1])) / sigma
    return 0.0 if math.isnan(off) else off * off


@njit(cache=True, nogil=True, error_model="numpy")
def _past_the_end(
    line: Array, step: int, last: int, ranges: Array, rays: Array, increment: float, range_max: float,
    limits: Array,
) -> tuple[int, int, int]:  # fmt: skip
    """Return how many beams after ``last`` the first that returned is, the last on an end face, the first past it.

    The second is 0 where no end face shows; the third is 0 where the surface is hidden or goes on.
    """
    n = ranges.shape[0]
    full = n * increment > 2.0 * math.pi - 1.5 * increment
    end = _meets(line, rays[last])
    first = inner = beams = 0
    for _ in range(_MOST_BEAMS):
        beams += 1
        index = last + beams * step
        if index < 0 or index >= n:
            if not full:
                return 0, 0, 0
            index %= n
        reach = ranges[index]
        if math.isnan(reach):
            continue
        first = beams if first == 0 else first
        across = line[NX] * rays[index, 0] + line[NY] * rays[index, 1]
        if across < 0.05:
            return 0, 0, 0
        missed = line[R] / across  # range at which the beam would meet the line
        if missed > range_max - 0.1 or reach < missed - limits[SPLIT_SIGMAS] * limits[SIGMA]:
            return 0, 0, 0
        px, py = reach * rays[index, 0], reach * rays[index, 1]
        beyond = (-line[NY] * (px - line[MX]) + line[NX] * (py - line[MY]) - end) * step
        if reach > missed + limits[EDGE_JUMP]:
            depth = line[NX] * px + line[NY] * py - line[R]
            if not (depth < limits[EDGE_FACE] and -limits[EDGE_FACE] < beyond < limits[EDGE_FACE]):
                return first, inner, beams
        elif beyond > limits[EDGE_FACE]:
            return 0, 0, 0  # the surface goes on, a little off the line
        inner = beams
    return 0, 0, 0


@njit(cache=True, nogil=True, error_model="numpy")
def _end_before_face(
    line: Array, step: int, last: int, inner: int, past: int, ranges: Array, rays: Array, limits: Array
) -> tuple[float, float]:
    """Return where a surface ends, along it from its centroid, and the variance that an end face brings to that.

    The first points of a face that recedes at a right angle lie so near the surface's line that they passed for
    points of the surface, the more of them the noisier the ranges. So its last beams, as far back from ``last`` as
    that may be, and those after it up to ``inner`` are divided anew, where their ranges fit best: the surface lies
    on the line, and all points of the face lie as far along it as its end. Where neither that fits nor all of them
    lie on the line (a bevel), the surface is taken to end with the first beam that is off the line.
    """
    n, sigma = ranges.shape[0], limits[SIGMA]
    lean = (-line[NY] * rays[last, 0] + line[NX] * rays[last, 1]) * step
    across = line[NX] * rays[last, 0] + line[NY] * rays[last, 1]
    end, back = _meets(line, rays[last]), 0
    visible = lean < -_LEAN
    if visible:
        # How far beyond the end these beams meet the line where the face is 4σ behind it.
        most = limits[SPLIT_SIGMAS] * sigma * -lean / across
        while back < line[POINTS] - 4 and (end - _meets(line, rays[(last - back * step) % n])) * step < most:
            back += 1
    rest, on = 0.0, 0
    for k in range(1 - back, inner + 1):
        i = (last + k * step) % n
        off = _misfit(line, ranges[i], rays[i], sigma)
        rest += off
        on = k if k == on + 1 and off < limits[SPLIT_SIGMAS] ** 2 else on
    best, variance = rest - _SIMPLER, 0.0
    s = _half_way(line, rays, last + inner * step, last + past * step)
    # The face from its far end inwards: weight, first and second moment of its points along the line.
    weight = first = second = 0.0
    for k in range(inner, -back, -1):
        i = (last + k * step) % n
        lean = -line[NY] * rays[i, 0] + line[NX] * rays[i, 1]
        if not visible or math.isnan(ranges[i]) or lean * step > -_LEAN:
            continue
        along = ranges[i] * lean + line[NY] * line[MX] - line[NX] * line[MY]
        w = 1.0 / (sigma * lean) ** 2
        weight, first, second = weight + w, first + w * along, second + w * along * along
        rest -= _misfit(line, ranges[i], rays[i], sigma)
        misfit = rest + second - first * first / weight
        if misfit < best:
            best, s, variance = misfit, first / weight, 1.0 / weight
    if best < 2.0 * (inner + back) + _SIMPLER:
        return s, variance
    return _half_way(line, rays, last + on * step, last + (on + 1) * step), (limits[SPLIT_SIGMAS] * sigma) ** 2


@njit(cache=True, nogil=True, error_model="numpy")
def _half_way(line: Array, rays: Array, one: int, other: int) -> float:
    """Return the middle between where two beams meet a line, along it from its centroid."""
    n = rays.shape[0]
    return 0.5 * (_meets(line, rays[one % n]) + _meets(line, rays[other % n]))


@njit(cache=True, nogil=True, error_model="numpy")
def edge(
    line: Array, side: int, ranges: Array, rays: Array, increment: float, range_max: float, limits: Array,
    corner: Array,
) -> int:  # fmt: skip
    """Write the corner at which a surface ends in front of something farther away; return 1 if there is one.

    Where the next beam would still meet the surface's line but passes it, the surface ends: between the two
    beams, uniformly. A short end face may show in between (a wall is as thick as that), all of it behind the
    line; hidden or not, it is taken to recede at a right angle. (Where a beam stops short of the line, something
    nearer hides the surface: the rim of a shadow, no landmark.)
    """
    if line[T1] - line[T0] < limits[EDGE_LENGTH] or line[POINTS] < limits[EDGE_POINTS]:
        return 0
    step = 1 if side == 1 else -1
    last = int(line[LAST]) if side == 1 else int(line[FIRST])
    first, inner, past = _past_the_end(line, step, last, ranges, rays, increment, range_max, limits)
    if past == 0:
        return 0
    # The ends by their bearings: the noise of one range would move them along a wall seen at an angle.
    spacing = (_meets(line, rays[(last + first * step) % rays.shape[0]]) - _meets(line, rays[last])) * step
    if spacing < 0.0 or spacing > limits[EDGE_SPACING]:
        return 0
    s, variance = _end_before_face(line, step, last, inner, past, ranges, rays, limits)
    # A uniform error of the beams' spacing, with some more since it lasts while the robot stands still.
    along = (limits[EDGE_SIGMA] * spacing) ** 2 + limits[FLOOR] ** 2 + variance
    x, y = line[MX] - line[NY] * s, line[MY] + line[NX] * s
    off = line[VAR_OFFSET] + s * s * line[VAR_SLOPE] + limits[FLOOR] ** 2
    nx, ny, ax, ay = line[NX], line[NY], -line[NY], line[NX]
    direction = math.atan2(step * ay - ny, step * ax - nx)
    _to_polar(
        x, y, along * ax * ax + off * nx * nx, along * ax * ay + off * nx * ny, along * ay * ay + off * ny * ny,
        CONVEX, direction, 1, corner,
    )  # fmt: skip
    return 1
