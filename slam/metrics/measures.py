"""How good a belief is: the only place where metrics are computed. Pure functions of arrays.

Trajectories, consistency, corners, maps and coverage; ``docs/reference/metrics.md`` has the equations.
A metric of nothing (no landmark, no cell) is ``nan``, so that it can be told from a bad one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from slam.geometry import transform_points, wrap, wrap_scalar
from slam.metrics.chi_square import chi2_quantile
from slam.types import Array, Flags

__all__ = [
    "CornerDeviation",
    "MapScore",
    "align_se2",
    "anees",
    "ate",
    "ate_aligned",
    "compare_walls",
    "corner_deviation",
    "coverage",
    "heading_errors",
    "nees_band",
    "nees_pose",
    "nees_pose_invariant",
    "time_to",
]


# ---------------------------------------------------------------------------------------------------------
# Trajectories (Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012)


def ate(true_poses: ArrayLike, est_poses: ArrayLike) -> float:
    """Return the absolute trajectory error: RMS distance [m] between poses ``(n, ≥ 2)``, without alignment.

    The start pose is the origin of both, so the error at the end is drift that the user feels.
    """
    true, est = _trajectories(true_poses, est_poses, columns=2)
    return _rms(true[:, :2] - est[:, :2])


def ate_aligned(true_poses: ArrayLike, est_poses: ArrayLike) -> float:
    """Return the absolute trajectory error [m] after the best rigid alignment (:func:`align_se2`)."""
    true, est = _trajectories(true_poses, est_poses, columns=2)
    return _rms(true[:, :2] - transform_points(align_se2(true, est), est[:, :2]))


def align_se2(true_poses: ArrayLike, est_poses: ArrayLike) -> Array:
    """Return the transform ``(3,)`` that brings estimated positions nearest to the true ones.

    Least squares over SE(2), no scale: Horn 1987, Umeyama 1991; in the plane the rotation is one arctangent.
    """
    true, est = _trajectories(true_poses, est_poses, columns=2)
    true_centre, est_centre = true[:, :2].mean(axis=0), est[:, :2].mean(axis=0)
    t, e = true[:, :2] - true_centre, est[:, :2] - est_centre
    angle = math.atan2(float(np.sum(e[:, 0] * t[:, 1] - e[:, 1] * t[:, 0])), float(np.sum(e * t)))
    turned = transform_points(np.array([0.0, 0.0, angle]), est_centre[None])[0]
    return np.array([*(true_centre - turned), wrap_scalar(angle)])


def heading_errors(true_poses: ArrayLike, est_poses: ArrayLike) -> Array:
    """Return estimated minus true heading ``(n,)`` [rad] in [-π, π) of poses ``(n, 3)``."""
    true, est = _trajectories(true_poses, est_poses, columns=3)
    return wrap(est[:, 2] - true[:, 2])


def _trajectories(true_poses: ArrayLike, est_poses: ArrayLike, *, columns: int) -> tuple[Array, Array]:
    true, est = np.asarray(true_poses, np.float64), np.asarray(est_poses, np.float64)
    if true.ndim != 2 or true.shape != est.shape or len(true) == 0 or true.shape[1] < columns:
        raise ValueError(f"needs two equal arrays of poses (n ≥ 1, {columns}), got {true.shape} and {est.shape}")
    return true, est


def _rms(vectors: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


# ---------------------------------------------------------------------------------------------------------
# Consistency (Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation", 5.4)


@njit(cache=True, nogil=True, inline="always")
def _pivot_vanishes(pivot: float, variance: float) -> bool:
    # What elimination leaves of a variance below its own rounding is nothing: the matrix is singular.
    return abs(pivot) <= 1e-14 * abs(variance)


@njit(cache=True, nogil=True, inline="always")
def _term(residual: float, pivot: float, variance: float) -> float:
    """Return one diagonal term of eᵀ P⁻¹ e after L D Lᵀ: the limit for P + εI, ε → 0, where P is singular."""
    if _pivot_vanishes(pivot, variance):
        return 0.0 if residual == 0.0 else residual * residual * math.inf
    return residual * residual / pivot if pivot > 0.0 else math.nan


@njit(cache=True, nogil=True)
def _pose_form(x: float, y: float, theta: float, cov: Array) -> float:
    """Return eᵀ P⁻¹ e for e = (x, y, θ), by the L D Lᵀ factors of P written out."""
    p00, p01, p02, p11, p12, p22 = cov[0, 0], cov[0, 1], cov[0, 2], cov[1, 1], cov[1, 2], cov[2, 2]
    l10 = l20 = l21 = 0.0
    if not _pivot_vanishes(p00, p00):
        l10, l20 = p01 / p00, p02 / p00
    d1, d2 = p11 - l10 * p01, p22 - l20 * p02
    m21 = p12 - l20 * p01
    if not _pivot_vanishes(d1, p11):
        l21 = m21 / d1
        d2 -= l21 * m21
    y -= l10 * x
    theta -= l20 * x + l21 * y
    return _term(x, p00, p00) + _term(y, d1, p11) + _term(theta, d2, p22)


@njit(cache=True, nogil=True)
def nees_pose(est: Array, cov: Array, true: Array) -> float:
    """Return the NEES of one pose: eᵀ P⁻¹ e, e = true − est with the heading wrapped (a kernel).

    Parameters
    ----------
    est, cov, true : (3,), (3, 3), (3,)
        Estimate, its covariance [m², m·rad, rad²] and the truth, in one frame.

    Returns
    -------
    float
        Of a singular covariance: ``inf`` for an error that it rules out, else the form over what it allows.
        ``nan`` where the matrix is no covariance (an indefinite one) or something is not finite.
    """
    return _pose_form(true[0] - est[0], true[1] - est[1], wrap_scalar(true[2] - est[2]), cov)


@njit(cache=True, nogil=True)
def nees_pose_invariant(est: Array, cov: Array, true: Array) -> float:
    """Return the NEES of one pose in the right-invariant error ξ, for filters that retract along it.

    true = Exp(ξ) est, θ: ξθ = wrap(θ − θ̂), ξp = V(ξθ)⁻¹ (p − Exp(ξθ) p̂). The covariance of ξ is T⁻¹ P T⁻ᵀ,
    T ξ = (ξp + J p̂ ξθ, ξθ), so the form is that of T ξ under P (invariant-EKF SLAM: Zhang et al. 2017).
    Arguments and result as :func:`nees_pose`.
    """
    t = wrap_scalar(true[2] - est[2])
    c, s = math.cos(t), math.sin(t)
    a, b = (s / t, (1.0 - c) / t) if abs(t) > 1e-6 else (1.0 - t * t / 6.0, 0.5 * t)
    dx, dy = true[0] - (c * est[0] - s * est[1]), true[1] - (s * est[0] + c * est[1])
    scale = 1.0 / (a * a + b * b)
    return _pose_form((a * dx + b * dy) * scale - est[1] * t, (a * dy - b * dx) * scale + est[0] * t, t, cov)


def anees(values: ArrayLike, *, dof: int = 3, axis: int | None = None) -> Array:
    """Return the average of NEES (or NIS) values divided by ``dof``: ideal 1, above it overconfident.

    ``axis=0`` of values ``(runs, steps)`` gives the Monte-Carlo average of each step ``(steps,)``. Undefined
    (nan) values are left out; nan where none is left.
    """
    v = np.asarray(values, np.float64)
    defined = ~np.isnan(v)
    with np.errstate(invalid="ignore"):
        mean: Array = np.sum(v, axis=axis, where=defined) / np.sum(defined, axis=axis) / dof
    return mean


def nees_band(dof: int, runs: int, *, confidence: float = 0.95) -> tuple[float, float]:
    """Return the two-sided band in which :func:`anees` of independent runs lies if the filter is consistent.

    The sum of ``runs`` values is χ² with ``runs · dof`` degrees of freedom; the band is that of the average
    divided by ``dof``: [0.79, 1.24] for dof 3, 50 runs, 95 %.
    """
    total, tail = dof * runs, 0.5 * (1.0 - confidence)
    return chi2_quantile(tail, total) / total, chi2_quantile(1.0 - tail, total) / total


# ---------------------------------------------------------------------------------------------------------
# Maps


class CornerDeviation(NamedTuple):
    """Distances of mapped corners from the true ones [m]."""

    mean: float
    max: float
    each: Array  # (n,)


class MapScore(NamedTuple):
    """How well walls of a map match the true ones, each in [0, 1]."""

    iou: float
    precision: float
    recall: float


def corner_deviation(estimated: ArrayLike, true: ArrayLike) -> CornerDeviation:
    """Return paper D's r: the distance of each mapped corner ``(n, 2)`` from the nearest true one ``(m, 2)``.

    No alignment: the start pose is the origin of both frames. nan where either is empty.
    """
    points = np.asarray(estimated, np.float64).reshape(-1, 2)
    targets = np.asarray(true, np.float64).reshape(-1, 2)
    if len(points) == 0 or len(targets) == 0:
        return CornerDeviation(math.nan, math.nan, np.full(len(points), math.nan))
    each: Array = np.sqrt(np.min(np.sum((points[:, None] - targets) ** 2, axis=2), axis=1))
    return CornerDeviation(float(each.mean()), float(each.max()), each)


def compare_walls(belief_occupied: Flags, true_wall: Flags, *, tolerance_cells: float) -> MapScore:
    """Compare the walls of two rasters on one lattice, forgiving displacements up to a tolerance.

    A belief cell is *right* when a true wall cell lies within the tolerance, a true cell *found* when a
    belief cell does (distances between cell centres). precision = right / belief, recall = found / true, and
    with TP = found true cells, FP = wrong belief cells, FN = true cells not found,
    iou = TP / (TP + FP + FN): at tolerance 0 the plain intersection over union.

    Parameters
    ----------
    belief_occupied, true_wall : (rows, cols) bool
        Cells believed, and known, to hold a wall.
    tolerance_cells : float
        Greatest distance [cells] that still counts as a match.
    """
    belief, true = _rasters(belief_occupied, true_wall)
    right = int(np.count_nonzero(belief & _within(true, tolerance_cells)))
    found = int(np.count_nonzero(true & _within(belief, tolerance_cells)))
    believed, walls = int(np.count_nonzero(belief)), int(np.count_nonzero(true))
    # TP + FN is all the true cells.
    return MapScore(_ratio(found, walls + believed - right), _ratio(right, believed), _ratio(found, walls))


def coverage(belief_free: Flags, visible_free: Flags) -> float:
    """Return the share of the free cells that can be seen which the belief rightly has as free."""
    belief, visible = _rasters(belief_free, visible_free)
    return _ratio(int(np.count_nonzero(belief & visible)), int(np.count_nonzero(visible)))


def time_to(coverage_curve: ArrayLike, times: ArrayLike, *, level: float) -> float | None:
    """Return the first of ``times`` (n,) at which the curve ``(n,)`` has reached ``level``, None if never."""
    curve, t = np.asarray(coverage_curve, np.float64), np.asarray(times, np.float64)
    if curve.ndim != 1 or curve.shape != t.shape:
        raise ValueError(f"needs a curve (n,) and its times (n,), got {curve.shape} and {t.shape}")
    reached = np.flatnonzero(curve >= level)
    return float(t[reached[0]]) if len(reached) else None


def _rasters(belief: Flags, true: Flags) -> tuple[Flags, Flags]:
    a, b = np.asarray(belief, np.bool_), np.asarray(true, np.bool_)
    if a.ndim != 2 or a.shape != b.shape:
        raise ValueError(f"rasters must share one lattice, got {a.shape} and {b.shape}")
    return a, b


def _within(cells: Flags, tolerance: float) -> Flags:
    if not cells.any():  # then there is no distance to measure
        return np.zeros(cells.shape, np.bool_)
    distance = cv2.distanceTransform((~cells).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(distance <= tolerance + 1e-4)  # distances are float32


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else math.nan
