"""The end-to-end policy's network in PyTorch; ``agents/learned/drive_network.py`` is the same in NumPy."""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd import Function
from torch.nn import functional

from agents.learned.drive_memory import CELL_M, CHANNELS, LOG_PRICES
from agents.learned.drive_network import NUMBERS, SECTORS
from agents.learned.drive_plan import EDGES, distances, gradient

__all__ = ["ControlNetwork", "PlanNetwork", "shortest", "step_prices"]

_OUTSIDE = 1e6  # price beyond the map


class _Shortest(Function):
    """Distances by the planning layer, with their gradient."""

    @staticmethod
    def forward(ctx: Any, prices: Tensor, goal: Tensor) -> Tensor:
        p, g = prices.detach().numpy(), goal.detach().numpy()
        found = [distances(p[i], g[i]) for i in range(len(p))]
        ctx.found = found
        return torch.from_numpy(np.stack([best for best, _ in found]))

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, Tensor]:
        flow = upstream.contiguous().numpy()
        parts = [gradient(best, parent, flow[i]) for i, (best, parent) in enumerate(ctx.found)]
        by_price, by_goal = (torch.from_numpy(np.stack(part)) for part in zip(*parts, strict=True))
        return by_price, by_goal


def shortest(prices: Tensor, goal: Tensor) -> Tensor:
    """Return the distances ``(b, n, m)`` of :mod:`agents.learned.drive_plan` for a batch."""
    return cast("Tensor", _Shortest.apply(prices, goal))  # type: ignore[no-untyped-call]


def step_prices(logs: Tensor) -> Tensor:
    """Return the prices of the steps ``(b, 4, n, m)``, of log prices a metre at the pixels ``(b, n, m)``.

    As :func:`agents.learned.drive_plan.node_prices` has them.
    """
    price = torch.exp(logs.clamp(*LOG_PRICES))
    rows, cols = price.shape[1:]
    padded = functional.pad(price, (1, 1, 0, 1), value=_OUTSIDE)
    steps = []
    for row, col in EDGES:
        there = padded[:, row : row + rows, col + 1 : col + 1 + cols]
        steps.append(0.5 * CELL_M * math.hypot(row, col) * (price + there))
    return torch.stack(steps, dim=1)


class PlanNetwork(nn.Module):
    """What the map says of each pixel: the log price of a metre there, and the log odds of a goal."""

    def __init__(self) -> None:
        super().__init__()
        width = 8
        self.map = nn.Sequential(
            nn.Conv2d(CHANNELS, width, 5, padding=2), nn.ReLU(),
            nn.Conv2d(width, width, 3, padding=1), nn.ReLU(),
            nn.Conv2d(width, width, 3, padding=2, dilation=2), nn.ReLU(),
            nn.Conv2d(width, width, 3, padding=4, dilation=4), nn.ReLU(),
            nn.Conv2d(width, 2, 1),
        )  # fmt: skip

    def forward(self, maps: Tensor) -> tuple[Tensor, Tensor]:
        """Return prices ``(b, n, m)`` and goals, as logarithms, of maps ``(b, CHANNELS, n, m)`` of bytes."""
        # Twice as fast as the usual order on processors.
        said = self.map((maps.float() / 128.0 - 1.0).contiguous(memory_format=torch.channels_last))
        return said[:, 0], said[:, 1]


class ControlNetwork(nn.Module):
    """The twist, from the scan in sectors, the landmarks as a set, and the way among the other numbers."""

    def __init__(self, *, out: int = 3) -> None:
        super().__init__()
        width = 128
        self.scan = nn.Sequential(
            nn.Conv1d(1, 8, 5, stride=2, padding=2, padding_mode="circular"), nn.ReLU(),
            nn.Conv1d(8, 16, 5, stride=2, padding=2, padding_mode="circular"), nn.ReLU(),
        )  # fmt: skip
        self.landmark = nn.Sequential(nn.Linear(5, 16), nn.ReLU(), nn.Linear(16, 16))
        self.head = nn.Sequential(
            nn.Linear(16 * SECTORS // 4 + 16 + NUMBERS, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(),
            nn.Linear(width, out),
        )  # fmt: skip

    def forward(self, scan: Tensor, landmarks: Tensor, numbers: Tensor) -> Tensor:
        """Return the twists ``(b, 3)`` as fractions of the limits, before they are cut off at ±1."""
        present = landmarks[..., 4:]
        each = torch.relu((self.landmark(landmarks) * present + (present - 1.0) * 1e3).amax(dim=1))
        return cast("Tensor", self.head(torch.cat([self.scan(scan[:, None]).flatten(1), each, numbers], dim=1)))
