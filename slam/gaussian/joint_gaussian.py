"""The joint Gaussian of the robot and its landmarks: adding to it and reading it, as Numba kernels.

The covariance is the upper triangle of a square array, the robot's three states first; landmark ``i`` stands at
index 3 + 2i. Association reads it, too (:mod:`slam.landmarks.association`); :mod:`slam.gaussian.stacked_update`
corrects it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from slam.gaussian.lanes import aligned_zeros
from slam.geometry import wrap_scalar
from slam.landmarks.joint_compatibility import insert_nearest
from slam.types import LINE, Array, Floats, Indices

__all__ = [
    "ANYWHERE_COV",
    "OBSERVED_LIMIT",
    "add_landmark",
    "enlarged",
    "jump_jacobian",
    "landmark_by_pose",
    "leave_out",
    "line_ends",
    "near_landmarks",
    "place",
    "read_block",
    "state_rows",
    "symmetric_block",
    "with_robot",
]

OBSERVED_LIMIT = 1e4
"""Bound of what :func:`near_landmarks` writes, m and m²: Gymnasium asks for finite spaces."""

ANYWHERE_COV = np.diag([10.0**2, 10.0**2, math.pi**2])
"""Covariance of a pose that is as good as unknown."""


@njit(cache=True, nogil=True, error_model="numpy")
def add_landmark(x: Array, p: Array, n: int, z: Array, offset: float) -> None:
    """Append a landmark seen at (ρ, φ) = z[:2] with covariance z[2:5] (docs/reference/ekf.md)."""
    if z[5] == LINE:
        _add_line(x, p, n, z, offset)
        return
    c, s = math.cos(x[2]), math.sin(x[2])
    cb, sb = math.cos(x[2] + z[1]), math.sin(x[2] + z[1])
    rx, ry = offset * c + z[0] * cb, offset * s + z[0] * sb
    x[n], x[n + 1] = x[0] + rx, x[1] + ry
    # Gr = [[1, 0, -ry], [0, 1, rx]];  cross = Gr P_r:, written into the new columns of the upper triangle.
    for j in range(n):
        p0 = p[0, j]
        p1 = p[1, j] if j >= 1 else p[0, 1]
        p2 = p[2, j] if j >= 2 else p[j, 2]
        p[j, n] = p0 - ry * p2
        p[j, n + 1] = p1 + rx * p2
    # Gz = [[cb, -ρ sb], [sb, ρ cb]]
    a, b, d, e = cb, -z[0] * sb, sb, z[0] * cb
    r00 = a * a * z[2] + 2.0 * a * b * z[3] + b * b * z[4]
    r01 = a * d * z[2] + (a * e + b * d) * z[3] + b * e * z[4]
    r11 = d * d * z[2] + 2.0 * d * e * z[3] + e * e * z[4]
    p[n, n] = p[0, n] - ry * p[2, n] + r00
    p[n, n + 1] = p[0, n + 1] - ry * p[2, n + 1] + r01
    p[n + 1, n + 1] = p[1, n + 1] + rx * p[2, n + 1] + r11


@njit(cache=True, nogil=True, error_model="numpy")
def _add_line(x: Array, p: Array, n: int, z: Array, offset: float) -> None:
    """Append a line (α, r) seen at distance z[0] and bearing z[1]: α = θ + φ, r = ρ + n(α)ᵀ s."""
    alpha = wrap_scalar(x[2] + z[1])
    nx, ny = math.cos(alpha), math.sin(alpha)
    c, s = math.cos(x[2]), math.sin(x[2])
    sx, sy = x[0] + offset * c, x[1] + offset * s
    lever = nx * sy - ny * sx  # (J n)ᵀ s: by how much r grows with α
    turn = lever + offset * (ny * c - nx * s)
    x[n], x[n + 1] = alpha, z[0] + nx * sx + ny * sy
    # Gr = [[0, 0, 1], [nx, ny, turn]], Gz (by distance, bearing) = [[0, 1], [1, lever]]
    for j in range(n):
        p0 = p[0, j]
        p1 = p[1, j] if j >= 1 else p[0, 1]
        p2 = p[2, j] if j >= 2 else p[j, 2]
        p[j, n] = p2
        p[j, n + 1] = nx * p0 + ny * p1 + turn * p2
    p[n, n] = p[2, n] + z[4]
    p[n, n + 1] = p[2, n + 1] + z[3] + lever * z[4]
    p[n + 1, n + 1] = (
        nx * p[0, n + 1] + ny * p[1, n + 1] + turn * p[2, n + 1]
        + z[2] + 2.0 * lever * z[3] + lever * lever * z[4]
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def leave_out(x: Array, p: Array, n: int, i: int) -> None:
    """Move up what stands behind the two states from ``i`` on; ``p`` is an upper triangle."""
    for a in range(n - 2):
        above = a if a < i else a + 2
        for b in range(a, n - 2):
            p[a, b] = p[above, b if b < i else b + 2]
    for a in range(i, n - 2):
        x[a] = x[a + 2]


def place(x: Array, p: Array, n: int, pose: Array, cov: Array) -> None:
    """Have the robot jump to a pose ``(3,)``, unsure by ``cov`` ``(3, 3)`` beside what it shares with the map.

    That it shares: cut off from it, a pose of any covariance would tell the map where it lies in the world. With
    :data:`ANYWHERE_COV` the next update finds it by the landmarks alone, linearised at ``pose``.
    """
    jump = jump_jacobian(x, pose)
    p[:3, 3:n] = jump @ p[:3, 3:n]
    own = np.triu(p[:3, :3])
    p[:3, :3] = np.triu(jump @ (own + np.triu(own, 1).T) @ jump.T + cov)
    x[:3] = pose


def jump_jacobian(before: Array, after: Array) -> Array:
    """Return the Jacobian ``(3, 3)`` of one pose by another ``(≥ 3,)`` in what all of the map is off by."""
    dx, dy = float(after[0] - before[0]), float(after[1] - before[1])
    return np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])


def landmark_by_pose(pose: Array, z: Array, offset: float) -> Array:
    """Return Gr ``(2, 3)``, the Jacobian by the pose of the landmark that :func:`add_landmark` appends."""
    x, y, theta = pose[:3].tolist()
    is_line = z[5] == LINE
    away_x = offset * math.cos(theta) + (0.0 if is_line else z[0] * math.cos(theta + z[1]))
    away_y = offset * math.sin(theta) + (0.0 if is_line else z[0] * math.sin(theta + z[1]))
    if not is_line:
        return np.array([[1.0, 0.0, -away_y], [0.0, 1.0, away_x]])
    nx, ny = math.cos(theta + z[1]), math.sin(theta + z[1])
    turn = nx * (y + away_y) - ny * (x + away_x) + ny * away_x - nx * away_y
    return np.array([[0.0, 0.0, 1.0], [nx, ny, turn]])


@njit(cache=True, nogil=True, error_model="numpy")
def symmetric_block(p: Array, out: Array) -> None:
    """Write the leading block of an upper triangle as the full symmetric matrix."""
    for i in range(out.shape[0]):
        for j in range(i, out.shape[0]):
            out[i, j] = out[j, i] = p[i, j]


@njit(cache=True, nogil=True, error_model="numpy")
def read_block(p: Array, rows: Indices, out: Array) -> None:
    """Write the block at these rows and columns of the symmetric matrix whose upper triangle is p."""
    for a in range(rows.shape[0]):
        for b in range(a, rows.shape[0]):
            i, j = min(rows[a], rows[b]), max(rows[a], rows[b])
            out[a, b] = out[b, a] = p[i, j]


@njit(cache=True, nogil=True, error_model="numpy")
def near_landmarks(x: Array, p: Array, marks: Array, out: Floats) -> None:
    """Write the nearest point landmarks in the robot frame, nearest first."""
    out[:] = 0.0
    c, s = math.cos(x[2]), math.sin(x[2])
    nearest, distance = np.empty(out.shape[0], np.int64), np.empty(out.shape[0])
    filled = 0
    for i in range(marks.shape[0]):
        if marks[i, 0] >= LINE:
            continue
        dx, dy = x[3 + 2 * i] - x[0], x[4 + 2 * i] - x[1]
        filled = insert_nearest(i, dx * dx + dy * dy, nearest, distance, filled)
    for j in range(filled):
        k = 3 + 2 * nearest[j]
        dx, dy = x[k] - x[0], x[k + 1] - x[1]
        a, b, d = p[k, k], p[k, k + 1], p[k + 1, k + 1]
        out[j, 0] = c * dx + s * dy
        out[j, 1] = -s * dx + c * dy
        out[j, 2] = c * c * a + 2.0 * c * s * b + s * s * d
        out[j, 3] = -c * s * a + (c * c - s * s) * b + c * s * d
        out[j, 4] = s * s * a - 2.0 * c * s * b + c * c * d
        for q in range(5):
            out[j, q] = min(max(out[j, q], -OBSERVED_LIMIT), OBSERVED_LIMIT)
        out[j, 5] = 1.0


@njit(cache=True, nogil=True, error_model="numpy")
def with_robot(p: Array, landmarks: Indices) -> Array:
    """Return the covariance ``(3 + 2k, 3 + 2k)`` of the robot and these landmarks; p is an upper triangle."""
    rows = np.empty(3 + 2 * len(landmarks), np.int64)
    for i in range(3):
        rows[i] = i
    for k in range(len(landmarks)):
        rows[3 + 2 * k], rows[4 + 2 * k] = 3 + 2 * landmarks[k], 4 + 2 * landmarks[k]
    out = np.empty((len(rows), len(rows)))
    read_block(p, rows, out)
    return out


def enlarged(x: Array, p: Array, n: int) -> tuple[Array, Array]:
    """Return state and covariance, of which ``n`` states are in use, with twice the room."""
    size = 2 * len(x)
    more, wider = np.zeros(size), aligned_zeros(size, size)
    more[:n], wider[:n, :n] = x[:n], p[:n, :n]
    return more, wider


def state_rows(landmarks: Indices, *, robot: bool) -> Indices:
    """Return the state's indices of landmarks, after the robot's three if wanted."""
    rows = np.column_stack([3 + 2 * landmarks, 4 + 2 * landmarks]).ravel()
    return np.concatenate([np.arange(3), rows]) if robot else rows


def line_ends(lines: Array, extent: Array) -> Array:
    """Return the ends ``(k, 4)`` of walls (α, r): as far as they were seen, along them from their feet."""
    alpha, r = lines.T
    n = np.column_stack([np.cos(alpha), np.sin(alpha)])
    along = np.column_stack([-n[:, 1], n[:, 0]])
    return np.hstack([r[:, None] * n + extent[:, [e]] * along for e in range(2)])
