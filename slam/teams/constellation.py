"""Candidates for where one account's frame lies in another's, and which landmarks are the same under one.

Two corners of a map are found again in another as two of the same kinds, as far apart, with the same directions to
the line that joins them: each such pair says where the frame is. So does one corner by its direction, once walls
have made the heading exact. What many corners and walls agree on is a candidate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numba import njit

from slam.accounts.account import Account
from slam.geometry import transform_points, wrap, wrap_scalar
from slam.settings import Angle, Config, Count, Few, Length, Within, require
from slam.teams.frames import ends_into, points_into, walls_into
from slam.types import Array, Indices

__all__ = ["ConstellationConfig", "candidates", "rigid_fit", "same_landmarks"]

Pairs = Indices


@dataclass(frozen=True, kw_only=True)
class ConstellationConfig(Config):
    """How like two landmarks must be to be the same."""

    shortest_m: Length = 0.8  # of a pair of corners: nearer ones say too little of the heading
    neighbours: Few = 15  # pairs of a corner with so many others, the nearest
    length_m: Length = 0.12  # by which two pairs may differ in length
    turn_rad: Angle = 0.4  # between the directions of two corners that are the same
    near_m: Length = 0.25  # of corners that count for a candidate
    places: Count = 200  # different ones by the corners alone, the best …
    count: Count = 15  # … and of these, by walls too, candidates that are looked at more closely
    # Of matches, as the fit gets closer.
    tolerances_m: Annotated[tuple[float, ...], Within("[0.001, 1000]")] = (0.25, 0.15, 0.12, 0.12)
    wall_turn_rad: Angle = 0.06  # between two walls that are the same
    overlap_m: Length = 0.2  # by which they must overlap

    def __post_init__(self) -> None:
        super().__post_init__()
        require(len(self.tolerances_m) > 0, "ConstellationConfig.tolerances_m must not be empty")


# ---- candidates ------------------------------------------------------------------------------------------------


def candidates(a: Account, b: Account, config: ConstellationConfig) -> Array:
    """Return poses ``(c, 3)`` of b's frame in a's, the one with most landmarks in common first."""
    rows_a, rows_b = _oriented(a), _oriented(b)
    if not len(rows_a) or not len(rows_b):
        return np.zeros((0, 3))
    poses = np.vstack([_by_pairs(a, b, rows_a, rows_b, config), _by_single_corners(a, b, rows_a, rows_b)])
    support = _support(a, b, rows_a, rows_b, poses, config)
    places: list[Array] = []
    for k in np.argsort(-support, kind="stable"):
        if len(places) == config.places:
            break
        apart = np.array(places).reshape(-1, 3) - poses[k]
        near = np.hypot(apart[:, 0], apart[:, 1]) < 2.0 * config.near_m
        if not (near & (np.abs(wrap(apart[:, 2])) < 0.1)).any():
            places.append(poses[k])
    matches = [sum(map(len, same_landmarks(a, b, pose, config.near_m, config))) for pose in places]
    return np.array(places).reshape(-1, 3)[np.argsort(-np.array(matches), kind="stable")[: config.count]]


def _oriented(account: Account) -> Indices:
    return np.flatnonzero((account.kinds != 0) & np.isfinite(account.directions))


def _pairs(points: Array, neighbours: int, shortest: float) -> Pairs:
    """Return pairs ``(p, 2)`` of each point with so many of its nearest that are not too near."""
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    apart[apart < shortest] = np.inf
    nearest = np.argsort(apart, axis=1, kind="stable")[:, :neighbours]
    pairs = np.column_stack([np.repeat(np.arange(len(points)), nearest.shape[1]), nearest.ravel()])
    return np.asarray(pairs[np.isfinite(apart[pairs[:, 0], pairs[:, 1]])], np.int64)


def _by_pairs(a: Account, b: Account, rows_a: Indices, rows_b: Indices, config: ConstellationConfig) -> Array:
    """Return the frame ``(h, 3)`` by every pair of b's corners that is like one of a's."""
    # Of b more neighbours: it may have corners between those that a has.
    pairs_a = rows_a[_pairs(a.points[rows_a], config.neighbours, config.shortest_m)]
    pairs_b = rows_b[_pairs(b.points[rows_b], 2 * config.neighbours, config.shortest_m)]
    lines_a, lines_b = (x.points[p[:, 1]] - x.points[p[:, 0]] for x, p in ((a, pairs_a), (b, pairs_b)))
    lengths_a, lengths_b = np.linalg.norm(lines_a, axis=1), np.linalg.norm(lines_b, axis=1)
    order = np.argsort(lengths_b, kind="stable")
    low = np.searchsorted(lengths_b[order], lengths_a - config.length_m)
    high = np.searchsorted(lengths_b[order], lengths_a + config.length_m)
    i = np.repeat(np.arange(len(pairs_a)), high - low)
    offset = np.arange(len(i)) - np.repeat(np.cumsum(high - low) - (high - low), high - low)
    j = order[np.repeat(low, high - low) + offset]
    turn = np.arctan2(lines_a[i, 1], lines_a[i, 0]) - np.arctan2(lines_b[j, 1], lines_b[j, 0])
    alike = np.ones(len(i), bool)
    for end in range(2):
        p, q = pairs_a[i, end], pairs_b[j, end]
        alike &= a.kinds[p] == b.kinds[q]
        alike &= np.abs(wrap(a.directions[p] - b.directions[q] - turn)) < config.turn_rad
    i, j, turn = i[alike], j[alike], turn[alike]
    middle_a = a.points[pairs_a[i]].mean(axis=1)
    middle_b = b.points[pairs_b[j]].mean(axis=1)
    c, s = np.cos(turn), np.sin(turn)
    turned = np.column_stack([c * middle_b[:, 0] - s * middle_b[:, 1], s * middle_b[:, 0] + c * middle_b[:, 1]])
    return np.column_stack([middle_a - turned, wrap(turn)])


def _by_single_corners(a: Account, b: Account, rows_a: Indices, rows_b: Indices) -> Array:
    """Return the frame ``(h, 3)`` by every corner of b's that is of the kind of one of a's."""
    p, q = (x.ravel() for x in np.meshgrid(rows_a, rows_b, indexing="ij"))
    alike = a.kinds[p] == b.kinds[q]
    p, q = p[alike], q[alike]
    turn = a.directions[p] - b.directions[q]
    # The mean turn between walls near that one: theirs is known to a fraction of a degree.
    between = np.sort(wrap(a.walls[:, None, 0] - b.walls[None, :, 0]).ravel())
    between = np.concatenate([between - 2.0 * math.pi, between, between + 2.0 * math.pi])
    total = np.concatenate([[0.0], np.cumsum(between)])
    turn = wrap(turn)
    for window in (0.15, 0.05):
        low, high = np.searchsorted(between, turn - window), np.searchsorted(between, turn + window)
        turn = np.where(high > low, (total[high] - total[low]) / np.maximum(high - low, 1), turn)
    c, s = np.cos(turn), np.sin(turn)
    x, y = b.points[q].T
    return np.column_stack([a.points[p] - np.column_stack([c * x - s * y, s * x + c * y]), wrap(turn)])


def _support(
    a: Account, b: Account, rows_a: Indices, rows_b: Indices, poses: Array, config: ConstellationConfig
) -> Array:
    """Return for each pose ``(h,)`` how many of b's corners have one of a's that may be the same."""
    rows_a = rows_a[np.argsort(a.points[rows_a, 0], kind="stable")]
    there, theirs = (
        np.column_stack([x.points[rows], x.directions[rows], x.kinds[rows]])
        for x, rows in ((a, rows_a), (b, rows_b))
    )
    out = np.zeros(len(poses))
    _count_near(np.ascontiguousarray(poses), there, theirs, config.near_m, config.turn_rad, out)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _count_near(poses: Array, a: Array, b: Array, near: float, most_turn: float, out: Array) -> None:
    """Do what :func:`_support` says; rows are x, y, direction, kind, those of ``a`` by rising x.

    Nearer counts more, so that of many poses about one place the middle comes first.
    """
    xs = a[:, 0].copy()
    for k in range(len(poses)):
        x, y, turn = poses[k]
        c, s = math.cos(turn), math.sin(turn)
        for j in range(len(b)):
            bx, by = x + c * b[j, 0] - s * b[j, 1], y + s * b[j, 0] + c * b[j, 1]
            least = near * near
            for i in range(np.searchsorted(xs, bx - near), len(a)):
                if xs[i] > bx + near:
                    break
                squared = (bx - xs[i]) ** 2 + (by - a[i, 1]) ** 2
                if squared < least and a[i, 3] == b[j, 3]:
                    off = wrap_scalar(a[i, 2] - b[j, 2] - turn)
                    if abs(off) < most_turn:
                        least = squared
            out[k] += 1.0 - least / (near * near)


# ---- which landmarks are the same ------------------------------------------------------------------------------


def same_landmarks(
    a: Account, b: Account, pose: Array, tolerance_m: float, config: ConstellationConfig
) -> tuple[Pairs, Pairs]:
    """Return which corners ``(k, 2)`` and walls ``(m, 2)`` are the same, by row, with b's frame at a pose in a's.

    Each is the other's nearest of those that are alike.
    """
    moved = transform_points(pose, b.points)
    apart = np.linalg.norm(a.points[:, None] - moved[None], axis=2)
    turn = np.abs(wrap(a.directions[:, None] - b.directions[None] - pose[2]))
    alike = (a.kinds[:, None] == b.kinds[None]) & ~(turn >= config.turn_rad)  # one without direction is like any
    points = _mutual(np.where(alike, apart, np.inf), tolerance_m)
    return points, _mutual(_walls_apart(a, b, pose, config), tolerance_m)


def _walls_apart(a: Account, b: Account, pose: Array, config: ConstellationConfig) -> Array:
    """Return how far [m] walls are apart ``(k, l)``, inf where they point elsewhere or do not overlap.

    The farther of the distances of b's two ends, as far as a's piece reaches, from a's line.
    """
    walls, ends = walls_into(pose, b.walls)[0], ends_into(pose, b.wall_ends).reshape(-1, 2, 2)
    normal = np.column_stack([np.cos(a.walls[:, 0]), np.sin(a.walls[:, 0])])
    along = np.column_stack([-normal[:, 1], normal[:, 0]])
    own = np.sort(np.einsum("kei,ki->ke", a.wall_ends.reshape(-1, 2, 2), along), axis=1)
    theirs = np.einsum("lei,ki->kle", ends, along)
    first, last = theirs.min(axis=2), theirs.max(axis=2)
    low, high = np.maximum(own[:, None, 0], first), np.minimum(own[:, None, 1], last)
    turn = wrap(walls[None, :, 0] - a.walls[:, None, 0])
    out = np.full(turn.shape, np.inf)
    off = np.einsum("lei,ki->kle", ends, normal) - a.walls[:, 1, None, None]
    middle = off.mean(axis=2)
    # On b's line the distance from a's grows by the tangent of the turn; measured where both were seen.
    centre = 0.5 * (low + high) - theirs.mean(axis=2)
    apart = np.abs(middle - np.tan(np.clip(turn, -1.0, 1.0)) * centre) + 0.5 * np.abs(turn) * (high - low)
    fits = (np.abs(turn) < config.wall_turn_rad) & (high - low > config.overlap_m)
    out[fits] = apart[fits]
    return out


def _mutual(apart: Array, most: float) -> Pairs:
    if not apart.size:
        return np.zeros((0, 2), np.int64)
    row, column = apart.argmin(axis=1), apart.argmin(axis=0)
    rows = np.arange(len(apart))
    good = (column[row] == rows) & (apart[rows, row] < most)
    return np.asarray(np.column_stack([rows, row])[good], np.int64)


def rigid_fit(a: Account, b: Account, pose: Array, points: Pairs, walls: Pairs) -> Array:
    """Return the pose of b's frame in a's by least squares over matches, one step from a pose.

    Corners count by how far they are apart, walls by the distance of b's two ends from a's line.
    """
    moved, _, by_frame = points_into(pose, b.points[points[:, 1]])
    ends, _, ends_by_frame = points_into(pose, b.wall_ends[walls[:, 1]].reshape(-1, 2))
    alpha = np.repeat(a.walls[walls[:, 0], 0], 2)
    normal = np.column_stack([np.cos(alpha), np.sin(alpha)])
    off = np.einsum("ei,ei->e", ends, normal) - np.repeat(a.walls[walls[:, 0], 1], 2)
    residual = np.concatenate([(moved - a.points[points[:, 0]]).ravel(), off])
    jacobian = np.concatenate([by_frame.reshape(-1, 3), np.einsum("eij,ei->ej", ends_by_frame, normal)])
    step = np.linalg.lstsq(jacobian, -residual, rcond=None)[0]
    if not math.isfinite(float(step.sum())):
        return pose
    out = np.asarray(pose + step, np.float64)
    out[2] = float(wrap(out[2]))
    return out
