"""Paper D's table: how far mapped corners are from the true ones in its corridor systems, backend by backend.

``python -m training.studies.paper_d --out out/paper-d`` drives the ``cavity`` robot (0.5 m/s, 90 °/s, 120° of
view, slip 0.1) by nearest-frontier through corridors of the paper's total and longest lengths (theory.md D).
Deviations are measured without alignment: the start pose is the origin.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mecanum_env.rooms import PAPER_D
from slam.formats import atomic_write
from training.episodes.room_pictures import parse_seeds
from training.runs.campaign import backend_names, check_settings, installed_version, run_all, write_settings
from training.runs.errors import BadInput, Interrupted, bad_input

__all__ = ["PAPER_MEAN_MAX_M", "main", "run_job", "summarise"]

PAPER_MEAN_MAX_M = {1: (0.09, 0.20), 2: (0.06, 0.16), 3: (0.13, 0.48)}
"""The paper's own result with its EKF: mean and largest deviation on each map."""

FILES = ("paper_d.json", "episodes.jsonl")
MAX_STEPS = 6000
_KEYS = (
    "coverage", "time_s", "collisions", "corner_mean_m", "corner_max_m", "final_position_error_m", "ate_rmse_m",
    "anees",
)  # fmt: skip

Job = tuple[int, str, int]  # map, backend, seed
Row = dict[str, Any]


def run_job(job: Job) -> Row:
    """Explore one map; return the metrics at the end."""
    import agents
    from mecanum_env.env import ExploreEnv

    number, backend, seed = job
    env = ExploreEnv(
        robot="cavity", rooms={"name": "corridors", "map": number}, slam=backend, config={"coverage_target": 1.0}
    )
    # In corridors this narrow what lies round a corner is not seen from afar: look from near by.
    agent = agents.make(
        "nearest-frontier",
        config={"frontiers": {"view_range_m": 1.0}},
        robot=env.config.robot,
        lidar=env.config.lidar,
    )
    observation, _ = env.reset(seed=seed)
    agent.reset(env.belief, seed=seed)
    idle = 0
    for _ in range(MAX_STEPS):
        action = agent.act(observation, env.belief)
        observation, _, terminated, _, _ = env.step(action)
        idle = idle + 1 if agent.goal is None else 0
        if terminated or idle > 20:
            break
    metrics = env.episode_metrics()
    return {key: metrics[key] for key in _KEYS}


def summarise(rows: dict[Job, Row], backends: Sequence[str]) -> list[Row]:
    """Return one summary per map and backend, over the seeds."""
    out = []
    for number, (mean_paper, max_paper) in PAPER_MEAN_MAX_M.items():
        for backend in backends:
            group = [row for (m, b, _), row in sorted(rows.items()) if (m, b) == (number, backend)]
            means = [row["corner_mean_m"] for row in group if row["corner_mean_m"] is not None]
            most = [row["corner_max_m"] for row in group if row["corner_max_m"] is not None]
            out.append(
                {
                    "map": number,
                    "slam": backend,
                    "episodes": len(group),
                    "corner_mean_m": statistics.fmean(means) if means else None,
                    "corner_mean_median_m": statistics.median(means) if means else None,
                    "corner_max_median_m": statistics.median(most) if most else None,
                    "corner_max_m": max(most) if most else None,
                    "coverage_median": statistics.median(row["coverage"] for row in group),
                    "collisions": sum(row["collisions"] for row in group),
                    "paper_mean_m": mean_paper,
                    "paper_max_m": max_paper,
                }
            )
    return out


def _table(summaries: list[Row]) -> str:
    lines = [
        "| map | backend | mean deviation: mean, median of the seeds [m] | largest: median, worst seed [m] "
        "| paper: mean, max [m] | coverage, median | collisions |",
        "|---|---|---|---|---|---|---|",
    ]
    for s in summaries:
        total, longest = PAPER_D[s["map"]]
        lines.append(
            f"| {s['map']} ({total} m, {longest} m) | `{s['slam']}` | {_m(s['corner_mean_m'])}, "
            f"{_m(s['corner_mean_median_m'])} | {_m(s['corner_max_median_m'])}, {_m(s['corner_max_m'])} "
            f"| {s['paper_mean_m']}, {s['paper_max_m']} | {s['coverage_median']:.2f} | {s['collisions']} |"
        )
    return "\n".join(lines)


def _m(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the module's command line; return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m training.studies.paper_d", description=__doc__)
    parser.add_argument("--slam", default="ekf,invariant-ekf,fastslam1,fastslam2")
    parser.add_argument("--seeds", default="10000:10019")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, default=Path("out/paper-d"))
    options = parser.parse_args(argv)
    try:
        with bad_input():
            backends = backend_names(options.slam)
            seeds = parse_seeds(options.seeds)
            settings = {"version": installed_version(), "max_steps": MAX_STEPS}
            check_settings(options.out, settings, FILES)
        write_settings(options.out, settings)
        store = options.out / "episodes.jsonl"
        rows = _read(store)
        jobs = [(m, b, s) for m in PAPER_MEAN_MAX_M for b in backends for s in seeds]

        with store.open("a", encoding="utf-8") as file:

            def keep(job: Job, row: Row) -> None:
                rows[job] = row
                file.write(json.dumps([*job, row]) + "\n")
                file.flush()

            run_all([job for job in jobs if job not in rows], run_job, workers=options.workers, keep=keep,
                    what="episodes")  # fmt: skip
    except BadInput as error:
        print(f"training.studies.paper_d: {error}", file=sys.stderr)
        return 2
    except Interrupted as error:
        print(error, file=sys.stderr)
        return 130
    summaries = summarise({job: rows[job] for job in jobs}, backends)
    atomic_write(options.out / "paper_d.json", json.dumps({**settings, "summaries": summaries}, indent=1) + "\n")
    print(_table(summaries))
    return 0


def _read(store: Path) -> dict[Job, Row]:
    """Return the rows that are there; a line that was cut off is run again."""
    rows: dict[Job, Row] = {}
    for line in store.read_text(encoding="utf-8").splitlines() if store.exists() else ():
        try:
            number, backend, seed, row = json.loads(line)
        except ValueError:
            continue
        rows[(number, backend, seed)] = row
    return rows


if __name__ == "__main__":
    sys.exit(main())
