"""The feature extractor of the end-to-end policy, for the observation of ``mecanum_env/Explore-v0``."""

from __future__ import annotations

from typing import cast

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

__all__ = ["DriveExtractor"]

_LEAST = 1e-12  # below any variance that a belief has


class DriveExtractor(BaseFeaturesExtractor):
    """Two maps by convolution, the scan by convolution around the circle, landmarks as a set, and numbers.

    Parameters
    ----------
    space
        The observation space.
    uncertainty
        Whether the belief's covariance and its landmarks are looked at; without, for an ablation.
    width
        Of what each map is summed up in.
    """

    def __init__(self, space: spaces.Dict, *, uncertainty: bool = True, width: int = 128) -> None:
        super().__init__(space, 2 * width + 64 + 32 + 32)
        self.uncertainty = uncertainty
        self.local, self.overview = _map_network(width), _map_network(width)
        beams = cast("tuple[int]", space["scan"].shape)[0]
        self.scan = nn.Sequential(
            nn.Conv1d(1, 8, 7, stride=3, padding=3, padding_mode="circular"), nn.ReLU(),
            nn.Conv1d(8, 16, 5, stride=3, padding=2, padding_mode="circular"), nn.ReLU(),
            nn.Flatten(),
        )  # fmt: skip
        with torch.no_grad():
            flat = self.scan(torch.zeros(1, 1, beams)).shape[1]
        self.scan_out = nn.Linear(flat, 64)
        self.landmark = nn.Sequential(nn.Linear(5, 32), nn.ReLU(), nn.Linear(32, 32))
        self.numbers = nn.Sequential(nn.Linear(4 + 3 + 2 + 3, 32), nn.ReLU(), nn.Linear(32, 32), nn.ReLU())

    def forward(self, observation: dict[str, Tensor]) -> Tensor:
        """Return the features ``(b, features)`` of a batch of observations."""
        cov = observation["pose_cov"][:, [0, 3, 5]].clamp(min=_LEAST).log10() / 4.0 + 1.0
        landmarks = self._landmarks(observation["landmarks"])
        if not self.uncertainty:
            cov, landmarks = torch.zeros_like(cov), torch.zeros_like(landmarks)
        numbers = torch.cat([observation["pose"], observation["twist"], observation["progress"], cov], dim=1)
        parts = [
            self.local(observation["map_local"]),
            self.overview(observation["map_global"]),
            torch.relu(self.scan_out(self.scan(observation["scan"][:, None]))),
            landmarks,
            self.numbers(numbers),
        ]
        return torch.cat(parts, dim=1)

    def _landmarks(self, rows: Tensor) -> Tensor:
        """Return the set summed up ``(b, 32)``: the most of each of 32 numbers over those present."""
        present = rows[..., 5:]
        spread = rows[..., 2:5:2].clamp(min=_LEAST).log10() / 4.0 + 1.0
        each = self.landmark(torch.cat([rows[..., :2] / 8.0, spread, present], dim=2))
        return torch.relu((each * present + (present - 1.0) * 1e3).amax(dim=1))


def _map_network(width: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(3, 16, 5, stride=2, padding=2), nn.ReLU(),
        nn.Conv2d(16, 32, 3, stride=2, padding=1), nn.ReLU(),
        nn.Conv2d(32, 32, 3, stride=2, padding=1), nn.ReLU(),
        nn.Flatten(),
        nn.Linear(32 * 8 * 8, width), nn.ReLU(),
    )  # fmt: skip
