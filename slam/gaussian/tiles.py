"""Products of matrices, a tile at a time in registers: as fast as a BLAS on one thread, and always the same bits.

A BLAS spreads larger products over threads, and then rounds otherwise than on one; but one seed must give the same
bits everywhere. Nor does it subtract a product from a triangle that is the corner of a larger array.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from slam.gaussian.lanes import (
    LANES,
    add_product,
    aligned_zeros,
    first,
    load,
    store,
    subtract_number,
    subtract_product,
)
from slam.types import Array

__all__ = ["add_combination", "downdate", "product", "subtract"]

# Of a tile: what sixteen registers hold, AVX2's. With the thirty-two of AVX-512 a larger one is 5 % faster.
_HEIGHT, _WIDTH = 4, 3 * LANES
_CACHED = 48 * 1024  # float64: three eighths of a megabyte, of the one a core has next to its first cache


def product(a: Array, b: Array, n: int) -> Array:
    """Return a b, of whose columns the first ``n`` are computed and the others zero."""
    out = aligned_zeros(len(a), b.shape[1])
    subtract(out, len(a), n, np.ascontiguousarray(-a.T), b, a.shape[1])
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def add_combination(out: Array, n: int, factors: Array, w: Array) -> None:
    """Add to ``out`` ``(≥ n,)`` the first rows of ``w``, each times its factor."""
    for j in range(0, n, LANES):
        mask = first(n - j)
        v = load(out, j, mask)
        for k in range(factors.shape[0]):
            v = add_product(v, factors[k], load(w, (k, j), mask))
        store(out, j, mask, v)


@njit(cache=True, nogil=True, error_model="numpy")
def downdate(p: Array, n: int, left: Array, right: Array, rows: int, pairs: int) -> None:
    """Subtract a symmetric product Lᵀ R of two arrays' first ``rows`` from the upper triangle of p.

    The rows that follow are ``pairs`` of a and b, the same in both arrays: of each, a bᵀ + b aᵀ is subtracted,
    too; ``rows`` is even then. The lower triangle of p is undefined after.
    """
    whole = n - n % _HEIGHT
    width = _columns(n, rows + 2 * pairs)
    for begin in range(0, n, width):
        end = min(begin + width, n)
        for i in range(0, min(end, whole), _HEIGHT):
            _tiles(p, i, max(begin, i - i % LANES), end, left, right, rows, pairs)
    for i in range(whole, n):
        for j in range(i, n):
            for k in range(rows):
                p[i, j] = subtract_number(p[i, j], left[k, i], right[k, j])
            for k in range(rows, rows + 2 * pairs):
                p[i, j] = subtract_number(p[i, j], left[k ^ 1, i], right[k, j])


@njit(cache=True, nogil=True, error_model="numpy")
def subtract(out: Array, height: int, n: int, left: Array, right: Array, rows: int) -> None:
    """Subtract the product Lᵀ R of two arrays' first ``rows`` from ``out[:height, :n]``."""
    whole = height - height % _HEIGHT
    width = _columns(n, rows)
    for begin in range(0, n, width):
        for i in range(0, whole, _HEIGHT):
            _tiles(out, i, begin, min(begin + width, n), left, right, rows, 0)
    for i in range(whole, height):
        for j in range(0, n, LANES):
            mask = first(n - j)
            v = load(out, (i, j), mask)
            for k in range(rows):
                v = subtract_product(v, left[k, i], load(right, (k, j), mask))
            store(out, (i, j), mask, v)


@njit(nogil=True, error_model="numpy", forceinline=True)
def _columns(n: int, rows: int) -> int:
    """Return how many columns to do at a time, so that the right factor's stay in the cache."""
    return n if n * rows <= _CACHED else _WIDTH * max(1, _CACHED // (_WIDTH * rows))


@njit(nogil=True, error_model="numpy", forceinline=True)
def _tiles(p: Array, i: int, j: int, n: int, left: Array, right: Array, rows: int, pairs: int) -> None:
    """Subtract the tiles of Lᵀ R that begin in row i and from column j on."""
    while j + _WIDTH <= n:
        _tile(p, i, j, left, right, rows, pairs, None, None, None)
        j += _WIDTH
    if j < n:
        rest = n - j
        _tile(p, i, j, left, right, rows, pairs, first(rest), first(rest - LANES), first(rest - 2 * LANES))


@njit(nogil=True, error_model="numpy", forceinline=True)
def _tile(
    p: Array, i: int, j: int, left: Array, right: Array, rows: int, pairs: int, mask0: Any, mask1: Any, mask2: Any
) -> None:
    """Subtract a tile of Lᵀ R, four rows and three vectors of columns, from p at (i, j)."""
    j1, j2 = j + LANES, j + 2 * LANES
    a0, b0, c0 = load(p, (i, j), mask0), load(p, (i, j1), mask1), load(p, (i, j2), mask2)
    a1, b1, c1 = load(p, (i + 1, j), mask0), load(p, (i + 1, j1), mask1), load(p, (i + 1, j2), mask2)
    a2, b2, c2 = load(p, (i + 2, j), mask0), load(p, (i + 2, j1), mask1), load(p, (i + 2, j2), mask2)
    a3, b3, c3 = load(p, (i + 3, j), mask0), load(p, (i + 3, j1), mask1), load(p, (i + 3, j2), mask2)
    for k in range(rows + 2 * pairs):
        row = left[k if k < rows else k ^ 1]
        x, y, z = load(right, (k, j), mask0), load(right, (k, j1), mask1), load(right, (k, j2), mask2)
        f0, f1, f2, f3 = row[i], row[i + 1], row[i + 2], row[i + 3]
        a0, a1 = subtract_product(a0, f0, x), subtract_product(a1, f1, x)
        a2, a3 = subtract_product(a2, f2, x), subtract_product(a3, f3, x)
        b0, b1 = subtract_product(b0, f0, y), subtract_product(b1, f1, y)
        b2, b3 = subtract_product(b2, f2, y), subtract_product(b3, f3, y)
        c0, c1 = subtract_product(c0, f0, z), subtract_product(c1, f1, z)
        c2, c3 = subtract_product(c2, f2, z), subtract_product(c3, f3, z)
    store(p, (i, j), mask0, a0)
    store(p, (i + 1, j), mask0, a1)
    store(p, (i + 2, j), mask0, a2)
    store(p, (i + 3, j), mask0, a3)
    store(p, (i, j1), mask1, b0)
    store(p, (i + 1, j1), mask1, b1)
    store(p, (i + 2, j1), mask1, b2)
    store(p, (i + 3, j1), mask1, b3)
    store(p, (i, j2), mask2, c0)
    store(p, (i + 1, j2), mask2, c1)
    store(p, (i + 2, j2), mask2, c2)
    store(p, (i + 3, j2), mask2, c3)
