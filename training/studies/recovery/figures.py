"""What episodes with faults amount to: how many recovered, how long it took, false alarms, and reliability."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from training.figures.charts import COLOURS, INK, chart, label
from training.studies.recovery.runs import BINS, Row

__all__ = ["draw_recovery", "draw_reliability", "false_alarms", "recovered", "reliability", "sum_up"]

_COUNTED = ("count", "true", "sum")
_IN_TIME_S = 20.0
_DOUBLED = 0.02  # share of the mapped walls by which their precision may fall: more is a wall drawn twice


def recovered(row: Row) -> bool:
    """Tell whether a belief was right again in time, with no wall drawn twice."""
    in_time = row["recovered_s"] is not None and row["recovered_s"] <= _IN_TIME_S
    return bool(in_time and not _doubled(row))


def _doubled(row: Row) -> bool:
    before, after = row["precision_before"], row["precision"]
    return None not in (before, after) and bool(after < before - _DOUBLED)


def sum_up(rows: Sequence[Row]) -> dict[str, Any]:
    """Return the figures of the episodes with one fault."""
    done = [row for row in rows if row["possible"]]
    times = [row["recovered_s"] for row in done if recovered(row)]
    median = statistics.median(times + [math.inf] * (len(done) - len(times))) if done else math.inf
    return {
        "episodes": len(done),
        "impossible": len(rows) - len(done),
        "recovered": sum(map(recovered, done)),
        "recovered_s_median": median if math.isfinite(median) else None,  # those that never were count as late
        "recovered_s_max": max(times, default=None),  # of those that were
        "doubled_walls": sum(map(_doubled, done)),
        "error_m_max_median": statistics.median(row["worst_m"] for row in done) if done else None,
        "relocalisations": sum(row["found"] for row in done),
        "lost_s_max": max((row["lost_s"] for row in done), default=0.0),
        "contacts": sum(row["contacts"] for row in done),
    }


def false_alarms(rows: Sequence[Row]) -> dict[str, float]:
    """Return how often, in episodes without a fault, a belief was given up, and in how many hours of driving."""
    hours = sum(row["seconds"] for row in rows) / 3600.0
    lost = sum(row["lost"] for row in rows)
    return {"hours": hours, "times_lost": lost, "in_10_hours": 10.0 * lost / hours if hours else 0.0}


def reliability(rows: Sequence[Row]) -> dict[str, Any]:
    """Return a reliability diagram's figures: per bin of health its mean, how often the belief was true, seconds.

    ``expected_error`` is the mean distance of the two, each bin by its seconds.
    """
    count, true, total = (np.array([row[key] for row in rows], np.float64).sum(axis=0) for key in _COUNTED)
    filled = count > 0
    health, share = total[filled] / count[filled], true[filled] / count[filled]
    weight = count[filled] / count.sum()
    return {
        "edges": list(BINS),
        "seconds": count.astype(int).tolist(),
        "health": [None if n == 0 else h / n for h, n in zip(total.tolist(), count.tolist(), strict=True)],
        "true": [None if n == 0 else t / n for t, n in zip(true.tolist(), count.tolist(), strict=True)],
        "health_mean": float(total.sum() / count.sum()),
        "true_mean": float(true.sum() / count.sum()),
        "expected_error": float(np.sum(weight * np.abs(health - share))),
    }


def draw_reliability(found: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Return the diagram: how often beliefs of a health were true, and how many seconds there were of it."""
    figure, (diagram, counts) = chart(2, size=(1000, 1000))
    diagram.plot([0, 1], [0, 1], color=INK, linewidth=1, linestyle="dashed", label="ideal")
    width = 0.8 / max(len(found), 1)
    for k, (name, one) in enumerate(found.items()):
        points = [
            (h, t, n) for h, t, n in zip(one["health"], one["true"], one["seconds"], strict=True) if n >= _FEWEST
        ]
        if not points:
            continue
        health, true, seconds = np.array(points, np.float64).T
        # 95 % of what so many seconds would give if they were independent, which they are not.
        spread = 1.96 * np.sqrt(np.maximum(true * (1.0 - true), 0.25 / seconds) / seconds)
        diagram.errorbar(
            health, true, yerr=spread, fmt="o-", color=COLOURS[k % len(COLOURS)], capsize=3, label=name
        )
        bars = np.arange(len(one["seconds"])) + (k - 0.5 * (len(found) - 1)) * width
        counts.bar(
            bars,
            np.where(np.array(one["seconds"]) > 0, one["seconds"], np.nan),
            width,
            color=COLOURS[k % len(COLOURS)],
            label=name,
        )
    diagram.set_xlim(0.0, 1.0)
    diagram.set_ylim(0.0, 1.02)
    label(diagram, "Is the belief true as often as it says?", "health", "share within the 99.7 % region")
    label(counts, "Seconds of each health", "health from", "seconds", log="y")
    counts.set_xticks(range(len(BINS) - 1), [f"{edge:g}" for edge in BINS[:-1]])
    return figure


_FEWEST = 10  # seconds in a bin that is drawn


def draw_recovery(groups: Mapping[str, Sequence[Row]]) -> Figure:
    """Return how many beliefs were right again after so long, fault by fault."""
    figure, (axes,) = chart(size=(1000, 500))
    for name, rows in groups.items():
        done = [row for row in rows if row["possible"]]
        times = sorted(row["recovered_s"] for row in done if recovered(row))
        if done:
            steps = [0.0, *times, _IN_TIME_S]
            shares = [k / len(done) for k in [*range(len(times) + 1), len(times)]]
            axes.step(steps, shares, where="post", label=name)
    axes.set_ylim(0.0, 1.02)
    label(axes, "Right again, with no wall drawn twice", "seconds after the fault's end", "share of the episodes")
    return figure
