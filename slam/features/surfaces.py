"""Scan → straight surfaces: split and merge over the points, a line through each piece (kernels)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from slam.types import Array, Indices

MAX_LINES = 128
GRAZING = 0.003  # c² that beams along a surface count as at least: bearings are not as exact as that
_OUTLIER = 4.0  # σ along the beam by which a point may be off the line that it is fitted to
HIDDEN = 0.25  # 1σ of that shift; see :func:`_add_hidden`
_STEPS = 2  # of Gauss-Newton: the second takes its points by the line of the first
MAX_STEP = 4  # beams; neighbours farther apart than this, the ones between lost, are not joined

# The config as the kernels take it.
(
    SIGMA, SPLIT_SIGMAS, SPLIT_FLOOR, MIN_POINTS, MIN_LENGTH, SIN_MIN_ANGLE, MAX_GAP, FLOOR,
    EDGE_LENGTH, EDGE_JUMP, EDGE_SPACING, EDGE_POINTS, EDGE_FACE, EDGE_SIGMA, EDGE_FLOOR,
) = range(15)  # fmt: skip
# A fitted line: its normal, away from the sensor, and distance; the points' weighted centroid; the variances of
# offset (at the centroid) and slope, which are uncorrelated there; from where to where it reaches along (-ny, nx)
# from the centroid; its points; its first and last beam; which of its ends make a corner with a neighbour (bits 0
# and 1); its curvature, positive where it bends away from the sensor, and the variance of that.
(
    NX, NY, R, MX, MY, VAR_OFFSET, VAR_SLOPE, T0, T1, POINTS, FIRST, LAST, ENDS, CURVATURE, VAR_CURVATURE,
) = range(15)  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _breaks(r0: float, r1: float, step: int, gaps: Array, sigma: float) -> bool:
    """Tell whether two points ``step`` beams apart cannot lie on one surface (see ``_gap_table``)."""
    if step > MAX_STEP:
        return True
    limit = min(r0, r1) * gaps[step - 1, 0] + 4.0 * sigma
    # The law of cosines, by the difference of the ranges.
    distance_squared = (r0 - r1) * (r0 - r1) + r0 * r1 * gaps[step - 1, 1]
    return bool(limit < 0.0 or distance_squared > limit * limit)


@njit(cache=True, nogil=True, error_model="numpy")
def points_in_order(
    ranges: Array, rays: Array, increment: float, range_min: float, limits: Array, gaps: Array, xy: Array,
    reach: Array, beam: Indices, apart: Indices,
) -> int:  # fmt: skip
    """Write the points in order of bearing, starting after a break, so that no surface is cut at ±π.

    ``reach`` gets their ranges, ``apart`` whether a point and the next cannot lie on one surface. Returns the
    number of points.
    """
    n = ranges.shape[0]
    start = 0
    if n * increment > 2.0 * math.pi - 1.5 * increment:
        for i in range(n):
            r0, r1 = ranges[i - 1], ranges[i]
            if not (r0 < np.inf and r1 < np.inf):
                start = i
                if r0 == np.inf or r1 == np.inf:
                    break
            elif _breaks(r0, r1, 1, gaps, limits[SIGMA]):
                start = i
                break
    count = holes = 0
    for k in range(n):
        i = start + k
        if i >= n:
            i -= n
        r = ranges[i]
        if r >= range_min and r < np.inf:
            xy[count, 0] = r * rays[i, 0]
            xy[count, 1] = r * rays[i, 1]
            reach[count] = r
            beam[count] = i
            count += 1
        else:
            apart[n - 1 - holes] = count - 1  # the point before the hole: there is room, as there is a point less
            holes += 1
    _mark_breaks(reach, count, gaps, limits[SIGMA], apart, n, holes, beam)
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _mark_breaks(
    reach: Array, count: int, gaps: Array, sigma: float, apart: Indices, beams: int, holes: int, beam: Indices
) -> None:
    """Write :func:`_breaks` of each point and the next; after which points beams were lost, ``apart`` ends with.

    As though no beam had been lost first, in a loop that vectorises, then anew where some were.
    """
    share, cosine, slack = gaps[0, 0], gaps[0, 1], 4.0 * sigma
    for k in range(np.uint64(max(count - 1, 0))):
        r0, r1 = reach[k], reach[k + np.uint64(1)]
        limit = (r0 if r0 < r1 else r1) * share + slack
        distance_squared = (r0 - r1) * (r0 - r1) + r0 * r1 * cosine
        apart[k] = np.int64((limit < 0.0) | (distance_squared > limit * limit))
    for hole in range(holes):
        k = apart[beams - 1 - hole]
        if 0 <= k < count - 1:
            step = beam[k + 1] - beam[k]
            if step < 0:
                step += beams
            apart[k] = _breaks(reach[k], reach[k + 1], step, gaps, sigma)


@njit(cache=True, nogil=True, error_model="numpy")
def split(xy: Array, n: int, limits: Array, apart: Indices, stack: Indices, pieces: Indices) -> int:
    """Write the straight pieces (first, last, 1 where it goes on from the piece before); return their number.

    ``xy`` and ``apart`` are those of :func:`points_in_order`.
    """
    threshold = max(limits[SPLIT_SIGMAS] * limits[SIGMA], limits[SPLIT_FLOOR])
    count = 0
    begin = 0
    while begin < n:
        end = begin
        while end + 1 < n and apart[end] == 0:
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


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"nnan", "nsz"}, forceinline=True)
def _farthest(xy: Array, first: int, last: int, threshold: float) -> int:
    """Return the point farthest from the chord first–last if it is beyond the threshold, else -1."""
    if last - first < 2:
        return -1
    x0, y0 = xy[first, 0], xy[first, 1]
    dx, dy = xy[last, 0] - x0, xy[last, 1] - y0
    farthest, largest = -1, threshold * math.sqrt(dx * dx + dy * dy)
    # A branch, seldom taken and well foreseen: computing a maximum, each point would wait for the one before.
    # Unsigned, since other indices are tested for being negative.
    for i in range(np.uint64(first + 1), np.uint64(last)):
        distance = abs(dx * (xy[i, 1] - y0) - dy * (xy[i, 0] - x0))
        if distance > largest:
            farthest, largest = np.int64(i), distance  # type: ignore[assignment]
    return farthest


@njit(cache=True, nogil=True, error_model="numpy")
def _one_line(xy: Array, first: int, middle: int, last: int, threshold: float) -> bool:
    """Tell whether two pieces that share ``middle`` are one after all (the merge of split and merge)."""
    if last - first < 3 or middle - first < 2 or last - middle < 2:
        return False
    return _farthest(xy, first, last, 0.75 * threshold) < 0


@njit(cache=True, nogil=True, error_model="numpy")
def fit(xy: Array, first: int, last: int, limits: Array, line: Array) -> bool:
    """Fit a line to a piece; tell whether it is a surface.

    The caller writes the line's first and last beam, and which of its ends make a corner.
    """
    # The end points are shared with what comes before and after, and may lie on that.
    a, b = first + 1, last - 1
    if b - a + 3 < limits[MIN_POINTS] or b - a < 2:
        return False
    _line_through(xy, a, b, line)
    if not _is_straight(xy, a, b, limits, line):
        return False
    # So may the points beside them, which the splitting could not tell apart: all that are so near are left out.
    # With them a wall seemed turned towards its neighbour by more than its covariance allows.
    near = max(limits[SPLIT_SIGMAS] * limits[SIGMA], limits[SPLIT_FLOOR])
    while a < b and _is_within(near, xy, a, first):
        a += 1
    while a < b and _is_within(near, xy, b, last):
        b -= 1
    # The next is out of reach by its own noise, too: for it to count would make a bias of that.
    a, b = a + 1, b - 1
    n = 0
    for _ in range(_STEPS):
        n = _refine(xy, a, b, limits[SIGMA], line)
        if n < 3:
            return False
    t0 = -line[NY] * (xy[first, 0] - line[MX]) + line[NX] * (xy[first, 1] - line[MY])
    t1 = -line[NY] * (xy[last, 0] - line[MX]) + line[NX] * (xy[last, 1] - line[MY])
    line[T0], line[T1], line[POINTS] = t0, t1, n
    length = t1 - t0
    if length < limits[MIN_LENGTH]:
        return False
    _add_hidden(line, near)
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _add_hidden(line: Array, near: float) -> None:
    """Add to a line's variances what the splitting did not see.

    What departs by less than ``near`` [m] (a ledge, a chamfer, a neighbour's last points) was not told apart. If
    it is as long as it is high, it shifts the line the more, the shorter that is.
    """
    length = line[T1] - line[T0]
    hidden = HIDDEN * near * near / length
    line[VAR_OFFSET] += hidden * hidden
    line[VAR_SLOPE] += 12.0 * hidden * hidden / (length * length)


@njit(cache=True, nogil=True, error_model="numpy")
def _refine(xy: Array, a: int, b: int, sigma: float, line: Array) -> int:
    """Bring a line nearer to the maximum likelihood one of the points ``a`` … ``b``; return how many those are.

    Range noise acts along the beam. It moves a point along a wall seen at an angle as well as across it, and
    always both together: total least squares takes that for a turn of the wall, the more the shorter and the
    noisier. So a point is placed along the wall by its bearing alone, and counts by the cosine c of its incidence:
    across the wall its error has the variance σ² c². A Gauss-Newton step from the line as it is, with the points
    that may lie on it at all; at least three, else nothing is done.
    """
    nx, ny, r = line[NX], line[NY], line[R]
    mt = -ny * line[MX] + nx * line[MY]  # of the centroid, from the line's foot
    gate = (_OUTLIER * sigma) ** 2
    n = 0
    sw = st = stt = sttt = stttt = se = ste = stte = 0.0
    for i in range(a, b + 1):
        x, y = xy[i, 0], xy[i, 1]
        d = nx * x + ny * y
        t = r * (nx * y - ny * x) / d - mt  # where the beam meets the line
        square = x * x + y * y
        weight = square / (d * d + GRAZING * square)
        e = d - r
        if d <= 0.5 * r or e * e * weight > gate:
            continue
        n += 1
        wt, we = weight * t, weight * e
        wtt = wt * t
        sw += weight
        st += wt
        stt += wtt
        sttt += wtt * t
        stttt += wtt * t * t
        se += we
        ste += wt * e
        stte += wtt * e
    if n < 3:
        return n
    mean = st / sw
    spread = stt - mean * st
    ste -= mean * se  # about the centroid from here on
    slope = ste / spread
    # Turned by the slope about the weighted centroid, where offset and slope are uncorrelated.
    mt += mean
    offset = r + se / sw
    mx, my = offset * nx - mt * ny, offset * ny + mt * nx
    norm = 1.0 / math.sqrt(1.0 + slope * slope)
    nx, ny = norm * (nx + slope * ny), norm * (ny - slope * nx)
    line[NX], line[NY], line[R], line[MX], line[MY] = nx, ny, nx * mx + ny * my, mx, my
    line[VAR_OFFSET] = sigma * sigma / sw
    line[VAR_SLOPE] = sigma * sigma / spread
    # What a line leaves of t², q = t² − spread / sw − lean t, is what a curved surface's points depart along.
    lean = (sttt - mean * (3.0 * stt - 2.0 * mean * st)) / spread
    fourth = stttt - mean * (4.0 * sttt - mean * (6.0 * stt - 3.0 * mean * st))
    left = fourth - spread * (spread / sw + lean * lean)
    bulge = stte - mean * (2.0 * ste + mean * se) - spread / sw * se - lean * ste
    left = max(left, 1e-9 * stttt)  # three points in two places leave nothing
    line[CURVATURE], line[VAR_CURVATURE] = 2.0 * bulge / left, 4.0 * sigma * sigma / left
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _is_within(distance: float, xy: Array, i: int, j: int) -> bool:
    dx, dy = xy[i, 0] - xy[j, 0], xy[i, 1] - xy[j, 1]
    return bool(dx * dx + dy * dy < distance * distance)


@njit(cache=True, nogil=True, error_model="numpy")
def _line_through(xy: Array, a: int, b: int, line: Array) -> None:
    """Write normal, distance and centroid of the total least squares line of the points ``a`` … ``b``."""
    n = b - a + 1
    # Sums about the first point: about the origin they would lose digits.
    x0, y0 = xy[a, 0], xy[a, 1]
    sx = sy = sxx = sxy = syy = 0.0
    for i in range(a + 1, b + 1):
        dx, dy = xy[i, 0] - x0, xy[i, 1] - y0
        sx += dx
        sy += dy
        sxx += dx * dx
        sxy += dx * dy
        syy += dy * dy
    mx, my = x0 + sx / n, y0 + sy / n
    sxx, sxy, syy = sxx - sx * sx / n, sxy - sx * sy / n, syy - sy * sy / n
    angle = 0.5 * math.atan2(2.0 * sxy, sxx - syy)  # of the line itself
    nx, ny = -math.sin(angle), math.cos(angle)
    r = nx * mx + ny * my
    if r < 0.0:
        nx, ny, r = -nx, -ny, -r
    line[NX], line[NY], line[R], line[MX], line[MY] = nx, ny, r, mx, my


@njit(cache=True, nogil=True, error_model="numpy")
def _is_straight(xy: Array, a: int, b: int, limits: Array, line: Array) -> bool:
    """Tell whether the points ``a`` … ``b`` lie on their line, neither off it nor bulging away from it."""
    n, sigma = b - a + 1, limits[SIGMA]
    nx, ny, r, mx, my = line[NX], line[NY], line[R], line[MX], line[MY]
    spread = residual = off = curve = fourth = largest = 0.0
    for i in range(a, b + 1):
        x, y = xy[i, 0], xy[i, 1]
        t = -ny * (x - mx) + nx * (y - my)
        e, tt = nx * x + ny * y - r, t * t
        spread += tt
        residual += e * e
        off += e
        curve += tt * e
        fourth += tt * tt
        largest = max(largest, tt)
    if spread <= 0.0 or residual > n * (max(2.0 * sigma, 0.5 * limits[SPLIT_FLOOR])) ** 2:
        return False
    mean = spread / n
    return not _is_curved(curve - mean * off, fourth - mean * spread, largest, sigma)


@njit(cache=True, nogil=True, error_model="numpy")
def _is_curved(bulge: float, norm: float, largest: float, sigma: float) -> bool:
    """Tell whether points bulge away from their line by more than noise would have them do.

    Pieces of a round table are short enough to pass for straight ones, and would meet in corners that wander
    with the robot. With t the position along the line and q = t² − mean(t²), ``bulge`` is Σ q · (offset from the
    line) and ``norm`` Σ q²: the coefficient of q is their ratio. ``largest`` is max t².
    """
    if norm <= 0.0:
        return False
    coefficient, deviation = bulge / norm, sigma / math.sqrt(norm)
    # As a sagitta: what the curve departs by between the middle and the ends.
    return abs(coefficient) > 2.5 * deviation and abs(coefficient) * largest > 0.5 * sigma
