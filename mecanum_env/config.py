"""Configuration: one frozen dataclass a part, validated when built, with presets, and TOML in and out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tomli_w

from slam.files import read_toml
from slam.settings import (
    Config,
    Count,
    Finite,
    PositiveShare,
    Sigma,
    Span,
    Within,
    argument,
    check_name,
    from_mapping,
    require,
    to_mapping,
)

__all__ = [
    "LIDAR_PRESETS",
    "NOISE_PRESETS",
    "ROBOT_PRESETS",
    "EnvConfig",
    "LidarConfig",
    "NoiseConfig",
    "RewardConfig",
    "RobotConfig",
    "StepTime",
    "Steps",
    "from_toml",
    "resolve",
    "to_toml",
]

T = TypeVar("T")

StepTime = Annotated[float, Within("[0.001, 1]")]
"""Of one control step [s]."""

Steps = Annotated[int, Within("[1, 1000000000]")]
"""Of an episode, at most."""


@dataclass(frozen=True, kw_only=True)
class RobotConfig(Config):
    """Body, wheels and motors of a mecanum robot with X rollers (docs/reference/robot.md).

    The motor constants are those of a geared servo drive: a speed loop with a first-order lag, a torque limit
    at the wheel, and the rotor's inertia as the wheel feels it through the gear.
    """

    length_m: Annotated[float, Within("[0.05, 2]")] = 0.58
    width_m: Annotated[float, Within("[0.05, 2]")] = 0.38
    mass_kg: Annotated[float, Within("[0.1, 1000]")] = 20.0
    wheel_radius_m: Annotated[float, Within("[0.005, 1]")] = 0.0475
    wheelbase_m: Annotated[float, Within("[0.01, 2]")] = 0.471
    track_m: Annotated[float, Within("[0.01, 2]")] = 0.300
    max_speed_m_s: Annotated[float, Within("[0.01, 10]")] = 0.8
    max_turn_rate_rad_s: Annotated[float, Within("[0.01, 20]")] = 1.5
    motor_lag_s: Annotated[float, Within("[0, 10]")] = 0.05
    motor_torque_nm: Annotated[float, Within("[0.001, 1e6]")] = 2.0
    motor_gain: Annotated[float, Within("[0.001, 1000]")] = 2.0  # torque per speed error [N·m·s/rad]
    wheel_inertia_kg_m2: Sigma = 0.01
    wheel_friction: Annotated[float, Within("[0, 100]")] = 0.01  # viscous, torque per wheel speed [N·m·s/rad]
    slip_speed_m_s: Annotated[float, Within("[0.001, 1]")] = 0.015  # width of the regularised Coulomb law, s₀

    @cached_property
    def lever_m(self) -> float:
        """Half the wheelbase plus half the track: the arm l of the mecanum kinematics [m]."""
        return 0.5 * (self.wheelbase_m + self.track_m)

    @cached_property
    def max_wheel_speed_rad_s(self) -> float:
        """Wheel speed limit: what straight driving at full speed asks for [rad/s]."""
        return self.max_speed_m_s / self.wheel_radius_m

    @cached_property
    def inscribed_radius_m(self) -> float:
        """Largest disc within the footprint [m]."""
        return 0.5 * min(self.length_m, self.width_m)

    @cached_property
    def circumscribed_radius_m(self) -> float:
        """Smallest disc around the footprint [m]."""
        return 0.5 * math.hypot(self.length_m, self.width_m)

    @cached_property
    def inertia_kg_m2(self) -> float:
        """Moment of inertia of the body about its centre: a uniform rectangle [kg·m²]."""
        return self.mass_kg * (self.length_m**2 + self.width_m**2) / 12.0


@dataclass(frozen=True, kw_only=True)
class LidarConfig(Config):
    """A planar lidar mounted on the robot's centre line, at A ahead of the centre of mass C."""

    beams: Annotated[int, Within("[8, 10000]")] = 360
    field_of_view_deg: Annotated[float, Within("[1, 360]")] = 360.0
    range_min_m: Annotated[float, Within("[0, 100]")] = 0.02
    range_max_m: Annotated[float, Within("[0.01, 100]")] = 8.0
    offset_m: Annotated[float, Within("[-10, 10]")] = 0.2  # L of docs/reference/ekf.md

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.range_min_m < self.range_max_m,
            f"LidarConfig needs range_min_m < range_max_m, got {self.range_min_m} and {self.range_max_m}",
        )

    @property
    def angle_increment(self) -> float:
        """Angle between beams [rad]: a full circle has as many gaps as beams, a sector one fewer."""
        fov = math.radians(self.field_of_view_deg)
        return fov / self.beams if self.field_of_view_deg >= 360.0 else fov / (self.beams - 1)

    @property
    def angle_min(self) -> float:
        """Bearing of the first beam [rad]."""
        return -0.5 * math.radians(self.field_of_view_deg)


@dataclass(frozen=True, kw_only=True)
class NoiseConfig(Config):
    """Everything random about the robot's dealings with the world, as declared to the estimators."""

    range_sigma_m: Annotated[float, Within("[0, 1)")] = 0.01
    dropout: Annotated[float, Within("[0, 1)")] = 0.005  # probability that a beam is lost
    encoder: Annotated[float, Within("[0, 1)")] = 0.01  # 1σ of a wheel's measured increment, as a share of it
    # Largest relative error of each wheel's radius, drawn per episode.
    radius_error: Annotated[float, Within("[0, 1)")] = 0.01
    # Largest relative error of the lever l, drawn per episode.
    base_error: Annotated[float, Within("[0, 1)")] = 0.01
    # Mean share of the commanded motion that is lost at random: up to twice as much at a time.
    slip: Annotated[float, Within("[0, 0.5]")] = 0.0
    friction: Annotated[float, Within("[0.01, 2]")] = 0.6  # μ of the floor
    # μ of the slippery patches, drawn per patch.
    patch_friction: Annotated[tuple[float, float], Span("[0.01, 2]")] = (0.15, 0.3)
    patch_share: Annotated[float, Within("[0, 1)")] = 0.0  # share of the floor that slippery patches cover


@dataclass(frozen=True, kw_only=True)
class RewardConfig(Config):
    """Weights of the reward's terms."""

    area: Finite = 0.1  # per m² newly mapped
    pose_entropy: Finite = 0.01  # per nat of pose entropy lost
    map_entropy: Finite = 0.0  # per bit-m² of map entropy lost
    collision: Finite = -1.0  # per contact
    effort: Finite = -0.002  # per second at full speed
    time: Finite = -0.001  # per second


@dataclass(frozen=True, kw_only=True)
class EnvConfig(Config):
    """An environment, whole. A string names a preset, generator or backend; ``*_config`` sets its details."""

    rooms: str = "apartment"
    floor_plan: str | None = None  # a file to read instead of generating rooms
    rooms_config: Mapping[str, Any] = field(default_factory=dict)
    slam: str = "invariant-ekf"
    slam_config: Mapping[str, Any] = field(default_factory=dict)
    odometry_filter: str = "none"  # between the wheels and the backend (slam.odometry.filters)
    odometry_filter_config: Mapping[str, Any] = field(default_factory=dict)
    robot: RobotConfig = field(default_factory=RobotConfig)
    lidar: LidarConfig = field(default_factory=LidarConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    step_s: StepTime = 0.1
    physics_step_s: StepTime = 0.02
    grid_resolution_m: Annotated[float, Within("[0.01, 1]")] = 0.05
    coverage_target: PositiveShare = 0.95
    # What ``progress`` counts against where the environment has no step limit.
    time_limit_s: Annotated[float, Within("[0.001, 1e9]")] = 300.0
    terminate_on_collision: bool = False
    max_landmarks_observed: Count = 32

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.physics_step_s <= self.step_s,
            f"EnvConfig.physics_step_s must be at most step_s, {self.step_s}, got {self.physics_step_s}",
        )
        substeps = self.step_s / self.physics_step_s
        require(
            abs(substeps - round(substeps)) < 1e-6,
            f"EnvConfig.step_s must be a multiple of physics_step_s, {self.physics_step_s}, got {self.step_s}",
        )
        half = 0.5 * self.robot.length_m
        fit = [f'{{"preset": "{name}", …}}' for name, it in LIDAR_PRESETS.items() if abs(it.offset_m) <= half]
        require(
            abs(self.lidar.offset_m) <= half,
            f"lidar.offset_m must be at most half of robot.length_m, {half:g}: from beyond its body a robot looks "
            f"through walls; got {self.lidar.offset_m:g}{'; this body bears ' if fit else ''}{' or '.join(fit)}",
        )
        for name in ("rooms_config", "slam_config", "odometry_filter_config"):
            object.__setattr__(self, name, _plain(getattr(self, name)))


def _plain(value: Any) -> Any:
    """Return settings as TOML gives them back: tables of their own, without None; sequences as tuples."""
    if isinstance(value, Config):
        value = to_mapping(value)
    if hasattr(value, "tolist"):  # NumPy's
        value = value.tolist()
    if isinstance(value, Mapping):
        return {key: _plain(inner) for key, inner in value.items() if inner is not None}
    if isinstance(value, list | tuple):
        return tuple(_plain(inner) for inner in value)
    return value


# Paper D's robot is 24 × 16 cm, at most 0.5 m/s and 90 °/s, and sees 120°; wheels, mass and
# motors are the youBot's, scaled to that body.
ROBOT_PRESETS: dict[str, RobotConfig] = {
    "youbot": RobotConfig(),
    "cavity": RobotConfig(
        length_m=0.24,
        width_m=0.16,
        mass_kg=2.5,
        wheel_radius_m=0.03,
        wheelbase_m=0.16,
        track_m=0.13,
        max_speed_m_s=0.5,
        max_turn_rate_rad_s=math.radians(90.0),
        motor_torque_nm=0.3,
        motor_gain=0.1,
        wheel_inertia_kg_m2=5e-4,
        wheel_friction=5e-4,
    ),
}
LIDAR_PRESETS: dict[str, LidarConfig] = {
    "youbot": LidarConfig(),
    "cavity": LidarConfig(beams=121, field_of_view_deg=120.0, offset_m=0.08),
}
NOISE_PRESETS: dict[str, NoiseConfig] = {
    "nominal": NoiseConfig(),
    "youbot": NoiseConfig(),
    "slippery": NoiseConfig(encoder=0.05, radius_error=0.03, base_error=0.03, slip=0.1, patch_share=0.25),
    "cavity": NoiseConfig(slip=0.1),
}


def resolve(
    cls: type[T], value: str | Mapping[str, Any] | T | None, presets: Mapping[str, T], what: str, *,
    base: T | None = None,
) -> T:  # fmt: skip
    """Return a config from a preset's name, a config, or a mapping, laid over its ``preset`` key's or ``base``.

    ``what`` is the argument, and a word for its names perhaps, of which ``ValueError`` speaks.
    """
    if isinstance(value, str):
        check_name(what, value, presets)
        return presets[value]
    if isinstance(value, Mapping) and "preset" in value:
        base = resolve(cls, str(value["preset"]), presets, what)
        value = {key: inner for key, inner in value.items() if key != "preset"}
    with argument(what.partition(" ")[0]):
        return from_mapping(cls, value, base=base)


def from_toml(path: str | Path) -> EnvConfig:
    """Read an environment's configuration; ``ValueError`` names the file and what is wrong with it.

    A [run] table is left to whoever wrote it: who explored, with which seed and versions.
    """
    values = read_toml(Path(path))
    values.pop("run", None)
    try:
        return from_mapping(EnvConfig, values)
    except (ValueError, TypeError) as error:
        raise ValueError(f"config {path}: {error}") from error


def to_toml(config: EnvConfig) -> str:
    """Return the effective configuration as TOML text that :func:`from_toml` reads back equal."""
    return tomli_w.dumps(to_mapping(config))
