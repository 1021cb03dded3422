"""A covariance between what is near and what is far as a product of two thin matrices.

What is near is correlated with what is far only by way of the robot's journey between them: of a few hundred rows
some thirty are independent, to nine digits.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from slam.gaussian.lanes import aligned_zeros
from slam.gaussian.tiles import product
from slam.types import Array

__all__ = ["FEWEST_SAMPLES", "factor", "root_of_loss"]

FEWEST_SAMPLES = 48
"""Random sums of columns that are tried at first."""

_ROUNDING = 1e-14  # what a thousand updates of a covariance leave of it


def factor(
    cov: Array, row_sigma: Array, column_sigma: Array, tolerance: float, samples: int = FEWEST_SAMPLES
) -> tuple[Array, Array]:
    """Return U ``(m, r)`` and V ``(r, n)`` with U V = ``cov`` ``(m, n)``, but for ``tolerance``.

    That bounds the root of the sum of squares of what is left of all correlations, covariances divided by σ's
    ``(m,)`` and ``(n,)``. The columns' space is found from random sums of them (Halko, Martinsson and Tropp 2011,
    algorithm 4.1), the same ones every time: ``samples``, and more where the rank turns out to be as high.
    """
    m, n = cov.shape
    scaled = aligned_zeros(m, n)
    scaled[:, :n] = cov / row_sigma[:, None]
    while 2 * samples <= m:  # with more of them the factors take longer than they save
        sums = np.random.default_rng(0).standard_normal((n, samples)) / column_sigma[:, None]
        basis = _orthonormal(product(scaled[:, :n], sums, samples)[:, :samples].copy(), tolerance)
        if basis.shape[1] < samples:
            return row_sigma[:, None] * basis, product(basis.T, scaled, n)
        samples *= 2
    return np.diag(row_sigma), scaled


@njit(cache=True, nogil=True, error_model="numpy")
def _orthonormal(columns: Array, tolerance: float) -> Array:
    """Return orthonormal columns ``(m, r)`` that span those given but for the tolerance: pivoted Gram-Schmidt.

    All columns go along a row at a time: so sums over rows are sums of vectors. Those given are overwritten.
    """
    m, count = columns.shape
    out = np.empty((m, count))
    squares, along = np.zeros(count), np.empty(count)
    for j in range(m):
        for i in range(count):
            squares[i] += columns[j, i] * columns[j, i]
    found = 0
    while found < count:
        best = np.argmax(squares)
        norm = np.sqrt(squares[best])
        if norm <= tolerance:
            break
        new = columns[:, best] / norm
        for _ in range(2):  # the second time takes what rounding left
            along[:found] = 0.0
            for j in range(m):
                for i in range(found):
                    along[i] += new[j] * out[j, i]
            square = 0.0
            for j in range(m):
                for i in range(found):
                    new[j] -= along[i] * out[j, i]
                square += new[j] * new[j]
            new /= np.sqrt(square)
        out[:, found] = new
        found += 1
        along[:] = 0.0
        for j in range(m):
            for i in range(count):
                along[i] += new[j] * columns[j, i]
        squares[:] = 0.0
        for j in range(m):
            for i in range(count):
                columns[j, i] -= new[j] * along[i]
                squares[i] += columns[j, i] * columns[j, i]
    return out[:, :found].copy()


@njit(cache=True, nogil=True, error_model="numpy")
def root_of_loss(cov: Array, weights: Array, tolerance: float) -> Array:
    """Return G ``(k, r)`` with Gᵀ G = −``cov`` ``(r, r)``, which is ≤ 0, but for ``tolerance``.

    That bounds what is left out of the trace, each entry times its weight ``(r,)``, or rounding does. Pivoted
    Cholesky. k is small: all that was learnt is by way of the few landmarks seen meanwhile. Of ``cov`` the upper
    triangle is read.
    """
    r = cov.shape[0]
    root, rest = np.empty((r, r)), np.empty(r)
    for i in range(r):
        rest[i] = -cov[i, i]
    enough = max(tolerance, _ROUNDING * np.sum(weights * rest))
    found = 0
    while found < r:
        left, best = 0.0, 0
        for i in range(r):
            left += weights[i] * max(rest[i], 0.0)
            if weights[i] * rest[i] > weights[best] * rest[best]:
                best = i
        if not left > enough:
            break
        new, pivot = root[found], np.sqrt(rest[best])
        for i in range(r):
            new[i] = -cov[i, best] if i < best else -cov[best, i]
        for k in range(found):
            along = root[k, best]
            for i in range(r):
                new[i] -= along * root[k, i]
        for i in range(r):
            new[i] /= pivot
            rest[i] -= new[i] * new[i]
        rest[best] = 0.0
        found += 1
    return root[:found].copy()
