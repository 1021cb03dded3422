"""What every training run does: keep to a folder, learn in chunks of rollouts, note trials, go on after a kill.

Each chunk begins with fresh episodes and random numbers that follow from the run's seed and the chunk's number
alone, so that a run that was killed and resumed is the one that was not, bit for bit.
"""

from __future__ import annotations

import json
import secrets
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import FloatSchedule
from stable_baselines3.common.vec_env import VecEnv

from slam.files import quoted, read_json
from slam.formats import atomic_write, replacing
from slam.settings import to_mapping
from training.learning.config import PpoConfig
from training.learning.follow import Follow, Sink
from training.runs.campaign import Pool, Workers, worker_pool

__all__ = ["FolderRun", "save_model", "seed_of", "words"]

NOBODY = Follow()

_LEFT = (
    "checkpoint.zip", "checkpoint.safetensors", "best.zip", "best.safetensors", "curve.jsonl", "maps-*.npz",
    "control-*.npz", "member-*",
)  # fmt: skip
"""What a run leaves in its folder beside its note."""


class FolderRun:
    """A training run in a folder: begun there, or gone on with.

    The folder gets ``progress.json``, where ``command`` is noted for the policies that are exported;
    ``curve.jsonl`` with a line per evaluation; of stable-baselines3 ``checkpoint.zip``, of TensorBoard ``log``.
    PPO's networks learn on a ``device`` of torch's; only on a processor are they the same again, bit for bit.

    Raises
    ------
    ValueError
        Where the folder holds a run with another configuration, or one whose files are damaged, or not all there.
    """

    seeds_from = 0
    """Number of the first chunk's seed."""

    def __init__(
        self, config: Any, out: Path, *, workers: Workers, log: Callable[[str], None], command: str = "",
        follow: Follow = NOBODY, device: str = "cpu",
    ) -> None:  # fmt: skip
        self.config, self.out, self._workers, self._log, self._follow = config, out, workers, log, follow
        self._device = device
        settings = json.loads(json.dumps(to_mapping(config)))
        self._progress: dict[str, Any] = {
            "config": settings, "command": command, "round": 0, "chunk": 0, "steps": 0, "best": None,
            "best_in": "", "wall_s": 0.0, "done": False, "identity": secrets.token_hex(8),
        }  # fmt: skip
        path = out / "progress.json"
        if not path.exists():
            self._check_empty()
            return
        self._progress |= self._noted(path)
        if self._progress["config"] != settings:
            raise ValueError(f"{out} holds a run with another configuration; choose another --out")
        if not self._progress["done"]:
            self._catch_up()
            self._check_files()

    def _noted(self, path: Path) -> dict[str, Any]:
        """Return what an earlier process noted; ``ValueError`` where the file says nothing of the kind."""
        found = read_json(path, nan=True)
        kinds: dict[str, Any] = {"best": (int, float, type(None)), "wall_s": (int, float)}
        for name, usual in self._progress.items():
            value: Any = found.get(name, usual) if isinstance(found, dict) else None
            if not isinstance(value, kinds.get(name, type(usual))) or (type(usual) is int and value < 0):
                raise ValueError(f"{path} is damaged: {name} is {quoted(value)}; choose another --out")
        return dict(found)

    def _check_empty(self) -> None:
        """Raise ``ValueError`` where files of a run would be taken for this one's."""
        found = sorted(path.name for pattern in _LEFT for path in self.out.glob(pattern))
        if found:
            raise ValueError(
                f"{self.out} holds {found[0]} of a run, but no progress.json; empty it, or choose another --out"
            )

    def _check_files(self) -> None:
        """Raise ``ValueError`` where a file that the run goes on from is missing or damaged."""
        for name in self._needed():
            path = self.out / name
            if not path.exists():
                raise ValueError(f"{path} is missing, and the run goes on from it; choose another --out")
            if path.suffix == ".npz" and not zipfile.is_zipfile(path):
                raise ValueError(f"{path} is damaged, and the run goes on from it; choose another --out")
        _read_curve(self.out / "curve.jsonl")

    def _needed(self) -> list[str]:
        """Return the names of the files that the run goes on from."""
        return ["checkpoint.zip"] if self._progress["chunk"] > 0 else []

    def _catch_up(self) -> None:
        """Take the last chunk for learned where the run was killed after its checkpoint, before the note of it."""
        checkpoint = self.out / "checkpoint.zip"
        if checkpoint.exists() and (steps := _steps_of(checkpoint)) > self._progress["steps"]:
            self._progress |= {"chunk": self._progress["chunk"] + 1, "steps": steps}

    def train(self) -> None:
        """Train to the end; a run broken off anywhere goes on from its last checkpoint, a finished one is left."""
        if self._progress["done"]:
            return
        torch.set_num_threads(1)
        self.out.mkdir(parents=True, exist_ok=True)
        self._began = time.perf_counter() - self._progress["wall_s"]
        self._keep()
        progress = self._progress
        about = {**progress["config"], "command": progress["command"]}
        with (
            self._follow.noting(self.out, config=about, identity=progress["identity"]) as self._note,
            worker_pool(self._workers) as pool,
        ):
            self._train(pool)
        self._keep(done=True)

    def _train(self, pool: Pool) -> None:
        raise NotImplementedError

    def _learn(
        self, model: OnPolicyAlgorithm, env: VecEnv, ppo: PpoConfig, *, every: int, try_out: Callable[[], None],
        stage: str = "ppo", first: int = 0, prepare: Callable[[int], BaseCallback | None],
    ) -> None:  # fmt: skip
        """Go through what is left of a stage, from the last checkpoint if there is one.

        Parameters
        ----------
        model, env, ppo
            What learns, where, and how.
        every, try_out
            What is done before the first of every so many chunks, and at the end.
        stage, first
            Name of the stage, and number of its first chunk.
        prepare
            Called with a chunk's number before it is learned; returns what stable-baselines3 calls back.
        """
        progress, checkpoint = self._progress, self.out / "checkpoint.zip"
        logger = configure(str(self.out / "log"), ["tensorboard"])
        logger.output_formats.append(Sink(self._note))
        model.set_logger(logger)
        model.num_timesteps = progress["steps"]
        if progress["chunk"] > first:
            model.set_parameters(str(checkpoint), device=self._device)
        while (done := progress["chunk"] - first) < ppo.chunks:
            if done % every == 0:
                try_out()
            seed = seed_of(self.config.seed, self.seeds_from + progress["chunk"])
            model.set_random_seed(seed)
            env.seed(seed)
            model._last_obs = None  # fresh episodes
            model.lr_schedule = FloatSchedule(ppo.learning_rate * (1.0 - done / ppo.chunks))
            model.learn(ppo.size, callback=prepare(progress["chunk"]), reset_num_timesteps=False)
            save_model(model, checkpoint)
            self._keep(chunk=progress["chunk"] + 1, steps=model.num_timesteps)
            self._say(f"{stage}, chunk {done + 1} of {ppo.chunks}: " + words(_recent(model)))
        try_out()

    def _note_trial(
        self, at: dict[str, Any], result: dict[str, Any], cost: float, save: Callable[[], None]
    ) -> None:
        """Add a trial to the curve; ``save`` the weights, of equals the last, if none in this stage cost less."""
        path = self.out / "curve.jsonl"
        # A run killed after a trial repeats it: one line of it is enough.
        kept = [line for line in _read_curve(path) if not at.items() <= line.items()]
        line = at | result | {"wall_s": time.perf_counter() - self._began}
        atomic_write(path, "".join(json.dumps(each) + "\n" for each in [*kept, line]))
        self._say("evaluation: " + words(at | result))
        noted = {f"evaluation/{name}": value for name, value in result.items()}
        self._note({"steps": self._progress["steps"], **at, **noted})
        stage, best = at.get("stage", ""), self._progress["best"]
        # Seconds of a rehearsal are not those of the whole environment.
        if best is None or self._progress["best_in"] != stage or cost <= best:
            save()
            self._keep(best=cost, best_in=stage)

    def _keep(self, **progress: Any) -> None:
        self._progress |= progress | {"wall_s": time.perf_counter() - self._began}
        atomic_write(self.out / "progress.json", json.dumps(self._progress))

    def _say(self, text: str) -> None:
        self._log(f"{text} [{time.perf_counter() - self._began:.0f} s]")


def _read_curve(path: Path) -> list[dict[str, Any]]:
    """Return a run's evaluations, none where there is no file; ``ValueError`` where a line is none."""
    found = []
    for number, line in enumerate(path.read_bytes().splitlines() if path.exists() else [], 1):
        try:
            found.append(dict(json.loads(line)))
        except (ValueError, TypeError) as error:
            raise ValueError(
                f"{path} is damaged in line {number}; remove that line, or choose another --out"
            ) from error
    return found


def seed_of(*numbers: int) -> int:
    """Return a seed that follows from several numbers."""
    return int(np.random.SeedSequence(numbers).generate_state(1)[0] % 2**31)


def save_model(model: OnPolicyAlgorithm, path: Path) -> None:
    """Write a zip of stable-baselines3, whole or not at all."""
    with replacing(path) as new:
        model.save(new)


def _steps_of(path: Path) -> int:
    """Return the steps that a zip of :func:`save_model` has learned from."""
    try:
        with zipfile.ZipFile(path) as archive:
            return int(json.loads(archive.read("data"))["num_timesteps"])
    except (zipfile.BadZipFile, OSError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is no checkpoint of a run; choose another --out") from error


def words(values: dict[str, Any]) -> str:
    """Return values as a line of the log says them."""
    return ", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in values.items())


def _recent(model: OnPolicyAlgorithm) -> dict[str, float]:
    """Return what the last rollouts were like: an episode's return and steps, and how learning went."""
    episodes = list(model.ep_info_buffer or [])
    found = {
        name: float(np.mean([e[key] for e in episodes])) if episodes else float("nan")
        for name, key in (("return", "r"), ("steps", "l"))
    }
    names = ("approx_kl", "explained_variance", "entropy_loss", "std")
    values = {name: model.logger.name_to_value.get(f"train/{name}") for name in names}
    return found | {name: float(value) for name, value in values.items() if value is not None}
