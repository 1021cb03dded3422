"""``mecanum consistency``: is the error as large as the covariance says? NEES and NIS over Monte-Carlo runs.

In a :mod:`training.studies.circle_world`, where nothing but the filter can be wrong, or in generated rooms,
explored by the nearest-frontier agent. ``docs/studies/consistency.md`` has the equations and what was measured.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import slam
from mecanum_env import MAX_EPISODE_STEPS
from mecanum_env import rooms as room_registry
from mecanum_env.config import NOISE_PRESETS, NoiseConfig
from mecanum_env.env import ExploreEnv
from slam.backend import Backend
from slam.formats import atomic_write
from slam.metrics.measures import nees_band
from slam.settings import check_name
from slam.types import Array
from training.figures.charts import COLOURS, chart, label, png
from training.figures.consistency import step_averages
from training.figures.tables import number, text_table
from training.runs.campaign import Workers, backend_names, keep_settings, made_by
from training.runs.errors import bad_input
from training.runs.rows import resume
from training.runs.running import write_json
from training.studies.circle_world import WORLDS, drive, not_observing
from training.studies.exploring import AGENT, exploring

__all__ = ["Record", "consistency", "run_job", "scaled_noise", "summarise", "table"]

Job = tuple[str, str, int, int, float]  # backend, rooms, seed, steps, noise
Row = list[tuple[float, float, float]]  # a run: NEES, NIS and its degrees of freedom at each step
Record = dict[str, Array]  # the same as columns (steps,): "nees", "nis", "dof"

FILES = ("consistency.json", "consistency.png")
STORE = "runs.jsonl"  # what each run left
_IDLE_STEPS = 20  # an agent without a goal for so long has nothing left to do
_SCALED = ("range_sigma_m", "dropout", "encoder", "radius_error", "base_error", "slip")
_NOT_HERE = {"truth": "is given the pose, so there is nothing to be consistent about"}


def scaled_noise(scale: float) -> NoiseConfig:
    """Return the nominal noise, all of it times ``scale``; the floor's friction is left as it is."""
    nominal = NOISE_PRESETS["nominal"]
    return dataclasses.replace(nominal, **{name: scale * getattr(nominal, name) for name in _SCALED})


# ---- one run ---------------------------------------------------------------------------------------------------


def run_job(job: Job) -> Row:
    """Do one run; NIS is nan for a backend that has none."""
    return _in_world(*job) if job[1] in WORLDS else _in_rooms(*job)


def _record(row: Row) -> Record:
    return dict(zip(("nees", "nis", "dof"), np.array(row, np.float64).reshape(-1, 3).T, strict=True))


def _of_step(backend: Backend, true_pose: Array) -> tuple[float, float, float]:
    dof = float(getattr(backend, "nis_dof", 0))
    return backend.pose_nees(true_pose), float(getattr(backend, "nis", math.nan)) if dof else math.nan, dof


def _in_world(name: str, rooms: str, seed: int, steps: int, noise: float) -> Row:
    world = WORLDS[rooms].scaled(noise)
    backend = slam.make(name, config=world.backend_settings())
    rows = []
    for step in drive(world, backend, seed, steps):
        nees, nis, dof = _of_step(backend, step.true_pose)
        # The backend still tells of its last observation where there was none in this step.
        rows.append((nees, nis, dof) if len(step.observations.range_bearing) else (nees, math.nan, 0.0))
    return rows


def _in_rooms(name: str, rooms: str, seed: int, steps: int, noise: float) -> Row:
    """Explore until the agent has nothing left to do, or the steps are used up."""
    env = ExploreEnv(
        rooms=rooms, slam=name, noise=dataclasses.asdict(scaled_noise(noise)), config={"coverage_target": 1.0}
    )
    rows = []
    for info, idle in exploring(env, seed=seed, steps=steps):
        rows.append(_of_step(env.backend, info["true_pose"]))
        if idle >= _IDLE_STEPS:
            break
    return rows


# ---- all of them -----------------------------------------------------------------------------------------------


def consistency(
    *, backends: str, rooms: str, runs: int, steps: int | None, noise: float, seed0: int, out: Path,
    workers: Workers,
) -> dict[str, Any]:  # fmt: skip
    """Do the runs that ``out`` does not hold yet, write ``consistency.json`` and ``.png``, return the former.

    Backends are given as typed. ``rooms`` is a name in :data:`WORLDS`, or a generator; ``steps`` are at most those
    of a run (None: the world's, or an episode's); ``noise`` is times that of the world, or of the nominal robot.

    Raises
    ------
    BadInput
        For a folder that cannot be used, or a backend that takes no observations.
    Interrupted
        On Ctrl-C; running it again goes on.
    """
    world = WORLDS.get(rooms)
    with bad_input():
        names = backend_names(backends, without=_NOT_HERE | (not_observing() if world else {}))
        check_name("rooms", rooms, (*WORLDS, *room_registry.names()))
        if not (math.isfinite(noise) and noise > 0):
            raise ValueError(f"--noise must be a finite number above 0, got {noise}")
        if world is not None:
            where: dict[str, Any] = {"world": world.scaled(noise).settings()}
        else:
            where = {"agent": AGENT, "noise_config": dataclasses.asdict(scaled_noise(noise))}
    if steps is None:
        steps = world.steps if world is not None else MAX_EPISODE_STEPS
    settings = {**made_by(backends=names), "rooms": rooms, "steps": steps, "noise": noise, **where}
    keep_settings(out, settings, FILES)
    # All backends on one seed before the next seed.
    jobs = [(name, rooms, seed, steps, noise) for seed in range(seed0, seed0 + runs) for name in names]
    rows = resume(out / STORE, jobs, run_job, workers=workers)
    groups = {name: [_record(row) for job, row in rows.items() if job[0] == name] for name in names}
    result: dict[str, Any] = {name: summarise(group) for name, group in groups.items()}
    result["config"] = settings | {"seeds": [seed0, seed0 + runs - 1]}
    write_json(out / "consistency.json", result)
    title = f"Pose NEES / 3, average of {runs} runs: {rooms}, noise × {noise:g}"
    atomic_write(out / "consistency.png", png(_chart(title, groups, nees_band(3, runs))))
    return result


def summarise(records: Sequence[Record]) -> dict[str, Any]:
    """Return a backend's figures from its runs.

    ``anees_pose`` is the mean over the steps of the Monte-Carlo average of NEES / 3 (null where that is not
    finite), ``fraction_in_band`` the share of the steps whose average lies in ``band``, the 95 % band of so many
    runs (at each step: of those that go on), ``nis_mean`` all NIS over all degrees of freedom (null: no NIS).
    """
    averages, lows, highs = step_averages([record["nees"] for record in records])
    defined = [(float(np.nansum(r["nis"])), float(r["dof"][~np.isnan(r["nis"])].sum())) for r in records]
    nis, dof = (sum(column) for column in zip(*defined, strict=True))
    low, high = nees_band(3, len(records))
    mean = float(averages.mean())
    return {
        "anees_pose": mean if math.isfinite(mean) else None,
        "fraction_in_band": float(np.mean((averages >= lows) & (averages <= highs))),
        "nis_mean": nis / dof if dof else None,
        "runs": len(records),
        "steps": len(averages),
        "band": [low, high],
    }


# ---- what the user sees ----------------------------------------------------------------------------------------


def table(result: dict[str, Any]) -> str:
    """Return the figures as a table."""
    rows = [
        [
            name, number(row["anees_pose"], 3, "inf"), f"{100 * row['fraction_in_band']:.0f} %",
            number(row["nis_mean"], 3, "-"), str(row["runs"]), str(row["steps"]),
        ]
        for name, row in result.items() if name != "config"
    ]  # fmt: skip
    low, high = next(iter(result.values()))["band"]
    return (
        text_table(["backend", "NEES / 3", "in 95 % band", "NIS / dof", "runs", "steps"], rows)
        + f"\nideal 1; the average of a step lies in [{low:.2f}, {high:.2f}] with 95 % if consistent"
    )


def _chart(title: str, groups: dict[str, list[Record]], band: tuple[float, float]) -> Figure:
    figure, (axes,) = chart()
    axes.axhspan(*band, color=COLOURS[2], alpha=0.2, linewidth=0, label="95 % band")
    highest = 0.0
    for name, group in groups.items():
        average, _, _ = step_averages([record["nees"] for record in group])
        axes.plot(np.arange(1, len(average) + 1), average, linewidth=1, label=name)
        highest = max(highest, float(np.max(average[np.isfinite(average)], initial=0.0)))
    label(axes, title, "step", "1 is consistent, above it too sure", log="y" if highest > 10 else "")
    if highest <= 10:
        axes.set_ylim(bottom=0.0)
    axes.set_xlim(left=0.0)
    return figure
