"""Robust averages with bootstrap intervals, and comparisons in pairs.

Interquartile means, stratified bootstrap and probability of improvement as in Agarwal et al., "Deep reinforcement
learning at the edge of the statistical precipice", NeurIPS 2021; ``docs/how-to/benchmark.md`` says what for.
Everything is drawn from fixed seeds: the same values give the same intervals.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam.types import Array
from training.runs.running import plain

__all__ = [
    "CONFIDENCE", "NONE", "RESAMPLES", "Comparison", "Estimate", "Interval", "compare", "estimate", "interval",
    "iqm", "mean_interval", "median", "ratio_of_sums", "resampled_indices",
]  # fmt: skip

Indices = NDArray[np.intp]

CONFIDENCE = 0.95
RESAMPLES = 2000
_SEED = 20210830  # of every resampling: figures of the same episodes share their resamples


@dataclass(frozen=True)
class Interval:
    """A value, and the interval that holds its true one with :data:`CONFIDENCE`; nan where there is none."""

    value: float
    low: float
    high: float

    def as_json(self) -> dict[str, float | None]:
        """Return value and limits by their names, null for what is not finite."""
        return {name: plain(float(getattr(self, name))) for name in ("value", "low", "high")}


NONE = Interval(np.nan, np.nan, np.nan)


@dataclass(frozen=True)
class Estimate:
    """Averages of one metric over episodes, each with its interval."""

    iqm: Interval
    median: Interval
    mean: Interval
    n: int


@dataclass(frozen=True)
class Comparison:
    """One agent against another on the same episodes."""

    difference: Interval  # of the IQMs, ours − theirs, in the metric's unit
    ratio: Interval  # of the IQMs, ours / theirs
    probability: Interval  # that ours does better in an episode, a tie counted half
    n: int  # pairs


def iqm(values: ArrayLike) -> Array:
    """Return the interquartile mean: the mean of what is left without the lowest and the highest quarter.

    Along the last axis; of n values, ⌊n / 4⌋ are left out at either end, so that up to three are averaged whole.
    """
    # Sorting whole rows takes a tenth of the time of NumPy's partition, and so of scipy.stats.trim_mean.
    ordered = np.sort(np.asarray(values, np.float64), axis=-1)
    n = ordered.shape[-1]
    return np.asarray(ordered[..., n // 4 : n - n // 4].mean(axis=-1))


def median(values: ArrayLike) -> Array:
    """Return the median along the last axis; between a number and infinity it is infinite."""
    ordered = np.sort(np.asarray(values, np.float64), axis=-1)
    n = ordered.shape[-1]
    return np.asarray(0.5 * (ordered[..., (n - 1) // 2] + ordered[..., n // 2]))


# ---- resampling ------------------------------------------------------------------------------------------------


def resampled_indices(strata: Sequence[Hashable]) -> Indices:
    """Return bootstrap resamples of n episodes as indices ``(RESAMPLES, n)``; each stratum keeps its share."""
    codes = {name: code for code, name in enumerate(dict.fromkeys(strata))}
    return _indices(tuple(codes[name] for name in strata))


@lru_cache(maxsize=8)  # 16 MB each, of a thousand episodes
def _indices(codes: tuple[int, ...]) -> Indices:
    rng = np.random.default_rng(_SEED)
    stratum, out = np.array(codes, np.intp), np.empty((RESAMPLES, len(codes)), np.intp)
    for code in range(stratum.max(initial=-1) + 1):
        members = np.flatnonzero(stratum == code)
        out[:, members] = members[rng.integers(len(members), size=(RESAMPLES, len(members)))]
    out.setflags(write=False)
    return out


def interval(statistic: Callable[[Indices], Array], strata: Sequence[Hashable]) -> Interval:
    """Return a statistic of n episodes with its percentile bootstrap interval.

    Parameters
    ----------
    statistic
        Of indices ``(…, n)`` into the episodes → ``(…,)``.
    strata
        Each episode's stratum ``(n,)``.

    Notes
    -----
    The limits are order statistics, not interpolated between: a statistic may be infinite in some resamples. Where
    it is not defined in one of them, or a stratum has but one episode, neither are the limits.
    """
    if not len(strata):
        return NONE
    return _limits(float(statistic(np.arange(len(strata))[None])[0]), statistic(resampled_indices(strata)), strata)


def estimate(values: ArrayLike, strata: Sequence[Hashable], *, for_median: ArrayLike | None = None) -> Estimate:
    """Return IQM, median and mean of values ``(n,)``.

    Parameters
    ----------
    values
        One an episode.
    strata
        Each episode's stratum ``(n,)``.
    for_median
        Values that the median is taken of instead: those that are infinite where something was never reached.
    """
    v = np.asarray(values, np.float64)
    m = v if for_median is None else np.asarray(for_median, np.float64)
    return Estimate(
        iqm=interval(lambda at: iqm(v[at]), strata),
        median=interval(lambda at: median(m[at]), strata),
        mean=mean_interval(v, strata),
        n=len(v),
    )


def mean_interval(values: ArrayLike, strata: Sequence[Hashable]) -> Interval:
    """Return the mean of values ``(n,)`` with its interval."""
    v = np.asarray(values, np.float64)
    return interval(lambda at: np.asarray(v[at].mean(axis=-1)), strata)


def ratio_of_sums(above: ArrayLike, below: ArrayLike, strata: Sequence[Hashable]) -> Interval:
    """Return Σ above / Σ below of values ``(n,)``, such as contacts over way driven, with its interval."""
    a, b = np.asarray(above, np.float64), np.asarray(below, np.float64)

    def statistic(at: Indices) -> Array:
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(a[at].sum(axis=-1) / b[at].sum(axis=-1))

    return interval(statistic, strata)


# ---- in pairs --------------------------------------------------------------------------------------------------


def compare(
    ours: ArrayLike, theirs: ArrayLike, strata: Sequence[Hashable], *, lower_is_better: bool,
    for_rank: tuple[ArrayLike, ArrayLike] | None = None,
) -> Comparison:  # fmt: skip
    """Compare two agents on the same n episodes; both are resampled together.

    Parameters
    ----------
    ours, theirs
        Values ``(n,)``, the same episode at the same place.
    strata
        Each episode's stratum ``(n,)``. Each counts the same: the difference is the mean over the strata, the
        ratio the geometric mean of those that are not 0 / 0, the probability their mean.
    lower_is_better
        Which way an improvement goes.
    for_rank
        Values of ours and theirs that decide who did better instead: infinite ones may be among them.

    Notes
    -----
    The probability of improvement takes every episode (a room under its noise) for a task with one run each, as
    Agarwal et al. do with runs: P = mean of [ours better] + ½ [equal].
    """
    a, b = np.asarray(ours, np.float64), np.asarray(theirs, np.float64)
    rank_a, rank_b = (a, b) if for_rank is None else (np.asarray(v, np.float64) for v in for_rank)
    better = (rank_a < rank_b) if lower_is_better else (rank_a > rank_b)
    won = better + 0.5 * (rank_a == rank_b)
    if not len(a):
        return Comparison(NONE, NONE, NONE, 0)
    names = list(dict.fromkeys(strata))
    # A resample keeps each stratum's episodes at that stratum's places.
    places = [np.array([k for k, s in enumerate(strata) if s == name], np.intp) for name in names]
    found = []
    for at in (np.arange(len(a))[None], resampled_indices(strata)):
        ours_at, theirs_at = (np.stack([iqm(v[at[:, p]]) for p in places]) for v in (a, b))  # (strata, resamples)
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.log(ours_at / theirs_at)
            defined = ~np.isnan(logs)  # not 0 / 0
            ratio = np.exp(np.sum(logs, axis=0, where=defined) / defined.sum(axis=0))
        probability = np.mean([won[at[:, p]].mean(axis=-1) for p in places], axis=0)
        found.append(((ours_at - theirs_at).mean(axis=0), ratio, probability))
    (difference, ratio, probability), resampled = found
    return Comparison(
        difference=_limits(float(difference[0]), resampled[0], strata),
        ratio=_limits(float(ratio[0]), resampled[1], strata),
        probability=_limits(float(probability[0]), resampled[2], strata),
        n=len(a),
    )


def _limits(value: float, resampled: Array, strata: Sequence[Hashable]) -> Interval:
    if min(Counter(strata).values()) < 2:  # one episode of a place cannot tell how much others would differ
        return Interval(value, np.nan, np.nan)
    tail = 0.5 * (1.0 - CONFIDENCE)
    low, high = np.quantile(resampled, (tail, 1.0 - tail), method="inverted_cdf").tolist()
    return Interval(value, low, high)
