"""What paper C's recurrence is held against: other ways to solve the Riccati equation, and numbers that count.

Dormand and Prince's RK45; Van Loan's matrix exponential with the discrete filter's update; the exponential of the
Hamiltonian matrix (Davison and Maki), which solves the Riccati equation itself while F stays as it is. All are
compiled, as the recurrence is, so that times compare; run as plain Python on :class:`Counted` numbers they tell
how many operations they took.
"""

from __future__ import annotations

from collections.abc import Callable
from types import FunctionType
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["Counted", "as_python", "hamiltonian", "rk45", "van_loan"]

Array = NDArray[np.float64]

# Dormand and Prince (1980): nodes, stages, and the fifth order's weights less the fourth's.
_NODES = (0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0)
_STAGES = (
    (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    (1 / 5, 0.0, 0.0, 0.0, 0.0, 0.0),
    (3 / 40, 9 / 40, 0.0, 0.0, 0.0, 0.0),
    (44 / 45, -56 / 15, 32 / 9, 0.0, 0.0, 0.0),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0.0, 0.0),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0.0),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
_ERROR = (71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40)
_TAYLOR_TERMS = 12  # of the matrix exponential, whose argument's norm is at most 1/2: 1e-13


# ---- kernels ---------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_matrix(powers: Array, matrices: Array, t: float, f: Array) -> None:
    """Write F(t) ``(n, n)``."""
    f[:] = 0.0
    for j in range(powers.shape[0]):
        factor = t ** powers[j] if powers[j] != 0.0 else 1.0
        for a in range(f.shape[0]):
            for b in range(f.shape[0]):
                if matrices[j, a, b] != 0.0:
                    f[a, b] += matrices[j, a, b] * factor if powers[j] != 0.0 else matrices[j, a, b]


@njit(cache=True, nogil=True, error_model="numpy")
def _slope(f: Array, noise: Array, inverse_r: float, p: Array, out: Array) -> None:
    """Write η' = F η + η Fᵀ - η Hᵀ H η / R + G Q Gᵀ, without the products by F's zeros."""
    n = p.shape[0]
    for i in range(n):
        for j in range(i, n):
            total = -(p[i, 0] * p[0, j] * inverse_r)
            if noise[i, j] != 0.0:
                total += noise[i, j]
            for a in range(n):
                if f[i, a] != 0.0:
                    total += f[i, a] * p[a, j]
                if f[j, a] != 0.0:
                    total += f[j, a] * p[i, a]
            out[i, j] = total
            out[j, i] = total


@njit(cache=True, nogil=True, error_model="numpy")
def _try_step(
    powers: Array, matrices: Array, noise: Array, inverse_r: float, now: float, h: float, p: Array,
    relative: float, absolute: float, work: Array,
) -> float:  # fmt: skip
    """Write the covariance a step of ``h`` [s] later to ``work[8]``; return its error over what is allowed."""
    n, f, trial = p.shape[0], work[7], work[8]
    for s in range(1, 7):
        for i in range(n):
            for j in range(i, n):
                total = _STAGES[s][0] * work[0, i, j]
                for r in range(1, s):
                    if _STAGES[s][r] != 0.0:
                        total += _STAGES[s][r] * work[r, i, j]
                trial[i, j] = p[i, j] + h * total
                trial[j, i] = trial[i, j]
        _fill_matrix(powers, matrices, now + _NODES[s] * h, f)
        _slope(f, noise, inverse_r, trial, work[s])
    worst = 0.0
    for i in range(n):
        for j in range(i, n):
            total = _ERROR[0] * work[0, i, j]
            for r in range(2, 7):
                total += _ERROR[r] * work[r, i, j]
            allowed = relative * abs(trial[i, i] * trial[j, j]) ** 0.5 + absolute
            worst = max(worst, abs(h * total) / allowed)
    return worst


@njit(cache=True, nogil=True, error_model="numpy")
def rk45(
    powers: Array, matrices: Array, noise: Array, inverse_r: float, t: float, span: float, p: Array,
    relative: float, absolute: float, step: Array, work: Array,
) -> int:  # fmt: skip
    """Solve from ``t`` to ``t + span`` [s], ``p`` ``(n, n)`` in place; return the number of steps tried.

    ``step`` ``(1,)`` is the step to try [s], kept from call to call; ``work`` ``(9, n, n)`` is room. The error of
    a step may be as large as that of an expansion (:class:`slam.odometry.riccati.Tolerances`).
    """
    now, end, tried = t, t + span, 0
    _fill_matrix(powers, matrices, now, work[7])
    _slope(work[7], noise, inverse_r, p, work[0])
    while now < end:
        tried += 1
        h = min(step[0], end - now)
        is_last = step[0] >= end - now
        worst = _try_step(powers, matrices, noise, inverse_r, now, h, p, relative, absolute, work)
        if worst <= 1.0:
            p[:] = work[8]
            work[0] = work[6]
            now = end if is_last else now + h
        factor = 0.9 * worst**-0.2 if worst > 0.0 else 5.0
        # A last step is as short as it has to be, which tells nothing of the next one.
        if worst > 1.0 or not is_last or factor < 1.0:
            step[0] = h * min(max(factor, 0.2), 5.0)
    return tried


@njit(cache=True, nogil=True, error_model="numpy")
def _multiply(a: Array, b: Array, out: Array) -> None:
    """Write a b, without the products by a's zeros."""
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            out[i, j] = 0.0
            for k in range(a.shape[1]):
                if a[i, k] != 0.0:
                    out[i, j] += a[i, k] * b[k, j]


@njit(cache=True, nogil=True, error_model="numpy")
def _exponential(a: Array, out: Array, term: Array, held: Array) -> None:
    """Write eᵃ by scaling, Taylor's series, and squaring; ``a`` is overwritten."""
    size, squarings, largest = a.shape[0], 0, 0.0
    for i in range(size):
        total = 0.0
        for j in range(size):
            if a[i, j] != 0.0:
                total += abs(a[i, j])
        largest = max(largest, total)
    scale = 1.0
    while largest > 0.5:
        largest *= 0.5
        scale *= 0.5
        squarings += 1
    for i in range(size):
        for j in range(size):
            if squarings and a[i, j] != 0.0:
                a[i, j] = a[i, j] * scale
            term[i, j] = a[i, j]
            out[i, j] = a[i, j] + 1.0 if i == j else a[i, j]
    for k in range(2, _TAYLOR_TERMS + 1):
        _multiply(a, term, held)
        for i in range(size):
            for j in range(size):
                if held[i, j] != 0.0:
                    term[i, j] = held[i, j] * (1.0 / k)
                    out[i, j] += term[i, j]
                else:
                    term[i, j] = 0.0
    for _ in range(squarings):
        held[:] = out
        term[:] = out
        _multiply(held, term, out)


@njit(cache=True, nogil=True, error_model="numpy")
def van_loan(
    powers: Array, matrices: Array, noise: Array, inverse_r: float, t: float, span: float, steps: int, p: Array,
    work: Array,
) -> None:  # fmt: skip
    """Go ``steps`` equal steps of the discrete filter, ``p`` ``(n, n)`` in place: Φ and Q by Van Loan (1978).

    F is that of the step's middle; the update takes a measurement of variance R/Δt. ``work`` ``(5, 2n, 2n)``.
    """
    n, h = p.shape[0], span / steps
    f, a, e = work[0, :n, :n], work[1], work[2]
    phi, q, moved = work[3, :n, :n], work[3, :n, n:], work[3, n:, :n]
    for k in range(steps):
        _fill_matrix(powers, matrices, t + (k + 0.5) * h, f)
        a[:] = 0.0
        for i in range(n):
            for j in range(n):
                if f[i, j] != 0.0:
                    a[i, j] = -(f[i, j] * h)
                    a[n + j, n + i] = -a[i, j]
                if noise[i, j] != 0.0:
                    a[i, n + j] = noise[i, j] * h
        _exponential(a, e, work[3], work[4])
        for i in range(n):
            for j in range(n):
                phi[i, j] = e[n + j, n + i]
        _multiply(phi, e[:n, n:], q)
        _multiply(phi, p, moved)
        for i in range(n):
            for j in range(i, n):
                for m in range(n):
                    q[i, j] += moved[i, m] * phi[j, m]
                q[j, i] = q[i, j]
        weight = 1.0 / (q[0, 0] + 1.0 / (inverse_r * h))
        for i in range(n):
            for j in range(i, n):
                p[i, j] = q[i, j] - q[i, 0] * weight * q[0, j]
                p[j, i] = p[i, j]


@njit(cache=True, nogil=True, error_model="numpy")
def hamiltonian(
    powers: Array, matrices: Array, noise: Array, inverse_r: float, t: float, span: float, steps: int, p: Array,
    work: Array,
) -> None:  # fmt: skip
    """Go ``steps`` equal steps, each exact for F of the step's middle: η = (E₂₁ + E₂₂ η)(E₁₁ + E₁₂ η)⁻¹.

    E = exp(Δt [[-Fᵀ, HᵀH/R], [GQGᵀ, F]]), Davison and Maki (1973). ``work`` ``(5, 2n, 2n)``.
    """
    n, h = p.shape[0], span / steps
    f, a, e = work[0, :n, :n], work[1], work[2]
    under, above, held = work[3, :n, :n], work[3, n:, :n], work[3, :n, n:]
    for k in range(steps):
        _fill_matrix(powers, matrices, t + (k + 0.5) * h, f)
        a[:] = 0.0
        a[0, n] = inverse_r * h
        for i in range(n):
            for j in range(n):
                if f[i, j] != 0.0:
                    a[n + i, n + j] = f[i, j] * h
                    a[j, i] = -a[n + i, n + j]
                if noise[i, j] != 0.0:
                    a[n + i, j] = noise[i, j] * h
        _exponential(a, e, work[3], work[4])
        _multiply(e[:n, n:], p, held)
        for i in range(n):
            for j in range(n):
                under[i, j] = e[i, j] + held[i, j]
        _multiply(e[n:, n:], p, held)
        for i in range(n):
            for j in range(n):
                above[i, j] = e[n + i, j] + held[i, j]
        _divide(above, under, p)


@njit(cache=True, nogil=True, error_model="numpy")
def _divide(above: Array, under: Array, out: Array) -> None:
    """Write above · under⁻¹, which is symmetric, by elimination in the columns; both are overwritten."""
    n = out.shape[0]
    for c in range(n):
        for j in range(c + 1, n):
            factor = under[c, j] / under[c, c]
            for i in range(c + 1, n):
                under[i, j] -= factor * under[i, c]
            for i in range(n):
                above[i, j] -= factor * above[i, c]
    for j in range(n - 1, -1, -1):
        for i in range(j + 1):
            total = above[i, j] * 1.0
            for c in range(j + 1, n):
                total -= out[i, c] * under[c, j]
            out[i, j] = total / under[j, j]
            out[j, i] = out[i, j]


# ---- counting --------------------------------------------------------------------------------------------------


class Counted:
    """A number that counts what is done with it: products, sums (differences, too), quotients, powers.

    Comparisons, signs and copies cost nothing here, and multiplications by zeros that are known beforehand do not
    take place. The counts are of the class: ``Counted.done``.
    """

    __array_ufunc__ = None  # NumPy's own numbers leave it to us
    __slots__ = ("value",)
    done: dict[str, int] = {}  # noqa: RUF012 - meant to be of the class

    def __init__(self, value: float) -> None:
        self.value = float(value)

    @classmethod
    def start(cls) -> None:
        """Begin to count from zero."""
        cls.done = {"multiplications": 0, "additions": 0, "divisions": 0, "powers": 0}

    def _note(self, what: str, value: float) -> Counted:
        Counted.done[what] += 1
        return Counted(value)

    def __mul__(self, other: Any) -> Counted:
        return self._note("multiplications", self.value * float(other))

    __rmul__ = __mul__

    def __add__(self, other: Any) -> Counted:
        return self._note("additions", self.value + float(other))

    __radd__ = __add__

    def __sub__(self, other: Any) -> Counted:
        return self._note("additions", self.value - float(other))

    def __rsub__(self, other: Any) -> Counted:
        return self._note("additions", float(other) - self.value)

    def __truediv__(self, other: Any) -> Counted:
        return self._note("divisions", self.value / float(other))

    def __rtruediv__(self, other: Any) -> Counted:
        return self._note("divisions", float(other) / self.value)

    def __pow__(self, other: Any) -> Counted:
        return self._note("powers", self.value ** float(other))

    def __neg__(self) -> Counted:
        return Counted(-self.value)

    def __abs__(self) -> Counted:
        return Counted(abs(self.value))

    def __float__(self) -> float:
        return self.value

    def __lt__(self, other: Any) -> bool:
        return self.value < float(other)

    def __le__(self, other: Any) -> bool:
        return self.value <= float(other)

    def __gt__(self, other: Any) -> bool:
        return self.value > float(other)

    def __ge__(self, other: Any) -> bool:
        return self.value >= float(other)

    def __eq__(self, other: object) -> bool:
        return self.value == float(other)  # type: ignore[arg-type]

    __hash__ = None  # type: ignore[assignment]


def as_python(kernel: Any) -> Callable[..., Any]:
    """Return a compiled kernel as the Python function it was written as, and so every kernel that it calls."""
    function = kernel.py_func
    scope = dict(function.__globals__)
    for name in function.__code__.co_names:
        if hasattr(scope.get(name), "py_func"):
            scope[name] = as_python(scope[name])
    return FunctionType(function.__code__, scope, function.__name__)
