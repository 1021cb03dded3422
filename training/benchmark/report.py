"""A benchmark on one HTML page that needs nothing else: tables, curves, maps with the worst cases first."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from slam.formats import atomic_write
from training.benchmark import tables
from training.benchmark.episode import EpisodeRow, Key
from training.benchmark.output import Entry, Report, centres
from training.benchmark.report_charts import (
    COLOURS,
    Along,
    band,
    coverage_chart,
    extent,
    scaling_charts,
    team_chart,
)
from training.benchmark.team_figures import scaling_table
from training.episodes.explore import ENDINGS
from training.figures.page import html_page, name_html, text_html
from training.figures.statistics import Comparison
from training.truth.known_map import KNOWN_MAPS

__all__ = ["FILE", "TEAMS", "page", "worst_first", "write_report"]

FILE = "report.html"
TEAMS = "teams.png"

_CASES = 6  # maps shown of an agent in a suite
_READING = """<p>Figures are interquartile means over the episodes (the mean of the middle half); shares are means,
and so is NEES / 3, ideally 1; collisions are all contacts over all the way driven. Below each, its 95 % interval.
An episode that never reached a coverage counts with its time limit in means, as infinite in medians.</p>"""

_BOUND = f"""<p><b>{" and ".join(KNOWN_MAPS)}</b> are no agents: they know the true map, and drive the fastest way
that a search found. Regret is what a time is more than the least of all in the same room.</p>"""


def write_report(out: Path, report: Report) -> None:
    """Write ``report.html`` beside the tables, with the ``config.toml`` there is, and of teams ``teams.png``."""
    config = out / "config.toml"
    text = config.read_text("utf-8") if config.exists() else ""
    atomic_write(out / FILE, page(report, config_text=text))
    if report.has_teams:
        scalings = {suite: report.scalings(suite) for suite in report.suites()}
        atomic_write(out / TEAMS, team_chart(scalings))


def page(report: Report, *, config_text: str) -> str:
    """Return the page."""
    suites = report.suites()
    colours = {name: k for k, name in enumerate(dict.fromkeys(entry.name for entry in report.entries))}
    links = "".join(f'<a href="#{_anchor(name)}">{name_html(name)}</a>' for name in suites)
    body = [
        "<h1>Exploration benchmark</h1>",
        f'<p class="soft">{name_html(_described(report), 2000)}</p>',
        f"<nav>{links}<a href='#made'>configuration</a></nav>",
        _READING,
        _BOUND if any(entry.group.agent in KNOWN_MAPS for entry in report.entries) else "",
        _overview(report, suites),
        *(
            _against(found, report.baseline, f"{name.replace('-', ' ')} suites together")
            for name, found in report.overall.items()
        ),
        *(_suite(name, entries, report, colours) for name, entries in suites.items()),
        _made(report.config, config_text),
    ]
    return html_page("Exploration benchmark", "\n".join(body))


# ---- the parts of a suite --------------------------------------------------------------------------------------


def _suite(name: str, entries: Sequence[Entry], report: Report, colours: dict[str, int]) -> str:
    counts = sorted({len(entry.group.rows) for entry in entries})
    episodes = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    backends = ", ".join(dict.fromkeys(entry.group.slam for entry in entries))
    parts = [
        f'<h2 id="{_anchor(name)}">{name_html(name)}</h2>',
        f'<p class="soft">{episodes} episodes an agent, {name_html(backends)}</p>',
        _figures(entries, tables.HEADLINE, colours),
        _against(
            {entry.name: entry.against for entry in entries if entry.against},
            report.baseline,
            "on the same episodes",
        ),
        _teams(report, name),
        _charts(entries, colours),
        "<h3>How the episodes ended</h3>",
        _ends_table(entries),
        "<h3>Is the robot's own uncertainty right?</h3>",
        _consistency_table(entries),
        "<h3>Maps, worst cases first</h3>",
        '<p class="soft">Those that did not reach 95 %, the least covered first; then those with a collision, '
        "then the others, the largest trajectory error first.</p>",
        *(_cases(entry) for entry in entries),
        "<details><summary>All metrics</summary>",
        _figures(entries, list(tables.BY_KEY), colours, medians=True),
        "</details>",
    ]
    return "\n".join(parts)


def _figures(
    entries: Sequence[Entry], metrics: Sequence[str], colours: dict[str, int], *, medians: bool = False
) -> str:
    notes = None
    if medians:
        notes = {
            e.name: {
                key: f"median {tables.shown(tables.BY_KEY[key], f.averages.median.value)}, n {f.averages.n}"
                for key, f in e.figures.items()
            }
            for e in entries
        }
    return tables.html(
        tables.figures_table(centres(entries), metrics, notes=notes),
        {e.name: _key(colours[e.name]) for e in entries},
    )


def _against(found: Mapping[str, Mapping[str, Comparison]], baseline: str | None, where: str) -> str:
    """Return a table of name → metric → comparison, nothing where there is none."""
    if not found:
        return ""
    return (
        f"<h3>{name_html(f'Against {baseline}, {where}')}</h3>"
        '<p class="soft">Change of the interquartile mean, of several plans within each, the plans counting the '
        f"same, with its interval, coloured where that excludes no change and is of at least {tables.FEWEST} "
        "episodes: of fewer it is too sure. Below, in what share of the episodes it did better, ties counted "
        "half, and n, where it is of other episodes than the time: a path is compared where both reached 95 %, an "
        "error where both have one.</p>" + tables.html(tables.against_table(found, baseline))
    )


def _charts(entries: Sequence[Entry], colours: dict[str, int]) -> str:
    groups = [entry.group for entry in entries]
    charts = []
    alongs: tuple[Along, ...] = ("time_s", "path_length_m")
    for along in alongs:
        high = extent(groups, along)
        bands = [band(entry.group, name=entry.name, along=along, high=high) for entry in entries]
        charts.append(coverage_chart(bands, along=along, colours=[colours[entry.name] for entry in entries]))
    legend = "".join(f"<span>{_key(colours[e.name])}{name_html(e.name)}</span>" for e in entries)
    return (
        "<h3>Coverage against time and way</h3>"
        f'<p class="soft">Median, and the middle half of the episodes.</p><nav>{legend}</nav>'
        f'<div class="charts">{"".join(charts)}</div>'
    )


def _teams(report: Report, suite: str) -> str:
    scalings = report.scalings(suite)
    if not scalings:
        return ""
    charts = ""
    for how in dict.fromkeys(s.communication for s in scalings):
        part = [s for s in scalings if s.communication == how]
        legend = "".join(f"<span>{_key(k)}{name_html(s.agent)}</span>" for k, s in enumerate(part))
        charts += f"<h4>Who hears whom: {escape(how)}</h4>" if how else ""
        charts += f'<nav>{legend}</nav><div class="charts">{scaling_charts(part)}</div>'
    return (
        "<h3>Several robots</h3>"
        '<p class="soft">Time until the team has mapped 95 %, with its interval; thin and dashed, what there '
        "would be if so many robots were so many times as fast. Against one robot: on the same episodes. A "
        "contact of two robots counts for both. NEES / 3 is over all robots.</p>"
        + charts
        + tables.html(scaling_table(scalings))
    )


def _ends_table(entries: Sequence[Entry]) -> str:
    ends = {entry.name: entry.group.ends() for entry in entries}
    kinds = list(dict.fromkeys(kind for found in ends.values() for kind in found))
    rows = {name: [str(found.get(kind, "–")) for kind in kinds] for name, found in ends.items()}
    means = "; ".join(f"{kind}: {ENDINGS[kind]}" for kind in kinds if kind in ENDINGS)
    return f'{tables.html(tables.Table.of_words(["agent", *kinds], rows))}<p class="soft">{escape(means)}</p>'


def _consistency_table(entries: Sequence[Entry]) -> str:
    rows: dict[str, list[str]] = {}
    for entry in entries:
        found = entry.group.consistency()
        mean, (low, high) = found["nees_over_3_mean"], found["nees_band_95"]
        average = tables.shown(tables.BY_KEY["anees"], math.nan if mean is None else mean)
        share = f"{100 * found['fraction_in_band']:.0f} %"
        rows[entry.name] = [average, f"{low:.2f} … {high:.2f}", share]
    head = ["agent", "NEES / 3, average of all seconds", "band of a consistent filter (95 %)", "seconds within it"]
    return tables.html(tables.Table.of_words(head, rows))


def worst_first(keys: Sequence[Key], rows: Sequence[EpisodeRow]) -> list[tuple[Key, EpisodeRow]]:
    """Return episodes with the worst first.

    Those that did not reach 95 % by their coverage; of the others those with a collision, then those without, by
    their trajectory error.
    """

    def rank(pair: tuple[Key, EpisodeRow]) -> tuple[bool, bool, float]:
        m = pair[1].metrics
        if m["time_to_95_s"] is None:
            return False, False, m["coverage"] or 0.0
        return True, m["collisions"] == 0, -(m["ate_rmse_m"] or 0.0)

    return sorted(zip(keys, rows, strict=True), key=rank)


def _cases(entry: Entry) -> str:
    worst = worst_first(entry.group.keys, entry.group.rows)[:_CASES]
    shown_cases = "".join(_case(key, row, several=len(set(entry.group.strata)) > 1) for key, row in worst)
    return (
        f'<details open><summary>{name_html(entry.name)}</summary><div class="cases">{shown_cases}</div></details>'
    )


def _case(key: Key, row: EpisodeRow, *, several: bool) -> str:
    m = row.metrics
    where = f"{key[1]}, seed {key[2]}" if several else f"seed {key[2]}"
    at = "95 % never" if m["time_to_95_s"] is None else f"95 % at {m['time_to_95_s']:.0f} s"
    lines = [
        f"<b>{name_html(where)}</b>",
        f"{100 * m['coverage']:.1f} %, {at}",
        f"ATE {_cm(m['ate_rmse_m'])}, end {_cm(m['final_position_error_m'])}",
        f"{escape(str(m['end']))} at {m['time_s']:.0f} s"
        + (f', <span class="worse">{m["collisions"]} collisions</span>' if m["collisions"] else ""),
    ]
    data = base64.b64encode(row.thumbnail).decode("ascii")
    return (
        f'<figure><img loading="lazy" alt="believed map, {name_html(where)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{'<br>'.join(lines)}</figcaption></figure>"
    )


# ---- all suites ------------------------------------------------------------------------------------------------


def _overview(report: Report, suites: dict[str, list[Entry]]) -> str:
    """Return time to 95 % of every agent on every suite, where there is more than one."""
    if len(suites) < 2:
        return ""
    ratios = {
        together: {name: against["time_to_95_s"].ratio for name, against in found.items()}
        for together, found in report.overall.items()
    }
    found = {suite: centres(entries) for suite, entries in suites.items()}
    return "<h3>Time to 95 % coverage [s]</h3>" + "".join(
        map(tables.html, tables.overview(found, ratios, report.baseline))
    )


def _made(config: dict[str, Any], config_text: str) -> str:
    lines = json.dumps(config, ensure_ascii=False, indent=1)
    return (
        '<h2 id="made">Configuration and versions</h2>'
        '<p class="soft">Beside this page: episodes.csv (a row an episode), summary.csv, comparison.csv, '
        "tables.md, results.sqlite, config.toml.</p>"
        f"<details><summary>What was asked for, and versions</summary><pre>{text_html(lines)}</pre></details>"
        f"<details><summary>config.toml</summary><pre>{text_html(config_text)}</pre></details>"
    )


# ---- small pieces ----------------------------------------------------------------------------------------------


def _key(colour: int) -> str:
    return f'<span class="key c{colour % COLOURS}{" dashed" if colour >= COLOURS else ""}"></span>'


def _cm(metres: float | None) -> str:
    return "–" if metres is None else f"{100 * metres:.1f} cm"


def _anchor(name: str) -> str:
    return "suite-" + "".join(c if c.isalnum() else "-" for c in name)


def _described(report: Report) -> str:
    config = report.config
    version = config.get("mecanum-slam", "")
    which = f"{config['split']} seeds" if config.get("split") else "chosen seeds"
    suites = ", ".join(report.suites())
    return f"{suites}: {', '.join(config['agents'])}; {which}; mecanum-slam {version}"
