"""A benchmark's main tables in Markdown, as a leaderboard shows them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

from training.benchmark.figures import METRICS, Metric
from training.benchmark.output import Entry, Report, shown
from training.figures.statistics import Comparison, Interval

__all__ = ["AGAINST", "HEADLINE", "markdown"]

HEADLINE = (
    "reached_95", "coverage", "time_to_95_s", "path_length_m", "collisions_per_100_m", "map_iou", "corner_mean_m",
    "ate_rmse_m", "final_heading_error_rad", "anees", "decision_ms_median",
)  # fmt: skip
"""The metrics of the main table."""

AGAINST = ("time_to_90_s", "time_to_95_s", "path_length_m", "ate_rmse_m", "corner_mean_m", "map_iou")
"""The metrics of the table against the baseline."""

_BY_KEY = {metric.key: metric for metric in METRICS}


def markdown(report: Report) -> str:
    """Return a section of each suite, and of all suites of a noise together."""
    parts = []
    for name, found in report.overall.items():
        parts += [f"## {name.replace('-', ' ')} suites together", "", *_against(found, report.baseline)]
    for suite, entries in report.suites().items():
        parts += [f"## {suite}", "", *_main(entries)]
        parts += _against({entry.name: entry.against for entry in entries if entry.against}, report.baseline)
    return "\n".join(parts).rstrip() + "\n"


def _main(entries: Sequence[Entry]) -> list[str]:
    metrics = [_BY_KEY[key] for key in HEADLINE]
    head = ["agent", "episodes", *(f"{m.label} [{m.unit}]" if m.unit else m.label for m in metrics)]
    rows = [
        [f"`{e.name}`", str(len(e.group.rows)), *(_value(m, e.figures[m.key].centre) for m in metrics)]
        for e in entries
    ]
    return _table(head, rows)


def _against(found: Mapping[str, Mapping[str, Comparison]], baseline: str | None) -> list[str]:
    if not found:
        return []
    head = [f"against `{baseline}`", *(_BY_KEY[key].label for key in AGAINST), "faster to 95 % in", "episodes"]
    rows = []
    for name, against in found.items():
        time = against["time_to_95_s"]
        faster = f"{100 * time.probability.value:.0f} %" + _limits(time.probability, 100.0, 0.0, "{:.0f}")
        rows.append([f"`{name}`", *(_change(against[key].ratio) for key in AGAINST), faster, str(time.n)])
    return _table(head, rows)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    lines = [" | ".join(row) for row in (head, ["---"] * len(head), *rows)]
    return [*(f"| {line} |" for line in lines), ""]


def _value(metric: Metric, found: Interval) -> str:
    text = shown(metric, found.value)
    return text if math.isnan(found.low) else f"{text} [{shown(metric, found.low)}, {shown(metric, found.high)}]"


def _change(ratio: Interval) -> str:
    if math.isnan(ratio.value):
        return "–"
    return f"{100 * (ratio.value - 1):+.1f} %" + _limits(ratio, 100.0, -100.0, "{:+.1f}")


def _limits(found: Interval, scale: float, offset: float, form: str) -> str:
    if math.isnan(found.low):
        return ""
    low, high = (form.format(scale * limit + offset) for limit in (found.low, found.high))
    return f" [{low}, {high}]"
