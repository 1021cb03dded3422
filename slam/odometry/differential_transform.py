"""Taylor spectra of the differential (Pukhov) transform, and the motion models that are written in them.

The spectrum of x about t₀ with scale h is X(k) = hᵏ/k! x⁽ᵏ⁾(t₀), an array ``(order + 1,)`` in the units of x; the
original is x(t₀ + θ h) = Σ X(k) θᵏ, or a Padé fraction that agrees with it.
The filter that these serve is in :mod:`slam.odometry.riccati`.
Equations: ``docs/reference/differential_transform.md``.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from slam.settings import check_name, require
from slam.types import Array

__all__ = ["MODELS", "PowerModel", "fill_model", "fit_pade", "make_model"]

SINGULAR = 1e-10
"""A pivot this small, as a share of the largest number in its system, is taken for zero."""


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
    """Write n₁ … n_m ``(m,)`` of the denominator, from Σ_j n_j c(m + i - j) = -c(m + i), i = 1 … m.

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


class PowerModel:
    """The motion of one coordinate: x' = F(t) x + G q, of which the first state is measured, z = x₁ + ϑ.

    Parameters
    ----------
    name
        For messages and tables.
    powers, matrices
        ``(j,)`` and ``(j, n, n)``: F(t) = Σ ``matrices[j]`` t^``powers[j]``. A power that is negative or not whole
        needs t₀ > 0.
    drive
        G ``(n,)``: where the process noise enters.
    """

    def __init__(self, name: str, *, powers: ArrayLike, matrices: ArrayLike, drive: ArrayLike) -> None:
        self.name = name
        self.powers: Array = np.array(powers, np.float64)
        self.matrices: Array = np.array(matrices, np.float64)
        self.drive: Array = np.array(drive, np.float64)
        self.size = n = len(self.drive)
        require(
            self.matrices.shape == (len(self.powers), n, n),
            f"{name} takes matrices ({len(self.powers)}, {n}, {n})",
        )
        self.needs_positive_time = bool(np.any((self.powers < 0) | (self.powers % 1.0 != 0)))


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
    check_name("motion model", name, MODELS)
    return MODELS[name]
