"""Teams in bare rooms, and what drives them."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

import agents
from agents.base import Agent
from mecanum_env.rooms.floor_plan import FloorPlan
from mecanum_env.team.team import Team


def hall(width_m: float, height_m: float, start: tuple[float, float, float] = (1.0, 1.0, 0.0)) -> FloorPlan:
    """An empty room, its corner at the origin."""
    w, h = width_m, height_m
    walls = np.array([[0.0, 0.0, w, 0.0], [w, 0.0, w, h], [w, h, 0.0, h], [0.0, h, 0.0, 0.0]])
    free = np.ones((round(h / 0.05), round(w / 0.05)), np.bool_)
    return FloorPlan(name="hall", walls=walls, free=free, resolution=0.05, start=start)


def crew_of(team: Team, name: str, seed: int, config: Mapping | None = None) -> dict[int, Agent]:
    made, of = {}, team.config
    for member in team.members:
        agent = agents.make(name, config=config, robot=of.robot, lidar=of.lidar, step_s=of.step_s)
        agent.reset(member.belief, seed)
        made[member.number] = agent
    return made


def run(
    team: Team, choose: Callable[[int, Mapping, object], NDArray[np.float32]], observed: list, steps: int,
    announce: Callable[[int], object] = lambda k: None,
) -> list[np.ndarray]:  # fmt: skip
    """Step a team, whether or not anything is left to see; return the actions of each step ``(robots, 3)``.

    Beyond its ``coverage_target`` each step takes ten times as long: it sums up the episode.
    """
    observations = {k: observation for k, (observation, _) in enumerate(observed)}
    sent = []
    for _ in range(steps):
        team.active = list(range(len(team.members)))
        actions = {}
        for k in team.active:
            member = team.members[k]
            actions[k] = choose(k, observations[k], member.belief)
            member.knowledge.goal = announce(k)
        sent.append(np.array(list(actions.values())))
        for k, outcome in team.step(actions).items():
            observations[k] = outcome.observation
    return sent


def explore(team: Team, name: str, *, seed: int, steps: int, **options: object) -> list[np.ndarray]:
    """Have a team explore; return its actions."""
    observed = team.reset(seed=seed, options=options or None)
    crew = crew_of(team, name, seed)

    def goal(k: int) -> object:
        found = crew[k].goal
        return None if found is None else found.pose[:2].copy()

    return run(team, lambda k, seen, belief: crew[k].act(seen, belief), observed, steps, goal)


def touched(team: Team) -> int:
    """Return how often a robot touched another."""
    return sum(member.truth.world.robot_collisions for member in team.members)
