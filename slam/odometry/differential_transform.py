"""Taylor spectra, the arithmetic of the differential (Pukhov) transform, and the motion models written in them.

The spectrum of x about t₀ with scale h is X(k) = hᵏ/k! x⁽ᵏ⁾(t₀), an array ``(order + 1,)`` in the units of x; the
original is x(t₀ + θ h) = Σ X(k) θᵏ, or a Padé fraction that agrees with it (theory.md C, differential transform).
The filter that these serve is in :mod:`slam.odometry.riccati`.
Equations: ``docs/reference/differential_transform.md``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from slam.settings import require, unknown_name

__all__ = [
    "MODELS", "Model", "PowerModel", "SpectrumModel", "constant", "derivative", "evaluate", "fit_pade",
    "integral", "make_model", "pade", "power", "product", "quotient", "rescale",
]  # fmt: skip

Array = NDArray[np.float64]
Compiled = TypeVar("Compiled", bound=Callable[..., object])

SINGULAR = 1e-10
"""A pivot this small, as a share of the largest number in its system, is taken for zero."""


# ---- spectra ---------------------------------------------------------------------------------------------------


def constant(value: float, order: int) -> Array:
    """Return the spectrum ``(order + 1,)`` of a constant: it stands in the first discrete alone."""
    out = np.zeros(order + 1)
    out[0] = value
    return out


def power(exponent: float, t0: float, h: float, order: int) -> Array:
    """Return the spectrum ``(order + 1,)`` of tᵖ about t₀: C(p, k) t₀ᵖ (h/t₀)ᵏ.

    2/t is ``2 * power(-1, …)``. ``ValueError`` at t₀ = 0 unless p is a whole number of at least 0, and below it
    unless p is whole.
    """
    whole = float(exponent).is_integer()
    require(t0 > 0 or whole, f"t to the power of {exponent:g} has no spectrum about t0 = {t0:g}")
    require(t0 != 0 or exponent >= 0, f"t to the power of {exponent:g} has no spectrum about 0")
    out = np.empty(order + 1)
    _fill_power(out, float(exponent), float(t0), float(h))
    return out


def derivative(x: Array, h: float) -> Array:
    """Return the spectrum ``(order,)`` of dx/dt: (k + 1)/h X(k + 1)."""
    return np.asarray(np.arange(1, len(x)) * x[1:] / h)


def integral(x: Array, h: float, start: float = 0.0) -> Array:
    """Return the spectrum ``(order + 2,)`` of ``start`` plus x's integral; :func:`derivative` undoes it."""
    return np.concatenate([[start], h * x / np.arange(1, len(x) + 1)])


def product(x: Array, y: Array) -> Array:
    """Return the spectrum of x y: the convolution Σ X(l) Y(k - l), up to the shorter one's order."""
    order = min(len(x), len(y))
    return np.asarray(np.convolve(x, y)[:order])


def quotient(x: Array, y: Array) -> Array:
    """Return the spectrum of x / y: the convolution solved for its factor. ``ValueError`` where y(t₀) = 0."""
    require(y[0] != 0, "nothing can be divided by a spectrum whose first discrete is zero")
    order = min(len(x), len(y))
    out = np.zeros(order)
    for k in range(order):
        out[k] = (x[k] - out[:k] @ y[k:0:-1]) / y[0]
    return out


def rescale(x: Array, ratio: float) -> Array:
    """Return the spectrum of the same function for the scale ``ratio`` · h: X(k) ratioᵏ."""
    return np.asarray(x * np.power(float(ratio), np.arange(len(x))))


def evaluate(x: Array, share: ArrayLike) -> Array:
    """Return x(t₀ + θ h) of θ = ``share`` (any shape) by the series."""
    theta, out = np.asarray(share, np.float64), np.zeros(np.shape(share))
    for value in x[::-1].tolist():
        out = out * theta + value
    return out


def pade(x: Array) -> tuple[Array, Array] | None:
    """Return numerator ``(m + 1,)`` and denominator ``(m + 1,)`` of the [m/m] fraction of a spectrum in θ.

    The spectrum holds 2m + 1 discretes: [3/3], the paper's, takes seven. None where the m × m system for the
    denominator is singular, as a polynomial's of low degree is: then the series does.
    """
    require(len(x) % 2 == 1 and len(x) >= 3, "a Padé fraction [m/m] takes 2m + 1 discretes")
    m = len(x) // 2
    below = np.zeros(m)
    if not fit_pade(np.asarray(x, np.float64), np.empty((m, m + 1)), below):
        return None
    denominator = np.concatenate([[1.0], below])
    return product(x[: m + 1], denominator), denominator


# ---- kernels ---------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_power(out: Array, exponent: float, t0: float, h: float) -> None:
    """Write the spectrum of tᵖ about t₀; about 0, where p is whole and at least 0, it stands in one discrete."""
    if t0 == 0.0 and exponent >= 0.0:
        out[:] = 0.0
        if exponent < out.shape[0]:
            out[int(exponent)] = h**exponent
        return
    out[0] = t0**exponent
    ratio = h / t0
    for k in range(out.shape[0] - 1):
        out[k + 1] = out[k] * ((exponent - k) / (k + 1.0)) * ratio


@njit(cache=True, nogil=True, error_model="numpy")
def fill_model(powers: Array, matrices: Array, t0: float, h: float, column: Array, f: Array) -> None:
    """Write the spectra ``f`` ``(K, n, n)`` of F(t) = Σ ``matrices[j]`` t^``powers[j]``.

    ``column`` ``(K,)`` is room.
    """
    f[:] = 0.0
    n = f.shape[1]
    for j in range(powers.shape[0]):
        if powers[j] == 0.0:
            for a in range(n):
                for b in range(n):
                    f[0, a, b] += matrices[j, a, b]
            continue
        _fill_power(column, powers[j], t0, h)
        for a in range(n):
            for b in range(n):
                if matrices[j, a, b] != 0.0:
                    for k in range(column.shape[0]):
                        f[k, a, b] += matrices[j, a, b] * column[k]


@njit(cache=True, nogil=True, error_model="numpy")
def fit_pade(c: Array, system: Array, below: Array) -> bool:
    """Write n₁ … n_m ``(m,)`` of the denominator, from Σ_j n_j c(m + i - j) = -c(m + i), i = 1 … m (theory.md C).

    ``c`` holds at least 2m + 1 discretes, ``system`` ``(m, m + 1)`` is room to work in. False: singular.
    """
    m = below.shape[0]
    largest = abs(c[0])
    for i in range(m):
        for j in range(m):
            system[i, j] = c[m + i - j]
            largest = max(largest, abs(system[i, j]))
        system[i, m] = -c[m + i + 1]
    for i in range(m):
        pivot = i
        for r in range(i + 1, m):
            if abs(system[r, i]) > abs(system[pivot, i]):
                pivot = r
        if not abs(system[pivot, i]) > SINGULAR * largest:
            return False
        if pivot != i:
            for j in range(i, m + 1):
                held = system[i, j]
                system[i, j] = system[pivot, j]
                system[pivot, j] = held
        for r in range(i + 1, m):
            factor = system[r, i] / system[i, i]
            for j in range(i + 1, m + 1):
                system[r, j] -= factor * system[i, j]
    for i in range(m - 1, -1, -1):
        total = system[i, m]
        for j in range(i + 1, m):
            total -= system[i, j] * below[j]
        below[i] = total / system[i, i]
    return True


# ---- models ----------------------------------------------------------------------------------------------------


class Model(ABC):
    """The motion of one coordinate: x' = F(t) x + G q, of which the first state is measured, z = x₁ + ϑ.

    Attributes
    ----------
    name : str
        For messages and tables.
    size : int
        n, the number of states.
    drive : NDArray[np.float64]
        G ``(n,)``: where the process noise enters.
    """

    def __init__(self, name: str, drive: ArrayLike) -> None:
        self.name = name
        self.drive: Array = np.array(drive, np.float64)
        self.size = len(self.drive)

    @abstractmethod
    def spectrum(self, t0: float, h: float, order: int) -> Array:
        """Return the spectra ``(order + 1, n, n)`` of F about t₀ [s] with scale h [s]."""

    def matrix(self, t: float) -> Array:
        """Return F(t) ``(n, n)``."""
        return np.asarray(self.spectrum(t, 1.0, 0)[0])


class PowerModel(Model):
    """F(t) = Σ ``matrices[j]`` t^``powers[j]``: all of the filter then runs compiled.

    Parameters
    ----------
    powers, matrices
        ``(j,)`` and ``(j, n, n)``. A power that is negative or not whole needs t₀ > 0.
    """

    def __init__(self, name: str, *, powers: ArrayLike, matrices: ArrayLike, drive: ArrayLike) -> None:
        super().__init__(name, drive)
        self.powers: Array = np.array(powers, np.float64)
        self.matrices: Array = np.array(matrices, np.float64)
        n = self.size
        require(
            self.matrices.shape == (len(self.powers), n, n),
            f"{name} takes matrices ({len(self.powers)}, {n}, {n})",
        )
        self.needs_positive_time = bool(np.any((self.powers < 0) | (self.powers % 1.0 != 0)))

    def spectrum(self, t0: float, h: float, order: int) -> Array:
        """Return the spectra ``(order + 1, n, n)`` of F about t₀ [s] with scale h [s]."""
        columns = np.array([power(p, t0, h, order) for p in self.powers])
        return np.asarray(np.einsum("jk,jab->kab", columns, self.matrices))


class SpectrumModel(Model):
    """Any F(t) whose spectra are known: ``of(t0, h, order)`` returns them, ``(order + 1, n, n)``."""

    def __init__(self, name: str, of: Callable[[float, float, int], Array], *, drive: ArrayLike) -> None:
        super().__init__(name, drive)
        self._of = of

    def spectrum(self, t0: float, h: float, order: int) -> Array:
        """Return the spectra ``(order + 1, n, n)`` of F about t₀ [s] with scale h [s]."""
        return np.asarray(self._of(t0, h, order), np.float64)


_POSITION_RATE = np.array([[0.0, 1.0], [0.0, 0.0]])

MODELS: dict[str, PowerModel] = {
    model.name: model
    for model in (
        # ẍ = (2/t) ẋ - (2/t²) x, solved by t and t²: uniform acceleration from the origin at t = 0.
        PowerModel(
            "uniform_acceleration", powers=[0, -1, -2], drive=[0.0, 1.0],
            matrices=np.array([_POSITION_RATE, [[0, 0], [0, 2]], [[0, 0], [-2, 0]]]),
        ),
        # As the paper prints it: ẍ = (2/t²) x - (2/t) ẋ, solved by t and t⁻².
        PowerModel(
            "as_printed", powers=[0, -1, -2], drive=[0.0, 1.0],
            matrices=np.array([_POSITION_RATE, [[0, 0], [0, -2]], [[0, 0], [2, 0]]]),
        ),
        PowerModel("constant_velocity", powers=[0], drive=[0.0, 1.0], matrices=[_POSITION_RATE]),
        PowerModel(
            "wiener_acceleration", powers=[0], drive=[0.0, 0.0, 1.0],
            matrices=[[[0, 1, 0], [0, 0, 1], [0, 0, 0]]],
        ),
    )
}  # fmt: skip
"""The named models. Process noise drives the velocity [m²/s³], of ``wiener_acceleration`` the acceleration."""


def make_model(name: str) -> PowerModel:
    """Return a named model; ``ValueError`` lists the valid names."""
    if name not in MODELS:
        raise unknown_name("motion model", name, MODELS)
    return MODELS[name]
