"""From the keyword arguments of ``gym.make`` to a checked configuration, and the backend it asks for."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from mecanum_env import rooms as room_registry
from mecanum_env.config import (
    LIDAR_PRESETS,
    NOISE_PRESETS,
    ROBOT_PRESETS,
    EnvConfig,
    LidarConfig,
    NoiseConfig,
    RewardConfig,
    RobotConfig,
    from_toml,
    resolve,
)
from mecanum_env.rooms import FloorPlan
from mecanum_env.rooms.registry import check as check_rooms
from mecanum_env.sensing.calibration import backend_settings
from slam.backend import Backend
from slam.files import plain_name, quoted
from slam.odometry.filters import make_odometry_filter
from slam.registry import config_type
from slam.registry import make as make_slam
from slam.settings import Within, argument, check_name, checked, from_mapping, overlaid, require

__all__ = [
    "Settings", "check_arguments", "make_backend", "make_config", "make_plan", "reset_options", "room_seed_of",
]  # fmt: skip

Settings = str | Mapping[str, Any]
"""A name, or a mapping that configures what it names."""

RoomSeed = Annotated[int, Within("[0, 9223372036854775807]")]


def make_config(
    *,
    config: EnvConfig | str | Path | Mapping[str, Any] | None = None,
    rooms: Settings | None = None,
    slam: Settings | None = None,
    robot: Settings | RobotConfig | None = None,
    lidar: Settings | LidarConfig | None = None,
    noise: Settings | NoiseConfig | None = None,
    reward: Mapping[str, Any] | RewardConfig | None = None,
    floor_plan: str | Path | FloorPlan | None = None,
    odometry_filter: Settings | None = None,
    **unknown: Any,
) -> EnvConfig:
    """Put an environment's configuration together: ``config`` (a TOML file, a mapping), then each part over it.

    A string names a preset, generator, backend or filter; a mapping changes what ``config`` has of it, or what a
    preset or name in it stands for (``{"preset": "youbot", …}``, ``{"name": "apartment", …}``). A robot's name
    stands for its lidar and noise too, where those are not given.
    A floor plan that is no path is only held against ``rooms``: no file holds it.
    Unknown names, keys and arguments raise ``ValueError`` that lists the valid ones.
    """
    check_arguments(unknown)
    if isinstance(config, str | Path):
        base = from_toml(config)
    else:
        with argument("config"):
            base = from_mapping(EnvConfig, config)
    changes: dict[str, Any] = {}
    preset = robot.get("preset") if isinstance(robot, Mapping) else robot
    if isinstance(preset, str) and preset in ROBOT_PRESETS:
        given_parts = config if isinstance(config, Mapping) else {}
        lidar = preset if lidar is None and "lidar" not in given_parts else lidar
        noise = preset if noise is None and "noise" not in given_parts else noise
    require(
        rooms is None or floor_plan is None,
        "a floor plan is explored instead of rooms; leave out the one or the other",
    )
    if rooms is not None:
        changes["floor_plan"] = None
    for name, given in (("rooms", rooms), ("slam", slam), ("odometry_filter", odometry_filter)):
        if isinstance(given, Mapping):
            options = dict(given)
            changes[name] = options.pop("name", getattr(base, name))
            same = changes[name] == getattr(base, name)
            changes[f"{name}_config"] = overlaid(getattr(base, f"{name}_config"), options) if same else options
        elif given is not None:
            require(isinstance(given, str), f"{name} must be a name or a mapping, got {quoted(given)}")
            changes[name] = given
            if given != getattr(base, name):
                changes[f"{name}_config"] = {}
    if robot is not None:
        changes["robot"] = resolve(RobotConfig, robot, ROBOT_PRESETS, "robot", base=base.robot)
    if lidar is not None:
        changes["lidar"] = resolve(LidarConfig, lidar, LIDAR_PRESETS, "lidar", base=base.lidar)
    if noise is not None:
        changes["noise"] = resolve(NoiseConfig, noise, NOISE_PRESETS, "noise preset", base=base.noise)
    if reward is not None:
        with argument("reward"):
            changes["reward"] = from_mapping(RewardConfig, reward, base=base.reward)
    if floor_plan is not None and not isinstance(floor_plan, FloorPlan):
        require(isinstance(floor_plan, str | Path), f"floor_plan must be a path, got {quoted(floor_plan)}")
        changes["floor_plan"] = str(floor_plan)
    made = dataclasses.replace(base, **changes)
    plan = made.floor_plan
    require(
        plan is None or Path(plan).is_file(),
        f"floor_plan {plain_name(str(plan))} does not exist, or is no file; check the path",
    )
    with argument("rooms" if "rooms_config" in changes else "rooms_config"):
        check_rooms(made.rooms, made.rooms_config)
    with argument("slam" if "slam_config" in changes else "slam_config"):
        settings = backend_settings(made)
        same = settings["grid_resolution_m"] == made.grid_resolution_m
        require(same, "grid_resolution_m is set in config, not beside it: truth and metrics have the same cells")
        from_mapping(config_type(made.slam), settings)
    with argument("odometry_filter" if "odometry_filter_config" in changes else "odometry_filter_config"):
        make_odometry_filter(made.odometry_filter, made.odometry_filter_config)
    return made


def check_arguments(given: Iterable[str], *takers: Callable[..., Any]) -> None:
    """Raise ``ValueError`` for what is a keyword argument neither of ``takers`` nor of :func:`make_config`."""
    valid = {
        p.name for taker in (*takers, make_config) for p in inspect.signature(taker).parameters.values()
        if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)
    }  # fmt: skip
    for name in given:
        check_name("argument", name, valid)


def reset_options(given: Mapping[str, Any] | None, names: Iterable[str]) -> dict[str, Any]:
    """Return the options of a reset, of those that there are, less what is None: that is left out."""
    given = {} if given is None else given
    require(isinstance(given, Mapping), f"options must be a mapping, got {quoted(given)}")
    for key in given:
        check_name("reset option", key, names)
    return {key: value for key, value in given.items() if value is not None}


def room_seed_of(options: Mapping[str, Any], seed: int, plan: FloorPlan | None) -> int:
    """Return the seed that the room is drawn by: the option ``room_seed`` of a reset, else the episode's.

    ``plan`` is the environment's own, if it was given one.
    """
    if "room_seed" not in options:
        return seed
    require(
        not isinstance(options.get("floor_plan", plan), FloorPlan),
        "room_seed draws a room, and there is a floor plan instead; leave out the one or the other",
    )
    return int(checked("room_seed", RoomSeed, options["room_seed"]))


def make_plan(
    config: EnvConfig, seed: int, *, given: FloorPlan | str | Path | None = None,
    start: Sequence[float] | None = None,
) -> FloorPlan:  # fmt: skip
    """Return where to explore: a plan or its file where one is given, else the configuration's, else rooms drawn.

    ``start`` is a pose x, y, θ in the plan's frame, for the plan's own.
    """
    given = config.floor_plan if given is None else given
    if not isinstance(given, FloorPlan | str | Path | None):
        raise ValueError(f"floor_plan must be a FloorPlan or a path, got {quoted(given)}")
    if given is not None and not isinstance(given, FloorPlan):
        return room_registry.load(given, start=start, seed=seed, roomy_m=config.robot.circumscribed_radius_m)
    plan = room_registry.make(config.rooms, seed=seed, config=config.rooms_config) if given is None else given
    return plan if start is None else plan.with_start(start, clearance_m=config.robot.inscribed_radius_m)


def make_backend(config: EnvConfig) -> Backend:
    """Return the backend that an environment's configuration asks for, told of its robot and noise."""
    return make_slam(config.slam, config=backend_settings(config))
