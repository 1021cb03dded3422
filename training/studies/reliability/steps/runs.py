"""An item run: the environments of one robot, stepped and watched, and what became of memory and handles."""

from __future__ import annotations

import gc
import math
import os
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import agents
from training.episodes.explore import make_agent
from training.runs.errors import one_line
from training.runs.processes import memory_mb
from training.studies.reliability.parts import Row
from training.studies.reliability.steps import batch, team
from training.studies.reliability.steps.actions import policy
from training.studies.reliability.steps.items import Item, settings
from training.studies.reliability.steps.nonsense import NONSENSE_EVERY, no_actions, no_choices, refuse
from training.studies.reliability.steps.watch import Findings, Watch, check_belief, check_metrics

__all__ = ["handles", "run", "work"]


def work(item: Item) -> Row:
    """Run an item; return its digest, what was counted and what was wrong."""
    began = time.perf_counter()
    found = run(item)
    if item.driver == "nonsense":
        plain = run(item, nonsense=False)
        if plain.digest != found.digest:
            found.note("what was refused has left a trace", f"{found.digest} is {plain.digest} without")
    gc.collect()
    return {
        "steps": found.steps, "episodes": found.episodes, "collisions": found.collisions,
        "refused": found.refused, "deepest_mm": round(1e3 * found.deepest_m, 3), "digest": found.digest,
        "mb": round(memory_mb(), 1), "pid": os.getpid(), "handles": handles(),
        "seconds": round(time.perf_counter() - began, 3), "wrong": found.wrong,
    }  # fmt: skip


def run(item: Item, *, nonsense: bool = True) -> Findings:
    """Run an item; where nonsense is acted, it may be left out."""
    found = Findings()
    with tempfile.TemporaryDirectory(prefix="steps-") as folder:
        given = settings(item, Path(folder))
        try:
            _RUNS[item.kind](item, given, found, nonsense and item.driver == "nonsense")
        except Exception as error:
            frames = traceback.extract_tb(error.__traceback__)
            where = " < ".join(f"{Path(f.filename).name}:{f.lineno} {f.name}" for f in reversed(frames[-5:]))
            found.note(f"{type(error).__name__}: {one_line(error)[:200]}", f"step {found.steps}: {where}")
    return found


def _single(item: Item, given: dict[str, Any], found: Findings, nonsense: bool) -> None:
    name = "ExploreWheels" if item.kind == "wheels" else "Explore"
    env = gymnasium.make(f"mecanum_env/{name}-v0", max_episode_steps=item.limit, disable_env_checker=True, **given)
    inner: Any = env.unwrapped
    size = env.action_space.shape[0]  # type: ignore[index]
    rng = np.random.default_rng([item.seed, 2])
    agent = make_agent(item.driver, inner) if item.driver in agents.names() else None
    act = None if agent else policy(item.driver, size, rng, inner)
    left = item.steps
    while left:
        observation, info = env.reset(seed=item.seed + found.episodes)
        if agent is not None:
            agent.reset(inner.belief, seed=item.seed)
        found.episodes += 1
        watch = Watch(inner, found, env.observation_space)  # type: ignore[arg-type]
        watch.first(observation, info)
        ended = False
        while left and not ended:
            if nonsense and left % NONSENSE_EVERY == 0:
                refuse(env.step, no_actions(size), left // NONSENSE_EVERY, found)
            action = agent.act(observation, inner.belief) if agent else act(left)  # type: ignore[misc]
            observation, reward, terminated, truncated, info = env.step(action)
            watch.step(observation, float(reward), info)
            ended = terminated or truncated
            left -= 1
        if ended:
            check_metrics(info, found)
    env.close()


def _frontier(item: Item, given: dict[str, Any], found: Findings, nonsense: bool) -> None:
    """Choose; a choice takes many steps of the robot, of which only the last is seen."""
    config = {"time_limit_s": 0.1 * item.limit}
    env: Any = gymnasium.make(
        "mecanum_env/ExploreFrontier-v0", config=config, disable_env_checker=True, **given
    ).unwrapped
    rng = np.random.default_rng([item.seed, 2])
    most = int(env.action_space.n)
    choose: dict[str, Callable[[], int]] = {"constant": lambda: 0, "extreme": lambda: most - 1}
    at_random: Callable[[], int] = lambda: int(rng.integers(most))  # noqa: E731
    while found.steps < item.steps:
        observation, info = env.reset(seed=item.seed + found.episodes)
        found.episodes += 1
        ended, decisions = False, 0
        while found.steps < item.steps and not ended:
            if nonsense and decisions % NONSENSE_EVERY == 0:
                refuse(env.step, no_choices(most), decisions // NONSENSE_EVERY, found)
            observation, reward, ended, truncated, info = env.step(choose.get(item.driver, at_random)())
            ended = ended or truncated
            decisions += 1
            found.steps += round(info["duration_s"] / env.config.step_s)
            if not env.observation_space.contains(observation):
                found.note("an observation is not in its space", f"choice {decisions}")
            if not math.isfinite(reward):
                found.note("reward or info is not finite", f"choice {decisions}: {reward}")
            found.feed(observation, reward, info["duration_s"], *info["true_pose"])
            check_belief(env.base, 200 * decisions, found)
        if ended:
            check_metrics(info, found)
        found.collisions += env.base.truth.world.collisions
    env.close()


def handles() -> int:
    """Return how many files, pipes and sockets this process has open; 0 where the system does not tell."""
    folder = Path("/proc/self/fd")
    return len(os.listdir(folder)) if folder.exists() else 0


_RUNS: dict[str, Callable[[Item, dict[str, Any], Findings, bool], None]] = {
    "single": _single, "wheels": _single, "frontier": _frontier, "team": team.run, "batch": batch.run,
}  # fmt: skip
