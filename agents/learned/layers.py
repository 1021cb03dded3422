"""Layers in NumPy, for the networks that the package ships: what was trained runs without PyTorch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.types import Floats

__all__ = ["Layers"]


class Layers:
    """A network's weights, and what its layers, called by their names, make of an input.

    Parameters
    ----------
    weights : mapping
        Name to array, as PyTorch names them.

    Raises
    ------
    ValueError
        Where a weight is missing or does not fit the others.
    """

    def __init__(self, weights: Mapping[str, NDArray[Any]]) -> None:
        self._weights = {name: np.asarray(value, dtype=np.float32, order="C") for name, value in weights.items()}
        try:
            self._check()
        except KeyError as error:
            raise ValueError(f"weight {error.args[0]} is missing") from error

    def _check(self) -> None:
        """Raise ``KeyError`` for a weight that is missing, ``ValueError`` for one that does not fit."""
        raise NotImplementedError

    def _expect(self, shapes: Mapping[str, tuple[int, ...]]) -> None:
        for name, shape in shapes.items():
            found: Any = self._weights[name].shape
            if found != shape:
                raise ValueError(f"weight {name} has the shape {found}, expected {shape}")

    def _linear(self, name: str, x: Floats) -> Floats:
        return np.asarray(x @ self._weights[f"{name}.weight"].T + self._weights[f"{name}.bias"])

    def _convolved(self, name: str, x: Floats, dilation: int = 1) -> Floats:
        """Return the convolution ``(out, n, m)`` of ``(in, n, m)``, padded to the same size."""
        weight, bias = self._weights[f"{name}.weight"], self._weights[f"{name}.bias"]
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
