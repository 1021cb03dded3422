"""The warm start: to choose as a heuristic does, learned from what it chose and how that went on."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from training.choice_world import Teacher, make_world
from training.networks import ChoiceNetwork
from training.train_config import TrainConfig

__all__ = ["Lessons", "give_lessons", "learn"]


@dataclass(frozen=True, eq=False)
class Lessons:
    """What a teacher was shown, chose and got."""

    observations: dict[str, NDArray[Any]]  # (n, …) each
    actions: NDArray[np.int64]  # (n,)
    returns: NDArray[np.float32]  # (n,) discounted, from there on


def give_lessons(config: TrainConfig, pool: ProcessPoolExecutor) -> Lessons:
    """Return a teacher's choices in as many episodes as the configuration says, however many workers give them."""
    jobs = [(config, k) for k in range(config.imitation.episodes)]
    parts = list(pool.map(_episode, jobs, chunksize=4))
    keys = parts[0].observations
    return Lessons(
        {key: np.concatenate([part.observations[key] for part in parts]) for key in keys},
        np.concatenate([part.actions for part in parts]),
        np.concatenate([part.returns for part in parts]),
    )


def _episode(job: tuple[TrainConfig, int]) -> Lessons:
    config, number = job
    torch.set_num_threads(1)
    imitation = config.imitation
    world = make_world(config.world, number)
    teacher = Teacher(imitation.teacher, world.env)
    rng = np.random.default_rng([config.seed, number])
    observation, _ = world.reset(seed=int(rng.integers(2**31)))
    seen, actions, rewards, durations = [], [], [], []
    done = False
    while not done:
        if not observation["present"].any():
            break
        action = int(teacher())
        seen.append(observation)
        actions.append(action)
        if rng.random() < imitation.astray:
            action = int(rng.integers(observation["present"].sum()))
        observation, reward, terminated, truncated, info = world.step(action)
        rewards.append(reward)
        durations.append(info["duration_s"])
        done = terminated or truncated
    world.close()
    returns, total = np.zeros(len(rewards), np.float32), 0.0
    for k in reversed(range(len(rewards))):
        total = rewards[k] + config.ppo.gamma ** durations[k] * total
        returns[k] = total
    stacked = {key: np.stack([o[key] for o in seen]) for key in seen[0]}
    return Lessons(stacked, np.array(actions), returns)


def learn(network: ChoiceNetwork, lessons: Lessons, config: TrainConfig) -> Iterator[dict[str, float]]:
    """Train the network on lessons, epoch by epoch; a tenth of them is kept to test it on."""
    imitation = config.imitation
    rng = np.random.default_rng(config.seed)
    n = len(lessons.actions)
    kept = np.arange(n) >= n - n // 10  # the last episodes: rooms that the rest does not show
    train = np.flatnonzero(~kept)
    optimizer = torch.optim.AdamW(network.parameters(), lr=imitation.rate, weight_decay=1e-4)
    batches = -(-len(train) // imitation.batch)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, max_lr=imitation.rate, total_steps=imitation.epochs * batches
    )
    for epoch in range(imitation.epochs):
        losses = []
        for rows in np.array_split(rng.permutation(train), batches):
            loss, _ = _loss(network, lessons, rows)
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimizer.step()
            schedule.step()
            losses.append(float(loss.detach()))
        with torch.no_grad():
            parts = [_loss(network, lessons, r) for r in np.array_split(np.flatnonzero(kept), max(n // 2560, 1))]
        yield {
            "epoch": epoch + 1,
            "loss": float(np.mean(losses)),
            "test_loss": float(np.mean([float(p[0]) for p in parts])),
            "agreement": float(np.mean([p[1] for p in parts])),
        }


def _loss(network: ChoiceNetwork, lessons: Lessons, rows: NDArray[np.int64]) -> tuple[torch.Tensor, float]:
    observation = {key: torch.as_tensor(value[rows]) for key, value in lessons.observations.items()}
    present = observation["present"]
    tokens = network.tokens(observation)
    scores = network.scores(tokens).masked_fill(present < 0.5, -1e9)
    actions = torch.as_tensor(lessons.actions[rows])
    choice = nn.functional.cross_entropy(scores, actions)
    worth = nn.functional.mse_loss(network.value(tokens, present)[:, 0], torch.as_tensor(lessons.returns[rows]))
    return choice + 0.5 * worth, float((scores.argmax(dim=1) == actions).float().mean())
