"""``mecanum explore --robots N``: one episode of a team, as ``explore`` has it of one robot."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from agents.base import Agent, Goal
from mecanum_env.team.config import TeamConfig
from mecanum_env.team.team import JOINT_SLAM, Team
from slam.files import quoted
from slam.settings import from_mapping
from training.episodes.explore import AGENT_DONE_AFTER_S, EXTRAS, Course, Progress, asked_for, done, make_agent
from training.episodes.team_log import TeamLog, team_metrics
from training.runs.config_files import read_config
from training.runs.errors import BadInput, bad_input
from training.runs.running import plain
from training.runs.signals import interrupt_flag
from training.truth.known_map import KNOWN_MAPS

__all__ = [
    "FILES", "LANDMARKS", "ROBOT_FILE", "TeamEpisode", "TeamWitness", "files_of", "prepare", "read_team", "run",
    "tell_goal",
]  # fmt: skip

FILES = ("map.pgm", "map.yaml", "team.png", "config.toml", "report.html", "metrics.json")
"""What an episode of a team writes, beside :func:`files_of` each robot, ``metrics.json`` last."""

# An episode with several agents ends as the one does that did worst.
_WORST_FIRST = ("stuck", "unreachable", "covered", "returned")


LANDMARKS = "landmarks.db"
"""The landmarks of all, where backends keep the covariance that it takes to merge them."""

ROBOT_FILE = re.compile(r"(trajectory_(true|estimate)|landmarks|map)_robot_\d+\.(tum|db|pgm|yaml)")
"""What the names of :func:`files_of` look like."""


def files_of(robot: int) -> tuple[str, ...]:
    """Return what an episode writes of one robot."""
    kinds = ("trajectory_true", "tum"), ("trajectory_estimate", "tum"), ("landmarks", "db"), ("map", "pgm")
    return tuple(f"{kind}_robot_{robot}.{ending}" for kind, ending in (*kinds, ("map", "yaml")))


class TeamWitness(Protocol):
    """Sees a team's start and every step of it."""

    def take(self, team: Team, goals: Sequence[Goal | None]) -> None:
        """Take down the team as it is now, and where each of its robots means to go."""


@dataclass(eq=False, kw_only=True)
class TeamEpisode(Course):
    """An episode of a team."""

    team: Team
    agents: tuple[Agent, ...]
    observations: list[Mapping[str, Any]]
    log: TeamLog = field(default_factory=TeamLog)

    def metrics(self) -> dict[str, Any]:
        """Return the contents of ``metrics.json``."""
        setting = self.team.team
        metrics = {
            "robots": setting.robots,
            "communication": setting.communication.model,
            "starts": setting.starts,
            "known_starts": setting.known_starts,
            **team_metrics(self.team, self.log),
            "decision_ms_median": self.decision_ms,
            **self.about(),
        }
        metrics["success"] = bool(metrics["coverage"] >= self.config.coverage_target)
        robots = [{key: plain(value) for key, value in robot.items()} for robot in metrics.pop("per_robot")]
        return {key: plain(value) for key, value in metrics.items()} | {"per_robot": robots}


def read_team(
    config: Path | None = None, *, robots: int | None = None, communication: str | None = None,
    range_m: float | None = None, starts: str | None = None, unknown_starts: bool = False,
    joint_belief: bool = False,
) -> TeamConfig:  # fmt: skip
    """Return the team that a config file's [run] table names, the options before it; of neither, one robot.

    Options that mean something to several robots only are refused where there is one.

    Raises
    ------
    BadInput
        In one line: what is wrong, and what is allowed.
    """
    with bad_input():
        past = read_config(config, {"team": (dict,)})[1].get("team", {}) if config is not None else {}
        heard = _known({"model": communication, "range_m": range_m})
        given = _known({
            "robots": robots, "starts": starts, "known_starts": False if unknown_starts else None,
            "belief": "joint" if joint_belief else None,
        })  # fmt: skip
        settings = {"robots": 1} | past | given
        if settings["robots"] == 1:
            for name, option in _OPTIONS.items():
                if name in heard | given:
                    raise BadInput(f"{option} is for several robots; give --robots 2 or more")
        if heard:
            noted = past.get("communication", {})
            if not isinstance(noted, dict):
                raise ValueError(f"[run.team] communication must be a table, got {quoted(noted)}")
            settings["communication"] = noted | heard
        team = from_mapping(TeamConfig, settings)
        if range_m is not None and team.robots > 1 and team.communication.model in ("unlimited", "none"):
            raise ValueError(
                f"--range {range_m:g} means nothing with --communication {team.communication.model}; "
                "give range, line-of-sight or walls"
            )
        return team


_OPTIONS = {
    "model": "--communication", "range_m": "--range", "starts": "--starts", "known_starts": "--unknown-starts",
    "belief": "--joint-belief",
}  # fmt: skip


def _known(given: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in given.items() if value is not None}


def refuse_bounds(names: Iterable[str]) -> None:
    """Raise ``ValueError`` for a planner that knows the map: it searches for one robot, and bounds no team."""
    for name in names:
        if name in KNOWN_MAPS:
            raise ValueError(f"{name} is the fastest way of one robot, and no bound of a team's; leave it out")


def prepare(team: TeamConfig, *, out: Path, slam: str | None = None, **asked: Any) -> TeamEpisode:
    """Check everything that can be checked, and place the robots; nothing is written.

    As :func:`training.episodes.explore.prepare`; ``start`` is the first robot's, ``agent`` drives each of them.

    Raises
    ------
    BadInput
        In one line: which option, file or name is wrong, and what to do.
    """
    with bad_input():
        files = [*FILES, LANDMARKS, EXTRAS["video"], *(name for k in range(team.robots) for name in files_of(k))]
        world, run, plan = asked_for(out=out, files=files, slam=slam, **asked)
        refuse_bounds([run["agent"]])
        if team.belief == "joint" and slam is not None and slam != JOINT_SLAM:
            # What a file has may be the default: that stands for none.
            raise ValueError(f"--joint-belief is one {JOINT_SLAM} over all robots; leave out --slam {slam}")
        if run.get("start") is not None:
            plan = plan.with_start(run["start"], clearance_m=world.robot.inscribed_radius_m)
        robots = Team(team=team, config=replace(world, coverage_target=1.0), max_steps=run["max_steps"])
        world = replace(world, slam=robots.config.slam)  # a joint belief has one of its own
        found = robots.reset(seed=run["seed"], options={"floor_plan": plan})
        explorers = tuple(make_agent(run["agent"], member) for member in robots.members)
        for k, (explorer, member) in enumerate(zip(explorers, robots.members, strict=True)):
            explorer.reset(member.belief, run["seed"] + k)
        robots.ends_covered = not any(explorer.outlives_coverage for explorer in explorers)
    return TeamEpisode(
        team=robots, agents=explorers, observations=[observation for observation, _ in found], config=world,
        run=run, out=out,
    )  # fmt: skip


def tell_goal(team: Team, robot: int, goal: Goal | None) -> None:
    """Have a robot tell the others where it goes."""
    team.members[robot].knowledge.goal = None if goal is None else np.array(goal.pose[:2], np.float64)


def run(episode: TeamEpisode, progress: Progress, witnesses: Iterable[TeamWitness] = ()) -> None:
    """Let the robots explore until all are done, the steps are used up, or Ctrl-C is pressed between two steps."""
    team, agents, observations = episode.team, episode.agents, episode.observations
    patience = math.ceil(AGENT_DONE_AFTER_S / episode.config.step_s)
    goals = [agent.goal for agent in agents]
    watching = [episode.log, *witnesses]
    idle, max_steps = 0, episode.run["max_steps"]
    for witness in watching:
        witness.take(team, goals)
    began = time.perf_counter()
    with interrupt_flag() as interrupted:
        for steps in range(1, max_steps + 1):
            actions = {}
            for k in team.active:
                agent = agents[k]
                asked = time.perf_counter()
                actions[k] = agent.act(observations[k], team.members[k].belief)
                if agent.goal is not goals[k]:
                    episode.decisions_ms.append(1e3 * (time.perf_counter() - asked))
                    goals[k] = agent.goal
                    tell_goal(team, k, agent.goal)
            outcomes = team.step(actions)
            for k, outcome in outcomes.items():
                observations[k] = outcome.observation
            for witness in watching:
                witness.take(team, goals)
            progress(coverage=team.coverage_share, time_s=team.time_s, steps=steps, max_steps=max_steps)
            idle = idle + 1 if all(done(agents[k]) for k in outcomes) else 0
            if interrupted.is_set():
                episode.end, episode.interrupted = "interrupted", True
            elif not team.active and not any(outcome.truncated for outcome in outcomes.values()):
                covered = any(outcome.info["is_success"] for outcome in outcomes.values())
                episode.end = "covered" if covered else "collision"
            elif idle >= patience and all(agents[k].ended for k in outcomes):
                statuses = {agents[k].status for k in outcomes}
                episode.end = next((word for word in _WORST_FIRST if word in statuses), min(statuses))
            elif team.active:
                continue
            break
    episode.wall_time_s = time.perf_counter() - began
