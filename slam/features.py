"""Scan → straight surfaces and the corners where they meet, each with a covariance from its fit.

Split and merge (iterative end-point fit) over the scan's points in order of bearing; every piece is fitted by
total least squares. A corner is where two fitted surfaces meet and the scan runs
through without a break, or where one ends in front of something farther away. The rim of a shadow is neither:
it moves with the robot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.settings import require
from slam.types import CONCAVE, CONVEX, Scan

__all__ = ["Corners", "FeatureConfig", "FeatureExtractor", "Lines"]

Array = NDArray[np.float64]

_MAX_LINES = 128
_MAX_STEP = 4  # beams; neighbours farther apart than this, the ones between lost, are not joined

# The config as the kernels take it.
(
    _SIGMA, _SPLIT_SIGMAS, _SPLIT_FLOOR, _MIN_POINTS, _MIN_LENGTH, _SIN_MIN_ANGLE, _MAX_GAP, _FLOOR,
    _EDGE_LENGTH, _EDGE_JUMP, _EDGE_SPACING, _EDGE_POINTS, _EDGE_FACE, _EDGE_SIGMA,
) = range(14)  # fmt: skip
# A fitted line: its normal, away from the sensor, and distance; the points' centroid; the variances of offset (at
# the centroid) and slope and their covariance; from where to where it reaches along (-ny, nx) from the centroid;
# its points; its first and last beam; which of its ends make a corner with a neighbour (bits 0 and 1).
(
    _NX, _NY, _R, _MX, _MY, _VAR_OFFSET, _VAR_SLOPE, _COV, _T0, _T1, _POINTS, _FIRST, _LAST, _ENDS,
) = range(14)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class FeatureConfig:
    """What counts as a straight surface and as a corner."""

    range_sigma_m: float = 0.01  # of one beam, along it
    split_sigmas: float = 4.0  # a piece is split where it departs from its chord by more than this
    split_floor_m: float = 0.02  # … and by more than this
    min_points: int = 6
    min_length_m: float = 0.25
    grazing_deg: float = 8.0  # flattest incidence at which neighbouring points still belong together
    min_angle_deg: float = 55.0  # between the surfaces of a corner; pieces of a round column meet at less
    max_gap_m: float = 0.12  # from the corner to the nearest point of either surface
    edge_length_m: float = 0.35  # of a surface whose visible end is taken for a corner
    edge_points: int = 8  # … and the points on it: fewer would let a piece of a round column pass for straight
    edge_face_m: float = 0.25  # thickest wall of which the end face may show
    # 1σ of a visible end along the surface, as a share of the beams' spacing there. A uniform error would have
    # 0.29, but it lasts while the robot stands.
    edge_sigma: float = 1.0
    edge_jump_m: float = 0.15  # how far beyond the surface the next beam must go
    edge_spacing_m: float = 0.2  # farthest apart that two beams may meet the surface there
    # 1σ of a corner along each axis that the model of straight walls leaves out. Over apartments of the training
    # seeds 0-15 it makes the average pose NEES/3 0.98; with 2 mm it is 0.63.
    sigma_floor_m: float = 0.001

    def __post_init__(self) -> None:
        require(self.range_sigma_m >= 0, "FeatureConfig.range_sigma_m must be ≥ 0")
        require(self.min_points >= 4, "FeatureConfig.min_points must be at least 4")
        require(0 < self.grazing_deg < 45, "FeatureConfig.grazing_deg must be in (0, 45)")
        require(5 <= self.min_angle_deg <= 85, "FeatureConfig.min_angle_deg must be in [5, 85]")
        require(self.sigma_floor_m > 0, "FeatureConfig.sigma_floor_m must be > 0")


@dataclass(frozen=True, slots=True)
class Corners:
    """Corner points of one scan, in the sensor frame."""

    range_bearing: Array  # (m, 2) range [m], bearing [rad]
    cov: Array  # (m, 2, 2) [m², m·rad, rad²]
    kind: NDArray[np.int8]  # (m,) CONVEX or CONCAVE
    direction: Array  # (m,) bearing of the bisector that points into free space [rad]


@dataclass(frozen=True, slots=True)
class Lines:
    """Straight surfaces of one scan, in the sensor frame, in order of bearing."""

    hesse: Array  # (k, 2) α [rad], r [m]: the points with x cos α + y sin α = r, r ≥ 0
    ends: Array  # (k, 4) x1, y1, x2, y2: feet of the first and last point on the line [m]
    points: NDArray[np.int64]  # (k,) number of points fitted


class FeatureExtractor:
    """Extracts corners and lines from scans; holds the buffers, so that no scan allocates in the kernel.

    After :meth:`extract`, ``surface`` ``(beams,)`` holds for each beam the index of the line that it ended on,
    or -1.
    """

    def __init__(self, config: FeatureConfig | None = None) -> None:
        self.config = config or FeatureConfig()
        self.surface = np.zeros(0, np.int16)
        self._angles = np.zeros(0)
        self._scan_of: tuple[int, float, float] = (0, 0.0, 0.0)
        self._lines = np.zeros((_MAX_LINES, 14))
        self._corners = np.zeros((3 * _MAX_LINES, 8))
        self._line_count = 0
        self._corner_count = 0
        c = self.config
        self._limits = np.array([
            c.range_sigma_m, c.split_sigmas, c.split_floor_m, c.min_points, c.min_length_m,
            math.sin(math.radians(c.min_angle_deg)), c.max_gap_m, c.sigma_floor_m, c.edge_length_m, c.edge_jump_m,
            c.edge_spacing_m, c.edge_points, c.edge_face_m, c.edge_sigma,
        ])  # fmt: skip

    def extract(self, scan: Scan) -> NDArray[np.float64]:
        """Return the corners as rows of ``(m, 8)`` (a view, until the next call).

        Columns: range, bearing, then the covariance's three distinct terms, kind, direction, and 1 for the visible
        end of a surface, 0 for a meeting of two.
        :meth:`corners` and :meth:`lines` give the same as named arrays.
        """
        n = len(scan.ranges)
        key = (n, scan.angle_min, scan.angle_increment)
        if key != self._scan_of:
            angles = scan.angle_min + scan.angle_increment * np.arange(n)
            self._angles = np.column_stack([np.cos(angles), np.sin(angles)])
            self._xy = np.zeros((n, 2))
            self._beam = np.zeros(n, np.int64)
            self._stack = np.zeros((n + 2, 2), np.int64)
            self._pieces = np.zeros((n + 2, 3), np.int64)
            self.surface = np.zeros(n, np.int16)
            self._gaps = self._gap_table(scan.angle_increment)
            self._scan_of = key
        self._line_count, self._corner_count = _extract(
            scan.ranges, self._angles, scan.angle_increment, scan.range_min, scan.range_max, self._limits,
            self._gaps, self._xy, self._beam, self._stack, self._pieces, self.surface, self._lines, self._corners,
        )  # fmt: skip
        return self._corners[: self._corner_count]

    def _gap_table(self, increment: float) -> Array:
        """Return, for neighbours 1, 2, … beams apart: how far apart they may be, and 2 − 2 cos of the angle.

        The adaptive breakpoint of Borges and Aldon (2004): a surface at the flattest incidence that is still
        accepted would put the next point at most sin Δ / sin(λ − Δ) times the nearer range away.
        """
        angles = increment * np.arange(1, _MAX_STEP + 1)
        rest = math.radians(self.config.grazing_deg) - angles
        # Neighbours as far apart as the flattest incidence never belong together: nothing is that near.
        share = np.where(rest > 0, np.sin(angles) / np.sin(np.maximum(rest, 1e-6)), -np.inf)
        return np.column_stack([share, 2.0 - 2.0 * np.cos(angles)])

    def corners(self) -> Corners:
        """Return the corners of the last scan as named arrays."""
        rows = self._corners[: self._corner_count].copy()
        cov = np.empty((len(rows), 2, 2))
        cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 0], cov[:, 1, 1] = (
            rows[:, 2],
            rows[:, 3],
            rows[:, 3],
            rows[:, 4],
        )
        return Corners(rows[:, :2], cov, rows[:, 5].astype(np.int8), rows[:, 6])

    def lines(self) -> Lines:
        """Return the straight surfaces of the last scan as named arrays."""
        rows = self._lines[: self._line_count]
        nx, ny, r = rows[:, 0], rows[:, 1], rows[:, 2]
        hesse = np.column_stack([np.arctan2(ny, nx), r])
        # A point of the line at distance t along its direction from the centroid.
        centre, t0, t1 = rows[:, 3:5], rows[:, 8:9], rows[:, 9:10]
        along = np.column_stack([-ny, nx])
        ends = np.hstack([centre + t0 * along, centre + t1 * along])
        return Lines(hesse, ends, rows[:, 10].astype(np.int64))


@njit(cache=True, nogil=True, error_model="numpy")
def _extract(
    ranges: Array, rays: Array, increment: float, range_min: float, range_max: float, limits: Array,
    gaps: Array, xy: Array,
    beam: NDArray[np.int64], stack: NDArray[np.int64], pieces: NDArray[np.int64], surface: NDArray[np.int16],
    lines: Array, corners: Array,
) -> tuple[int, int]:  # fmt: skip
    surface[:] = -1
    n = _points_in_order(ranges, rays, increment, range_min, limits, gaps, xy, beam)
    pieces_count = _split(xy, beam, n, ranges, limits, gaps, stack, pieces)
    line_count = 0
    last_line = -1  # the surface that the scan has run on from without a break, else -1
    last_end = 0  # … and its last point
    corner_count = 0
    for k in range(pieces_count):
        first, last = pieces[k, 0], pieces[k, 1]
        if pieces[k, 2] == 0:
            last_line = -1
        if line_count == _MAX_LINES or not _fit(xy, first, last, limits, lines[line_count]):
            continue
        line = lines[line_count]
        line[_FIRST], line[_LAST] = beam[first], beam[last]
        line[_ENDS] = 0.0
        for i in range(first, last + 1):
            surface[beam[i]] = line_count
        # Noise near a corner may leave a sliver between its two surfaces; its points must lie on either.
        if last_line >= 0 and _all_on(xy, last_end, first, lines[last_line], line, limits):
            met = _meet(lines[last_line], line, increment, limits, corners[corner_count])
            corner_count += met
            lines[last_line, _ENDS] += 2.0 * met
            line[_ENDS] += met
        last_line, last_end = line_count, last
        line_count += 1
    for k in range(line_count):
        for side in range(2):
            # This end may already make a corner with the neighbouring surface.
            if int(lines[k, _ENDS]) & (1 << side) == 0:
                corner_count += _edge(
                    lines[k], side, ranges, rays, increment, range_max, limits, corners[corner_count]
                )
    return line_count, corner_count


@njit(cache=True, nogil=True, error_model="numpy")
def _breaks(r0: float, r1: float, step: int, gaps: Array, sigma: float) -> bool:
    """Tell whether two points ``step`` beams apart cannot lie on one surface (see ``_gap_table``)."""
    if step > _MAX_STEP:
        return True
    limit = min(r0, r1) * gaps[step - 1, 0] + 4.0 * sigma
    # The law of cosines, by the difference of the ranges.
    distance_squared = (r0 - r1) * (r0 - r1) + r0 * r1 * gaps[step - 1, 1]
    return bool(limit < 0.0 or distance_squared > limit * limit)


@njit(cache=True, nogil=True, error_model="numpy")
def _points_in_order(
    ranges: Array, rays: Array, increment: float, range_min: float, limits: Array, gaps: Array, xy: Array,
    beam: NDArray[np.int64],
) -> int:  # fmt: skip
    """Write the points in order of bearing, starting after a break, so that no surface is cut at ±π."""
    n = ranges.shape[0]
    start = 0
    if n * increment > 2.0 * math.pi - 1.5 * increment:
        for i in range(n):
            r0, r1 = ranges[i - 1], ranges[i]
            if not (r0 < np.inf and r1 < np.inf):
                start = i
                if r0 == np.inf or r1 == np.inf:
                    break
            elif _breaks(r0, r1, 1, gaps, limits[_SIGMA]):
                start = i
                break
    count = 0
    for k in range(n):
        i = start + k
        if i >= n:
            i -= n
        r = ranges[i]
        if r >= range_min and r < np.inf:
            xy[count, 0] = r * rays[i, 0]
            xy[count, 1] = r * rays[i, 1]
            beam[count] = i
            count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _split(
    xy: Array, beam: NDArray[np.int64], n: int, ranges: Array, limits: Array, gaps: Array,
    stack: NDArray[np.int64], pieces: NDArray[np.int64],
) -> int:  # fmt: skip
    """Write the straight pieces (first, last, 1 where it goes on from the piece before); return their number."""
    threshold = max(limits[_SPLIT_SIGMAS] * limits[_SIGMA], limits[_SPLIT_FLOOR])
    beams = ranges.shape[0]
    count = 0
    begin = 0
    while begin < n:
        end = begin
        while end + 1 < n:
            step = beam[end + 1] - beam[end]
            if step < 0:
                step += beams
            if _breaks(ranges[beam[end]], ranges[beam[end + 1]], step, gaps, limits[_SIGMA]):
                break
            end += 1
        depth = 0
        stack[0, 0], stack[0, 1] = begin, end
        depth = 1
        goes_on = 0
        while depth > 0:
            depth -= 1
            first, last = stack[depth, 0], stack[depth, 1]
            middle = _farthest(xy, first, last, threshold)
            if middle > 0:
                # Depth first, left part on top: the pieces come out in order.
                stack[depth, 0], stack[depth, 1] = middle, last
                stack[depth + 1, 0], stack[depth + 1, 1] = first, middle
                depth += 2
                continue
            if goes_on == 1 and _one_line(xy, pieces[count - 1, 0], first, last, threshold):
                pieces[count - 1, 1] = last
            else:
                pieces[count, 0], pieces[count, 1], pieces[count, 2] = first, last, goes_on
                count += 1
            goes_on = 1
        begin = end + 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _farthest(xy: Array, first: int, last: int, threshold: float) -> int:
    """Return the point farthest from the chord first–last if it is beyond the threshold, else -1."""
    x0, y0 = xy[first, 0], xy[first, 1]
    dx, dy = xy[last, 0] - x0, xy[last, 1] - y0
    length = math.sqrt(dx * dx + dy * dy)
    best, where = threshold * length, -1
    for i in range(first + 1, last):
        d = abs(dx * (xy[i, 1] - y0) - dy * (xy[i, 0] - x0))
        if d > best:
            best, where = d, i
    return where


@njit(cache=True, nogil=True, error_model="numpy")
def _one_line(xy: Array, first: int, middle: int, last: int, threshold: float) -> bool:
    """Tell whether two pieces that share ``middle`` are one after all (the merge of split and merge)."""
    if last - first < 3 or middle - first < 2 or last - middle < 2:
        return False
    return _farthest(xy, first, last, 0.75 * threshold) < 0


@njit(cache=True, nogil=True, error_model="numpy")
def _fit(xy: Array, first: int, last: int, limits: Array, line: Array) -> bool:
    """Fit a line to a piece by total least squares; tell whether it is a surface.

    ``line``: normal (2), distance r, centroid (2), then the variance of the offset at the centroid, of the
    slope, and their covariance, the extent along the line from the centroid (2), the number of points; then
    (by the caller) the first and last beam, and which ends make a corner.
    """
    # The end points are shared with what comes before and after, and may lie on that: the fit leaves them out.
    a, b = first + 1, last - 1
    n = b - a + 1
    if n + 2 < limits[_MIN_POINTS] or n < 3:
        return False
    mx = my = 0.0
    for i in range(a, b + 1):
        mx += xy[i, 0]
        my += xy[i, 1]
    mx /= n
    my /= n
    sxx = sxy = syy = 0.0
    for i in range(a, b + 1):
        dx, dy = xy[i, 0] - mx, xy[i, 1] - my
        sxx += dx * dx
        sxy += dx * dy
        syy += dy * dy
    angle = 0.5 * math.atan2(2.0 * sxy, sxx - syy)  # of the line itself
    tx, ty = math.cos(angle), math.sin(angle)
    nx, ny = -ty, tx
    r = nx * mx + ny * my
    if r < 0.0:
        nx, ny, r = -nx, -ny, -r
        tx, ty = -tx, -ty
    # Range noise acts along the beam: across the line it counts by the cosine of the incidence.
    sigma = limits[_SIGMA]
    var_offset = var_slope = cov = spread = residual = 0.0
    for i in range(a, b + 1):
        x, y = xy[i, 0], xy[i, 1]
        t = tx * (x - mx) + ty * (y - my)
        d = nx * x + ny * y
        across = sigma * d / math.sqrt(x * x + y * y)
        variance = across * across
        var_offset += variance
        var_slope += t * t * variance
        cov += t * variance
        spread += t * t
        residual += (d - r) * (d - r)
    if spread <= 0.0 or residual > n * (max(2.0 * sigma, 0.5 * limits[_SPLIT_FLOOR])) ** 2:
        return False
    line[_NX], line[_NY], line[_R], line[_MX], line[_MY] = nx, ny, r, mx, my
    line[_VAR_OFFSET] = var_offset / (n * n)
    line[_VAR_SLOPE] = var_slope / (spread * spread)
    line[_COV] = cov / (n * spread)
    if _is_curved(xy, a, b, line, sigma):
        return False
    # Along (-ny, nx), which is (tx, ty) up to sign.
    ax, ay = -ny, nx
    t0 = ax * (xy[first, 0] - mx) + ay * (xy[first, 1] - my)
    t1 = ax * (xy[last, 0] - mx) + ay * (xy[last, 1] - my)
    line[_T0], line[_T1], line[_POINTS] = t0, t1, n
    if ax * tx + ay * ty < 0.0:
        line[_COV] = -line[_COV]
    return bool(abs(t1 - t0) >= limits[_MIN_LENGTH])


@njit(cache=True, nogil=True, error_model="numpy")
def _is_curved(xy: Array, a: int, b: int, line: Array, sigma: float) -> bool:
    """Tell whether points bulge away from their line by more than noise would have them do.

    Pieces of a round table are short enough to pass for straight ones, and would meet in corners that wander
    with the robot. The bulge is the coefficient of u² − mean(u²), u the position along the line.
    """
    nx, ny, r, mx, my = line[_NX], line[_NY], line[_R], line[_MX], line[_MY]
    n = b - a + 1
    mean = 0.0
    for i in range(a, b + 1):
        t = -ny * (xy[i, 0] - mx) + nx * (xy[i, 1] - my)
        mean += t * t
    mean /= n
    bulge = norm = largest = 0.0
    for i in range(a, b + 1):
        t = -ny * (xy[i, 0] - mx) + nx * (xy[i, 1] - my)
        q = t * t - mean
        bulge += q * (nx * xy[i, 0] + ny * xy[i, 1] - r)
        norm += q * q
        largest = max(largest, t * t)
    if norm <= 0.0:
        return False
    coefficient, deviation = bulge / norm, sigma / math.sqrt(norm)
    # As a sagitta: what the curve departs by between the middle and the ends.
    return abs(coefficient) > 2.5 * deviation and abs(coefficient) * largest > 0.5 * sigma


@njit(cache=True, nogil=True, error_model="numpy")
def _all_on(xy: Array, first: int, last: int, one: Array, two: Array, limits: Array) -> bool:
    """Tell whether every point from ``first`` to ``last`` lies on one of two lines."""
    near = max(limits[_SPLIT_SIGMAS] * limits[_SIGMA], limits[_SPLIT_FLOOR])
    for i in range(first, last + 1):
        off_one = abs(one[_NX] * xy[i, 0] + one[_NY] * xy[i, 1] - one[_R])
        off_two = abs(two[_NX] * xy[i, 0] + two[_NY] * xy[i, 1] - two[_R])
        if min(off_one, off_two) > near:
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _meet(one: Array, two: Array, increment: float, limits: Array, corner: Array) -> int:
    """Write the corner of two surfaces that follow each other in the scan; return 1 if there is one."""
    cross = one[_NX] * two[_NY] - one[_NY] * two[_NX]
    if abs(cross) < limits[_SIN_MIN_ANGLE]:
        return 0
    x = (one[_R] * two[_NY] - two[_R] * one[_NY]) / cross
    y = (two[_R] * one[_NX] - one[_R] * two[_NX]) / cross
    s1 = -one[_NY] * (x - one[_MX]) + one[_NX] * (y - one[_MY])
    s2 = -two[_NY] * (x - two[_MX]) + two[_NX] * (y - two[_MY])
    # The corner must lie where one surface ends and the other begins, up to the beams' own spacing.
    rho = math.sqrt(x * x + y * y)
    gap = limits[_MAX_GAP] + 4.0 * rho * increment
    if abs(s1 - one[_T1]) > gap or abs(s2 - two[_T0]) > gap:
        return 0
    # Each line's offset at the corner: n·p = r there, with this variance.
    v1 = one[_VAR_OFFSET] + 2.0 * s1 * one[_COV] + s1 * s1 * one[_VAR_SLOPE]
    v2 = two[_VAR_OFFSET] + 2.0 * s2 * two[_COV] + s2 * s2 * two[_VAR_SLOPE]
    # p = N⁻¹ (r1, r2)  ⇒  cov p = N⁻¹ diag(v1, v2) N⁻ᵀ
    a, b = two[_NY] / cross, -one[_NY] / cross
    c, d = -two[_NX] / cross, one[_NX] / cross
    floor = limits[_FLOOR] ** 2
    cxx = a * a * v1 + b * b * v2 + floor
    cxy = a * c * v1 + b * d * v2
    cyy = c * c * v1 + d * d * v2 + floor
    # Unit vectors from the corner along both surfaces.
    f = math.copysign(1.0, -s1)
    g = math.copysign(1.0, -s2)
    ax, ay = -one[_NY] * f, one[_NX] * f
    bx, by = -two[_NY] * g, two[_NX] * g
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
def _edge(
    line: Array, side: int, ranges: Array, rays: Array, increment: float, range_max: float, limits: Array,
    corner: Array,
) -> int:  # fmt: skip
    """Write the corner at which a surface ends in front of something farther away; return 1 if there is one.

    Where the next beam would still meet the surface's line but passes it, the surface ends: between the two
    beams, uniformly. A short end face may show in between (a wall is as thick as that), all of it behind the
    line; hidden or not, it is taken to recede at a right angle. (Where a beam stops short of the line, something
    nearer hides the surface: the rim of a shadow, no landmark.)
    """
    if line[_T1] - line[_T0] < limits[_EDGE_LENGTH] or line[_POINTS] < limits[_EDGE_POINTS]:
        return 0
    n = ranges.shape[0]
    step = 1 if side == 1 else -1
    index = int(line[_LAST]) if side == 1 else int(line[_FIRST])
    full = n * increment > 2.0 * math.pi - 1.5 * increment
    end = line[_T1] if side == 1 else line[_T0]
    t = missed = 0.0
    faces = 0
    while True:
        index += step
        if index < 0 or index >= n:
            if not full:
                return 0
            index %= n
        reach = ranges[index]
        if math.isnan(reach):
            continue
        across = line[_NX] * rays[index, 0] + line[_NY] * rays[index, 1]
        if across < 0.05:
            return 0
        missed = line[_R] / across  # range at which the beam would meet the line
        if missed > range_max - 0.1 or reach < missed - limits[_SPLIT_SIGMAS] * limits[_SIGMA]:
            return 0
        if faces == 0:
            t = -line[_NY] * (missed * rays[index, 0] - line[_MX]) + line[_NX] * (
                missed * rays[index, 1] - line[_MY]
            )
        if reach > missed + limits[_EDGE_JUMP]:
            px, py = reach * rays[index, 0], reach * rays[index, 1]
            depth = line[_NX] * px + line[_NY] * py - line[_R]
            beyond = (-line[_NY] * (px - line[_MX]) + line[_NX] * (py - line[_MY]) - end) * step
            if not (depth < limits[_EDGE_FACE] and -limits[_EDGE_FACE] < beyond < limits[_EDGE_FACE]):
                break  # past the end face, or there is none to see
        else:
            px, py = reach * rays[index, 0], reach * rays[index, 1]
            beyond = (-line[_NY] * (px - line[_MX]) + line[_NX] * (py - line[_MY]) - end) * step
            if beyond > limits[_EDGE_FACE]:
                return 0  # the surface goes on, a little off the line
        faces += 1
        if faces > 40:
            return 0
    spacing = abs(t - end)
    if spacing > limits[_EDGE_SPACING] or (t - end) * step < 0.0:
        return 0
    s = 0.5 * (t + end)
    x, y = line[_MX] - line[_NY] * s, line[_MY] + line[_NX] * s
    # A uniform error of the beams' spacing, with some more since it lasts while the robot stands still.
    # An end face that shows may be bevelled: its first points still pass for the surface's.
    along = (
        (limits[_EDGE_SIGMA] * spacing) ** 2
        + limits[_FLOOR] ** 2
        + (4.0 * limits[_SIGMA] ** 2 if faces > 0 else 0.0)
    )
    off = line[_VAR_OFFSET] + 2.0 * s * line[_COV] + s * s * line[_VAR_SLOPE] + limits[_FLOOR] ** 2
    nx, ny, ax, ay = line[_NX], line[_NY], -line[_NY], line[_NX]
    direction = math.atan2(step * ay - ny, step * ax - nx)
    _to_polar(
        x, y, along * ax * ax + off * nx * nx, along * ax * ay + off * nx * ny, along * ay * ay + off * ny * ny,
        CONVEX, direction, 1, corner,
    )  # fmt: skip
    return 1
