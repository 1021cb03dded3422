"""The accuracy table of ``docs/studies/estimators.md``: episodes over seeds, rooms, backends; their medians.

``mecanum study accuracy --seeds 10000:10049 --out results/episodes`` runs what is missing in
``episodes.jsonl`` (a killed run goes on where it stopped), then writes ``episodes.csv`` and ``summary.json`` and
prints the table.
"""

from __future__ import annotations

import math
import statistics
import tempfile
from pathlib import Path
from typing import Annotated, Any

import typer

import agents
from mecanum_env.arguments import make_config
from slam.formats import atomic_write
from training.episodes.explore import run_whole
from training.episodes.room_pictures import parse_seeds
from training.figures.consistency import consistency_figures
from training.figures.tables import csv_table, markdown_table, number
from training.runs.campaign import keep_settings, made_by
from training.runs.errors import bad_input
from training.runs.options import Backends, Out, Ray, Seeds, Workers, workers_of
from training.runs.rows import resume
from training.runs.running import plain, versions, write_json
from training.runs.typed import parts_of

__all__ = ["study", "summarise"]

Job = tuple[str, str, int, str, str]  # rooms, backend, seed, agent, noise
Row = dict[str, Any]

FILES = ("episodes.csv", "summary.json")
STORE = "episodes.jsonl"
_MEDIANS = (
    "coverage", "time_s", "time_to_95_s", "path_length_m", "map_iou", "corner_mean_m", "corner_max_m",
    "ate_rmse_m", "final_position_error_m", "final_heading_error_rad", "anees", "landmarks",
)  # fmt: skip


def run_job(job: Job) -> Row:
    """Run one episode; return its metrics, and its pose NEES once a simulated second."""
    rooms, backend, seed, agent, noise = job
    with tempfile.TemporaryDirectory() as folder:
        episode = run_whole(out=Path(folder), agent=agent, rooms=rooms, slam=backend, seed=seed, noise=noise)
    every = round(1.0 / episode.config.step_s)
    nees = [round(float(v), 4) for v in episode.env.truth.record.nees[every::every]]
    return episode.metrics() | {"nees_each_s": nees, "noise": noise}


_NOT_IN_CSV = ("nees_each_s", "floor_plan", "wall_time_s", "decision_ms_median")


def summarise(rows: list[Row], seeds: str) -> list[Row]:
    """Return one summary per rooms and backend; it names the seeds as typed."""
    out = []
    for rooms, backend in sorted({(r["rooms"], r["slam"]) for r in rows}):
        group = [r for r in rows if (r["rooms"], r["slam"]) == (rooms, backend)]
        summary: Row = {
            "rooms": rooms,
            "slam": backend,
            "noise": group[0]["noise"],
            "agent": group[0]["agent"],
            "episodes": len(group),
            "seeds": seeds,
            "covered_95": sum(r["coverage"] >= 0.95 for r in group),
            "without_collision": sum(r["collisions"] == 0 for r in group),
        }
        for key in _MEDIANS:
            # A time that was not reached is later than any.
            never = [math.inf] * sum(r[key] is None for r in group) if key == "time_to_95_s" else []
            values = [r[key] for r in group if r[key] is not None] + never
            middle = statistics.median(values) if values else math.inf
            summary[f"{key}_median"] = middle if math.isfinite(middle) else None
        summary["final_position_error_m_max"] = max(r["final_position_error_m"] for r in group)
        back = [r["return_error_m"] for r in group if r.get("return_error_m") is not None]
        summary |= {
            "returned": len(back),
            "return_error_m_median": statistics.median(back) if back else None,
            "return_error_m_max": max(back) if back else None,
        }
        found = consistency_figures([r["nees_each_s"] for r in group])
        summary |= {key: plain(value) for key, value in found.items()}
        out.append(summary)
    return out


def _table(summaries: list[Row]) -> str:
    head = [
        "rooms", "backend", "coverage ≥ 0.95", "no collision", "final position error, median (max) [m]",
        "corner error, median [m]", "ATE, median [m]", "map IoU", "time to 95 % [s]", "NEES/3 (in 95 % band)",
    ]  # fmt: skip
    rows = []
    for s in summaries:
        n = s["episodes"]
        rows.append([
            s["rooms"], f"`{s['slam']}`", f"{s['covered_95']} of {n}", f"{s['without_collision']} of {n}",
            f"{s['final_position_error_m_median']:.3f} ({s['final_position_error_m_max']:.3f})",
            number(s["corner_mean_m_median"], 3), number(s["ate_rmse_m_median"], 3),
            number(s["map_iou_median"], 3), number(s["time_to_95_s_median"], 0),
            f"{number(s['nees_over_3_mean'], 2)} ({100 * s['fraction_in_band']:.0f} %)",
        ])  # fmt: skip
        if s["returned"]:
            back = (
                f"{s['returned']} of {n} came back, truly {s['return_error_m_median']:.3f} m "
                f"(at most {s['return_error_m_max']:.3f}) from the start"
            )
            rows.append(["", "", back, *[""] * 7])
    return markdown_table(head, rows)


def study(
    rooms: Annotated[
        str, typer.Option(help="Generators of rooms, separated by commas.")
    ] = "apartment,rectangular",
    slam: Backends = "ekf,odometry,truth",
    agent: Annotated[str, typer.Option(help="Who explores.")] = "nearest-frontier",
    noise: Annotated[str, typer.Option(help="Noise preset.")] = "nominal",
    seeds: Seeds = "10000:10049",
    workers: Workers = None,
    ray: Ray = None,
    out: Out = Path("out/accuracy"),
) -> None:
    """Explore over seeds, rooms and backends: one row each, and their medians."""
    with bad_input():
        agents.check(agent)
        kinds, backends = parts_of(rooms), parts_of(slam)
        for kind in kinds:
            for backend in backends:
                make_config(rooms=kind, slam=backend, noise=noise)
        jobs = [(r, b, s, agent, noise) for s in parse_seeds(seeds) for r in kinds for b in backends]
    who = workers_of(workers, ray)
    keep_settings(out, made_by(agents=[agent], backends=backends), FILES)
    every = resume(out / STORE, jobs, run_job, workers=who, what="episodes")
    rows = [every[job] for job in sorted(set(jobs))]
    summaries = summarise(rows, seeds)
    write_json(out / "summary.json", {"versions": versions(), "summaries": summaries})
    shown = [{key: value for key, value in row.items() if key not in _NOT_IN_CSV} for row in rows]
    atomic_write(out / "episodes.csv", csv_table(shown, digits=6))
    print(_table(summaries))
