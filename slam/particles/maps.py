"""The landmarks of many particles, shared wherever they are the same.

Every particle has its own estimate of every landmark, yet most of them are equal: resampling makes copies, and a
scan shows but a few landmarks. So the estimates lie in one pool of records with a count of references, and a
particle has a table of where its landmarks lie. Resampling copies tables and counts references; a landmark is
written in place where one particle alone refers to it, and otherwise into a record of its own (copy on write).
Two copies of a particle that wrote to one and the same record would be the classic fault of FastSLAM programs.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from slam.geometry import wrap_scalar
from slam.landmarks.association import IGNORED, UNMATCHED, own_reach
from slam.types import Array, Indices

__all__ = ["ParticleMaps", "associate", "correct_landmark", "innovation", "own", "refresh_extents"]

_RECORD = 5  # x, y [m], σxx, σxy, σyy [m²] given the particle's path


class ParticleMaps:
    """Landmark rows ``0 … count-1``, the same ones in every particle, each with the particle's own estimate."""

    def __init__(self, particles: int) -> None:
        self.count = 0
        self.table = np.zeros((particles, 32), np.int64)  # (particle, row) → record
        self.records = np.zeros((4 * particles, _RECORD))
        self.references = np.zeros(len(self.records), np.int64)
        self.free = np.arange(len(self.records))[::-1].copy()  # a stack of the records that nobody refers to …
        self.free_count = np.array([len(self.records)])  # … and its height
        # Smallest and largest x and y of each landmark over the particles (or somewhat wider).
        self.extents = np.zeros((32, 4))

    def of(self, particle: int) -> Array:
        """Return one particle's landmarks ``(n, 5)``: x, y [m], σxx, σxy, σyy [m²]."""
        return self.records[self.table[particle, : self.count]]

    def reserve(self, records: int) -> None:
        """Make sure that so many records are free, so that kernels may take them."""
        while self.free_count[0] < records:
            size, free = len(self.records), int(self.free_count[0])
            self.records = np.vstack([self.records, np.zeros_like(self.records)])
            self.references = np.concatenate([self.references, np.zeros_like(self.references)])
            stack = np.zeros(2 * size, np.int64)
            stack[:free] = self.free[:free]
            stack[free : free + size] = np.arange(size, 2 * size)
            self.free = stack
            self.free_count[0] = free + size

    def add(self, poses: Array, z: Array, offset: float) -> None:
        """Append a landmark, seen as observation row ``z`` from each particle's pose ``(particles, 3)``."""
        if self.count == self.table.shape[1]:
            self.table = np.hstack([self.table, np.zeros_like(self.table)])
            self.extents = np.vstack([self.extents, np.zeros_like(self.extents)])
        self.reserve(len(self.table))
        row = self.count
        _add(poses, z, offset, row, self.table, self.records, self.references, self.free, self.free_count)
        self.count = row + 1
        refresh_extents(self.table, self.records, np.array([[row]]), self.extents)

    def drop(self, row: int) -> None:
        """Take a landmark out of every particle; those after it move up."""
        n = self.count
        _release(self.table[:, row].copy(), self.references, self.free, self.free_count)
        self.table[:, row : n - 1] = self.table[:, row + 1 : n]
        self.extents[row : n - 1] = self.extents[row + 1 : n]
        self.count = n - 1

    def resample(self, ancestors: Indices) -> None:
        """Give each particle its ancestor's map, as :func:`slam.particles.resampling.systematic` says."""
        _resample(ancestors, self.count, self.table, self.references, self.free, self.free_count)

    def mixture(self, weights: Array) -> tuple[Array, Array]:
        """Return the mean ``(n, 2)`` and the covariance ``(n, 2, 2)`` over particles of these weights.

        The covariance is the mean of the particles' own, plus how much their estimates differ.
        """
        mean, cov = np.zeros((self.count, 2)), np.zeros((self.count, 2, 2))
        _mixture(weights, self.table, self.records, mean, cov)
        return mean, cov


@njit(cache=True, nogil=True, error_model="numpy")
def own(
    particle: int, row: int, table: Indices, references: Indices, free: Indices, free_count: Indices
) -> int:  # fmt: skip
    """Return a record that this particle's landmark may be written to: copy on write, without the copying."""
    record = table[particle, row]
    if references[record] == 1:
        return int(record)
    references[record] -= 1
    free_count[0] -= 1
    record = free[free_count[0]]
    references[record] = 1
    table[particle, row] = record
    return int(record)


@njit(cache=True, nogil=True, error_model="numpy")
def _release(records: Indices, references: Indices, free: Indices, free_count: Indices) -> None:
    for record in records:
        references[record] -= 1
        if references[record] == 0:
            free[free_count[0]] = record
            free_count[0] += 1


@njit(cache=True, nogil=True, error_model="numpy")
def _resample(
    ancestors: Indices, count: int, table: Indices, references: Indices, free: Indices, free_count: Indices
) -> None:  # fmt: skip
    for i in range(ancestors.shape[0]):
        a = ancestors[i]
        if a == i:
            continue
        # The ancestor keeps its place, so its table is the old one, whatever has been overwritten before.
        for row in range(count):
            references[table[a, row]] += 1
        _release(table[i, :count], references, free, free_count)
        table[i, :count] = table[a, :count]


@njit(cache=True, nogil=True, error_model="numpy")
def _add(
    poses: Array, z: Array, offset: float, row: int, table: Indices, records: Array, references: Indices,
    free: Indices, free_count: Indices,
) -> None:  # fmt: skip
    """Add landmarks; given the particle's path the pose is known, so P_new,new = Gz R Gzᵀ."""
    for i in range(poses.shape[0]):
        free_count[0] -= 1
        record = free[free_count[0]]
        references[record] = 1
        table[i, row] = record
        theta = poses[i, 2]
        c, s = math.cos(theta + z[1]), math.sin(theta + z[1])
        a, b, d, e = c, -z[0] * s, s, z[0] * c
        r = records[record]
        r[0] = poses[i, 0] + offset * math.cos(theta) + z[0] * c
        r[1] = poses[i, 1] + offset * math.sin(theta) + z[0] * s
        r[2] = a * a * z[2] + 2.0 * a * b * z[3] + b * b * z[4]
        r[3] = a * d * z[2] + (a * e + b * d) * z[3] + b * e * z[4]
        r[4] = d * d * z[2] + 2.0 * d * e * z[3] + e * e * z[4]


@njit(cache=True, nogil=True, error_model="numpy")
def refresh_extents(table: Indices, records: Array, match: Indices, extents: Array) -> None:
    """Write anew the extents of the rows in ``match``: smallest and largest x and y over the particles."""
    seen = np.zeros(extents.shape[0], np.bool_)
    for i in range(match.shape[0]):
        for k in range(match.shape[1]):
            if match[i, k] >= 0:
                seen[match[i, k]] = True
    for row in range(extents.shape[0]):
        if not seen[row]:
            continue
        x0 = y0 = math.inf
        x1 = y1 = -math.inf
        for i in range(table.shape[0]):
            j = table[i, row]
            x0, x1 = min(x0, records[j, 0]), max(x1, records[j, 0])
            y0, y1 = min(y0, records[j, 1]), max(y1, records[j, 1])
        extents[row, 0], extents[row, 1], extents[row, 2], extents[row, 3] = x0, x1, y0, y1


@njit(cache=True, nogil=True, error_model="numpy")
def _mixture(weights: Array, table: Indices, records: Array, mean: Array, cov: Array) -> None:
    for row in range(mean.shape[0]):
        # Relative to the first particle's, lest the squares of far-off positions swallow the differences.
        x, y = records[table[0, row], 0], records[table[0, row], 1]
        mx = my = xx = xy = yy = 0.0
        for i in range(weights.shape[0]):
            w, j = weights[i], table[i, row]
            dx, dy = records[j, 0] - x, records[j, 1] - y
            mx, my = mx + w * dx, my + w * dy
            xx += w * (records[j, 2] + dx * dx)
            xy += w * (records[j, 3] + dx * dy)
            yy += w * (records[j, 4] + dy * dy)
        mean[row, 0], mean[row, 1] = x + mx, y + my
        cov[row, 0, 0], cov[row, 1, 1] = xx - mx * mx, yy - my * my
        cov[row, 0, 1] = cov[row, 1, 0] = xy - mx * my


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def innovation(
    pose: Array, c: float, s: float, offset: float, mx: float, my: float, z: Array
) -> tuple[float, float, float, float, float, float, float, float]:
    """Return ν (range, bearing) and H by the pose, row by row: (νρ, νφ, h00, h01, h02, h10, h11, h12).

    ``c`` and ``s`` are cos θ and sin θ, ``offset`` is L, the landmark is at ``mx``, ``my``. H by the landmark is
    minus the first two columns (docs/reference/ekf.md).
    """
    dx, dy = pose[0] + offset * c - mx, pose[1] + offset * s - my
    rho2 = max(dx * dx + dy * dy, 1e-12)  # a landmark on the sensor itself has no bearing, but must do no harm
    rho = math.sqrt(rho2)
    nx, ny = dx / rho, dy / rho
    tx, ty = nx / rho, ny / rho
    return (
        z[0] - rho, wrap_scalar(z[1] - math.atan2(-dy, -dx) + pose[2]),
        nx, ny, offset * (ny * c - nx * s),
        -ty, tx, offset * (tx * c + ty * s) - 1.0,
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def associate(
    poses: Array, covs: Array, offset: float, z: Array, marks: Array, gate: float, near: float, max_turn: float,
    table: Indices, records: Array, extents: Array, match: Indices,
) -> int:  # fmt: skip
    """Match observations to landmarks in every particle; return the particle that matched most of them.

    Nearest neighbour within the gate, each landmark once, by the rules of
    :func:`slam.landmarks.association.nearest_neighbour`; S has the pose's covariance (zero where the pose was
    drawn), the landmark's and R.

    Parameters
    ----------
    poses, covs : Array
        ``(particles, 3)`` and ``(particles, 3, 3)``, upper triangles.
    z, marks, gate, near, max_turn
        As in :func:`slam.landmarks.association.nearest_neighbour`.
    match : Indices
        ``(particles, m)`` filled: landmark row, UNMATCHED or IGNORED.
    """
    particles, m, n = poses.shape[0], z.shape[0], marks.shape[0]
    spread = turn = 0.0
    for i in range(particles):
        spread = max(spread, math.sqrt(covs[i, 0, 0] + covs[i, 1, 1]))
        turn = max(turn, math.sqrt(covs[i, 2, 2]))
    points, turns = np.empty((particles, 2)), np.empty((particles, 2))
    for i in range(particles):
        turns[i, 0], turns[i, 1] = math.cos(poses[i, 2]), math.sin(poses[i, 2])
    candidates = np.empty(n, np.int64)
    distance = np.empty((particles, m))
    for k in range(m):
        window = 0.3 + 4.0 * (spread + z[k, 0] * turn) + own_reach(z[k])
        ahead, left = offset + z[k, 0] * math.cos(z[k, 1]), z[k, 0] * math.sin(z[k, 1])
        x0 = y0 = math.inf
        x1 = y1 = -math.inf
        for i in range(particles):
            c, s = turns[i, 0], turns[i, 1]
            px, py = poses[i, 0] + ahead * c - left * s, poses[i, 1] + ahead * s + left * c
            points[i, 0], points[i, 1] = px, py
            x0, x1, y0, y1 = min(x0, px), max(x1, px), min(y0, py), max(y1, py)
        # Once for all particles: which landmarks can be near at all.
        count = 0
        for row in range(n):
            e = extents[row]
            apart_x, apart_y = max(e[0] - x1, x0 - e[1]), max(e[2] - y1, y0 - e[3])
            if apart_x <= window and apart_y <= window and (
                z[k, 5] == 0.0 or marks[row, 0] == 0.0 or (z[k, 5] == marks[row, 0] and z[k, 7] == marks[row, 6])
            ):  # fmt: skip
                candidates[count] = row
                count += 1
        for i in range(particles):
            match[i, k], distance[i, k] = UNMATCHED, math.inf
            theta = poses[i, 2]
            for q in range(count):
                row = candidates[q]
                j = table[i, row]
                dx, dy = records[j, 0] - points[i, 0], records[j, 1] - points[i, 1]
                if abs(dx) > window or abs(dy) > window:
                    continue
                known = z[k, 5] != 0.0 and marks[row, 0] != 0.0
                if known and abs(wrap_scalar(z[k, 6] + theta - marks[row, 1])) > max_turn:
                    continue
                d2 = _squared_distance(poses[i], covs[i], turns[i], offset, records[j], z[k])
                if d2 < gate and d2 < distance[i, k]:
                    match[i, k], distance[i, k] = row, d2
                elif match[i, k] == UNMATCHED and dx * dx + dy * dy < near * near:
                    match[i, k] = IGNORED
    best = most = 0
    for i in range(particles):
        matched = 0
        for k in range(m):
            # Two observations cannot be one landmark: the farther gives way.
            for j in range(k):
                if match[i, k] >= 0 and match[i, k] == match[i, j]:
                    match[i, k if distance[i, k] >= distance[i, j] else j] = IGNORED
        for k in range(m):
            matched += match[i, k] >= 0
        if matched > most:
            best, most = i, matched
    return best


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _squared_distance(pose: Array, p: Array, turn: Array, offset: float, landmark: Array, z: Array) -> float:
    u, v, a, b, c, d, e, f = innovation(pose, turn[0], turn[1], offset, landmark[0], landmark[1], z)
    # The landmark's covariance and the pose's meet in x and y; S = H P Hᵀ + R by the pose's H alone.
    xx, xy, yy = p[0, 0] + landmark[2], p[0, 1] + landmark[3], p[1, 1] + landmark[4]
    xt, yt, tt = p[0, 2], p[1, 2], p[2, 2]
    s00 = z[2] + a * a * xx + b * b * yy + c * c * tt + 2.0 * (a * b * xy + a * c * xt + b * c * yt)
    s11 = z[4] + d * d * xx + e * e * yy + f * f * tt + 2.0 * (d * e * xy + d * f * xt + e * f * yt)
    s01 = (
        z[3] + a * d * xx + b * e * yy + c * f * tt
        + (a * e + b * d) * xy + (a * f + c * d) * xt + (b * f + c * e) * yt
    )  # fmt: skip
    return float((s11 * u * u - 2.0 * s01 * u * v + s00 * v * v) / (s00 * s11 - s01 * s01))


@njit(cache=True, nogil=True, error_model="numpy")
def correct_landmark(
    pose: Array, c: float, s: float, offset: float, z: Array, before: Array, after: Array
) -> None:  # fmt: skip
    """Write the EKF update of a landmark seen from a known pose; ``before`` and ``after`` may be one record."""
    u, v, a, b, _, d, e, _ = innovation(pose, c, s, offset, before[0], before[1], z)
    xx, xy, yy = before[2], before[3], before[4]
    gx, hx = -(xx * a + xy * b), -(xx * d + xy * e)  # P H_mᵀ; H_m = −H_x
    gy, hy = -(xy * a + yy * b), -(xy * d + yy * e)
    s00, s01, s11 = z[2] - a * gx - b * gy, z[3] - d * gx - e * gy, z[4] - d * hx - e * hy
    l00 = math.sqrt(s00)
    l10 = s01 / l00
    l11 = math.sqrt(s11 - l10 * l10)
    y0 = u / l00
    y1 = (v - l10 * y0) / l11
    gx, gy = gx / l00, gy / l00
    hx, hy = (hx - l10 * gx) / l11, (hy - l10 * gy) / l11
    after[0] = before[0] + gx * y0 + hx * y1
    after[1] = before[1] + gy * y0 + hy * y1
    after[2] = xx - gx * gx - hx * hx
    after[3] = xy - gx * gy - hx * hy
    after[4] = yy - gy * gy - hy * hy
