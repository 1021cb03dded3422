"""Quantiles of the χ² distribution, for consistency bands and association gates."""

from __future__ import annotations

import math
from functools import lru_cache

__all__ = ["chi2_quantile"]


@lru_cache(maxsize=256)
def chi2_quantile(probability: float, dof: float) -> float:
    """Return x with P(χ² ≤ x) = ``probability`` for ``dof`` > 0 degrees of freedom."""
    from scipy.special import gammaincinv

    if not (0.0 <= probability <= 1.0 and 0.0 < dof < math.inf):
        raise ValueError(f"chi2_quantile needs probability in [0, 1] and dof > 0, got {probability}, {dof}")
    return 2.0 * float(gammaincinv(0.5 * dof, probability))
