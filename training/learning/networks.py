"""Networks of the trained policies, in PyTorch; ``agents/`` computes the same without it."""

from __future__ import annotations

import io
import math
import pickle
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule
from torch import Tensor, nn

from agents.learned.choice import CANDIDATE, STATE
from slam.files import quoted

__all__ = ["ChoiceExtractor", "ChoiceNetwork", "ChoicePolicy", "read_zip"]

_NOWHERE = -1e9
_INSIDE = "features_extractor.network."  # where the network is among the parameters of ChoicePolicy


class Layer(nn.Module):
    """Attention among the candidates, weaker the farther they lie apart, then each for itself."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm_1, self.norm_2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.qkv, self.out = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.up, self.down = nn.Linear(width, 2 * width), nn.Linear(2 * width, width)
        self.reach = nn.Parameter(torch.linspace(-2.0, 2.0, heads))

    def forward(self, x: Tensor, distances: Tensor, absent: Tensor) -> Tensor:
        """Return the tokens ``(b, k, width)`` after attention over those that are not ``absent`` ``(b, k)``."""
        b, k, width = x.shape
        q, key, v = self.qkv(self.norm_1(x)).reshape(b, k, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        score = q @ key.transpose(-1, -2) / math.sqrt(width // self.heads)
        score = score - nn.functional.softplus(self.reach)[:, None, None] * distances[:, None]
        score = score.masked_fill(absent[:, None, None], _NOWHERE)
        mixed = (score.softmax(dim=-1) @ v).transpose(1, 2).reshape(b, k, width)
        x = x + self.out(mixed)
        return cast("Tensor", x + self.down(torch.relu(self.up(self.norm_2(x)))))


class ChoiceNetwork(nn.Module):
    """Scores candidates, whatever their order and number, and says what the whole choice is worth.

    ``features``, ``patch`` and ``state`` count numbers: a candidate's row, its patch, the choice as a whole.
    """

    def __init__(
        self, features: int, patch: int, state: int, *, width: int = 64, heads: int = 4, layers: int = 2
    ) -> None:
        super().__init__()
        self.width = width
        self.patch_1, self.patch_2 = nn.Linear(patch, 2 * width), nn.Linear(2 * width, width)
        self.row = nn.Linear(features, width)
        self.state = nn.Linear(state, width)
        self.token = nn.Linear(width, width)
        self.layers = nn.ModuleList(Layer(width, heads) for _ in range(layers))
        self.norm = nn.LayerNorm(width)
        self.score = nn.Linear(width, 1)
        self.value_1, self.value_2 = nn.Linear(2 * width, width), nn.Linear(width, 1)
        nn.init.zeros_(self.score.weight)

    def ignore_uncertainty(self) -> None:
        """Begin with no regard to covariance and landmarks: learned while these are 0, it is not upset later."""
        with torch.no_grad():
            for linear, names, ignored in (
                (self.row, CANDIDATE, ("corners", "walls", "sigma_left")),
                (self.state, STATE, ("sigma_m", "sigma_rad")),
            ):
                linear.weight[:, [names.index(name) for name in ignored]] = 0.0

    def tokens(self, observation: dict[str, Tensor]) -> Tensor:
        """Return the candidates after attention ``(b, k, width)``."""
        present = observation["present"] > 0.5
        absent = ~present
        # Of the candidates that there are alone: most of the time goes into these two.
        patches = observation["patches"][present].flatten(1).float() / 255.0
        seen = torch.zeros(*present.shape, self.width, device=patches.device)
        seen[present] = self.patch_2(torch.relu(self.patch_1(patches)))
        x = self.row(observation["candidates"]) + seen + self.state(observation["state"])[:, None]
        x = self.token(torch.relu(x))
        for layer in self.layers:
            x = layer(x, observation["distances"], absent)
        return cast("Tensor", self.norm(x))

    def scores(self, tokens: Tensor) -> Tensor:
        """Return each candidate's score ``(b, k)``."""
        return cast("Tensor", self.score(tokens)[..., 0])

    def value(self, tokens: Tensor, present: Tensor) -> Tensor:
        """Return the value ``(b, 1)``."""
        weight = present[..., None]
        mean = (tokens * weight).sum(dim=1) / weight.sum(dim=1).clamp(min=1.0)
        most = (tokens + (weight - 1.0) * 1e3).amax(dim=1).clamp(min=-10.0)
        return cast("Tensor", self.value_2(torch.relu(self.value_1(torch.cat([mean, most], dim=1)))))


class ChoiceExtractor(BaseFeaturesExtractor):
    """The network's trunk as stable-baselines3 wants it: one row of features an observation."""

    def __init__(self, space: spaces.Dict, **network: Any) -> None:
        k, features = cast("tuple[int, int]", space["candidates"].shape)
        patch = int(np.prod(cast("tuple[int, ...]", space["patches"].shape)[1:]))
        state = cast("tuple[int]", space["state"].shape)[0]
        made = ChoiceNetwork(features, patch, state, **network)
        super().__init__(space, k * made.width + k)
        self.network = made

    def forward(self, observation: dict[str, Tensor]) -> Tensor:
        """Return tokens and presence, flattened ``(b, k · width + k)``."""
        tokens = self.network.tokens(observation)
        return torch.cat([tokens.flatten(1), observation["present"]], dim=1)


class _Head(nn.Module):
    """A head of the network, on the features."""

    def __init__(self, network: ChoiceNetwork, candidates: int, *, value: bool) -> None:
        super().__init__()
        # In a list, so that the parameters are the trunk's and are not counted twice.
        self._network, self._k, self._value = [network], candidates, value

    def forward(self, features: Tensor) -> Tensor:
        network, present = self._network[0], features[:, -self._k :]
        tokens = features[:, : -self._k].reshape(-1, self._k, network.width)
        return network.value(tokens, present) if self._value else network.scores(tokens)


class ChoicePolicy(MaskableActorCriticPolicy):
    """:class:`ChoiceNetwork` as the policy of ``MaskablePPO``."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        settings: dict[str, Any] = {"features_extractor_class": ChoiceExtractor, "net_arch": []}
        super().__init__(*args, **(settings | kwargs))

    def _build(self, lr_schedule: Schedule) -> None:
        extractor = cast("ChoiceExtractor", self.features_extractor)
        k = int(cast("spaces.Discrete", self.action_space).n)
        self._build_mlp_extractor()  # of no layers: the network is all there is
        self.action_net = _Head(extractor.network, k, value=False)
        self.value_net = _Head(extractor.network, k, value=True)  # type: ignore[assignment]
        make: Any = self.optimizer_class
        self.optimizer = make(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)

    @property
    def network(self) -> ChoiceNetwork:
        """The network itself."""
        return cast("ChoiceExtractor", self.features_extractor).network


def read_zip(path: Path) -> dict[str, NDArray[np.float32]]:
    """Return the network's weights in a zip of stable-baselines3; of its pickles none is loaded.

    Raises
    ------
    ValueError
        Where the file is no such zip.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            state = torch.load(io.BytesIO(archive.read("policy.pth")), weights_only=True, map_location="cpu")
    except pickle.UnpicklingError as error:
        raise ValueError(f"{path} holds more than weights, which is not read: it may be code") from error
    except (OSError, LookupError, EOFError, ValueError, zipfile.BadZipFile, zlib.error, RuntimeError) as error:
        raise ValueError(f"{path} is no zip that stable-baselines3 wrote: {error}") from error
    named = {str(name): value for name, value in state.items()} if isinstance(state, Mapping) else {}
    weights = {name.removeprefix(_INSIDE): value for name, value in named.items() if name.startswith(_INSIDE)}
    if not weights:
        raise ValueError(f"{path} holds another policy than training.learning.networks.ChoicePolicy")
    for name, value in weights.items():
        if not (isinstance(value, Tensor) and value.dtype == torch.float32 and value.layout == torch.strided):
            raise ValueError(f"{path} holds {quoted(name)}, which is no array of numbers in single precision")
    return {name: value.detach().numpy() for name, value in weights.items()}
