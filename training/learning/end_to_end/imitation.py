"""What the end-to-end policy learns from lessons: of maps prices and goals, of situations twists."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from agents.learned.drive_network import sectors
from training.learning.end_to_end.lessons import LOG_PRICE, NO_WAY
from training.learning.end_to_end.networks import ControlNetwork, PlanNetwork, shortest, step_prices

__all__ = ["Lessons", "control_batch", "learn_control", "learn_maps", "map_losses"]

Lessons = Mapping[str, NDArray[Any]]

_GOAL_WEIGHT = 5.0  # of a pixel that is a goal: few are
_WAYS = 4
_MIRRORED_NUMBERS = [*range(1, 20, 2), 33, 34]


def learn_maps(
    network: PlanNetwork, lessons: Lessons, *, steps: int, batch: int, rate: float, rng: np.random.Generator
) -> Iterator[dict[str, float]]:
    """Train the map network; what is said every hundred steps are the means of the losses since."""

    def losses(step: int) -> dict[str, Tensor]:
        rows = np.sort(rng.integers(len(lessons["map"]), size=batch))
        found = map_losses(network, lessons, rows, mirrored=step % 2 == 1)
        found["total"] = found["price"] + 10.0 * found["goal"] + found["travel"]
        return found

    return _descend(network, losses, steps=steps, rate=rate, every=100)


def map_losses(
    network: PlanNetwork, lessons: Lessons, rows: NDArray[np.int64], *, mirrored: bool
) -> dict[str, Tensor]:
    """Return the losses on some lessons, as they are or mirrored."""
    maps, price, travel = (lessons[key][rows] for key in ("map", "price", "travel"))
    goal, start = np.unpackbits(lessons["goal"][rows], axis=-1), lessons["start"][rows].copy()
    if mirrored:
        maps, price, travel, goal = (values[..., ::-1] for values in (maps, price, travel, goal))
        start[:, 1] = maps.shape[-1] - 1 - start[:, 1]
    said, odds = network(_tensor(maps))
    # Distances take longer than all the rest: they are asked of every fourth.
    ways, start, told = _tensor(travel[::_WAYS].astype(np.float32)), start[::_WAYS], said[::_WAYS]
    ends = torch.full(ways.shape, 1e6)
    ends[np.arange(len(start)), start[:, 0], start[:, 1]] = 0.0
    reached = ways < 0.9 * NO_WAY
    error = torch.log1p(shortest(step_prices(told), ends)[reached].clamp(max=1e5)) - torch.log1p(ways[reached])
    return {
        "price": functional.smooth_l1_loss(said, _tensor(price.astype(np.float32)) / LOG_PRICE, beta=0.3),
        "goal": _goal_loss(odds, goal),
        "travel": functional.smooth_l1_loss(error, torch.zeros_like(error), beta=0.2),
    }


def learn_control(
    network: ControlNetwork, lessons: Lessons, *, steps: int, batch: int, rate: float, rng: np.random.Generator
) -> Iterator[dict[str, float]]:
    """Train the control network to send what the teacher would; every thousand steps the mean loss is said."""

    def losses(step: int) -> dict[str, Tensor]:
        rows = np.sort(rng.integers(len(lessons["wanted"]), size=batch))
        *inputs, wanted = control_batch(lessons, rows, mirrored=step % 2 == 1)
        return {"total": functional.smooth_l1_loss(network(*inputs), wanted, beta=0.1)}

    return _descend(network, losses, steps=steps, rate=rate, every=1000)


def control_batch(lessons: Lessons, rows: NDArray[np.int64], *, mirrored: bool) -> tuple[Tensor, ...]:
    """Return scans in sectors, landmarks, numbers and the wanted twists of some lessons, mirrored or not."""
    scan, landmarks = lessons["scan"][rows], lessons["landmarks"][rows].astype(np.float32)
    numbers, wanted = lessons["numbers"][rows].copy(), lessons["wanted"][rows].copy()
    if mirrored:
        # The first beam looks backwards, and so it does mirrored.
        scan = np.roll(scan[:, ::-1], 1, axis=1)
        landmarks[..., 1] *= -1.0
        numbers[:, _MIRRORED_NUMBERS] *= -1.0
        wanted[:, 1:] *= -1.0
    return _tensor(sectors(scan.astype(np.float32))), _tensor(landmarks), _tensor(numbers), _tensor(wanted)


def _goal_loss(logit: Tensor, goal: NDArray[np.uint8]) -> Tensor:
    weight = torch.tensor(_GOAL_WEIGHT)
    return functional.binary_cross_entropy_with_logits(logit, _tensor(goal.astype(np.float32)), pos_weight=weight)


def _descend(
    network: nn.Module, losses: Callable[[int], dict[str, Tensor]], *, steps: int, rate: float, every: int
) -> Iterator[dict[str, float]]:
    """Go down the ``total`` of each step's losses; say their means every so many steps."""
    optimizer = torch.optim.AdamW(network.parameters(), lr=rate, weight_decay=1e-4)
    seen = []
    for step in range(steps):
        # Warm up over 50 steps, then fall to a hundredth along a cosine.
        share = 0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * step / steps))
        for group in optimizer.param_groups:
            group["lr"] = rate * min(1.0, (step + 1) / 50) * share
        found = losses(step)
        optimizer.zero_grad()
        found["total"].backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        seen.append([float(value.detach()) for value in found.values()])
        if (step + 1) % every == 0 or step + 1 == steps:
            yield {"step": step + 1} | dict(zip(found, np.mean(seen, axis=0).tolist(), strict=True))
            seen = []


def _tensor(values: NDArray[Any]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values))
