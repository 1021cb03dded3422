"""What long runs leave and go on from: a benchmark's store, rows of studies, settings and summaries."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from training.benchmark import leaderboard as board
from training.benchmark.episode import CURVE_POINTS, EpisodeJob, EpisodeRow, Key
from training.benchmark.figures import group_rows
from training.benchmark.output import FILES, Report, as_json, markdown
from training.benchmark.report import page
from training.benchmark.run import BenchmarkPlan
from training.benchmark.store import Store
from training.runs.campaign import keep_settings
from training.runs.rows import resume
from training.studies.reliability.files.samples import Sound

__all__ = [
    "benchmark", "leaderboard", "metrics_of", "row_of", "rows", "run_files", "store", "use_rows", "use_run_files",
    "use_store",
]  # fmt: skip

_ASKED = {"suite": "rooms", "agents": "random", "slam": "odometry", "seeds": "0:2"}
_NUMBERS = (
    "coverage", "time_to_50_s", "time_to_90_s", "time_to_95_s", "time_to_99_s", "time_s", "path_length_m",
    "collisions", "map_iou", "corner_mean_m", "ate_rmse_m", "ate_aligned_rmse_m", "final_position_error_m",
    "final_heading_error_rad", "anees", "decision_ms_median", "decision_ms_p95", "limit_s",
)  # fmt: skip


@cache
def _plan() -> tuple[BenchmarkPlan, dict[Key, str]]:
    plan = BenchmarkPlan.parse(**_ASKED, max_steps=1)  # type: ignore[arg-type]
    return plan, plan.made_by()


def metrics_of(seed: int) -> dict[str, Any]:
    """Return what a row of an episode could say."""
    return {name: 1.0 + 0.1 * seed for name in _NUMBERS} | {"collisions": 0, "end": "time"}


def row_of(job: EpisodeJob) -> EpisodeRow:
    """Return a row that an episode could have left."""
    curve = np.linspace(0.0, 1.0, CURVE_POINTS, dtype=np.float32)
    return EpisodeRow(
        metrics=metrics_of(job.seed),
        coverage_by_time=curve,
        coverage_by_path=curve,
        nees=curve[:9],
        thumbnail=b"\x89PNG",
    )


@cache
def store() -> Sound:
    """Return the folder of a benchmark that is done."""
    plan, made_by = _plan()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "results.sqlite"
        with Store(path) as kept:
            for job in plan.jobs:
                kept.add(job, row_of(job), made_by=made_by[job.key])
        settings = json.dumps(plan.settings(), indent=1).encode()
        return {"results.sqlite": path.read_bytes(), "settings.json": settings}


def use_store(path: Path) -> None:
    """Go on with a benchmark: look what is there, add what is missing, and put the tables together."""
    plan, made_by = _plan()
    keep_settings(path.parent, plan.settings(), FILES)
    with Store(path) as kept:
        there = kept.made_by()
        for job in plan.jobs:
            if job.key not in there:
                kept.add(job, row_of(job), made_by=made_by[job.key])
        groups = group_rows(list(kept.rows(job.key for job in plan.jobs)))
    report = Report.of(groups, baseline=None, config={"agents": ["random"], "seeds": {}})
    json.dumps(as_json(report), allow_nan=False)
    markdown(report)
    page(report, config_text="")


def benchmark(path: Path, out: Path) -> Sequence[str]:
    """Return the command line that goes on with a benchmark."""
    del out
    options = [word for name, value in _ASKED.items() for word in (f"--{name}", value)]
    return ["benchmark", *options, "--max-steps", "1", "--workers", "1", "--report", "--out", str(path.parent)]


_JOBS = tuple((name, seed) for name in ("a", "b") for seed in range(6))


def _work(job: tuple[str, int]) -> dict[str, Any]:
    return {"value": 0.1 * job[1], "name": job[0], "list": [1, 2, 3]}


@cache
def rows() -> Sound:
    """Return the rows of a study that is done."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rows.jsonl"
        resume(path, _JOBS, _work, workers=1)
        return {"rows.jsonl": path.read_bytes()}


def use_rows(path: Path) -> None:
    """Go on with a study: whatever became of its rows, they are what they would be without a break."""
    found = resume(path, _JOBS, _work, workers=1)
    if found != {job: _work(job) for job in _JOBS}:
        raise RuntimeError("rows that nobody computed")
    if resume(path, _JOBS, _refuse, workers=1) != found:
        raise RuntimeError("rows that were computed are not there")


def _refuse(job: tuple[str, int]) -> dict[str, Any]:
    raise RuntimeError(f"{job} is computed once more")


_SETTINGS = {"version": "1", "seed": 0, "agents": ["a", "b"], "limit": {"least": 1, "per_m2": 2.0}}


@cache
def run_files() -> Sound:
    """Return settings, a benchmark's summary, and a page that its figures are put into."""
    plan, _ = _plan()
    pairs = [(job.key, row_of(job)) for job in plan.jobs]
    config = {"agents": ["random"], "backends": ["odometry"], "baseline": None, "seeds": {"rooms": [0, 1, 2]}}
    summary = as_json(Report.of(group_rows(pairs), baseline=None, config=config))
    return {
        "settings.json": json.dumps(_SETTINGS, indent=1).encode(),
        "summary.json": json.dumps(summary, indent=1).encode(),
        "page.md": f"# Page\n\n{board.BEGIN}\n{board.END}\n".encode(),
    }


def use_run_files(path: Path) -> None:
    """Go on in a folder with its settings, and put its figures into a page."""
    keep_settings(path, _SETTINGS, [])
    board.study(path, path / "page.md")


def leaderboard(path: Path, out: Path) -> Sequence[str]:
    """Return the command line that puts a benchmark's figures into a page."""
    del out
    return ["study", "leaderboard", str(path), str(path / "page.md")]
