"""What a training run is made of: TOML tables, validated."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from typing import Any, ClassVar

from mecanum_env import rooms as room_registry
from mecanum_env.config import NOISE_PRESETS
from slam.settings import from_mapping, require, unknown_name

__all__ = [
    "CurriculumPart", "EvaluationConfig", "ImitationConfig", "PpoConfig", "RehearsalConfig", "TrainConfig",
    "WorldConfig",
]  # fmt: skip

TEACHERS = ("hindsight", "tour", "cost-utility")


@dataclass(frozen=True, kw_only=True)
class CurriculumPart:
    """Where is trained first, before it is everywhere that ``[world]`` says."""

    until: float = 0.0  # share of the choices of a rehearsal, and of those of PPO after it
    rooms: tuple[str, ...] = ()  # none: those of [world]
    noises: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class WorldConfig:
    """Where is trained: families of rooms, drawn as often as named, one noise an environment in turn."""

    rooms: tuple[str, ...] = ("apartment",)
    noises: tuple[str, ...] = ("nominal",)
    seeds: tuple[int, int] = (0, 999)  # of the rooms, both included
    repeats: int = 1  # episodes, of other noise, in a room before the next is drawn: rooms take time to price
    slam: str = "invariant-ekf"
    time_limit_s: float = 300.0
    time_1_s: float = -1.0 / 30.0  # reward per second
    area_1_m2: float = 0.0  # … per square metre newly mapped
    collision: float = -1.0
    shaping_s_m: float = 0.0  # seconds that a metre less still to go, by hindsight, counts for; 0: no such reward
    driver: Mapping[str, Any] = field(default_factory=dict)
    curriculum: tuple[Mapping[str, Any], ...] = ()  # CurriculumPart, one after the other

    def __post_init__(self) -> None:
        require(len(self.rooms) > 0 and len(self.noises) > 0, "[world] needs rooms and noises")
        for name in self.rooms:
            if name not in room_registry.names():
                raise unknown_name("rooms", name, room_registry.names())
        for name in self.noises:
            if name not in NOISE_PRESETS:
                raise unknown_name("noise preset", name, NOISE_PRESETS)
        require(self.repeats >= 1, f"[world] repeats must be at least 1, got {self.repeats}")
        low, high = self.seeds
        require(0 <= low <= high < 1000, "[world] seeds must lie within the training seeds, 0 … 999")
        shares = [0.0, *(until for until, _ in self.parts())]
        rising = all(before < after for before, after in pairwise(shares))
        require(rising, "[[world.curriculum]] needs until between 0 and 1, each more than the one before")

    def parts(self) -> list[tuple[float, WorldConfig]]:
        """Return the curriculum: up to which share of the choices, and where; the last part is all of it."""
        tables = all(isinstance(part, Mapping) for part in self.curriculum)
        require(tables, "[[world.curriculum]] is a list of tables")
        parts = [from_mapping(CurriculumPart, part) for part in self.curriculum]
        whole = replace(self, curriculum=()) if parts else self
        first = [
            (part.until, replace(whole, rooms=part.rooms or self.rooms, noises=part.noises or self.noises))
            for part in parts
        ]
        return [*first, (1.0, whole)]


@dataclass(frozen=True, kw_only=True)
class ImitationConfig:
    """The start: to choose as a heuristic does."""

    teacher: str = "hindsight"  # or tour, or cost-utility
    episodes: int = 0  # a round; 0: no warm start
    rounds: int = 1  # after the first, what was learned so far drives
    epochs: int = 8
    batch: int = 256
    rate: float = 1e-3
    temperature_m: float = 0.0  # choices that cost so much more are left to chance: what PPO explores from
    astray: float = 0.1  # share of the choices that are made at random, so that more than its own ways are seen

    def __post_init__(self) -> None:
        if self.teacher not in TEACHERS:
            raise unknown_name("[imitation] teacher", self.teacher, TEACHERS)
        require(self.episodes >= 0, "[imitation] needs episodes ≥ 0")
        require(self.rounds >= 1 and self.epochs >= 1, "[imitation] needs rounds ≥ 1 and epochs ≥ 1")
        require(
            math.isfinite(self.temperature_m) and self.temperature_m >= 0, "[imitation] temperature_m must be ≥ 0"
        )
        require(0 <= self.astray < 1, "[imitation] astray must be in [0, 1)")


@dataclass(frozen=True, kw_only=True)
class PpoConfig:
    """Of stable-baselines3, but ``gamma``, which is per second."""

    table: ClassVar[str] = "ppo"

    steps: int = 200_000  # decisions
    environments: int = 8
    n_steps: int = 128  # decisions an environment, in one rollout
    batch_size: int = 256
    n_epochs: int = 4
    learning_rate: float = 3e-4  # falls to nothing
    gamma: float = 0.998
    gae_lambda: float = 0.97
    ent_coef: float = 0.003
    clip_range: float = 0.2
    target_kl: float = 0.03
    chunk: int = 16  # rollouts between two checkpoints

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            require(math.isfinite(value) and value >= 0, f"[{self.table}] {f.name} must be ≥ 0, got {value}")
        for name in ("environments", "n_steps", "batch_size", "n_epochs", "chunk"):
            require(getattr(self, name) >= 1, f"[{self.table}] {name} must be at least 1")

    @property
    def size(self) -> int:
        """Decisions in a chunk."""
        return self.chunk * self.n_steps * self.environments


@dataclass(frozen=True, kw_only=True)
class RehearsalConfig(PpoConfig):
    """PPO in ``training/learning/jump_world.py``, before that in the whole environment."""

    table: ClassVar[str] = "rehearsal"

    steps: int = 0  # 0: no rehearsal
    environments: int = 16
    n_steps: int = 256
    batch_size: int = 512
    n_epochs: int = 3
    learning_rate: float = 5e-4
    gamma: float = 1.0
    gae_lambda: float = 0.9
    chunk: int = 4
    covered_1: float = 1.0  # reward for all there is to cover, as it is covered, besides that for time
    shaping_s_m: float = 0.0  # as in [world], of the way still to go from where the robot is
    replan_s: float = 3.0  # that a choice lasts at most: the longer, the more it is felt
    every: int = 8  # chunks, between two trials on validation seeds …
    episodes: int = 30  # … of each family

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.every >= 1 and 1 <= self.episodes <= 50, "[rehearsal] needs every ≥ 1, episodes 1 … 50")
        require(self.replan_s > 0, "[rehearsal] replan_s must be > 0")


@dataclass(frozen=True, kw_only=True)
class EvaluationConfig:
    """How often it is tried on validation seeds, and on how many."""

    every: int = 2  # chunks
    episodes: int = 20  # of each family

    def __post_init__(self) -> None:
        require(self.every >= 1 and 1 <= self.episodes <= 50, "[evaluation] needs every ≥ 1, episodes 1 … 50")


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """A training run of ``ppo-frontier``."""

    seed: int = 1
    members: int = 1  # networks that are trained apart, each as all that follows says, and choose together
    width: int = 64
    heads: int = 4
    layers: int = 2
    world: WorldConfig = field(default_factory=WorldConfig)
    imitation: ImitationConfig = field(default_factory=ImitationConfig)
    rehearsal: RehearsalConfig = field(default_factory=RehearsalConfig)
    ppo: PpoConfig = field(default_factory=PpoConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)

    def __post_init__(self) -> None:
        require(self.members >= 1, f"members must be at least 1, got {self.members}")
