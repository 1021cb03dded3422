"""``mecanum complexity``: how long one step of an estimator takes, against the number of landmarks in its map.

The landmarks stand one a square metre however many there are, so that the robot, which drives in their midst,
always sees as many: what grows is the map that it does not see. ``docs/studies/speed.md`` has what was measured.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg.blas import dsyrk

import slam
from slam.backend import Backend
from slam.formats import atomic_write
from slam.motion import move
from slam.types import Array, Observations, Odometry
from training.figures.charts import chart, label, png
from training.figures.tables import number, text_table
from training.runs.campaign import backend_names, keep_settings, made_by
from training.runs.errors import bad_input
from training.runs.rows import resume
from training.runs.running import write_json
from training.runs.typed import whole_numbers
from training.studies.circle_world import not_observing, observed

__all__ = ["REFERENCE", "SEEN", "complexity", "exponent", "run_job", "table"]

Job = tuple[str, int, int]  # backend or REFERENCE, landmarks, steps
Point = dict[str, float | None]

FILES = ("complexity.json", "complexity.png")
SEEN = 10
"""Landmarks observed in one step."""
REFERENCE = "blas"
"""For comparison: P − WᵀW of a W of 2 · SEEN rows by BLAS, P of the size of the joint covariance, float64."""
REPEATS = 10
STORE = "points.jsonl"  # what was measured
_MOST_LANDMARKS = 2000  # the joint covariance of so many takes 130 MB
_DT, _SPEED, _TURN = 0.1, 0.3, 0.2
_COV = np.diag([0.02, math.radians(1.0)]) ** 2  # of an observation


# ---- one point -------------------------------------------------------------------------------------------------


def run_job(job: Job) -> Point:
    """Measure one point: the median over the steps, the least of :data:`REPEATS` such [µs].

    ``us_per_step`` of predict and observe together, ``us_predict``, and ``us_correction`` of the stacked update
    alone, which the EKFs have (null elsewhere). The reference has the first only.
    """
    name, landmarks, steps = job
    if name == REFERENCE:
        return {"us_per_step": _time_reference(landmarks), "us_predict": None, "us_correction": None}
    backend = slam.make(name, config={"lidar_offset_m": 0.0})
    world = _landmarks(landmarks)
    drive = _record(world, steps * REPEATS)
    _map_everything(backend, world, drive[0][2])
    backend.predict(drive[0][0])  # compiles what is still to be compiled
    backend.observe(drive[0][1])
    _map_everything(backend, world, drive[0][2])
    rows = _time_steps(backend, drive, _watch_correction(backend))
    medians = np.median(rows.reshape(REPEATS, steps, 3), axis=1)
    whole, predict, correction = (1e6 * float(v) for v in medians.min(axis=0))
    return {"us_per_step": whole, "us_predict": predict, "us_correction": correction or None}


def _landmarks(count: int) -> Array:
    """Return points ``(count, 2)`` [m] about the origin, one a square metre."""
    rng = np.random.default_rng(count)
    side = math.ceil(math.sqrt(count))
    cells = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2) - 0.5 * (side - 1)
    nearest = np.argsort(np.hypot(cells[:, 0], cells[:, 1]), kind="stable")[:count]
    return np.asarray(cells[nearest] + rng.uniform(-0.3, 0.3, (count, 2)))


def _record(world: Array, steps: int) -> list[tuple[Odometry, Observations, Array]]:
    """Drive a circle of 1.5 m; return each step's odometry, :data:`SEEN` nearest landmarks, and pose before it."""
    rng = np.random.default_rng(0)
    pose, twist = np.array([0.0, -_SPEED / _TURN, 0.0]), np.array([_SPEED, 0.0, _TURN])
    out = []
    for _ in range(steps):
        before, pose = pose, move(pose, twist, _DT)
        odometry = Odometry(twist * (1.0 + 0.01 * rng.standard_normal(3)), _DT)
        distance = np.hypot(*(world - pose[:2]).T)
        nearest = np.argsort(distance, kind="stable")[:SEEN]
        out.append((odometry, observed(world, nearest, pose, _COV, rng), before))
    return out


def _map_everything(backend: Backend, world: Array, pose: Array) -> None:
    """Have every landmark in the map, each by one observation from the start."""
    backend.reset(pose)
    rng = np.random.default_rng(1)
    for begin in range(0, len(world), SEEN):
        ids = np.arange(begin, min(begin + SEEN, len(world)))
        backend.observe(observed(world, ids, pose, _COV, rng))


def _watch_correction(backend: Backend) -> Callable[[], float]:
    """Time an EKF's stacked update by standing in for its method; return what gives the last one's time [s]."""
    took = [0.0]
    inner = getattr(backend, "_correct", None)
    if inner is not None and backend.belief.joint_cov is not None:

        def timed(*args: Any) -> Any:
            begin = time.perf_counter()
            out = inner(*args)
            took[0] = time.perf_counter() - begin
            return out

        backend._correct = timed  # type: ignore[attr-defined]
    return lambda: took[0]


def _time_steps(
    backend: Backend, drive: Sequence[tuple[Odometry, Observations, Array]], correction: Callable[[], float]
) -> Array:
    """Return per step the time of all of it, of ``predict``, and of the correction ``(steps, 3)`` [s]."""
    clock = time.perf_counter
    rows = np.empty((len(drive), 3))
    for row, (odometry, observations, _) in zip(rows, drive, strict=True):
        begin = clock()
        backend.predict(odometry)
        middle = clock()
        backend.observe(observations)
        row[:] = clock() - begin, middle - begin, correction()
    return rows


def _time_reference(landmarks: int) -> float:
    """Return how long BLAS takes for P ← P − WᵀW by `dsyrk` [µs]."""
    n = 3 + 2 * landmarks
    w = np.asfortranarray(1e-3 * np.random.default_rng(0).standard_normal((2 * SEEN, n)))
    p = np.asfortranarray(np.eye(n))
    medians = []
    for _ in range(REPEATS):
        times = []
        for _ in range(100):
            begin = time.perf_counter()
            dsyrk(-1.0, w, beta=1.0, c=p, trans=1, overwrite_c=1)  # one triangle, in place
            times.append(time.perf_counter() - begin)
        medians.append(float(np.median(times)))
    return 1e6 * min(medians)


# ---- all of them -----------------------------------------------------------------------------------------------


def complexity(*, backends: str, landmarks: str, steps: int, out: Path) -> dict[str, Any]:
    """Measure the points that ``out`` does not hold yet, one at a time; write and return ``complexity.json``.

    Backends and numbers of landmarks are given as typed.

    Raises
    ------
    BadInput
        For a folder that cannot be used, or a backend that takes no observations.
    Interrupted
        On Ctrl-C; running it again goes on.
    """
    with bad_input():
        asked = backend_names(backends, without=not_observing())
    names = (*asked, REFERENCE)
    sizes = whole_numbers("--landmarks", landmarks, low=SEEN, high=_MOST_LANDMARKS)
    settings = {**made_by(backends=asked), "steps": steps, "repeats": REPEATS, "seen": SEEN, "reference": "dsyrk"}
    keep_settings(out, settings, FILES)
    jobs = [(name, n, steps) for n in sizes for name in names]
    points = resume(out / STORE, jobs, run_job, workers=1, what="points", apart=True)
    result: dict[str, Any] = {}
    figure, (axes,) = chart()
    for name in names:
        rows = [{"landmarks": n, **points[name, n, steps]} for n in sizes]
        times = [float(row["us_per_step"] or 0.0) for row in rows]
        result[name] = {"times": rows, "exponent": exponent(sizes, times)}
        axes.plot(sizes, times, "o-", label=name)
    result["config"] = settings
    write_json(out / "complexity.json", result)
    label(axes, f"Time per step: predict, and observe {SEEN} of n landmarks", "landmarks n", "µs", log="xy")
    axes.set_xticks(sizes, list(map(str, sizes)))
    axes.set_xticks([], minor=True)
    atomic_write(out / "complexity.png", png(figure))
    return result


def exponent(landmarks: Sequence[int], times: Sequence[float]) -> float | None:
    """Return b of the power law a · nᵇ that fits the logarithms best; None of fewer than two points."""
    if len(landmarks) < 2:
        return None
    return float(np.polyfit(np.log(landmarks), np.log(times), 1)[0])


# ---- what the user sees ----------------------------------------------------------------------------------------


def table(result: dict[str, Any]) -> str:
    """Return the times per step [µs] as a table, and the EKFs' corrections against the reference."""
    rows = {name: row for name, row in result.items() if name != "config"}
    sizes = [point["landmarks"] for point in rows[REFERENCE]["times"]]
    head = ["µs per step, landmarks", *(str(n) for n in sizes), "exponent"]
    lines = []
    for name, row in rows.items():
        lines.append([name, *_cells([p["us_per_step"] for p in row["times"]]), number(row["exponent"], 2, "-")])
        corrections = [p["us_correction"] for p in row["times"]]
        if all(corrections):
            ratios = [c / p["us_per_step"] for c, p in zip(corrections, rows[REFERENCE]["times"], strict=True)]
            lines.append(["  its stacked update", *_cells(corrections), ""])
            lines.append([f"  that over {REFERENCE}", *_cells(ratios), ""])
    return text_table(head, lines)


def _cells(values: Sequence[float]) -> list[str]:
    return [f"{v:.1f}" for v in values]
