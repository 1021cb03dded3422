"""Robust averages with bootstrap intervals, and comparisons in pairs.

Interquartile means, stratified bootstrap and probability of improvement as in Agarwal et al., "Deep reinforcement
learning at the edge of the statistical precipice", NeurIPS 2021; ``docs/how-to/benchmark.md`` says what for.
Everything is drawn from fixed seeds: the same values give the same intervals.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam.types import Array
from training.runs.running import plain

__all__ = [
    "CONFIDENCE", "NONE", "RESAMPLES", "Comparison", "Estimate", "Interval", "compare", "estimate", "interval",
    "iqm", "mean_interval", "median", "ratio_of_sums", "resampled_indices", "share_interval",
]  # fmt: skip

Indices = NDArray[np.intp]

CONFIDENCE = 0.95
RESAMPLES = 2000
_TAIL = 0.5 * (1.0 - CONFIDENCE)  # beyond either limit
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


def share_interval(values: ArrayLike, strata: Sequence[Hashable]) -> Interval:
    """Return the mean of values ``(n,)`` in [0, 1], such as whether a level was reached, with its interval.

    That of :func:`_share`: resamples of episodes that all agree say nothing of how sure that is.
    """
    v = np.asarray(values, np.float64)
    return _share(float(v.mean()), len(v), strata) if len(v) else NONE


def _share(share: float, n: float, strata: Sequence[Hashable]) -> Interval:
    """Return a share of n episodes with its score interval (Wilson, "Probable inference", JASA 1927).

    Of values between 0 and 1, or of strata that differ, it is somewhat too wide: they scatter less.
    """
    if _has_lone(strata):
        return Interval(share, np.nan, np.nan)
    z2 = NormalDist().inv_cdf(1.0 - _TAIL) ** 2
    middle = share + z2 / (2 * n)
    half = math.sqrt(z2 * (share * (1.0 - share) / n + z2 / (4 * n * n)))
    low, high = ((middle + side) / (1.0 + z2 / n) for side in (-half, half))
    return Interval(share, max(low, 0.0), min(high, 1.0))


def ratio_of_sums(counts: ArrayLike, ways: ArrayLike, strata: Sequence[Hashable], *, per: float = 1.0) -> Interval:
    """Return Σ counts / Σ ways of episodes ``(n,)``, such as contacts over way driven, times ``per``.

    Where nothing was counted, the upper limit is that of a Poisson process: the rate at which nothing comes in
    2.5 % of all cases.
    """
    counted, way = np.asarray(counts, np.float64), np.asarray(ways, np.float64)
    if not counted.any() and way.sum() > 0.0 and not _has_lone(strata):
        return Interval(0.0, 0.0, per * -math.log(_TAIL) / float(way.sum()))

    def statistic(at: Indices) -> Array:
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(per * counted[at].sum(axis=-1) / way[at].sum(axis=-1))

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
    Agarwal et al. do with runs: P = mean of [ours better] + ½ [equal]. Its interval is that of a share.
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
        found.append(((ours_at - theirs_at).mean(axis=0), ratio))
    (difference, ratio), resampled = found
    # The mean of the strata's shares is as sure as the share of so many episodes: all of them, in strata alike.
    n = len(places) ** 2 / sum(1.0 / len(p) for p in places)
    return Comparison(
        difference=_limits(float(difference[0]), resampled[0], strata),
        ratio=_limits(float(ratio[0]), resampled[1], strata),
        probability=_share(float(np.mean([won[p].mean() for p in places])), n, strata),
        n=len(a),
    )


def _limits(value: float, resampled: Array, strata: Sequence[Hashable]) -> Interval:
    if _has_lone(strata):
        return Interval(value, np.nan, np.nan)
    low, high = np.quantile(resampled, (_TAIL, 1.0 - _TAIL), method="inverted_cdf").tolist()
    return Interval(value, low, high)


def _has_lone(strata: Sequence[Hashable]) -> bool:
    """Whether a place has but one episode, which cannot tell how much others would differ."""
    return min(Counter(strata).values()) < 2
