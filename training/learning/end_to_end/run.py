"""Training of ``ppo``, the end-to-end policy: rounds of lessons, then PPO, resumable to the bit.

A run is a chain of rounds and then of chunks of rollouts. Each follows from the weights that the one before it
left, from the lessons kept in the folder, and from random numbers of its own, drawn by the run's seed and its
number: a run that was killed and resumed is the one that was not.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import load_file, save
from stable_baselines3 import PPO
from stable_baselines3.common.utils import FloatSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from agents.learned.drive_network import PlanSettings
from slam.formats import atomic_write
from training.learning.end_to_end.config import DriveConfig
from training.learning.end_to_end.imitation import learn_control, learn_maps
from training.learning.end_to_end.networks import ControlNetwork, PlanNetwork
from training.learning.end_to_end.ppo import DrivePolicy, make_drive_world, make_model
from training.learning.end_to_end.rollouts import Episode, Outcome, give_lessons, guided_lessons, judge
from training.learning.ppo import Log
from training.runs.campaign import worker_pool
from training.runs.running import progress_of_run

__all__ = ["DriveRun", "summary"]

Weights = dict[str, NDArray[np.float32]]

_FIRST_VALIDATION_SEED = 1000


class DriveRun:
    """A training run in a folder: begun there, or gone on with.

    The folder gets ``checkpoint.safetensors`` and ``best.safetensors``, ``progress.json``, ``curve.jsonl`` with a
    line per evaluation, the lessons of each round, and PPO's ``checkpoint.zip`` and TensorBoard files.

    Raises
    ------
    ValueError
        Where the folder holds a run with another configuration.
    """

    def __init__(self, config: DriveConfig, out: Path, *, workers: int, log: Log, command: str = "") -> None:
        self.config, self.out, self._workers, self._log = config, out, workers, log
        self._progress = progress_of_run(
            out, config, command=command, round=0, chunk=0, steps=0, best=None, wall_s=0.0
        )
        self._plan, self._control = PlanNetwork(), ControlNetwork()

    def train(self) -> None:
        """Train to the end; a run broken off anywhere goes on from its last checkpoint."""
        torch.set_num_threads(1)
        self.out.mkdir(parents=True, exist_ok=True)
        self._began = time.perf_counter() - self._progress["wall_s"]
        if (self.out / "checkpoint.safetensors").exists():
            self._take(load_file(self.out / "checkpoint.safetensors"))
        else:
            torch.manual_seed(self.config.seed)
            self._plan, self._control = PlanNetwork(), ControlNetwork()
            self._keep({})
        with worker_pool(self._workers) as pool:
            while self._progress["round"] <= len(self.config.lessons.teacher_shares):
                self._round(self._progress["round"], pool)
            if self.config.ppo.steps > 0:
                self._practise(pool)

    @property
    def weights(self) -> Weights:
        """Both networks' weights, by name."""
        both = self._plan.state_dict() | self._control.state_dict()
        return {name: value.numpy().copy() for name, value in both.items()}

    def _take(self, weights: Weights) -> None:
        for network in (self._plan, self._control):
            network.load_state_dict({name: torch.from_numpy(weights[name]) for name in network.state_dict()})

    # ---- lessons -------------------------------------------------------------------------------------------

    def _round(self, number: int, pool: ProcessPoolExecutor) -> None:
        learning = self.config.learning
        if not (self.out / f"maps-{number}.npz").exists():
            self._give_lessons(number, pool)
        rng = np.random.default_rng([self.config.seed, number])
        torch.manual_seed(int(rng.integers(2**31)))
        maps = _gathered(self.out / f"maps-{k}.npz" for k in range(number + 1))
        steps = learning.map_steps if number == 0 else learning.map_steps_a_round
        rate = learning.map_rate if number == 0 else 0.3 * learning.map_rate
        for line in learn_maps(self._plan, maps, steps=steps, batch=learning.map_batch, rate=rate, rng=rng):
            self._say(f"round {number}: " + _words(line))
        if number > 0:
            rows = _gathered(self.out / f"control-{k}.npz" for k in range(1, number + 1))
            for line in learn_control(
                self._control, rows, steps=learning.control_steps, batch=learning.control_batch,
                rate=learning.control_rate, rng=rng,
            ):  # fmt: skip
                self._say(f"round {number}: " + _words(line))
            self._evaluate(pool, {"round": number})
        self._keep({"round": number + 1})
        self._say(f"round {number} of {len(self.config.lessons.teacher_shares)} done")

    def _give_lessons(self, number: int, pool: ProcessPoolExecutor) -> None:
        lessons, world = self.config.lessons, self.config.world
        rng = np.random.default_rng([self.config.seed, 1000 + number])
        low, high = world.seeds
        share = 1.0 if number == 0 else lessons.teacher_shares[number - 1]
        jobs = [
            self._episode(
                rooms, int(rng.integers(low, high + 1)), int(rng.integers(2**31)), teacher_share=share,
                time_limit_s=lessons.time_limit_s, shaken=lessons.shaken,
            )
            for rooms in world.rooms
            for _ in range(lessons.episodes if number else lessons.guided_episodes)
        ]  # fmt: skip
        found = list(pool.map(give_lessons if number else guided_lessons, jobs))
        if number > 0:
            _save_rows(self.out / f"control-{number}.npz", [rows for _, rows, _ in found])
        _save_rows(self.out / f"maps-{number}.npz", [maps for maps, _, _ in found])  # last: it says all are there
        said = summary(jobs, [outcome for _, _, outcome in found])
        self._say(f"round {number}: lessons of {len(jobs)} episodes, " + _words(said))

    def _episode(self, rooms: str, room_seed: int, seed: int, **more: Any) -> Episode:
        config = self.config
        return Episode(
            rooms=rooms, room_seed=room_seed, seed=seed, weights=self.weights, settings=self._settings,
            uncertainty=config.uncertainty, slam=config.world.slam, noise=config.world.noise,
            teacher=config.lessons.teacher, **more,
        )  # fmt: skip

    @property
    def _settings(self) -> PlanSettings:
        return PlanSettings(goal_m=self.config.goal_m, turn_m=self.config.turn_m)

    # ---- practice ------------------------------------------------------------------------------------------

    def _practise(self, pool: ProcessPoolExecutor) -> None:
        config, ppo, progress = self.config, self.config.ppo, self._progress
        makers = [partial(make_drive_world, config, self.weights, self._settings)] * ppo.environments
        env = VecMonitor(DummyVecEnv(makers))  # type: ignore[arg-type]
        try:
            model = make_model(config, env, self.out)
            policy: Any = model.policy
            if progress["chunk"] > 0:
                model.set_parameters(str(self.out / "checkpoint.zip"), device="cpu")
                model.num_timesteps = progress["steps"]
            else:
                policy.network.load_state_dict(self._control.state_dict())
            size = ppo.chunk * ppo.n_steps * ppo.environments
            chunks = -(-ppo.steps // size)
            for number in range(progress["chunk"], chunks):
                self._learn_chunk(model, env, number, chunks)
                self._control.load_state_dict(policy.network.state_dict())
                if (number + 1) % config.evaluation.every == 0 or number + 1 == chunks:
                    self._evaluate(pool, {"steps": model.num_timesteps})
                new = self.out / ".checkpoint.zip"
                model.save(new)
                new.replace(self.out / "checkpoint.zip")
                self._keep({"chunk": number + 1, "steps": model.num_timesteps})
                self._say(f"chunk {number + 1} of {chunks}: " + _words(_recent(model)))
        finally:
            env.close()

    def _learn_chunk(self, model: PPO, env: VecMonitor, number: int, chunks: int) -> None:
        ppo = self.config.ppo
        seed = int(np.random.SeedSequence([self.config.seed, 2000 + number]).generate_state(1)[0] % 2**31)
        model.set_random_seed(seed)
        env.seed(seed)
        model._last_obs = None  # fresh episodes
        model.lr_schedule = FloatSchedule(ppo.learning_rate * (1.0 - number / chunks))
        policy = model.policy
        assert isinstance(policy, DrivePolicy)
        # The critic knows nothing at first: what it would tell the policy is noise.
        policy.hold_still(number == 0)
        model.learn(ppo.chunk * ppo.n_steps * ppo.environments, reset_num_timesteps=False)

    # ---- keeping count -------------------------------------------------------------------------------------

    def _evaluate(self, pool: ProcessPoolExecutor, at: dict[str, int]) -> None:
        jobs = [
            self._episode(rooms, seed, seed, time_limit_s=self.config.world.time_limit_s)
            for rooms in self.config.world.rooms
            for seed in range(_FIRST_VALIDATION_SEED, _FIRST_VALIDATION_SEED + self.config.evaluation.episodes)
        ]
        result = summary(jobs, list(pool.map(judge, jobs)))
        with (self.out / "curve.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(at | result | {"wall_s": time.perf_counter() - self._began}) + "\n")
        self._say("evaluation: " + _words(at | result))
        if self._progress["best"] is None or result["score"] > self._progress["best"]:
            self._progress["best"] = result["score"]
            atomic_write(self.out / "best.safetensors", save(self.weights))

    def _keep(self, progress: dict[str, int]) -> None:
        atomic_write(self.out / "checkpoint.safetensors", save(self.weights))
        self._progress |= progress | {"wall_s": time.perf_counter() - self._began}
        atomic_write(self.out / "progress.json", json.dumps(self._progress))

    def _say(self, text: str) -> None:
        self._log(f"{text} [{time.perf_counter() - self._began:.0f} s]")


def summary(jobs: list[Episode], outcomes: list[Outcome]) -> dict[str, Any]:
    """Return by family the share of episodes with 90 % covered and the mean time to that; collisions an episode.

    ``score`` is what the best checkpoint is chosen by: the shares' mean, less half the collisions an episode, less
    a tenth of the time as a share of its limit.
    """
    found: dict[str, Any] = {}
    shares, times = [], []
    for rooms in dict.fromkeys(job.rooms for job in jobs):
        own = [(job, end) for job, end in zip(jobs, outcomes, strict=True) if job.rooms == rooms]
        spent = [end.time_to_90_s or job.time_limit_s for job, end in own]
        shares.append(float(np.mean([end.time_to_90_s is not None for _, end in own])))
        times.append(float(np.mean([s / job.time_limit_s for s, (job, _) in zip(spent, own, strict=True)])))
        found |= {f"{rooms}_90": shares[-1], f"{rooms}_90_s": float(np.mean(spent))}
    found["collisions"] = float(np.mean([end.collisions for end in outcomes]))
    found["score"] = float(np.mean(shares)) - 0.5 * found["collisions"] - 0.1 * float(np.mean(times))
    return found


def _gathered(paths: Iterable[Path]) -> dict[str, NDArray[Any]]:
    files = [dict(np.load(path)) for path in paths]
    return {key: np.concatenate([file[key] for file in files]) for key in files[0]}


def _save_rows(path: Path, parts: list[dict[str, NDArray[Any]]]) -> None:
    new = path.with_name(f".{path.name}")
    np.savez(new, **{key: np.concatenate([part[key] for part in parts]) for key in parts[0]})  # type: ignore[arg-type]
    new.replace(path)


def _recent(model: PPO) -> dict[str, float]:
    """Return what the last rollouts were like."""
    episodes = list(model.ep_info_buffer or [])
    found = {"return": float(np.mean([e["r"] for e in episodes])) if episodes else float("nan")}
    values = model.logger.name_to_value
    for name in ("approx_kl", "explained_variance", "std"):
        if f"train/{name}" in values:
            found[name] = float(values[f"train/{name}"])
    return found


def _words(values: dict[str, Any]) -> str:
    return ", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in values.items())
