"""The accuracy table of ``docs/studies/estimators.md``: episodes over seeds, rooms, backends; their medians.

``mecanum study accuracy --seeds 10000:10049 --out results/episodes`` runs what is missing in
``episodes.jsonl`` (a killed run goes on where it stopped), then writes ``episodes.csv`` and ``summary.json`` and
prints the table.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
import tempfile
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

import agents
from mecanum_env.config import NOISE_PRESETS
from mecanum_env.rooms.registry import check as check_rooms
from slam.formats import atomic_write
from slam.metrics.measures import nees_band
from slam.registry import config_type
from slam.settings import unknown_name
from training.episodes.room_pictures import parse_seeds
from training.runs.errors import bad_input
from training.runs.options import Workers

__all__ = ["consistency_figures", "evaluate", "study", "summarise"]

Job = tuple[str, str, int]  # rooms, backend, seed
Row = dict[str, Any]

_MEDIANS = (
    "coverage", "time_s", "time_to_95_s", "path_length_m", "map_iou", "corner_mean_m", "corner_max_m",
    "ate_rmse_m", "final_position_error_m", "final_heading_error_rad", "anees", "landmarks",
)  # fmt: skip


def run_job(job: Job, agent: str, noise: str) -> Row:
    """Run one episode; return its metrics, and its pose NEES once a simulated second."""
    from training.episodes.explore import ExploreOptions, prepare, run

    rooms, backend, seed = job
    with tempfile.TemporaryDirectory() as folder:
        options = ExploreOptions(
            out=Path(folder),
            agent=agent,
            rooms=rooms,
            slam=backend,
            seed=seed,
            noise=noise,
        )
        episode = prepare(options)
        run(episode, lambda **_: None)
    row = episode.metrics()
    every = round(1.0 / episode.config.step_s)
    row["nees_each_s"] = [round(float(v), 4) for v in episode.env.truth.record.nees[every::every]]
    return row


def evaluate(jobs: Iterable[Job], *, agent: str, noise: str, workers: int, out: Path) -> list[Row]:
    """Run the jobs that ``out/episodes.jsonl`` does not hold yet; return every row that was asked for."""
    out.mkdir(parents=True, exist_ok=True)
    store = out / "episodes.jsonl"
    wanted = set(jobs)
    done = {
        (r["rooms"], r["slam"], r["seed"]): r for r in _read(store) if (r["agent"], r["noise"]) == (agent, noise)
    }
    missing = sorted(wanted - done.keys(), key=lambda job: (job[2], job[0], job[1]))
    with ProcessPoolExecutor(workers) as pool, store.open("a", encoding="utf-8") as file:
        futures = {pool.submit(run_job, job, agent, noise): job for job in missing}
        try:
            for count, future in enumerate(as_completed(futures), start=1):
                row = future.result() | {"noise": noise}
                done[futures[future]] = row
                # One write a row: what is killed in between leaves whole rows behind.
                file.write(json.dumps(row) + "\n")
                file.flush()
                print(f"\r{count}/{len(missing)} episodes", end="", file=sys.stderr, flush=True)
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    if missing:
        print(file=sys.stderr)
    return [done[job] for job in sorted(wanted)]


def _read(store: Path) -> list[Row]:
    if not store.exists():
        return []
    rows = []
    for line in store.read_text(encoding="utf-8").splitlines():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            continue  # the row that was being written when the run was killed: it is run again
    return rows


def summarise(rows: list[Row]) -> list[Row]:
    """Return one summary per rooms and backend."""
    out = []
    for rooms, backend in sorted({(r["rooms"], r["slam"]) for r in rows}):
        group = [r for r in rows if (r["rooms"], r["slam"]) == (rooms, backend)]
        summary: Row = {
            "rooms": rooms,
            "slam": backend,
            "noise": group[0]["noise"],
            "agent": group[0]["agent"],
            "episodes": len(group),
            "seeds": f"{group[0]['seed']}:{group[-1]['seed']}",
            "covered_95": sum(r["coverage"] >= 0.95 for r in group),
            "without_collision": sum(r["collisions"] == 0 for r in group),
        }
        for key in _MEDIANS:
            values = [r[key] for r in group if r[key] is not None]
            summary[f"{key}_median"] = statistics.median(values) if values else None
        summary["final_position_error_m_max"] = max(r["final_position_error_m"] for r in group)
        back = [r["return_error_m"] for r in group if r.get("return_error_m") is not None]
        summary |= {
            "returned": len(back),
            "return_error_m_median": statistics.median(back) if back else None,
            "return_error_m_max": max(back) if back else None,
        }
        summary |= consistency_figures([r["nees_each_s"] for r in group])
        out.append(summary)
    return out


def consistency_figures(profiles: list[list[float]]) -> Row:
    """Return the average NEES / 3 over the runs, second by second, against the band of that many runs.

    ``profiles`` are each run's pose NEES, once a second. Counted as long as at least half the runs go on; the
    others' ends would leave the average to a few.
    """
    seconds = int(np.median([len(p) for p in profiles]))
    averages, inside = [], 0
    for k in range(seconds):
        values = [p[k] for p in profiles if len(p) > k]
        average = statistics.fmean(values) / 3.0
        low, high = nees_band(3, len(values))
        inside += low <= average <= high
        averages.append(average)
    low, high = nees_band(3, len(profiles))
    return {
        "nees_over_3_mean": statistics.fmean(averages) if averages else None,
        "nees_band_95": [low, high],
        "fraction_in_band": inside / max(len(averages), 1),
    }


def _csv(rows: list[Row]) -> str:
    """Return every episode's metrics as a table, one row each, without the NEES over time."""
    names = [
        name for name in rows[0] if name not in ("nees_each_s", "floor_plan", "wall_time_s", "decision_ms_median")
    ]

    def cell(value: Any) -> str:
        if isinstance(value, float):
            return f"{value:.6g}"
        return "" if value is None else str(value)

    return "\n".join([",".join(names), *(",".join(cell(row[name]) for name in names) for row in rows)]) + "\n"


def _figure(value: float | None, places: int) -> str:
    return "–" if value is None else f"{value:.{places}f}"


def _table(summaries: list[Row]) -> str:
    lines = [
        "| rooms | backend | coverage ≥ 0.95 | no collision | final position error, median (max) [m] "
        "| corner error, median [m] | ATE, median [m] | map IoU | time to 95 % [s] | NEES/3 (in 95 % band) |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for s in summaries:
        n = s["episodes"]
        lines.append(
            f"| {s['rooms']} | `{s['slam']}` | {s['covered_95']} of {n} | {s['without_collision']} of {n} "
            f"| {s['final_position_error_m_median']:.3f} ({s['final_position_error_m_max']:.3f}) "
            f"| {_figure(s['corner_mean_m_median'], 3)} | {s['ate_rmse_m_median']:.3f} "
            f"| {_figure(s['map_iou_median'], 3)} | {_figure(s['time_to_95_s_median'], 0)} "
            f"| {_figure(s['nees_over_3_mean'], 2)} ({100 * s['fraction_in_band']:.0f} %) |"
        )
        if s["returned"]:
            lines.append(
                f"| | | {s['returned']} of {n} came back, truly {s['return_error_m_median']:.3f} m "
                f"(at most {s['return_error_m_max']:.3f}) from the start | | | | | | | |"
            )
    return "\n".join(lines)


def _check_names(kinds: list[str], backends: list[str], agent: str, noise: str) -> None:
    """Raise ``ValueError`` for a name that is not registered, before any episode is run."""
    for kind in kinds:
        check_rooms(kind)
    for backend in backends:
        config_type(backend)
    agents.check(agent)
    if noise not in NOISE_PRESETS:
        raise unknown_name("noise preset", noise, NOISE_PRESETS)


def study(
    rooms: Annotated[
        str, typer.Option(help="Generators of rooms, separated by commas.")
    ] = "apartment,rectangular",
    slam: Annotated[str, typer.Option(help="SLAM backends, separated by commas.")] = "ekf,odometry,truth",
    agent: Annotated[str, typer.Option(help="Who explores.")] = "nearest-frontier",
    noise: Annotated[str, typer.Option(help="Noise preset.")] = "nominal",
    seeds: Annotated[str, typer.Option(help="3, 0:9 (both included) or 1,4,7.")] = "10000:10049",
    workers: Workers = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("out/accuracy"),
) -> None:
    """Explore over seeds, rooms and backends: one row each, and their medians."""
    with bad_input():
        _check_names(rooms.split(","), slam.split(","), agent, noise)
        jobs = [(r, b, s) for r in rooms.split(",") for b in slam.split(",") for s in parse_seeds(seeds)]
        rows = evaluate(jobs, agent=agent, noise=noise, workers=workers or os.cpu_count() or 1, out=out)
    summaries = summarise(rows)
    versions = {name: version(name) for name in ("mecanum-slam", "numpy", "numba", "pymunk", "gymnasium")}
    text = json.dumps({"versions": versions, "summaries": summaries}, indent=1)
    atomic_write(out / "summary.json", text + "\n")
    atomic_write(out / "episodes.csv", _csv(rows))
    print(_table(summaries))
