"""Compressed EKF-SLAM: an ordinary filter over the landmarks near by; the rest of the map is updated later.

Guivant and Nebot 2001, in the form of the design's invariant-ekf.md. While the robot stays in one region only the
state's part *a*, robot and landmarks near by, is filtered. What that does to the rest *b* is gathered in three
small matrices: Φ, by which P_ab changes from the left, Ψ and θ, by which P_bb and x_b do:

    predict   Φ ← F Φ
    update    Ψ += Φᵀ Hᵀ S⁻¹ H Φ,  θ += Φᵀ Hᵀ S⁻¹ ν,  Φ ← (I − K H) Φ
    flush     x_b += P_ba θ,  P_bb −= P_ba Ψ P_ab,  P_ab ← Φ P_ab

The flush is exact: the result is that of the full filter. It comes when the robot leaves the region, and when the
belief is read. Every landmark has a fixed place in the map's own state and covariance, so that taking another
region moves the rows of its landmarks only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.belief import Belief
from slam.ekf import EkfSlam
from slam.gaussian.joint_gaussian import landmark_by_pose, read_block, state_rows, symmetric_block
from slam.gaussian.lanes import aligned_zeros
from slam.gaussian.settings import EkfConfig
from slam.gaussian.stacked_update import NO_LIMITS, solve
from slam.gaussian.tiles import add_combination, downdate, product, subtract
from slam.landmarks.book import MARKS
from slam.settings import require
from slam.types import LINE, Observations, Odometry, Scan

__all__ = ["CompressedEkfConfig", "CompressedEkfSlam"]

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class CompressedEkfConfig(EkfConfig):
    """EKF-SLAM with postponed updates."""

    leave_share: float = 0.5  # of the sensor's reach: having moved so far, the robot takes another region
    margin_m: float = 1.0  # beyond what the sensor can reach before that: landmarks so near are filtered, too

    def __post_init__(self) -> None:
        super().__post_init__()
        require(0 < self.leave_share <= 10, "CompressedEkfConfig.leave_share must be in (0, 10]")
        require(self.margin_m >= 0, "CompressedEkfConfig.margin_m must be ≥ 0")


class CompressedEkfSlam(EkfSlam):
    """The compressed EKF-SLAM backend, ``compressed-ekf``.

    ``_x``, ``_p`` and ``_book`` of the base class are those of the region: an ordinary filter over a small map.
    """

    config: CompressedEkfConfig

    def __init__(self, config: CompressedEkfConfig | None = None) -> None:
        super().__init__(config or CompressedEkfConfig())

    def _start(self, pose: Array, pose_cov: Array, seed: int) -> None:
        super()._start(pose, pose_cov, seed)
        # The whole map: what belongs to the region is out of date here until it is left.
        self._map_x = np.zeros(len(self._x))
        self._map_p = aligned_zeros(len(self._x), len(self._x))  # upper triangle
        self._map_ids = np.zeros(len(self._x) // 2, np.int64)
        self._map_marks = np.zeros((len(self._map_ids), MARKS))
        self._near = np.zeros(0, np.int64)  # the places of the region's landmarks, in its order
        self._far = np.zeros(0, np.int64)  # those of all the others
        self._free: list[int] = []  # those of landmarks that were dropped
        self._centre = (float(pose[0]), float(pose[1]))
        self._reach = 0.0  # how far the sensor sees [m]: lately, or as it says itself
        self._made_for = 0.0  # that, when the region was chosen
        self._cross = np.zeros((3, len(self._x)))  # P_ab of the last flush; zero where b is not far
        self._begin_region()

    def _begin_region(self) -> None:
        n = self._n
        self._n0 = n
        self._phi = aligned_zeros(n + 16, n)
        self._phi[:n, :n] = np.eye(n)
        self._minus_psi, self._theta = aligned_zeros(n, n), np.zeros(n)  # the upper triangle of −Ψ
        self._u = aligned_zeros(len(self._s), n)

    # ---- the filter ----------------------------------------------------------------------------------------

    def predict(self, odometry: Odometry) -> None:
        """Move on by what the wheels measured; Φ ← F Φ."""
        x, y = self._x[0], self._x[1]
        super().predict(odometry)
        # F's entries by θ are J times the step: see slam.motion.predict_robot.
        self._phi[0] -= (self._x[1] - y) * self._phi[2]
        self._phi[1] += (self._x[0] - x) * self._phi[2]

    def _update(self, scan: Scan) -> None:
        """Correct by the corners of a scan, in the region of what it can show."""
        self._settle(scan.range_max)
        super()._update(scan)

    def observe(self, observations: Observations) -> None:
        """Correct by landmark observations, in the region that holds them."""
        rb = np.asarray(observations.range_bearing, dtype=np.float64).reshape(-1, 2)
        finite = rb[np.isfinite(rb[:, 0]), 0]
        self._settle(float(finite.max()) if len(finite) else 0.0)
        if observations.ids is not None:
            ids = np.asarray(observations.ids)
            strangers = [int(i) for i in ids if self._book.row(int(i)) < 0]  # mostly none, which is soon seen
            if strangers and np.isin(strangers, self._map_ids[self._far]).any():
                self._choose_region(ids)
        super().observe(observations)

    def _relocate(self, pose: Array, cov: Array, scan: Scan) -> None:
        self._place(pose, cov)
        self._choose_region(np.zeros(0, np.int64))
        super()._relocate(pose, cov, scan)

    def _correct(self, z: Array, match: NDArray[np.int64], limits: Array = NO_LIMITS) -> None:
        super()._correct(z, match, limits)
        if self.nis_dof and len(self._far):
            _postpone(
                self._phi, self._minus_psi, self._theta, self._u, self._n, self._n0, match, self._h, self._w,
                self._s,
            )  # fmt: skip

    def _fit(self, z: Array, match: NDArray[np.int64], scan: Scan) -> float:
        kept = self._phi.copy(), self._minus_psi.copy(), self._theta.copy()  # this correction is only a trial
        value = super()._fit(z, match, scan)
        self._phi, self._minus_psi, self._theta = kept
        return value

    def _add(self, z: Array, known_id: int | None) -> None:
        n = self._n
        if n + 2 > len(self._phi):
            self._phi = np.vstack([self._phi, np.zeros_like(self._phi)])
        self._phi[n : n + 2] = landmark_by_pose(self._x, z, self.config.lidar_offset_m) @ self._phi[:3]
        super()._add(z, known_id)
        if not self._free:
            self._free.append(len(self._near) + len(self._far))  # every place before it is taken
        self._near = np.append(self._near, self._free.pop())

    def _drop(self, row: int) -> None:
        n, i = self._n, 3 + 2 * row
        self._phi[i : n - 2] = self._phi[i + 2 : n]
        self._free.append(int(self._near[row]))
        self._near = np.delete(self._near, row)
        super()._drop(row)

    def _enlarge(self) -> None:
        super()._enlarge()
        self._u = aligned_zeros(len(self._s), self._n0)

    def _place(self, pose: Array, pose_cov: Array) -> None:
        self.flush()
        super()._place(pose, pose_cov)
        self._cross[:3] = 0.0

    # ---- regions -------------------------------------------------------------------------------------------

    def _settle(self, reach: float) -> None:
        """Take another region where the robot has left this one, or sees farther than it was made for."""
        share, margin = self.config.leave_share, self.config.margin_m
        self._reach = max(reach, 0.95 * self._reach)
        beyond = reach > self._made_for + margin and len(self._far) > 0
        moved = math.hypot(self._x[0] - self._centre[0], self._x[1] - self._centre[1])
        if beyond or moved > share * max(self._made_for, margin) or self._reach < 0.5 * self._made_for:
            self._choose_region(np.zeros(0, np.int64))

    def _choose_region(self, also: NDArray[np.int64]) -> None:
        """Flush, and filter from now on what is near the robot, and the landmarks with these ids."""
        self.flush()
        self._write_back()
        places = np.sort(np.concatenate([self._near, self._far]))
        marks = self._map_marks[places]
        self._centre, self._made_for = (float(self._x[0]), float(self._x[1])), self._reach
        radius = (1.0 + self.config.leave_share) * self._reach + self.config.margin_m
        near = _distance(self._map_x[3:].reshape(-1, 2)[places], marks, *self._centre) < radius
        near |= np.isin(self._map_ids[places], also)
        self._near, self._far = places[near], places[~near]
        self._book.replace(self._map_ids[self._near], marks[near])
        a, b = state_rows(self._near, robot=True), state_rows(self._far, robot=False)
        while len(a) + 2 > len(self._x):
            self._enlarge()
        self._n = len(a)
        self._x[: self._n] = self._map_x[a]
        rows = np.empty((len(a), self._map_p.shape[1]))
        _read_rows(self._map_p, 3 + 2 * (len(places) + len(self._free)), a, rows)
        self._p[: self._n, : self._n] = rows[:, a]
        self._cross = aligned_zeros(*rows.shape)
        self._cross[:, b] = rows[:, b]
        self._begin_region()

    def flush(self) -> None:
        """Bring the rest of the map up to date: what the full filter would have."""
        if len(self._far):
            size, cross = 5 + 2 * int(self._far.max()), self._cross
            add_combination(self._map_x, size, self._theta, cross)
            psi = np.empty((self._n0, self._n0))
            symmetric_block(-self._minus_psi, psi)
            downdate(self._map_p, size, cross, product(psi, cross, size), self._n0, 0)
            self._cross = product(self._phi[: self._n, : self._n0], cross, size)
        self._begin_region()

    def _write_back(self) -> None:
        """Write the region into the whole map; right after a flush."""
        a, b = state_rows(self._near, robot=True), state_rows(self._far, robot=False)
        needed = int(max(a.max(), b.max(initial=0))) + 1
        if needed > len(self._map_x):
            self._enlarge_map(2 * needed + 1)
        self._map_x[a] = self._x[: self._n]
        self._map_ids[self._near], self._map_marks[self._near] = self._book.ids, self._book.marks
        _write_rows(self._map_p, a, b, self._p, self._cross)

    def _enlarge_map(self, size: int) -> None:
        old = len(self._map_x)
        x, p, ids, marks = self._map_x, self._map_p, self._map_ids, self._map_marks
        self._map_x, self._map_p = np.zeros(size), aligned_zeros(size, size)
        self._map_ids, self._map_marks = np.zeros(size // 2, np.int64), np.zeros((size // 2, MARKS))
        self._map_x[:old], self._map_p[:old, :old] = x, p[:old, :old]
        self._map_ids[: len(ids)], self._map_marks[: len(ids)] = ids, marks

    # ---- the belief ----------------------------------------------------------------------------------------

    @property
    def belief(self) -> Belief:
        """Pose, landmarks, joint covariance and grid."""
        self.flush()
        self._write_back()
        return super().belief

    def _covariance(self, landmarks: NDArray[np.int64]) -> Array:
        self.flush()
        self._write_back()
        rows = state_rows(np.concatenate([self._near, self._far])[landmarks], robot=True)
        out = np.empty((len(rows), len(rows)))
        read_block(self._map_p, rows, out)
        return out

    @property
    def landmark_count(self) -> int:
        """Number of landmarks in the map."""
        return self._book.count + len(self._far)

    @property
    def _marks(self) -> Array:
        return np.vstack([self._book.marks, self._map_marks[self._far]])

    @property
    def _ids(self) -> NDArray[np.int64]:
        return np.concatenate([self._book.ids, self._map_ids[self._far]])

    def _map_points(self) -> tuple[Array, NDArray[np.int64]]:
        """Return every landmark's estimate ``(n, 2)``, the region's first, and which row an id has."""
        ids = self._ids
        row_of_id = np.full(max(len(self._book.row_of_id), int(ids.max(initial=0)) + 1), -1, np.int64)
        row_of_id[ids] = np.arange(len(ids))
        return np.concatenate([self._points, self._map_x[3:].reshape(-1, 2)[self._far]]), row_of_id


def _distance(x: Array, marks: Array, px: float, py: float) -> Array:
    """Return how far each landmark ``(n, 2)`` is from a point: of a wall its nearest end or piece."""
    out = np.hypot(x[:, 0] - px, x[:, 1] - py)
    walls = marks[:, 0] == LINE
    alpha, r = x[walls].T
    c, s = np.cos(alpha), np.sin(alpha)
    along = c * py - s * px
    beyond = np.maximum(np.maximum(marks[walls, 6] - along, along - marks[walls, 7]), 0.0)
    out[walls] = np.hypot(c * px + s * py - r, beyond)
    return np.asarray(out)


@njit(cache=True, nogil=True, error_model="numpy")
def _postpone(
    phi: Array, minus_psi: Array, theta: Array, u: Array, n: int, n0: int, match: NDArray[np.int64], h: Array,
    w: Array, s: Array,
) -> None:  # fmt: skip
    """Gather what an update does to the rest of the map; ``w`` and ``s`` as :func:`whiten` left them.

    With U = L⁻¹ H Φ: Ψ += Uᵀ U, θ += Uᵀ L⁻¹ ν, Φ −= Wᵀ U. Of −Ψ only the upper triangle is kept.
    """
    rows = 0
    for k in range(match.shape[0]):
        if match[k] < 0:
            continue
        m = 3 + 2 * match[k]
        hk = h[rows // 2]
        u[rows, :n0] = 0.0
        u[rows + 1, :n0] = 0.0
        for e in range(2):
            add_combination(u[rows + e], n0, hk[e, :3], phi)
            add_combination(u[rows + e], n0, hk[e, 3:], phi[m:])
        rows += 2
    solve(s, u, n0, rows)
    add_combination(theta, n0, s[:rows, rows], u)
    downdate(minus_psi, n0, u, u, rows, 0)
    subtract(phi, n, n0, w, u, rows)


@njit(cache=True, nogil=True, error_model="numpy")
def _read_rows(p: Array, n: int, rows: NDArray[np.int64], out: Array) -> None:
    """Write rows of the symmetric matrix whose upper triangle is p, their first ``n`` columns."""
    for k in range(rows.shape[0]):
        i = rows[k]
        for j in range(min(i, n)):
            out[k, j] = p[j, i]
        for j in range(i, n):
            out[k, j] = p[i, j]


@njit(cache=True, nogil=True, error_model="numpy")
def _write_rows(p: Array, a: NDArray[np.int64], b: NDArray[np.int64], block: Array, cross: Array) -> None:
    """Write P_aa, an upper triangle, and P_ab, whose columns are the map's own, into p's upper triangle."""
    for k in range(a.shape[0]):
        i = a[k]
        for e in range(k, a.shape[0]):
            p[min(i, a[e]), max(i, a[e])] = block[k, e]
        for j in b:
            p[min(i, j), max(i, j)] = cross[k, j]
