"""Finite differences and random covariances for the estimators' tests."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from slam.geometry import wrap_scalar

Array = NDArray[np.float64]


def numerical_jacobian(
    function: Callable[[Array], Array], at: Array, *, angle: int | None = None, step: float = 1e-6
) -> Array:
    """Return central differences of ``function``; component ``angle`` of its value is wrapped."""
    columns = []
    for i in range(len(at)):
        d = np.zeros(len(at))
        d[i] = step
        difference = np.array(function(at + d)) - np.array(function(at - d))
        if angle is not None:
            difference[angle] = wrap_scalar(float(difference[angle]))
        columns.append(difference / (2 * step))
    return np.column_stack(columns)


def random_covariance(n: int, rng: np.random.Generator, scale: float = 0.01) -> Array:
    """Return a well-conditioned random covariance ``(n, n)``."""
    a = rng.standard_normal((n, n))
    return scale * (a @ a.T / n + 0.2 * np.eye(n))
