"""stable-baselines3: PPO drives the robot, ten commands a second (``python examples/sb3_ppo.py [STEPS]``)."""

import sys

from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000

settings = {"rooms": "rectangular", "max_episode_steps": 600}
env = make_vec_env("mecanum_env:mecanum_env/Explore-v0", n_envs=4, seed=0, env_kwargs=settings)
model = PPO("MultiInputPolicy", env, n_steps=256, batch_size=256, n_epochs=4, ent_coef=0.001, seed=0, verbose=1)
model.learn(steps)
model.save("sb3_ppo")
