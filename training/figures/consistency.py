"""Is the error as large as the covariance says? The pose's NEES over many runs, step by step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from slam.metrics.measures import anees, nees_band
from slam.types import Array

__all__ = ["consistency_figures", "step_averages"]


def step_averages(profiles: Sequence[ArrayLike]) -> tuple[Array, Array, Array]:
    """Return per step the average NEES / 3 over the runs, and the limits of its 95 % band.

    Counted as long as at least half the runs go on; the others' ends would leave the average to a few.
    """
    runs = [np.asarray(profile, np.float64) for profile in profiles]
    steps = int(np.median([len(run) for run in runs]))
    values = np.full((len(runs), steps), np.nan)
    for row, run in zip(values, runs, strict=True):
        row[: len(run)] = run[:steps]
    going_on = (~np.isnan(values)).sum(axis=0).tolist()  # a robot of a team may have ended before its team
    bands = {count: nees_band(3, max(count, 1)) for count in set(going_on)}
    low, high = np.array([bands[count] for count in going_on]).reshape(-1, 2).T
    return anees(values, axis=0), low, high


def consistency_figures(profiles: Sequence[ArrayLike]) -> dict[str, Any]:
    """Return the mean NEES / 3 over all steps of runs, each a profile ``(steps,)``, and how it lies in its band.

    The mean is infinite where a covariance ruled an error out, ``None`` where nothing is defined. The band is that
    of the average over so many runs, step by step (:func:`step_averages`).
    """
    averages, lows, highs = step_averages(profiles)
    inside = np.count_nonzero((averages >= lows) & (averages <= highs))
    steps = np.concatenate([np.asarray(profile, np.float64) for profile in profiles])
    return {
        "nees_over_3_mean": float(np.nanmean(steps)) / 3 if not np.isnan(steps).all() else None,
        "nees_band_95": list(nees_band(3, len(profiles))),
        "fraction_in_band": float(inside / max(len(averages), 1)),
    }
