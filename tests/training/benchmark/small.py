"""Benchmarks that are soon over, rows and groups that are made up, and what a run leaves behind."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from training.benchmark.episode import CURVE_POINTS, EpisodeRow, Key
from training.benchmark.figures import METRICS, Group
from training.benchmark.store import FILE, Store
from training.cli import main

STEPS = 25

WALL_CLOCK = ("decision_ms_median", "decision_ms_p95", "wall_time_s")
"""The metrics that the machine decides, too; all the others are the same in every run of a job."""


def small(out: Path, *more: str, seeds: str = "0:2") -> list[str]:
    return [
        "benchmark", "--suite", "rooms", "--agents", "nearest-frontier", "--seeds", seeds,
        "--max-steps", str(STEPS), "--workers", "1", "--out", str(out), *more,
    ]  # fmt: skip


def measure(argv: list[str], capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    assert main([*argv, "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def contents(out: Path) -> dict[Key, tuple[Any, ...]]:
    """Return all that is in a store but wall-clock."""
    with Store(out / FILE) as store:
        made_by = store.made_by()
        return {key: (made_by[key], *without_clock(row)) for key, row in store.rows(made_by)}


def without_clock(row: EpisodeRow) -> tuple[Any, ...]:
    metrics = {name: value for name, value in row.metrics.items() if name not in WALL_CLOCK}
    curves = (row.coverage_by_time, row.coverage_by_path, row.nees)
    return metrics, *(curve.tobytes() for curve in curves), row.thumbnail


def episode(key: Key, **metrics: Any) -> EpisodeRow:
    """Return a made-up row."""
    some = dict.fromkeys(m.key for m in METRICS) | {
        "coverage": 0.99, "time_s": 60.0, "path_length_m": 30.0, "collisions": 0, "limit_s": 300.0,
        "time_to_50_s": 10.0, "time_to_90_s": 40.0, "time_to_95_s": 50.0, "time_to_99_s": None,
        "ate_rmse_m": 0.01, "final_position_error_m": 0.02, "end": "covered",
    }  # fmt: skip
    curve = np.linspace(0.1, 0.99, CURVE_POINTS).astype(np.float32)
    png = cv2.imencode(".png", np.full((30, 40, 3), 200, np.uint8))[1].tobytes()
    return EpisodeRow(
        metrics=some | metrics, coverage_by_time=curve, coverage_by_path=curve,
        nees=np.ones(3, np.float32), thumbnail=png,
    )  # fmt: skip


def made_up_group(agent: str = "a", suite: str = "rooms", **columns: list[Any]) -> Group:
    n = len(next(iter(columns.values())))
    keys = tuple((suite, "rectangular", seed, agent, "ekf") for seed in range(n))
    rows = tuple(
        episode(key, **{name: values[k] for name, values in columns.items()}) for k, key in enumerate(keys)
    )
    return Group(suite=suite, agent=agent, slam="ekf", keys=keys, rows=rows)


def count(out: Path) -> int:
    try:
        with sqlite3.connect(f"file:{out / FILE}?mode=ro", uri=True) as connection:
            return int(connection.execute("SELECT count(*) FROM episodes").fetchone()[0])
    except sqlite3.Error:  # not there yet
        return 0


def children(pid: int) -> list[int]:
    file = Path(f"/proc/{pid}/task/{pid}/children")
    return [int(word) for word in file.read_text().split()] if file.exists() else []


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
