"""Put a benchmark's figures into a page: ``mecanum study leaderboard RESULTS PAGE``.

``RESULTS`` is the folder of ``mecanum benchmark``; of it ``summary.json`` is read. What stands in the page outside
of the marks stays as it is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from slam.files import quoted, read_bytes, read_json
from slam.formats import atomic_write
from training.benchmark.tables import figures_table, markdown, overview, ranked
from training.figures.statistics import Interval
from training.figures.tables import markdown_name
from training.runs.errors import BadInput, bad_input

__all__ = ["BEGIN", "END", "study", "tables", "update"]

BEGIN, END = "<!-- leaderboard -->", "<!-- end of the leaderboard -->"

_NOT_SUITES = ("comparison", "ends", "consistency", "config", "teams")
_COLUMNS = (
    "time_to_95_s", "regret_95", "reached_95", "path_length_m", "collisions_per_100_m", "map_iou", "corner_mean_m",
    "ate_rmse_m", "final_heading_error_rad", "anees", "decision_ms_median",
)  # fmt: skip
_WITH_LIMITS = ("time_to_95_s", "regret_95", "corner_mean_m", "ate_rmse_m")
_OWN = ("baseline", "split")  # of the settings, no library's version

Summary = Mapping[str, Any]


def tables(summary: Summary) -> str:
    """Return the leaderboard in Markdown: the times of all suites side by side, then each suite's table."""
    suites = {name: _figures(found) for name, found in summary.items() if name not in _NOT_SUITES}
    config = summary["config"]
    versus = {
        together: {name: _interval(against["time_to_95_s"]["ratio"]) for name, against in found.items()}
        for together, found in summary.get("comparison", {}).items()
    }
    parts = ["### Time to 95 % coverage [s], IQM\n"]
    parts += [markdown(table) for table in overview(suites, versus, config["baseline"], limits=False)]
    for suite, found in suites.items():
        parts.append(f"### {suite}\n\nSeeds {_ranges(config['seeds'][suite])}.\n")
        parts.append(markdown(figures_table(ranked(found), _COLUMNS, limits=_WITH_LIMITS)))
        ends = {agent: words for agent, words in summary["ends"][suite].items() if set(words) != {"covered"}}
        if ends:
            told = "; ".join(f"{markdown_name(agent)} {_counted(words)}" for agent, words in ends.items())
            parts.append(f"Ended otherwise than covered: {told}.\n")
    versions = ", ".join(
        f"{name} {value}" for name, value in config.items() if isinstance(value, str) and name not in _OWN
    )
    parts.append(f"Backend {', '.join(config['backends'])}; {versions}.\n")
    return "\n".join(parts)


def _ranges(seeds: Sequence[int]) -> str:
    """Return seeds as ``0 to 9, 12``."""
    ends: list[list[int]] = []
    for seed in sorted(seeds):
        if ends and seed == ends[-1][-1] + 1:
            ends[-1][1:] = [seed]
        else:
            ends.append([seed])
    return ", ".join(" to ".join(map(str, part)) for part in ends)


def _counted(words: Mapping[str, int]) -> str:
    return ", ".join(f"{word} {count}" for word, count in words.items())


def _figures(agents: Summary) -> dict[str, dict[str, Interval]]:
    return {name: {key: _interval(figure) for key, figure in found.items()} for name, found in agents.items()}


def _interval(figure: Summary) -> Interval:
    """Return a figure with its interval; null is infinite where episodes have a value, as a mean NEES may be."""
    value, low, high = (figure.get(key) for key in ("value", "low", "high"))
    beyond = math.inf if figure.get("n") else math.nan
    return Interval(
        beyond if value is None else value, math.nan if low is None else low, beyond if high is None else high
    )


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
    with bad_input():
        summary, before = read_json(results / "summary.json"), read_bytes(page, what="page")
    protocol = summary.get("settings", {}).get("protocol") if isinstance(summary, dict) else None
    if protocol is not None:
        raise BadInput(f"{results} is a benchmark of --protocol {quoted(protocol)}; give one of suites")
    try:
        text = update(before.decode("utf-8"), tables(summary))
    except BadInput as error:
        raise BadInput(f"{page}: {error}") from error
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise BadInput(f"cannot put {results} into {page}: {quoted(error, 200)}; is it a benchmark's?") from error
    atomic_write(page, text)
