"""What a training run is made of: TOML tables, validated."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

import slam as backends
from agents.learned.chooser import ChooserConfig
from mecanum_env import rooms as room_registry
from mecanum_env.config import NOISE_PRESETS
from slam.settings import (
    Config,
    Count,
    Duration,
    Few,
    Finite,
    NotNegative,
    PositiveShare,
    Seed,
    SettingError,
    Share,
    Span,
    Within,
    check_name,
    from_mapping,
    require,
)

__all__ = [
    "FIRST_VALIDATION_SEED", "EvaluationConfig", "PpoConfig", "RehearsalConfig", "RoomsConfig", "TrainConfig",
    "WorldConfig", "check_names",
]  # fmt: skip

FIRST_VALIDATION_SEED = 1000
"""Seeds from here on are for choosing the best policy: neither for training nor for reporting."""


def check_names(what: str, names: Iterable[str], valid: Collection[str]) -> None:
    """Raise ``ValueError`` unless all names are valid."""
    for name in names:
        check_name(what, name, valid)


@dataclass(frozen=True, kw_only=True)
class RoomsConfig(Config):
    """Where is trained, whatever is: families of rooms, drawn as often as named, and what is paid there."""

    rooms: tuple[str, ...] = ("apartment",)
    seeds: Annotated[tuple[int, int], Span("[0, 999]")] = (0, 999)  # of the rooms, both included
    repeats: Count = 1  # episodes, of other noise, in a room before the next is drawn: rooms take time to price
    slam: str = "invariant-ekf"
    time_limit_s: Duration = 300.0
    time_1_s: Finite = -1.0 / 30.0  # reward per second
    area_1_m2: Finite = 0.0  # … per square metre newly mapped
    collision: Finite = -1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require(len(self.rooms) > 0, f"{type(self).__name__}.rooms must name some")
        check_names(f"{type(self).__name__}.rooms", self.rooms, room_registry.names())
        check_names(f"{type(self).__name__}.slam", [self.slam], backends.names())

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
    driver: Mapping[str, Any] = field(default_factory=dict)  # laid over ChooserConfig

    def __post_init__(self) -> None:
        super().__post_init__()
        require(len(self.noises) > 0, f"{type(self).__name__}.noises must name some")
        check_names(f"{type(self).__name__}.noises", self.noises, NOISE_PRESETS)
        try:
            from_mapping(ChooserConfig, self.driver)
        except SettingError as error:
            raise SettingError(type(self).__name__, f"driver.{error.path}", error.problem) from None
        except ValueError as error:
            raise ValueError(f"{type(self).__name__}.driver: {error}") from None


@dataclass(frozen=True, kw_only=True)
class PpoConfig(Config):
    """Of stable-baselines3, but ``gamma``, which is per second."""

    steps: Annotated[int, Within("[0, 1000000000]")] = 200_000  # decisions
    environments: Annotated[int, Within("[1, 1024]")] = 8
    n_steps: Annotated[int, Within("[1, 100000]")] = 128  # decisions an environment, in one rollout
    batch_size: Annotated[int, Within("[1, 1000000]")] = 256
    n_epochs: Few = 4
    learning_rate: Share = 3e-4  # falls to nothing
    gamma: PositiveShare = 0.998
    gae_lambda: Share = 0.97
    ent_coef: Annotated[float, Within("[0, 1000]")] = 0.003
    clip_range: Annotated[float, Within("[0, 1000]")] = 0.2
    target_kl: Annotated[float, Within("[0, 1000]")] = 0.03
    chunk: Count = 16  # rollouts between two checkpoints

    def __post_init__(self) -> None:
        super().__post_init__()
        rollout = self.n_steps * self.environments
        # Advantages are divided by their spread in a batch, and one alone has none: weights would be NaN.
        require(
            self.batch_size > 1 and rollout % self.batch_size != 1,
            f"{type(self).__name__}.batch_size must be 2 at least and leave no single decision of a rollout's "
            f"{rollout} (n_steps times environments), got {self.batch_size}",
        )

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

    steps: Annotated[int, Within("[0, 1000000000]")] = 0  # 0: no rehearsal
    environments: Annotated[int, Within("[1, 1024]")] = 16
    n_steps: Annotated[int, Within("[1, 100000]")] = 256
    batch_size: Annotated[int, Within("[1, 1000000]")] = 512
    n_epochs: Few = 3
    learning_rate: Share = 5e-4
    gamma: PositiveShare = 1.0
    gae_lambda: Share = 0.9
    chunk: Count = 4
    # Seconds that a metre less still to go, by hindsight, counts for; 0: no such reward.
    shaping_s_m: NotNegative = 0.0
    replan_s: Duration = 3.0  # that a choice lasts at most: the longer, the more it is felt
    every: Count = 8  # chunks, between two trials on validation seeds …
    episodes: Annotated[int, Within("[1, 50]")] = 30  # … of each family


@dataclass(frozen=True, kw_only=True)
class EvaluationConfig(Config):
    """How often it is tried on validation seeds, and on how many."""

    every: Count = 2  # chunks
    episodes: Annotated[int, Within("[1, 50]")] = 20  # of each family


@dataclass(frozen=True, kw_only=True)
class TrainConfig(Config):
    """A training run of ``ppo-frontier``."""

    seed: Seed = 1
    # Networks that are trained apart, each as all that follows says, and choose together.
    members: Annotated[int, Within("[1, 100]")] = 1
    width: Annotated[int, Within("[1, 4096]")] = 64
    heads: Annotated[int, Within("[1, 64]")] = 4
    layers: Annotated[int, Within("[1, 64]")] = 2
    world: WorldConfig = field(default_factory=WorldConfig)
    rehearsal: RehearsalConfig = field(default_factory=RehearsalConfig)
    ppo: PpoConfig = field(default_factory=PpoConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.width % self.heads == 0,
            f"{type(self).__name__}.width must be a multiple of heads, got {self.width} and {self.heads}",
        )
        count, environments = len(self.world.noises), self.ppo.environments
        require(
            self.ppo.steps == 0 or environments >= count,
            f"{type(self).__name__}.ppo.environments must be {count} at least, one for each of world.noises, got "
            f"{environments}",
        )
