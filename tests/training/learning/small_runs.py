"""Training runs of seconds, killed where a test wants them to be, and what they leave."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from slam.settings import from_mapping
from training.learning.config import TrainConfig
from training.learning.ppo import Run

SMALL = {
    "world": {"rooms": ["rectangular"]},
    "ppo": {"steps": 48, "environments": 2, "n_steps": 8, "chunk": 1, "batch_size": 16},
    "evaluation": {"episodes": 1, "every": 2},
}


class Killed(Exception):
    pass


REHEARSED = SMALL | {
    "rehearsal": {
        "steps": 32, "environments": 2, "n_steps": 8, "chunk": 1, "batch_size": 16, "every": 2, "episodes": 1,
        "shaping_s_m": 1.3,
    },
    "ppo": SMALL["ppo"] | {"steps": 16},
}  # fmt: skip


@contextmanager
def here() -> Iterator[None]:
    """Have trials made in this process: starting another takes longer than they do."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("training.learning.folder.worker_pool", lambda _: nullcontext(SimpleNamespace(map=map)))
        yield


def run(
    out: Path, *, kill_after: str | None = None, config: dict = SMALL, workers: int = 2, device: str = "cpu"
) -> list[str]:
    """Train; with one worker all is done in this process."""
    said: list[str] = []

    def log(text: str) -> None:
        said.append(text)
        if kill_after is not None and text.startswith(kill_after):
            raise Killed

    with here() if workers == 1 else nullcontext():
        Run(from_mapping(TrainConfig, config), out, workers=workers, log=log, device=device).train()
    return said


def curve(out: Path) -> list[dict]:
    return [json.loads(line) for line in (out / "curve.jsonl").read_text().splitlines()]


def same_weights(one, other):
    assert one.keys() == other.keys()
    for name, weights in one.items():
        np.testing.assert_array_equal(weights, other[name])


def halved(weights):
    """As a policy's file has them."""
    return {name: value.astype(np.float16).astype(np.float32) for name, value in weights.items()}
