"""SE(2): poses, twists and angles in the plane. Nothing else in the project wraps an angle.

A pose is an array ``(3,)``: x [m], y [m], heading [rad] in [-π, π); it stands for the transform that takes
points of the body frame into the frame the pose is given in. The functions ending in ``_scalar`` are Numba
kernels for use inside other kernels.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from slam.types import Array

__all__ = [
    "about_z",
    "compose",
    "exp",
    "inverse",
    "log",
    "relative",
    "rotation",
    "symmetric",
    "transform_points",
    "wrap",
    "wrap_scalar",
]

_TWO_PI = 2.0 * math.pi


@njit(cache=True, nogil=True, inline="always")
def wrap_scalar(angle: float) -> float:
    """Return ``angle`` [rad] in [-π, π)."""
    wrapped = angle - _TWO_PI * math.floor((angle + math.pi) / _TWO_PI)
    # floor() of a tiny negative number over 2π rounds up to exactly π; the interval is half open.
    return -math.pi if wrapped >= math.pi else wrapped


def wrap(angle: float | Array) -> Array:
    """Return angles [rad] in [-π, π), element by element, in the shape given."""
    wrapped = np.asarray(angle, dtype=np.float64)
    wrapped = wrapped - _TWO_PI * np.floor((wrapped + math.pi) / _TWO_PI)
    return np.where(wrapped >= math.pi, -math.pi, wrapped)


def rotation(angle: float) -> Array:
    """Return the rotation matrix ``(2, 2)`` of an angle [rad]."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


def compose(pose_a_b: Array, pose_b_c: Array) -> Array:
    """Return ``pose_a_c``: first the transform of b in a, then that of c in b."""
    x, y, theta = (float(v) for v in pose_a_b)
    bx, by, btheta = (float(v) for v in pose_b_c)
    c, s = math.cos(theta), math.sin(theta)
    return np.array([x + c * bx - s * by, y + s * bx + c * by, wrap_scalar(theta + btheta)])


def inverse(pose_a_b: Array) -> Array:
    """Return ``pose_b_a``."""
    x, y, theta = (float(v) for v in pose_a_b)
    c, s = math.cos(theta), math.sin(theta)
    return np.array([-c * x - s * y, s * x - c * y, wrap_scalar(-theta)])


def relative(poses: Array, seen: Array) -> Array:
    """Return poses ``(n, 3)`` as seen from other poses ``(n, 3)``, row by row: inverse(poses) ∘ seen."""
    dx, dy = (seen[:, :2] - poses[:, :2]).T
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    return np.column_stack([c * dx + s * dy, c * dy - s * dx, wrap(seen[:, 2] - poses[:, 2])])


def exp(twist: Array) -> Array:
    """Return the pose reached from the origin by a body twist (vx, vy, ω) held for one unit of time."""
    vx, vy, omega = (float(v) for v in twist)
    if abs(omega) < 1e-6:
        # Second-order series: exact to rounding below this angle, where 1 - cos ω is all rounding.
        a, b = 1.0 - omega * omega / 6.0, 0.5 * omega
    else:
        a, b = math.sin(omega) / omega, (1.0 - math.cos(omega)) / omega
    return np.array([a * vx - b * vy, b * vx + a * vy, wrap_scalar(omega)])


def log(pose: Array) -> Array:
    """Return the body twist (vx, vy, ω) that reaches ``pose`` from the origin in one unit of time."""
    x, y, theta = (float(v) for v in pose)
    half = 0.5 * theta
    # half / tan(half) has a removable singularity at zero.
    cot = 1.0 - theta * theta / 12.0 if abs(theta) < 1e-6 else half / math.tan(half)
    return np.array([cot * x + half * y, -half * x + cot * y, theta])


def transform_points(pose_a_b: Array, points_b: Array) -> Array:
    """Return points ``(n, 2)`` of frame b expressed in frame a."""
    x, y, theta = (float(v) for v in pose_a_b)
    points = np.asarray(points_b, np.float64)
    c, s, px, py = math.cos(theta), math.sin(theta), points[..., 0], points[..., 1]
    # No product of matrices: BLAS wakes its threads for many points, and they spin for tens of milliseconds after.
    return np.stack([c * px - s * py + x, s * px + c * py + y], axis=-1)


def symmetric(upper: Array) -> Array:
    """Return the symmetric matrix ``(n, n)`` that has this upper triangle; what is below it does not count."""
    return np.asarray(np.triu(upper) + np.triu(upper, 1).T, np.float64)


def about_z(turn: float) -> Array:
    """Return what turns the covariance of a pose into a frame turned by ``turn`` [rad]."""
    c, s = math.cos(turn), math.sin(turn)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
