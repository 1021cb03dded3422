"""Quantiles of the χ² distribution, for consistency bands and association gates, without SciPy."""

from __future__ import annotations

import math
from functools import lru_cache
from statistics import NormalDist

__all__ = ["chi2_quantile"]


@lru_cache(maxsize=256)
def chi2_quantile(probability: float, dof: float) -> float:
    """Return x with P(χ² ≤ x) = ``probability`` for ``dof`` > 0 degrees of freedom, to about 1e-12 of x.

    Newton's iteration for u = log(x/2) on the logarithm of the smaller tail. That is concave in u, so the
    iteration converges from any start; the start is Wilson and Hilferty's (1931).
    """
    if not (0.0 <= probability <= 1.0 and 0.0 < dof < math.inf):
        raise ValueError(f"chi2_quantile needs probability in [0, 1] and dof > 0, got {probability}, {dof}")
    if probability in (0.0, 1.0):
        return math.inf * probability if probability else 0.0
    a, upper = 0.5 * dof, probability > 0.5
    target = math.log(1.0 - probability if upper else probability)
    spread = 2.0 / (9.0 * dof)
    root = 1.0 - spread + NormalDist().inv_cdf(probability) * math.sqrt(spread)
    # Far down the lower tail the cube has no meaning; P ≈ (x/2)ᵃ / Γ(a + 1) has.
    u = math.log(a) + 3.0 * math.log(root) if root > 0.1 else (target + math.lgamma(a + 1.0)) / a
    for _ in range(100):
        value, slope = _log_gamma_tail(a, u, upper=upper)
        u += (target - value) / slope
        if abs(target - value) <= 1e-11 * abs(slope):
            break
    return 2.0 * math.exp(u)


def _log_gamma_tail(a: float, u: float, *, upper: bool) -> tuple[float, float]:
    """Return log P(a, eᵘ), or log Q, of the regularised incomplete gamma function, and its slope in u."""
    x = math.exp(u)
    log_density = a * u - x - math.lgamma(a)
    if x < a + 1.0:  # series for P (Abramowitz and Stegun 6.5.29)
        term = total = 1.0 / a
        k = a
        while term > 1e-17 * total:
            k += 1.0
            term *= x / k
            total += term
        is_upper = False
    else:  # continued fraction for Q (6.5.31), evaluated by Lentz's method
        b = x + 1.0 - a
        c, d = math.inf, 1.0 / b
        total = d
        for i in range(1, 100_000):
            numerator = i * (a - i)
            b += 2.0
            d = 1.0 / (b + numerator * d)
            c = b + numerator / c
            total *= c * d
            if abs(c * d - 1.0) < 1e-16:
                break
        is_upper = True
    log_tail = log_density + math.log(total)
    if upper != is_upper:
        log_tail = math.log1p(-math.exp(log_tail))
    return log_tail, math.exp(log_density - log_tail) * (-1.0 if upper else 1.0)
