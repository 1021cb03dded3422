"""Whether the wheels did what they say: the same landmarks, seen twice, tell the motion in between as well.

What lasts of a landmark's error (:mod:`slam.features.corners`) is in its covariance, so that a filter takes a
centimetre that the robot slipped for an error that lasts: V knows nothing of a wheel without grip, or of a wall
that stops the robot. Between two scans of the same landmarks what lasts drops out. So the motion is measured a
second time, by the landmarks of a scan some time ago, the map left aside; and where the two contradict each other
the pose is not what the wheels made of it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.geometry import wrap_scalar
from slam.landmarks.association import predicted
from slam.landmarks.joint_compatibility import JOINT_LIMITS, MAX_OBSERVATIONS
from slam.metrics.measures import nees_pose
from slam.motion import Twist, predict_robot
from slam.types import LINE, Array

__all__ = ["WheelCheck"]

Ids = NDArray[np.int64]

_FEWEST = 3  # landmarks that must agree on another motion
_EVERY = 2  # scans between two comparisons
_USUAL, _PRIOR = 0.35, 8  # share of the covariances that is new in a scan; residuals that this counts for
_LEAST_WAY_M, _LEAST_TURN_RAD = 1e-3, 1e-3


class WheelCheck:
    """Compares what the wheels say since a scan with what that scan's landmarks say.

    Parameters
    ----------
    offset_m : float
        Of the sensor, ahead of the robot's centre.
    scans : int
        After so many another scan is compared with.
    gate : float
        Squared Mahalanobis distance of the two motions from which wheels are not believed.
    white_share : float
        Least share of the landmarks' covariances that is taken for new in every scan.
    """

    def __init__(self, offset_m: float, *, scans: int, gate: float, white_share: float) -> None:
        self._offset, self._scans, self._gate, self._white = offset_m, scans, gate, white_share
        self._ids, self._seen = np.zeros(MAX_OBSERVATIONS, np.int64), np.zeros((MAX_OBSERVATIONS, 6))
        self._x, self._p, self._moved = np.zeros(3), np.zeros((3, 3)), np.zeros(2)
        self._extra = np.zeros((3, 3))
        self.forget()

    def forget(self) -> None:
        """Take the next scan to compare with."""
        self._count, self._age, self._heading = 0, self._scans, 0.0

    def predict(self, dt: float, twist: Twist, var_v: float, var_w: float) -> None:
        """Move on by what the wheels say, as the filter does."""
        _move_on(self._x, self._p, self._moved, *twist, dt, var_v, var_w)

    def doubt(self, z: Array, match: Ids, ids: Ids) -> Array | None:
        """Return what the pose's covariance lacks ``(3, 3)`` [belief's frame]; None where nothing contradicts.

        Parameters
        ----------
        z, match
            A scan's observations ``(m, 12)`` and the rows of their landmarks ``(m,)``, negative for none.
        ids
            Of the landmarks, by row.
        """
        doubted = self._count >= _FEWEST and self._age % _EVERY == 0 and _contradiction(
            self._x, self._p, self._moved, self._heading, self._ids[: self._count], self._seen, z, match, ids,
            self._offset, self._white, self._gate, JOINT_LIMITS, self._extra,
        )  # fmt: skip
        if not doubted:
            return None
        self.forget()
        return self._extra

    def note(self, z: Array, match: Ids, ids: Ids, heading: float) -> None:
        """Take note of a scan, taken at a heading [rad, belief's frame]; where it is time, compare with it."""
        self._age += 1
        if self._age < self._scans:
            return
        self._count, self._age, self._heading = (
            _remember(z, match, ids, self._offset, self._ids, self._seen),
            0,
            heading,
        )
        self._x[:], self._p[:], self._moved[:] = 0.0, 0.0, 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _move_on(
    x: Array, p: Array, moved: Array, vx: float, vy: float, omega: float, dt: float, var_v: float, var_w: float
) -> None:
    """Predict the motion ``x``, ``p``, and count what the wheels claim in all, ``moved`` [m, rad]."""
    moved[0] += math.hypot(vx, vy) * dt
    moved[1] += abs(omega) * dt
    predict_robot(x, p, 3, vx, vy, omega, dt, var_v, var_w)


@njit(cache=True, nogil=True, error_model="numpy")
def _remember(z: Array, match: Ids, ids: Ids, offset: float, out_ids: Ids, out: Array) -> int:
    """Write what was seen: x, y, or α, r, in the robot's frame, covariance and kind; return how many."""
    count = 0
    for k in range(z.shape[0]):
        if match[k] < 0:
            continue
        rho, phi = z[k, 0], z[k, 1]
        out_ids[count] = ids[match[k]]
        if z[k, 5] == LINE:
            out[count, 0], out[count, 1] = phi, rho + offset * math.cos(phi)
        else:
            out[count, 0], out[count, 1] = offset + rho * math.cos(phi), rho * math.sin(phi)
        out[count, 2:6] = z[k, 2:6]
        count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _contradiction(
    x: Array, p: Array, moved: Array, heading: float, known: Ids, seen: Array, z: Array, match: Ids, ids: Ids,
    offset: float, white: float, gate: float, limits: Array, extra: Array,
) -> bool:  # fmt: skip
    """Tell whether landmarks seen twice contradict the motion ``x``, ``p``; write what its covariance lacks.

    With A = Σ Hᵀ R⁻¹ H, b = Σ Hᵀ R⁻¹ ν, and W of wheels that may have turned in vain (all that they claim), the
    error of the motion is e = C b / s, C = (A / s + W⁻¹)⁻¹. s is the share of R that is not the same in both
    scans, by the residuals and what it usually is. They contradict where eᵀ (P + C)⁻¹ e exceeds the gate; what
    lacks is C + e eᵀ.
    """
    info, b = np.zeros((3, 3)), np.zeros(3)
    state, h = np.empty(5), np.empty((2, 5))
    state[:3] = x
    square, count = 0.0, 0
    for k in range(z.shape[0]):
        if match[k] < 0:
            continue
        i = 0
        while i < known.shape[0] and known[i] != ids[match[k]]:
            i += 1
        if i == known.shape[0]:
            continue
        state[3], state[4] = seen[i, 0], seen[i, 1]
        rho, phi = predicted(state, 0, seen[i, 5], offset, h)
        v0, v1 = z[k, 0] - rho, wrap_scalar(z[k, 1] - phi)
        r00, r01, r11 = z[k, 2] + seen[i, 2], z[k, 3] + seen[i, 3], z[k, 4] + seen[i, 4]
        det = r00 * r11 - r01 * r01
        i00, i01, i11 = r11 / det, -r01 / det, r00 / det
        square += i00 * v0 * v0 + 2.0 * i01 * v0 * v1 + i11 * v1 * v1
        for q in range(3):
            a0, a1 = i00 * h[0, q] + i01 * h[1, q], i01 * h[0, q] + i11 * h[1, q]
            b[q] += a0 * v0 + a1 * v1
            for j in range(3):
                info[q, j] += a0 * h[0, j] + a1 * h[1, j]
        count += 1
    if count < _FEWEST:
        return False
    way, turn = max(moved[0], _LEAST_WAY_M), max(moved[1], _LEAST_TURN_RAD, moved[0])
    cov, wide, error = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    # First with the least noise that there may be: mostly there is no contradiction even so.
    for share in (white, 0.0):
        if share == 0.0:
            left = square
            for q in range(3):
                left += error[q] * (
                    info[q, 0] * error[0] + info[q, 1] * error[1] + info[q, 2] * error[2] - 2.0 * b[q]
                )
            if left > limits[count]:
                return False  # no motion explains them all: another landmark was taken for one of them
            share = max((left + _PRIOR * _USUAL) / (2 * count - 3 + _PRIOR), white)
        for q in range(3):
            for j in range(3):
                cov[q, j] = info[q, j] / share
            cov[q, q] += 1.0 / (way * way if q < 2 else turn * turn)
        cov[:] = np.linalg.inv(cov)
        for q in range(3):
            error[q] = (cov[q, 0] * b[0] + cov[q, 1] * b[1] + cov[q, 2] * b[2]) / share
            for j in range(q, 3):
                wide[q, j] = p[q, j] + cov[q, j]
        if nees_pose(np.zeros(3), wide, error) <= gate:
            return False
    for q in range(3):
        for j in range(3):
            cov[q, j] += error[q] * error[j]
    c, s = math.cos(heading), math.sin(heading)
    for q in range(3):  # from the frame of the scan that was compared with: T cov Tᵀ
        cov[q, 0], cov[q, 1] = c * cov[q, 0] - s * cov[q, 1], s * cov[q, 0] + c * cov[q, 1]
    for q in range(3):
        extra[0, q], extra[1, q] = c * cov[0, q] - s * cov[1, q], s * cov[0, q] + c * cov[1, q]
        extra[2, q] = cov[2, q]
    return True
