"""The filter between wheels and backend: what it must not change, and what it does."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from slam.motion import move
from slam.odometry.differential_transform import MODELS
from slam.odometry.filters import OdometryFilter, OdometryFilterConfig, make_odometry_filter
from slam.odometry.riccati import Tolerances
from slam.odometry.transform_filter import KalmanBucyFilter
from slam.types import Odometry

DT = 0.1


def run(behind: OdometryFilter, twists: np.ndarray) -> np.ndarray:
    return np.array([behind.filter(Odometry(twist, DT)).twist for twist in twists])


def reckon(twists: np.ndarray) -> np.ndarray:
    pose = np.zeros(3)
    for twist in twists:
        pose = move(pose, twist, DT)
    return pose


def unwrapped(pose: np.ndarray, twist: np.ndarray) -> np.ndarray:
    """What :func:`slam.motion.move` returns, its heading not wrapped."""
    return np.append(move(pose, twist, DT)[:2], pose[2] + twist[2] * DT)


def swing(steps: int = 80) -> np.ndarray:
    k = np.arange(steps)
    return np.column_stack([0.5 * np.sin(k / 20), 0.2 * np.sin(k / 15), 0.8 * np.sin(k / 25)])


@pytest.mark.parametrize("model", MODELS)
def test_what_is_held_back_is_given_once_the_robot_rests(model: str) -> None:
    twists = np.vstack([swing(), np.zeros((1, 3))])
    out = run(OdometryFilter(OdometryFilterConfig(model=model)), twists)
    assert np.max(np.abs(out[:-1] - twists[:-1])) > 1e-4
    np.testing.assert_allclose(reckon(out), reckon(twists), atol=1e-9)
    rest = run(OdometryFilter(OdometryFilterConfig(model=model)), np.zeros((5, 3)))
    np.testing.assert_array_equal(rest, np.zeros((5, 3)))


def test_a_steady_drive_passes_unchanged_in_the_end() -> None:
    twists = np.tile([0.4, 0.0, 0.0], (100, 1))
    out = run(OdometryFilter(), twists)
    np.testing.assert_allclose(out[-20:], twists[-20:], atol=1e-6)


def test_noise_is_smoothed() -> None:
    rng = np.random.Generator(np.random.PCG64(1))
    noise = 0.05 * rng.standard_normal((600, 3))
    for process, share in ((0.03, 1.0), (1e-3, 0.9), (1e-5, 0.6)):
        behind = OdometryFilter(OdometryFilterConfig(process_linear=process))
        out = run(behind, np.array([0.5, 0.1, 0.05]) + noise)
        assert np.std(out[50:, 0]) < share * np.std(noise[50:, 0])


def test_turns_beyond_pi_are_no_jumps() -> None:
    out = run(OdometryFilter(), np.tile([0.3, 0.0, 1.2], (200, 1)))
    np.testing.assert_allclose(out[50:, 2], 1.2, atol=1e-4)
    np.testing.assert_allclose(np.hypot(out[50:, 0], out[50:, 1]), 0.3, atol=0.01)


def test_reset_forgets() -> None:
    behind = OdometryFilter()
    first = run(behind, swing(20))
    behind.reset()
    np.testing.assert_array_equal(run(behind, swing(20)), first)
    assert make_odometry_filter("none") is None
    with pytest.raises(ValueError, match="odometry must be finite"):
        behind.filter(Odometry((math.nan, 0.0, 0.0), DT))


def test_outputs_are_fresh_arrays() -> None:
    behind = OdometryFilter()
    first = behind.filter(Odometry((0.3, 0.0, 0.1), DT)).twist
    kept = np.array(first)
    behind.filter(Odometry((-0.3, 0.2, 0.4), DT))
    np.testing.assert_array_equal(first, kept)


def test_a_step_of_no_time_passes_unchanged() -> None:
    behind, other = OdometryFilter(), OdometryFilter()
    run(behind, swing(10))
    run(other, swing(10))
    still = behind.filter(Odometry((0.3, 0.1, -0.2), 0.0))
    np.testing.assert_array_equal(still.twist, (0.3, 0.1, -0.2))
    np.testing.assert_array_equal(run(behind, swing(20)[10:]), run(other, swing(20)[10:]))
    with pytest.raises(ValueError, match="odometry must be finite"):
        behind.filter(Odometry((math.nan, 0.0, 0.0), 0.0))


@pytest.mark.parametrize("model", MODELS)
def test_it_is_three_filters_of_one_coordinate_each(model: str) -> None:
    config = OdometryFilterConfig(model=model)
    behind, n = OdometryFilter(config), MODELS[model].size
    strengths = [(config.measurement_m2_s, config.process_linear)] * 2
    strengths.append((config.measurement_rad2_s, config.process_turn))
    tolerances = Tolerances(relative=1e-4)  # the odometry filter's own
    alone = [KalmanBucyFilter(model, measurement=r, process=q, tolerances=tolerances) for r, q in strengths]
    for kalman in alone:
        kalman.reset(time=0.1, cov=np.diag(np.square(config.start_sigmas[:n])))
    reckoned, filtered = np.zeros(3), np.zeros(3)
    for twist in swing()[1:]:  # at no step of which the robot rests
        reckoned = unwrapped(reckoned, twist)
        for kalman, z in zip(alone, reckoned, strict=True):
            kalman.advance(DT, z)
        filtered = unwrapped(filtered, np.asarray(behind.filter(Odometry(twist, DT)).twist))
        np.testing.assert_allclose(filtered, [kalman.state[0] for kalman in alone], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("start_sigmas", ["a", 1, 2]), ("start_sigmas", 3.0), ("start_sigmas", (1.0, 2.0)),
        ("start_sigmas", (1.0, 2.0, math.nan)), ("start_sigmas", "abc"), ("rest_speed_m_s", math.inf),
        ("rest_turn_rate_rad_s", math.inf), ("rest_speed_m_s", -1.0), ("process_turn", math.nan),
    ],
)  # fmt: skip
def test_bad_settings_are_named(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"config.{name} must be"):
        make_odometry_filter("differential-transform", {name: value})
