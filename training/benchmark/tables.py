"""A benchmark's tables, once: what stands in each cell, and how a page, Markdown and a terminal print it."""

from __future__ import annotations

import math
import re
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from typing import Literal

from slam.files import plain_name
from training.benchmark.figures import METRICS, REGRETS, Metric
from training.benchmark.suites import SLIPPERY
from training.figures.page import name_html
from training.figures.statistics import NONE, Comparison, Interval
from training.figures.tables import markdown_name, markdown_table, text_table
from training.truth.known_map import KNOWN_MAPS

__all__ = [
    "AGAINST", "BY_KEY", "FEWEST", "HEADLINE", "Cell", "Table", "against_table", "change", "figure",
    "figures_table", "html", "markdown", "overview", "ranked", "shown", "text",
]  # fmt: skip

BY_KEY = {metric.key: metric for metric in METRICS}

HEADLINE = (
    "reached_95", "coverage", "time_to_95_s", "regret_95", "path_length_m", "collisions_per_100_m", "map_iou",
    "corner_mean_m", "ate_rmse_m", "final_heading_error_rad", "anees", "decision_ms_median",
)  # fmt: skip
"""The metrics of the main table."""

AGAINST = ("time_to_90_s", "time_to_95_s", "path_length_m", "ate_rmse_m", "corner_mean_m", "map_iou")
"""The metrics of the table against the baseline."""

_TIME = "time_to_95_s"

Intervals = Mapping[str, Interval]  # of each metric, or of each agent


@dataclass(frozen=True)
class Cell:
    """What stands in one place of a table."""

    text: str
    low: str = ""  # limits of its interval; empty: it has none
    high: str = ""
    note: str = ""  # what a page says below
    tone: Literal["", "best", "better", "worse"] = ""  # how a page shows it


@dataclass(frozen=True)
class Table:
    """A row an agent."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, tuple[Cell, ...]], ...]  # an agent's name, and its cells

    @classmethod
    def of_words(cls, head: Sequence[str], rows: Mapping[str, Sequence[str]]) -> Table:
        """Return a table of name → what stands in its cells."""
        return cls(tuple(head), tuple((name, tuple(map(Cell, words))) for name, words in rows.items()))


# ---- cells -----------------------------------------------------------------------------------------------------


def shown(metric: Metric, value: float) -> str:
    """Return a value of a metric in the unit shown."""
    if math.isnan(value):
        return "–"
    return "∞" if math.isinf(value) else f"{metric.scale * value:.{metric.digits}f}"


def figure(metric: Metric, found: Interval, *, limits: bool = True) -> Cell:
    """Return the cell of a figure, with the limits of its interval."""
    if math.isnan(found.low) or not limits:
        return Cell(shown(metric, found.value))
    return Cell(shown(metric, found.value), shown(metric, found.low), shown(metric, found.high))


def change(metric: Metric, ratio: Interval, note: str = "") -> Cell:
    """Return by how much a ratio differs from one, with a tone where its interval excludes that."""
    if math.isnan(ratio.value):
        return Cell("–", note=note)
    value, low, high = (f"{100 * (share - 1):+.1f}" for share in (ratio.value, ratio.low, ratio.high))
    if math.isnan(ratio.low):
        return Cell(f"{value} %", note=note)
    good = (ratio.value < 1.0) == (metric.better == "low")
    return Cell(
        f"{value} %", low, high, note, "" if ratio.low <= 1.0 <= ratio.high else "better" if good else "worse"
    )


def _share(p: Interval) -> Cell:
    value, low, high = (f"{100 * share:.0f}" for share in (p.value, p.low, p.high))
    if math.isnan(p.value):
        return Cell("–")
    return Cell(f"{value} %") if math.isnan(p.low) else Cell(f"{value} %", low, high)


def _heading(metric: Metric) -> str:
    return f"{metric.label} [{metric.unit}]" if metric.unit else metric.label


# ---- tables ----------------------------------------------------------------------------------------------------


def figures_table(
    found: Mapping[str, Intervals], metrics: Sequence[str], *, limits: Container[str] | None = None,
    notes: Mapping[str, Mapping[str, str]] | None = None, episodes: Mapping[str, int] | None = None,
) -> Table:  # fmt: skip
    """Return a table of agents × metrics.

    Parameters
    ----------
    found
        Name → metric → figure; a metric may be missing.
    metrics
        Keys of :data:`METRICS`; of regrets those that there are any of.
    limits
        The metrics that show their intervals; None: all.
    notes
        Name → metric → what a page says below.
    episodes
        Name → how many, in a column of their own.
    """
    shown_metrics = [BY_KEY[key] for key in metrics if key not in REGRETS or _has(key, found)]
    best = {metric.key: _best(metric, found) for metric in shown_metrics}
    rows = []
    for name, figures in found.items():
        cells = [Cell(str(episodes[name]))] if episodes else []
        for metric in shown_metrics:
            key = metric.key
            cell = figure(metric, figures.get(key, NONE), limits=limits is None or key in limits)
            cells.append(_toned(replace(cell, note=notes[name][key] if notes else ""), name, best[key]))
        rows.append((name, tuple(cells)))
    return Table(("agent", *(["episodes"] if episodes else []), *map(_heading, shown_metrics)), tuple(rows))


def _has(key: str, found: Mapping[str, Intervals]) -> bool:
    """Whether any has a value of a metric: there is a bound only where the planner that knows the map was run."""
    return any(not math.isnan(figures.get(key, NONE).value) for figures in found.values())


FEWEST = 10
"""Episodes that a comparison is coloured from: a bootstrap of fewer is too sure."""


def against_table(found: Mapping[str, Mapping[str, Comparison]], baseline: str | None) -> Table:
    """Return a table of name → metric → comparison with the baseline."""
    rows = []
    for name, against in found.items():
        cells = []
        for key in AGAINST:
            share = against[key].probability
            notes = [] if math.isnan(share.value) else [_plain(_share(share))]
            notes += [f"n {against[key].n}"] if against[key].n != against[_TIME].n else []
            cell = change(BY_KEY[key], against[key].ratio, ", ".join(notes))
            cells.append(cell if against[key].n >= FEWEST else replace(cell, tone=""))
        time = against[_TIME]
        rows.append((name, (*cells, _share(time.probability), Cell(str(time.n)))))
    labels = [BY_KEY[key].label for key in AGAINST]
    return Table((f"against {baseline}", *labels, "faster to 95 % in", "episodes"), tuple(rows))


def overview(
    suites: Mapping[str, Mapping[str, Intervals]], versus: Mapping[str, Intervals], baseline: str | None, *,
    limits: bool = True,
) -> list[Table]:  # fmt: skip
    """Return time to 95 % of every agent on every suite, the quickest first: nominal suites, slippery ones.

    ``versus`` has the ratios of that time to the baseline's over all suites of a noise, by agent; without
    ``limits`` the times' intervals are left out.
    """
    metric, tables = BY_KEY[_TIME], []
    for together, slippery in (("all-nominal", False), ("all-slippery", True)):
        columns = [suite for suite in suites if suite.endswith(SLIPPERY) == slippery]
        if not columns:
            continue
        ratios = versus.get(together, {})
        times = {
            name: [suites[suite].get(name, {}).get(_TIME, NONE) for suite in columns]
            for name in sorted({name for suite in columns for name in suites[suite]})
        }
        best = [_best(metric, suites[suite]) for suite in columns]
        rows = []
        for name in sorted(times, key=lambda name: _mean([time.value for time in times[name]])):
            cells = [
                _toned(figure(metric, time, limits=limits), name, least)
                for time, least in zip(times[name], best, strict=True)
            ]
            if ratios:
                cells.append(change(metric, ratios[name]) if name in ratios else Cell(""))
            rows.append((name, tuple(cells)))
        tables.append(Table(("agent", *columns, *([f"against {baseline}"] if ratios else [])), tuple(rows)))
    return tables


def _mean(times: Sequence[float]) -> float:
    mean = sum(times) / len(times)
    return math.inf if math.isnan(mean) else mean


def ranked(found: Mapping[str, Intervals]) -> dict[str, Intervals]:
    """Return agents by their time to 95 %, those that never get there last."""
    return dict(sorted(found.items(), key=lambda item: (_mean([item[1][_TIME].value]), item[0])))


def _best(metric: Metric, found: Mapping[str, Intervals]) -> str | None:
    """Return the agents' best value as shown, None where there is nothing to choose between."""
    values = [figures.get(metric.key, NONE).value for name, figures in found.items() if not _is_bound(name)]
    values = [v for v in values if not math.isnan(v)]
    if not metric.better or min(values, default=0.0) == max(values, default=0.0):
        return None
    return shown(metric, min(values) if metric.better == "low" else max(values))


def _toned(cell: Cell, name: str, best: str | None) -> Cell:
    return replace(cell, tone="best") if cell.text == best and not _is_bound(name) else cell


def _is_bound(name: str) -> bool:
    return name.replace("@", " ").split(" ")[0] in KNOWN_MAPS


# ---- printers --------------------------------------------------------------------------------------------------


def text(table: Table) -> str:
    """Return a table for the terminal."""
    return text_table(table.head, [[name, *map(_plain, cells)] for name, cells in table.rows])


def markdown(table: Table) -> str:
    """Return a table in Markdown."""
    names = [
        f"*{name}* (knows the plan, no agent)" if _is_bound(name) else markdown_name(name)
        for name, _ in table.rows
    ]
    rows = [[name, *map(_plain, cells)] for name, (_, cells) in zip(names, table.rows, strict=True)]
    return markdown_table([_in_words(heading) for heading in table.head], rows) + "\n"


def _in_words(heading: str) -> str:
    """Return a heading, in which a name may stand, so that nothing in it acts in Markdown."""
    return re.sub(r"([\\`<>|])", r"\\\1", plain_name(heading))


def _plain(cell: Cell) -> str:
    return f"{cell.text} [{cell.low}, {cell.high}]" if cell.low else cell.text


def html(table: Table, keys: Mapping[str, str] | None = None) -> str:
    """Return a table that scrolls sideways; ``keys`` are what stands before an agent's name, as HTML."""
    head = "".join(f"<th>{_unbroken(heading)}</th>" for heading in ("", *table.head[1:]))
    rows = [
        f"<tr><th>{keys[name] if keys else ''}{name_html(name)}</th>{''.join(map(_html_cell, cells))}</tr>"
        for name, cells in table.rows
    ]
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'


def _html_cell(cell: Cell) -> str:
    value = f'<span class="{cell.tone}">{escape(cell.text)}</span>' if cell.tone else escape(cell.text)
    limits = f"{cell.low} … {cell.high}" if cell.low else ""
    below = "".join(f"<small>{escape(line)}</small>" for line in (limits, cell.note) if line)
    return f"<td>{value}{below}</td>"


def _unbroken(heading: str) -> str:
    return name_html(heading).replace(" %", "\u00a0%").replace(" [", "<br>[")
