"""What a training run is made of: TOML tables, validated."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from mecanum_env import rooms as room_registry
from mecanum_env.config import NOISE_PRESETS
from slam.settings import not_negative, positive, require, unknown_name

__all__ = [
    "EvaluationConfig", "PpoConfig", "RehearsalConfig", "RoomsConfig", "TrainConfig", "WorldConfig", "check_names",
]  # fmt: skip


def check_names(what: str, names: Iterable[str], valid: Collection[str]) -> None:
    """Raise ``ValueError`` unless all names are valid."""
    for name in names:
        if name not in valid:
            raise unknown_name(what, name, valid)


@dataclass(frozen=True, kw_only=True)
class RoomsConfig:
    """Where is trained, whatever is: families of rooms, drawn as often as named, and what is paid there."""

    rooms: tuple[str, ...] = ("apartment",)
    seeds: tuple[int, int] = (0, 999)  # of the rooms, both included
    repeats: int = 1  # episodes, of other noise, in a room before the next is drawn: rooms take time to price
    slam: str = "invariant-ekf"
    time_limit_s: float = 300.0
    time_1_s: float = -1.0 / 30.0  # reward per second
    area_1_m2: float = 0.0  # … per square metre newly mapped
    collision: float = -1.0

    def __post_init__(self) -> None:
        require(len(self.rooms) > 0, "[world] needs rooms")
        check_names("rooms", self.rooms, room_registry.names())
        low, high = self.seeds
        require(0 <= low <= high < 1000, "[world] seeds must lie within the training seeds, 0 … 999")
        require(self.repeats >= 1, f"[world] repeats must be at least 1, got {self.repeats}")

    @property
    def reward(self) -> dict[str, float]:
        """The weights of the environment's reward."""
        return {
            "area": self.area_1_m2, "pose_entropy": 0.0, "map_entropy": 0.0, "collision": self.collision,
            "effort": 0.0, "time": self.time_1_s,
        }  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class WorldConfig(RoomsConfig):
    """Where view points are chosen: with one noise an environment in turn."""

    noises: tuple[str, ...] = ("nominal",)
    driver: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        require(len(self.noises) > 0, "[world] needs noises")
        check_names("noise preset", self.noises, NOISE_PRESETS)


@dataclass(frozen=True, kw_only=True)
class PpoConfig:
    """Of stable-baselines3, but ``gamma``, which is per second."""

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
        not_negative(self, *(f.name for f in fields(PpoConfig)))
        positive(self, "environments", "n_steps", "batch_size", "n_epochs", "chunk")

    @property
    def size(self) -> int:
        """Decisions in a chunk."""
        return self.chunk * self.n_steps * self.environments

    @property
    def chunks(self) -> int:
        """Number of the chunks."""
        return -(-self.steps // self.size)

    @property
    def settings(self) -> dict[str, Any]:
        """What stable-baselines3 is told."""
        names = (
            "n_steps", "batch_size", "n_epochs", "learning_rate", "gamma", "gae_lambda", "ent_coef", "clip_range",
            "target_kl",
        )  # fmt: skip
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True, kw_only=True)
class RehearsalConfig(PpoConfig):
    """PPO in ``training/learning/jump_world.py``, before that in the whole environment."""

    steps: int = 0  # 0: no rehearsal
    environments: int = 16
    n_steps: int = 256
    batch_size: int = 512
    n_epochs: int = 3
    learning_rate: float = 5e-4
    gamma: float = 1.0
    gae_lambda: float = 0.9
    chunk: int = 4
    shaping_s_m: float = 0.0  # seconds that a metre less still to go, by hindsight, counts for; 0: no such reward
    replan_s: float = 3.0  # that a choice lasts at most: the longer, the more it is felt
    every: int = 8  # chunks, between two trials on validation seeds …
    episodes: int = 30  # … of each family

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.every >= 1 and 1 <= self.episodes <= 50, "[rehearsal] needs every ≥ 1, episodes 1 … 50")
        not_negative(self, "shaping_s_m")
        positive(self, "replan_s")


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
    rehearsal: RehearsalConfig = field(default_factory=RehearsalConfig)
    ppo: PpoConfig = field(default_factory=PpoConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)

    def __post_init__(self) -> None:
        require(self.members >= 1, f"members must be at least 1, got {self.members}")
