"""What recording an episode takes: ``mecanum study recording-cost``.

Each seed is explored without, with, with and without a recorder, in one process, so that whatever else the machine
does falls on both alike; CPU time is compared. Beside it: what the report takes to make, and its size.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from training.episodes import explore
from training.episodes.recording import Recorder
from training.episodes.room_pictures import parse_seeds
from training.runs.errors import Interrupted
from training.runs.options import Seeds
from training.views.report_page import episode_page

__all__ = ["measure", "study"]


def measure(**options: Any) -> dict[str, Any]:
    """Return CPU seconds of an episode without and with recording, of its report, and the report's size.

    The options are those of :func:`training.episodes.explore.prepare`.
    """
    spent: dict[bool, list[float]] = {False: [], True: []}
    for recorded in (False, True, True, False):
        episode, recorder = explore.prepare(**options), Recorder()
        began = time.process_time()
        explore.run(episode, lambda **_: None, [recorder] if recorded else [])
        spent[recorded].append(time.process_time() - began)
        if episode.interrupted:
            raise Interrupted("interrupted; nothing was kept")
        if recorded:
            kept, recording = episode, recorder.recording()
    began = time.process_time()
    page = episode_page(kept.env, recording, title="", metrics=kept.metrics(), ending="", config="", target=1.0)
    without, with_it = (statistics.mean(spent[recorded]) for recorded in (False, True))
    return {
        "seed": options["seed"], "episode_s": float(recording.times[-1]), "cpu_s": without,
        "recorded_cpu_s": with_it, "ratio": with_it / without, "report_cpu_s": time.process_time() - began,
        "report_bytes": len(page.encode()),
    }  # fmt: skip


def study(
    seeds: Seeds = "0:9",
    agent: Annotated[str, typer.Option(help="Who explores.")] = "nearest-frontier",
    rooms: Annotated[str | None, typer.Option(help="Generator of the rooms.")] = None,
    floor_plan: Annotated[Path | None, typer.Option(metavar="FILE", help="A real plan instead.")] = None,
    max_steps: Annotated[int | None, typer.Option(min=1, max=1_000_000, help="Step limit.")] = None,
) -> None:
    """Measure what recording an episode takes: CPU time with and without, in turn."""
    rows: list[dict[str, Any]] = []
    for seed in parse_seeds(seeds, most=1000):
        given: dict[str, Any] = {
            "out": Path("out/recording_cost"), "agent": agent, "rooms": rooms, "seed": seed,
            "floor_plan": floor_plan, "max_steps": max_steps,
        }  # fmt: skip
        if not rows:
            explore.run_whole([Recorder()], **given)  # compile first
        rows.append(measure(**given))
        print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    medians = {key: statistics.median(row[key] for row in rows) for key in rows[0] if key != "seed"}
    print(json.dumps({"episodes": len(rows), "median": medians, "worst_ratio": max(r["ratio"] for r in rows)}))
