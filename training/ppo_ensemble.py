"""Several networks, trained apart from one seed, that choose together.

What PPO comes to from other random weights errs elsewhere: the mean of what they hold likely shall err less.
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from agents.choice_network import joined
from slam.formats import atomic_write
from training.campaign import worker_pool
from training.networks import read_zip
from training.ppo import Log, Run, Weights, evaluate, trials_in_full
from training.running import progress_of_run
from training.train_config import TrainConfig

__all__ = ["EnsembleRun", "best_weights", "curve_of"]


class EnsembleRun:
    """A run for each member, in folders ``member-1``, ``member-2`` and so on, and a trial of all at the end.

    The folder itself gets ``progress.json`` and ``curve.jsonl``; a member that is done is not trained again.

    Raises
    ------
    ValueError
        Where the folder holds a run with another configuration.
    """

    def __init__(self, config: TrainConfig, out: Path, *, workers: int, log: Log, command: str = "") -> None:
        self.config, self.out, self._workers, self._log = config, out, workers, log
        self._progress = progress_of_run(out, config, command=command, steps=0, wall_s=0.0, done=False)

    def train(self) -> None:
        """Train to the end; a run broken off anywhere goes on from its last checkpoint."""
        self.out.mkdir(parents=True, exist_ok=True)
        progress = self._progress
        atomic_write(self.out / "progress.json", json.dumps(progress))
        for number, folder in enumerate(_folders(self.config, self.out)):
            run = Run(
                replace(self.config, members=1, seed=_seed_of(self.config.seed, number)), folder,
                workers=self._workers, log=partial(self._say, folder.name),
                command=f"{progress['command']}: {folder.name}",
            )  # fmt: skip
            run.train()
        if not progress["done"]:
            self._evaluate()

    def _say(self, name: str, text: str) -> None:
        self._log(f"{name}: {text}")

    def _evaluate(self) -> None:
        with worker_pool(self._workers) as pool:
            weights = best_weights(self.config, self.out)
            result = evaluate(weights, self.config.heads, trials_in_full(self.config), pool)
        members = [
            json.loads((folder / "progress.json").read_text()) for folder in _folders(self.config, self.out)
        ]
        progress = self._progress
        progress |= {key: sum(member[key] for member in members) for key in ("steps", "wall_s")} | {"done": True}
        line = {"stage": "all members", "steps": progress["steps"], **result, "wall_s": progress["wall_s"]}
        atomic_write(self.out / "curve.jsonl", json.dumps(line) + "\n")
        atomic_write(self.out / "progress.json", json.dumps(progress))
        self._say("all members", f"{result['time_to_95_s']:.2f} s to 95 %, {result['collisions']} collisions")


def best_weights(config: TrainConfig, out: Path) -> Weights:
    """Return the best weights in a run's folder; of an ensemble's, those of all members."""
    return joined([read_zip(folder / "best.zip") for folder in _folders(config, out)])


def curve_of(config: TrainConfig, out: Path) -> list[dict[str, Any]]:
    """Return a run's evaluations; of an ensemble's, those of the members first."""
    folders = _folders(config, out)
    lines = [{"member": folder.name} | line for folder in folders for line in _read(folder)]
    return _read(out) if folders == [out] else lines + _read(out)


def _read(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "curve.jsonl").read_text(encoding="utf-8").splitlines()]


def _folders(config: TrainConfig, out: Path) -> list[Path]:
    return [out] if config.members == 1 else [out / f"member-{k + 1}" for k in range(config.members)]


def _seed_of(seed: int, number: int) -> int:
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0] % 2**31)
