"""A benchmark's tables: as JSON, as CSV, and as text for the terminal."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from slam.formats import atomic_write
from training.benchmark.figures import METRICS, Figure, Group, Metric, comparisons, figures, merged
from training.benchmark.suites import SLIPPERY
from training.figures.statistics import Comparison, Interval
from training.runs.running import plain

__all__ = ["FILES", "Entry", "Report", "as_json", "shown", "table", "write_tables"]

FILES = (
    "results.sqlite",
    "config.toml",
    "episodes.csv",
    "summary.csv",
    "comparison.csv",
    "summary.json",
    "tables.md",
)
"""What a benchmark writes, beside settings.json and, if asked for, report.html."""

_BY_KEY = {metric.key: metric for metric in METRICS}
_WHO_COLUMNS = ("suite", "agent", "slam")
_KEY_COLUMNS = ("suite", "place", "seed", "agent", "slam")
# What a terminal has room for: metric, heading, whether with its interval.
_COLUMNS = (
    ("reached_95", "95 %", False), ("time_to_95_s", "time to 95 % [s]", True),
    ("path_length_m", "path [m]", False), ("collisions_per_100_m", "coll/100 m", False),
    ("map_iou", "IoU", False), ("corner_mean_m", "corner [cm]", False), ("ate_rmse_m", "ATE [cm]", True),
    ("anees", "NEES/3", False), ("decision_ms_median", "decide [ms]", False),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Entry:
    """One agent on one backend in one suite."""

    group: Group
    name: str  # the agent, with its backend where there are several
    figures: dict[str, Figure]  # of METRICS
    against: dict[str, Comparison]  # of COMPARED, with the baseline on the same backend; empty where there is none


@dataclass(frozen=True, eq=False)
class Report:
    """All that a benchmark has to tell."""

    entries: tuple[Entry, ...]
    overall: dict[str, dict[str, dict[str, Comparison]]]  # all suites of a noise together → name → of COMPARED
    baseline: str | None
    config: dict[str, Any]

    @classmethod
    def of(cls, groups: Sequence[Group], *, baseline: str | None, config: dict[str, Any]) -> Report:
        """Work out every table of the groups."""
        several = len({group.slam for group in groups}) > 1
        entries = []
        for group, base in _with_baseline(groups, baseline):
            entries.append(Entry(
                group,
                f"{group.agent}@{group.slam}" if several else group.agent,
                figures(group),
                comparisons(group, base) if base is not None and base is not group else {},
            ))  # fmt: skip
        overall: dict[str, dict[str, dict[str, Comparison]]] = {}
        names = {(entry.group.agent, entry.group.slam): entry.name for entry in entries}
        for group, base in _with_baseline(_all_suites(groups), baseline):
            if base is not None and base is not group:
                found = overall.setdefault(group.suite, {})
                found[names[group.agent, group.slam]] = comparisons(group, base)
        return cls(tuple(entries), overall, baseline, config)

    def suites(self) -> dict[str, list[Entry]]:
        """Return the entries by suite."""
        found: dict[str, list[Entry]] = {}
        for entry in self.entries:
            found.setdefault(entry.group.suite, []).append(entry)
        return found


def _with_baseline(groups: Sequence[Group], baseline: str | None) -> list[tuple[Group, Group | None]]:
    bases = {(g.suite, g.slam): g for g in groups if g.agent == baseline}
    return [(group, bases.get((group.suite, group.slam))) for group in groups]


def _all_suites(groups: Sequence[Group]) -> list[Group]:
    """Return each agent's episodes of all nominal suites as one group, and of all slippery ones."""
    found = []
    for name, slippery in (("all-nominal", False), ("all-slippery", True)):
        parts = [group for group in groups if group.suite.endswith(SLIPPERY) == slippery]
        suites = {group.suite for group in parts}
        for who in dict.fromkeys((group.agent, group.slam) for group in parts):
            own = [group for group in parts if (group.agent, group.slam) == who]
            if len(own) == len(suites) > 1:
                found.append(merged(own, suite=name))
    return found


def shown(metric: Metric, value: float) -> str:
    """Return a value of a metric in the unit shown."""
    if math.isnan(value):
        return "–"
    return "∞" if math.isinf(value) else f"{metric.scale * value:.{metric.digits}f}"


# ---- JSON and CSV ----------------------------------------------------------------------------------------------


def as_json(report: Report) -> dict[str, Any]:
    """Return suite → agent → metric → figures, and ``comparison``, ``ends``, ``consistency``, ``config`` beside.

    ``comparison`` also has all nominal and all slippery suites together, each place counting the same.

    ``low`` and ``high`` are the limits of ``value``, the figure in the tables: the IQM, but the mean for shares
    and the ratio of two sums for collisions a way. null is what is not defined, or infinite: never reached.
    """
    out: dict[str, Any] = {}
    against: dict[str, Any] = {}
    ends: dict[str, Any] = {}
    consistency: dict[str, Any] = {}
    for suite, entries in report.suites().items():
        out[suite] = {e.name: {key: _figure(_BY_KEY[key], f) for key, f in e.figures.items()} for e in entries}
        ends[suite] = {e.name: e.group.ends() for e in entries}
        consistency[suite] = {e.name: _plain(e.group.consistency()) for e in entries}
        found = {e.name: {key: _compared(c) for key, c in e.against.items()} for e in entries if e.against}
        if found:
            against[suite] = found
    for suite, by_name in report.overall.items():
        against[suite] = {name: {key: _compared(c) for key, c in found.items()} for name, found in by_name.items()}
    return out | {
        "comparison": against, "ends": ends, "consistency": consistency, "config": report.config,
    }  # fmt: skip


def write_tables(out: Path, report: Report) -> None:
    """Write ``episodes.csv``, ``summary.csv``, ``comparison.csv`` and ``summary.json``."""
    atomic_write(out / "episodes.csv", _csv(_episodes(report), _KEY_COLUMNS))
    atomic_write(out / "summary.csv", _csv(_summary(report), _WHO_COLUMNS))
    atomic_write(out / "comparison.csv", _csv(_comparison(report), _WHO_COLUMNS))
    text = json.dumps(as_json(report), indent=1, ensure_ascii=False, allow_nan=False)
    atomic_write(out / "summary.json", text + "\n")


def _figure(metric: Metric, figure: Figure) -> dict[str, Any]:
    a = figure.averages
    values = {
        "value": figure.centre.value, "low": figure.centre.low, "high": figure.centre.high, "iqm": a.iqm.value,
        "median": a.median.value, "median_low": a.median.low, "median_high": a.median.high, "mean": a.mean.value,
    }  # fmt: skip
    return _plain(values) | {"n": a.n, "value_is": metric.centre}


def _compared(c: Comparison) -> dict[str, Any]:
    parts = {"difference": c.difference, "ratio": c.ratio, "probability_of_improvement": c.probability}
    return {name: _interval(part) for name, part in parts.items()} | {"n": c.n}


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    return {key: plain(value) for key, value in values.items()}


def _interval(found: Interval) -> dict[str, Any]:
    return _plain({"value": found.value, "low": found.low, "high": found.high})


def _episodes(report: Report) -> list[dict[str, Any]]:
    rows = []
    for entry in report.entries:
        for (suite, place, seed, agent, slam), row in zip(entry.group.keys, entry.group.rows, strict=True):
            who = {"suite": suite, "place": place, "seed": seed, "agent": agent, "slam": slam}
            rows.append(who | row.metrics)
    return rows


def _who(entry: Entry) -> dict[str, Any]:
    return {"suite": entry.group.suite, "agent": entry.group.agent, "slam": entry.group.slam}


def _summary(report: Report) -> list[dict[str, Any]]:
    return [
        _who(entry) | {"metric": key} | _figure(_BY_KEY[key], figure)
        for entry in report.entries
        for key, figure in entry.figures.items()
    ]


def _comparison(report: Report) -> list[dict[str, Any]]:
    every = [(_who(entry), entry.against) for entry in report.entries]
    for suite, by_name in report.overall.items():
        for name, found in by_name.items():
            agent, _, slam = name.partition("@")
            slam = slam or report.entries[0].group.slam
            every.append(({"suite": suite, "agent": agent, "slam": slam}, found))
    rows = []
    for who, against in every:
        for key, c in against.items():
            row: dict[str, Any] = who | {"baseline": report.baseline, "metric": key, "n": c.n}
            parts = {"difference": c.difference, "ratio": c.ratio, "probability": c.probability}
            for name, part in parts.items():
                limits = _interval(part)
                row |= {name: limits["value"], f"{name}_low": limits["low"], f"{name}_high": limits["high"]}
            rows.append(row)
    return rows


def _csv(rows: Sequence[dict[str, Any]], first: Sequence[str]) -> str:
    """Return rows as CSV with the first columns and every other that a row has; empty where there is no value."""
    file = io.StringIO()
    columns = dict.fromkeys((*first, *(name for row in rows for name in row)))
    writer = csv.DictWriter(file, list(columns), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return file.getvalue()


# ---- the terminal ----------------------------------------------------------------------------------------------


def table(report: Report) -> str:
    """Return the main figures of every suite as text."""
    lines: list[str] = []
    for suite, entries in report.suites().items():
        lines += ["", *_suite_table(suite, entries)] if lines else _suite_table(suite, entries)
        lines += _against_lines(entries, report.baseline)
    lines.append("IQM [95 % interval]; 95 %: share of episodes that got there; where never, the step limit counts")
    return "\n".join(lines)


def _suite_table(suite: str, entries: Sequence[Entry]) -> list[str]:
    cells = [[f"{suite}", *(heading for _, heading, _ in _COLUMNS)]]
    for entry in entries:
        row = [entry.name]
        for key, _, with_limits in _COLUMNS:
            metric, centre = _BY_KEY[key], entry.figures[key].centre
            text = shown(metric, centre.value) + (" %" if metric.unit.startswith("%") else "")
            if with_limits and not math.isnan(centre.low):
                text += f" [{shown(metric, centre.low)}, {shown(metric, centre.high)}]"
            row.append(text)
        cells.append(row)
    widths = [max(len(row[k]) for row in cells) for k in range(len(cells[0]))]
    return [
        "  ".join([row[0].ljust(widths[0]), *(t.rjust(w) for t, w in zip(row[1:], widths[1:], strict=True))])
        for row in cells
    ]


def _against_lines(entries: Sequence[Entry], baseline: str | None) -> list[str]:
    lines = []
    for entry in entries:
        if not entry.against:
            continue
        c = entry.against["time_to_95_s"]
        text = f"  {entry.name}: time to 95 % {100 * (c.ratio.value - 1):+.1f} %"
        if not math.isnan(c.ratio.low):
            text += f" [{100 * (c.ratio.low - 1):+.1f} %, {100 * (c.ratio.high - 1):+.1f} %]"
        text += f" against {baseline}, faster in {100 * c.probability.value:.0f} % of {c.n} episodes"
        lines.append(text)
    return lines
