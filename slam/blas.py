"""BLAS's matrix product on part of a larger array, for maps too large for a plain loop.

SciPy's own wrappers take whole contiguous matrices only; a filter's covariance is the corner of an array with
room to grow. So the routine is taken from where SciPy offers it to compiled code, and called with its leading
dimension.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

__all__ = ["product", "rank_k_downdate"]

Array = NDArray[np.float64]

# Products this large OpenBLAS spreads over threads, and then rounds otherwise than on one. Smaller ones it does
# not, whatever the number of threads (interface/gemm.c): one seed must give the same bits everywhere.
_LARGEST_PRODUCT = 65536 * 4

_AS_IS, _TRANSPOSED = ctypes.byref(ctypes.c_char(b"N")), ctypes.byref(ctypes.c_char(b"T"))
_MINUS_ONE, _ONE = ctypes.byref(ctypes.c_double(-1.0)), ctypes.byref(ctypes.c_double(1.0))


@lru_cache(maxsize=1)
def _dgemm() -> Callable[..., None]:
    from numba.extending import get_cython_function_address

    address = get_cython_function_address("scipy.linalg.cython_blas", "dgemm")
    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 13)(address)


def product(a: Array, b: Array) -> Array:
    """Return a b, in pieces that BLAS does not spread over threads either."""
    out = np.empty((a.shape[0], b.shape[1]))
    step = max(_LARGEST_PRODUCT // max(b.shape[0] * b.shape[1], 1), 1)
    for i in range(0, len(a), step):
        np.matmul(a[i : i + step], b, out=out[i : i + step])
    return out


def rank_k_downdate(p: Array, n: int, w: Array, rows: int) -> None:
    """Subtract Wᵀ W, W = w[:rows, :n], from the upper triangle of p[:n, :n], both C-ordered.

    By blocks of rows, from the diagonal to the right: p's lower triangle is undefined after.
    """
    dgemm = _dgemm()
    length, height, depth = ctypes.c_int(), ctypes.c_int(), ctypes.c_int(rows)
    stride_w, stride_p = ctypes.c_int(w.shape[1]), ctypes.c_int(p.shape[1])
    by = ctypes.byref
    length_at, height_at, depth_at, w_step, p_step = (
        by(length), by(height), by(depth), by(stride_w), by(stride_p)
    )  # fmt: skip
    w_at, p_at = w.ctypes.data, p.ctypes.data
    diagonal = 8 * (p.shape[1] + 1)  # bytes from one entry of the diagonal to the next
    first = 0
    while first < n:
        length.value = n - first
        height.value = min(max(_LARGEST_PRODUCT // (rows * (n - first)), 1), n - first)
        block_w, block_p = w_at + 8 * first, p_at + diagonal * first
        # To BLAS, which counts by columns, p and w are transposed.
        dgemm(
            _AS_IS, _TRANSPOSED, length_at, height_at, depth_at, _MINUS_ONE, block_w, w_step, block_w, w_step,
            _ONE, block_p, p_step,
        )  # fmt: skip
        first += height.value
