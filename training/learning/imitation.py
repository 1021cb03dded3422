"""The warm start: to choose as a teacher does, learned from what each candidate would have cost.

The teacher is ``hindsight``, which prices every candidate by the truth (``training/learning/hindsight.py``), or
``tour``, which prices them by how much later all would be seen by the best tour that begins there, or another
heuristic, whose choice costs nothing and every other one alike. In the first round a heuristic drives; in later
ones what was learned from the rounds before, so that it learns from the states that it gets into (DAgger: Ross,
Gordon and Bagnell, AISTATS 2011; with costs of all actions, AggreVaTe: Ross and Bagnell, 2014).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from agents.learned import choice_network
from agents.learned.choice import CANDIDATE, TOUR_LOSS_M
from slam.formats import replacing
from training.learning.choice_world import Families, Teacher, make_world, mirrored
from training.learning.config import TrainConfig
from training.learning.networks import ChoiceNetwork

__all__ = ["Lessons", "give_lessons", "learn"]

Weights = dict[str, NDArray[np.float32]]

_METRES = 5.0  # of price, for one unit of loss


@dataclass(frozen=True, eq=False)
class Lessons:
    """What was shown, what each candidate would have cost, and how it went on."""

    observations: dict[str, NDArray[Any]]  # (n, …) each
    prices: NDArray[np.float32]  # (n, K) weighted metres; inf where there is no candidate
    returns: NDArray[np.float32]  # (n,) discounted, from there on

    @classmethod
    def joined(cls, parts: Sequence[Lessons]) -> Lessons:
        """Return several as one."""
        keys = parts[0].observations
        return cls(
            {key: np.concatenate([part.observations[key] for part in parts]) for key in keys},
            *(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)[1:]),
        )

    def save(self, path: Path) -> None:
        """Write as ``.npz``, whole or not at all."""
        arrays: Any = {"prices": self.prices, "returns": self.returns} | self.observations
        with replacing(path) as new:
            np.savez_compressed(new, **arrays)

    @classmethod
    def load(cls, path: Path) -> Lessons:
        """Read what :meth:`save` wrote."""
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files}
        return cls(prices=arrays.pop("prices"), returns=arrays.pop("returns"), observations=arrays)


def give_lessons(
    config: TrainConfig, pool: ProcessPoolExecutor, *, number: int = 0, weights: Weights | None = None
) -> Lessons:
    """Return the lessons of a round, the same however many workers give them.

    Parameters
    ----------
    config
        Says how many episodes, and who teaches.
    pool
        The workers.
    number
        Of the round, from 0.
    weights
        Of the network that drives; without, a heuristic does.
    """
    episodes = range(number * config.imitation.episodes, (number + 1) * config.imitation.episodes)
    return Lessons.joined(list(pool.map(_episode, [(config, k, weights) for k in episodes], chunksize=4)))


def _episode(job: tuple[TrainConfig, int, Weights | None]) -> Lessons:
    config, number, weights = job
    torch.set_num_threads(1)
    imitation = config.imitation
    world = make_world(config.world, number)
    heuristic = Teacher("tour" if imitation.teacher == "hindsight" else imitation.teacher, world.whole)
    network = None if weights is None else choice_network.ChoiceNetwork(weights, heads=config.heads)
    rng = np.random.default_rng([config.seed, number])
    observation, _ = world.reset(seed=int(rng.integers(2**31)))
    heuristic.begin()
    seen, prices, rewards, durations = [], [], [], []
    done = False
    while not done and observation["present"].any():
        asked = network is None or imitation.teacher != "hindsight"
        wanted = int(heuristic()) if asked else -1
        seen.append(observation)
        prices.append(_prices(world, observation, wanted, imitation.teacher))
        action = wanted if network is None else int(np.argmax(network.scores(world.env.agent.described[0])))
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
    return Lessons({key: np.stack([o[key] for o in seen]) for key in seen[0]}, np.array(prices), returns)


def _prices(
    world: Families, observation: dict[str, NDArray[Any]], wanted: int, teacher: str
) -> NDArray[np.float32]:
    """Return each action's price ``(K,)``, inf where it stands for no candidate."""
    masks = world.action_masks()
    prices = np.full(len(masks), np.inf, dtype=np.float32)
    if teacher == "hindsight":
        prices[masks] = world.prices()
    elif teacher == "tour":
        prices[masks] = TOUR_LOSS_M * observation["candidates"][masks, CANDIDATE.index("tour_loss")]
    else:
        prices[masks] = _METRES
        prices[wanted] = 0.0
    return prices


def learn(network: ChoiceNetwork, lessons: Lessons, config: TrainConfig) -> Iterator[dict[str, float]]:
    """Train the network on lessons, epoch by epoch; a tenth of them is kept to test it on."""
    imitation = config.imitation
    rng = np.random.default_rng(config.seed)
    n = len(lessons.prices)
    kept = np.arange(n) >= n - n // 10  # the last episodes
    train = np.flatnonzero(~kept)
    optimizer = torch.optim.AdamW(network.parameters(), lr=imitation.rate, weight_decay=1e-2)
    batches = -(-len(train) // imitation.batch)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, max_lr=imitation.rate, total_steps=imitation.epochs * batches
    )
    for epoch in range(imitation.epochs):
        losses = []
        for rows in np.array_split(rng.permutation(train), batches):
            loss, _ = _loss(network, lessons, rows, imitation.temperature_m, mirror=rng.random(len(rows)) < 0.5)
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimizer.step()
            schedule.step()
            losses.append(float(loss.detach()))
        with torch.no_grad():
            tests = np.array_split(np.flatnonzero(kept), max(n // 2560, 1))
            parts = [
                _loss(network, lessons, r, imitation.temperature_m, mirror=np.zeros(len(r), np.bool_))
                for r in tests
            ]
        yield {
            "epoch": epoch + 1,
            "loss": float(np.mean(losses)),
            "test_loss": float(np.mean([float(p[0]) for p in parts])),
            "regret_m": float(np.mean([p[1] for p in parts])),
        }


def _loss(
    network: ChoiceNetwork,
    lessons: Lessons,
    rows: NDArray[np.int64],
    temperature_m: float,
    *,
    mirror: NDArray[np.bool_],
) -> tuple[torch.Tensor, float]:
    """Return the loss, and what the choice with the highest score costs above the cheapest."""
    shown = mirrored({key: value[rows] for key, value in lessons.observations.items()}, mirror)
    observation = {key: torch.as_tensor(value) for key, value in shown.items()}
    prices = torch.as_tensor(lessons.prices[rows])
    present = torch.isfinite(prices)
    above = torch.where(present, prices - prices.amin(dim=1, keepdim=True), 0.0)
    tokens = network.tokens(observation)
    scores = network.scores(tokens).masked_fill(~present, -1e9)
    # What choosing by these scores costs on average: least where it is the choice of the lowest mean price. With
    # a temperature, less the choice's entropy: least at chances of exp(−price / temperature).
    chances, log_chances = scores.softmax(dim=1), scores.log_softmax(dim=1)
    choice = (chances * (above + temperature_m * log_chances)).sum(dim=1).mean() / _METRES
    returns = torch.as_tensor(lessons.returns[rows])
    worth = nn.functional.mse_loss(network.value(tokens, observation["present"])[:, 0], returns)
    best = scores.argmax(dim=1, keepdim=True)
    return choice + 0.5 * worth, float(above.gather(1, best).mean())
