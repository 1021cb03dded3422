"""sb3-contrib: MaskablePPO chooses the next view point (``python examples/sb3_maskable_ppo.py [STEPS]``)."""

import sys

from sb3_contrib import MaskablePPO
from stable_baselines3.common.env_util import make_vec_env

from training.learning.networks import ChoicePolicy  # "MultiInputPolicy" works too, but learns each row apart

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 50_000

# A tenth of a point a second, until 95 % are covered: the return is minus the time that took.
settings = {"rooms": "apartment", "reward": {"time": -0.1, "area": 0.0, "pose_entropy": 0.0, "effort": 0.0}}
env = make_vec_env("mecanum_env:mecanum_env/ExploreFrontier-v0", n_envs=4, seed=0, env_kwargs=settings)
model = MaskablePPO(ChoicePolicy, env, n_steps=64, batch_size=64, n_epochs=4, seed=0, verbose=1)
model.learn(steps)
model.save("sb3_maskable_ppo")
