"""What a step takes against the number of robots: ``mecanum study team-cost``."""

from __future__ import annotations

import json
import statistics
import time
from typing import Annotated, Any

import numpy as np
import typer

from mecanum_env.team.team import Team
from training.episodes.explore import make_agent
from training.episodes.room_pictures import parse_seeds
from training.episodes.team import tell_goal
from training.figures.tables import text_table
from training.runs.errors import bad_input
from training.runs.options import Json, Seeds
from training.runs.typed import whole_numbers
from training.studies.exploring import AGENT

__all__ = ["measure", "study"]

_WARM_UP = 20  # steps that are not counted: every buffer reaches its size


def measure(team: Team, seeds: list[int], steps: int) -> dict[str, float]:
    """Return median and mean [ms] of a team's step, decisions left out, over episodes of so many steps."""
    took: list[float] = []
    for seed in seeds:
        with bad_input():  # whether there is room for so many, the rooms of each seed tell
            observations = [observation for observation, _ in team.reset(seed=seed)]
        agents = [make_agent(AGENT, member) for member in team.members]
        for agent, member in zip(agents, team.members, strict=True):
            agent.reset(member.belief, seed)
        for step in range(steps):
            actions = {}
            for k in team.active:
                actions[k] = agents[k].act(observations[k], team.members[k].belief)
                tell_goal(team, k, agents[k].goal)
            began = time.perf_counter()
            outcomes = team.step(actions)
            if step >= _WARM_UP:
                took.append(1e3 * (time.perf_counter() - began))
            for k, outcome in outcomes.items():
                observations[k] = outcome.observation
            if not team.active:
                break
    return {"median_ms": statistics.median(took), "mean_ms": float(np.mean(took))}


def study(
    seeds: Seeds = "0:3",
    robots: Annotated[str, typer.Option(help="How many robots, separated by commas.")] = "1,2,3,5,8",
    rooms: Annotated[str, typer.Option(help="Generator of the rooms.")] = "apartment",
    steps: Annotated[int, typer.Option(min=_WARM_UP + 1, max=1_000_000, help="Of each episode.")] = 250,
    as_json: Json = False,
) -> None:
    """Measure a step of a team that explores, resets and decisions left out."""
    with bad_input():
        chosen, counts = parse_seeds(seeds), whole_numbers("--robots", robots, low=1, high=64)
        teams = {
            count: Team(count, rooms=rooms, config={"coverage_target": 1.0}, max_steps=steps) for count in counts
        }
    for team in teams.values():
        measure(team, chosen[:1], _WARM_UP + 1)  # kernels are compiled
    found: dict[int, dict[str, Any]] = {count: measure(team, chosen, steps) for count, team in teams.items()}
    if as_json:
        print(json.dumps({"rooms": rooms, "seeds": seeds, "steps": steps, "robots": found}))
        return
    lines = [
        [str(n), f"{row['median_ms']:.2f}", f"{row['mean_ms']:.2f}", f"{row['mean_ms'] / n:.2f}"]
        for n, row in found.items()
    ]
    print(text_table(["robots", "median ms", "mean ms", "mean ms a robot"], lines))
