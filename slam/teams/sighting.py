"""One robot sees another: what that says of where their frames lie."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from scipy.optimize import minimize_scalar

from slam.geometry import compose, inverse, wrap
from slam.teams.frames import compose_jacobians, inverse_jacobian
from slam.types import Array

__all__ = ["combine", "relative_pose"]


def relative_pose(
    seen: Array, seen_cov: Array, pose_a: Array, cov_a: Array, pose_b: Array, cov_b: Array
) -> tuple[Array, Array]:
    """Return the pose ``(3,)`` of b's frame in a's and its covariance ``(3, 3)``, to first order.

    T = p_a ∘ z ∘ p_b⁻¹, where z is where b's body is as seen from a's.

    Parameters
    ----------
    seen, seen_cov : (3,), (3, 3)
        Range [m], bearing [rad] and relative heading [rad] of b's body from a's, and their covariance.
    pose_a, cov_a, pose_b, cov_b : (3,), (3, 3)
        What either believes of its pose at that instant, in its own frame; their errors are independent.
    """
    distance, bearing, heading = (float(v) for v in seen)
    c, s = math.cos(bearing), math.sin(bearing)
    z = np.array([distance * c, distance * s, heading])
    by_seen = np.array([[c, -distance * s, 0.0], [s, distance * c, 0.0], [0.0, 0.0, 1.0]])
    back = inverse(pose_b)
    there = compose(pose_a, z)
    by_a, by_z = compose_jacobians(pose_a, z)
    by_there, by_back = compose_jacobians(there, back)
    cov = np.zeros((3, 3))
    for jacobian, own in (
        (by_there @ by_a, cov_a), (by_there @ by_z @ by_seen, seen_cov),
        (by_back @ inverse_jacobian(pose_b), cov_b),
    ):  # fmt: skip
        cov += jacobian @ own @ jacobian.T
    return compose(there, back), cov


def combine(estimates: Iterable[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Return one pose ``(3,)`` and covariance ``(3, 3)`` out of several of the same frame.

    By covariance intersection (Julier and Uhlmann 1997), one after the other: sightings at different times share
    the errors of the poses they were made from, in a way that nobody keeps; this is consistent whatever that is.

    Raises
    ------
    ValueError
        Where there is none.
    """
    merged: tuple[Array, Array] | None = None
    for pose, cov in estimates:
        merged = (np.asarray(pose), np.asarray(cov)) if merged is None else _intersection(*merged, pose, cov)
    if merged is None:
        raise ValueError("needs one estimate at least")
    return merged


def _intersection(pose_a: Array, cov_a: Array, pose_b: Array, cov_b: Array) -> tuple[Array, Array]:
    """P⁻¹ = ω P_a⁻¹ + (1 − ω) P_b⁻¹, with the ω that makes the determinant of P least."""
    info_a, info_b = np.linalg.inv(cov_a), np.linalg.inv(cov_b)

    def uncertainty(share: float) -> float:
        return -float(np.linalg.slogdet(share * info_a + (1.0 - share) * info_b)[1])

    inner = float(minimize_scalar(uncertainty, bounds=(0.0, 1.0), method="bounded").x)
    share = min((0.0, inner, 1.0), key=uncertainty)
    cov = np.linalg.inv(share * info_a + (1.0 - share) * info_b)
    off = np.asarray(pose_b) - pose_a
    off[2] = wrap(off[2])
    pose = pose_a + cov @ ((1.0 - share) * info_b @ off)
    pose[2] = wrap(pose[2])
    return pose, cov
