"""Several networks, trained apart from one seed, that choose together.

What PPO comes to from other random weights errs elsewhere: the mean of what they hold likely shall err less.
"""

from __future__ import annotations

import json
import multiprocessing
import queue
import time
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from agents.learned.choice_network import joined
from slam.formats import atomic_write
from training.learning.config import TrainConfig
from training.learning.networks import read_zip
from training.learning.ppo import Log, Run, Weights, evaluate, trials_in_full
from training.runs.campaign import worker_pool
from training.runs.running import progress_of_run

__all__ = ["EnsembleRun", "best_weights", "curve_of"]


class EnsembleRun:
    """A run for each member, in folders ``member-1``, ``member-2`` and so on, and a trial of all at the end.

    The folder itself gets ``progress.json`` and ``curve.jsonl``; a member that is done is not trained again. As
    many members as there are workers are trained at a time, each in one process.

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
        self._began = time.perf_counter() - self._progress["wall_s"]
        self._keep_progress()
        if not self._progress["done"]:
            self._train_members()
            self._evaluate()

    def _train_members(self) -> None:
        jobs = [
            (replace(self.config, members=1, seed=_seed_of(self.config.seed, number)), folder)
            for number, folder in enumerate(_folders(self.config, self.out))
        ]
        command = self._progress["command"]
        with multiprocessing.get_context("spawn").Manager() as manager, worker_pool(self._workers) as pool:
            said = manager.Queue()
            futures = [pool.submit(_train_member, *job, f"{command}: {job[1].name}", said) for job in jobs]
            while not said.empty() or not all(future.done() for future in futures):
                self._pass_on(said, futures)
        for future in futures:
            future.result()

    def _pass_on(self, said: queue.Queue[tuple[str, str]], futures: list[Future[None]]) -> None:
        """Log what a member says next, if any does within a second; raise what one failed of."""
        try:
            name, text = said.get(timeout=1.0)
            self._keep_progress()
            self._log(f"{name}: {text}")
        except queue.Empty:
            for future in futures:
                if future.done():
                    future.result()

    def _keep_progress(self) -> None:
        if not self._progress["done"]:
            self._progress["wall_s"] = time.perf_counter() - self._began
        atomic_write(self.out / "progress.json", json.dumps(self._progress))

    def _evaluate(self) -> None:
        with worker_pool(self._workers) as pool:
            weights = best_weights(self.config, self.out)
            result = evaluate(weights, self.config.heads, trials_in_full(self.config), pool)
        members = [
            json.loads((folder / "progress.json").read_text()) for folder in _folders(self.config, self.out)
        ]
        self._progress["steps"] = sum(member["steps"] for member in members)
        self._keep_progress()
        line = {"stage": "all members", **result} | {key: self._progress[key] for key in ("steps", "wall_s")}
        atomic_write(self.out / "curve.jsonl", json.dumps(line) + "\n")
        self._progress["done"] = True
        self._keep_progress()
        self._log(f"all members: {result['time_to_95_s']:.2f} s to 95 %, {result['collisions']} collisions")


def _train_member(config: TrainConfig, out: Path, command: str, said: queue.Queue[tuple[str, str]]) -> None:
    def log(text: str) -> None:
        said.put((out.name, text))

    Run(config, out, workers=1, log=log, command=command).train()


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
