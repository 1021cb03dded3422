"""What a benchmark's rows amount to: metrics of each agent on each suite, and agents against a baseline."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from slam.types import Array
from training.benchmark.episode import EpisodeRow, Key
from training.figures.consistency import consistency_figures
from training.figures.statistics import (
    Comparison,
    Estimate,
    Interval,
    compare,
    estimate,
    ratio_of_sums,
    share_interval,
)

__all__ = [
    "COMPARED", "METRICS", "REGRETS", "Figure", "Group", "Metric", "comparisons", "figures", "group_rows",
    "merged", "with_regrets",
]  # fmt: skip

Row = dict[str, Any]  # an episode's metrics


@dataclass(frozen=True, kw_only=True)
class Metric:
    """One column of the tables."""

    key: str
    label: str
    unit: str = ""
    scale: float = 1.0  # from what is stored to the unit shown
    digits: int = 2  # after the point, as shown
    better: Literal["low", "high", ""] = "low"
    # What stands in the tables, with its interval: the IQM, the mean (of shares, too) or the ratio of two sums.
    centre: Literal["iqm", "mean", "ratio"] = "iqm"
    share: bool = False  # of the episodes: each is 0 or 1
    # Never reached: counted as the episode's time limit in IQM and mean, as infinite in median and ranks.
    may_be_missed: bool = False
    of: Callable[[Row], float | bool | None] | None = None  # None: the stored value of that key

    def value(self, row: Row) -> float:
        """Return an episode's value; nan where it has none."""
        found = row.get(self.key) if self.of is None else self.of(row)
        return math.nan if found is None else float(found)


METRICS: tuple[Metric, ...] = (
    Metric(key="coverage", label="coverage", unit="%", scale=100, better="high"),
    Metric(
        key="reached_95", label="reached 95 %", unit="%", scale=100, digits=0, better="high",
        centre="mean", share=True, of=lambda row: row["time_to_95_s"] is not None,
    ),
    *(
        Metric(key=f"time_to_{share}_s", label=f"time to {share} %", unit="s", digits=1, may_be_missed=True)
        for share in (50, 90, 95, 99)
    ),
    *(
        Metric(key=f"regret_{share}", label=f"regret to {share} %", unit="%", scale=100, digits=0)
        for share in (95, 99)
    ),
    Metric(key="time_s", label="time", unit="s", digits=1),
    Metric(key="path_length_m", label="path", unit="m", digits=1),
    Metric(
        key="collisions_per_100_m", label="collisions", unit="/100 m", centre="ratio",
        of=lambda row: 100 * row["collisions"] / row["path_length_m"] if row["path_length_m"] else None,
    ),
    Metric(
        key="collided", label="episodes with collision", unit="%", scale=100, digits=0, centre="mean", share=True,
        of=lambda row: row["collisions"] > 0,
    ),
    Metric(key="map_iou", label="wall IoU", digits=3, better="high"),
    Metric(key="corner_mean_m", label="corner error", unit="cm", scale=100),
    Metric(key="ate_rmse_m", label="ATE", unit="cm", scale=100),
    Metric(key="ate_aligned_rmse_m", label="ATE, aligned", unit="cm", scale=100),
    Metric(key="final_position_error_m", label="final position error", unit="cm", scale=100),
    Metric(key="final_heading_error_rad", label="heading error", unit="°", scale=180 / math.pi, digits=3),
    # χ² is skewed, so that the IQM of a true belief is below 1; and it would leave out the beliefs that go wrong.
    Metric(key="anees", label="NEES / 3", better="", centre="mean"),
    Metric(key="decision_ms_median", label="decision", unit="ms", digits=1),
    Metric(key="decision_ms_p95", label="decision, 95th percentile", unit="ms", digits=1),
)  # fmt: skip
"""Every metric that is reported, in the order of the tables."""

REGRETS = {"regret_95": ("time_to_95_s", "known-map"), "regret_99": ("time_to_99_s", "known-map-99")}
"""Metric → the time that it is of, and whose must be there for there to be a bound."""

COMPARED = tuple(m for m in METRICS if m.centre == "iqm" and m.better and m.key not in REGRETS)
"""The metrics that an agent is compared with the baseline in."""


@dataclass(frozen=True, kw_only=True)
class Group:
    """The episodes of one agent on one backend in one suite, by place and seed; of so many robots."""

    suite: str
    agent: str
    slam: str
    keys: tuple[Key, ...]
    rows: tuple[EpisodeRow, ...]
    robots: int = 1
    communication: str = ""  # of a team

    @property
    def who(self) -> tuple[str, str, int, str]:
        """What tells it from the suite's other groups."""
        return self.agent, self.slam, self.robots, self.communication

    @property
    def strata(self) -> tuple[str, ...]:
        """The place of every episode."""
        return tuple(key[1] for key in self.keys)

    def ends(self) -> dict[str, int]:
        """Return how many episodes ended how, the commonest first."""
        return dict(Counter(str(row.metrics["end"]) for row in self.rows).most_common())

    def consistency(self) -> dict[str, Any]:
        """Return ``nees_over_3_mean``, ``nees_band_95`` and ``fraction_in_band`` over all episodes' seconds."""
        return consistency_figures([own for row in self.rows for own in row.nees.reshape(self.robots, -1)])

    def values(self, metric: Metric) -> Array:
        """Return every episode's value ``(n,)``, nan where it has none."""
        values = np.array([metric.value(row.metrics) for row in self.rows], np.float64)
        if metric.key == "anees":  # JSON has no infinity: it is what a mean of defined values lacks
            values[np.isnan(values) & [not np.isnan(row.nees).all() for row in self.rows]] = np.inf
        return values


@dataclass(frozen=True)
class Figure:
    """A metric of a group: what stands in the tables, and the averages of the episodes that have a value."""

    centre: Interval
    averages: Estimate


def group_rows(rows: Sequence[tuple[Key, EpisodeRow]]) -> list[Group]:
    """Return the groups of rows, in the order in which their first rows come."""
    members: dict[tuple[Any, ...], list[tuple[Key, EpisodeRow]]] = {}
    for key, row in rows:
        members.setdefault((key[0], *key[3:]), []).append((key, row))
    groups = []
    for (suite, agent, slam, *team), found in members.items():
        robots, communication = team or (1, "")
        groups.append(Group(
            suite=suite, agent=agent, slam=slam, keys=tuple(k for k, _ in found), rows=tuple(r for _, r in found),
            robots=robots, communication=communication,
        ))  # fmt: skip
    return groups


def with_regrets(groups: Sequence[Group]) -> list[Group]:
    """Return the groups with the metrics of :data:`REGRETS` in every episode whose bound is there.

    The bound is the least time in the same room under the same seed, on the same backend: that of the planner that
    knows the map or, where an agent was sooner, that agent's. A time that was never reached counts as the limit;
    in a median its regret is infinite, as the time is.
    """
    times: dict[str, dict[tuple[Any, ...], float]] = {name: {} for name in REGRETS}
    known: set[tuple[Any, ...]] = set()
    for group in groups:
        for key, row in zip(group.keys, group.rows, strict=True):
            room = (*key[:3], *group.who[1:])
            for name, (time, planner) in REGRETS.items():
                if (found := row.metrics.get(time)) is not None:
                    times[name][room] = min(found, times[name].get(room, math.inf))
                    known |= {(name, *room)} if group.agent == planner else set()

    def regrets(group: Group, key: Key, row: EpisodeRow) -> Row:
        room, metrics = (*key[:3], *group.who[1:]), row.metrics
        taken = {name: metrics[time] or metrics["limit_s"] for name, (time, _) in REGRETS.items()}
        return {
            name: float(taken[name] / times[name][room] - 1.0)
            for name in REGRETS
            if (name, *room) in known and times[name][room] > 0.0
        }

    return [
        replace(group, rows=tuple(
            replace(row, metrics=row.metrics | regrets(group, key, row))
            for key, row in zip(group.keys, group.rows, strict=True)
        ))
        for group in groups
    ]  # fmt: skip


def merged(groups: Sequence[Group], *, suite: str) -> Group:
    """Return one agent's episodes of several suites as those of one, with each suite's places as its strata."""
    pairs = [(key, row) for group in groups for key, row in zip(group.keys, group.rows, strict=True)]
    keys = [(suite, f"{key[0]}/{key[1]}", *key[2:]) for key, _ in pairs]
    return replace(groups[0], suite=suite, keys=tuple(keys), rows=tuple(row for _, row in pairs))


def figures(group: Group) -> dict[str, Figure]:
    """Return every metric of :data:`METRICS` by its key."""
    return {metric.key: _figure(metric, group) for metric in METRICS}


def comparisons(group: Group, baseline: Group) -> dict[str, Comparison]:
    """Return every metric of :data:`COMPARED` against the baseline's, on the episodes that both have."""
    theirs = {key[:3]: row for key, row in zip(baseline.keys, baseline.rows, strict=True)}
    pairs = [
        (key[1], row.metrics, theirs[key[:3]].metrics)
        for key, row in zip(group.keys, group.rows, strict=True)
        if key[:3] in theirs
    ]
    # The way of one that has not explored is short for that.
    explored = [pair for pair in pairs if None not in (row["time_to_95_s"] for row in pair[1:])]
    return {
        metric.key: _comparison(metric, explored if metric.key == "path_length_m" else pairs)
        for metric in COMPARED
    }


def _figure(metric: Metric, group: Group) -> Figure:
    values, rows = group.values(metric), [row.metrics for row in group.rows]
    strata: Sequence[str] = group.strata
    if metric.may_be_missed:
        averages = estimate(_at_limit(values, rows), strata, for_median=_at_infinity(values))
    else:
        time, _ = REGRETS.get(metric.key, (None, None))
        missed = [time is not None and row[time] is None for row in rows]
        known = np.flatnonzero(~np.isnan(values))
        for_median = np.where(missed, np.inf, values)[known]
        averages = estimate(values[known], [strata[k] for k in known.tolist()], for_median=for_median)
    if metric.centre == "iqm":
        return Figure(averages.iqm, averages)
    if metric.centre == "mean":
        return Figure(share_interval(values, strata) if metric.share else averages.mean, averages)
    # Many short episodes without contact shall not outvote a long one with many.
    contacts, ways = (np.array([row[name] for row in rows], np.float64) for name in _COLLISIONS)
    return Figure(ratio_of_sums(contacts, ways, strata, per=100.0), averages)


_COLLISIONS = ("collisions", "path_length_m")


def _comparison(metric: Metric, pairs: Sequence[tuple[str, Row, Row]]) -> Comparison:
    our_rows, their_rows = [ours for _, ours, _ in pairs], [theirs for _, _, theirs in pairs]
    ours, theirs = (np.array([metric.value(row) for row in rows]) for rows in (our_rows, their_rows))
    lower = metric.better == "low"
    if metric.may_be_missed:
        strata = [place for place, _, _ in pairs]
        ranks = _at_infinity(ours), _at_infinity(theirs)
        ours, theirs = _at_limit(ours, our_rows), _at_limit(theirs, their_rows)
        return compare(ours, theirs, strata, lower_is_better=lower, for_rank=ranks)
    known = np.flatnonzero(np.isfinite(ours) & np.isfinite(theirs))
    strata = [pairs[k][0] for k in known.tolist()]
    return compare(ours[known], theirs[known], strata, lower_is_better=lower)


def _at_limit(values: Array, rows: Sequence[Row]) -> Array:
    limits = np.array([row["limit_s"] for row in rows], np.float64)
    return np.where(np.isnan(values), limits, values)


def _at_infinity(values: Array) -> Array:
    return np.where(np.isnan(values), np.inf, values)
