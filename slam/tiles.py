"""Products of matrices, a tile at a time in registers: as fast as a BLAS on one thread, and always the same bits.

A BLAS spreads larger products over threads, and then rounds otherwise than on one; but one seed must give the same
bits everywhere. Nor does it subtract a product from a triangle that is the corner of a larger array.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.lanes import LANES, add_product, aligned_zeros, first, load, store, subtract_product

__all__ = ["add_combination", "downdate", "product", "subtract"]

Array = NDArray[np.float64]

_HEIGHT, _WIDTH = 8, 2 * LANES  # of a tile: as much as the registers hold


def product(a: Array, b: Array, n: int) -> Array:
    """Return a b, of whose columns the first ``n`` are computed and the others zero."""
    out = aligned_zeros(len(a), b.shape[1])
    subtract(out, len(a), n, np.ascontiguousarray(-a.T), b, a.shape[1])
    return out


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def add_combination(out: Array, n: int, factors: Array, w: Array) -> None:
    """Add to ``out`` ``(≥ n,)`` the first rows of ``w``, each times its factor."""
    for j in range(0, n, LANES):
        mask = first(n - j)
        v = load(out, j, mask)
        for k in range(factors.shape[0]):
            v = add_product(v, factors[k], load(w, (k, j), mask))
        store(out, j, mask, v)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def downdate(p: Array, n: int, left: Array, right: Array, rows: int, pairs: int) -> None:
    """Subtract a symmetric product Lᵀ R of two arrays' first ``rows`` from the upper triangle of p.

    The rows that follow are ``pairs`` of a and b, the same in both arrays: of each, a bᵀ + b aᵀ is subtracted,
    too; ``rows`` is even then. The lower triangle of p is undefined after.
    """
    whole = n - n % _HEIGHT
    for i in range(0, whole, _HEIGHT):
        j = i
        while j + _WIDTH <= n:
            _tile(p, i, j, left, right, rows, pairs, None, None)
            j += _WIDTH
        if j < n:
            _tile(p, i, j, left, right, rows, pairs, first(n - j), first(n - j - LANES))
    for i in range(whole, n):
        for j in range(i, n):
            for k in range(rows):
                p[i, j] -= left[k, i] * right[k, j]
            for k in range(rows, rows + 2 * pairs):
                p[i, j] -= left[k ^ 1, i] * right[k, j]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def subtract(out: Array, height: int, n: int, left: Array, right: Array, rows: int) -> None:
    """Subtract the product Lᵀ R of two arrays' first ``rows`` from ``out[:height, :n]``."""
    whole = height - height % _HEIGHT
    for i in range(0, whole, _HEIGHT):
        for j in range(0, n, _WIDTH):
            if j + _WIDTH <= n:
                _tile(out, i, j, left, right, rows, 0, None, None)
            else:
                _tile(out, i, j, left, right, rows, 0, first(n - j), first(n - j - LANES))
    for i in range(whole, height):
        for j in range(0, n, LANES):
            mask = first(n - j)
            v = load(out, (i, j), mask)
            for k in range(rows):
                v = subtract_product(v, left[k, i], load(right, (k, j), mask))
            store(out, (i, j), mask, v)


@njit(nogil=True, error_model="numpy", fastmath={"contract"}, forceinline=True)
def _tile(
    p: Array, i: int, j: int, left: Array, right: Array, rows: int, pairs: int, mask0: Any, mask1: Any
) -> None:
    """Subtract a tile of Lᵀ R, eight rows and two vectors of columns, from p at (i, j)."""
    r = j + LANES
    a0, b0 = load(p, (i, j), mask0), load(p, (i, r), mask1)
    a1, b1 = load(p, (i + 1, j), mask0), load(p, (i + 1, r), mask1)
    a2, b2 = load(p, (i + 2, j), mask0), load(p, (i + 2, r), mask1)
    a3, b3 = load(p, (i + 3, j), mask0), load(p, (i + 3, r), mask1)
    a4, b4 = load(p, (i + 4, j), mask0), load(p, (i + 4, r), mask1)
    a5, b5 = load(p, (i + 5, j), mask0), load(p, (i + 5, r), mask1)
    a6, b6 = load(p, (i + 6, j), mask0), load(p, (i + 6, r), mask1)
    a7, b7 = load(p, (i + 7, j), mask0), load(p, (i + 7, r), mask1)
    for k in range(rows + 2 * pairs):
        f, x, y = left[k if k < rows else k ^ 1], load(right, (k, j), mask0), load(right, (k, r), mask1)
        a0, b0 = subtract_product(a0, f[i], x), subtract_product(b0, f[i], y)
        a1, b1 = subtract_product(a1, f[i + 1], x), subtract_product(b1, f[i + 1], y)
        a2, b2 = subtract_product(a2, f[i + 2], x), subtract_product(b2, f[i + 2], y)
        a3, b3 = subtract_product(a3, f[i + 3], x), subtract_product(b3, f[i + 3], y)
        a4, b4 = subtract_product(a4, f[i + 4], x), subtract_product(b4, f[i + 4], y)
        a5, b5 = subtract_product(a5, f[i + 5], x), subtract_product(b5, f[i + 5], y)
        a6, b6 = subtract_product(a6, f[i + 6], x), subtract_product(b6, f[i + 6], y)
        a7, b7 = subtract_product(a7, f[i + 7], x), subtract_product(b7, f[i + 7], y)
    store(p, (i, j), mask0, a0)
    store(p, (i + 1, j), mask0, a1)
    store(p, (i + 2, j), mask0, a2)
    store(p, (i + 3, j), mask0, a3)
    store(p, (i + 4, j), mask0, a4)
    store(p, (i + 5, j), mask0, a5)
    store(p, (i + 6, j), mask0, a6)
    store(p, (i + 7, j), mask0, a7)
    store(p, (i, r), mask1, b0)
    store(p, (i + 1, r), mask1, b1)
    store(p, (i + 2, r), mask1, b2)
    store(p, (i + 3, r), mask1, b3)
    store(p, (i + 4, r), mask1, b4)
    store(p, (i + 5, r), mask1, b5)
    store(p, (i + 6, r), mask1, b6)
    store(p, (i + 7, r), mask1, b7)
