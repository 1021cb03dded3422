"""Training runs of seconds, killed where a test wants them to be, and what they leave."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

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


def run(
    out: Path, *, kill_after: str | None = None, config: dict = SMALL, workers: int = 2, device: str = "cpu"
) -> list[str]:
    said: list[str] = []

    def log(text: str) -> None:
        said.append(text)
        if kill_after is not None and text.startswith(kill_after):
            raise Killed

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
