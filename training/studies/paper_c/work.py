"""What paper C's filter costs: operations and time against how exact the covariance is, method by method."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from slam.odometry.differential_transform import Model, PowerModel
from slam.odometry.riccati import Tolerances, Workspace, advance
from training.studies.paper_c.peers import Counted, as_python, hamiltonian, rk45, van_loan

__all__ = ["METHODS", "Run", "cheapest", "measure", "reference", "relative_deviation", "solve"]

Array = NDArray[np.float64]
Go = Callable[[Any, Any], int]

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
_COUNTED_STEPS = 100  # equal steps all cost the same: so many are counted, and scaled
_ABSOLUTE = 1e-6  # of the relative tolerance [m², …]


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


# ---- how exact -------------------------------------------------------------------------------------------------


def reference(run: Run, times: Array, *, method: str = "Radau", relative: float = 1e-12) -> Array:
    """Return the covariance ``(k, n, n)`` at ``times`` ``(k,)`` by SciPy's stiff solver."""
    n, noise = run.model.size, run.noise

    def slope(t: float, y: Array) -> Array:
        p = y.reshape(n, n)
        moved = _matrix(run.model, t) @ p
        return np.asarray((moved + moved.T - np.outer(p[:, 0], p[0]) / run.measurement + noise).ravel())

    solved = solve_ivp(
        slope, (run.t0, run.t1), run.cov.ravel(), method=method, t_eval=times, rtol=relative, atol=relative * 1e-5
    )
    if not solved.success:
        raise ArithmeticError(f"the stiff solver failed on {run.model.name}: {solved.message}")
    return np.asarray(solved.y.T.reshape(-1, n, n))


def _matrix(model: Model, t: float) -> Array:
    if not isinstance(model, PowerModel):
        return model.matrix(t)
    return np.asarray(sum(m * t**p for m, p in zip(model.matrices, model.powers, strict=True)))


def relative_deviation(cov: Array, true: Array) -> Array:
    """Return the largest deviation ``(k,)`` of the entries of ``(k, n, n)``, each as a share of √(ηᵢᵢ ηⱼⱼ).

    As a share of themselves entries off the diagonal would deviate without bounds where they pass through zero.
    """
    scale = np.sqrt(np.einsum("kii,kjj->kij", true, true))
    return np.asarray((np.abs(cov - true) / scale).max(axis=(1, 2)))


# ---- each method -----------------------------------------------------------------------------------------------


def solve(method: str, setting: float, run: Run, *, counted: bool = False, pieces: int = 1) -> Array:
    """Return the covariance ``(pieces, n, n)`` at the end of each of so many equal pieces.

    With ``counted`` the numbers are :class:`~training.studies.paper_c.peers.Counted` and the kernels run as plain
    Python.
    """
    go, cov = _prepare(method, setting / pieces if setting >= 1 else setting, run, counted)
    span, out = (run.t1 - run.t0) / pieces, []
    for k in range(pieces):
        now = run.t0 + k * span
        go(Counted(now) if counted else now, Counted(span) if counted else span)
        out.append([[float(v) for v in row] for row in cov])
    return np.array(out)


def _prepare(method: str, setting: float, run: Run, counted: bool) -> tuple[Go, Array]:
    """Return what goes on from a time [s] by a span [s], and the covariance ``(n, n)`` that it changes."""
    prepare = _transform if method in _TRANSFORMS else _runge_kutta if method == "RK45" else _equal_steps
    return prepare(method, setting, run, counted)


def _transform(method: str, setting: float, run: Run, counted: bool) -> tuple[Go, Array]:
    order, recovery = _TRANSFORMS[method]
    rules = Tolerances(recovery=recovery, order=order, relative=setting, absolute=_ABSOLUTE * setting)
    model, kernel, room = run.model, *_kernel(advance, counted, run, order)
    room.eta[0] = _numbers(run.cov, counted)

    def go(t: Any, span: Any) -> int:
        return int(kernel(
            model.powers, model.matrices, run.noise, 1.0 / run.measurement, t, span, room.f, room.eta, room.x,
            room.z, room.column, rules.relative, rules.absolute, recovery == "pade", room.system, room.below,
            room.is_fraction,
        ))  # fmt: skip

    return go, room.eta[0]


def _kernel(kernel: Any, counted: bool, run: Run, order: int) -> tuple[Any, Workspace]:
    room = Workspace(run.model.size, order, dtype=object if counted else np.float64, estimate=False)
    return (as_python(kernel) if counted else kernel), room


def _runge_kutta(method: str, setting: float, run: Run, counted: bool) -> tuple[Go, Array]:
    del method
    n, model = run.model.size, run.model
    kernel = as_python(rk45) if counted else rk45
    cov, room = _numbers(run.cov, counted), np.zeros((9, n, n), object if counted else np.float64)
    step = np.array([1e-3])

    def go(t: Any, span: Any) -> int:
        return int(kernel(
            model.powers, model.matrices, run.noise, 1.0 / run.measurement, t, span, cov, setting,
            _ABSOLUTE * setting, step, room,
        ))  # fmt: skip

    return go, cov


def _equal_steps(method: str, setting: float, run: Run, counted: bool) -> tuple[Go, Array]:
    n, model, steps = run.model.size, run.model, max(round(setting), 1)
    compiled = van_loan if method == "Van Loan" else hamiltonian
    kernel = as_python(compiled) if counted else compiled
    cov = _numbers(run.cov, counted)
    room = np.zeros((5, 2 * n, 2 * n), object if counted else np.float64)

    def go(t: Any, span: Any) -> int:
        kernel(model.powers, model.matrices, run.noise, 1.0 / run.measurement, t, span, steps, cov, room)
        return steps

    return go, cov


def _numbers(values: Array, counted: bool) -> Array:
    """Return a copy ``(n, n)``, of numbers that count if asked."""
    out = np.array(values, object if counted else np.float64)
    if counted:
        for index, value in np.ndenumerate(values):
            out[index] = Counted(value)
    return out


# ---- what it costs ---------------------------------------------------------------------------------------------


def count(method: str, setting: float, run: Run) -> dict[str, float]:
    """Return how many operations of each kind solving takes; F, step choice and all."""
    scale = 1.0
    if method not in _TRANSFORMS and method != "RK45" and setting > _COUNTED_STEPS:
        scale = setting / _COUNTED_STEPS
        run = Run(
            model=run.model, measurement=run.measurement, process=run.process, cov=run.cov, t0=run.t0,
            t1=run.t0 + (run.t1 - run.t0) / scale,
        )  # fmt: skip
        setting = _COUNTED_STEPS
    Counted.start()
    solve(method, setting, run, counted=True)
    return {name: scale * number for name, number in Counted.done.items()}


def measure(run: Run, *, repeats: int) -> list[dict[str, Any]]:
    """Return per method and setting the deviation, the operations, and the median time of ``repeats`` solutions.

    The deviation is the largest at 20 times; operations and time are those of going to the end at once.
    """
    true = reference(run, np.linspace(run.t0, run.t1, _CHECKPOINTS + 1))[1:]
    rows = []
    for method, settings in METHODS.items():
        for setting in settings:
            cov = solve(method, setting, run, pieces=_CHECKPOINTS)
            times, steps = [], 0
            for _ in range(repeats):
                go, _ = _prepare(method, setting, run, False)
                start = time.perf_counter()
                steps = go(run.t0, run.t1 - run.t0)
                times.append(time.perf_counter() - start)
            operations = count(method, setting, run)
            rows.append({
                "method": method, "setting": setting, "steps": steps,
                "deviation": float(relative_deviation(cov, true).max()),
                "operations": round(sum(operations.values())),
                **{name: round(number) for name, number in operations.items()},
                "time_us": 1e6 * statistics.median(times),
            })  # fmt: skip
    return rows


def cheapest(rows: Sequence[dict[str, Any]], goal: float) -> dict[str, dict[str, Any] | None]:
    """Return of each method the run of fewest operations that deviates by no more than ``goal``, or None."""
    out: dict[str, dict[str, Any] | None] = {}
    for method in METHODS:
        good = [row for row in rows if row["method"] == method and row["deviation"] <= goal]
        out[method] = min(good, key=lambda row: int(row["operations"])) if good else None
    return out
