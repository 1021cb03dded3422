"""The Riccati equation of paper C's filter as a recurrence on spectra, re-expanded where need be.

    η' = F η + η Fᵀ - η Hᵀ H η / R + G Q Gᵀ,    x̂' = F x̂ + K (z - H x̂),    K = η Hᵀ / R,    H = [1, 0, …]

Where the step would leave what the spectra can tell, it ends there and they are taken anew about its end
(:func:`advance`). Equations and figures: ``docs/reference/differential_transform.md``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from numba import njit

from slam.odometry.differential_transform import fill_model, fit_pade
from slam.settings import Config, OneOf, Within, require
from slam.types import Array, Flags

__all__ = ["RECOVERIES", "Rules", "Tolerances", "Workspace", "advance"]

Rules = tuple[float, float, bool]  # relative and absolute error of an expansion, whether fractions are tried

RECOVERIES = ("pade", "series")
_SAFETY = 0.9  # of the step that the error estimate allows
_RADIUS_SHARE = 0.5  # of the radius of convergence that a step may use, whatever the estimate says
_MOST_EXPANSIONS = 1_000_000  # of one step
_DENOMINATOR_LEFT = 0.2  # a Padé denominator may fall from 1 to no less than this within the step


@dataclass(frozen=True, kw_only=True)
class Tolerances(Config):
    """How exactly the differential equations are solved, and how the original is recovered.

    The error of one expansion may be ``relative`` · √(ηᵢᵢ ηⱼⱼ) + ``absolute`` in ηᵢⱼ, and for x̂ᵢ as many of its σ
    (and of its own size).
    """

    recovery: Annotated[str, OneOf(RECOVERIES)] = "pade"  # or "series"
    order: Annotated[int, Within("[2, 30]")] = 6  # the highest discrete used, even; Padé [order/2, order/2]
    relative: Annotated[float, Within("(0, 1)")] = 1e-9
    absolute: Annotated[float, Within("(0, 1]")] = 1e-15  # [m²], …

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.order % 2 == 0, f"Tolerances.order must be even, got {self.order}")

    @property
    def rules(self) -> Rules:
        """What the kernels are told."""
        return self.relative, self.absolute, self.recovery == "pade"


class Workspace(NamedTuple):
    """Room for the spectra of one filter, so that no kernel allocates; K = order + 2.

    One discrete more than is used tells of the error. ``eta[0]`` and ``x[0]`` are the values now.
    """

    f: Array  # (K, n, n), spectra of F
    eta: Array  # (K, n, n), of η
    x: Array  # (K, n), of x̂
    z: Array  # (2,): the measurement now, and its change over what is left of the step
    column: Array  # (K,)
    system: Array  # (order / 2, order / 2 + 1), of a fraction's denominator
    below: Array  # (entries, order / 2), every entry's denominator
    is_fraction: Flags  # (entries,): which are recovered by a fraction

    @classmethod
    def of(cls, n: int, order: int) -> Workspace:
        """Return room for n states."""
        count, half, entries = order + 2, order // 2, n * (n + 1) // 2 + n
        square, fractions = (count, n, n), np.zeros(entries, np.bool_)
        return cls(
            np.zeros(square), np.zeros(square), np.zeros((count, n)), np.zeros(2), np.zeros(count),
            np.zeros((half, half + 1)), np.zeros((entries, half)), fractions,
        )  # fmt: skip


# ---- kernels ---------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True, error_model="numpy")
def covariance_spectrum(f: Array, noise: Array, inverse_r: float, h: float, eta: Array) -> None:
    """Fill η(1) … from η(0), spectra ``(K, n, n)``: the Riccati equation as a recurrence.

    (k + 1)/h η(k + 1) = Σ_l F(l) η(k - l) + η(k - l) F(l)ᵀ - η(l) Hᵀ H η(k - l) / R, and G Q Gᵀ in k = 0.
    """
    n = eta.shape[1]
    for k in range(eta.shape[0] - 1):
        share = h / (k + 1.0)
        for i in range(n):
            for j in range(i, n):
                seen = eta[0, i, 0] * eta[k, 0, j]
                for m in range(1, k + 1):
                    seen += eta[m, i, 0] * eta[k - m, 0, j]
                total = -(seen * inverse_r)
                if k == 0 and noise[i, j] != 0.0:
                    total += noise[i, j]
                moved = 0.0
                for m in range(k + 1):
                    for a in range(n):
                        if f[m, i, a] != 0.0:
                            moved += f[m, i, a] * eta[k - m, a, j]
                        if i != j and f[m, j, a] != 0.0:
                            moved += f[m, j, a] * eta[k - m, i, a]
                total += 2.0 * moved if i == j else moved
                eta[k + 1, i, j] = share * total
                eta[k + 1, j, i] = eta[k + 1, i, j]


@njit(cache=True, nogil=True, error_model="numpy")
def estimate_spectrum(f: Array, inverse_r: float, h: float, eta: Array, z: Array, x: Array) -> None:
    """Fill X(1) … of x̂ ``(K, n)`` from X(0) and all of η: (k + 1)/h X(k + 1) = Σ_l F(l) X(k - l) + K(l) E(k - l).

    E is the innovation z - x̂₁, of a measurement that changes linearly within the step.
    """
    n = x.shape[1]
    for k in range(x.shape[0] - 1):
        share = h / (k + 1.0)
        for i in range(n):
            seen = eta[k, i, 0] * (z[0] - x[0, 0])
            for m in range(k):
                e = z[1] - x[1, 0] if k - m == 1 else -x[k - m, 0]
                seen += eta[m, i, 0] * e
            total = seen * inverse_r
            for m in range(k + 1):
                for a in range(n):
                    if f[m, i, a] != 0.0:
                        total += f[m, i, a] * x[k - m, a]
            x[k + 1, i] = share * total


@njit(cache=True, nogil=True, error_model="numpy")
def _allowed_share(c: Array, allowed: float, scale: float, try_pade: bool, system: Array, below: Array) -> float:
    """Return how large a share θ of the scale h an entry allows: below zero by the fraction, else by the series.

    ``c`` ``(K,)`` are its discretes, the last of which only tells of the error; ``allowed`` is what the error may
    be and ``scale`` the entry's size. The radius of convergence is Jorba and Zou's (2005), from the last two.
    """
    count = c.shape[0]
    last: float = abs(c[count - 1])
    before: float = abs(c[count - 2])
    # Of an even or odd function every other discrete vanishes: both have to be heard.
    inverse: float = max((last / scale) ** (1.0 / (count - 1)), (before / scale) ** (1.0 / (count - 2)))
    if inverse == 0.0:
        return 1.0
    radius = 1.0 / inverse
    by_series: float = min(radius * (allowed / scale) ** (1.0 / (count - 1)), _RADIUS_SHARE * radius)
    if by_series >= 1.0 or not try_pade:
        return min(by_series, 1.0)
    # Fitted for the scale radius · h, in which the discretes are of one size, so that a pivot tells something.
    factor = 1.0
    for k in range(count):
        c[k] *= factor
        factor *= radius
    m = below.shape[0]
    share = -1.0
    if fit_pade(c, system, below):
        missed = c[count - 1]
        for j in range(m):
            missed += below[j] * c[count - 2 - j]
        share = _RADIUS_SHARE
        if missed != 0.0:
            share = min(share, (_DENOMINATOR_LEFT * allowed / abs(missed)) ** (1.0 / (count - 1)))
        share = min(share, inverse)  # no more than h
        while _lost(below, share) > 1.0 - _DENOMINATOR_LEFT:
            share *= 0.8
        share *= radius
    factor = 1.0
    for j in range(m):
        factor *= inverse
        below[j] *= factor
    factor = 1.0
    for k in range(count):
        c[k] *= factor
        factor *= inverse
    return -share if share > by_series else by_series


@njit(cache=True, nogil=True, error_model="numpy")
def _lost(below: Array, share: float) -> float:
    """Return by how much the denominator 1 + n₁ θ + … can fall at most for any θ up to ``share``."""
    total: float = 0.0
    factor = 1.0
    for j in range(below.shape[0]):
        factor *= share
        total += abs(below[j]) * factor
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def recover(c: Array, below: Array, is_fraction: bool, share: float) -> float:
    """Return the original at t₀ + ``share`` · h from its discretes: by the fraction, or by the series (Horner)."""
    if not is_fraction:
        value: float = c[c.shape[0] - 2]
        for k in range(c.shape[0] - 3, -1, -1):
            value = value * share + c[k]
        return value
    m: int = below.shape[0]
    above: float = c[m]
    under: float = below[m - 1]
    for j in range(m):
        above += below[j] * c[m - 1 - j]
    for i in range(m - 1, -1, -1):
        term: float = c[i]
        for j in range(i):
            term += below[j] * c[i - 1 - j]
        above = above * share + term
        under = under * share + (below[i - 1] if i > 0 else 1.0)
    return above / under


@njit(cache=True, nogil=True, error_model="numpy")
def step_share(work: Workspace, rules: Rules) -> float:
    """Return the share of h that every entry of η and x̂ allows; note which to recover by a fraction."""
    eta, x = work.eta, work.x
    relative, absolute, try_pade = rules
    n = eta.shape[1]
    share, entry = 1.0, 0
    for i in range(n):
        for j in range(i, n):
            scale = (abs(eta[0, i, i] * eta[0, j, j])) ** 0.5 + absolute / relative
            own = _allowed_share(eta[:, i, j], relative * scale, scale, try_pade, work.system, work.below[entry])
            work.is_fraction[entry] = own < 0.0
            share = min(share, abs(own))
            entry += 1
    for i in range(n):
        scale = abs(x[0, i]) + (abs(eta[0, i, i]) + absolute / relative) ** 0.5
        own = _allowed_share(x[:, i], relative * scale, scale, try_pade, work.system, work.below[entry])
        work.is_fraction[entry] = own < 0.0
        share = min(share, abs(own))
        entry += 1
    return share


@njit(cache=True, nogil=True, error_model="numpy")
def expand(f: Array, noise: Array, inverse_r: float, h: float, work: Workspace, rules: Rules) -> float:
    """Go as far towards t₀ + h as one expansion reaches, F's spectra being ``f``; return which share of h that is.

    The values at its end are then ``eta[0]`` and ``x[0]``, and ``z`` is what is left of the measurement's change.
    """
    eta, x, z = work.eta, work.x, work.z
    n = eta.shape[1]
    covariance_spectrum(f, noise, inverse_r, h, eta)
    estimate_spectrum(f, inverse_r, h, eta, z, x)
    share = step_share(work, rules)
    if share < 1.0:
        share = min(share * _SAFETY, 1.0)
    entry = 0
    for i in range(n):
        for j in range(i, n):
            eta[0, i, j] = recover(eta[:, i, j], work.below[entry], work.is_fraction[entry], share)
            eta[0, j, i] = eta[0, i, j]
            entry += 1
    for i in range(n):
        x[0, i] = recover(x[:, i], work.below[entry], work.is_fraction[entry], share)
        entry += 1
    z[0] += z[1] * share
    z[1] *= 1.0 - share
    return share


@njit(cache=True, nogil=True, error_model="numpy")
def advance(
    powers: Array, matrices: Array, noise: Array, inverse_r: float, t: float, span: float, work: Workspace,
    rules: Rules,
) -> int:  # fmt: skip
    """Solve from t to t + ``span`` [s] in as many expansions as it takes; return how many, -1 if they get stuck.

    ``powers`` and ``matrices`` are those of :class:`~slam.odometry.differential_transform.PowerModel`.
    """
    end, now = t + span, t
    for count in range(1, _MOST_EXPANSIONS):
        h = end - now
        fill_model(powers, matrices, now, h, work.column, work.f)
        share = expand(work.f, noise, inverse_r, h, work, rules)
        if share >= 1.0:
            return count
        now += share * h
        if not share * h > 0.0:
            return -1
    return -1
