"""Paper D's table: how far mapped corners are from the true ones in its corridor systems, backend by backend.

``mecanum study paper-d --out out/paper-d`` drives the ``cavity`` robot (0.5 m/s, 90 °/s, 120° of
view, slip 0.1) by nearest-frontier through corridors of the paper's total and longest lengths (theory.md D).
Deviations are measured without alignment: the start pose is the origin.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mecanum_env.env import ExploreEnv
from mecanum_env.rooms import PAPER_D
from training.episodes.room_pictures import parse_seeds
from training.figures.tables import markdown_table, number
from training.runs.campaign import backend_names, keep_settings, made_by
from training.runs.errors import bad_input
from training.runs.options import Backends, Out, Ray, Seeds, Workers, workers_of
from training.runs.rows import resume
from training.runs.running import write_json
from training.studies.exploring import exploring

__all__ = ["PAPER_MEAN_MAX_M", "run_job", "study", "summarise"]

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
    map_number, backend, seed = job
    env = ExploreEnv(
        robot="cavity",
        rooms={"name": "corridors", "map": map_number},
        slam=backend,
        config={"coverage_target": 1.0},
    )
    # In corridors this narrow what lies round a corner is not seen from afar: look from near by.
    for _ in exploring(env, seed=seed, steps=MAX_STEPS, config={"frontiers": {"view_range_m": 1.0}}):
        pass
    metrics = env.episode_metrics()
    return {key: metrics[key] for key in _KEYS}


def summarise(rows: dict[Job, Row], backends: Sequence[str]) -> list[Row]:
    """Return one summary per map and backend, over the seeds."""
    out = []
    for map_number, (mean_paper, max_paper) in PAPER_MEAN_MAX_M.items():
        for backend in backends:
            group = [row for (m, b, _), row in sorted(rows.items()) if (m, b) == (map_number, backend)]
            means = [row["corner_mean_m"] for row in group if row["corner_mean_m"] is not None]
            most = [row["corner_max_m"] for row in group if row["corner_max_m"] is not None]
            out.append(
                {
                    "map": map_number,
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
    head = [
        "map", "backend", "mean deviation: mean, median of the seeds [m]", "largest: median, worst seed [m]",
        "paper: mean, max [m]", "coverage, median", "collisions",
    ]  # fmt: skip
    rows = []
    for s in summaries:
        total, longest = PAPER_D[s["map"]]
        rows.append([
            f"{s['map']} ({total} m, {longest} m)", f"`{s['slam']}`",
            f"{number(s['corner_mean_m'], 3)}, {number(s['corner_mean_median_m'], 3)}",
            f"{number(s['corner_max_median_m'], 3)}, {number(s['corner_max_m'], 3)}",
            f"{s['paper_mean_m']}, {s['paper_max_m']}", f"{s['coverage_median']:.2f}", str(s["collisions"]),
        ])  # fmt: skip
    return markdown_table(head, rows)


def study(
    slam: Backends = "ekf,invariant-ekf,fastslam1,fastslam2",
    seeds: Seeds = "10000:10019",
    workers: Workers = None,
    ray: Ray = None,
    out: Out = Path("out/paper-d"),
) -> None:
    """Repeat paper D's table: how far mapped corners are from the true ones, backend by backend."""
    with bad_input():
        backends = backend_names(slam)
        chosen = parse_seeds(seeds)
    who = workers_of(workers, ray)
    settings = {**made_by(backends=backends), "max_steps": MAX_STEPS}
    keep_settings(out, settings, FILES)
    jobs = [(m, b, s) for m in PAPER_MEAN_MAX_M for b in backends for s in chosen]
    rows = resume(out / "episodes.jsonl", jobs, run_job, workers=who, what="episodes")
    summaries = summarise(rows, backends)
    write_json(out / "paper_d.json", {**settings, "summaries": summaries})
    print(_table(summaries))
