"""The network of ``learned-tour`` in PyTorch; ``agents.learned.station_network`` is the same in NumPy."""

from __future__ import annotations

from typing import cast

import torch
from safetensors.numpy import load
from torch import Tensor, nn

from agents.learned.choice_network import apart
from agents.learned.station_network import PLANES

__all__ = ["StationNetwork", "read_network"]

_WIDTHS = 24, 40, 56  # channels at 4, 8, and 16 and 32 m a pixel
_OUT = 32
_HIDDEN = 48


class Block(nn.Module):
    """Two convolutions beside a way that goes round them (He et al., 2016)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(inputs, outputs, 3, padding=1)
        self.second = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.skip = nn.Conv2d(inputs, outputs, 1) if inputs != outputs else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """Return ``(b, outputs, n, m)`` of ``(b, inputs, n, m)``."""
        return torch.relu(self.skip(x) + self.second(torch.relu(self.first(x))))


class StationNetwork(nn.Module):
    """Says of each opening what it is expected to cost, and of each pixel how much of it is free."""

    def __init__(self) -> None:
        super().__init__()
        near, mid, far = _WIDTHS
        self.down_0, self.down_1 = Block(PLANES, near), Block(near, mid)
        self.down_2, self.down_3 = Block(mid, far), Block(far, far)
        self.up_2, self.up_1, self.up_0 = Block(2 * far, far), Block(far + mid, mid), Block(mid + near, _OUT)
        self.free = nn.Conv2d(_OUT, 4, 1)
        self.score_1 = nn.Linear(2 * _OUT + far + 3, _HIDDEN)
        self.score_2, self.score_3 = nn.Linear(_HIDDEN, _HIDDEN), nn.Linear(_HIDDEN, 1)
        self.loss_share = nn.Parameter(torch.tensor(0.5))

    def forward(self, planes: Tensor, targets: Tensor, hops: Tensor, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Return each opening's score ``(b, c)``, 20 m a unit, and the log odds of free quarters ``(b, 4, n, n)``.

        Parameters
        ----------
        planes
            ``(b, PLANES, n, n)``.
        targets, hops
            ``(b, c, 2)`` pixels.
        numbers
            ``(b, c, 3)`` of :func:`agents.learned.station_network.opening_numbers`.
        """
        x0 = self.down_0(planes)
        x1 = self.down_1(_halved(x0))
        x2 = self.down_2(_halved(x1))
        x3 = self.down_3(_halved(x2))
        y2 = self.up_2(torch.cat([_doubled(x3), x2], dim=1))
        y1 = self.up_1(torch.cat([_doubled(y2), x1], dim=1))
        y0 = self.up_0(torch.cat([_doubled(y1), x0], dim=1))
        own = torch.arange(len(planes))[:, None]
        whole = x3.mean(dim=(2, 3))[:, None].expand(-1, targets.shape[1], -1)
        seen = [y0[own, :, at[..., 0], at[..., 1]] for at in (targets, hops)]
        rows = torch.cat([*seen, whole, numbers], dim=-1)
        rows = torch.relu(self.score_2(torch.relu(self.score_1(rows))))
        score = self.loss_share * numbers[..., 0] + 0.5 * self.score_3(rows)[..., 0]
        return cast("Tensor", score), cast("Tensor", self.free(y0))


def read_network(weights: bytes) -> StationNetwork:
    """Return the network of a file of weights, the first of several.

    What only training needs is not in it, and is drawn at random.
    """
    network = StationNetwork()
    first, *_ = apart(load(weights))
    network.load_state_dict({name: torch.tensor(value).float() for name, value in first.items()}, strict=False)
    return network


def _halved(x: Tensor) -> Tensor:
    return nn.functional.max_pool2d(x, 2)


def _doubled(x: Tensor) -> Tensor:
    return nn.functional.interpolate(x, scale_factor=2, mode="nearest")
