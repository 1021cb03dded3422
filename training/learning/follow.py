"""Who else is told how a training run goes: nobody, or Weights & Biases."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stable_baselines3.common.logger import KVWriter

from training.runs.errors import BadInput, one_line

__all__ = ["Follow", "Note", "Sink"]

Note = Callable[[Mapping[str, Any]], None]
"""Takes down named numbers, ``steps`` among them."""


@dataclass(frozen=True)
class Follow:
    """Where a run is followed; members of an ensemble, in processes of their own, are each a run there."""

    project: str | None = None  # of Weights & Biases; None: nowhere

    @contextmanager
    def noting(self, out: Path, *, config: Mapping[str, Any], identity: str) -> Iterator[Note]:
        """Give what takes notes while a run in the folder ``out`` goes on; the same identity goes on with its run.

        Raises
        ------
        BadInput
            In one line, where Weights & Biases does not take the run.
        """
        if self.project is None:
            yield lambda _: None
            return
        import wandb

        # No source, console or state of a repository is sent: numbers and the configuration are.
        quiet = wandb.Settings(console="off", disable_code=True, disable_git=True)
        try:
            run = wandb.init(
                project=self.project, name="/".join(out.absolute().parts[-2:]), id=identity, resume="allow",
                config=dict(config), dir=str(out), settings=quiet,
            )  # fmt: skip
            run.define_metric("*", step_metric="steps")  # a resumed run repeats some
        except (wandb.Error, OSError) as error:
            raise BadInput(
                f"--wandb {self.project}: {one_line(error)}; log in by `wandb login`, or set WANDB_MODE=offline"
            ) from error
        try:
            yield lambda values: run.log({k: v for k, v in values.items() if isinstance(v, int | float)})
        except BaseException:
            run.finish(exit_code=1)
            raise
        run.finish()


class Sink(KVWriter):
    """What stable-baselines3 hands its numbers to, each rollout's and update's."""

    def __init__(self, note: Note) -> None:
        self._note = note

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, Any], step: int = 0) -> None:
        """Hand on the numbers of a step."""
        self._note({**{name: _plain(value) for name, value in key_values.items()}, "steps": step})

    def close(self) -> None:
        """There is nothing to close."""


def _plain(value: Any) -> Any:
    return value.item() if hasattr(value, "item") and getattr(value, "size", 0) == 1 else value
