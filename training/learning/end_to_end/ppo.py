"""PPO on the control network, the planning network before it as imitation left it."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.spaces.utils import flatten_space
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.policies import MultiInputActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn

from agents.learned.drive_network import NUMBERS, SECTORS, DriveNetwork
from mecanum_env.env import ExploreEnv
from training.learning.choice_world import Families
from training.learning.end_to_end.config import DriveConfig, DriveWorldConfig
from training.learning.end_to_end.networks import ControlNetwork

__all__ = ["DrivePolicy", "DriveWorld", "make_model"]

LANDMARKS = 32


class DriveWorld(Families):
    """``Explore-v0`` over families of rooms, seen as the control network sees it; the time limit truncates."""

    def __init__(self, world: DriveWorldConfig, network: DriveNetwork) -> None:
        limit = {"time_limit_s": world.time_limit_s}
        super().__init__(ExploreEnv(slam=world.slam, noise=world.noise, reward=world.reward, config=limit), world)
        self._network = network
        free = {"scan": (SECTORS,), "landmarks": (LANDMARKS, 5), "numbers": (NUMBERS,)}
        self.observation_space = spaces.Dict(
            {key: spaces.Box(-np.inf, np.inf, shape, np.float32) for key, shape in free.items()}
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode in rooms of the next draw."""
        observation, info = super().reset(seed=seed, options=options)
        self._memory = self._network.memory(step_s=self.env.config.step_s)
        return self._inputs(observation), info

    def step(self, action: NDArray[np.float32]) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Drive for one step."""
        observation, reward, terminated, _, info = self.env.step(action)
        late = info["time_s"] >= self._world.time_limit_s - 1e-9
        return self._inputs(observation), reward, terminated, late and not terminated, info

    def _inputs(self, observation: Any) -> dict[str, NDArray[np.float32]]:
        return self._network.inputs(observation, self._memory.way(self.env.belief))._asdict()


class DrivePolicy(MultiInputActorCriticPolicy):
    """:class:`ControlNetwork` as the mean of a Gaussian, and another for the value."""

    def _build(self, lr_schedule: Schedule) -> None:
        self._build_mlp_extractor()
        self.action_net, self.value_net = _Flat(3), _Flat(1)  # type: ignore[assignment]
        self.log_std = nn.Parameter(torch.full((3,), self.log_std_init))
        make: Any = self.optimizer_class
        self.optimizer = make(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)

    def hold_still(self, still: bool) -> None:
        """Let the value alone learn, or both."""
        for parameter in [*self.action_net.parameters(), self.log_std]:
            parameter.requires_grad_(not still)

    @property
    def network(self) -> ControlNetwork:
        """The network of the mean."""
        return cast("_Flat", self.action_net).network


class _Flat(nn.Module):
    """A control network on the flattened observation, its parts in the order of their names."""

    def __init__(self, out: int) -> None:
        super().__init__()
        self.network = ControlNetwork(out=out)

    def forward(self, features: Tensor) -> Tensor:
        landmarks, numbers, scan = torch.split(features, [LANDMARKS * 5, NUMBERS, SECTORS], dim=1)
        return cast("Tensor", self.network(scan, landmarks.reshape(-1, LANDMARKS, 5), numbers))


def make_model(config: DriveConfig, env: VecEnv, *, device: str = "cpu") -> PPO:
    """Return PPO with :class:`DrivePolicy`."""
    assert flatten_space(env.observation_space).shape == (LANDMARKS * 5 + NUMBERS + SECTORS,)
    return PPO(
        DrivePolicy, env, **config.ppo.settings, device=device, seed=config.seed,
        policy_kwargs={"log_std_init": -2.0, "net_arch": []},
    )  # fmt: skip
