"""V as measured on the simulated robot, against what is known of its noise and what the estimators are told."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest

from mecanum_env.config import NOISE_PRESETS, ROBOT_PRESETS, EnvConfig, NoiseConfig, RobotConfig
from mecanum_env.sensing.calibration import backend_settings, odometry_noise
from mecanum_env.sensing.odometry_calibration import Drives, drift_ratios, drive, fit, open_floor
from mecanum_env.sensing.sensors import WheelEncoders
from slam.geometry import wrap
from slam.motion import OdometryNoise
from training.cli import main

ROBOT = RobotConfig()
LEVER = ROBOT.lever_m
PERFECT = NoiseConfig(encoder=0.0, radius_error=0.0, base_error=0.0)


@pytest.fixture(scope="module")
def nominal() -> Drives:
    return drive(ROBOT, NOISE_PRESETS["nominal"], episodes=60, steps=120)


def sigma(noise: OdometryNoise, speed: float) -> tuple[float, float]:
    """Return σ of v and of ω at a speed."""
    v, w = noise.variances(speed, 0.0, 0.0)
    return math.sqrt(v), math.sqrt(w)


def test_drives_are_varied_and_touch_nothing(nominal: Drives) -> None:
    speed = nominal.speeds(LEVER)
    assert np.mean(speed < 0.01) > 0.03  # it stops
    assert np.quantile(speed, 0.98) > 0.5  # and drives fast
    assert np.all(np.std(nominal.true.reshape(-1, 3), axis=0) > 0.1)
    assert open_floor().distance_to_surfaces(np.zeros((1, 2)))[0] == pytest.approx(8.0)
    # Errors are of measurement, not of contact: none comes near a robot that is held up.
    assert np.abs(nominal.errors[..., :2]).max() < 0.08


def test_the_same_seed_drives_the_same() -> None:
    a, b = (drive(ROBOT, NOISE_PRESETS["slippery"], episodes=2, steps=20, seed=3) for _ in range(2))
    np.testing.assert_array_equal(a.measured, b.measured)
    np.testing.assert_array_equal(a.true, b.true)


def test_without_noise_odometry_is_off_by_half_a_millimetre_a_second() -> None:
    """The wheels' creep under acceleration is taken out: with it, 1.2 mm/s."""
    found = fit(drive(ROBOT, PERFECT, episodes=10, steps=100), LEVER)
    assert np.all(np.abs(found.gain) < 0.001)
    assert sigma(found.white, 0.5)[0] < 0.0005
    assert sigma(found.lasting, 0.5)[0] < 0.001


def test_the_white_part_of_encoder_noise_is_what_theory_says() -> None:
    """Four wheels with 1σ = e of their own increments: e/2 of the speed in v, e/(2l) in ω."""
    e = 0.05
    found = fit(
        drive(ROBOT, NoiseConfig(encoder=e, radius_error=0.0, base_error=0.0), episodes=30, steps=100), LEVER
    )
    v, w = sigma(found.white, 0.4)
    assert v == pytest.approx(0.4 * e / 2, rel=0.15)
    assert w == pytest.approx(0.4 * e / (2 * LEVER), rel=0.15)


def test_synthetic_errors_come_back() -> None:
    """White errors of a known V: the white and the lasting fit both find it, and the drift ratio is 1."""
    rng = np.random.default_rng(1)
    true = rng.uniform(-0.4, 0.4, (40, 1, 3)) * np.ones((40, 200, 3))
    told = OdometryNoise(speed_floor_m_s=0.01, speed_share=0.05, turn_floor_rad_s=0.02, turn_share_rad_m=0.1)
    speed = np.sqrt(true[..., 0] ** 2 + true[..., 1] ** 2 + (told.lever_m * true[..., 2]) ** 2)
    sigmas = np.stack([0.01 + 0.05 * speed, 0.01 + 0.05 * speed, 0.02 + 0.1 * speed], axis=-1)
    measured = true + sigmas * rng.standard_normal(true.shape)
    drives = Drives(measured, true, np.zeros((40, 200, 2)), 0.1)
    found = fit(drives, told.lever_m)
    for noise in (found.white, found.lasting):
        assert sigma(noise, 0.4) == pytest.approx(sigma(told, 0.4), rel=0.1)
    assert drift_ratios(drives, told) == pytest.approx((1.0, 1.0), abs=0.12)


def test_odometry_takes_the_mean_slip_out() -> None:
    found = fit(drive(ROBOT, NOISE_PRESETS["cavity"], episodes=10, steps=100), LEVER)
    np.testing.assert_allclose(found.gain, 0.0, atol=0.02)


@pytest.mark.parametrize("preset", ["nominal", "slippery", "cavity"])
def test_the_declared_v_is_the_measured_one(preset: str) -> None:
    """Shares within 20 % of what was measured over 60 episodes, and drifts over a window as V allows."""
    robot = ROBOT_PRESETS.get(preset, ROBOT)
    drives = drive(robot, NOISE_PRESETS[preset], episodes=60, steps=120)
    declared, measured = odometry_noise(robot, NOISE_PRESETS[preset]), fit(drives, robot.lever_m)
    for told, found in ((declared, measured.lasting), (declared.white(), measured.white)):
        assert told.speed_share == pytest.approx(found.speed_share, rel=0.2)
        assert told.turn_share_rad_m == pytest.approx(found.turn_share_rad_m, rel=0.2)
    assert all(0.7 < ratio < 1.2 for ratio in drift_ratios(drives, declared))


def test_what_slips_at_random_is_a_share_of_the_motion_that_is_left() -> None:
    """Odometry tells the wheels' motion less the mean slip p: of that, random slip is p / (1 - p), not p.

    Over a window: from one step to the next the body does not follow at once.
    """
    noise = dataclasses.replace(NOISE_PRESETS["cavity"], slip=0.3, encoder=0.0, radius_error=0.0, base_error=0.0)
    drives = drive(ROBOT, noise, episodes=30, steps=120)
    assert drift_ratios(drives, odometry_noise(ROBOT, noise)) == pytest.approx((1.0, 1.0), abs=0.15)


def test_errors_that_last_add_up_over_the_same_time_whatever_the_step() -> None:
    usual, short, long = (odometry_noise(ROBOT, NOISE_PRESETS["nominal"], step_s) for step_s in (0.1, 0.02, 2.0))
    for share, white in (
        ("speed_share", usual.white().speed_share),
        ("turn_share_rad_m", usual.white().turn_share_rad_m),
    ):
        lasting = {v: getattr(v, share) ** 2 - white**2 for v in (usual, short, long)}
        assert lasting[short] == pytest.approx(5.0 * lasting[usual])
        assert lasting[long] == pytest.approx(lasting[usual] / 8.0)


def test_the_lasting_errors_declared_are_those_that_are_drawn() -> None:
    noise = NOISE_PRESETS["slippery"]
    drawn = [WheelEncoders(ROBOT, noise, np.random.default_rng(seed)) for seed in range(1000)]
    told = odometry_noise(ROBOT, noise).lasting
    assert told is not None
    radii = np.array([e.true_radii for e in drawn]) / ROBOT.wheel_radius_m - 1.0
    levers = np.array([e.true_lever for e in drawn]) / ROBOT.lever_m - 1.0
    assert np.std(radii) == pytest.approx(told.radius_sigma, rel=0.05)
    assert np.std(levers) == pytest.approx(told.lever_sigma, rel=0.05)


def test_a_v_of_one_s_own_is_the_whole_of_it() -> None:
    """Shares given for the odometry replace what follows from the noise, the filter's states for it included."""
    whole = backend_settings(EnvConfig(slam_config={"odometry": {"speed_share": 0.5}}))["odometry"]
    assert whole["speed_share"] == 0.5 and "lasting" not in whole
    other = backend_settings(EnvConfig(slam_config={"odometry": {"grip_m_s2": 1.0}}))["odometry"]
    assert other["lasting"]["radius_sigma"] > 0.0


def test_the_command_prints_measured_beside_declared(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["study", "calibration", "--noise", "nominal", "--episodes", "3", "--steps", "40", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)["nominal"]
    assert {"white", "lasting", "lasting_without_gain", "declared", "gain", "bins", "steps"} <= result.keys()
    assert result["declared"]["speed_share"] == pytest.approx(0.0096, abs=1e-4)
    assert main(["study", "calibration", "--noise", "nominall"]) == 2
    assert "did you mean 'nominal'?" in capsys.readouterr().err
    assert main(["study", "calibration", "--episodes", "0"]) == 2


def test_headings_stay_wrapped(nominal: Drives) -> None:
    # A jump of the heading at ±π would show as a turn rate of 2π / dt.
    assert np.abs(wrap(nominal.true[..., 2] * nominal.dt)).max() < 0.2
