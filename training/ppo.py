"""Training of ``ppo-frontier``: a warm start by imitation, then PPO, checkpointed so that it goes on exactly.

A run is a chain of chunks of rollouts. Each begins with fresh episodes and random numbers that follow from the run's
seed and the chunk's number alone, so that a run that was killed and resumed is the one that was not, bit for bit.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from sb3_contrib import MaskablePPO
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import FloatSchedule
from stable_baselines3.common.vec_env import SubprocVecEnv, VecMonitor

from slam.formats import atomic_write
from slam.settings import to_mapping
from training.choice_world import make_world
from training.imitation import give_lessons, learn
from training.networks import ChoicePolicy
from training.semi_markov import Durations, SemiMarkovBuffer
from training.train_config import TrainConfig

__all__ = ["train"]

Log = Callable[[str], None]


def train(config: TrainConfig, out: Path, *, workers: int, log: Log) -> None:
    """Train a policy into a folder, or go on where the folder's run was broken off.

    ``out`` gets ``config.json``, ``checkpoint.zip`` (stable-baselines3) with ``progress.json``, ``best.zip`` and
    ``curve.jsonl``, a line per evaluation, and TensorBoard's files.
    """
    torch.set_num_threads(1)
    out.mkdir(parents=True, exist_ok=True)
    settings = json.loads(json.dumps(to_mapping(config)))
    progress: dict[str, Any] = {"chunk": 0, "best": None, "wall_s": 0.0}
    if (out / "progress.json").exists():
        progress = json.loads((out / "progress.json").read_text())
        if progress["config"] != settings:
            raise ValueError(f"{out} holds a run with another configuration; choose another --out")
    ppo = config.ppo
    env = VecMonitor(SubprocVecEnv(
        [partial(_make, config, k) for k in range(ppo.environments)], start_method="forkserver"
    ))  # fmt: skip
    try:
        model = _model(config, env)
        model.set_logger(configure(str(out / "log"), ["tensorboard"]))
        began = time.perf_counter() - progress["wall_s"]
        if progress["chunk"] == 0 and config.imitation.episodes > 0:
            lessons = give_lessons(config, workers=workers)
            log(f"{len(lessons.actions)} choices of {config.imitation.teacher} [{time.perf_counter() - began:.0f} s]")
            for line in learn(model.policy.network, lessons, config):
                log("imitation " + _words(line))
        elif progress["chunk"] > 0:
            model.set_parameters(out / "checkpoint.zip", exact_match=True, device="cpu")
            model.num_timesteps = progress["steps"]
        size = ppo.chunk * ppo.n_steps * ppo.environments
        chunks = -(-ppo.steps // size)
        while progress["chunk"] <= chunks:
            number = progress["chunk"]
            if number % config.evaluation.every == 0 or number == chunks:
                result = {"steps": model.num_timesteps} | evaluate(model, config, env)
                log("evaluation " + _words(result) + f" [{time.perf_counter() - began:.0f} s]")
                with (out / "curve.jsonl").open("a") as file:
                    file.write(json.dumps(result | {"wall_s": time.perf_counter() - began}) + "\n")
                if progress["best"] is None or result["time_to_95_s"] < progress["best"]:
                    progress["best"] = result["time_to_95_s"]
                    model.save(out / "best.zip")
            if number == chunks:
                break
            _run_chunk(model, config, env, number, chunks, size)
            progress |= {
                "chunk": number + 1, "steps": model.num_timesteps, "wall_s": time.perf_counter() - began,
                "config": settings,
            }  # fmt: skip
            model.save(out / "checkpoint.new.zip")
            (out / "checkpoint.new.zip").replace(out / "checkpoint.zip")
            atomic_write(out / "progress.json", json.dumps(progress))
            log(f"chunk {number + 1} of {chunks}: {_words(_recent(model))} [{progress['wall_s']:.0f} s]")
    finally:
        env.close()


def _run_chunk(
    model: MaskablePPO, config: TrainConfig, env: VecMonitor, number: int, chunks: int, size: int
) -> None:
    ppo = config.ppo
    seed = int(np.random.SeedSequence([config.seed, number]).generate_state(1)[0] % 2**31)
    model.set_random_seed(seed)
    env.seed(seed)
    model._last_obs = None  # fresh episodes
    share = 1.0 - number / chunks
    model.lr_schedule = FloatSchedule(ppo.learning_rate * share)
    callback: list[BaseCallback] = [Durations()]
    learning_steps = min(size, max(ppo.steps - number * size, ppo.n_steps * ppo.environments))
    model.learn(learning_steps, callback=CallbackList(callback), reset_num_timesteps=False)


def _recent(model: MaskablePPO) -> dict[str, float]:
    episodes = list(model.ep_info_buffer or [])
    values = model.logger.name_to_value
    return {
        "return": float(np.mean([e["r"] for e in episodes])) if episodes else float("nan"),
        "choices": float(np.mean([e["l"] for e in episodes])) if episodes else float("nan"),
        **{k.split("/")[1]: float(v) for k, v in values.items() if k in ("train/approx_kl", "train/explained_variance", "train/entropy_loss")},
    }


def evaluate(model: MaskablePPO, config: TrainConfig, env: VecMonitor) -> dict[str, float]:
    """Return how long the policy, without chance, takes to 95 % on validation seeds; unreached counts as the limit."""
    jobs = [(name, 1000 + k) for name in config.world.rooms for k in range(config.evaluation.episodes)]
    venv = env.venv
    results: dict[str, list[float]] = {name: [] for name in config.world.rooms}
    collisions = 0
    # Each environment works through its own share, so that all noises see all families.
    shares = [jobs[k :: venv.num_envs] for k in range(venv.num_envs)]
    state = [venv.env_method("reset", options=_options(s[0]), indices=k)[0] if s else None for k, s in enumerate(shares)]
    observations = [s[0] if s else None for s in state]
    while any(shares):
        live = [k for k, s in enumerate(shares) if s]
        masks = {k: venv.env_method("action_masks", indices=k)[0] for k in live}
        for k in live:
            action, _ = model.predict(observations[k], action_masks=masks[k], deterministic=True)
            venv.remotes[k].send(("env_method", ("step", (int(action),), {})))
        for k in live:
            observation, _, terminated, truncated, info = venv.remotes[k].recv()
            observations[k] = observation
            if terminated or truncated:
                name, _ = shares[k].pop(0)
                results[name].append(info["time_s"] if info["is_success"] else config.world.time_limit_s)
                collisions += info["collisions"]
                if shares[k]:
                    observations[k] = venv.env_method("reset", options=_options(shares[k][0]), indices=k)[0][0]
    means = {name: float(np.mean(times)) for name, times in results.items()}
    return {"time_to_95_s": float(np.mean(list(means.values()))), "collisions": collisions, **means}


def _options(job: tuple[str, int]) -> dict[str, Any]:
    return {"rooms": job[0], "room_seed": job[1]}


def _make(config: TrainConfig, index: int) -> Any:
    torch.set_num_threads(1)
    return make_world(config.world, index)


def _model(config: TrainConfig, env: VecMonitor) -> MaskablePPO:
    ppo = config.ppo
    return MaskablePPO(
        ChoicePolicy, env, n_steps=ppo.n_steps, batch_size=ppo.batch_size, n_epochs=ppo.n_epochs,
        learning_rate=ppo.learning_rate, gamma=ppo.gamma, gae_lambda=ppo.gae_lambda, ent_coef=ppo.ent_coef,
        clip_range=ppo.clip_range, target_kl=ppo.target_kl, rollout_buffer_class=SemiMarkovBuffer, device="cpu",
        seed=config.seed,
        policy_kwargs={
            "features_extractor_kwargs": {
                "width": config.width, "heads": config.heads, "layers": config.layers,
            },
        },
    )  # fmt: skip


def _words(values: dict[str, Any]) -> str:
    return ", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in values.items())
