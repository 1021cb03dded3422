"""What recording an episode takes: ``python -m training.studies.recording_cost``.

Each seed is explored without, with, with and without a recorder, in one process, so that whatever else the machine
does falls on both alike; CPU time is compared. Beside it: what the report takes to make, and its size.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from pathlib import Path
from typing import Any

from training.episodes import explore
from training.episodes.recording import Recorder
from training.episodes.room_pictures import parse_seeds
from training.runs.errors import BadInput, Interrupted, bad_input
from training.views.report_page import episode_page

__all__ = ["main", "measure"]


def measure(options: explore.ExploreOptions) -> dict[str, Any]:
    """Return CPU seconds of an episode without and with recording, of its report, and the report's size."""
    spent: dict[bool, list[float]] = {False: [], True: []}
    for recorded in (False, True, True, False):
        episode, recorder = explore.prepare(options), Recorder()
        began = time.process_time()
        explore.run(episode, lambda **_: None, [recorder] if recorded else [])
        spent[recorded].append(time.process_time() - began)
        if episode.interrupted:
            raise Interrupted("interrupted; nothing was kept")
        if recorded:
            kept, recording = episode, recorder.recording()
    began = time.process_time()
    page = episode_page(kept.env, recording, title="", metrics=kept.metrics(), ending="", config="", command="")
    without, with_it = (statistics.mean(spent[recorded]) for recorded in (False, True))
    return {
        "seed": options.seed, "episode_s": float(recording.times[-1]), "cpu_s": without, "recorded_cpu_s": with_it,
        "ratio": with_it / without, "report_cpu_s": time.process_time() - began,
        "report_bytes": len(page.encode()),
    }  # fmt: skip


def main(argv: list[str] | None = None) -> int:
    """Run the module's command line; return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m training.studies.recording_cost", description=__doc__)
    parser.add_argument("--seeds", default="0:9")
    parser.add_argument("--agent", default="nearest-frontier")
    parser.add_argument("--rooms", default=None)
    parser.add_argument("--floor-plan", type=Path, default=None)
    parser.add_argument("--max-steps", type=int, default=None)
    options = parser.parse_args(argv)
    try:
        with bad_input():
            seeds = parse_seeds(options.seeds, most=1000)
        rows: list[dict[str, Any]] = []
        for seed in seeds:
            given = explore.ExploreOptions(
                out=Path("out/recording_cost"), agent=options.agent, rooms=options.rooms, seed=seed,
                floor_plan=options.floor_plan, max_steps=options.max_steps,
            )  # fmt: skip
            if not rows:
                explore.run(explore.prepare(given), lambda **_: None, [Recorder()])  # compile first
            rows.append(measure(given))
            print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    except (BadInput, Interrupted, KeyboardInterrupt) as error:
        print(f"recording_cost: {error or 'interrupted'}", file=sys.stderr)
        return 2 if isinstance(error, BadInput) else 130
    medians = {key: statistics.median(row[key] for row in rows) for key in rows[0] if key != "seed"}
    print(json.dumps({"episodes": len(rows), "median": medians, "worst_ratio": max(r["ratio"] for r in rows)}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
