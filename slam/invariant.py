"""Right-invariant EKF-SLAM: the standard filter with another error, so that it never grows sure of a heading.

After Barrau and Bonnabel, and Zhang et al. 2017, as worked out in docs/reference/invariant.md. The covariance
stays in ordinary coordinates, where the two filters predict, observe and add landmarks alike. What differs is how
a correction is applied: along the exponential of SE(2), by which the whole map turns about the origin with the
robot's heading, and with a change of the covariance's coordinates to the new estimate (the *reset*).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numba import njit

from slam.compressed import Change, CompressedEkfConfig, CompressedEkfSlam
from slam.gaussian.joint_gaussian import state_rows
from slam.gaussian.settings import EkfLinesConfig
from slam.gaussian.stacked_update import NO_LIMITS, whiten
from slam.gaussian.tiles import add_combination, downdate, product
from slam.geometry import wrap_scalar
from slam.metrics.measures import nees_pose_invariant
from slam.settings import Within
from slam.types import LINE, Array, Indices

__all__ = ["InvariantEkfConfig", "InvariantEkfSlam"]

_SETTLED_M = 1e-4  # a wall whose r changes by less [m/rad] needs no new coordinates
_PAIR = (1, 2, 0)  # where x, y and θ stand in work space: θ first, since walls alone need the others


@dataclass(frozen=True, kw_only=True)
class InvariantEkfConfig(EkfLinesConfig, CompressedEkfConfig):
    """Right-invariant EKF-SLAM over walls and corners, in regions where the map is large."""

    # Larger regions than its parent's: another one takes as long as a hundred steps.
    leave_share: Annotated[float, Within("[0.001, 10]")] = 1.5
    whole_up_to: Annotated[int, Within("[0, 1000000000]")] = 300
    rank_tolerance: Annotated[float, Within("(0, 1)")] = 1e-8


class InvariantEkfSlam(CompressedEkfSlam):
    """The right-invariant EKF-SLAM backend, ``invariant-ekf``.

    What is far is moved, and its covariance reset, once a region: by the sum of what was corrected meanwhile.
    """

    config: InvariantEkfConfig

    def __init__(self, config: InvariantEkfConfig | None = None) -> None:
        super().__init__(config or InvariantEkfConfig())

    def _start(self, pose: Array, pose_cov: Array, seed: int) -> None:
        super()._start(pose, pose_cov, seed)
        self._delta = np.zeros(len(self._x))
        self._entered = self._x[:3].copy()  # the pose on entering the region, …
        self._entered_cov, self._entered_far = pose_cov, np.zeros((3, 0))  # … its covariance, and with what is far

    def _correct(self, z: Array, match: Indices, limits: Array = NO_LIMITS) -> None:
        n, w = self._n, self._w
        self.nis_dof, self.nis = invariant_update(
            self._x, self._p, n, z, match, self.config.lidar_offset_m, self._book.marks, self._h, w, self._s,
            self._delta, limits,
        )  # fmt: skip
        self._beside.correct(n, match, self._h, w, self._s, self.nis_dof, reset=True)
        if self.nis_dof:
            self._turn_beside()

    def _correct_direction(self, i: int) -> None:
        apply(self._x, self._p, self._n, 2, self._book.marks, self._w, self._s, self._delta)
        self._beside.correct_direction(self._n, i, self._w, self._s, reset=True)
        self._turn_beside()

    def _turn_beside(self) -> None:
        _turn_columns(self._beside.cross, self._n, self._delta)

    def _enlarge(self) -> None:
        super()._enlarge()
        self._delta = np.zeros(len(self._x))

    # ---- what is far ---------------------------------------------------------------------------------------

    def _enter(self) -> None:
        super()._enter()
        self._entered = self._x[:3].copy()
        if len(self._far):
            self._entered_cov, self._entered_far = self.pose_cov, self._cross(3)
            # What is far turns with the robot as it entered. Since then odometry's errors are put right, too.
            cross, own = self._p[:3, : self._n].copy(), self._beside.cross[: self._beside.own, :3].copy()
            cross[:, :3] = self.pose_cov
            self._beside.join(cross, own)

    def _rest(self) -> Array:
        return self._retracted()[0] if len(self._far) else super()._rest()

    def _retracted(self) -> tuple[Array, Array]:
        """Return the map's state ``(n,)``, what is far retracted, and the columns of its reset ``(3, n)``."""
        x, delta = self._map_x.copy(), super()._rest() - self._map_x
        columns, end = np.zeros((3, len(x))), int(state_rows(self._far, robot=False).max()) + 1
        x[:3], delta[:3] = self._entered, self._beside.mean[-3:]
        # Walls far away were settled long ago.
        _retract(x, end, delta, self._map_marks, columns, math.inf)
        return x, columns

    def _change(self) -> Change:
        """Return what the region's corrections make of the rest's covariance, its reset included."""
        change = super()._change()
        if not len(self._far):
            return change
        far, size, columns = state_rows(self._far, robot=False), change.left.shape[1], self._retracted()[1]
        a, robot = np.zeros((3, size)), [2, 0, 1]
        a[:, far] = columns[:, far]
        # P += A Uᵀ + U Aᵀ with U = P_:r + ½ A P_rr, as in invariant_update; r is the robot as it entered, too.
        y, v, own = self._beside, self._v, change.own.copy()
        change_cov = np.triu(y.cov[-3:, -3:])  # of joined states there is but the upper triangle
        pose_cov = self._entered_cov + change_cov + np.triu(change_cov, 1).T
        u = np.zeros((3, size))
        u[:, far] = (self._entered_far + product(y.cov[self._of_far, -3:].T, v, v.shape[1]))[:, far]
        u[:, state_rows(self._near, robot=True)] = y.cross[-3:, : self._n]
        u = u[robot] + product(0.5 * pose_cov[np.ix_(robot, robot)], a, size)
        own[:, :size] += product(y.cov[: len(own), -3:][:, robot], a, size)[:, : own.shape[1]]
        return Change(np.vstack([change.left, a, u]), np.vstack([change.right, u, a]), own)

    def pose_nees(self, true_pose: Array) -> float:
        """Return the pose's NEES in the invariant error, which is the one this filter's covariance speaks of."""
        return float(nees_pose_invariant(self._x, self._p, np.asarray(true_pose, dtype=np.float64)))


@njit(cache=True, nogil=True, error_model="numpy")
def invariant_update(
    x: Array, p: Array, n: int, z: Array, match: Indices, offset: float, marks: Array, h: Array,
    w: Array, s: Array, delta: Array, limits: Array,
) -> tuple[int, float]:  # fmt: skip
    """Make one right-invariant EKF update of all observations with ``match`` ≥ 0; return the dof and the NIS.

    The gain is the standard filter's (:func:`slam.gaussian.stacked_update.stacked_update`), as are ``limits``; for
    ``marks``, ``w`` and ``delta`` see :func:`apply`.
    """
    rows = whiten(x, p, n, z, match, offset, h, w, s)
    if rows == 0:
        return 0, 0.0
    nis = 0.0
    for k in range(rows):
        nis += s[k, rows] * s[k, rows]
    if nis > limits[min(rows // 2, limits.shape[0] - 1)]:
        return 0, nis
    apply(x, p, n, rows, marks, w, s, delta)
    return rows, nis


@njit(cache=True, nogil=True, error_model="numpy")
def apply(x: Array, p: Array, n: int, rows: int, marks: Array, w: Array, s: Array, delta: Array) -> None:
    """Correct by so many ``rows``, as :func:`slam.gaussian.stacked_update.whiten` left them in ``w`` and ``s``.

    The reset P ← P + A Vᵀ + V Aᵀ (docs/reference/invariant.md) goes along with P − Wᵀ W: the rows of ``w`` after
    W's are, for θ, x and y, A's column and −V's; what of it is by a wall's own α follows. ``marks`` tells walls
    from points; ``delta`` ``(≥ n,)`` holds after it, where a wall's r stands in the state, what it changes by that
    α, else 0.
    """
    delta[:n] = 0.0
    add_combination(delta, n, s[:rows, rows], w)
    a, minus_v = w[rows : rows + 6 : 2], w[rows + 1 : rows + 6 : 2]
    walls = _retract(x, n, delta, marks, a, _SETTLED_M)
    # V = P_:r + ½ A P_rr, P being what it is after the update, P − Wᵀ W.
    for q in range(0 if walls else 2, 3):
        v = minus_v[_PAIR[q]]
        for j in range(n):
            v[j] = -p[j, q] if j <= q else -p[q, j]
        add_combination(v, n, w[:rows, q], w)
    _add_half(a, minus_v, n, walls)
    downdate(p, n, w, w, rows, 3 if walls else 1)
    if walls:
        _turn(p, n, delta)


@njit(cache=True, nogil=True, error_model="numpy")
def _turn(p: Array, n: int, levers: Array) -> None:
    """P ← G P Gᵀ of an upper triangle, G adding a wall's α, times its lever ``(≥ n,)``, to its r."""
    for j in range(4, n, 2):
        i, g = j - 1, levers[j]
        if g != 0.0:
            p[j, j] += g * (2.0 * p[i, j] + g * p[i, i])
            p[i, j] += g * p[i, i]
            for k in range(i):
                p[k, j] += g * p[k, i]
            for k in range(j + 1, n):
                p[j, k] += g * p[i, k]


@njit(cache=True, nogil=True, error_model="numpy")
def _turn_columns(cross: Array, n: int, levers: Array) -> None:
    """C ← C Gᵀ, with the G of :func:`_turn`."""
    for j in range(4, n, 2):
        if levers[j] != 0.0:
            for k in range(cross.shape[0]):
                cross[k, j] += levers[j] * cross[k, j - 1]


@njit(cache=True, nogil=True, error_model="numpy")
def _retract(x: Array, n: int, delta: Array, marks: Array, a: Array, settled_m: float) -> bool:
    """Apply a correction along the exponential, write A's columns by θ, x and y, tell whether there are walls.

    x⁺ = Exp(t) x̂ + V(t) (δ − J x̂ t) for the robot's position and every point, with t = δθ. A wall turns about
    where the robot is: r⁺ = r̂ + δr + Δnᵀ (p̂ + ½ δp) − (J n̂)ᵀ p̂ δα, which is right to second order for a wall that
    turns alone and for one that turns with the robot. (A correction of the robot alone leaves it where it is.)
    r̂ + δr would turn it about its foot, which may be a hundred metres away: ½ nᵀ p δα² too far out, always.

    A's column by θ is J times how far a point moved. Of a wall the distance r − nᵀ p from the robot keeps its
    meaning, so r changes coordinates by Δn of the position and by g = Δ(J n)ᵀ p̂ of the wall's own α; ``delta``
    holds that g where r stands. If g is below ``settled_m`` [m/rad], r − nᵀ (p − J p̂ θ) does, and 0 stands there.
    """
    t = delta[2]
    c, s = math.cos(t), math.sin(t)
    # V(t) = [[va, −vb], [vb, va]]
    if abs(t) > 1e-4:
        va, vb = s / t, (1.0 - c) / t
    else:
        va, vb = 1.0 - t * t / 6.0, 0.5 * t - t * t * t / 24.0
    robot_x, robot_y = x[0], x[1]
    middle_x, middle_y = robot_x + 0.5 * delta[0], robot_y + 0.5 * delta[1]
    walls = False
    for k in range(-1, (n - 3) // 2):
        i = 0 if k < 0 else 3 + 2 * k
        if k >= 0 and marks[k, 0] == LINE:
            nx, ny = math.cos(x[i]), math.sin(x[i])
            x[i] = wrap_scalar(x[i] + delta[i])
            dx, dy = math.cos(x[i]) - nx, math.sin(x[i]) - ny
            x[i + 1] += delta[i + 1] + dx * middle_x + dy * middle_y - (nx * robot_y - ny * robot_x) * delta[i]
            lever = dx * robot_y - dy * robot_x
            settled = abs(lever) < settled_m
            a[0, i] = a[1, i] = a[2, i] = 0.0
            a[0, i + 1], a[1, i + 1], a[2, i + 1] = lever if settled else 0.0, dx, dy
            delta[i + 1] = 0.0 if settled else lever
            walls = True
            continue
        px, py = x[i], x[i + 1]
        dx, dy = delta[i] + py * t, delta[i + 1] - px * t  # J p = (−py, px)
        x[i] = c * px - s * py + va * dx - vb * dy
        x[i + 1] = s * px + c * py + vb * dx + va * dy
        a[0, i], a[0, i + 1] = -(x[i + 1] - py), x[i] - px
        a[1, i] = a[1, i + 1] = a[2, i] = a[2, i + 1] = 0.0
        if k >= 0:
            delta[i + 1] = 0.0
    x[2] = wrap_scalar(x[2] + t)
    a[0, 2] = a[1, 2] = a[2, 2] = 0.0
    return walls


@njit(cache=True, nogil=True, error_model="numpy")
def _add_half(a: Array, v: Array, n: int, walls: bool) -> None:
    """Turn ±P_:r in the rows of ``v`` into ±(P_:r + ½ A P_rr); without walls A has its column by θ only."""
    if not walls:
        half, v0, a0 = 0.5 * v[0, 2], v[0], a[0]
        for j in range(n):
            v0[j] += half * a0[j]
        return
    rr = np.empty((3, 3))
    for q in range(3):
        for e in range(3):
            rr[_PAIR[e], q] = v[q, e]
    for q in range(3):
        for j in range(n):
            v[q, j] += 0.5 * (a[0, j] * rr[0, q] + a[1, j] * rr[1, q] + a[2, j] * rr[2, q])
