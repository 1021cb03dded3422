"""What a benchmark has to tell: as JSON, as CSV, as text for the terminal, in Markdown."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from slam.formats import atomic_write
from training.benchmark import tables
from training.benchmark.figures import Figure, Group, comparisons, figures, merged
from training.benchmark.suites import SLIPPERY
from training.benchmark.team_figures import Scaling, scaling_of, scaling_table, scalings_as_json
from training.figures.statistics import Comparison, Interval
from training.figures.tables import csv_table
from training.runs.running import plain

__all__ = [
    "FILES", "KEY_COLUMNS", "TEAM_COLUMNS", "Entry", "Report", "as_json", "centres", "markdown", "table",
    "write_tables",
]  # fmt: skip

FILES = (
    "results.sqlite",
    "config.toml",
    "episodes.csv",
    "summary.csv",
    "comparison.csv",
    "summary.json",
    "tables.md",
)
"""What a benchmark writes, beside settings.json and, if asked for, report.html and episodes.parquet."""

_WHO_COLUMNS = ("suite", "agent", "slam")
KEY_COLUMNS = ("suite", "place", "seed", "agent", "slam")
TEAM_COLUMNS = ("robots", "communication")  # behind those, where there are teams
# What a terminal has room for.
_COLUMNS = (
    "reached_95", "time_to_95_s", "regret_95", "path_length_m", "collisions_per_100_m", "map_iou", "corner_mean_m",
    "ate_rmse_m", "anees", "decision_ms_median",
)  # fmt: skip
_WITH_LIMITS = ("time_to_95_s", "ate_rmse_m")


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
        names = _names(groups)
        entries = []
        for group, base in _with_baseline(groups, baseline):
            entries.append(Entry(
                group,
                names[group.who],
                figures(group),
                comparisons(group, base) if base is not None and base is not group else {},
            ))  # fmt: skip
        overall: dict[str, dict[str, dict[str, Comparison]]] = {}
        for group, base in _with_baseline(_all_suites(groups), baseline):
            if base is not None and base is not group:
                found = overall.setdefault(group.suite, {})
                found[names[group.who]] = comparisons(group, base)
        return cls(tuple(entries), overall, baseline, config)

    @property
    def has_teams(self) -> bool:
        """Whether any of the episodes had several robots."""
        return any(entry.group.robots > 1 for entry in self.entries)

    def scalings(self, suite: str) -> list[Scaling]:
        """Return a suite's figures by the number of robots; none where no episode had several."""
        return scaling_of([entry.group for entry in self.entries], suite=suite) if self.has_teams else []

    def suites(self) -> dict[str, list[Entry]]:
        """Return the entries by suite."""
        found: dict[str, list[Entry]] = {}
        for entry in self.entries:
            found.setdefault(entry.group.suite, []).append(entry)
        return found


def _names(groups: Sequence[Group]) -> dict[tuple[str, str, int, str], str]:
    """Return what each group is called: by its agent, and by what else there are several of."""
    several = len({group.slam for group in groups}) > 1
    said = len({group.communication for group in groups if group.communication}) > 1
    return {
        group.who: (f"{group.agent}@{group.slam}" if several else group.agent)
        + (f" ×{group.robots}" if group.robots > 1 else "")
        + (f" {group.communication}" if said and group.communication else "")
        for group in groups
    }


def _with_baseline(groups: Sequence[Group], baseline: str | None) -> list[tuple[Group, Group | None]]:
    bases = {(g.suite, *g.who[1:]): g for g in groups if g.agent == baseline}
    return [(group, bases.get((group.suite, *group.who[1:]))) for group in groups]


def _all_suites(groups: Sequence[Group]) -> list[Group]:
    """Return each agent's episodes of all nominal suites as one group, and of all slippery ones."""
    found = []
    for name, slippery in (("all-nominal", False), ("all-slippery", True)):
        parts = [group for group in groups if group.suite.endswith(SLIPPERY) == slippery]
        suites = {group.suite for group in parts}
        for who in dict.fromkeys(group.who for group in parts):
            own = [group for group in parts if group.who == who]
            if len(own) == len(suites) > 1:
                found.append(merged(own, suite=name))
    return found


# ---- JSON and CSV ----------------------------------------------------------------------------------------------


def as_json(report: Report) -> dict[str, Any]:
    """Return suite → agent → metric → figures, and ``comparison``, ``ends``, ``consistency``, ``config`` beside.

    ``comparison`` also has all nominal and all slippery suites together, each place counting the same.

    ``teams`` has, where there are some, the figures by the number of robots.

    ``low`` and ``high`` are the limits of ``value``, the figure in the tables: the IQM, but the mean for shares
    and the NEES, and the ratio of two sums for collisions a way. null is what is not defined, or infinite.
    """
    out: dict[str, Any] = {}
    against: dict[str, Any] = {}
    ends: dict[str, Any] = {}
    consistency: dict[str, Any] = {}
    for suite, entries in report.suites().items():
        out[suite] = {e.name: _figures(e) for e in entries}
        ends[suite] = {e.name: e.group.ends() for e in entries}
        consistency[suite] = {e.name: _plain(e.group.consistency()) for e in entries}
        found = {e.name: _compared(e.against) for e in entries if e.against}
        if found:
            against[suite] = found
    for suite, by_name in report.overall.items():
        against[suite] = {name: _compared(found) for name, found in by_name.items()}
    teams = {suite: scalings_as_json(report.scalings(suite)) for suite in report.suites()}
    return out | {
        "comparison": against, "ends": ends, "consistency": consistency, "config": report.config,
        **({"teams": teams} if report.has_teams else {}),
    }  # fmt: skip


def write_tables(out: Path, report: Report) -> None:
    """Write ``episodes.csv``, ``summary.csv``, ``comparison.csv`` and ``summary.json``."""
    found = as_json(report)
    teams = TEAM_COLUMNS if report.has_teams else ()
    episodes = [
        dict(zip(KEY_COLUMNS, key, strict=False)) | _team(entry.group, teams) | row.metrics
        for entry in report.entries
        for key, row in zip(entry.group.keys, entry.group.rows, strict=True)
    ]
    summary = [
        {"suite": e.group.suite} | _who(e.group, teams) | {"metric": key} | figure
        for e in report.entries
        for key, figure in _figures(e).items()
    ]
    atomic_write(out / "episodes.csv", csv_table(episodes, (*KEY_COLUMNS, *teams)))
    atomic_write(out / "summary.csv", csv_table(summary, (*_WHO_COLUMNS, *teams)))
    compared = _comparison(report, found["comparison"], teams)
    atomic_write(out / "comparison.csv", csv_table(compared, (*_WHO_COLUMNS, *teams)))
    text = json.dumps(found, indent=1, ensure_ascii=False, allow_nan=False)
    atomic_write(out / "summary.json", text + "\n")


def _team(group: Group, columns: Sequence[str]) -> dict[str, Any]:
    return {name: getattr(group, name) for name in columns}


def _who(group: Group, teams: Sequence[str]) -> dict[str, Any]:
    return {"agent": group.agent, "slam": group.slam} | _team(group, teams)


def _figures(entry: Entry) -> dict[str, dict[str, Any]]:
    out = {}
    for key, figure in entry.figures.items():
        a = figure.averages
        values = figure.centre.as_json() | _plain({
            "iqm": a.iqm.value, "median": a.median.value, "median_low": a.median.low,
            "median_high": a.median.high, "mean": a.mean.value,
        })  # fmt: skip
        out[key] = values | {"n": a.n, "value_is": tables.BY_KEY[key].centre}
    return out


def _compared(against: Mapping[str, Comparison]) -> dict[str, dict[str, Any]]:
    return {
        key: {
            "difference": c.difference.as_json(), "ratio": c.ratio.as_json(),
            "probability_of_improvement": c.probability.as_json(), "n": c.n,
        }
        for key, c in against.items()
    }  # fmt: skip


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    return {key: plain(value) for key, value in values.items()}


def _comparison(report: Report, found: dict[str, Any], teams: Sequence[str]) -> list[dict[str, Any]]:
    """Return the rows of ``comparison.csv``: of each suite, agent and metric."""
    rows, groups = [], {entry.name: entry.group for entry in report.entries}
    for suite, by_name in found.items():
        for name, against in by_name.items():
            who = {"suite": suite} | _who(groups[name], teams)
            for key, c in against.items():
                row: dict[str, Any] = who | {"baseline": report.baseline, "metric": key, "n": c["n"]}
                for part in ("difference", "ratio", "probability_of_improvement"):
                    column = part.partition("_")[0]
                    low, high = c[part]["low"], c[part]["high"]
                    row |= {column: c[part]["value"], f"{column}_low": low, f"{column}_high": high}
                rows.append(row)
    return rows


# ---- the terminal ----------------------------------------------------------------------------------------------


def table(report: Report) -> str:
    """Return the main figures of every suite as text."""
    parts = []
    for suite, entries in report.suites().items():
        parts += [suite, tables.text(tables.figures_table(centres(entries), _COLUMNS, limits=_WITH_LIMITS)), ""]
        against = {entry.name: entry.against for entry in entries if entry.against}
        if against:
            parts += [tables.text(tables.against_table(against, report.baseline)), ""]
        if scalings := report.scalings(suite):
            parts += [tables.text(scaling_table(scalings)), ""]
    parts.append(
        "IQM [95 % interval]; 95 %: share of episodes that got there; where never, the step limit counts; "
        "NEES / 3: the mean"
    )
    return "\n".join(parts)


# ---- Markdown --------------------------------------------------------------------------------------------------


def markdown(report: Report) -> str:
    """Return a section of each suite, and of all suites of a noise together."""
    parts = []
    for name, found in report.overall.items():
        parts += [f"## {name.replace('-', ' ')} suites together\n", _against(found, report.baseline)]
    for suite, entries in report.suites().items():
        episodes = {entry.name: len(entry.group.rows) for entry in entries}
        main = tables.figures_table(centres(entries), tables.HEADLINE, episodes=episodes)
        against = {entry.name: entry.against for entry in entries if entry.against}
        parts += [f"## {suite}\n", tables.markdown(main)]
        parts += [_against(against, report.baseline)] if against else []
        parts += [tables.markdown(scaling_table(scalings))] if (scalings := report.scalings(suite)) else []
    return "\n".join(parts)


def _against(found: Mapping[str, Mapping[str, Comparison]], baseline: str | None) -> str:
    return tables.markdown(tables.against_table(found, baseline))


def centres(entries: Sequence[Entry]) -> dict[str, dict[str, Interval]]:
    """Return what stands in the tables of a suite: name → metric → figure."""
    return {e.name: {key: figure.centre for key, figure in e.figures.items()} for e in entries}
