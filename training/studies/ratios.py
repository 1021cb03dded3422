"""What one agent has of the others' errors and times: ratios of means over the same seeds of a benchmark.

Means, not interquartile means: a rare large error counts. ::

    mecanum study ratios out/benchmark --suite apartments-slippery --agent active
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from slam.types import Array
from training.figures.statistics import NONE, Interval, interval
from training.figures.tables import markdown_table
from training.runs.errors import BadInput

__all__ = ["ratio", "study", "table"]

COLUMNS = {
    "time_to_95_s": ("time to 95 % [s]", 1.0, 1),
    "time_s": ("to the end [s]", 1.0, 1),
    "ate_rmse_m": ("ATE [mm]", 1e3, 1),
    "corner_mean_m": ("corner error [mm]", 1e3, 1),
}


def ratio(ours: Array, theirs: Array) -> Interval:
    """Return mean(ours) / mean(theirs) of pairs ``(n,)`` with its 95 % interval, pairs resampled together.

    Over a mean of 0, such as the ATE of ``truth``, there is none.
    """
    if not theirs.any():
        return NONE
    with np.errstate(divide="ignore", invalid="ignore"):  # a resample may be of zeros alone
        return interval(lambda at: ours[at].mean(axis=-1) / theirs[at].mean(axis=-1), ["all"] * len(ours))


def table(episodes: Path, suite: str, agent: str) -> str:
    """Return a Markdown table: each agent's means, and what ``agent`` has of them.

    Raises
    ------
    BadInput
        Where the rows hold no such suite or agent.
    """
    values = _read(episodes, suite)
    if agent not in values:
        there = f"but of {', '.join(values)}" if values else "and none of that suite"
        raise BadInput(f"{episodes} holds no rows of {agent} on {suite}, {there}; run mecanum benchmark with both")
    head = [suite, *(name for name, _, _ in COLUMNS.values())]
    head += [f"`{agent}`: {name.split(' [')[0]}" for name, _, _ in COLUMNS.values()]
    rows = []
    for other, theirs in values.items():
        seeds = sorted(set(theirs) & set(values[agent]))
        means, shares = [], []
        for k, (_, factor, digits) in enumerate(COLUMNS.values()):
            every = np.array([row[k] for row in theirs.values()])
            means.append(f"{factor * np.nanmean(every):.{digits}f}" if np.isfinite(every).any() else "–")
            pairs = np.array([(values[agent][s][k], theirs[s][k]) for s in seeds])
            pairs = pairs[np.isfinite(pairs).all(axis=1)]
            if other == agent or not len(pairs):
                shares.append("")
                continue
            found = ratio(pairs[:, 0], pairs[:, 1])
            limits = f" [{found.low:.2f}, {found.high:.2f}]" if np.isfinite([found.low, found.high]).all() else ""
            shares.append("–" if np.isnan(found.value) else f"{found.value:.2f}{limits}")
        rows.append([f"`{other}`", *means, *shares])
    return markdown_table(head, rows)


def _read(episodes: Path, suite: str) -> dict[str, dict[tuple[str, int], list[float]]]:
    """Return the columns' values by agent and episode; a time that was not reached is the limit.

    Agents are called what the benchmark's tables call them.
    """
    values: dict[str, dict[tuple[str, int], list[float]]] = {}
    try:
        with episodes.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        several = [
            key for key in ("slam", "communication") if len({row.get(key) or None for row in rows} - {None}) > 1
        ]
        for row in (row for row in rows if row["suite"] == suite):
            found = [float(row[key] or "nan") for key in COLUMNS]
            found[0] = float(row["limit_s"]) if np.isnan(found[0]) else found[0]
            values.setdefault(_name(row, several), {})[row["place"], int(row["seed"])] = found
    except (OSError, KeyError, ValueError) as error:
        raise BadInput(f"cannot read {episodes}: {error}; give the folder of a mecanum benchmark") from error
    return values


def _name(row: dict[str, str], several: list[str]) -> str:
    name = f"{row['agent']}@{row['slam']}" if "slam" in several else row["agent"]
    name += f" ×{row['robots']}" if row.get("robots", "1") not in ("", "1") else ""
    return f"{name} {row['communication']}" if "communication" in several and row["communication"] else name


def study(
    folder: Annotated[Path, typer.Argument(help="Folder of a mecanum benchmark.")],
    suite: Annotated[str, typer.Option(help="Suite whose rows are compared.")] = "apartments-slippery",
    agent: Annotated[str, typer.Option(help="Who is compared with the others.")] = "active",
) -> None:
    """Compare one agent with the others on one suite: ratios of means over the same seeds."""
    print(table(folder / "episodes.csv", suite, agent))
