"""The covariance of what all particles inherit: the error of a line of ancestors, told by the filter's own gains.

Resampling leaves one ancestor of all but the last few updates, so the particles' spread says nothing of the error
that was made before (Bailey, Nieto and Nebot 2006, "Consistency of the FastSLAM algorithm"). That error is not
unknown, though. A particle is a linear filter whose gains are not the best ones: its pose is corrected as if its
landmarks knew of no error but that of their own measurements, each landmark as if the pose were known. Of a filter
with *any* gain the covariance is known (Joseph's form, P ← (I - KH) P (I - KH)ᵀ + K R Kᵀ), and here K has rows for
the pose and the landmarks seen only: the time of an update is in proportion to the number of landmarks
(``docs/reference/fastslam.md``).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from slam.particles.maps import innovation
from slam.types import Array, Indices

__all__ = ["InheritedError", "beyond", "common_descent"]


class InheritedError:
    """Joint covariance of the errors of a particle's pose and of its landmarks, over worlds and noises.

    Rows are x, y, θ, then x, y of every landmark [m, rad], errors estimate less truth.
    """

    def __init__(self, pose_cov: Array) -> None:
        self._p = np.zeros((67, 67))  # symmetric, room for more landmarks than there are
        self._p[:3, :3] = pose_cov
        self._size = 3
        self.motion = np.zeros((3, 3))
        """Covariance of the motion since the last :meth:`correct`: the proposal's, before it is narrowed."""

    @property
    def cov(self) -> Array:
        """The joint covariance ``(3 + 2n, 3 + 2n)``, a view."""
        return self._p[: self._size, : self._size]

    def predict(self, pose: Array, twist: Array, dt: float, var_v: float, var_w: float) -> None:
        """Move on from ``pose`` ``(3,)`` by a measured twist of these variances (docs/reference/ekf.md)."""
        _predict(self._p, self._size, self.motion, pose, twist, dt, var_v, var_w)

    def widen(self, cov: Array) -> None:
        """Allow for an error ``(3, 3)`` of the motion that the wheels' noise does not account for."""
        self._p[:3, :3] += cov
        self.motion += cov

    def place(self, cov: Array) -> None:
        """Have the pose err by ``cov`` ``(3, 3)``, by itself: it was set anew."""
        self._p[:3], self._p[:, :3] = 0.0, 0.0
        self._p[:3, :3] = cov
        self.motion = cov.copy()

    def correct(
        self, pose: Array, points: Array, covs: Array, z: Array, match: Indices, offset: float, drawn: float
    ) -> None:
        """Follow an update of the filter: the pose narrowed by all matches and drawn, then each landmark.

        Parameters
        ----------
        pose, points : Array
            ``(3,)`` and ``(n, 2)``, where the observations are linearised: a particle's own.
        covs : Array
            ``(n, 3)`` σxx, σxy, σyy [m²] of the particle's landmarks before the update, given its path.
        z, match
            Observation rows ``(m, ≥ 5)`` and the landmark of each, below 0 where it has none.
        offset : float
            Of the sensor, ahead of the body's centre [m].
        drawn : float
            Share of the drawn pose's covariance that stays as an error: 1/N_eff of the particles' mean.
        """
        points, covs = np.ascontiguousarray(points), np.ascontiguousarray(covs)  # one kernel, not one a layout
        _correct(self._p, self._size, self.motion, pose, points, covs, z, match, offset, drawn)

    def add(self, pose: Array, z: Array, offset: float) -> None:
        """Append a landmark seen as row ``z`` from ``pose`` ``(3,)``: it errs as the pose does, and as ``z``."""
        if self._size + 2 > len(self._p):
            wider = np.zeros((2 * len(self._p), 2 * len(self._p)))
            wider[: self._size, : self._size] = self.cov
            self._p = wider
        _add(self._p, self._size, pose, z, offset)
        self._size += 2

    def drop(self, row: int) -> None:
        """Take a landmark out; those after it move up."""
        kept = np.delete(np.arange(self._size), [3 + 2 * row, 4 + 2 * row])
        self._size = len(kept)
        self._p[: self._size, : self._size] = self._p[np.ix_(kept, kept)]

    def of_landmarks(self) -> Array:
        """Return the landmarks' own covariances ``(n, 2, 2)``."""
        cov, rows = self.cov, np.arange(3, self._size).reshape(-1, 2)
        return np.asarray(cov[rows[:, :, None], rows[:, None, :]])


def common_descent(origin: Indices, weights: Array) -> float:
    """Return how probable it is that two particles drawn by weight descend from one of the start.

    From 1/n where none has died to 1 where all descend from one. Two particles of one descent have the errors of
    their ancestor in common: it is the share of what was inherited that the particles' spread does not show.
    """
    return float(np.square(np.bincount(origin, weights)).sum())


@njit(cache=True, nogil=True, error_model="numpy")
def beyond(covs: Array, spreads: Array, share: float) -> None:
    """Add to each of ``spreads`` ``(n, k, k)`` a share of what the covariance in ``covs`` has beyond it.

    S ← S + share · L (I - L⁻¹ S L⁻ᵀ)₊ Lᵀ with P = L Lᵀ: in no direction less than S, and with share 1 in none less
    than P or S.
    """
    for i in range(covs.shape[0]):
        root = np.linalg.cholesky(covs[i])
        half = np.linalg.solve(root, spreads[i])
        inner = np.linalg.solve(root, half.T.copy())
        values, axes = np.linalg.eigh(0.5 * (inner + inner.T))
        turned = root @ axes
        for a in range(values.shape[0]):
            lacks = share * max(1.0 - values[a], 0.0)
            for b in range(turned.shape[0]):
                for c in range(turned.shape[0]):
                    spreads[i, b, c] += lacks * turned[b, a] * turned[c, a]


@njit(cache=True, nogil=True, error_model="numpy")
def _predict(
    p: Array, size: int, motion: Array, pose: Array, twist: Array, dt: float, var_v: float, var_w: float
) -> None:  # fmt: skip
    """P_rr ← Fx P_rr Fxᵀ + Fu V Fuᵀ, P_rm ← Fx P_rm; the motion's own covariance likewise."""
    middle = pose[2] + 0.5 * twist[2] * dt
    c, s = math.cos(middle), math.sin(middle)
    a = -(twist[0] * s + twist[1] * c) * dt
    b = (twist[0] * c - twist[1] * s) * dt
    _shear(p, size, a, b)
    _shear(motion, 3, a, b)
    half, qv, qw = 0.5 * dt, var_v * dt * dt, var_w
    for q in (p, motion):
        q[0, 0] += qv + a * a * half * half * qw
        q[1, 1] += qv + b * b * half * half * qw
        q[0, 1] += a * b * half * half * qw
        q[0, 2] += a * half * dt * qw
        q[1, 2] += b * half * dt * qw
        q[2, 2] += dt * dt * qw
        q[1, 0], q[2, 0], q[2, 1] = q[0, 1], q[0, 2], q[1, 2]


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _shear(p: Array, size: int, a: float, b: float) -> None:
    for j in range(size):
        p[0, j] += a * p[2, j]
        p[1, j] += b * p[2, j]
    for i in range(size):
        p[i, 0] += a * p[i, 2]
        p[i, 1] += b * p[i, 2]


@njit(cache=True, nogil=True, error_model="numpy")
def _correct(
    p: Array, size: int, motion: Array, pose: Array, points: Array, covs: Array, z: Array, match: Indices,
    offset: float, drawn: float,
) -> None:  # fmt: skip
    """Let errors of the pose and of the landmarks seen go on as A e + B v + D d: v of what was seen, d drawn."""
    m = z.shape[0]
    slot, rows = _slots(match, points.shape[0])
    used = rows.shape[0]
    # One matrix for A, B and D, side by side.
    map_of = np.zeros((used, used + 2 * m + 3))
    for j in range(used):
        map_of[j, j] = 1.0
    known = np.empty((used, 2, 2))
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    sigma, h, r = motion.copy(), np.empty((m, 2, 3)), np.empty((m, 2, 2))
    for k in range(m):
        i = match[k]
        if i < 0:
            continue
        q = innovation(pose, cosine, sine, offset, points[i, 0], points[i, 1], z[k])
        h[k, 0, 0], h[k, 0, 1], h[k, 0, 2] = q[2], q[3], q[4]
        h[k, 1, 0], h[k, 1, 1], h[k, 1, 2] = q[5], q[6], q[7]
        r[k, 0, 0], r[k, 0, 1], r[k, 1, 0], r[k, 1, 1] = z[k, 2], z[k, 3], z[k, 3], z[k, 4]
        own = known[slot[i]]
        own[0, 0], own[0, 1], own[1, 0], own[1, 1] = covs[i, 0], covs[i, 1], covs[i, 1], covs[i, 2]
        by_point = np.ascontiguousarray(-h[k][:, :2])
        back = sigma @ h[k].T
        s = h[k] @ back + by_point @ own @ by_point.T + r[k]
        gain = back @ np.linalg.inv(s)
        _apply(map_of, rows[0], gain, h[k], by_point, slot[i], used + 2 * k)
        sigma -= gain @ back.T
    for a in range(3):
        map_of[a, used + 2 * m + a] = 1.0
    for k in range(m):
        i = match[k]
        if i < 0:
            continue
        by_point = np.ascontiguousarray(-h[k][:, :2])
        own = known[slot[i]]
        back = own @ by_point.T
        gain = back @ np.linalg.inv(by_point @ back + r[k])
        _apply(map_of, slot[i], gain, h[k], by_point, slot[i], used + 2 * k)
        own -= gain @ back.T
    motion[:, :] = 0.0
    _map(p, size, rows, map_of, r, match, drawn * sigma)


@njit(cache=True, nogil=True, error_model="numpy")
def _slots(match: Indices, landmarks: int) -> tuple[Indices, Indices]:
    """Return where each landmark comes in the rows that change, -1 where it does not, and those rows of P."""
    slot, rows, used = np.full(landmarks, -1, np.int64), np.empty(3 + 2 * match.shape[0], np.int64), 3
    rows[0], rows[1], rows[2] = 0, 1, 2
    for i in match:
        if i >= 0 and slot[i] < 0:
            slot[i] = used
            rows[used], rows[used + 1] = 3 + 2 * i, 4 + 2 * i
            used += 2
    return slot, rows[:used]


@njit(cache=True, nogil=True, error_model="numpy")
def _apply(map_of: Array, row: int, gain: Array, by_pose: Array, by_point: Array, point: int, noise: int) -> None:
    """Let the error at ``row`` go on as e + K (v - H e), in terms of errors and noises before the update."""
    seen = by_pose @ map_of[:3] + by_point @ map_of[point : point + 2]
    seen[0, noise] -= 1.0
    seen[1, noise + 1] -= 1.0
    map_of[row : row + gain.shape[0]] -= gain @ seen


@njit(cache=True, nogil=True, error_model="numpy")
def _map(p: Array, size: int, rows: Indices, map_of: Array, r: Array, match: Indices, draw: Array) -> None:
    """P ← A P Aᵀ + B R Bᵀ + D Q Dᵀ, where A is the identity but for ``rows``."""
    used, m = rows.shape[0], match.shape[0]
    before = np.empty((used, size))
    for a in range(used):
        before[a] = p[rows[a], :size]
    a_of = np.ascontiguousarray(map_of[:, :used])
    after = a_of @ before
    block = np.empty((used, used))
    for a in range(used):
        for b in range(used):
            block[a, b] = after[a, rows[b]]
    block = block @ a_of.T
    for k in range(m):
        if match[k] >= 0:
            b_of = np.ascontiguousarray(map_of[:, used + 2 * k : used + 2 * k + 2])
            block += b_of @ r[k] @ b_of.T
    d_of = np.ascontiguousarray(map_of[:, used + 2 * m :])
    block += d_of @ draw @ d_of.T
    for a in range(used):
        for j in range(size):
            p[rows[a], j] = p[j, rows[a]] = after[a, j]
    for a in range(used):
        for b in range(used):
            p[rows[a], rows[b]] = 0.5 * (block[a, b] + block[b, a])


@njit(cache=True, nogil=True, error_model="numpy")
def _add(p: Array, size: int, pose: Array, z: Array, offset: float) -> None:
    """Add a landmark: its error is that of the pose, with the lever of the heading, and that of z."""
    theta = pose[2]
    c, s = math.cos(theta + z[1]), math.sin(theta + z[1])
    lever_x, lever_y = -offset * math.sin(theta) - z[0] * s, offset * math.cos(theta) + z[0] * c
    for j in range(size):
        p[size, j] = p[j, size] = p[0, j] + lever_x * p[2, j]
        p[size + 1, j] = p[j, size + 1] = p[1, j] + lever_y * p[2, j]
    a, b, d, e = c, -z[0] * s, s, z[0] * c
    p[size, size] = (
        p[size, 0] + lever_x * p[size, 2] + a * a * z[2] + 2.0 * a * b * z[3] + b * b * z[4]
    )  # fmt: skip
    p[size + 1, size + 1] = (
        p[size + 1, 1] + lever_y * p[size + 1, 2] + d * d * z[2] + 2.0 * d * e * z[3] + e * e * z[4]
    )  # fmt: skip
    p[size, size + 1] = p[size + 1, size] = (
        p[size, 1] + lever_y * p[size, 2] + a * d * z[2] + (a * e + b * d) * z[3] + b * e * z[4]
    )  # fmt: skip
