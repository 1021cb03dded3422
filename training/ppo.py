"""Training of ``ppo-frontier``: a warm start by imitation, then PPO, checkpointed so that it goes on exactly.

A run is a chain of chunks of rollouts. Each begins with fresh episodes and random numbers that follow from the
run's seed and the chunk's number alone, so that a run that was killed and resumed is the one that was not, bit for
bit.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from sb3_contrib import MaskablePPO
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import FloatSchedule
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv, VecMonitor

from agents.choice_network import ChoiceNetwork
from slam.formats import atomic_write
from training.campaign import one_thread_each, start_worker, worker_pool
from training.choice_world import Families, make_world
from training.imitation import Lessons, give_lessons, learn
from training.networks import ChoicePolicy
from training.running import progress_of_run
from training.semi_markov import Durations, SemiMarkovBuffer
from training.train_config import TrainConfig, WorldConfig

__all__ = ["Run", "evaluate", "make_model"]

Log = Callable[[str], None]
Weights = dict[str, NDArray[np.float32]]

_FIRST_VALIDATION_SEED = 1000


class Run:
    """A training run in a folder: begun there, or gone on with.

    The folder gets ``checkpoint.zip`` (stable-baselines3), ``progress.json``, ``best.zip``, ``curve.jsonl`` with a
    line per evaluation, TensorBoard's files in ``log`` and the lessons of the warm start. ``command`` is noted in
    ``progress.json``, from where exported policies have it.

    Raises
    ------
    ValueError
        Where the folder holds a run with another configuration.
    """

    def __init__(self, config: TrainConfig, out: Path, *, workers: int, log: Log, command: str = "") -> None:
        self.config, self.out, self._workers, self._log = config, out, workers, log
        self._progress = progress_of_run(out, config, command=command, chunk=0, steps=0, best_s=None, wall_s=0.0)

    def train(self) -> None:
        """Train to the end; a run broken off anywhere goes on from its last checkpoint."""
        torch.set_num_threads(1)
        self.out.mkdir(parents=True, exist_ok=True)
        ppo, progress = self.config.ppo, self._progress
        # From the first: the lessons in the folder are of this configuration and no other.
        atomic_write(self.out / "progress.json", json.dumps(progress))
        makers = [partial(_world_of_worker, self.config.world, k) for k in range(ppo.environments)]
        with one_thread_each():
            env = VecMonitor(SubprocVecEnv(makers, start_method="spawn"))  # type: ignore[arg-type]
        self._began = time.perf_counter() - progress["wall_s"]
        try:
            with worker_pool(self._workers) as pool:
                model = make_model(self.config, env)
                model.set_logger(configure(str(self.out / "log"), ["tensorboard"]))
                if progress["chunk"] > 0:
                    model.set_parameters(str(self.out / "checkpoint.zip"), device="cpu")
                    model.num_timesteps = progress["steps"]
                elif self.config.imitation.episodes > 0:
                    self._imitate(model, pool)
                self._go_on(model, env, pool)
        finally:
            env.close()

    def _imitate(self, model: MaskablePPO, pool: ProcessPoolExecutor) -> None:
        network = cast("ChoicePolicy", model.policy).network
        untrained = {name: value.clone() for name, value in network.state_dict().items()}
        rounds: list[Lessons] = []
        for number in range(self.config.imitation.rounds):
            # Lessons are kept in the folder: what they cost in time is not spent again after a kill.
            path = self.out / f"lessons-{number + 1}.npz"
            if not path.exists():
                weights = _weights(network) if number > 0 else None
                give_lessons(self.config, pool, number=number, weights=weights).save(path)
            rounds.append(Lessons.load(path))
            self._say(f"round {number + 1}: {len(rounds[-1].prices)} choices")
            # From the beginning with the lessons of all rounds, whatever the last one came to.
            network.load_state_dict(untrained)
            for line in learn(network, Lessons.joined(rounds), self.config):
                self._say(f"imitation {number + 1}: " + _words(line))

    def _go_on(self, model: MaskablePPO, env: VecMonitor, pool: ProcessPoolExecutor) -> None:
        ppo, progress = self.config.ppo, self._progress
        size = ppo.chunk * ppo.n_steps * ppo.environments
        chunks = -(-ppo.steps // size)
        while progress["chunk"] <= chunks:
            number = progress["chunk"]
            if number % self.config.evaluation.every == 0 or number == chunks:
                self._evaluate(model, pool)
            if number == chunks:
                break
            self._learn_chunk(model, env, number, chunks)
            progress |= {
                "chunk": number + 1, "steps": model.num_timesteps, "wall_s": time.perf_counter() - self._began,
            }  # fmt: skip
            _save(model, self.out / "checkpoint.zip")
            atomic_write(self.out / "progress.json", json.dumps(progress))
            self._say(f"chunk {number + 1} of {chunks}: " + _words(_recent(model)))

    def _learn_chunk(self, model: MaskablePPO, env: VecMonitor, number: int, chunks: int) -> None:
        ppo = self.config.ppo
        seed = int(np.random.SeedSequence([self.config.seed, number]).generate_state(1)[0] % 2**31)
        model.set_random_seed(seed)
        env.seed(seed)
        model._last_obs = None  # fresh episodes
        model.lr_schedule = FloatSchedule(ppo.learning_rate * (1.0 - number / chunks))
        steps = ppo.chunk * ppo.n_steps * ppo.environments
        model.learn(steps, callback=Durations(), reset_num_timesteps=False)

    def _evaluate(self, model: MaskablePPO, pool: ProcessPoolExecutor) -> None:
        weights = _weights(cast("ChoicePolicy", model.policy).network)
        result = {"steps": model.num_timesteps} | evaluate(weights, self.config, pool)
        with (self.out / "curve.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(result | {"wall_s": time.perf_counter() - self._began}) + "\n")
        self._say("evaluation: " + _words(result))
        if self._progress["best_s"] is None or result["time_to_95_s"] < self._progress["best_s"]:
            self._progress["best_s"] = result["time_to_95_s"]
            _save(model, self.out / "best.zip")

    def _say(self, text: str) -> None:
        self._log(f"{text} [{time.perf_counter() - self._began:.0f} s]")


def make_model(config: TrainConfig, env: VecEnv) -> MaskablePPO:
    """Return an untrained model for an environment with the configuration's choices."""
    ppo = config.ppo
    return MaskablePPO(
        ChoicePolicy, env, n_steps=ppo.n_steps, batch_size=ppo.batch_size, n_epochs=ppo.n_epochs,
        learning_rate=ppo.learning_rate, gamma=ppo.gamma, gae_lambda=ppo.gae_lambda, ent_coef=ppo.ent_coef,
        clip_range=ppo.clip_range, target_kl=ppo.target_kl, rollout_buffer_class=SemiMarkovBuffer,
        device="cpu", seed=config.seed,
        policy_kwargs={
            "features_extractor_kwargs": {
                "width": config.width, "heads": config.heads, "layers": config.layers,
            },
        },
    )  # fmt: skip


def evaluate(weights: Weights, config: TrainConfig, pool: ProcessPoolExecutor) -> dict[str, Any]:
    """Return how long a policy, chance aside, takes to 95 % on validation seeds; unreached counts as the limit."""
    world, heads = config.world, config.heads
    jobs = [
        (weights, heads, world, name, noise, _FIRST_VALIDATION_SEED + k)
        for name in dict.fromkeys(world.rooms)
        for noise in world.noises
        for k in range(config.evaluation.episodes)
    ]
    ends = list(pool.map(_try, jobs))
    times: dict[str, list[float]] = {job[3]: [] for job in jobs}
    for job, (time_s, _) in zip(jobs, ends, strict=True):
        times[job[3]].append(time_s)
    means = {name: float(np.mean(values)) for name, values in times.items()}
    return {
        "time_to_95_s": float(np.mean(list(means.values()))),
        "collisions": sum(collisions for _, collisions in ends),
        **means,
    }


def _try(job: tuple[Weights, int, WorldConfig, str, str, int]) -> tuple[float, int]:
    """Return the time to 95 % [s] and the collisions of one episode."""
    weights, heads, world, rooms, noise, seed = job
    network = ChoiceNetwork(weights, heads=heads)
    env = make_world(replace(world, noises=(noise,)))
    env.reset(options={"rooms": rooms, "room_seed": seed})
    while True:
        k = int(np.argmax(network.scores(env.env.agent.described[0]))) if env.action_masks().sum() > 1 else 0
        *_, terminated, truncated, info = env.step(k)
        if terminated or truncated:
            return info["time_s"] if info["is_success"] else world.time_limit_s, info["collisions"]


def _world_of_worker(world: WorldConfig, index: int) -> Families:
    """Make an environment in a process of its own."""
    start_worker()
    return make_world(world, index)


def _weights(network: torch.nn.Module) -> Weights:
    return {name: value.detach().numpy().copy() for name, value in network.state_dict().items()}


def _save(model: MaskablePPO, path: Path) -> None:
    new = path.with_name(f".{path.name}")
    model.save(new)
    new.replace(path)


def _recent(model: MaskablePPO) -> dict[str, float]:
    """Return what the last rollouts were like."""
    episodes = list(model.ep_info_buffer or [])
    found = {
        "return": float(np.mean([e["r"] for e in episodes])) if episodes else float("nan"),
        "choices": float(np.mean([e["l"] for e in episodes])) if episodes else float("nan"),
    }
    values = model.logger.name_to_value
    for name in ("approx_kl", "explained_variance", "entropy_loss"):
        if f"train/{name}" in values:
            found[name] = float(values[f"train/{name}"])
    return found


def _words(values: dict[str, Any]) -> str:
    return ", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in values.items())
