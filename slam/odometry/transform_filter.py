"""The Kalman-Bucy filter of one coordinate, solved by differential transforms.

The mathematics is in :mod:`slam.odometry.riccati`, the models are in :mod:`slam.odometry.differential_transform`.
::

    kalman = KalmanBucyFilter("uniform_acceleration", measurement=1e-4, process=1e-2)
    kalman.reset(time=1.0, state=(1.25, 1.5), cov=np.diag([0.02, 0.02]))
    kalman.advance(0.01, 1.27)  # 10 ms later 1.27 m were measured
    kalman.state, kalman.cov
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from slam.odometry.differential_transform import PowerModel, make_model
from slam.odometry.riccati import Tolerances, Workspace, advance
from slam.settings import require
from slam.types import Array

__all__ = ["KalmanBucyFilter"]


class KalmanBucyFilter:
    """The filter of one coordinate with sampled measurements.

    Parameters
    ----------
    model
        A named model, or one's own.
    measurement
        R, the intensity of the measurement noise [m² s]: σ² Δt of samples of σ, Δt apart.
    process
        Q, the intensity of the process noise (units: see :data:`~slam.odometry.differential_transform.MODELS`).
    tolerances
        Of the solution.
    """

    def __init__(
        self, model: PowerModel | str, *, measurement: float, process: float, tolerances: Tolerances | None = None
    ) -> None:
        require(math.isfinite(measurement) and measurement > 0, "the measurement noise's intensity must be > 0")
        require(math.isfinite(process) and process >= 0, "the process noise's intensity must be ≥ 0")
        self.model = make_model(model) if isinstance(model, str) else model
        self.tolerances = tolerances or Tolerances()
        self._inverse_r = 1.0 / measurement
        self._noise = process * np.outer(self.model.drive, self.model.drive)  # G Q Gᵀ
        self._work = Workspace.of(self.model.size, self.tolerances.order)
        self.expansions = 0
        self.reset()

    def reset(
        self, *, time: float = 1.0, state: ArrayLike | None = None, cov: ArrayLike | None = None,
        measurement: float | None = None,
    ) -> None:  # fmt: skip
        """Start at ``time`` [s] from a state ``(n,)`` and its covariance ``(n, n)``; both zero if not given.

        ``measurement`` is z at that time: the state's first component if not given. ``ValueError`` for anything
        that is not finite, and a covariance that is not symmetric.
        """
        n, work = self.model.size, self._work
        if self.model.needs_positive_time:
            require(time > 0, f"{self.model.name} has no meaning at t = {time:g}; start at a time above 0")
        start = np.zeros(n) if state is None else np.asarray(state, np.float64)
        first = np.zeros((n, n)) if cov is None else np.asarray(cov, np.float64)
        require(start.shape == (n,) and first.shape == (n, n), f"{self.model.name} takes a state of {n} numbers")
        last = float(start[0]) if measurement is None else float(measurement)
        require(bool(np.all(np.isfinite(start)) and np.all(np.isfinite(first))), "a start must be finite")
        require(math.isfinite(time), f"a start's time must be finite, got {time}")
        require(math.isfinite(last), f"a measurement must be finite, got {last}")
        skew, largest = np.abs(first - first.T).max(), np.abs(first).max()
        require(bool(skew <= 1e-9 * largest), "a start's covariance must be symmetric")
        self.time = float(time)
        work.x[0], work.eta[0] = start, first
        self._last = last
        self.expansions = 0

    @property
    def state(self) -> Array:
        """The estimate x̂ ``(n,)``."""
        return np.array(self._work.x[0])

    @property
    def cov(self) -> Array:
        """Its covariance η ``(n, n)``."""
        return np.array(self._work.eta[0])

    def advance(self, span: float, measurement: float | None = None) -> None:
        """Go on by ``span`` [s], at the end of which z is ``measurement``; the last one again if not given.

        In between z changes linearly: held from one sample to the next it would be half a step late.
        ``ArithmeticError`` where the covariance grows beyond all bounds, or the tolerance cannot be kept.
        """
        require(math.isfinite(span) and span > 0, f"a step must be above 0 s, got {span}")
        z = self._last if measurement is None else float(measurement)
        require(math.isfinite(z), f"a measurement must be finite, got {z}")
        model, work = self.model, self._work
        work.z[0], work.z[1] = self._last, z - self._last
        count = advance(
            model.powers, model.matrices, self._noise, self._inverse_r, self.time, span, work,
            self.tolerances.rules,
        )  # fmt: skip
        if count < 0 or not np.all(np.isfinite(work.eta[0])):
            raise ArithmeticError(f"{model.name}: no solution at this tolerance beyond t = {self.time:g} s")
        self.expansions += count
        self.time += span
        self._last = z
