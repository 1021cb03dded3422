"""Training of ``ppo-frontier``: a warm start by imitation, rehearsals, then PPO in the whole environment.

A run is a chain of chunks of rollouts, those of the rehearsal first. Each begins with fresh episodes and random
numbers that follow from the run's seed and the chunk's number alone, so that a run that was killed and resumed is
the one that was not, bit for bit.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from sb3_contrib import MaskablePPO
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import FloatSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecMonitor

from agents.learned.choice_network import ChoiceEnsemble
from slam.formats import atomic_write, replacing
from training.learning.choice_world import Families, make_rehearsal, make_world, world_of_worker
from training.learning.config import PpoConfig, TrainConfig, WorldConfig
from training.learning.imitation import Lessons, give_lessons, learn
from training.learning.networks import ChoicePolicy, read_zip
from training.learning.semi_markov import Durations, SemiMarkovBuffer
from training.runs.campaign import one_thread_each, worker_pool
from training.runs.running import progress_of_run

__all__ = ["Run", "Trial", "evaluate", "make_model", "trials_in_full"]

Log = Callable[[str], None]
Weights = dict[str, NDArray[np.float32]]

_FIRST_VALIDATION_SEED = 1000


class Run:
    """A training run in a folder: begun there, or gone on with.

    The folder gets ``checkpoint.zip`` (stable-baselines3), ``progress.json``, ``best.zip``, ``curve.jsonl`` with a
    line per evaluation, TensorBoard's files in ``log`` and the lessons of the warm start. ``command`` is noted in
    ``progress.json``, from where exported policies have it. With one worker the rollouts are made in this process;
    with more, each of their environments has a process of its own. What is learned is the same.

    Raises
    ------
    ValueError
        Where the folder holds a run with another configuration.
    """

    def __init__(self, config: TrainConfig, out: Path, *, workers: int, log: Log, command: str = "") -> None:
        self.config, self.out, self._workers, self._log = config, out, workers, log
        self._progress = progress_of_run(
            out, config, command=command, chunk=0, steps=0, best_s=None, best_in="", wall_s=0.0, done=False
        )

    def train(self) -> None:
        """Train to the end; a run broken off anywhere goes on from its last checkpoint, a finished one is left."""
        if self._progress["done"]:
            return
        torch.set_num_threads(1)
        self.out.mkdir(parents=True, exist_ok=True)
        progress = self._progress
        # From the first: the lessons in the folder are of this configuration and no other.
        atomic_write(self.out / "progress.json", json.dumps(progress))
        self._began = time.perf_counter() - progress["wall_s"]
        with worker_pool(self._workers) as pool:
            for stage in _stages(self.config):
                if stage.first == stage.end > 0:  # nothing is learned in it
                    self._evaluate(stage, read_zip(self.out / "checkpoint.zip"), pool, self._keep_checkpoint)
                elif progress["chunk"] <= stage.end:
                    self._enact(stage, pool)
        progress["done"] = True
        atomic_write(self.out / "progress.json", json.dumps(progress))

    def _enact(self, stage: _Stage, pool: ProcessPoolExecutor) -> None:
        """Go through what is left of a stage, from the last checkpoint if there is one."""
        config, progress, checkpoint = self.config, self._progress, self.out / "checkpoint.zip"
        parts = [part for part in stage.parts if progress["chunk"] < part.end] or stage.parts[-1:]
        env = VecMonitor(self._environments(parts[0].makers))
        try:
            model = make_model(config, env, stage.ppo)
            model.set_logger(configure(str(self.out / "log"), ["tensorboard"]))
            model.num_timesteps = progress["steps"]
            if progress["chunk"] > stage.first:
                model.set_parameters(str(checkpoint), device="cpu")
            elif stage.first > 0:
                network = cast("ChoicePolicy", model.policy).network
                found = read_zip(checkpoint)
                network.load_state_dict({name: torch.as_tensor(value) for name, value in found.items()})
            elif config.imitation.episodes > 0:
                self._imitate(model, pool)
            for part in parts:
                if part is not parts[0]:
                    env.close()
                    env = VecMonitor(self._environments(part.makers))
                    model.set_env(env)
                self._go_on(stage, part.end, model, env, pool)
            self._try_out(stage, model, pool)
        finally:
            env.close()

    def _environments(self, makers: Sequence[Callable[[], Families]]) -> VecEnv:
        if self._workers == 1:
            return DummyVecEnv(list(makers))
        with one_thread_each():
            apart: Any = [partial(world_of_worker, maker) for maker in makers]
            return SubprocVecEnv(apart, start_method="spawn")

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

    def _go_on(
        self, stage: _Stage, end: int, model: MaskablePPO, env: VecMonitor, pool: ProcessPoolExecutor
    ) -> None:
        progress = self._progress
        while progress["chunk"] < end:
            number = progress["chunk"]
            if (number - stage.first) % stage.every == 0:
                self._try_out(stage, model, pool)
            self._learn_chunk(stage, model, env, number)
            progress |= {
                "chunk": number + 1, "steps": model.num_timesteps, "wall_s": time.perf_counter() - self._began,
            }  # fmt: skip
            _save(model, self.out / "checkpoint.zip")
            atomic_write(self.out / "progress.json", json.dumps(progress))
            done, of = number + 1 - stage.first, stage.end - stage.first
            self._say(f"{stage.name}, chunk {done} of {of}: " + _words(_recent(model)))

    def _learn_chunk(self, stage: _Stage, model: MaskablePPO, env: VecMonitor, number: int) -> None:
        seed = int(np.random.SeedSequence([self.config.seed, number]).generate_state(1)[0] % 2**31)
        model.set_random_seed(seed)
        env.seed(seed)
        model._last_obs = None  # fresh episodes
        left = 1.0 - (number - stage.first) / (stage.end - stage.first)
        model.lr_schedule = FloatSchedule(stage.ppo.learning_rate * left)
        model.learn(stage.ppo.size, callback=Durations(), reset_num_timesteps=False)

    def _try_out(self, stage: _Stage, model: MaskablePPO, pool: ProcessPoolExecutor) -> None:
        weights = _weights(cast("ChoicePolicy", model.policy).network)
        self._evaluate(stage, weights, pool, partial(_save, model))

    def _evaluate(
        self, stage: _Stage, weights: Weights, pool: ProcessPoolExecutor, save: Callable[[Path], None]
    ) -> None:
        result = {"stage": stage.name, "steps": self._progress["steps"]}
        result |= evaluate(weights, self.config.heads, stage.trials, pool)
        self._add_to_curve(result | {"wall_s": time.perf_counter() - self._began})
        self._say("evaluation: " + _words(result))
        best = self._progress["best_s"]
        # Seconds of a rehearsal are not those of the whole environment.
        if self._progress["best_in"] != stage.name or best is None or result["time_to_95_s"] < best:
            self._progress |= {"best_s": result["time_to_95_s"], "best_in": stage.name}
            save(self.out / "best.zip")
            atomic_write(self.out / "progress.json", json.dumps(self._progress))

    def _add_to_curve(self, result: dict[str, Any]) -> None:
        path = self.out / "curve.jsonl"
        text = path.read_text(encoding="utf-8") if path.exists() else ""
        lines = [json.loads(line) for line in text.splitlines()]
        # A run killed after a trial repeats it: one line of it is enough.
        where = ("stage", "steps")
        kept = [line for line in lines if any(line[key] != result[key] for key in where)]
        atomic_write(path, "".join(json.dumps(line) + "\n" for line in [*kept, result]))

    def _keep_checkpoint(self, path: Path) -> None:
        with replacing(path) as new:
            shutil.copyfile(self.out / "checkpoint.zip", new)

    def _say(self, text: str) -> None:
        self._log(f"{text} [{time.perf_counter() - self._began:.0f} s]")


def make_model(config: TrainConfig, env: VecEnv, ppo: PpoConfig | None = None) -> MaskablePPO:
    """Return an untrained model for an environment with the configuration's choices."""
    ppo = ppo or config.ppo
    model = MaskablePPO(
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
    if config.rehearsal.steps > 0:
        cast("ChoicePolicy", model.policy).network.ignore_uncertainty()
    return model


@dataclass(frozen=True)
class Trial:
    """An episode on a validation seed."""

    family: str
    make: Callable[[], Families]
    options: dict[str, Any]
    limit_s: float


@dataclass(frozen=True)
class _Part:
    """A part of a stage, in one part of the curriculum."""

    end: int  # number of the chunk after its last one
    makers: list[Callable[[], Families]]


@dataclass(frozen=True)
class _Stage:
    """A part of a run, in one kind of world."""

    name: str
    ppo: PpoConfig
    first: int  # number of its first chunk
    every: int  # chunks, between two evaluations
    world: WorldConfig
    makers: Callable[[WorldConfig], list[Callable[[], Families]]]
    trials: list[Trial]

    @property
    def end(self) -> int:
        """Number of the chunk after its last one."""
        return self.first + -(-self.ppo.steps // self.ppo.size)

    @property
    def parts(self) -> list[_Part]:
        """What the curriculum makes of it, in whole chunks."""
        first, chunks = self.first, self.end - self.first
        return [_Part(first + round(share * chunks), self.makers(world)) for share, world in self.world.parts()]


def _stages(config: TrainConfig) -> list[_Stage]:
    world, rehearsal, ppo = config.world, config.rehearsal, config.ppo
    stages = []
    if rehearsal.steps > 0:
        # Trials ask for the time alone.
        unshaped = partial(make_rehearsal, world, replace(rehearsal, shaping_s_m=0.0))
        stages.append(
            _Stage(
                "rehearsal", rehearsal, 0, rehearsal.every, world,
                lambda part: [partial(make_rehearsal, part, rehearsal)] * rehearsal.environments,
                _trials(world, unshaped, rehearsal.episodes, {"anywhere": False}),
            )
        )  # fmt: skip
    first = stages[0].end if stages else 0
    in_full = _Stage(
        "ppo", ppo, first, config.evaluation.every, world,
        lambda part: [partial(make_world, part, k) for k in range(ppo.environments)], trials_in_full(config),
    )  # fmt: skip
    return [*stages, in_full]


def trials_in_full(config: TrainConfig) -> list[Trial]:
    """Return the trials in the whole environment: every family, with every noise."""
    world = config.world
    whole = [partial(make_world, replace(world, noises=(noise,))) for noise in world.noises]
    return [trial for make in whole for trial in _trials(world, make, config.evaluation.episodes, {})]


def _trials(
    world: WorldConfig, make: Callable[[], Families], episodes: int, options: dict[str, Any]
) -> list[Trial]:
    return [
        Trial(name, make, {"rooms": name, "room_seed": _FIRST_VALIDATION_SEED + k} | options, world.time_limit_s)
        for name in dict.fromkeys(world.rooms)
        for k in range(episodes)
    ]


def evaluate(weights: Weights, heads: int, trials: Sequence[Trial], pool: ProcessPoolExecutor) -> dict[str, Any]:
    """Return how long a policy, chance aside, takes to 95 % on validation seeds; unreached counts as the limit."""
    ends = list(pool.map(_try, [(weights, heads, trial) for trial in trials]))
    times: dict[str, list[float]] = {trial.family: [] for trial in trials}
    for trial, (time_s, _) in zip(trials, ends, strict=True):
        times[trial.family].append(time_s)
    means = {name: float(np.mean(values)) for name, values in times.items()}
    return {
        "time_to_95_s": float(np.mean(list(means.values()))),
        "collisions": sum(collisions for _, collisions in ends),
        **means,
    }


def _try(job: tuple[Weights, int, Trial]) -> tuple[float, int]:
    """Return the time to 95 % [s] and the collisions of one episode."""
    weights, heads, trial = job
    network = ChoiceEnsemble(weights, heads=heads)
    env = trial.make()
    env.reset(options=trial.options)
    while True:
        k = int(np.argmax(network.scores(env.env.agent.described[0]))) if env.action_masks().sum() > 1 else 0
        *_, terminated, truncated, info = env.step(k)
        if terminated or truncated:
            return info["time_s"] if info["is_success"] else trial.limit_s, info["collisions"]


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
