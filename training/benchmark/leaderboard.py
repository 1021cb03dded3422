"""Put a benchmark's figures into a page: ``mecanum study leaderboard RESULTS PAGE``.

``RESULTS`` is the folder of ``mecanum benchmark``; of it ``summary.json`` is read. What stands in the page outside
of the marks stays as it is.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from slam.formats import atomic_write
from training.benchmark.suites import SLIPPERY
from training.runs.errors import BadInput

__all__ = ["BEGIN", "END", "study", "tables", "update"]

BEGIN, END = "<!-- leaderboard -->", "<!-- end of the leaderboard -->"

_NOT_SUITES = ("comparison", "ends", "consistency", "config")
# metric, heading, factor, digits, whether with its interval
_COLUMNS = (
    ("time_to_95_s", "time to 95 % [s]", 1.0, 1, True),
    ("reached_95", "reached 95 % [%]", 100.0, 0, False),
    ("path_length_m", "path [m]", 1.0, 1, False),
    ("collisions_per_100_m", "collisions per 100 m", 1.0, 2, False),
    ("map_iou", "wall IoU", 1.0, 3, False),
    ("corner_mean_m", "corner error [cm]", 100.0, 2, True),
    ("ate_rmse_m", "ATE [cm]", 100.0, 2, True),
    ("final_heading_error_rad", "heading error [°]", 57.29578, 3, False),
    ("anees", "NEES/3", 1.0, 2, False),
    ("decision_ms_median", "decision [ms]", 1.0, 1, False),
)  # fmt: skip
_OWN = ("baseline", "split")  # of the settings, no library's version
_BOUND = "known-map"

Summary = Mapping[str, Any]


def tables(summary: Summary) -> str:
    """Return the leaderboard in Markdown: the times of all suites side by side, then each suite's table."""
    suites = [name for name in summary if name not in _NOT_SUITES]
    config = summary["config"]
    parts = [_overview(summary, suites)]
    for suite in suites:
        seeds = config["seeds"][suite]
        parts.append(f"### {suite}\n\nSeeds {min(seeds)} to {max(seeds)}.\n")
        parts.append(_suite(summary[suite]))
        ends = {agent: words for agent, words in summary["ends"][suite].items() if set(words) != {"covered"}}
        if ends:
            told = "; ".join(f"`{agent}` {_counted(words)}" for agent, words in ends.items())
            parts.append(f"Ended otherwise than covered: {told}.\n")
    versions = ", ".join(
        f"{name} {value}" for name, value in config.items() if isinstance(value, str) and name not in _OWN
    )
    parts.append(f"Backend {', '.join(config['backends'])}; {versions}.\n")
    return "\n".join(parts)


def _counted(words: Mapping[str, int]) -> str:
    return ", ".join(f"{word} {count}" for word, count in words.items())


def _overview(summary: Summary, suites: Sequence[str]) -> str:
    """Time to 95 % coverage, an agent a row and a suite a column; and against the baseline over all suites."""
    agents = _ranked({a: m for suite in suites for a, m in summary[suite].items()})
    lines = ["### Time to 95 % coverage [s], IQM\n"]
    for slippery in (False, True):
        columns = [s for s in suites if s.endswith(SLIPPERY) == slippery]
        if not columns:
            continue
        together = "all-slippery" if slippery else "all-nominal"
        versus = summary.get("comparison", {}).get(together, {})
        extra = [f"against `{summary['config']['baseline']}`"] if versus else []
        lines += [_row(["agent", *columns, *extra]), _row(["---"] * (1 + len(columns) + len(extra)))]
        rows = sorted(agents, key=lambda a: _mean_time(summary, columns, a))
        for agent in rows:
            cells = [_value(summary[s].get(agent), "time_to_95_s", 1.0, 1) for s in columns]
            against = [_ratio(versus.get(agent, {}).get("time_to_95_s"))] if extra else []
            lines.append(_row([_name(agent), *cells, *against]))
        lines.append("")
    return "\n".join(lines)


def _mean_time(summary: Summary, suites: Sequence[str], agent: str) -> float:
    times = [summary[s][agent]["time_to_95_s"]["value"] for s in suites if agent in summary[s]]
    return sum(times) / len(times) if times and None not in times else float("inf")


def _ratio(comparison: Mapping[str, Any] | None) -> str:
    if not comparison or not comparison.get("ratio"):
        return ""
    ratio = comparison["ratio"]
    change: Callable[[float], str] = lambda v: f"{100.0 * (v - 1.0):+.1f}"  # noqa: E731
    if ratio.get("low") is None:
        return f"{change(ratio['value'])} %"
    return f"{change(ratio['value'])} % [{change(ratio['low'])}, {change(ratio['high'])}]"


def _suite(agents: Summary) -> str:
    lines = [_row(["agent", *(heading for _, heading, *_ in _COLUMNS)]), _row(["---"] * (1 + len(_COLUMNS)))]
    for agent in _ranked(agents):
        cells = [
            _value(agents[agent], key, factor, digits, interval) for key, _, factor, digits, interval in _COLUMNS
        ]
        lines.append(_row([_name(agent), *cells]))
    return "\n".join(lines) + "\n"


def _ranked(agents: Summary) -> list[str]:
    """Return agents by their time to 95 %, those that never get there last."""

    def time(agent: str) -> float:
        value = agents[agent]["time_to_95_s"]["value"]
        return float("inf") if value is None else float(value)

    return sorted(agents, key=lambda a: (time(a), a))


def _name(agent: str) -> str:
    return f"*{agent}* (knows the plan, no agent)" if agent.split("@")[0] == _BOUND else f"`{agent}`"


def _value(figures: Summary | None, key: str, factor: float, digits: int, interval: bool = False) -> str:
    if figures is None or figures.get(key, {}).get("value") is None:
        return "–"
    figure = figures[key]
    text = f"{factor * figure['value']:.{digits}f}"
    if interval and figure.get("low") is not None and figure.get("high") is not None:
        text += f" [{factor * figure['low']:.{digits}f}, {factor * figure['high']:.{digits}f}]"
    return text


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def update(page: str, content: str) -> str:
    """Return the page with what stands between the two marks replaced.

    Raises
    ------
    BadInput
        Where the marks are missing.
    """
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise BadInput(f"the page lacks its marks; put {BEGIN} and {END} where the tables shall be")
    return f"{before}{begin}\n\n{content}\n{end}{after}"


def study(
    results: Annotated[Path, typer.Argument(help="Folder of a mecanum benchmark.")],
    page: Annotated[Path, typer.Argument(help="Markdown page with the two marks.")],
) -> None:
    """Put a benchmark's figures into a page, between its two marks."""
    try:
        summary = json.loads((results / "summary.json").read_text("utf-8"))
        text = update(page.read_text("utf-8"), tables(summary))
        atomic_write(page, text)
    except (OSError, ValueError, KeyError) as error:
        raise BadInput(f"cannot read {results} or {page}: {error!r}") from error
