"""The relations metric: how well a trajectory keeps the motions between pairs of poses.

Kümmerle, Steder, Dornhege, Ruhnke, Grisetti, Stachniss and Kleiner, "On measuring the accuracy of SLAM
algorithms", Autonomous Robots 27 (2009). It compares relative poses, so neither where the frame lies nor an
early error that turns all that follows counts more than once. ``docs/reference/metrics.md`` has the equations.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from slam.geometry import relative, wrap
from slam.types import Array, Indices

__all__ = ["RelationScore", "closing_relations", "local_relations", "relation_errors", "relation_score"]

Pairs = Indices

LOCAL_STEPS = (1, 5, 20)
"""Of the local relations, in poses: from one scan to the next, and over two longer stretches."""
CLOSING_WITHIN_M = 1.0
"""How far apart the two places of a loop closing may be."""
CLOSING_AFTER_M = 10.0
"""How long the way between them must be."""


class RelationScore(NamedTuple):
    """Mean and standard deviation over relations of the error, and of its square; nan where there is none."""

    trans_m: float
    trans_std_m: float
    trans_sq_m2: float
    trans_sq_std_m2: float
    rot_rad: float
    rot_std_rad: float
    rot_sq_rad2: float
    rot_sq_std_rad2: float
    relations: int


def local_relations(poses: int, *, steps: tuple[int, ...] = LOCAL_STEPS) -> Pairs:
    """Return the relations ``(m, 2)`` between every one of so many poses and that so many ``steps`` later."""
    parts = [np.column_stack([np.arange(poses - k), np.arange(k, poses)]) for k in steps if k < poses]
    return np.vstack([np.zeros((0, 2), np.int64), *parts]).astype(np.int64)


def closing_relations(
    reference: ArrayLike, *, within_m: float = CLOSING_WITHIN_M, after_m: float = CLOSING_AFTER_M
) -> Pairs:
    """Return the relations ``(m, 2)``, i < j, between places that were visited again: close in space, not in time.

    A pose j is related to at most one pose of each earlier visit: the nearest of an unbroken run of poses within
    ``within_m``, so that a place where the robot stood for long does not count a hundredfold.

    Parameters
    ----------
    reference : (n, ≥ 2) array_like
        True poses in the order of time [m].
    within_m : float
        Farthest apart in space.
    after_m : float
        Shortest way between them, along the reference.
    """
    places = np.asarray(reference, np.float64)[:, :2]
    way = np.append(0.0, np.cumsum(np.hypot(*np.diff(places, axis=0).T)))
    pairs: list[tuple[int, int]] = []
    for j in range(len(places)):
        earlier = int(np.searchsorted(way, way[j] - after_m, side="right"))  # poses with way enough between
        apart = np.hypot(*(places[:earlier] - places[j]).T)
        near = np.flatnonzero(apart <= within_m)
        for visit in np.split(near, np.flatnonzero(np.diff(near) > 1) + 1):
            if len(visit):
                pairs.append((int(visit[np.argmin(apart[visit])]), j))
    return np.array(pairs, np.int64).reshape(-1, 2)


def relation_errors(true_poses: ArrayLike, est_poses: ArrayLike, relations: ArrayLike) -> tuple[Array, Array]:
    """Return the errors of relations: of translation ``(m,)`` [m] and of rotation ``(m,)`` [rad], both ≥ 0.

    With δ = x_i⁻¹ x_j estimated and δ* the same of the truth: length of the translation, and size of the angle, of
    δ ⊖ δ* = δ*⁻¹ δ. Whatever rigid transform the whole estimate is moved by, they stay the same.

    Parameters
    ----------
    true_poses, est_poses : (n, 3) array_like
        x, y [m], θ [rad], each in a frame of its own.
    relations : (m, 2) array_like of int
        Rows i, j.
    """
    true, est = np.asarray(true_poses, np.float64), np.asarray(est_poses, np.float64)
    if true.ndim != 2 or true.shape != est.shape or true.shape[1] != 3:
        raise ValueError(f"relations need two equal arrays of poses (n, 3), got {true.shape} and {est.shape}")
    i, j = np.asarray(relations, np.int64).reshape(-1, 2).T
    if len(i) and not (min(i.min(), j.min()) >= 0 and max(i.max(), j.max()) < len(true)):
        raise ValueError(f"relations name poses outside 0 … {len(true) - 1}")
    off = relative(est[i], est[j]) - relative(true[i], true[j])
    # δ*⁻¹ turns the difference of the translations, which keeps its length.
    return np.hypot(off[:, 0], off[:, 1]), np.abs(wrap(off[:, 2]))


def relation_score(true_poses: ArrayLike, est_poses: ArrayLike, relations: ArrayLike) -> RelationScore:
    """Return the relations metric ε(δ) of an estimate; arguments as of :func:`relation_errors`."""
    trans, rot = relation_errors(true_poses, est_poses, relations)
    if not len(trans):
        return RelationScore._make([math.nan] * 8 + [0])
    numbers = [f(v**p) for v in (trans, rot) for p in (1, 2) for f in (np.mean, np.std)]
    return RelationScore._make([float(v) for v in numbers] + [len(trans)])
