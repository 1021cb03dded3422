"""Nearest-frontier explores one room: what the studies that ask of errors in rooms have in common."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from mecanum_env.env import ExploreEnv
from training.episodes.explore import make_agent

__all__ = ["AGENT", "exploring"]

AGENT = "nearest-frontier"


def exploring(
    env: ExploreEnv, *, seed: int, steps: int, config: Mapping[str, Any] | None = None
) -> Iterator[tuple[dict[str, Any], int]]:
    """Explore until the robot is stopped, has nothing left to do, or has taken ``steps``.

    Yields
    ------
    tuple
        After each step its ``info``, and for how many steps the agent has had no goal; more than 20 end it.
    """
    agent = make_agent(AGENT, env, config=config)
    observation, _ = env.reset(seed=seed)
    agent.reset(env.belief, seed=seed)
    idle = 0
    for _ in range(steps):
        observation, _, terminated, _, info = env.step(agent.act(observation, env.belief))
        idle = idle + 1 if agent.goal is None else 0
        yield info, idle
        if terminated or idle > 20:
            break
