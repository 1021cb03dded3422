"""What is run: every environment, room, backend, noise, robot and driver, paired by chance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

import agents
import slam
from mecanum_env import rooms
from mecanum_env.config import NoiseConfig
from training.studies.reliability.steps.actions import POLICIES

__all__ = ["KINDS", "NOISES", "ROOMS", "TEAMS", "Item", "items", "settings"]

KINDS = ("single", "wheels", "team", "single", "batch", "single", "frontier")
"""Environments, the single one oftener: it takes every agent."""

_DRAWN = "drawn plan"
ROOMS = (*sorted(rooms.names()), _DRAWN)
"""Generators, and a plan read from an image that is drawn."""

_HARSH = NoiseConfig(
    range_sigma_m=0.2, dropout=0.5, encoder=0.3, radius_error=0.2, base_error=0.2, slip=0.5, friction=0.1,
    patch_share=0.5, patch_friction=(0.01, 0.1),
)  # fmt: skip
_NONE = NoiseConfig(range_sigma_m=0.0, dropout=0.0, encoder=0.0, radius_error=0.0, base_error=0.0)
NOISES: dict[str, str | NoiseConfig] = {
    "nominal": "nominal", "slippery": "slippery", "cavity": "cavity", "harsh": _HARSH, "none": _NONE,
}  # fmt: skip
"""Noise presets, one beyond them all, and none."""

ROBOTS = ("youbot", "cavity")

TEAMS: dict[str, dict[str, Any]] = {
    "together": {}, "scattered": {"starts": "scattered", "communication": {"model": "line-of-sight"}},
    "walls": {"communication": {"model": "walls", "every_s": 0.3}}, "silent": {"communication": {"model": "none"}},
    "unknown starts": {"known_starts": False, "starts": "scattered"},
    "unsure starts": {"start_sigma_m": 0.3, "start_sigma_rad": 0.2}, "joint": {"belief": "joint"},
}  # fmt: skip
"""How robots of a team begin and hear each other."""

_JOINT_COV = ("ekf", "ekf-lines", "invariant-ekf", "compressed-ekf")  # what frames are found with

_DRIVERS = {
    "single": (*POLICIES, *agents.names()), "team": (*POLICIES, *agents.names()), "wheels": POLICIES,
    "batch": tuple(name for name in POLICIES if name != "adversarial"),
    "frontier": ("uniform", "constant", "extreme", "nonsense"),
}  # fmt: skip

_AT_ONCE = 4000  # steps of an item that takes as long as most
_LEAST = 20
_MOST = 4  # times as many steps where one takes less

# Of the processor, in thousandths of a second: only how many steps an item has hangs on them.
_TYPICAL_MS, _STEP_MS, _RESET_MS = 1.0, 0.3, 40.0
_BACKEND_MS = {
    "truth": 0.05, "odometry": 0.05, "fastslam1": 0.4, "fastslam2": 0.6, "dp-slam": 1.0, "graph-slam": 1.0,
}  # fmt: skip
_OTHER_BACKEND_MS = 0.2
_AGENT_MS = {"random": 0.1, "next-best-view": 4.0, "rrt": 2.0, "ppo-frontier": 2.0, "team-frontier": 2.0}
_OTHER_AGENT_MS = 1.0


class Item(NamedTuple):
    """One work item: what is run, for how many steps, and whether it is run again in another process."""

    kind: str
    rooms: str
    slam: str
    noise: str
    robot: str
    driver: str
    team: str
    limit: int  # of an episode's steps
    seed: int
    steps: int
    again: int = 0


@dataclass
class _Deck:
    """Draws names as cards: all have come up before one comes up again."""

    names: Sequence[Any]
    rng: np.random.Generator

    def __post_init__(self) -> None:
        self._left: list[Any] = []

    def draw(self) -> Any:
        if not self._left:
            self._left = [self.names[k] for k in self.rng.permutation(len(self.names))]
        return self._left.pop()


def items(steps: int, seed: int) -> list[Item]:
    """Return items of so many steps in all, those of a larger number the same and more of them.

    Each takes about as long as another: where a step is dear, there are fewer of them.
    """
    each = min(max(steps // 50, _LEAST), _AT_ONCE)
    rng = np.random.default_rng([seed, 0])
    rooms_, backends, noises = _Deck(ROOMS, rng), _Deck(slam.names(), rng), _Deck(tuple(NOISES), rng)
    robots, teams, limits = _Deck(ROBOTS, rng), _Deck(tuple(TEAMS), rng), _Deck((60, 250, 3000), rng)
    drivers = {kind: _Deck(names, rng) for kind, names in _DRIVERS.items()}
    made: list[Item] = []
    left = steps
    while left > 0:
        k = len(made)
        kind = KINDS[k % len(KINDS)]
        backend, team = backends.draw(), teams.draw() if kind == "team" else "-"
        if team == "joint" or (team in ("unknown starts", "unsure starts") and backend not in _JOINT_COV):
            backend = "ekf-lines"
        item = Item(
            kind, rooms_.draw(), backend, noises.draw(), robots.draw(), drivers[kind].draw(), team, limits.draw(),
            int(rng.integers(10_000, 2**31)), 0, int(k % 20 == 5),
        )  # fmt: skip
        share = min(_TYPICAL_MS / _step_ms(item), _MOST)
        made.append(item._replace(steps=min(max(round(each * share), _LEAST), left)))
        left -= made[-1].steps
    return made


def _step_ms(item: Item) -> float:
    """Return about how long a step of an item takes, resets and what is run twice in it."""
    by_agent = item.kind == "frontier" or item.driver in agents.names()
    driver = _AGENT_MS.get(item.driver, _OTHER_AGENT_MS) if by_agent else 0.0
    twice = (item.kind == "batch") + (item.driver == "nonsense") + 1
    step = _STEP_MS + _BACKEND_MS.get(item.slam, _OTHER_BACKEND_MS) + driver + _RESET_MS / item.limit
    return twice * step


def settings(item: Item, folder: Path) -> dict[str, Any]:
    """Return the keyword arguments of the item's environment; a plan is drawn into the folder."""
    given: dict[str, Any] = {"slam": item.slam, "robot": item.robot, "noise": NOISES[item.noise]}
    if item.rooms == _DRAWN:
        return given | {"floor_plan": str(_draw_plan(folder / "plan.png", item.seed))}
    return given | {"rooms": item.rooms}


def _draw_plan(path: Path, seed: int) -> Path:
    """Write a plan of blocks, bars at any angle and discs, of 5 cm a pixel."""
    rng = np.random.default_rng([seed, 1])
    rows, cols = (int(v) for v in rng.integers(80, 200, 2))
    image = np.zeros((rows, cols), np.uint8)
    image[4:-4, 4:-4] = 255
    for _ in range(rng.integers(2, 8)):
        x, y = (int(v) for v in rng.integers((10, 10), (cols - 10, rows - 10)))
        shape = rng.integers(3)
        if shape == 0:
            cv2.rectangle(image, (x, y), (x + int(rng.integers(2, 16)), y + int(rng.integers(2, 16))), 0, -1)
        elif shape == 1:
            cv2.line(image, (x, y), (x + int(rng.integers(-30, 31)), y + int(rng.integers(-30, 31))), 0, 3)
        else:
            cv2.circle(image, (x, y), int(rng.integers(2, 8)), 0, -1)
    if not cv2.imwrite(str(path), image):
        raise OSError(f"cannot write {path}")
    return path
