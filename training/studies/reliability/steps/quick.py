"""What is beyond doubt as it should be, told in microseconds; only what is not is looked at closely.

Neither tells that something is wrong: Gymnasium's own check and eigenvalues, which take longer than a step, do.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numba import njit

from slam.types import Array

__all__ = ["QuickSpace", "surely_covariance"]


class QuickSpace:
    """The boxes of a space of observations, their bounds in one row."""

    def __init__(self, space: spaces.Dict) -> None:
        self._kinds: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}
        self._bounded: list[str] = []
        low, high = [np.empty(0)], [np.empty(0)]
        for key, box in space.items():
            assert isinstance(box, spaces.Box) and box.dtype is not None
            self._kinds[key] = np.dtype(box.dtype), box.shape
            if not _holds_all(box):
                self._bounded.append(key)
                low.append(box.low.ravel())
                high.append(box.high.ravel())
        self._low, self._high = np.concatenate(low), np.concatenate(high)

    def surely_contains(self, observation: Mapping[str, Any]) -> bool:
        """Tell whether an observation has just what the space has, in kind, shape and bounds."""
        if not isinstance(observation, dict) or observation.keys() != self._kinds.keys():
            return False
        for key, (kind, shape) in self._kinds.items():
            value = observation[key]
            if not isinstance(value, np.ndarray) or value.dtype != kind or value.shape != shape:
                return False
        values = np.concatenate([np.empty(0), *(observation[key].ravel() for key in self._bounded)])
        return bool((values >= self._low).all() and (values <= self._high).all())  # NaN is in no bounds


def _holds_all(box: spaces.Box) -> bool:
    """Tell whether a box holds every number of its kind, as that of a map's bytes does."""
    if not np.issubdtype(box.dtype, np.integer):
        return False
    bounds: Any = np.iinfo(np.dtype(box.dtype))
    return bool((box.low == bounds.min).all() and (box.high == bounds.max).all())


@njit(cache=True, nogil=True)
def surely_covariance(cov: Array) -> bool:
    """Tell whether a matrix ``(n, n)`` is finite, symmetric to the bit, and has a Cholesky factor."""
    n = cov.shape[0]
    factor = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            if cov[i, j] != cov[j, i] or not math.isfinite(cov[i, j]):
                return False
            rest = cov[i, j]
            for k in range(j):
                rest -= factor[i, k] * factor[j, k]
            if i > j:
                factor[i, j] = rest / factor[j, j]
            elif rest > 0.0:
                factor[i, i] = math.sqrt(rest)
            else:
                return False
    return True
