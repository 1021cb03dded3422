"""A covariance between what is near and what is far as a product of two thin matrices.

What is near is correlated with what is far only by way of the robot's journey between them: of a few hundred rows
some thirty are independent, to nine digits.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.gaussian.lanes import aligned_zeros
from slam.gaussian.tiles import product

__all__ = ["factor"]

Array = NDArray[np.float64]

_SAMPLES = 48  # sums of columns tried at first


def factor(cov: Array, row_sigma: Array, column_sigma: Array, tolerance: float) -> tuple[Array, Array]:
    """Return U ``(m, r)`` and V ``(r, n)`` with U V = ``cov`` ``(m, n)``, but for ``tolerance``.

    That bounds the root of the sum of squares of what is left of all correlations, covariances divided by σ's
    ``(m,)`` and ``(n,)``. The rows' space is found from random sums of columns (Halko, Martinsson and Tropp 2011,
    algorithm 4.1), the same ones every time.
    """
    m, n = cov.shape
    scaled = aligned_zeros(m, n)
    scaled[:, :n] = cov / row_sigma[:, None]
    basis, samples = np.eye(m), _SAMPLES
    while samples < m:
        sums = np.random.default_rng(0).standard_normal((n, samples)) / column_sigma[:, None]
        found = _orthonormal(product(scaled[:, :n], sums, samples)[:, :samples].T.copy(), tolerance)
        if len(found) < samples:
            basis = found.T
            break
        samples *= 2
    return row_sigma[:, None] * basis, product(basis.T, scaled, n)


@njit(cache=True, nogil=True, error_model="numpy")
def _orthonormal(rows: Array, tolerance: float) -> Array:
    """Return orthonormal vectors that span rows ``(k, m)`` but for the tolerance, by pivoted Gram-Schmidt."""
    count = rows.shape[0]
    found = 0
    for k in range(count):
        best, norm = k, 0.0
        for i in range(k, count):
            square = np.sqrt((rows[i] * rows[i]).sum())
            if square > norm:
                best, norm = i, square
        if norm <= tolerance:
            break
        for j in range(rows.shape[1]):
            rows[k, j], rows[best, j] = rows[best, j] / norm, rows[k, j]
        for _ in range(2):  # the second time takes what rounding left
            for i in range(k):
                rows[k] -= (rows[k] * rows[i]).sum() * rows[i]
            rows[k] /= np.sqrt((rows[k] * rows[k]).sum())
        for i in range(k + 1, count):
            rows[i] -= (rows[i] * rows[k]).sum() * rows[k]
        found += 1
    return rows[:found]
