"""Trials of a policy of ``ppo-frontier`` on validation seeds, in processes that do not wait for PyTorch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.learned.choice_network import ChoiceEnsemble
from training.learning.choice_world import Families, make_world
from training.learning.config import FIRST_VALIDATION_SEED, TrainConfig, WorldConfig
from training.runs.campaign import Pool

__all__ = ["Trial", "Weights", "evaluate", "trials_in_full", "trials_of"]

Weights = dict[str, NDArray[np.float32]]


@dataclass(frozen=True)
class Trial:
    """An episode on a validation seed."""

    family: str
    make: Callable[[], Families]
    options: dict[str, Any]
    limit_s: float


def trials_in_full(config: TrainConfig) -> list[Trial]:
    """Return the trials in the whole environment: every family, with every noise."""
    world = config.world
    whole = [partial(make_world, replace(world, noises=(noise,))) for noise in world.noises]
    return [trial for make in whole for trial in trials_of(world, make, config.evaluation.episodes, {})]


def trials_of(
    world: WorldConfig, make: Callable[[], Families], episodes: int, options: dict[str, Any]
) -> list[Trial]:
    """Return the trials of so many episodes in each family."""
    return [
        Trial(name, make, {"rooms": name, "room_seed": FIRST_VALIDATION_SEED + k} | options, world.time_limit_s)
        for name in dict.fromkeys(world.rooms)
        for k in range(episodes)
    ]


def evaluate(weights: Weights, heads: int, trials: Sequence[Trial], pool: Pool) -> dict[str, Any]:
    """Return how long a policy, chance aside, takes to 95 % on validation seeds; unreached counts as the limit."""
    ends = list(pool.map(_try, [(weights, heads, trial) for trial in trials]))
    times: dict[str, list[float]] = {trial.family: [] for trial in trials}
    for trial, (time_s, _) in zip(trials, ends, strict=True):
        times[trial.family].append(time_s)
    means = {name: float(np.mean(values)) for name, values in times.items()}
    return {
        "time_to_95_s": float(np.mean(list(means.values()))),
        "collisions": sum(collisions for _, collisions in ends),
        **means,
    }


def _try(job: tuple[Weights, int, Trial]) -> tuple[float, int]:
    """Return the time to 95 % [s] and the collisions of one episode."""
    weights, heads, trial = job
    network = ChoiceEnsemble(weights, heads=heads)
    env = trial.make()
    env.reset(options=trial.options)
    while True:
        k = int(np.argmax(network.scores(env.env.agent.described[0]))) if env.action_masks().sum() > 1 else 0
        *_, terminated, truncated, info = env.step(k)
        if terminated or truncated:
            return info["time_s"] if info["is_success"] else trial.limit_s, info["collisions"]
