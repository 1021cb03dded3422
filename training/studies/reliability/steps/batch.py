"""A batch run over worker processes, and each of its environments alone: both have to be the same, bit for bit."""

from __future__ import annotations

from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from mecanum_env.vector.vector_env import ExploreVectorEnv
from training.studies.reliability.steps.actions import policy
from training.studies.reliability.steps.items import Item
from training.studies.reliability.steps.nonsense import NONSENSE_EVERY, no_actions, refuse
from training.studies.reliability.steps.watch import Findings, Watch, check_metrics

__all__ = ["run"]

_ENVIRONMENTS, _WORKERS = 3, 2


def run(item: Item, given: dict[str, Any], found: Findings, nonsense: bool) -> None:
    """Run a batch, and keep what it shows; then each of its environments alone, watched."""
    mode = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)[item.seed % 2]
    envs = ExploreVectorEnv(
        _ENVIRONMENTS, workers=_WORKERS, autoreset_mode=mode, max_episode_steps=item.limit,
        copy=bool(item.seed // 2 % 2), **given,
    )  # fmt: skip
    try:
        shown, acted = _batch(item, envs, found, nonsense)
    finally:
        envs.close()
    for row in range(_ENVIRONMENTS):
        _alone(item, given, found, mode, row, shown, acted)


def _batch(item: Item, envs: ExploreVectorEnv, found: Findings, nonsense: bool) -> tuple[list[Any], list[Any]]:
    """Return what the batch showed after each step, the reset first, and the actions."""
    size = envs.single_action_space.shape[0]  # type: ignore[index]
    policies = [policy(item.driver, size, np.random.default_rng([item.seed, 2, k])) for k in range(_ENVIRONMENTS)]
    observations, _ = envs.reset(seed=item.seed)
    shown: list[Any] = [(_digestible(observations), np.zeros(_ENVIRONMENTS))]
    acted = []
    for k in range(-(-item.steps // _ENVIRONMENTS)):
        actions = np.stack([act(k) for act in policies])
        if nonsense and k % NONSENSE_EVERY == 0:
            bad = [
                a
                for a in no_actions(size)
                if isinstance(a, np.ndarray) and a.shape == (size,) and a.dtype.kind == "f"
            ]

            def step(one: Any, actions: Any = actions) -> None:
                envs.step(np.vstack([actions[:-1], one[None]]).astype(np.float32))

            refuse(step, bad, k // NONSENSE_EVERY, found)
        observations, rewards, terminated, truncated, _ = envs.step(actions)
        shown.append((_digestible(observations), rewards, terminated, truncated))
        acted.append(actions)
    return shown, acted


def _digestible(observations: dict[str, Any]) -> list[int]:
    """Return of each environment a number that its observation gives: all of them would fill the memory."""
    return [
        hash(b"".join(observations[key][k].tobytes() for key in sorted(observations)))
        for k in range(_ENVIRONMENTS)
    ]


def _alone(
    item: Item, given: dict[str, Any], found: Findings, mode: AutoresetMode, row: int, shown: list[Any],
    acted: list[Any],
) -> None:  # fmt: skip
    env = gymnasium.make("mecanum_env/Explore-v0", max_episode_steps=item.limit, disable_env_checker=True, **given)
    inner: Any = env.unwrapped
    space = cast(spaces.Dict, env.observation_space)
    observation, info = env.reset(seed=item.seed + row)
    found.episodes += 1
    watch = Watch(inner, found, space)
    watch.first(observation, info)
    ended = False
    for k, actions in enumerate(acted):
        terminated = truncated = False
        reward = 0.0
        if not ended:
            observation, paid, terminated, truncated, info = env.step(actions[row])
            reward = float(paid)
            watch.step(observation, reward, info)
            if terminated or truncated:
                check_metrics(info, found)
        if ended or (mode is AutoresetMode.SAME_STEP and (terminated or truncated)):
            observation, info = env.reset()
            found.episodes += 1
            watch = Watch(inner, found, space)
            watch.first(observation, info)
        ended = mode is AutoresetMode.NEXT_STEP and (terminated or truncated)
        seen = hash(b"".join(observation[key].tobytes() for key in sorted(observation)))
        hashes, rewards, *flags = shown[k + 1]
        if (hashes[row], float(rewards[row]), *(bool(flag[row]) for flag in flags)) != (
            seen, reward, bool(terminated), bool(truncated),
        ):  # fmt: skip
            found.note("a batch differs from its environment alone", f"environment {row}, step {k + 1}")
            break
    env.close()
