"""Poses, points and walls of one frame in another, with Jacobians by themselves and by the frame.

A frame is a pose ``(3,)`` of b in a: x, y [m], θ [rad]; what is given in b comes out in a.
"""

from __future__ import annotations

import numpy as np

from slam.geometry import compose, inverse, rotation, transform_points, wrap
from slam.types import Array

__all__ = [
    "compose_jacobians", "ends_into", "inverse_jacobian", "points_into", "pose_into", "walls_into",
]  # fmt: skip


def compose_jacobians(pose_a_b: Array, pose_b_c: Array) -> tuple[Array, Array]:
    """Return the Jacobians ``(3, 3)`` of :func:`slam.geometry.compose` by its first and second argument."""
    turn = rotation(float(pose_a_b[2]))
    first, second = np.eye(3), np.eye(3)
    x, y = turn @ np.asarray(pose_b_c)[:2]
    first[:2, 2] = -y, x
    second[:2, :2] = turn
    return first, second


def inverse_jacobian(pose_a_b: Array) -> Array:
    """Return the Jacobian ``(3, 3)`` of :func:`slam.geometry.inverse`."""
    x, y, _ = inverse(pose_a_b)
    out = -np.eye(3)
    out[:2, :2] = -rotation(-float(pose_a_b[2]))
    out[:2, 2] = y, -x
    return out


def pose_into(frame: Array, pose: Array) -> tuple[Array, Array, Array]:
    """Return a pose ``(3,)`` in the outer frame, and its Jacobians ``(3, 3)`` by pose and frame."""
    by_frame, by_pose = compose_jacobians(frame, pose)
    return compose(frame, pose), by_pose, by_frame


def points_into(frame: Array, points: Array) -> tuple[Array, Array, Array]:
    """Return points ``(n, 2)`` in the outer frame, and Jacobians by point ``(n, 2, 2)``, frame ``(n, 2, 3)``."""
    moved = transform_points(frame, points)
    by_point = np.broadcast_to(rotation(float(frame[2])), (len(points), 2, 2))
    by_frame = np.zeros((len(points), 2, 3))
    by_frame[:, 0, 0] = by_frame[:, 1, 1] = 1.0
    arm = moved - frame[:2]
    by_frame[:, 0, 2], by_frame[:, 1, 2] = -arm[:, 1], arm[:, 0]
    return moved, by_point, by_frame


def walls_into(frame: Array, walls: Array) -> tuple[Array, Array, Array]:
    """Return walls ``(k, 2)`` of α, r in the outer frame, with Jacobians as of :func:`points_into`.

    α' = α + θ and r' = r + n(α')ᵀ t: the normal goes on pointing into the wall, so that r' may well be negative;
    turning it round would make the two faces of a wall one.
    """
    alpha = walls[:, 0] + frame[2]
    nx, ny = np.cos(alpha), np.sin(alpha)
    lever = frame[1] * nx - frame[0] * ny  # dn/dα · t
    moved = np.column_stack([wrap(alpha), walls[:, 1] + nx * frame[0] + ny * frame[1]])
    by_wall, by_frame = np.zeros((len(walls), 2, 2)), np.zeros((len(walls), 2, 3))
    by_wall[:, 0, 0] = by_wall[:, 1, 1] = 1.0
    by_wall[:, 1, 0] = lever
    by_frame[:, 0, 2] = 1.0
    by_frame[:, 1] = np.column_stack([nx, ny, lever])
    return moved, by_wall, by_frame


def ends_into(frame: Array, ends: Array) -> Array:
    """Return the ends ``(k, 4)`` of walls in the outer frame."""
    return transform_points(frame, ends.reshape(-1, 2)).reshape(-1, 4)
