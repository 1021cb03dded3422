"""Checks that the generators' configurations share."""

from __future__ import annotations

import math
from typing import Any

from slam.settings import require

__all__ = ["interval"]


def interval(config: Any, name: str, *, low: float, high: float, whole: bool = False) -> None:
    """Raise ``ValueError`` unless the field is a pair of (whole) numbers, ``low`` ≤ first ≤ second ≤ ``high``."""
    value = getattr(config, name)
    what = f"{type(config).__name__}.{name}"
    ok = isinstance(value, (tuple, list)) and len(value) == 2
    ok = ok and all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in value)
    require(ok, f"{what} must be two numbers (least, most), got {value!r}")
    require(not whole or all(isinstance(v, int) for v in value), f"{what} must be two whole numbers")
    first, second = value
    require(
        math.isfinite(first) and math.isfinite(second) and low <= first <= second <= high,
        f"{what} needs {low:g} ≤ least ≤ most ≤ {high:g}, got {value!r}",
    )
