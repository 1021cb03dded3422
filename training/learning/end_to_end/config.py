"""What a training run of the end-to-end policy is made of: TOML tables, validated."""

from __future__ import annotations

from dataclasses import dataclass, field

from agents.learned.drive_network import PlanSettings
from mecanum_env.config import NOISE_PRESETS
from slam.settings import positive, require
from training.learning.config import EvaluationConfig, PpoConfig, RoomsConfig, check_names

__all__ = ["DriveConfig", "DriveLearningConfig", "DriveLessonsConfig", "DriveWorldConfig"]


@dataclass(frozen=True, kw_only=True)
class DriveWorldConfig(RoomsConfig):
    """Where driving is trained; the rewards are PPO's."""

    rooms: tuple[str, ...] = ("apartment", "rectangular")
    noise: str = "nominal"
    area_1_m2: float = 0.05
    time_1_s: float = -0.02

    def __post_init__(self) -> None:
        super().__post_init__()
        check_names("noise preset", [self.noise], NOISE_PRESETS)


@dataclass(frozen=True, kw_only=True)
class DriveLessonsConfig:
    """Lessons: a round of them for each share of the time that the teacher drives."""

    teacher: str = "nearest-frontier"  # whose frontiers are goals
    teacher_shares: tuple[float, ...] = (1.0, 0.5, 0.2, 0.0)
    guided_episodes: int = 400  # driven by the teacher on its own map, before the first round
    episodes: int = 60  # a round, of each family
    time_limit_s: float = 120.0
    shaken: float = 0.1  # share of the time that whoever drives is disturbed

    def __post_init__(self) -> None:
        require(self.teacher in ("nearest-frontier", "tour"), "[lessons] teacher: nearest-frontier or tour")
        require(self.guided_episodes >= 1 and self.episodes >= 1, "[lessons] needs episodes")
        require(all(0 <= share <= 1 for share in self.teacher_shares), "[lessons] shares must be in [0, 1]")
        require(0 <= self.shaken < 1, "[lessons] shaken must be in [0, 1)")


@dataclass(frozen=True, kw_only=True)
class DriveLearningConfig:
    """Steps of gradient descent, and their size."""

    map_steps: int = 2000  # before the first round
    map_steps_a_round: int = 300
    map_batch: int = 64
    map_rate: float = 5e-3
    control_steps: int = 6000  # a round
    control_batch: int = 256
    control_rate: float = 2e-3

    def __post_init__(self) -> None:
        positive(self)


@dataclass(frozen=True, kw_only=True)
class DriveConfig:
    """A training run of ``ppo``."""

    policy: str = "drive"  # what tells these files from those of ppo-frontier
    seed: int = 1
    uncertainty: bool = True  # whether the covariance and the landmarks are looked at
    goal_m: float = 3.0  # of PlanSettings
    turn_m: float = 0.4
    world: DriveWorldConfig = field(default_factory=DriveWorldConfig)
    lessons: DriveLessonsConfig = field(default_factory=DriveLessonsConfig)
    learning: DriveLearningConfig = field(default_factory=DriveLearningConfig)
    ppo: PpoConfig = field(default_factory=PpoConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)

    def __post_init__(self) -> None:
        require(self.policy == "drive", "policy must be drive")

    @property
    def planning(self) -> PlanSettings:
        """What the planning layer is told."""
        return PlanSettings(goal_m=self.goal_m, turn_m=self.turn_m)
