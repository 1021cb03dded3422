"""Convolution in NumPy, for the networks that the package ships: they run without PyTorch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["convolve"]

Floats = NDArray[np.float32]


def convolve(x: Floats, weight: Floats, bias: Floats, dilation: int = 1) -> Floats:
    """Return the convolution ``(out, n, m)`` of ``(in, n, m)``, padded to the same size."""
    out, channels, k, _ = weight.shape
    if k == 1:
        flat = weight.reshape(out, channels) @ x.reshape(channels, -1)
    else:
        pad = dilation * (k // 2)
        rows, cols = x.shape[1:]
        padded = np.zeros((channels, rows + 2 * pad, cols + 2 * pad), np.float32)
        padded[:, pad:-pad, pad:-pad] = x
        c, i, j = padded.strides
        view = np.lib.stride_tricks.as_strided(
            padded, (channels, k, k, rows, cols), (c, dilation * i, dilation * j, i, j), writeable=False
        )
        flat = weight.reshape(out, -1) @ view.reshape(channels * k * k, rows * cols)
    flat += bias[:, None]
    return np.asarray(flat.reshape(out, *x.shape[1:]))
