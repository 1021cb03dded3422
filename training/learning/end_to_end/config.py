"""What a training run of the end-to-end policy is made of: TOML tables, validated."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from agents.learned.drive_memory import PlanSettings
from mecanum_env.config import NOISE_PRESETS
from slam.settings import Config, Duration, Finite, Gap, Length, OneOf, PositiveShare, Seed, Within, require
from training.learning.config import EvaluationConfig, PpoConfig, RoomsConfig, check_names

__all__ = ["DriveConfig", "DriveLearningConfig", "DriveLessonsConfig", "DriveWorldConfig"]


@dataclass(frozen=True, kw_only=True)
class DriveWorldConfig(RoomsConfig):
    """Where driving is trained; the rewards are PPO's."""

    rooms: tuple[str, ...] = ("apartment", "rectangular", "corridors", "maze", "cave")
    noise: str = "nominal"
    area_1_m2: Finite = 0.05
    time_1_s: Finite = -0.02

    def __post_init__(self) -> None:
        super().__post_init__()
        check_names(f"{type(self).__name__}.noise", [self.noise], NOISE_PRESETS)


@dataclass(frozen=True, kw_only=True)
class DriveLessonsConfig(Config):
    """Lessons: a round of them for each share of the time that the teacher drives."""

    teacher: Annotated[str, OneOf(("nearest-frontier", "tour"))] = "nearest-frontier"  # whose frontiers are goals
    teacher_shares: Annotated[tuple[float, ...], Within("[0, 1]")] = (1.0, 0.5, 0.2, 0.0)
    # Driven by the teacher on its own map, before the first round.
    guided_episodes: Annotated[int, Within("[1, 1000000]")] = 400
    episodes: Annotated[int, Within("[1, 1000000]")] = 60  # a round, of each family
    time_limit_s: Duration = 120.0
    shaken: Annotated[float, Within("[0, 1)")] = 0.1  # share of the time that whoever drives is disturbed


@dataclass(frozen=True, kw_only=True)
class DriveLearningConfig(Config):
    """Steps of gradient descent, and their size."""

    map_steps: Annotated[int, Within("[1, 10000000]")] = 2000  # before the first round
    map_steps_a_round: Annotated[int, Within("[1, 10000000]")] = 300
    map_batch: Annotated[int, Within("[1, 10000000]")] = 64
    map_rate: PositiveShare = 5e-3
    control_steps: Annotated[int, Within("[1, 10000000]")] = 6000  # a round
    control_batch: Annotated[int, Within("[1, 10000000]")] = 256
    control_rate: PositiveShare = 2e-3


@dataclass(frozen=True, kw_only=True)
class DriveConfig(Config):
    """A training run of ``ppo``."""

    policy: Annotated[str, OneOf(("drive",))] = "drive"  # what tells these files from those of ppo-frontier
    seed: Seed = 1
    uncertainty: bool = True  # whether the covariance and the landmarks are looked at
    goal_m: Length = 8.0  # of PlanSettings
    keep_m: Gap = 1.5
    stall_m: Gap = 4.0
    world: DriveWorldConfig = field(default_factory=DriveWorldConfig)
    lessons: DriveLessonsConfig = field(default_factory=DriveLessonsConfig)
    learning: DriveLearningConfig = field(default_factory=DriveLearningConfig)
    ppo: PpoConfig = field(default_factory=PpoConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            len(self.lessons.teacher_shares) > 0 or self.ppo.steps > 0,
            f"{type(self).__name__}.lessons.teacher_shares must have one at least where ppo.steps is 0: else "
            "nothing learns to drive",
        )

    @property
    def planning(self) -> PlanSettings:
        """What the planning layer is told."""
        return PlanSettings(goal_m=self.goal_m, keep_m=self.keep_m, stall_m=self.stall_m)
