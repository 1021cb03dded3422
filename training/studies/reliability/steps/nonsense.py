"""What is no action, and that it is refused in a line."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from training.runs.errors import one_line
from training.studies.reliability.steps.watch import Findings

__all__ = ["NONSENSE_EVERY", "no_actions", "no_choices", "refuse"]

NONSENSE_EVERY = 4
"""Steps."""


def no_actions(size: int) -> Sequence[Any]:
    """Return what is no action of so many numbers: each has to be refused."""
    whole = np.zeros(size, np.float32)
    bad = []
    for value in (math.nan, math.inf, -math.inf):
        for k in (0, size - 1):
            one = whole.copy()
            one[k] = value
            bad.append(one)
    both = whole.astype(np.float64)
    both[:2] = math.inf, -math.inf
    return [
        *bad, both, np.full(size, math.nan), np.zeros(size - 1, np.float32), np.zeros(size + 1, np.float32),
        np.zeros((size, 1), np.float32), np.zeros(0, np.float32), np.float32(0.0), None, "ahead", ["a"] * size,
        [None] * size, [10**400] * size, np.zeros(size, np.complex128) + 1j, {}, object(), [[0.0], [0.0, 1.0]],
    ]  # fmt: skip


def no_choices(most: int) -> Sequence[Any]:
    """Return what is no choice of so many: each has to be refused."""
    return [-1, most, 10**30, math.nan, math.inf, None, "first", [0, 1], np.zeros(2), -(2**63), {}]


def refuse(step: Callable[[Any], Any], nonsense: Sequence[Any], k: int, found: Findings) -> None:
    """Act nonsense, the k-th of some: it has to be refused in a line."""
    bad = nonsense[k % len(nonsense)]
    shown = one_line(repr(bad))[:60]
    try:
        step(bad)
        found.note("nonsense was taken for an action", shown)
    except ValueError as error:
        found.refused += 1
        if not str(error) or "\n" in str(error) or len(str(error)) > 400:
            found.note("nonsense was refused in more than a line", f"{shown}: {str(error)[:200]!r}")
    except Exception as error:
        found.note(f"nonsense was refused by {type(error).__name__}", f"{shown}: {one_line(error)[:200]}")
