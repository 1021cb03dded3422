"""Several networks, trained apart from one seed, that choose together.

What PPO comes to from other random weights errs elsewhere: the mean of what they hold likely shall err less.
"""

from __future__ import annotations

import json
import queue
import socket
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

from agents.learned.choice_network import joined
from training.learning.config import TrainConfig
from training.learning.folder import FolderRun, seed_of
from training.learning.follow import Follow
from training.learning.networks import read_zip
from training.learning.ppo import Run
from training.learning.trials import Weights, evaluate, trials_in_full
from training.runs.campaign import Pool
from training.runs.errors import BadInput

__all__ = ["EnsembleRun", "best_weights", "curve_of"]


class EnsembleRun(FolderRun):
    """A run for each member, in folders ``member-1``, ``member-2`` and so on, and a trial of all at the end.

    A member that is done is not trained again. As many members as there are workers are trained at a time, each in
    one process, or with processes for its environments where there are workers left; it writes into the member's
    folder: the nodes of a cluster have to share it.
    """

    config: TrainConfig

    def _check_files(self) -> None:
        """Raise ``ValueError`` where a member cannot go on, before any does."""
        super()._check_files()
        for config, folder in self._members():
            Run(config, folder, workers=1, log=self._log)

    def _members(self) -> list[tuple[TrainConfig, Path]]:
        """Return the members' configurations and folders."""
        config = self.config
        folders = enumerate(_folders(config, self.out))
        return [(replace(config, members=1, seed=seed_of(config.seed, k)), folder) for k, folder in folders]

    def _train(self, pool: Pool) -> None:
        members = self._members()
        each = max(1, self._workers // self.config.members) if isinstance(self._workers, int) else 1
        with pool.channel() as said:
            futures = []
            for config, folder in members:
                command = f"{self._progress['command']}: {folder.name}"
                about = config, folder, command, said, self._follow, self._device, each
                futures.append(pool.submit(_train_member, *about))
            while not said.empty() or not all(future.done() for future in futures):
                self._pass_on(said, futures)
        for future in futures:
            future.result()
        steps = sum(json.loads((folder / "progress.json").read_text())["steps"] for _, folder in members)
        self._keep(steps=steps)
        weights = best_weights(self.config, self.out)
        result = evaluate(weights, self.config.heads, trials_in_full(self.config), pool)
        at = {"stage": "all members", "steps": steps}
        self._note_trial(at, result, result["time_to_95_s"], lambda: None)

    def _pass_on(self, said: queue.Queue[tuple[str, str]], futures: list[Future[None]]) -> None:
        """Log what a member says next, if any does within a second; raise what one failed of."""
        try:
            name, text = said.get(timeout=1.0)
            self._keep()
            self._log(f"{name}: {text}")
        except queue.Empty:
            for future in futures:
                if future.done():
                    future.result()


def _train_member(
    config: TrainConfig, out: Path, command: str, said: queue.Queue[tuple[str, str]], follow: Follow, device: str,
    workers: int,
) -> None:  # fmt: skip
    def log(text: str) -> None:
        said.put((out.name, text))

    if not (out.parent / "progress.json").exists():
        raise BadInput(
            f"{socket.gethostname()} has no {out.parent}: members are trained into --out; give a folder "
            "that every node shares"
        )

    Run(config, out, workers=workers, log=log, command=command, follow=follow, device=device).train()


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
