"""BLAS's matrix product in pieces so small that it gives the same bits on any number of threads."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["product"]

Array = NDArray[np.float64]

# Products this large OpenBLAS spreads over threads, and then rounds otherwise than on one. Smaller ones it does
# not, whatever the number of threads (interface/gemm.c): one seed must give the same bits everywhere.
_LARGEST_PRODUCT = 65536 * 4


def product(a: Array, b: Array) -> Array:
    """Return a b, in pieces that BLAS does not spread over threads either."""
    out = np.empty((a.shape[0], b.shape[1]))
    step = max(_LARGEST_PRODUCT // max(b.shape[0] * b.shape[1], 1), 1)
    for i in range(0, len(a), step):
        np.matmul(a[i : i + step], b, out=out[i : i + step])
    return out
