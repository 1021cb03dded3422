"""What paper C's filter costs: steps and multiplications against how exact the covariance is, method by method.

Beside the transforms stand SciPy's RK45 and two ways with its matrix exponential: Van Loan's, with the discrete
filter's update, and that of the Hamiltonian matrix (Davison and Maki), which solves the Riccati equation itself
while F stays as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.integrate import RK45, solve_ivp
from scipy.linalg import expm

from slam.odometry.differential_transform import PowerModel
from slam.odometry.riccati import Tolerances
from slam.odometry.transform_filter import KalmanBucyFilter
from slam.types import Array

__all__ = ["METHODS", "Run", "cheapest", "measure", "multiplications", "reference", "relative_deviation", "solve"]

METHODS: dict[str, Sequence[float]] = {
    "Padé [3/3]": tuple(10.0**-k for k in range(3, 12)),
    "series, 6": tuple(10.0**-k for k in range(3, 12)),
    "Padé [6/6]": tuple(10.0**-k for k in range(3, 12)),
    "RK45": tuple(10.0**-k for k in range(3, 12)),
    "Hamiltonian": (20, 40, 100, 200, 400, 1000, 2000, 4000),
    "Van Loan": (20, 40, 100, 200, 400, 1000, 2000, 4000),
}
"""Each method's settings: the error allowed in a step, or the number of equal steps."""

_TRANSFORMS = {"Padé [3/3]": (6, "pade"), "series, 6": (6, "series"), "Padé [6/6]": (12, "pade")}
_CHECKPOINTS = 20  # at which a run is held against the stiff solver
_ABSOLUTE = 1e-6  # of the relative tolerance [m², …]
_EXPONENTIAL = 6  # products of matrices that an exponential takes (Higham 2005, the highest fraction)


@dataclass(frozen=True, kw_only=True)
class Run:
    """A covariance to be solved for."""

    model: PowerModel
    measurement: float  # R [m² s]
    process: float  # Q
    cov: Array  # (n, n) at the start
    t0: float  # [s]
    t1: float  # [s]

    @property
    def noise(self) -> Array:
        """G Q Gᵀ ``(n, n)``."""
        return np.asarray(self.process * np.outer(self.model.drive, self.model.drive))

    def matrix(self, t: float) -> Array:
        """Return F(t) ``(n, n)``."""
        return np.asarray(np.einsum("j,jab->ab", t**self.model.powers, self.model.matrices))

    def slope(self, t: float, y: Array) -> Array:
        """Return η' ``(n²,)`` of η ``(n²,)``."""
        p = y.reshape(self.cov.shape)
        moved = self.matrix(t) @ p
        return np.asarray((moved + moved.T - np.outer(p[:, 0], p[0]) / self.measurement + self.noise).ravel())


# ---- how exact -------------------------------------------------------------------------------------------------


def reference(run: Run, times: Array, *, relative: float = 1e-12) -> Array:
    """Return the covariance ``(k, n, n)`` at ``times`` ``(k,)`` by SciPy's stiff solver."""
    solved = solve_ivp(
        run.slope, (run.t0, run.t1), run.cov.ravel(), method="Radau", t_eval=times, rtol=relative,
        atol=relative * 1e-5,
    )  # fmt: skip
    if not solved.success:
        raise ArithmeticError(f"the stiff solver failed on {run.model.name}: {solved.message}")
    return np.asarray(solved.y.T.reshape(-1, *run.cov.shape))


def relative_deviation(cov: Array, true: Array) -> Array:
    """Return the largest deviation ``(k,)`` of the entries of ``(k, n, n)``, each as a share of √(ηᵢᵢ ηⱼⱼ).

    As a share of themselves entries off the diagonal would deviate without bounds where they pass through zero.
    """
    scale = np.sqrt(np.einsum("kii,kjj->kij", true, true))
    return np.asarray((np.abs(cov - true) / scale).max(axis=(1, 2)))


# ---- each method -----------------------------------------------------------------------------------------------


def solve(method: str, setting: float, run: Run, *, pieces: int = 1) -> tuple[Array, int]:
    """Return the covariance ``(pieces, n, n)`` at the end of each of so many equal pieces, and the steps tried."""
    ends, cov, out, steps = np.linspace(run.t0, run.t1, pieces + 1).tolist(), run.cov, [], 0
    if method in _TRANSFORMS:
        order, recovery = _TRANSFORMS[method]
        rules = Tolerances(recovery=recovery, order=order, relative=setting, absolute=_ABSOLUTE * setting)
        kalman = KalmanBucyFilter(run.model, measurement=run.measurement, process=run.process, tolerances=rules)
        kalman.reset(time=run.t0, cov=cov)
    for begin, end in pairwise(ends):
        if method in _TRANSFORMS:
            kalman.advance(end - begin)
            cov, steps = kalman.cov, kalman.expansions
        elif method == "RK45":
            solved = solve_ivp(
                run.slope, (begin, end), cov.ravel(), rtol=setting, atol=_ABSOLUTE * setting, t_eval=[end]
            )
            # Two evaluations begin a solution; of the seven of a step one is the last step's.
            cov, steps = solved.y[:, -1].reshape(cov.shape), steps + (solved.nfev - 2) // 6
        else:
            count = max(round(setting / pieces), 1)
            cov, steps = _equal_steps(method, run, begin, end, count, cov), steps + count
        out.append(cov)
    return np.array(out), steps


def _equal_steps(method: str, run: Run, begin: float, end: float, count: int, cov: Array) -> Array:
    """Go ``count`` equal steps, with F as it is in the middle of each."""
    n, h = len(cov), (end - begin) / count
    f = np.array([run.matrix(begin + (k + 0.5) * h) for k in range(count)])
    a, inverse_r = np.zeros((count, 2 * n, 2 * n)), 1.0 / run.measurement
    if method == "Van Loan":
        a[:, :n, :n], a[:, :n, n:], a[:, n:, n:] = -f, run.noise, f.swapaxes(1, 2)
    else:
        a[:, :n, :n], a[:, n:, :n], a[:, n:, n:] = -f.swapaxes(1, 2), run.noise, f
        a[:, 0, n] = inverse_r
    for e in expm(h * a):
        if method == "Van Loan":
            moved = e[n:, n:].T @ (cov @ e[n:, n:] + e[:n, n:])
            cov = moved - np.outer(moved[:, 0], moved[0]) / (moved[0, 0] + run.measurement / h)
        else:  # η = (E₂₁ + E₂₂ η)(E₁₁ + E₁₂ η)⁻¹
            cov = np.linalg.solve((e[:n, :n] + e[:n, n:] @ cov).T, (e[n:, :n] + e[n:, n:] @ cov).T)
    return cov


# ---- what it costs ---------------------------------------------------------------------------------------------


def multiplications(method: str, model: PowerModel) -> int:
    """Return how many multiplications a step takes: the leading terms, without products by F's zeros."""
    n, entries = model.size, model.size * (model.size + 1) // 2
    constant, varying = (_products(model.matrices[model.powers == 0.0 if still else model.powers != 0.0])
                         for still in (True, False))  # fmt: skip
    if method in _TRANSFORMS:
        order, recovery = _TRANSFORMS[method]
        half, discretes = order // 2, order + 1
        # The convolutions Σ_l η(l) η(k - l) and Σ_l F(l) η(k - l), k = 0 … order; elimination for the fractions.
        recurrence = discretes * (discretes + 1) // 2 * (entries + varying) + discretes * (constant + 2 * entries)
        fraction = entries * (half * (half**2 - 1) // 3 + half * (half - 1) // 2)
        return recurrence + (fraction if recovery == "pade" else 0)
    if method == "RK45":
        weights = sum(np.count_nonzero(part) for part in (RK45.A, RK45.B, RK45.E))
        return int(6 * (constant + varying + 2 * entries) + weights * entries)
    return int(_EXPONENTIAL * (2 * n) ** 3 + (2 * n**3 if method == "Van Loan" else 10 * n**3 // 3))


def _products(matrices: Array) -> int:
    """Return the products that the upper triangle of F η + η Fᵀ takes; on the diagonal both are the same."""
    filled = np.count_nonzero(np.any(matrices != 0.0, axis=0), axis=1) if len(matrices) else np.zeros(1, np.intp)
    return int(len(filled) * filled.sum())


def measure(run: Run) -> list[dict[str, Any]]:
    """Return per method and setting the deviation, the steps, and the multiplications.

    The deviation is the largest at 20 times; steps and multiplications are those of going to the end at once.
    """
    true = reference(run, np.linspace(run.t0, run.t1, _CHECKPOINTS + 1))[1:]
    rows = []
    for method, settings in METHODS.items():
        for setting in settings:
            cov, _ = solve(method, setting, run, pieces=_CHECKPOINTS)
            _, steps = solve(method, setting, run)
            rows.append({
                "method": method, "setting": setting, "steps": steps,
                "deviation": float(relative_deviation(cov, true).max()),
                "multiplications": steps * multiplications(method, run.model),
            })  # fmt: skip
    return rows


def cheapest(rows: Sequence[dict[str, Any]], goal: float) -> dict[str, dict[str, Any] | None]:
    """Return of each method the run of fewest multiplications that deviates by no more than ``goal``, or None."""
    out: dict[str, dict[str, Any] | None] = {}
    for method in METHODS:
        good = [row for row in rows if row["method"] == method and row["deviation"] <= goal]
        out[method] = min(good, key=lambda row: int(row["multiplications"])) if good else None
    return out
