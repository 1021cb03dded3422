"""stable-baselines3: PPO drives the robot, ten commands a second (``python examples/sb3_ppo.py [STEPS]``)."""

import sys

from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

from training.learning.vec_env import ExploreVecEnv

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000

if __name__ == "__main__":  # the environments are shared out among processes, which may import this file
    env = VecMonitor(ExploreVecEnv(4, seed=0, rooms="rectangular", max_episode_steps=600))
    model = PPO(
        "MultiInputPolicy", env, n_steps=256, batch_size=256, n_epochs=4, ent_coef=0.001, seed=0, verbose=1
    )
    model.learn(steps)
    model.save("sb3_ppo")
    env.close()
