"""EKF-SLAM over corner points (theory.md A): one joint Gaussian of the robot and every landmark.

The covariance is kept as its upper triangle. All observations of a scan make one stacked update, a rank-2m
downdate of the triangle; a scan's own cost is linear in the landmarks but for that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.association import innovation_blocks, nearest_neighbour
from slam.backend import OBSERVED_LIMIT, Backend, BackendConfig
from slam.geometry import wrap_scalar
from slam.landmarks import DIRECTION, KIND, LandmarkBook, LandmarkPolicy
from slam.motion import predict_robot
from slam.settings import require
from slam.types import Belief, Observations, Odometry, Scan

__all__ = ["EkfConfig", "EkfSlam"]

Array = NDArray[np.float64]

_MAX_OBSERVATIONS = 64


@dataclass(frozen=True, kw_only=True)
class EkfConfig(BackendConfig):
    """EKF-SLAM: gating and landmark management."""

    gate: float = 11.83  # squared Mahalanobis: 99.7 % of chi-square with two degrees of freedom
    max_turn_deg: float = 35.0  # difference in a corner's direction
    landmarks: LandmarkPolicy = field(default_factory=LandmarkPolicy)

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.gate > 0, "EkfConfig.gate must be > 0")


class EkfSlam(Backend):
    """The standard EKF-SLAM backend, ``ekf``."""

    config: EkfConfig

    def __init__(self, config: EkfConfig | None = None) -> None:
        super().__init__(config or EkfConfig())
        self._start(np.zeros(3), np.eye(3) * 1e-8, 0)

    def _start(self, pose: Array, pose_cov: Array, seed: int) -> None:
        del seed  # nothing here is drawn
        self._n = 3
        self._x = np.zeros(3 + 2 * 32)
        self._p = np.zeros((len(self._x), len(self._x)))  # upper triangle
        self._x[:3] = pose
        self._p[:3, :3] = np.triu(pose_cov)
        self._book = LandmarkBook(self.config.landmarks)
        self._w = np.zeros((2 * _MAX_OBSERVATIONS + 2, len(self._x)))  # two spare rows, see _downdate
        self._s = np.zeros((2 * _MAX_OBSERVATIONS, 2 * _MAX_OBSERVATIONS + 1))
        self._h = np.zeros((_MAX_OBSERVATIONS, 2, 5))
        self._match = np.zeros(_MAX_OBSERVATIONS, np.int64)
        self._distance = np.zeros(_MAX_OBSERVATIONS)
        self._twist, self._dt = (0.0, 0.0, 0.0), 0.0
        self.nis = 0.0
        self.nis_dof = 0

    # ---- the filter ----------------------------------------------------------------------------------------

    def predict(self, odometry: Odometry) -> None:
        """Move on by what the wheels measured (theory.md A, predict)."""
        vx, vy, omega = np.asarray(odometry.twist, dtype=np.float64).tolist()
        noise = self.config.odometry
        slip = noise.slip(self._twist, (vx, vy, omega), odometry.dt)
        var_v, var_w = noise.variances(vx, vy, omega, slip=slip)
        predict_robot(self._x, self._p, self._n, vx, vy, omega, odometry.dt, var_v, var_w)
        self._twist, self._dt = (vx, vy, omega), odometry.dt

    def update(self, scan: Scan) -> None:
        """Correct by the corners of a scan, keep the book of landmarks, draw the scan."""
        z = self.extractor.extract(scan)[:_MAX_OBSERVATIONS]
        match = self._associate(z)
        if self._out_of_sight(match):
            match = self._allow_for_spinning_wheels(z)
        self._correct(z, match)
        self._manage(z, match, scan)
        self._draw(scan)
        self.key_scans.redraw_if_moved(self.grid, self._points, self._book.row_of_id)

    def observe(self, observations: Observations) -> None:
        """Correct by landmark observations without a scan; known ids are believed, and new ones added."""
        rb = np.asarray(observations.range_bearing, dtype=np.float64).reshape(-1, 2)
        cov = np.asarray(observations.cov, dtype=np.float64).reshape(-1, 2, 2)
        if len(rb) != len(cov) or not (np.all(np.isfinite(rb)) and np.all(np.isfinite(cov))):
            raise ValueError("observations need finite range_bearing (m, 2) and cov (m, 2, 2) of one length")
        z = np.zeros((len(rb), 8))
        z[:, :2], z[:, 2], z[:, 3], z[:, 4] = rb, cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
        for begin in range(0, len(z), _MAX_OBSERVATIONS):
            part = z[begin : begin + _MAX_OBSERVATIONS]
            if observations.ids is None:
                match = self._associate(part)
                self._correct(part, match)
                self._manage(part, match, None)
                continue
            ids = np.asarray(observations.ids)[begin : begin + _MAX_OBSERVATIONS]
            match = np.array([self._book.row(int(i)) for i in ids], np.int64)
            self._correct(part, match)
            for k in np.flatnonzero(match < 0):
                if self._book.row(int(ids[k])) < 0:  # not added by this very call
                    self._add(part[k], int(ids[k]))

    def _associate(self, z: Array) -> NDArray[np.int64]:
        match = self._match[: len(z)]
        policy = self.config.landmarks
        nearest_neighbour(
            self._x, self._p, self._book.count, self.config.lidar_offset_m, z, self._book.marks,
            self.config.gate, policy.new_distance_m, math.radians(self.config.max_turn_deg), match,
            self._distance, self._h[0],
        )  # fmt: skip
        return match

    def _out_of_sight(self, match: NDArray[np.int64]) -> bool:
        """Tell whether many of the landmarks that the last scans showed are missing all at once."""
        recent, still = self._book.recently_seen(match)
        return recent >= 3 and still < 0.6 * recent

    def _allow_for_spinning_wheels(self, z: Array) -> NDArray[np.int64]:
        """Associate again as though the wheels had turned in vain; keep to that if it brings the landmarks back.

        Against a wall, or pulling away too hard, the wheels turn and the robot does not follow. V knows nothing
        of that, and a filter that trusts it has every gate closed within two steps and is lost for good. So the
        pose may be off by as much as the wheels claim to have moved.
        """
        kept = self._p[:3, :3].copy()
        vx, vy, omega = self._twist
        lever = self.config.odometry.lever_m
        moved = math.hypot(vx, vy, lever * omega) * self._dt
        self._p[0, 0] += moved**2
        self._p[1, 1] += moved**2
        self._p[2, 2] += (moved / lever) ** 2
        match = self._associate(z)
        if not self._out_of_sight(match):
            return match
        # It is the view that changed: through a door, say.
        self._p[:3, :3] = kept
        return self._associate(z)

    def _correct(self, z: Array, match: NDArray[np.int64]) -> None:
        """Make one stacked update of all matched observations."""
        self.nis_dof, self.nis = stacked_update(
            self._x, self._p, self._n, z, match, self.config.lidar_offset_m, self._h, self._w, self._s
        )

    def _manage(self, z: Array, match: NDArray[np.int64], scan: Scan | None) -> None:
        """Tentative → confirmed → dropped (see :mod:`slam.landmarks`)."""
        new = self._book.review(self._x, self.config.lidar_offset_m, z, match)
        for k in new:
            self._add(z[k], None)
        if scan is not None:
            for row in self._book.contradicted(self._x, self.config.lidar_offset_m, scan):
                self._drop(row)

    def _add(self, z: Array, known_id: int | None) -> None:
        if self._n + 2 > len(self._x):
            self._enlarge()
        add_landmark(self._x, self._p, self._n, z, self.config.lidar_offset_m)
        self._n += 2
        self._book.add(float(z[KIND]), float(z[DIRECTION]) + float(self._x[2]), known_id)

    def _drop(self, row: int) -> None:
        """Take a landmark out of the state: marginalisation is leaving out its rows and columns."""
        n, i = self._n, 3 + 2 * row
        self._x[i : n - 2] = self._x[i + 2 : n]
        keep = np.r_[0:i, i + 2 : n]
        self._p[: n - 2, : n - 2] = self._p[np.ix_(keep, keep)]
        self._n = n - 2
        self._book.drop(row)

    def _enlarge(self) -> None:
        size = 2 * len(self._x)
        x, p = np.zeros(size), np.zeros((size, size))
        x[: self._n] = self._x[: self._n]
        p[: self._n, : self._n] = self._p[: self._n, : self._n]
        self._x, self._p = x, p
        self._w = np.zeros((2 * _MAX_OBSERVATIONS + 2, size))

    def _landmarks_in_view(self) -> tuple[NDArray[np.int64], Array]:
        rows = self._book.just_seen()
        return self._book.ids[rows], self._points[rows]

    # ---- the belief ----------------------------------------------------------------------------------------

    @property
    def _points(self) -> Array:
        return self._x[3 : self._n].reshape(-1, 2)

    @property
    def pose(self) -> Array:
        """Pose mean ``(3,)``."""
        return self._x[:3].copy()

    @property
    def pose_cov(self) -> Array:
        """Pose covariance ``(3, 3)``."""
        out = np.empty((3, 3))
        _symmetric(self._p, out)
        return out

    @property
    def joint_cov(self) -> Array:
        """Covariance ``(3 + 2n, 3 + 2n)`` of the robot and every landmark."""
        upper = np.triu(self._p[: self._n, : self._n])
        return upper + np.triu(upper, 1).T

    @property
    def landmark_count(self) -> int:
        """Number of confirmed landmarks."""
        return self._book.count

    def landmark_details(self) -> tuple[NDArray[np.int64], Array]:
        """Return per landmark how often it was seen and its direction in the belief's frame [rad]."""
        return self._book.times_seen(), self._book.directions()

    def near_landmarks(self, out: NDArray[np.float32]) -> None:
        """Write the nearest landmarks in the robot frame (see the base class)."""
        near_landmarks(self._x, self._p, self._book.count, out)

    @property
    def belief(self) -> Belief:
        """Pose, landmarks, joint covariance and grid."""
        joint = self.joint_cov
        index = 3 + 2 * np.arange(self._book.count)
        cov = np.empty((len(index), 2, 2))
        for a in range(2):
            for b in range(2):
                cov[:, a, b] = joint[index + a, index + b]
        return Belief(
            pose=self.pose,
            pose_cov=joint[:3, :3].copy(),
            landmarks=self._points.copy(),
            landmark_cov=cov,
            landmark_ids=self._book.ids.copy(),
            grid=self.grid,
            joint_cov=joint,
            landmark_kinds=self._book.kinds(),
        )


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def stacked_update(
    x: Array, p: Array, n: int, z: Array, match: NDArray[np.int64], offset: float, h: Array, w: Array, s: Array
) -> tuple[int, float]:  # fmt: skip
    """Make one EKF update of all observations with ``match`` ≥ 0; return the degrees of freedom and the NIS.

    S = H P Hᵀ + R = L Lᵀ, W = L⁻¹ H P, x += Wᵀ L⁻¹ ν, P ← P − Wᵀ W (theory.md A, observe; the same as
    P − K S Kᵀ). ``p`` is an upper triangle; ``h``, ``w``, ``s`` are work space.
    """
    rows = 0
    ns = s.shape[1] - 1  # the last column holds the innovation
    for k in range(z.shape[0]):
        if match[k] < 0:
            continue
        m = 3 + 2 * match[k]
        hk = h[rows // 2]
        rho, bearing = innovation_blocks(x, match[k], offset, hk)
        s[rows, ns] = z[k, 0] - rho
        s[rows + 1, ns] = wrap_scalar(z[k, 1] - bearing)
        _h_times_p(p, n, m, hk, w[rows], w[rows + 1])
        rows += 2
    if rows == 0:
        return 0, 0.0
    # S, its lower triangle: H W' row by row.
    a = 0
    for k in range(z.shape[0]):
        if match[k] < 0:
            continue
        m = 3 + 2 * match[k]
        hk = h[a // 2]
        for e in range(2):
            for b in range(a + 2):
                v = hk[e, 3] * w[b, m] + hk[e, 4] * w[b, m + 1]
                for q in range(3):
                    v += hk[e, q] * w[b, q]
                s[a + e, b] = v
        s[a, a] += z[k, 2]
        s[a + 1, a] += z[k, 3]
        s[a + 1, a + 1] += z[k, 4]
        a += 2
    _cholesky_solve(s, rows, ns, w, n)
    nis = 0.0
    for k in range(rows):
        y = s[k, ns]
        nis += y * y
        wk = w[k]
        for j in range(n):
            x[j] += y * wk[j]
    x[2] = wrap_scalar(x[2])
    if rows % 4 != 0:
        w[rows : rows + 2, :n] = 0.0
    _downdate(p, n, w, rows)
    return rows, nis


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _h_times_p(p: Array, n: int, m: int, h: Array, out0: Array, out1: Array) -> None:
    """Write both rows of H P for the landmark at state index ``m``, reading P's upper triangle."""
    # Left of the landmark its part of P stands in the columns m and m + 1.
    for j in range(m):
        a, b = p[j, m], p[j, m + 1]
        out0[j] = h[0, 3] * a + h[0, 4] * b
        out1[j] = h[1, 3] * a + h[1, 4] * b
    out0[m] = h[0, 3] * p[m, m] + h[0, 4] * p[m, m + 1]
    out1[m] = h[1, 3] * p[m, m] + h[1, 4] * p[m, m + 1]
    right0, right1, pa, pb = out0[m + 1 : n], out1[m + 1 : n], p[m, m + 1 : n], p[m + 1, m + 1 : n]
    for j in range(right0.shape[0]):
        right0[j] = h[0, 3] * pa[j] + h[0, 4] * pb[j]
        right1[j] = h[1, 3] * pa[j] + h[1, 4] * pb[j]
    for j in range(3):
        for q in range(3):
            c = p[q, j] if q <= j else p[j, q]
            out0[j] += h[0, q] * c
            out1[j] += h[1, q] * c
    map0, map1, p0, p1, p2 = out0[3:n], out1[3:n], p[0, 3:n], p[1, 3:n], p[2, 3:n]
    for j in range(map0.shape[0]):
        map0[j] += h[0, 0] * p0[j] + h[0, 1] * p1[j] + h[0, 2] * p2[j]
        map1[j] += h[1, 0] * p0[j] + h[1, 1] * p1[j] + h[1, 2] * p2[j]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _cholesky_solve(s: Array, rows: int, column: int, w: Array, n: int) -> None:
    """Factor S in place (lower triangle), and turn its last column and the rows of w into L⁻¹ times them."""
    for i in range(rows):
        wi = w[i, :n]
        for j in range(i):
            v = s[i, j]
            for k in range(j):
                v -= s[i, k] * s[j, k]
            v /= s[j, j]
            s[i, j] = v
            s[i, column] -= v * s[j, column]
            wj = w[j, :n]
            for q in range(n):
                wi[q] -= v * wj[q]
        d = s[i, i]
        for k in range(i):
            d -= s[i, k] * s[i, k]
        root = math.sqrt(d)
        s[i, i] = root
        inverse = 1.0 / root
        s[i, column] *= inverse
        for q in range(n):
            wi[q] *= inverse


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _downdate(p: Array, n: int, w: Array, rows: int) -> None:
    """Subtract Wᵀ W from the upper triangle of p.

    Two rows of p and four of W at a time, to spare memory traffic; the rows are sliced first, without which
    the inner loop does not vectorise and takes three times as long. Rows of W up to a multiple of four are zero.
    """
    for i in range(0, n - 1, 2):
        diagonal = 0.0
        for k in range(rows):
            diagonal += w[k, i] * w[k, i]
        p[i, i] -= diagonal
        upper, lower = p[i, i + 1 : n], p[i + 1, i + 1 : n]
        for k in range(0, rows, 4):
            a0, a1, a2, a3 = w[k, i], w[k + 1, i], w[k + 2, i], w[k + 3, i]
            b0, b1, b2, b3 = w[k, i + 1], w[k + 1, i + 1], w[k + 2, i + 1], w[k + 3, i + 1]
            w0, w1, w2, w3 = w[k, i + 1 : n], w[k + 1, i + 1 : n], w[k + 2, i + 1 : n], w[k + 3, i + 1 : n]
            for j in range(upper.shape[0]):
                c0, c1, c2, c3 = w0[j], w1[j], w2[j], w3[j]
                upper[j] -= a0 * c0 + a1 * c1 + (a2 * c2 + a3 * c3)
                lower[j] -= b0 * c0 + b1 * c1 + (b2 * c2 + b3 * c3)
    # n is odd: three for the robot, two a landmark.
    last = n - 1
    for k in range(rows):
        p[last, last] -= w[k, last] * w[k, last]


@njit(cache=True, nogil=True, error_model="numpy")
def add_landmark(x: Array, p: Array, n: int, z: Array, offset: float) -> None:
    """Append a landmark seen at (ρ, φ) = z[:2] with covariance z[2:5] (theory.md A, add a landmark)."""
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
def _symmetric(p: Array, out: Array) -> None:
    """Write the leading block of an upper triangle as the full symmetric matrix."""
    for i in range(out.shape[0]):
        for j in range(i, out.shape[0]):
            out[i, j] = out[j, i] = p[i, j]


@njit(cache=True, nogil=True, error_model="numpy")
def near_landmarks(x: Array, p: Array, count: int, out: NDArray[np.float32]) -> None:
    """Write the nearest landmarks in the robot frame, by insertion into a list sorted by distance."""
    out[:] = 0.0
    c, s = math.cos(x[2]), math.sin(x[2])
    filled = 0
    for i in range(count):
        k = 3 + 2 * i
        dx, dy = x[k] - x[0], x[k + 1] - x[1]
        d2 = dx * dx + dy * dy
        j = filled if filled < out.shape[0] else out.shape[0] - 1
        if filled == out.shape[0] and d2 >= out[j, 5]:
            continue
        while j > 0 and out[j - 1, 5] > d2:
            out[j] = out[j - 1]
            j -= 1
        a, b, d = p[k, k], p[k, k + 1], p[k + 1, k + 1]
        out[j, 0] = c * dx + s * dy
        out[j, 1] = -s * dx + c * dy
        out[j, 2] = c * c * a + 2.0 * c * s * b + s * s * d
        out[j, 3] = -c * s * a + (c * c - s * s) * b + c * s * d
        out[j, 4] = s * s * a - 2.0 * c * s * b + c * c * d
        out[j, 5] = d2
        filled = min(filled + 1, out.shape[0])
    for j in range(filled):
        for q in range(5):
            out[j, q] = min(max(out[j, q], -OBSERVED_LIMIT), OBSERVED_LIMIT)
        out[j, 5] = 1.0
