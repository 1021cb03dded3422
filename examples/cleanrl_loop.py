"""PPO in one file, as CleanRL has it, over view points (``python examples/cleanrl_loop.py [STEPS]``).

The environments are reset in the step that ends an episode (``SAME_STEP``): ``done`` cuts the advantages there,
and what the episode came to is in ``final_info``. Gymnasium's default, ``NEXT_STEP``, has no such key, and its
next step resets whatever the action: a loop that does not leave those steps out learns from them.
"""

from __future__ import annotations

import sys

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torch import nn
from torch.distributions import Categorical

ENVIRONMENTS, ROLLOUT, EPOCHS, BATCH = 4, 64, 4, 64
GAMMA, LAMBDA, CLIP, ENTROPY, RATE = 0.98, 0.95, 0.2, 0.01, 1e-3  # GAMMA is a second's: steps take unequal time
KEYS = ("candidates", "present", "state")


def make() -> gym.Env:
    """Return the environment; a tenth of a point is lost a second, until 95 % are covered."""
    reward = {"time": -0.1, "area": 0.0, "pose_entropy": 0.0, "effort": 0.0}
    name = "mecanum_env:mecanum_env/ExploreFrontier-v0"
    return gym.make(name, rooms="apartment", reward=reward, discount=GAMMA**0.1)  # a control step takes 0.1 s


class Agent(nn.Module):
    """Scores each candidate by its row and the state; the value is of the best of them."""

    def __init__(self, space: gym.spaces.Dict) -> None:
        super().__init__()
        numbers = space["candidates"].shape[1] + space["state"].shape[0]
        self.trunk = nn.Sequential(nn.Linear(numbers, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU())
        self.score, self.value = nn.Linear(64, 1), nn.Linear(64, 1)
        nn.init.zeros_(self.score.weight)

    def forward(self, observation: dict[str, torch.Tensor]) -> tuple[Categorical, torch.Tensor]:
        """Return the distribution over the candidates that are present, and the value."""
        rows, present = observation["candidates"], observation["present"] > 0.5
        state = observation["state"][:, None].expand(-1, rows.shape[1], -1)
        x = self.trunk(torch.cat([rows, state], dim=-1))
        logits = self.score(x)[..., 0].masked_fill(~present, -1e9)
        return Categorical(logits=logits), self.value((x * present[..., None]).amax(dim=1))[..., 0]


def tensors(observation: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
    """Return what of an observation the agent looks at."""
    return {key: torch.as_tensor(observation[key]) for key in KEYS}


def main(steps: int) -> None:
    """Train for so many steps, and say after every rollout how long exploring took in the episodes it ended."""
    torch.manual_seed(0)
    torch.set_num_threads(1)
    envs = SyncVectorEnv([make] * ENVIRONMENTS, autoreset_mode=AutoresetMode.SAME_STEP)
    agent = Agent(envs.single_observation_space)
    optimizer = torch.optim.Adam(agent.parameters(), lr=RATE, eps=1e-5)
    observation, _ = envs.reset(seed=0)
    shape = (ROLLOUT, ENVIRONMENTS)
    for iteration in range(1, -(-steps // (ROLLOUT * ENVIRONMENTS)) + 1):
        seen, ended = [], []
        actions = torch.zeros(shape, dtype=torch.long)
        rewards, discounts, values, log_probs = (torch.zeros(shape) for _ in range(4))
        for t in range(ROLLOUT):
            seen.append(tensors(observation))
            with torch.no_grad():
                policy, values[t] = agent(seen[-1])
            actions[t] = policy.sample()
            log_probs[t] = policy.log_prob(actions[t])
            observation, reward, terminated, truncated, info = envs.step(actions[t].numpy())
            rewards[t] = torch.as_tensor(reward)
            done = terminated | truncated
            discounts[t] = torch.as_tensor(np.where(done, 0.0, GAMMA ** info["duration_s"]))
            if done.any():
                last = info["final_info"]
                ended += [(last["time_s"][i], last["is_success"][i]) for i in np.flatnonzero(done)]
            for i in np.flatnonzero(truncated & ~terminated):  # out of time: what would follow is estimated
                final = {key: np.stack([info["final_obs"][i][key]]) for key in KEYS}
                with torch.no_grad():
                    rewards[t, i] += GAMMA ** last["duration_s"][i] * agent(tensors(final))[1][0]

        advantages = torch.zeros(shape)
        with torch.no_grad():
            following, advantage = agent(tensors(observation))[1], torch.zeros(ENVIRONMENTS)
        for t in reversed(range(ROLLOUT)):
            delta = rewards[t] + discounts[t] * following - values[t]
            advantages[t] = advantage = delta + discounts[t] * LAMBDA * advantage
            following = values[t]
        returns = (advantages + values).flatten()

        flat = {key: torch.cat([o[key] for o in seen]) for key in KEYS}
        for _ in range(EPOCHS):
            for batch in torch.randperm(ROLLOUT * ENVIRONMENTS).split(BATCH):
                policy, value = agent({key: flat[key][batch] for key in KEYS})
                ratio = (policy.log_prob(actions.flatten()[batch]) - log_probs.flatten()[batch]).exp()
                gain = advantages.flatten()[batch]
                gain = (gain - gain.mean()) / (gain.std() + 1e-8)
                surrogate = torch.min(ratio * gain, ratio.clamp(1 - CLIP, 1 + CLIP) * gain).mean()
                error = (value - returns[batch]).square().mean()
                loss = 0.5 * error - surrogate - ENTROPY * policy.entropy().mean()
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
                optimizer.step()

        said = ", {:.1f} s each, {:.0%} covered".format(*np.mean(ended, axis=0)) if ended else ""
        print(f"{iteration * ROLLOUT * ENVIRONMENTS} steps, {len(ended)} episodes ended{said}", flush=True)
    envs.close()


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 50_000)
