"""Training of ``ppo``, the end-to-end policy: rounds of lessons, then PPO, resumable to the bit.

A round follows from the weights that the one before it left, from the lessons kept in the folder, and from random
numbers of its own, drawn by the run's seed and its number.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import load_file, save
from stable_baselines3.common.vec_env import VecMonitor

from agents.learned.drive_network import DriveNetwork
from slam.formats import atomic_write, replacing
from training.learning.config import FIRST_VALIDATION_SEED
from training.learning.end_to_end.config import DriveConfig
from training.learning.end_to_end.imitation import learn_control, learn_maps
from training.learning.end_to_end.networks import ControlNetwork, PlanNetwork
from training.learning.end_to_end.ppo import DrivePolicy, DriveWorld, make_model
from training.learning.end_to_end.rollouts import Episode, Outcome, give_lessons, guided_lessons, judge
from training.learning.folder import FolderRun, words
from training.learning.vec_env import ExploreVecEnv
from training.runs.campaign import Pool
from training.runs.processes import one_thread_each

__all__ = ["DriveRun", "summary"]

Weights = dict[str, NDArray[np.float32]]


class DriveRun(FolderRun):
    """A run of rounds, then of chunks of rollouts.

    The folder gets ``checkpoint.safetensors``, ``best.safetensors`` and the lessons of each round, too.
    """

    config: DriveConfig
    seeds_from = 2000

    def _train(self, pool: Pool) -> None:
        torch.manual_seed(self.config.seed)
        self._plan, self._control = PlanNetwork(), ControlNetwork()
        checkpoint = self.out / "checkpoint.safetensors"
        if checkpoint.exists():
            weights = load_file(checkpoint)
            for network in (self._plan, self._control):
                network.load_state_dict({name: torch.from_numpy(weights[name]) for name in network.state_dict()})
        while self._progress["round"] <= len(self.config.lessons.teacher_shares):
            self._round(self._progress["round"], pool)
        if self.config.ppo.steps > 0:
            self._practise(pool)

    def _catch_up(self) -> None:
        """Take a round for done, too, where the run was killed after its checkpoint, before the note of it."""
        super()._catch_up()
        checkpoint = self.out / "checkpoint.safetensors"
        if checkpoint.exists():
            self._progress["round"] = max(self._progress["round"], _rounds_of(checkpoint))

    def _needed(self) -> list[str]:
        """Return the names of the files that the run goes on from, past lessons where there are rounds to come."""
        done = self._progress["round"]
        if done == 0:
            return super()._needed()
        past = range(done if done <= len(self.config.lessons.teacher_shares) else 0)
        lessons = [f"maps-{k}.npz" for k in past] + [f"control-{k}.npz" for k in past[1:]]
        return ["checkpoint.safetensors", *lessons, *super()._needed()]

    @property
    def weights(self) -> Weights:
        """Both networks' weights, by name."""
        both = self._plan.state_dict() | self._control.state_dict()
        return {name: value.numpy().copy() for name, value in both.items()}

    # ---- lessons -------------------------------------------------------------------------------------------

    def _round(self, number: int, pool: Pool) -> None:
        learning = self.config.learning
        if not (self.out / f"maps-{number}.npz").exists():
            self._give_lessons(number, pool)
        rng = np.random.default_rng([self.config.seed, number])
        torch.manual_seed(int(rng.integers(2**31)))
        maps = _gathered(self.out / f"maps-{k}.npz" for k in range(number + 1))
        steps = learning.map_steps if number == 0 else learning.map_steps_a_round
        rate = learning.map_rate if number == 0 else 0.3 * learning.map_rate
        for line in learn_maps(self._plan, maps, steps=steps, batch=learning.map_batch, rate=rate, rng=rng):
            self._say(f"round {number}: " + words(line))
        if number > 0:
            rows = _gathered(self.out / f"control-{k}.npz" for k in range(1, number + 1))
            for line in learn_control(
                self._control, rows, steps=learning.control_steps, batch=learning.control_batch,
                rate=learning.control_rate, rng=rng,
            ):  # fmt: skip
                self._say(f"round {number}: " + words(line))
            self._evaluate(pool, {"round": number})
        self._save("checkpoint", number + 1)
        self._keep(round=number + 1)
        self._say(f"round {number} of {len(self.config.lessons.teacher_shares)} done")

    def _give_lessons(self, number: int, pool: Pool) -> None:
        config, weights = self.config, self.weights
        lessons, world = config.lessons, config.world
        rng = np.random.default_rng([self.config.seed, 1000 + number])
        low, high = world.seeds
        share = 1.0 if number == 0 else lessons.teacher_shares[number - 1]
        jobs = [
            Episode(
                config, weights, rooms, int(rng.integers(low, high + 1)), int(rng.integers(2**31)),
                lessons.time_limit_s, share,
            )
            for rooms in world.rooms
            for _ in range(lessons.episodes if number else lessons.guided_episodes)
        ]  # fmt: skip
        found = list(pool.map(give_lessons if number else guided_lessons, jobs))
        if number > 0:
            _save_rows(self.out / f"control-{number}.npz", [rows for _, rows, _ in found])
        _save_rows(self.out / f"maps-{number}.npz", [maps for maps, _, _ in found])  # last: it says all are there
        said = summary(jobs, [outcome for _, _, outcome in found])
        self._say(f"round {number}: lessons of {len(jobs)} episodes, " + words(said))

    # ---- practice ------------------------------------------------------------------------------------------

    def _practise(self, pool: Pool) -> None:
        config, ppo = self.config, self.config.ppo
        network = DriveNetwork(self.weights, config.planning, uncertainty=config.uncertainty)
        world = partial(DriveWorld, config.world, network)
        workers = self._workers if isinstance(self._workers, int) else None  # in this machine, in any case
        with one_thread_each():
            envs = ExploreVecEnv(
                ppo.environments, make=world, workers=workers, max_episode_steps=None, context="spawn"
            )
        env = VecMonitor(envs)
        try:
            model = make_model(config, env, device=self._device)
            policy = cast("DrivePolicy", model.policy)
            policy.network.load_state_dict(self._control.state_dict())

            def prepare(number: int) -> None:
                # The critic knows nothing at first: what it would tell the policy is noise.
                policy.hold_still(number == 0)

            def try_out() -> None:
                if self._progress["chunk"] > 0:
                    self._control.load_state_dict(policy.network.state_dict())
                    self._evaluate(pool, {"steps": self._progress["steps"]})
                    self._save("checkpoint", self._progress["round"])

            self._learn(model, env, ppo, every=config.evaluation.every, try_out=try_out, prepare=prepare)
        finally:
            env.close()

    def _evaluate(self, pool: Pool, at: dict[str, int]) -> None:
        config, weights = self.config, self.weights
        jobs = [
            Episode(config, weights, rooms, seed, seed, config.world.time_limit_s)
            for rooms in config.world.rooms
            for seed in range(FIRST_VALIDATION_SEED, FIRST_VALIDATION_SEED + config.evaluation.episodes)
        ]
        result = summary(jobs, list(pool.map(judge, jobs)))
        # What differs by less than a hundredth is chance: of those the weights that have practised most are kept.
        self._note_trial(at, result, -round(result["score"], 2), partial(self._save, "best"))

    def _save(self, name: str, rounds: int = 0) -> None:
        atomic_write(self.out / f"{name}.safetensors", save(self.weights, {"rounds": str(rounds)}))


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


def _rounds_of(path: Path) -> int:
    """Return how many rounds a checkpoint's weights have learned from."""
    try:
        with safe_open(path, "numpy") as file:
            return int((file.metadata() or {}).get("rounds", 0))
    except (SafetensorError, OSError, ValueError) as error:
        raise ValueError(f"{path} is no checkpoint of a run; choose another --out") from error


def _gathered(paths: Iterable[Path]) -> dict[str, NDArray[Any]]:
    files = [dict(np.load(path)) for path in paths]
    return {key: np.concatenate([file[key] for file in files]) for key in files[0]}


def _save_rows(path: Path, parts: list[dict[str, NDArray[Any]]]) -> None:
    with replacing(path) as new:
        np.savez(new, **{key: np.concatenate([part[key] for part in parts]) for key in parts[0]})  # type: ignore[arg-type]
