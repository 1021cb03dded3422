"""``odometry_filter=`` of the environments: off by default and then without effect, checked like every part."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from mecanum_env.config import EnvConfig, from_toml, to_toml
from mecanum_env.sensing.sensors import WheelEncoders
from tests.mecanum_env.test_env import IDS, NO_WINDOWS, episode_bytes, make

NAME = "differential-transform"


@pytest.mark.parametrize("env_id", IDS)
def test_gymnasium_finds_nothing_to_complain_of(env_id: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = make(env_id, render_mode="rgb_array", odometry_filter=NAME).unwrapped
        check_env(env, skip_render_check=NO_WINDOWS)


def test_one_seed_is_one_episode_bit_for_bit() -> None:
    first = episode_bytes(7, odometry_filter=NAME)
    assert episode_bytes(7, odometry_filter=NAME) == first
    assert episode_bytes(7) != first


def test_off_is_the_default_and_adds_nothing() -> None:
    assert EnvConfig().odometry_filter == "none"
    assert episode_bytes(7, odometry_filter="none") == episode_bytes(7)
    env = make().unwrapped
    env.reset(seed=0)
    assert type(env._odometer) is WheelEncoders


@pytest.mark.parametrize("slam", ["odometry", "ekf", "fastslam1"])
def test_a_second_episode_starts_afresh(slam: str) -> None:
    env = make(odometry_filter=NAME, slam=slam)
    twists = []
    for _ in range(2):
        env.reset(seed=3)
        for k in range(12):
            env.step(np.array([0.1 * min(k, 6), 0.2, -0.3], np.float32))
        twists.append(np.array(env.unwrapped.odometry.twist))
    np.testing.assert_array_equal(twists[0], twists[1])


def test_room_noise_and_truth_are_those_of_the_unfiltered_episode() -> None:
    poses, scans = [], []
    for name in ("none", NAME):
        env = make(odometry_filter=name)
        env.reset(seed=3)
        for _ in range(10):
            *_, info = env.step(np.array([0.5, 0.1, 0.4], np.float32))
        poses.append(info["true_pose"])
        scans.append(env.unwrapped.scan.ranges)
    np.testing.assert_array_equal(poses[0], poses[1])
    np.testing.assert_array_equal(scans[0], scans[1])


def test_the_filtered_twist_is_what_backend_and_observation_get() -> None:
    env = make(odometry_filter=NAME, slam="odometry").unwrapped
    env.reset(seed=1)
    raw = []
    read = env._encoders.odometry
    env._encoders.odometry = lambda *args: raw.append(read(*args)) or raw[-1]
    for _ in range(30):
        observation, *_ = env.step(np.array([0.4, 0.0, 0.3], np.float32))
    limits = np.array([0.8, 0.8, 1.5])
    np.testing.assert_allclose(observation["twist"], np.array(env.odometry.twist) / limits, rtol=1e-6)
    assert np.any(np.array(env.odometry.twist) != np.array(raw[-1].twist))
    np.testing.assert_allclose(env.odometry.twist, raw[-1].twist, atol=0.05)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("kalman", "unknown odometry filter 'kalman'.*valid: differential-transform, none"),
        ("differential-transfrom", "did you mean 'differential-transform'"),
        ({"name": NAME, "modell": "x"}, "unknown key of OdometryFilterConfig 'modell'"),
        (
            {"name": NAME, "model": "x"},
            "odometry_filter.model must be one of .*constant_velocity, .* got 'x'",
        ),
        ({"name": NAME, "process_turn": -1}, r"odometry_filter.process_turn must be in \[1e-12, 1e6\], got -1"),
        ({"model": "constant_velocity"}, '"none" has no settings'),
    ],
)
def test_wrong_settings_are_named(given: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(odometry_filter=given)
    with pytest.raises(ValueError, match="unknown odometry filter 'x'"):
        make(config={"odometry_filter": "x"})


def test_the_configuration_holds_it_and_toml_reads_it_back(tmp_path: Path) -> None:
    given = {"name": NAME, "model": "constant_velocity", "start_sigmas": (1e-3, 0.2, 0.5)}
    config = make(odometry_filter=given).unwrapped.config
    assert config.odometry_filter == NAME
    assert config.odometry_filter_config["model"] == "constant_velocity"
    path = tmp_path / "config.toml"
    path.write_text(to_toml(config))
    read = from_toml(path)
    assert read == config and to_toml(read) == to_toml(config)
    again = make(config=str(path), rooms=None).unwrapped
    assert again._filter is not None
    assert again._filter.config.start_sigmas == (1e-3, 0.2, 0.5)
    assert make(config=str(path), rooms=None, odometry_filter="none").unwrapped._filter is None
