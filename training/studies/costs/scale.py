"""``mecanum study scale``: what a step and a decision take, against how much of a building has been explored.

Each plan is explored to its end, or for so long, in a process of its own. ``docs/studies/speed.md`` has what was
measured.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from functools import partial
from itertools import chain, count
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer

import agents
from agents.base import Goal
from mecanum_env.env import ExploreEnv
from mecanum_env.rooms import load
from mecanum_env.views.pictures import draw_map, episode_view
from slam.formats import atomic_write
from slam.types import Array
from training.episodes.explore import Episode, prepare, run, run_whole
from training.figures.charts import chart, label, png, told
from training.figures.tables import number, text_table
from training.runs.campaign import keep_settings, made_by
from training.runs.errors import BadInput, bad_input, one_line
from training.runs.options import Out, Seed
from training.runs.processes import memory_mb
from training.runs.rows import resume
from training.runs.running import write_json
from training.runs.typed import parts_of

__all__ = ["explore", "study", "table"]

Job = tuple[str, str, int, float, str]  # plan, agent, seed, most minutes, folder

FILES = ("scale.json", "scale.png")
STORE = "explorations.jsonl"
_EDGES_M2 = 125.0 * 2.0 ** np.arange(9)  # of the explored areas that are told apart
_LONGEST_PX = 2400


class _Watch:
    """Notes after each step what it took and how much is known by then; ends the episode when time is up."""

    def __init__(self, episode: Episode, limit_s: float) -> None:
        # Known area [m²], the step [ms], all else, which is belief and agent [ms], whether the agent chose.
        self.rows: list[tuple[float, float, float, bool]] = []
        self._step, self._limit_s = episode.wrapped.step, limit_s
        self._took, self._goal = 0.0, episode.agent.goal
        self._began = self._last = time.perf_counter()
        episode.wrapped.step = self.step

    def step(self, action: Any) -> Any:
        began = time.perf_counter()
        observation, reward, terminated, truncated, info = self._step(action)
        now = time.perf_counter()
        self._took = now - began
        return observation, reward, terminated, truncated or now - self._began > self._limit_s, info

    def take(self, env: ExploreEnv, goal: Goal | None) -> None:
        now = time.perf_counter()
        if self._took:
            rest = now - self._last - self._took
            area = env.backend.grid.known_area_m2
            self.rows.append((area, 1e3 * self._took, 1e3 * rest, goal is not self._goal))
        self._last, self._goal = now, goal


def explore(job: Job, *, picture: str) -> dict[str, Any]:
    """Explore a plan; return its figures, and write a picture of the map of that name into the folder.

    ``rows`` by explored area: steps, and the median, mean and 99th percentile of a step, and of what the agent
    takes between two steps where it does not choose and where it does (``driving_ms``, ``decision_ms``).
    """
    plan, agent, seed, minutes, folder = job
    asked: dict[str, Any] = {"out": Path(folder), "agent": agent, "floor_plan": Path(plan), "seed": seed}
    run_whole(**asked, max_steps=300)  # compiles what is still to be compiled
    episode = prepare(**asked)
    watch = _Watch(episode, 60.0 * minutes)
    run(episode, lambda **_: None, [watch])
    if episode.interrupted:
        raise KeyboardInterrupt
    area, step, rest, chose = np.array(watch.rows).T
    choice = chose > 0.0
    rows = []
    for low, high in zip([0.0, *_EDGES_M2], [*_EDGES_M2, np.inf], strict=True):
        here = (area >= low) & (area < high)
        if here.any():
            rows.append({
                "area_m2": float(area[here].mean()), "steps": int(here.sum()), "step_ms": _spread(step[here]),
                "driving_ms": _spread(rest[here & ~choice]), "decision_ms": _spread(rest[here & choice]),
            })  # fmt: skip
    try:
        _draw(episode, Path(folder) / picture)
    except OSError as error:  # the figures took minutes
        print(f"no picture of {Path(plan).name}: {one_line(error)}", file=sys.stderr)
    metrics = episode.metrics()
    kept = ("coverage", "time_s", "wall_time_s", "collisions", "path_length_m", "ate_rmse_m")
    return {
        "plan": Path(plan).stem, "agent": agent, "area_m2": episode.env.truth.ground.plan.area_m2,
        "end": "minutes" if episode.wall_time_s > 60.0 * minutes else episode.end,
        "memory_mb": memory_mb("VmHWM"),
        "step_ms": _spread(step), "driving_ms": _spread(rest[~choice]), "decision_ms": _spread(rest[choice]),
        **{key: metrics[key] for key in kept},
        "rows": rows,
    }  # fmt: skip


def _spread(values: Array) -> dict[str, float] | None:
    if not len(values):
        return None
    return {
        "median": float(np.median(values)),
        "mean": float(values.mean()),
        "p99": float(np.quantile(values, 0.99)),
    }


def _draw(episode: Episode, path: Path) -> None:
    env = episode.env
    view = episode_view(env.truth.ground, env.belief, longest_px=_LONGEST_PX)
    picture = draw_map(env.belief, env.truth.record.estimates, view=view, robot=episode.config.robot)
    atomic_write(path, cv2.imencode(".png", picture)[1].tobytes())


def _pictures(jobs: Sequence[Job]) -> dict[Job, str]:
    """Return what each exploration's picture is called: after plan and agent, numbered where several are alike."""
    names: dict[Job, str] = {}
    for job in jobs:
        name = f"{Path(job[0]).stem}_{Path(job[1]).name.removesuffix('.safetensors')}"
        tried = chain([f"{name}.png"], (f"{name}_{k}.png" for k in count(2)))
        names[job] = next(one for one in tried if one not in names.values())
    return names


def study(
    plans: Annotated[list[Path], typer.Argument(metavar="PLAN...", help="ROS maps or images.")],
    out: Out = Path("out/scale"),
    agent: Annotated[str, typer.Option(help="Agents, separated by commas.")] = "brisk-tour,ppo-frontier",
    seed: Seed = 10000,
    minutes: Annotated[float, typer.Option(min=0.0, max=1e6, help="Most that one exploration may take.")] = 15.0,
) -> None:
    """Explore buildings, and measure what steps and decisions take as the map grows."""
    names = parts_of(agent)
    with bad_input():
        for name in names:
            agents.check(name)
    for plan in plans:
        if not plan.is_file():
            raise BadInput(f"no such file: {plan}; give a ROS map (.yaml) or an image")
        with bad_input():
            load(plan)
    keep_settings(out, {**made_by(*plans, agents=names), "seed": seed, "minutes": minutes}, FILES)
    jobs: list[Job] = [(str(p), name, seed, minutes, str(out)) for p in plans for name in names]
    pictures = _pictures(jobs)
    for k, job in enumerate(jobs):  # each in a process of its own, so that its memory is
        what = f"exploration {k + 1} of {len(jobs)}, {Path(job[0]).stem}, {job[1]}"
        work = partial(explore, picture=pictures[job])
        rows = resume(out / STORE, jobs[: k + 1], work, workers=1, what=what, apart=True)
    found = list(rows.values())
    write_json(out / "scale.json", found)
    atomic_write(out / "scale.png", _chart(found))
    print(table(found))


def _chart(found: Sequence[dict[str, Any]]) -> bytes:
    figure, axes = chart(1, 2, size=(1400, 560))
    for one in found:
        area = [row["area_m2"] for row in one["rows"]]
        for axis, key in zip(axes, ("step_ms", "decision_ms"), strict=True):
            times = [row[key]["median"] if row[key] else np.nan for row in one["rows"]]
            name = told(f"{one['plan']}, {one['agent']}") if key == "decision_ms" else None
            axis.plot(area, times, "o-", label=name)
    label(axes[0], "A step, median", "explored [m²]", "ms", log="x")
    label(axes[1], "A decision, median", "explored [m²]", "ms", log="x")
    for axis in axes:
        axis.set_ylim(bottom=0.0)
    return png(figure)


def table(found: Sequence[dict[str, Any]]) -> str:
    """Return the figures of each exploration as a table."""
    head = ["plan", "m²", "agent", "coverage", "wall s", "step ms", "mean"]
    head += ["driving ms", "mean", "decision ms", "p99", "MB"]
    lines = []
    for one in found:
        cells = [one["plan"], f"{one['area_m2']:.0f}", one["agent"], number(one["coverage"], 3)]
        cells.append(f"{one['wall_time_s']:.0f}")
        for key, second, digits in (("step_ms", "mean", 2), ("driving_ms", "mean", 2), ("decision_ms", "p99", 1)):
            times = one[key] or {}
            cells += [number(times.get("median"), digits), number(times.get(second), digits)]
        lines.append([*cells, f"{one['memory_mb']:.0f}"])
    return text_table(head, lines)
