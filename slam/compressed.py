"""Compressed EKF-SLAM: an ordinary filter over the landmarks near by; the rest of the map is updated later.

Guivant and Nebot 2001, in the form of the design's invariant-ekf.md. While the robot stays in one region only the
state's part *a*, robot and landmarks near by, is filtered. What that does to the rest *b* is gathered in three
small matrices: Φ, by which P_ab changes from the left, Ψ and θ, by which P_bb and x_b do:

    predict   Φ ← F Φ
    update    Ψ += Φᵀ Hᵀ S⁻¹ H Φ,  θ += Φᵀ Hᵀ S⁻¹ ν,  Φ ← (I − K H) Φ
    flush     x_b += P_ba θ,  P_bb −= P_ba Ψ P_ab,  P_ab ← Φ P_ab

The flush is exact: the result is that of the full filter. It comes when the robot leaves the region, and when the
belief is read.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.blas import product
from slam.ekf import EkfConfig, EkfSlam
from slam.joint_gaussian import symmetric_block
from slam.landmarks import KIND
from slam.settings import require
from slam.types import LINE, Belief, Observations, Odometry, Scan

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
        self._far_ids = np.zeros(0, np.int64)
        self._far_marks = np.zeros((0, 8))
        self._far_x = np.zeros(0)
        self._far_p = np.zeros((0, 0))  # P_bb, both triangles
        self._cross = np.zeros((3, 0))  # P_ab of the last flush
        self._centre = (float(pose[0]), float(pose[1]))
        self._reach = 0.0  # how far the sensor sees [m]: lately, or as it says itself
        self._made_for = 0.0  # that, when the region was chosen
        self._begin_region()

    def _begin_region(self) -> None:
        n = self._n
        self._n0 = n
        self._phi = np.zeros((n + 16, n))
        self._phi[:n] = np.eye(n)
        self._psi, self._theta = np.zeros((n, n)), np.zeros(n)
        self._u = np.zeros((len(self._s), n))

    # ---- the filter ----------------------------------------------------------------------------------------

    def predict(self, odometry: Odometry) -> None:
        """Move on by what the wheels measured; Φ ← F Φ."""
        x, y = self._x[0], self._x[1]
        super().predict(odometry)
        # F's entries by θ are J times the step: see slam.motion.predict_robot.
        self._phi[0] -= (self._x[1] - y) * self._phi[2]
        self._phi[1] += (self._x[0] - x) * self._phi[2]

    def update(self, scan: Scan) -> None:
        """Correct by the corners of a scan, in the region of what it can show."""
        self._settle(scan.range_max)
        super().update(scan)

    def observe(self, observations: Observations) -> None:
        """Correct by landmark observations, in the region that holds them."""
        rb = np.asarray(observations.range_bearing, dtype=np.float64).reshape(-1, 2)
        finite = rb[np.isfinite(rb[:, 0]), 0]
        self._settle(float(finite.max()) if len(finite) else 0.0)
        if observations.ids is not None and np.isin(observations.ids, self._far_ids).any():
            self._choose_region(np.asarray(observations.ids))
        super().observe(observations)

    def _correct(self, z: Array, match: NDArray[np.int64]) -> None:
        super()._correct(z, match)
        if self.nis_dof and len(self._far_ids):
            _postpone(
                self._phi, self._psi, self._theta, self._u, self._n, self._n0, match, self._h, self._w, self._s
            )

    def _fit(self, z: Array, match: NDArray[np.int64], scan: Scan) -> float:
        kept = self._phi.copy(), self._psi.copy(), self._theta.copy()  # this correction is only a trial
        value = super()._fit(z, match, scan)
        self._phi, self._psi, self._theta = kept
        return value

    def _add(self, z: Array, known_id: int | None) -> None:
        n = self._n
        if n + 2 > len(self._phi):
            self._phi = np.vstack([self._phi, np.zeros_like(self._phi)])
        # G_r of the new landmark (slam.joint_gaussian.add_landmark) times Φ's three robot rows.
        x, y, theta = self._x[:3].tolist()
        offset, phi = self.config.lidar_offset_m, self._phi
        away_x = offset * math.cos(theta) + (0.0 if z[KIND] == LINE else z[0] * math.cos(theta + z[1]))
        away_y = offset * math.sin(theta) + (0.0 if z[KIND] == LINE else z[0] * math.sin(theta + z[1]))
        if z[KIND] == LINE:
            nx, ny = math.cos(theta + z[1]), math.sin(theta + z[1])
            lever = nx * (y + away_y) - ny * (x + away_x)
            turn = lever + ny * away_x - nx * away_y
            phi[n] = phi[2]
            phi[n + 1] = nx * phi[0] + ny * phi[1] + turn * phi[2]
        else:
            phi[n] = phi[0] - away_y * phi[2]
            phi[n + 1] = phi[1] + away_x * phi[2]
        super()._add(z, known_id)

    def _drop(self, row: int) -> None:
        n, i = self._n, 3 + 2 * row
        self._phi[i : n - 2] = self._phi[i + 2 : n]
        super()._drop(row)

    def _enlarge(self) -> None:
        super()._enlarge()
        self._u = np.zeros((len(self._s), self._n0))

    # ---- regions -------------------------------------------------------------------------------------------

    def _settle(self, reach: float) -> None:
        """Take another region where the robot has left this one, or sees farther than it was made for."""
        share, margin = self.config.leave_share, self.config.margin_m
        self._reach = max(reach, 0.95 * self._reach)
        beyond = reach > self._made_for + margin and len(self._far_ids) > 0
        moved = math.hypot(self._x[0] - self._centre[0], self._x[1] - self._centre[1])
        if beyond or moved > share * max(self._made_for, margin) or self._reach < 0.5 * self._made_for:
            self._choose_region(np.zeros(0, np.int64))

    def _choose_region(self, also: NDArray[np.int64]) -> None:
        """Flush, and filter from now on what is near the robot, and the landmarks with these ids."""
        self.flush()
        joint, x = self._whole(), np.concatenate([self._x[3 : self._n], self._far_x]).reshape(-1, 2)
        marks = np.vstack([self._book.marks, self._far_marks])
        ids = np.concatenate([self._book.ids, self._far_ids])
        self._centre, self._made_for = (float(self._x[0]), float(self._x[1])), self._reach
        radius = (1.0 + self.config.leave_share) * self._reach + self.config.margin_m
        near = _distance(x, marks, *self._centre) < radius
        near |= np.isin(ids, also)
        rows, far = np.flatnonzero(near), np.flatnonzero(~near)
        self._book.replace(ids[rows], marks[rows])
        a, b = _state_rows(rows, robot=True), _state_rows(far, robot=False)
        while len(a) + 2 > len(self._x):
            self._enlarge()
        self._n = len(a)
        self._x[3 : self._n] = x[rows].ravel()
        self._p[: self._n, : self._n] = joint[np.ix_(a, a)]
        self._far_ids, self._far_marks, self._far_x = ids[far], marks[far], x[far].ravel()
        self._far_p, self._cross = joint[np.ix_(b, b)], joint[np.ix_(a, b)]
        self._begin_region()

    def flush(self) -> None:
        """Bring the rest of the map up to date: what the full filter would have."""
        self._far_x += self._cross.T @ self._theta
        self._far_p -= product(np.ascontiguousarray(self._cross.T), product(self._psi, self._cross))
        self._cross = product(self._phi[: self._n], self._cross)
        self._begin_region()

    def _whole(self) -> Array:
        """Return the joint covariance, region first; right after a flush."""
        n, m = self._n, len(self._far_x)
        joint = np.empty((n + m, n + m))
        symmetric_block(self._p, joint[:n, :n])
        joint[:n, n:], joint[n:, :n], joint[n:, n:] = self._cross, self._cross.T, self._far_p
        return joint

    # ---- the belief ----------------------------------------------------------------------------------------

    @property
    def joint_cov(self) -> Array:
        """Covariance ``(3 + 2n, 3 + 2n)`` of the robot and every landmark, the region's first."""
        self.flush()
        return self._whole()

    @property
    def landmark_count(self) -> int:
        """Number of landmarks in the map."""
        return self._book.count + len(self._far_ids)

    def landmark_details(self) -> tuple[NDArray[np.int64], Array]:
        """Return per landmark how often it was seen and its direction, in the belief's order."""
        marks = np.vstack([self._book.marks, self._far_marks])
        marks = marks[marks[:, 0] != LINE]
        return marks[:, 2].astype(np.int64), np.where(marks[:, 0] == 0, np.nan, marks[:, 1])

    @property
    def belief(self) -> Belief:
        """Pose, landmarks, joint covariance and grid; reading it costs a flush."""
        joint = self.joint_cov
        marks = np.vstack([self._book.marks, self._far_marks])
        ids = np.concatenate([self._book.ids, self._far_ids])
        x = np.concatenate([self._x[3 : self._n], self._far_x]).reshape(-1, 2)
        rows, lines = np.flatnonzero(marks[:, 0] != LINE), np.flatnonzero(marks[:, 0] == LINE)
        keep = _state_rows(rows, robot=True)
        joint = joint[np.ix_(keep, keep)]
        index = 3 + 2 * np.arange(len(rows))
        cov = np.array([[joint[index + a, index + b] for b in range(2)] for a in range(2)]).transpose(2, 0, 1)
        near = super().belief
        return dataclasses.replace(
            near,
            landmarks=x[rows],
            landmark_cov=cov,
            landmark_ids=ids[rows],
            landmark_kinds=marks[rows, 0].astype(np.int8),
            joint_cov=joint,
            lines=x[lines],
            line_ends=self._ends_of(x[lines], marks[lines, 6:8]),
        )

    def _map_points(self) -> tuple[Array, NDArray[np.int64]]:
        ids = np.concatenate([self._book.ids, self._far_ids])
        row_of_id = np.full(max(len(self._book.row_of_id), int(ids.max(initial=0)) + 1), -1, np.int64)
        row_of_id[ids] = np.arange(len(ids))
        return np.concatenate([self._x[3 : self._n], self._far_x]).reshape(-1, 2), row_of_id


def _state_rows(landmarks: NDArray[np.int64], *, robot: bool) -> NDArray[np.int64]:
    """Return the state's indices of landmarks, after the robot's three if wanted."""
    rows = np.column_stack([3 + 2 * landmarks, 4 + 2 * landmarks]).ravel()
    return np.concatenate([np.arange(3), rows]) if robot else rows


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


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _postpone(
    phi: Array, psi: Array, theta: Array, u: Array, n: int, n0: int, match: NDArray[np.int64], h: Array, w: Array,
    s: Array,
) -> None:  # fmt: skip
    """Gather what an update does to the rest of the map; ``w`` and ``s`` as :func:`whiten` left them.

    With U = L⁻¹ H Φ: Ψ += Uᵀ U, θ += Uᵀ L⁻¹ ν, Φ −= Wᵀ U.
    """
    rows = 0
    for k in range(match.shape[0]):
        if match[k] < 0:
            continue
        m = 3 + 2 * match[k]
        hk = h[rows // 2]
        for e in range(2):
            ue = u[rows + e, :n0]
            for j in range(n0):
                ue[j] = hk[e, 3] * phi[m, j] + hk[e, 4] * phi[m + 1, j]
            for q in range(3):
                factor, pq = hk[e, q], phi[q]
                for j in range(n0):
                    ue[j] += factor * pq[j]
        rows += 2
    for i in range(rows):
        ui = u[i, :n0]
        for j in range(i):
            factor, uj = s[j, i], u[j]
            for q in range(n0):
                ui[q] -= factor * uj[q]
        inverse, y = s[i, i], s[i, rows]
        for q in range(n0):
            ui[q] *= inverse
            theta[q] += y * ui[q]
    for i in range(rows):
        ui = u[i, :n0]
        for a in range(n0):
            factor, row = ui[a], psi[a]
            for q in range(n0):
                row[q] += factor * ui[q]
        wi = w[i]
        for a in range(n):
            factor, row = wi[a], phi[a]
            for q in range(n0):
                row[q] -= factor * ui[q]
