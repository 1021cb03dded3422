"""Configurations as files: what is written is read back equal."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import gymnasium
import numpy as np
import pytest

import mecanum_env
from mecanum_env.arguments import make_config
from mecanum_env.config import LIDAR_PRESETS, NOISE_PRESETS, EnvConfig, from_toml, to_toml


@pytest.mark.parametrize(
    "given",
    [
        {"rooms": "cave", "rooms_config": {"area_m2": (40.0, 60.0), "pillars": [0, 1]}},
        {"slam_config": {"odometry": {"lever_m": 0.3}, "steps": ((1, 2), [3.0, 4.0])}},
        {"slam_config": {"map": None, "features": {"range_sigma_m": None, "wall_sigma_m": 0.02}}},
        {"odometry_filter_config": {"start_sigmas": (1e-3, 0.2, 0.5)}},
    ],
)
def test_a_configuration_is_read_back_equal(given: dict[str, Any], tmp_path: Path) -> None:
    config = EnvConfig(**given)
    path = tmp_path / "config.toml"
    path.write_text(to_toml(config))
    assert from_toml(path) == config


def test_a_configuration_keeps_its_settings_when_the_callers_change() -> None:
    given: dict[str, Any] = {"features": {"range_sigma_m": 0.01}}
    config = EnvConfig(slam_config=given)
    given["features"]["range_sigma_m"] = 9.0
    given["gate"] = 1.0
    assert config.slam_config == {"features": {"range_sigma_m": 0.01}}


def test_cells_of_another_size_are_those_of_truth_and_metrics_too() -> None:
    with pytest.raises(ValueError, match="grid_resolution_m is set in config"):
        gymnasium.make("mecanum_env/Explore-v0", slam={"grid_resolution_m": 0.1})
    env = gymnasium.make("mecanum_env/Explore-v0", config={"grid_resolution_m": 0.1}, slam={"gate": 9.0})
    env.reset(seed=0)
    assert env.unwrapped.belief.grid.resolution == env.unwrapped.truth.ground.resolution == 0.1


def test_rooms_given_are_explored_whatever_plan_the_configuration_has(tmp_path: Path) -> None:
    plan = tmp_path / "plan.png"
    image = np.full((80, 100), 255, np.uint8)
    image[[0, -1]], image[:, [0, -1]] = 0, 0
    cv2.imwrite(str(plan), image)
    base = {"floor_plan": str(plan), "rooms": "cave"}
    assert make_config(config=base).floor_plan == str(plan)
    laid_over = make_config(config=base, rooms="maze")
    assert (laid_over.floor_plan, laid_over.rooms) == (None, "maze")
    with pytest.raises(ValueError, match="instead of rooms; leave out the one or the other"):
        make_config(rooms="maze", floor_plan=str(plan))


@pytest.mark.parametrize("make", [partial(gymnasium.make, "mecanum_env/Explore-v0"), mecanum_env.parallel_env])
def test_what_draws_rooms_is_refused_beside_a_floor_plan(make: Callable[..., Any]) -> None:
    plan = mecanum_env.rooms.make("rectangular", seed=1)
    with pytest.raises(ValueError, match="instead of rooms; leave out the one or the other"):
        make(floor_plan=plan, rooms="maze")
    for env, more in ((make(floor_plan=plan), {}), (make(rooms="maze"), {"floor_plan": plan})):
        with pytest.raises(ValueError, match="room_seed draws a room, and there is a floor plan instead"):
            env.reset(seed=0, options={"room_seed": 5, **more})
        env.reset(seed=0, options=more)


def test_a_mapping_leaves_what_it_does_not_name_however_deep() -> None:
    base: dict[str, Any] = {"slam": "ekf", "slam_config": {"gate": 9.0, "landmarks": {"confirm_after": 3}}}
    config = make_config(config=base, slam={"landmarks": {"forget_after": 9}})
    assert config.slam_config == {"gate": 9.0, "landmarks": {"confirm_after": 3, "forget_after": 9}}
    other = make_config(config=base, slam={"name": "ekf-lines", "landmarks": {"forget_after": 9}})
    assert other.slam_config == {"landmarks": {"forget_after": 9}}  # what the base has is another's


def test_a_room_s_seed_beyond_its_limit_is_refused() -> None:
    env = gymnasium.make("mecanum_env/Explore-v0", rooms="rectangular")
    env.reset(seed=0, options={"room_seed": 2**63 - 1})
    with pytest.raises(ValueError, match=r"room_seed must be a whole number in \[0, 9223372036854775807\]"):
        env.reset(seed=0, options={"room_seed": 2**63})


def test_a_robot_s_preset_brings_its_lidar_and_no_lidar_lies_beyond_its_body() -> None:
    config = make_config(robot={"preset": "cavity", "mass_kg": 3.0})
    assert (config.lidar, config.noise) == (LIDAR_PRESETS["cavity"], NOISE_PRESETS["cavity"])
    assert make_config(robot={"preset": "cavity"}, lidar="cavity", noise="slippery").noise.slip == 0.1
    with pytest.raises(ValueError, match=r"at most half of robot.length_m, 0.1: .*; got 0.2"):
        make_config(robot={"length_m": 0.2, "width_m": 0.16})
    with pytest.raises(ValueError, match=r'got 0.2; this body bears {"preset": "cavity", …}$'):
        make_config(robot="cavity", lidar={"beams": 50})
    assert make_config(robot="cavity", lidar={"preset": "cavity", "beams": 50}).lidar.beams == 50


@pytest.mark.parametrize("name", ["Explore-v0", "ExploreFrontier-v0"])
def test_an_argument_that_there_is_not_is_named_with_those_that_there_are(name: str) -> None:
    with pytest.raises(ValueError, match=r"^unknown argument .room. \(did you mean .rooms.\?\); valid: .*slam$"):
        gymnasium.make(f"mecanum_env/{name}", room="maze")


@pytest.mark.parametrize(
    ("make", "own"),
    [
        (lambda: gymnasium.make("mecanum_env/Explore-v0", bogus=1), ["action", "render_mode"]),
        (lambda: gymnasium.make("mecanum_env/ExploreFrontier-v0", bogus=1), ["discount", "driver", "render_mode"]),
        (lambda: mecanum_env.parallel_env(bogus=1), ["action", "max_steps", "render_mode", "robots", "team"]),
    ],
)
def test_the_arguments_that_there_are_are_the_environment_s(make: Callable[[], Any], own: list[str]) -> None:
    with pytest.raises(ValueError, match="unknown argument 'bogus'; valid: ") as refused:
        make()
    named = str(refused.value).split("valid: ")[1].split(", ")
    shared = ["config", "floor_plan", "lidar", "noise", "odometry_filter", "reward", "robot", "rooms", "slam"]
    assert named == sorted([*shared, *own])
