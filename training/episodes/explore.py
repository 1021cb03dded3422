"""``mecanum explore``: one episode, from the options to its end; ``training.views`` writes its files."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import gymnasium
import numpy as np

import agents
from agents.base import ENDINGS as AGENT_ENDINGS
from agents.base import Agent, Goal
from mecanum_env.arguments import make_config, make_plan
from mecanum_env.config import EnvConfig
from mecanum_env.env import ExploreEnv
from mecanum_env.rooms import FloorPlan
from slam.files import quoted
from training.runs.config_files import read_config
from training.runs.errors import BadInput, bad_input, check_writable
from training.runs.running import plain
from training.runs.signals import interrupt_flag
from training.truth.known_map import KNOWN_MAPS, KnownMap

__all__ = [
    "AGENT_DONE_AFTER_S", "ENDINGS", "EXTRAS", "FILES", "Course", "Episode", "Progress", "Witness", "asked_for",
    "done", "make_agent", "meaning", "prepare", "read_run_table", "run", "run_whole",
]  # fmt: skip

FILES = (
    "map.png", "map.pgm", "map.yaml", "truth.png", "trajectory_true.tum", "trajectory_estimate.tum",
    "landmarks.db", "config.toml", "report.html", "metrics.json",
)  # fmt: skip
"""What an episode writes, ``metrics.json`` last: where it is, the others are."""

EXTRAS = {"video": "episode.mp4", "mcap": "episode.mcap", "rerun": "episode.rrd"}
"""What it writes besides when asked to, by the option."""

LEAST_STEPS, STEPS_PER_M2 = 3000, 12.0
"""The step limit where none is given: so many of 0.1 s, or so many a square metre of free space."""

ENDINGS = {
    **AGENT_ENDINGS,
    "time": "the step limit was reached first",
    "collision": "it touched a wall or another robot, and the configuration ends an episode there",
    "interrupted": "broken off, by Ctrl-C or SIGTERM",
    "running": "it goes on: written on the way",
}
"""Why an episode ended: the word in ``metrics.json``, and what it means."""


AGENT_DONE_AFTER_S = 2.0
"""An agent that says it has ended, and had no goal for so long, has nothing left to do."""

_DEFAULTS: dict[str, Any] = {"agent": "nearest-frontier", "seed": 0}
_RUN_KINDS = {"agent": (str,), "seed": (int,), "start": (list,), "max_steps": (int,)}


class Progress(Protocol):
    """Told after every step how far the episode is."""

    def __call__(self, *, coverage: float, time_s: float, steps: int, max_steps: int) -> None:
        """Show it, or do not."""


class Witness(Protocol):
    """Sees an episode's start and every step of it."""

    def take(self, env: ExploreEnv, goal: Goal | None) -> None:
        """Take down the environment as it is now, and where the agent means to go."""


@dataclass(eq=False, kw_only=True)
class Course:
    """What was asked of an episode, of one robot or of a team, and how it went: prepared, run, then written."""

    config: EnvConfig  # with the coverage that counts as success
    run: dict[str, Any]  # agent, seed, … as config.toml's [run] has them
    out: Path
    end: str = "time"  # a word of ENDINGS, or the agent's own
    interrupted: bool = False
    wall_time_s: float = 0.0
    decisions_ms: list[float] = field(default_factory=list)

    @property
    def timed_ms(self) -> list[float]:
        """Times of all decisions but the first [ms]: a process may load or compile what decides in that."""
        return self.decisions_ms[1:]

    @property
    def decision_ms(self) -> float | None:
        """Median of :attr:`timed_ms`."""
        return statistics.median(self.timed_ms) if self.timed_ms else None

    def about(self) -> dict[str, Any]:
        """Return what the metrics say of who explored where, and of the end."""
        return {
            "agent": self.run["agent"],
            "slam": self.config.slam,
            "rooms": self.config.rooms if self.config.floor_plan is None else None,
            "floor_plan": self.config.floor_plan,
            "seed": self.run["seed"],
            "end": self.end,
            "interrupted": self.interrupted,
            "wall_time_s": round(self.wall_time_s, 3),
        }


@dataclass(eq=False, kw_only=True)
class Episode(Course):
    """An episode of one robot."""

    env: ExploreEnv
    wrapped: Any  # the same environment, as gym.make wrapped it
    agent: Agent
    observation: Mapping[str, Any]

    def metrics(self) -> dict[str, Any]:
        """Return the contents of ``metrics.json``."""
        metrics: dict[str, Any] = dict(self.env.episode_metrics())
        metrics["decision_ms_median"] = self.decision_ms
        metrics["return_error_m"] = float(np.hypot(*self.env.truth.pose[:2])) if self.end == "returned" else None
        if isinstance(self.agent, KnownMap):
            metrics["lower_bound_s"] = self.agent.lower_bound_s
        metrics["success"] = bool(metrics["coverage"] >= self.config.coverage_target)
        metrics |= self.about()
        return {key: plain(value) for key, value in metrics.items()}


def meaning(end: str) -> str:
    """Return what a word for an ending, or for an agent's status, means; an agent may have words of its own."""
    return ENDINGS.get(end, "a word of the agent's own")


# ---- before --------------------------------------------------------------------------------------------------


def prepare(*, out: Path, **asked: Any) -> Episode:
    """Check everything that can be checked, and place the robot; nothing is written.

    What else is asked are options of :func:`asked_for`.

    Raises
    ------
    BadInput
        In one line: which option, file or name is wrong, and what to do.
    """
    with bad_input():
        world, run, plan = asked_for(out=out, files=[*FILES, *EXTRAS.values()], **asked)
        wrapped = gymnasium.make(
            "mecanum_env:mecanum_env/Explore-v0", config=replace(world, coverage_target=1.0),
            max_episode_steps=run["max_steps"], disable_env_checker=True,
        )  # fmt: skip
        placed = run.get("start")
        reset_options = {"floor_plan": plan} | ({"start_pose": tuple(placed)} if placed is not None else {})
        observation, _ = wrapped.reset(seed=run["seed"], options=reset_options)
        env = wrapped.unwrapped
        assert isinstance(env, ExploreEnv)
        explorer = make_agent(run["agent"], env)
        explorer.reset(env.belief, run["seed"])
    return Episode(
        env=env, wrapped=wrapped, agent=explorer, observation=observation, config=world, run=run, out=out
    )


def asked_for(
    *, out: Path, files: Sequence[str], agent: str | None = None, rooms: str | None = None,
    slam: str | None = None, robot: str | None = None, noise: str | None = None, seed: int | None = None,
    floor_plan: Path | None = None, start: tuple[float, float, float] | None = None, config: Path | None = None,
    max_steps: int | None = None, coverage_target: float | None = None,
) -> tuple[EnvConfig, dict[str, Any], FloorPlan]:  # fmt: skip
    """Return the world that is asked for, ``config.toml``'s [run], and the plan.

    Of what is ``None`` the config file or the default decides.

    An agent maps all that it can reach; what counts as success, the world's ``coverage_target``, is judged at
    the end.
    """
    past = read_run_table(config) if config is not None else {}
    if any(v is not None for v in (rooms, floor_plan, seed)):
        # Other rooms: neither the start nor the step limit is meant for them.
        past = {name: value for name, value in past.items() if name in _DEFAULTS}
    given = {"agent": agent, "seed": seed, "start": start, "max_steps": max_steps}
    run = _DEFAULTS | past | {name: value for name, value in given.items() if value is not None}
    agents.check(run["agent"], *KNOWN_MAPS)
    if run["agent"].endswith(".safetensors"):
        run["agent"] = str(Path(run["agent"]).absolute())  # as a floor plan's
    world = make_config(config=config, rooms=rooms, slam=slam, robot=robot, noise=noise, floor_plan=floor_plan)
    if world.floor_plan is not None:
        world = replace(world, floor_plan=str(Path(world.floor_plan).absolute()))
    if coverage_target is not None:
        world = replace(world, coverage_target=coverage_target)
    check_writable(out, files)
    plan = make_plan(world, run["seed"])
    limit = run.get("max_steps") or _step_limit(plan.area_m2, world.step_s)
    return world, run | {"max_steps": limit}, plan


def _step_limit(area_m2: float, step_s: float) -> int:
    """Return how many steps an episode may have: the same time, however long a step is."""
    return math.ceil(round(max(LEAST_STEPS, math.ceil(STEPS_PER_M2 * area_m2)) * 0.1 / step_s, 6))


def done(agent: Agent) -> bool:
    """Whether an agent has nothing to drive to; one whose belief is lost waits until it is found again.

    Raises
    ------
    TypeError
        For an agent whose status is no word: it may be why the episode ends.
    """
    status: Any = agent.status
    if not isinstance(status, str):
        raise TypeError(f"status of agent {type(agent).__name__} must be a word (str), got {quoted(status)}")
    return agent.goal is None and status != "lost"


def make_agent(name: str, env: ExploreEnv, *, config: Mapping[str, Any] | None = None) -> Agent:
    """Return an agent for an environment's robot, the bounds that know the map among them."""
    if name in KNOWN_MAPS:
        return KnownMap(env, KNOWN_MAPS[name])
    told = env.config
    return agents.make(name, robot=told.robot, lidar=told.lidar, step_s=told.step_s, config=config)


def read_run_table(path: Path) -> dict[str, Any]:
    """Return ``agent``, ``seed``, ``start`` and ``max_steps`` from a config's [run] table, where it has one."""
    _, run = read_config(path, _RUN_KINDS)
    start = run.get("start", [0.0, 0.0, 0.0])
    good = len(start) == 3 and all(isinstance(v, int | float) and math.isfinite(v) for v in start)
    if not good or run.get("max_steps", 1) < 1:
        raise BadInput(f"config {path}: [run] needs max_steps ≥ 1 and start = [x, y, θ]")
    return run


# ---- the episode -----------------------------------------------------------------------------------------------


def run(episode: Episode, progress: Progress, witnesses: Sequence[Witness] = ()) -> None:
    """Let the agent explore until it is done, the steps are used up, or Ctrl-C is pressed between two steps."""
    env, agent, step = episode.env, episode.agent, episode.wrapped.step
    patience = math.ceil(AGENT_DONE_AFTER_S / episode.config.step_s)
    observation, goal, idle, max_steps = episode.observation, agent.goal, 0, episode.run["max_steps"]
    for witness in witnesses:
        witness.take(env, goal)
    began = time.perf_counter()
    with interrupt_flag() as interrupted:
        for steps in range(1, max_steps + 1):
            asked = time.perf_counter()
            action = agent.act(observation, env.belief)
            if agent.goal is not goal:
                # The step in which it chose: driving on costs next to nothing.
                episode.decisions_ms.append(1e3 * (time.perf_counter() - asked))
                goal = agent.goal
            observation, _, terminated, truncated, info = step(action)
            for witness in witnesses:
                witness.take(env, goal)
            progress(coverage=info["coverage"], time_s=info["time_s"], steps=steps, max_steps=max_steps)
            idle = idle + 1 if done(agent) else 0
            if interrupted.is_set():
                episode.end, episode.interrupted = "interrupted", True
            elif terminated and not (info["is_success"] and agent.outlives_coverage):
                episode.end = "covered" if info["is_success"] else "collision"
            elif idle >= patience and agent.ended:
                episode.end = agent.status
            elif not truncated:
                continue
            break
    episode.wall_time_s = time.perf_counter() - began


def run_whole(witnesses: Sequence[Witness] = (), **options: Any) -> Episode:
    """Run an episode in silence, of what :func:`prepare` is asked for, and return it.

    Raises
    ------
    KeyboardInterrupt
        On Ctrl-C: half an episode is no result.
    """
    episode = prepare(**options)
    run(episode, lambda **_: None, witnesses)
    if episode.interrupted:
        raise KeyboardInterrupt
    return episode
