"""States beside the map: what lasts of the wheels' errors, the building's direction, what stands for the far map.

No scan shows them, but they are correlated with the robot, every landmark and one another. With e their estimates,
E their covariance and C their cross-covariance with the state, which stand beside x and P:

    predict   C_r ← C_r Fxᵀ
    update    W_e = L⁻¹ H Cᵀ,   e += W_eᵀ L⁻¹ ν,   C −= W_eᵀ W,   E −= W_eᵀ W_e

(docs/reference/ekf.md with the state enlarged; W and L are :mod:`slam.gaussian.stacked_update`'s).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from slam.gaussian.lanes import LANES, aligned_zeros
from slam.gaussian.stacked_update import SPARE_ROWS, solve
from slam.gaussian.tiles import add_combination, downdate, subtract
from slam.motion import Twist, predict_robot
from slam.types import Array, Indices

__all__ = ["Companions"]


class Companions:
    """States beside the map: those that are there all along, and more where :meth:`join` appends them."""

    def __init__(self, observations: int, size: int, cov: Array | None = None, *, direction: bool = False) -> None:
        """Begin with states of a covariance ``(k, k)``, none if left out; ``size`` is the map's state's.

        With ``direction`` there is one more, the building's direction (:mod:`slam.landmarks.right_angles`): it is
        not known before :meth:`take_direction`, and has no variance until then.
        """
        known = 0 if cov is None else len(cov)
        self.own = known + direction  # those that are there all along, the first ones
        self.cov = np.zeros((self.own, self.own))  # E; of those appended the upper triangle
        if cov is not None:
            self.cov[:known, :known] = cov
        self._direction = known
        self.sure = False  # whether most walls of some place told of the direction
        self.mean = np.zeros(self.own)
        self.cross = aligned_zeros(self.own, size)  # C: of each with the robot and the landmarks
        self._rows = 2 * observations
        self._make_work_space()

    def _make_work_space(self) -> None:
        vectors = max(1, -(-len(self.mean) // (2 * LANES)))  # solve takes two vectors of a row at a time
        self._w = aligned_zeros(self._rows, 2 * LANES * vectors)

    def join(self, cross: Array, with_own: Array) -> None:
        """Append states, of which only changes are of interest: mean and covariance begin at zero.

        ``cross`` ``(r, n)`` is their covariance with the map's state, ``with_own`` ``(own, r)`` with the own ones.
        """
        size, k = len(self.mean), len(self.mean) + len(cross)
        cov = np.zeros((k, k))
        cov[:size, :size] = self.cov
        cov[: self.own, size:], cov[size:, : self.own] = with_own, with_own.T
        joined = aligned_zeros(k, self.cross.shape[1])
        joined[:size], joined[size:, : cross.shape[1]] = self.cross, cross
        self.mean, self.cov, self.cross = np.concatenate([self.mean, np.zeros(len(cross))]), cov, joined
        self._make_work_space()

    def part(self) -> None:
        """Leave out what was appended."""
        own, cross = self.own, aligned_zeros(self.own, self.cross.shape[1])
        cross[:] = self.cross[:own]
        self.mean, self.cov, self.cross = self.mean[:own].copy(), self.cov[:own, :own].copy(), cross

    def snapshot(self) -> tuple[Array, Array, Array]:
        """Return what :meth:`restore` takes."""
        return self.mean.copy(), self.cov.copy(), self.cross.copy()

    def restore(self, kept: tuple[Array, Array, Array]) -> None:
        """Go back to what was kept."""
        self.mean[:], self.cov[:], self.cross[:] = kept

    def predict(self, x: Array, p: Array, n: int, dt: float, twist: Twist, var_v: float, var_w: float) -> None:
        """Do :func:`slam.motion.predict_robot`, correlations with these states included."""
        before_x, before_y = x[0], x[1]
        predict_robot(x, p, n, *twist, dt, var_v, var_w)
        if len(self.mean):  # Fx's entries by θ are J times the step
            self.cross[:, 0] -= (x[1] - before_y) * self.cross[:, 2]
            self.cross[:, 1] += (x[0] - before_x) * self.cross[:, 2]

    def correct(
        self, n: int, match: Indices, h: Array, w: Array, s: Array, rows: int, *, reset: bool = False
    ) -> None:
        """Correct by an update of so many ``rows``, h, w and s as it left them.

        ``reset`` goes along with that of :func:`slam.invariant.invariant_update`.
        """
        if rows and len(self.mean):
            _correct(self.mean, self.cov, self.cross, n, match, h, w, s, self._w, rows, self.own, reset)

    @property
    def direction(self) -> tuple[float, float, Array]:
        """The building's direction [rad], its variance and its covariance ``(≥ n,)`` with the map's state."""
        k = self._direction
        return float(self.mean[k]), float(self.cov[k, k]), self.cross[k]

    def take_direction(self, x: Array, p: Array, n: int, i: int, variance: float) -> None:
        """Let the building's direction be that of the wall of state i, up to an error of its own of a variance."""
        k = self._direction
        self.mean[k] = x[i]
        self.cross[k, :i], self.cross[k, i:n] = p[:i, i], p[i, i:n]
        self.cov[k] = self.cov[:, k] = self.cross[:, i]
        self.cov[k, k] = p[i, i] + variance

    def correct_direction(self, n: int, i: int, w: Array, s: Array, *, reset: bool = False) -> None:
        """Correct by :func:`slam.gaussian.stacked_update.whiten_difference` of state i and the direction."""
        states = len(self.mean)
        self._w[0, :states] = self.cross[:, i] - self.cov[self._direction]
        self._w[1, :states] = 0.0
        _apply(self.mean, self.cov, self.cross, n, w, s, self._w, 2, self.own, reset)

    def add(self, n: int, gr: Array) -> None:
        """Append a landmark with the Jacobian ``gr`` ``(2, 3)`` by the pose at state ``n``."""
        self.cross[:, n : n + 2] = self.cross[:, :3] @ gr.T

    def drop(self, n: int, i: int) -> None:
        """Leave out the two states of the map from ``i`` on."""
        self.cross[:, i : n - 2] = self.cross[:, i + 2 : n].copy()

    def jump(self, jacobian: Array) -> None:
        """Follow the robot to another pose (:func:`slam.gaussian.joint_gaussian.place`)."""
        self.cross[:, :3] = self.cross[:, :3] @ jacobian.T

    def enlarge(self, size: int) -> None:
        """Make room for a larger map."""
        cross = aligned_zeros(len(self.mean), size)
        cross[:, : self.cross.shape[1]] = self.cross
        self.cross = cross


@njit(cache=True, nogil=True, error_model="numpy")
def _correct(
    mean: Array, cov: Array, cross: Array, n: int, match: Indices, h: Array, w: Array, s: Array,
    we: Array, rows: int, own: int, reset: bool,
) -> None:  # fmt: skip
    """Correct by an update of landmarks, H being ``h``."""
    states = mean.shape[0]
    a = 0
    for k in range(match.shape[0]):
        if match[k] < 0:
            continue
        m = 3 + 2 * match[k]
        for e in range(2):
            g = h[a // 2, e]
            for i in range(states):
                c = cross[i]
                we[a + e, i] = g[0] * c[0] + g[1] * c[1] + g[2] * c[2] + g[3] * c[m] + g[4] * c[m + 1]
        a += 2
    _apply(mean, cov, cross, n, w, s, we, rows, own, reset)


@njit(cache=True, nogil=True, error_model="numpy")
def _apply(
    mean: Array, cov: Array, cross: Array, n: int, w: Array, s: Array, we: Array, rows: int, own: int, reset: bool
) -> None:
    """W_e = L⁻¹ H Cᵀ, H Cᵀ standing in ``we``; e += W_eᵀ L⁻¹ ν, C −= W_eᵀ W, E −= W_eᵀ W_e."""
    states = mean.shape[0]
    solve(s, we, states, rows)
    add_combination(mean, states, s[:rows, rows], we)
    subtract(cross, states, n, we, w, rows)
    if states > own:  # they are many
        downdate(cov, states, we, we, rows, 0)
        for i in range(own):
            for j in range(i + 1, states):
                cov[j, i] = cov[i, j]
    else:
        for i in range(own):
            for j in range(own):
                for k in range(rows):
                    cov[i, j] -= we[k, i] * we[k, j]
    if reset:
        _reset(cross, n, w[rows : rows + SPARE_ROWS : 2])


@njit(cache=True, nogil=True, error_model="numpy")
def _reset(cross: Array, n: int, a: Array) -> None:
    """C ← C (I + A S)ᵀ, S taking θ, x and y, and ``a`` A's columns by these (docs/reference/invariant.md)."""
    for i in range(cross.shape[0]):
        theta, x, y = cross[i, 2], cross[i, 0], cross[i, 1]
        for j in range(n):
            cross[i, j] += theta * a[0, j] + x * a[1, j] + y * a[2, j]
