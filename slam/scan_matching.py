"""Scan matching: where a scan fits a map of surfaces best, and how well that is known.

The map is a likelihood field: every cell holds exp(-d²/2s²), d the distance to the nearest surface point. A match
first searches a bounded window over x, y and θ exhaustively (Olson 2009, "Real-time correlative scan matching": a
coarse table of maxima bounds blocks of poses, so that few are looked at closely), then climbs to the top between
the cells (Gauss-Newton on the interpolated field, as Kohlbrecher et al. 2011, "A flexible and scalable SLAM
system with full 3D motion estimation"; by a quadratic spline, since between two cells the same distance from a
wall a bilinear field is flat, and says nothing of where between them the wall is). Each beam counts by Welsch's
robust loss, so what the map does not know yet, people and lost beams pull little or not at all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.geometry import wrap_scalar
from slam.settings import require
from slam.types import Scan

__all__ = ["LikelihoodField", "Match", "MatchConfig", "body_points", "match", "refine", "search", "stamps_of"]

Array = NDArray[np.float64]
Values = NDArray[np.float32]

_PHASES = 8  # sub-cell positions a side at which a surface point is drawn
_BLOCK = 4  # shifts a side that one bound of the search stands for
_FLAT_INFO = 1e-3  # [1/m², 1/rad²] added so that a featureless scan still has a (very wide) covariance


@dataclass(frozen=True, kw_only=True)
class MatchConfig:
    """The field, the window of the search, and how much a beam is believed."""

    cell_m: float = 0.05
    smooth_m: float = 0.1  # s: reach of a surface in the field
    window_m: float = 0.3  # the search goes as far as this to either side …
    window_rad: float = 0.25
    step_rad: float = 0.0125  # … in steps of one cell and of this
    sigma_m: float = 0.03  # of a beam's end against the map: range noise and the map's own error
    # A scan's beams err together (edges of cells, bent walls, a moving robot): each counts as this part of one.
    beam_weight: float = 0.2
    beams: int = 180  # used at most, evenly thinned
    reach_m: float = 20.0  # beams that end farther are not used
    iterations: int = 12

    def __post_init__(self) -> None:
        for name in ("cell_m", "smooth_m", "step_rad", "sigma_m", "beam_weight", "reach_m"):
            require(getattr(self, name) > 0, f"MatchConfig.{name} must be > 0")
        require(self.smooth_m >= self.cell_m, "MatchConfig.smooth_m must be at least MatchConfig.cell_m")
        require(self.window_m >= 0 and self.window_rad >= 0, "MatchConfig.window_* must be ≥ 0")
        require(self.beams >= 1 and self.iterations >= 1, "MatchConfig.beams and iterations must be at least 1")

    @property
    def gain(self) -> float:
        """What a beam's field value is worth in nat: 1 - L ≈ d²/2s², and a Gaussian's exponent is d²/2σ²."""
        return self.beam_weight * (self.smooth_m / self.sigma_m) ** 2


@dataclass(frozen=True, slots=True)
class Match:
    """Where a scan fits best."""

    pose: Array  # (3,) x [m], y [m], θ [rad] in the field's frame
    cov: Array  # (3, 3) from the curvature there, prior included
    score: float  # mean field value over the beams: 1 where every beam ends on a surface
    log_likelihood: float  # [nat] relative to a perfect fit, prior not included


class LikelihoodField:
    """A window of the plane whose cells hold exp(-d²/2s²), d the distance to the nearest surface point.

    Attributes
    ----------
    values : NDArray[np.float32]
        ``(rows, cols)`` in [0, 1]; rows run along y.
    x0, y0 : float
        Centre of cell (0, 0) [m].
    """

    def __init__(self, config: MatchConfig, low: tuple[float, float], high: tuple[float, float]) -> None:
        """Make an empty field over the box from ``low`` to ``high`` [m]."""
        cell = config.cell_m
        self.cell_m, self.stamps = cell, stamps_of(config)
        col, row = math.floor(low[0] / cell), math.floor(low[1] / cell)
        shape = (math.floor(high[1] / cell) - row + 1, math.floor(high[0] / cell) - col + 1)
        self.x0, self.y0 = (col + 0.5) * cell, (row + 0.5) * cell
        self.values = np.zeros(shape, np.float32)
        self._bounds: Values | None = None

    @classmethod
    def of_points(cls, config: MatchConfig, points: Array, *, margin_m: float = 1.0) -> LikelihoodField:
        """Draw surface points ``(n, 2)`` [m] into a field that encloses them with a margin."""
        if not len(points):
            return cls(config, (0.0, 0.0), (0.0, 0.0))
        low, high = points.min(axis=0) - margin_m, points.max(axis=0) + margin_m
        field = cls(config, (float(low[0]), float(low[1])), (float(high[0]), float(high[1])))
        field.add(points)
        return field

    def add(self, points: Array) -> None:
        """Draw surface points ``(n, 2)`` [m]; what lies outside is left out."""
        splat(self.values, self.x0, self.y0, self.cell_m, self.stamps, np.asarray(points, dtype=np.float64))
        self._bounds = None

    @property
    def bounds(self) -> Values:
        """Cell (r, c): the largest value of the block of 4 × 4 cells that begins there."""
        if self._bounds is None:
            kernel = np.ones((_BLOCK, _BLOCK), np.uint8)
            self._bounds = np.asarray(
                cv2.dilate(self.values, kernel, anchor=(0, 0), borderType=cv2.BORDER_CONSTANT, borderValue=0.0),
                np.float32,
            )
        return self._bounds


_STAMPS: dict[tuple[float, float], Values] = {}


def stamps_of(config: MatchConfig) -> Values:
    """Return what a surface point looks like in the cells around it, ``(phases, phases, size, size)``."""
    key = (config.cell_m, config.smooth_m)
    if key not in _STAMPS:
        half = math.ceil(2.5 * config.smooth_m / config.cell_m)
        offset = np.arange(-half, half + 1) * config.cell_m
        phase = ((np.arange(_PHASES) + 0.5) / _PHASES - 0.5) * config.cell_m
        d2 = (offset[None, :] - phase[:, None]) ** 2  # (phases, size)
        distance2 = d2[:, None, :, None] + d2[None, :, None, :]
        _STAMPS[key] = np.exp(-0.5 * distance2 / config.smooth_m**2).astype(np.float32)
    return _STAMPS[key]


def body_points(scan: Scan, config: MatchConfig, *, offset_m: float = 0.0) -> Array:
    """Return where beams ended ``(n, 2)`` [m] in the body frame, the sensor ``offset_m`` ahead of its centre.

    Lost beams (``nan``), those without return (``inf``, or at ``range_max``), those below ``range_min`` and those
    beyond ``reach_m`` are left out; if more are left than ``beams``, evenly spaced ones are taken.
    """
    ranges = np.asarray(scan.ranges, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        good = (ranges < min(scan.range_max, config.reach_m)) & (ranges >= scan.range_min) & (ranges > 0.0)
    index = np.flatnonzero(good)
    if len(index) > config.beams:
        index = index[(np.arange(config.beams) * len(index)) // config.beams]
    angle = scan.angle_min + scan.angle_increment * index
    r = ranges[index]
    return np.column_stack([offset_m + r * np.cos(angle), r * np.sin(angle)])


def match(
    field: LikelihoodField, points: Array, guess: Array, config: MatchConfig, *, prior_info: Array | None = None,
) -> Match:  # fmt: skip
    """Search the window around ``guess`` ``(3,)``, then refine; ``points`` ``(n, 2)`` are in the body frame.

    ``prior_info`` ``(3, 3)`` is the information of the guess itself, none where it is left out.
    """
    return refine(field, points, search(field, points, guess, config, prior_info=prior_info), config,
                  prior=guess, prior_info=prior_info)  # fmt: skip


def search(
    field: LikelihoodField, points: Array, guess: Array, config: MatchConfig, *, prior_info: Array | None = None,
) -> Array:  # fmt: skip
    """Return the best pose ``(3,)`` of the window, to a cell and ``step_rad``: exhaustive, by bounds (Olson)."""
    info = np.zeros((3, 3)) if prior_info is None else np.asarray(prior_info, dtype=np.float64)
    shifts = math.ceil(config.window_m / config.cell_m)
    turns = math.ceil(config.window_rad / config.step_rad)
    return correlate(
        field.values, field.bounds, field.x0, field.y0, field.cell_m, points, np.asarray(guess, dtype=np.float64),
        shifts, turns, config.step_rad, config.gain, info,
    )  # fmt: skip


def refine(
    field: LikelihoodField, points: Array, guess: Array, config: MatchConfig, *, prior: Array | None = None,
    prior_info: Array | None = None,
) -> Match:  # fmt: skip
    """Climb from ``guess`` ``(3,)`` to the nearest best fit; a prior pose with its information pulls along."""
    pose = np.array(guess, dtype=np.float64)
    info = np.zeros((3, 3)) if prior_info is None else np.array(prior_info, dtype=np.float64)
    mean = pose.copy() if prior is None else np.asarray(prior, dtype=np.float64)
    curvature = np.zeros((3, 3))
    total = climb(
        field.values, field.x0, field.y0, field.cell_m, points, pose, mean, info, config.gain,
        config.iterations, curvature,
    )  # fmt: skip
    cov = np.linalg.inv(curvature + np.eye(3) * _FLAT_INFO)
    n = len(points)
    return Match(pose, 0.5 * (cov + cov.T), total / n if n else 0.0, config.gain * (total - n))


@njit(cache=True, nogil=True, error_model="numpy")
def splat(values: Values, x0: float, y0: float, cell: float, stamps: Values, points: Array) -> None:
    """Raise the cells around each point ``(n, 2)`` to what a surface there gives them."""
    phases, half = stamps.shape[0], stamps.shape[2] // 2
    rows, cols = values.shape
    for k in range(points.shape[0]):
        u, v = (points[k, 0] - x0) / cell + 0.5, (points[k, 1] - y0) / cell + 0.5
        col, row = math.floor(u), math.floor(v)
        if not (-half <= col < cols + half and -half <= row < rows + half):
            continue
        stamp = stamps[int((v - row) * phases), int((u - col) * phases)]
        for i in range(max(row - half, 0), min(row + half + 1, rows)):
            line, out = stamp[i - row + half], values[i]
            for j in range(max(col - half, 0), min(col + half + 1, cols)):
                out[j] = max(out[j], line[j - col + half])


@njit(cache=True, nogil=True, error_model="numpy")
def correlate(
    values: Values, bounds: Values, x0: float, y0: float, cell: float, points: Array, guess: Array, shifts: int,
    turns: int, step: float, gain: float, info: Array,
) -> Array:  # fmt: skip
    """Return the pose with the highest sum of field values (times ``gain``, less the prior's loss)."""
    n, rows, cols = points.shape[0], values.shape[0], values.shape[1]
    angles, blocks = 2 * turns + 1, (2 * shifts + 1 + _BLOCK - 1) // _BLOCK
    row, col = np.empty((angles, n), np.int64), np.empty((angles, n), np.int64)
    upper = np.empty(angles * blocks * blocks)
    for a in range(angles):
        theta = guess[2] + (a - turns) * step
        c, s = math.cos(theta), math.sin(theta)
        for k in range(n):
            x = guess[0] + c * points[k, 0] - s * points[k, 1]
            y = guess[1] + s * points[k, 0] + c * points[k, 1]
            col[a, k] = math.floor((x - x0) / cell + 0.5) - shifts
            row[a, k] = math.floor((y - y0) / cell + 0.5) - shifts
        for i in range(blocks):
            for j in range(blocks):
                total = 0.0
                for k in range(n):
                    r, q = row[a, k] + i * _BLOCK, col[a, k] + j * _BLOCK
                    if 0 <= r < rows and 0 <= q < cols:
                        total += bounds[r, q]
                    elif -_BLOCK < r < rows and -_BLOCK < q < cols:  # the block reaches into the field
                        total += bounds[max(r, 0), max(q, 0)]
                upper[(a * blocks + i) * blocks + j] = gain * total
    best, found = 0.0, guess.copy()  # the guess itself, which no tie shall beat
    for k in range(n):
        r, q = row[turns, k] + shifts, col[turns, k] + shifts
        if 0 <= r < rows and 0 <= q < cols:
            best += gain * values[r, q]
    for index in np.argsort(-upper, kind="mergesort"):
        if upper[index] <= best:
            break  # every other block's bound is lower still; a prior only lowers
        a, i, j = index // (blocks * blocks), (index // blocks) % blocks, index % blocks
        for di in range(i * _BLOCK, min((i + 1) * _BLOCK, 2 * shifts + 1)):
            for dj in range(j * _BLOCK, min((j + 1) * _BLOCK, 2 * shifts + 1)):
                total = 0.0
                for k in range(n):
                    r, q = row[a, k] + di, col[a, k] + dj
                    if 0 <= r < rows and 0 <= q < cols:
                        total += values[r, q]
                dx, dy, dt = (dj - shifts) * cell, (di - shifts) * cell, (a - turns) * step
                value = gain * total - prior_loss(info, dx, dy, dt)
                if value > best:
                    best = value
                    found[0], found[1], found[2] = guess[0] + dx, guess[1] + dy, wrap_scalar(guess[2] + dt)
    return found


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def prior_loss(info: Array, dx: float, dy: float, dt: float) -> float:
    """Return what a prior of information ``(3, 3)`` loses [nat] at a distance from its mean."""
    loss: float = 0.5 * (
        info[0, 0] * dx * dx + info[1, 1] * dy * dy + info[2, 2] * dt * dt
        + 2.0 * (info[0, 1] * dx * dy + info[0, 2] * dx * dt + info[1, 2] * dy * dt)
    )  # fmt: skip
    return loss


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _weights(t: float) -> tuple[float, float, float]:
    """Return the quadratic B-spline's weights of three cells, ``t`` in [-½, ½] off the middle one."""
    return 0.5 * (0.5 - t) * (0.5 - t), 0.75 - t * t, 0.5 * (0.5 + t) * (0.5 + t)


@njit(cache=True, nogil=True, error_model="numpy")
def field_sum(values: Values, x0: float, y0: float, cell: float, points: Array, pose: Array) -> float:
    """Return the sum of the interpolated field under the points ``(n, 2)`` seen from a pose; 0 outside."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    rows, cols = values.shape
    total = 0.0
    for k in range(points.shape[0]):
        u = (pose[0] + c * points[k, 0] - s * points[k, 1] - x0) / cell
        v = (pose[1] + s * points[k, 0] + c * points[k, 1] - y0) / cell
        j, i = math.floor(u + 0.5), math.floor(v + 0.5)
        if 1 <= i < rows - 1 and 1 <= j < cols - 1:
            p0, p1, p2 = _weights(u - j)
            q0, q1, q2 = _weights(v - i)
            total += q0 * (p0 * values[i - 1, j - 1] + p1 * values[i - 1, j] + p2 * values[i - 1, j + 1])
            total += q1 * (p0 * values[i, j - 1] + p1 * values[i, j] + p2 * values[i, j + 1])
            total += q2 * (p0 * values[i + 1, j - 1] + p1 * values[i + 1, j] + p2 * values[i + 1, j + 1])
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def slope(
    values: Values,
    x0: float,
    y0: float,
    cell: float,
    points: Array,
    pose: Array,
    gradient: Array,
    curvature: Array,
) -> float:
    """Return :func:`field_sum`; write its exact gradient ``(3,)`` and the curvature ``(3, 3)`` for Gauss-Newton.

    Of a ridge L = exp(-d²/2s²) the curvature is L n nᵀ/s², n its normal: L times minus the second derivative of
    log L, which stays positive where that of L itself does not.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    rows, cols = values.shape
    total = 0.0
    gradient[:] = 0.0
    curvature[:] = 0.0
    for k in range(points.shape[0]):
        rx, ry = c * points[k, 0] - s * points[k, 1], s * points[k, 0] + c * points[k, 1]
        u, v = (pose[0] + rx - x0) / cell, (pose[1] + ry - y0) / cell
        j, i = math.floor(u + 0.5), math.floor(v + 0.5)
        if not (1 <= i < rows - 1 and 1 <= j < cols - 1):
            continue
        t, w = u - j, v - i
        p0, p1, p2 = _weights(t)
        a0, a1, a2 = values[i - 1, j - 1], values[i - 1, j], values[i - 1, j + 1]
        b0, b1, b2 = values[i, j - 1], values[i, j], values[i, j + 1]
        c0, c1, c2 = values[i + 1, j - 1], values[i + 1, j], values[i + 1, j + 1]
        a, b, d = p0 * a0 + p1 * a1 + p2 * a2, p0 * b0 + p1 * b1 + p2 * b2, p0 * c0 + p1 * c1 + p2 * c2
        ax = (t - 0.5) * a0 - 2.0 * t * a1 + (t + 0.5) * a2
        bx = (t - 0.5) * b0 - 2.0 * t * b1 + (t + 0.5) * b2
        dx = (t - 0.5) * c0 - 2.0 * t * c1 + (t + 0.5) * c2
        q0, q1, q2 = _weights(w)
        m = q0 * a + q1 * b + q2 * d
        gx = q0 * ax + q1 * bx + q2 * dx
        gy = (w - 0.5) * a - 2.0 * w * b + (w + 0.5) * d
        total += m
        gradient[0] += gx / cell
        gradient[1] += gy / cell
        gradient[2] += (gy * rx - gx * ry) / cell
        if m < 0.02:
            continue
        xx = gx * gx / m - (q0 * (a0 - 2.0 * a1 + a2) + q1 * (b0 - 2.0 * b1 + b2) + q2 * (c0 - 2.0 * c1 + c2))
        yy = gy * gy / m - (a - 2.0 * b + d)
        xy = gx * gy / m - ((w - 0.5) * ax - 2.0 * w * bx + (w + 0.5) * dx)
        # Between two surfaces the field has a valley, where a direction may curve the other way: left out.
        mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
        root = math.sqrt(half * half + xy * xy)
        if mean + root <= 0.0:
            continue
        if mean - root < 0.0 < root:
            part = 0.5 * (mean + root) / root
            xx, yy, xy = part * (root + half), part * (root - half), part * xy
        xx, yy, xy = xx / (cell * cell), yy / (cell * cell), xy / (cell * cell)
        tx, ty = xy * rx - xx * ry, yy * rx - xy * ry
        curvature[0, 0] += xx
        curvature[0, 1] += xy
        curvature[1, 1] += yy
        curvature[0, 2] += tx
        curvature[1, 2] += ty
        curvature[2, 2] += ty * rx - tx * ry
    curvature[1, 0], curvature[2, 0], curvature[2, 1] = curvature[0, 1], curvature[0, 2], curvature[1, 2]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def climb(
    values: Values, x0: float, y0: float, cell: float, points: Array, pose: Array, prior: Array, info: Array,
    gain: float, iterations: int, curvature: Array,
) -> float:  # fmt: skip
    """Move ``pose`` ``(3,)`` to the top of gain × field sum - prior's loss; return the field sum there.

    ``curvature`` ``(3, 3)`` becomes the information at the top, prior included. Steps that lead down are halved.
    """
    gradient, hessian, trial, step = np.empty(3), np.empty((3, 3)), np.empty(3), np.empty(3)
    total = 0.0
    for iteration in range(iterations + 1):
        total = slope(values, x0, y0, cell, points, pose, gradient, hessian)
        dx, dy, dt = pose[0] - prior[0], pose[1] - prior[1], wrap_scalar(pose[2] - prior[2])
        height = gain * total - prior_loss(info, dx, dy, dt)
        for a in range(3):
            gradient[a] = gain * gradient[a] - (info[a, 0] * dx + info[a, 1] * dy + info[a, 2] * dt)
            for b in range(3):
                curvature[a, b] = gain * hessian[a, b] + info[a, b]
        if iteration == iterations or not _solve(curvature, gradient, step):
            break
        reach = max(abs(step[0]), abs(step[1])) / (2.0 * cell) + abs(step[2]) / 0.1
        scale = 1.0 / max(reach, 1.0)
        better = False
        for _ in range(5):
            for a in range(3):
                trial[a] = pose[a] + scale * step[a]
            tx, ty, tt = trial[0] - prior[0], trial[1] - prior[1], wrap_scalar(trial[2] - prior[2])
            reached = gain * field_sum(values, x0, y0, cell, points, trial) - prior_loss(info, tx, ty, tt)
            if reached > height:
                better = True
                break
            scale *= 0.5
        if not better:
            break
        pose[0], pose[1], pose[2] = trial[0], trial[1], wrap_scalar(trial[2])
        if scale * (abs(step[0]) + abs(step[1]) + abs(step[2])) < 1e-4:
            total = slope(values, x0, y0, cell, points, pose, gradient, hessian)
            break
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(a: Array, b: Array, x: Array) -> bool:
    """Solve the damped symmetric 3 × 3 system by Cholesky; ``False`` where it is not positive."""
    d0 = a[0, 0] * 1.001 + 1e-3
    l10, l20 = a[1, 0] / d0, a[2, 0] / d0
    d1 = a[1, 1] * 1.001 + 1e-3 - l10 * l10 * d0
    if not (d0 > 0.0 and d1 > 0.0):
        return False
    l21 = (a[2, 1] - l20 * l10 * d0) / d1
    d2 = a[2, 2] * 1.001 + 1e-3 - l20 * l20 * d0 - l21 * l21 * d1
    if not d2 > 0.0:
        return False
    y0 = b[0]
    y1 = b[1] - l10 * y0
    y2 = b[2] - l20 * y0 - l21 * y1
    x[2] = y2 / d2
    x[1] = y1 / d1 - l21 * x[2]
    x[0] = y0 / d0 - l10 * x[1] - l20 * x[2]
    return True
