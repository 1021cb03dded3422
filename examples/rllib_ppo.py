"""RLlib's new API stack: masked PPO over view points (``python examples/rllib_ppo.py [ITERATIONS [WORKERS]]``)."""

from __future__ import annotations

import sys

import gymnasium as gym
import numpy as np
import ray
from gymnasium import spaces
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.examples.rl_modules.classes.action_masking_rlm import ActionMaskingTorchRLModule
from ray.tune.registry import register_env


class FlatWithMask(gym.ObservationWrapper):
    """RLlib's masking module wants a ``Dict`` of its own: one row of numbers, and which actions there are."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self._flat = spaces.Dict({key: env.observation_space[key] for key in ("candidates", "state")})
        mask = spaces.Box(0.0, 1.0, (int(env.action_space.n),), np.float32)
        row = spaces.flatten_space(self._flat)
        self.observation_space = spaces.Dict({"action_mask": mask, "observations": row})

    def observation(self, observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return what RLlib's masking module asks for."""
        mask = self.env.get_wrapper_attr("action_masks")().astype(np.float32)
        rows = {key: observation[key] for key in self._flat}
        return {"action_mask": mask, "observations": spaces.flatten(self._flat, rows)}


def make(settings: dict) -> gym.Env:
    """Return the environment."""
    return FlatWithMask(gym.make("mecanum_env:mecanum_env/ExploreFrontier-v0", **settings))


def main(iterations: int, workers: int) -> None:
    """Train, and say after every iteration how long exploring took."""
    register_env("ExploreFrontier", make)
    # A tenth of a point a second, until 95 % are covered: the return is minus the time that took.
    settings = {"rooms": "apartment", "reward": {"time": -0.1, "area": 0.0, "pose_entropy": 0.0, "effort": 0.0}}
    config = (
        PPOConfig()
        .environment("ExploreFrontier", env_config=settings)
        .env_runners(num_env_runners=workers, num_envs_per_env_runner=2)
        .rl_module(rl_module_spec=RLModuleSpec(module_class=ActionMaskingTorchRLModule))
        .training(train_batch_size_per_learner=512, minibatch_size=64, num_epochs=4, gamma=0.98, lr=3e-4)
        .debugging(seed=0)
    )
    algorithm = config.build_algo()
    for iteration in range(1, iterations + 1):
        result = algorithm.train()["env_runners"]
        steps, ended = int(result["num_env_steps_sampled_lifetime"]), int(result.get("num_episodes", 0))
        said = f", mean return {result['episode_return_mean']:.2f}" if ended else ""
        print(f"{iteration}: {steps} steps, {ended} episodes ended{said}", flush=True)
    algorithm.stop()
    ray.shutdown()


if __name__ == "__main__":
    given = [int(word) for word in sys.argv[1:]]
    main(*given, *(100, 2)[len(given) :])
