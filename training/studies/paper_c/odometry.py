"""Paper C on board: the odometry of the simulated robot while it accelerates, with and without the filter.

Q is chosen on drives of the training seeds; what is reported comes from drives of test seeds. A filter hides from
the backend that its errors are correlated, so the EKF's NEES in rooms is told, too.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from mecanum_env.config import NOISE_PRESETS, ROBOT_PRESETS
from mecanum_env.env import ExploreEnv
from mecanum_env.sensing.odometry_calibration import Drives, drive
from slam.motion import move
from slam.odometry.differential_transform import MODELS
from slam.odometry.filters import OdometryFilter, OdometryFilterConfig
from slam.types import Array, Odometry
from training.runs.campaign import Workers, run_all
from training.studies.exploring import exploring

__all__ = [
    "NOISES", "PROCESS", "TEST_SEED", "TRAINING_SEED", "TURN_PROCESS", "accelerating", "best", "drives", "errors",
    "explore", "filtered", "scan_process", "step_time_us",
]  # fmt: skip

Row = dict[str, Any]
Job = tuple[str, str, int, int]  # noise, odometry filter, seed, steps

NOISES = ("nominal", "slippery")
TRAINING_SEED, TEST_SEED = 0, 10_000
FASTER_M_S2 = 0.3  # change of the wheels' speed from which the robot accelerates; drives ask for 0.8
_SHORTEST = 4  # steps of a stretch
TURN_PROCESS = 10.0  # Q of θ over Q of x and y, as R of θ over R of x and y
_DRIVE_STEPS = 300
PROCESS = {name: np.logspace(-3, 2, 11) for name in MODELS} | {"wiener_acceleration": np.logspace(-1, 5, 13)}
"""Model → the Q tried on board."""


# ---- drives over an open floor ---------------------------------------------------------------------------------


def drives(noise: str, *, seed: int, episodes: int) -> Drives:
    """Return drives of the nominal robot by random twists, 30 s each, with one of the noise presets."""
    return drive(ROBOT_PRESETS["youbot"], NOISE_PRESETS[noise], episodes=episodes, steps=_DRIVE_STEPS, seed=seed)


def filtered(driven: Drives, config: OdometryFilterConfig) -> Array:
    """Return the twists ``(episodes, steps, 3)`` that a filter makes of the measured ones."""
    behind, out = OdometryFilter(config), np.empty_like(driven.measured)
    for episode, twists in enumerate(driven.measured):
        behind.reset()
        for k, twist in enumerate(twists):
            out[episode, k] = behind.filter(Odometry(twist, driven.dt)).twist
    return out


def accelerating(driven: Drives) -> list[tuple[int, int, int]]:
    """Return the stretches in which the robot truly accelerates: episode, first step, the step after the last."""
    lever = ROBOT_PRESETS["youbot"].lever_m
    change = np.diff(driven.true * np.array([1.0, 1.0, lever]), axis=1) / driven.dt
    fast = np.linalg.norm(change, axis=2) > FASTER_M_S2
    out = []
    for episode, row in enumerate(fast):
        ends = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(np.int8), [0]])))
        out += [(episode, int(a) + 1, int(b) + 1) for a, b in ends.reshape(-1, 2) if b - a >= _SHORTEST]
    return out


def errors(driven: Drives, twists: Array, stretches: Sequence[tuple[int, int, int]]) -> Row:
    """Return what is wrong with twists ``(episodes, steps, 3)``: RMS over the stretches, and over whole drives.

    Velocity and turn rate are the single steps' in the stretches; positions are dead-reckoned from the true pose
    at the start of a stretch, or of a drive, and compared at its end.
    """
    wrong = np.concatenate([twists[e, a:b] - driven.true[e, a:b] for e, a, b in stretches])
    ends = [_drift(twists[e, a:b], driven.true[e, a:b], driven.dt) for e, a, b in stretches]
    whole = [_drift(twists[e], driven.true[e], driven.dt) for e in range(len(twists))]
    return {
        "velocity_rms_mm_s": 1e3 * math.sqrt(float(np.mean(np.sum(wrong[:, :2] ** 2, axis=1)))),
        "turn_rate_rms_mrad_s": 1e3 * math.sqrt(float(np.mean(wrong[:, 2] ** 2))),
        "stretch_position_rms_mm": 1e3 * math.sqrt(float(np.mean(np.square(ends)))),
        "drive_position_rms_mm": 1e3 * math.sqrt(float(np.mean(np.square(whole)))),
    }


def _drift(twists: Array, true: Array, dt: float) -> float:
    """Return how far [m] dead reckoning by ``twists`` ends from where ``true`` ends, both ``(k, 3)``."""
    here, there = np.zeros(3), np.zeros(3)
    for a, b in zip(twists, true, strict=True):
        here, there = move(here, a, dt), move(there, b, dt)
    return math.hypot(here[0] - there[0], here[1] - there[1])


def scan_process(driven: dict[str, Drives]) -> list[Row]:
    """Return per noise, model and Q the errors, beside those of the unfiltered odometry (model None)."""
    rows: list[Row] = []
    for noise, one in driven.items():
        stretches = accelerating(one)
        rows.append({"noise": noise, "model": None, "process": None, **errors(one, one.measured, stretches)})
        for model, tried in PROCESS.items():
            for q in tried:
                config = OdometryFilterConfig(
                    model=model, process_linear=float(q), process_turn=float(TURN_PROCESS * q)
                )
                rows.append({
                    "noise": noise, "model": model, "process": float(q),
                    **errors(one, filtered(one, config), stretches),
                })  # fmt: skip
    return rows


def best(rows: Sequence[Row]) -> list[Row]:
    """Return each model's Q with the least velocity error in the stretches, as a share of the unfiltered one's.

    Averaged over the noise presets, and over the velocity and the turn rate; the best model first.
    """
    keys = ("velocity_rms_mm_s", "turn_rate_rms_mrad_s")
    raw = {row["noise"]: row for row in rows if row["model"] is None}
    shares: dict[tuple[str, float], list[float]] = {}
    for row in rows:
        if row["model"] is not None:
            own = shares.setdefault((row["model"], row["process"]), [])
            own += [row[key] / raw[row["noise"]][key] for key in keys]
    out: dict[str, Row] = {}
    for (model, q), own in shares.items():
        share = float(np.mean(own))
        if model not in out or share < out[model]["share_of_unfiltered"]:
            out[model] = {"model": model, "process": q, "share_of_unfiltered": share}
    return sorted(out.values(), key=lambda row: float(row["share_of_unfiltered"]))


def step_time_us(driven: Drives, config: OdometryFilterConfig) -> float:
    """Return the median time of one step of the filter [µs]."""
    behind, times = OdometryFilter(config), []
    for twist in driven.measured.reshape(-1, 3):
        start = time.perf_counter()
        behind.filter(Odometry(twist, driven.dt))
        times.append(time.perf_counter() - start)
    return 1e6 * float(np.median(times))


# ---- in rooms, with a backend that believes what it is given ---------------------------------------------------


def explore(*, seed: int, episodes: int, steps: int, workers: Workers) -> list[Row]:
    """Let the EKF explore apartments with and without the filter; return NEES and errors per noise and filter."""
    names = ("none", "differential-transform")
    jobs = [(noise, name, s, steps) for s in range(seed, seed + episodes) for noise in NOISES for name in names]
    results: dict[Job, Row] = {}
    run_all(jobs, explore_once, workers=workers, keep=results.__setitem__, what="episodes")
    rows = []
    for noise in NOISES:
        for name in names:
            group = [results[job] for job in jobs if job[:2] == (noise, name)]
            rows.append({
                "noise": noise, "odometry_filter": name, "episodes": len(group),
                "anees": float(np.mean([row["anees"] for row in group])),
                "anees_median": float(np.median([row["anees"] for row in group])),
                "ate_rmse_m": float(np.mean([row["ate_rmse_m"] for row in group])),
                "final_position_error_m": float(np.mean([row["final_position_error_m"] for row in group])),
                "anees_of_seeds": [row["anees"] for row in group],
            })  # fmt: skip
    return rows


def explore_once(job: Job) -> Row:
    """Explore one apartment by nearest-frontier; return the metrics at the end."""
    noise, name, seed, steps = job
    env = ExploreEnv(
        rooms="apartment", slam="ekf", noise=noise, odometry_filter=name, config={"coverage_target": 1.0}
    )
    for _ in exploring(env, seed=seed, steps=steps):
        pass
    metrics = env.episode_metrics()
    return {key: metrics[key] for key in ("anees", "ate_rmse_m", "final_position_error_m")}
