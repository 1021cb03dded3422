"""What a scan's beams ended on: a point, the surface's normal there, and how exactly the beam tells of it.

Beams on a straight surface have its fitted normal. The others get one from their neighbours (principal components
of five), where those lie on one piece of contour; rough or bent contours count as less exact by what the points
depart from their tangent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.features.extraction import FeatureExtractor
from slam.features.surfaces import FIRST, GRAZING, LAST, MAX_LINES, NX, NY, R
from slam.types import Array, Indices, Scan

__all__ = ["BeamEnds", "beam_ends"]

_FLATTEST = 0.15  # cosine of incidence below which a rough contour's normal means nothing
_BENT = 1.3  # variance across, in units of what noise makes, beyond which five points go around a corner
_PIECE_BEAMS, _PIECE_M, _PIECE_COS = 10, 0.6, 0.825  # largest piece of contour that is one surface
_SHARED = 3.0  # neighbouring normals of a rough contour come from the same points: each beam counts as a third


@dataclass(frozen=True, slots=True)
class BeamEnds:
    """The ends of a scan's beams on surfaces, in order of bearing; everything in the body frame."""

    points: Array  # (n, 2) [m] as measured
    normals: Array  # (n, 2) of the surface, towards the sensor
    on: Array  # (n, 2) [m] the point of the fitted surface; of a rough contour the measured one
    var: Array  # (n,) [m²] of the distance between the measured point and the surface, across it
    spacing: Array  # (n,) [m] between beams on the surface there
    surface: Indices  # (n,) which one: below MAX_LINES straight, from there on pieces of contour

    def __len__(self) -> int:
        return len(self.points)


def beam_ends(
    scan: Scan, extractor: FeatureExtractor, *, offset_m: float, reach_m: float, sigma_m: float, rough_m: float
) -> BeamEnds:
    """Return the ends of the beams of the scan that ``extractor`` has just seen.

    Parameters
    ----------
    offset_m, reach_m : float
        How far ahead of the body's centre the sensor is; ends farther from it are left out [m].
    sigma_m, rough_m : float
        1σ of a range, and what a rough contour departs from a straight one besides [m].
    """
    n = len(scan.ranges)
    numbers, labels = np.empty((n, 8)), np.empty(n, np.int64)
    count = _describe(
        np.asarray(scan.ranges, np.float64), scan.angle_min, scan.angle_increment, scan.range_min,
        min(scan.range_max, reach_m), extractor.surface, extractor.lines, offset_m, sigma_m, rough_m, numbers,
        labels,
    )  # fmt: skip
    rows = numbers[:count]
    return BeamEnds(
        np.ascontiguousarray(rows[:, 0:2]), np.ascontiguousarray(rows[:, 2:4]), np.ascontiguousarray(rows[:, 4:6]),
        rows[:, 6].copy(), rows[:, 7].copy(), labels[:count].copy(),
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _describe(
    ranges: Array, angle_min: float, increment: float, range_min: float, reach: float,
    surface: NDArray[np.int16], lines: Array, offset: float, sigma: float, rough: float, out: Array,
    labels: Indices,
) -> int:  # fmt: skip
    """Write a row a beam that ended on a surface: point, normal, point on the surface, variance, spacing."""
    n = ranges.shape[0]
    x, y = np.empty(n), np.empty(n)
    for i in range(n):
        angle = angle_min + i * increment
        x[i], y[i] = ranges[i] * math.cos(angle), ranges[i] * math.sin(angle)
    count = 0
    label, first_nx, first_ny, first_at, last_at = MAX_LINES - 1, 0.0, 0.0, 0, -9
    normal = np.empty(3)
    for i in range(n):
        r = ranges[i]
        if not (range_min <= r < reach and r > 0.0):
            continue
        row = out[count]
        k = surface[i]
        if k >= 0:
            line = lines[k]
            if i == int(line[FIRST]) or i == int(line[LAST]):
                continue
            nx, ny = line[NX], line[NY]
            e, c = nx * x[i] + ny * y[i] - line[R], (nx * x[i] + ny * y[i]) / r
            if abs(e) > 4.0 * sigma or c <= 0.0:
                continue
            row[2], row[3] = -nx, -ny
            row[4], row[5] = x[i] - e * nx + offset, y[i] - e * ny
            row[6] = sigma * sigma * max(c * c, GRAZING)
            labels[count] = k
        else:
            spread = _contour_normal(ranges, x, y, surface, i, increment, range_min, reach, normal)
            c = normal[2]
            if spread < 0.0 or c < _FLATTEST or spread > _BENT * (sigma * sigma * c * c + rough * rough):
                continue
            nx, ny = normal[0], normal[1]
            turned = nx * first_nx + ny * first_ny < _PIECE_COS
            far = math.hypot(x[i] - x[first_at], y[i] - y[first_at]) > _PIECE_M
            if i - last_at > 1 or i - first_at >= _PIECE_BEAMS or turned or far or label < MAX_LINES:
                label, first_nx, first_ny, first_at = label + 1, nx, ny, i
            last_at = i
            row[2], row[3] = nx, ny
            row[4], row[5] = x[i] + offset, y[i]
            row[6] = _SHARED * (sigma * sigma * c * c + spread + rough * rough)
            labels[count] = label
        row[0], row[1] = x[i] + offset, y[i]
        row[7] = r * increment / max(c, 0.05)
        count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _contour_normal(
    ranges: Array, x: Array, y: Array, surface: NDArray[np.int16], i: int, increment: float, range_min: float,
    reach: float, normal: Array,
) -> float:  # fmt: skip
    """Write a beam's normal (towards the sensor) and cosine of incidence; return the variance across, or -1."""
    n = ranges.shape[0]
    low = high = i
    for side in (-1, 1):
        at = i
        for _ in range(2):
            j = at + side
            if not (0 <= j < n) or surface[j] >= 0 or not (range_min <= ranges[j] < reach and ranges[j] > 0.0):
                break
            gap = math.hypot(x[j] - x[at], y[j] - y[at])
            if gap > max(0.06, 4.0 * min(ranges[j], ranges[at]) * increment):
                break
            at = j
        if side < 0:
            low = at
        else:
            high = at
    count = high - low + 1
    if count < 3:
        return -1.0
    mx = my = 0.0
    for j in range(low, high + 1):
        mx, my = mx + x[j] / count, my + y[j] / count
    xx = xy = yy = 0.0
    for j in range(low, high + 1):
        dx, dy = x[j] - mx, y[j] - my
        xx, xy, yy = xx + dx * dx, xy + dx * dy, yy + dy * dy
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    root = math.sqrt(half * half + xy * xy)
    least, most = max(mean - root, 0.0), mean + root
    if most <= 0.0 or least > 0.25 * most:
        return -1.0
    angle = 0.5 * math.atan2(2.0 * xy, xx - yy)  # of the contour
    nx, ny = -math.sin(angle), math.cos(angle)
    c = -(nx * x[i] + ny * y[i]) / ranges[i]
    if c < 0.0:
        nx, ny, c = -nx, -ny, -c
    normal[0], normal[1], normal[2] = nx, ny, c
    return least / count
