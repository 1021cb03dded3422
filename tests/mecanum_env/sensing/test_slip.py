from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mecanum_env.config import NOISE_PRESETS, ROBOT_PRESETS, NoiseConfig, RobotConfig
from mecanum_env.physics.robot import WheelTargets, inverse_kinematics
from mecanum_env.physics.world import World
from mecanum_env.sensing.calibration import odometry_noise
from mecanum_env.sensing.odometry_calibration import open_floor
from mecanum_env.sensing.sensors import WheelEncoders
from mecanum_env.sensing.slip import (
    add_up,
    follow,
    grip_m_s2,
    mean_of_slipperiest,
    patch_friction,
    slipperiest,
    traction_constants,
)
from slam.motion import twist_between

ROBOT = ROBOT_PRESETS["youbot"]
CONSTANTS = np.array(traction_constants(ROBOT, NoiseConfig().friction))
STEP = 0.1


def wheels_of(vx: float, vy: float, turn: float) -> np.ndarray:
    """Return ground speeds ``(4,)`` of wheels that roll; ``turn`` [m/s] is the turn rate times the lever."""
    return ROBOT.wheel_radius_m * inverse_kinematics(ROBOT, (vx, vy, turn / ROBOT.lever_m))


def pulled_up(wheels: np.ndarray, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Let a body at rest follow wheels that turn at once; return its speeds and by how far they outran it."""
    body, lost, dt = np.zeros(3), np.zeros(3), 0.002
    for _ in range(round(seconds / dt)):
        follow(body, wheels, wheels, dt, CONSTANTS, lost)
    return body, lost


@given(speed=st.floats(0.3, 0.8), axis=st.integers(0, 2))
def test_wheels_that_jump_outrun_the_body_by_what_the_floor_takes_to_pull_it_up(speed: float, axis: int) -> None:
    """v² / 2 a along x and y; a turn is pulled up faster, by what the body's inertia is less than m l²."""
    twist = np.zeros(3)
    twist[axis] = speed
    body, lost = pulled_up(wheels_of(*twist), 1.0)
    pull = grip_m_s2(NoiseConfig().friction) / (CONSTANTS[1] if axis == 2 else 1.0)
    np.testing.assert_allclose(body, twist, atol=1e-6)
    # Above v² / 2 a, since a wheel that slips by less than s₀ does not pull with all its grip.
    assert speed**2 / (2 * pull) < lost[axis] < 1.15 * speed**2 / (2 * pull) + 1e-3
    np.testing.assert_allclose(np.delete(lost, axis), 0.0, atol=1e-12)


def test_wheels_that_speed_up_gently_creep_and_do_not_slip() -> None:
    body, lost, last, dt = np.zeros(3), np.zeros(3), np.zeros(4), 0.01
    gain = np.array([1.0, -0.5, 0.5])  # m/s², of the 4.2 that the floor passes on
    for k in range(1, 40):
        now = wheels_of(*(k * dt * gain))
        assert not follow(body, last, now, dt, CONSTANTS, lost)
        last = now
    np.testing.assert_array_equal(lost, 0.0)
    creep_s = math.sqrt(2.0) * ROBOT.slip_speed_m_s / grip_m_s2(NoiseConfig().friction)
    np.testing.assert_allclose(body, (39.5 * dt - creep_s * np.array([1.0, 1.0, CONSTANTS[1]])) * gain)


def test_slip_that_lasts_adds_up_to_the_variance_of_its_sum() -> None:
    slid, dt = np.zeros(3), 0.1
    steps = np.array([(0.01, 0.0, 0.02), (0.02, 0.01, 0.01), (0.0, 0.01, 0.0), (-0.03, 0.0, -0.01)])
    found = [add_up(slid, step, dt, True) for step in steps]
    slid[:] = 0.0
    for step, (along, turned) in zip(steps, found, strict=True):
        grown = slid + step
        if slid @ step >= 0.0:  # back again: as though it were another slide
            assert along**2 == pytest.approx(grown[:2] @ grown[:2] - slid[:2] @ slid[:2])
            assert turned**2 == pytest.approx(grown[2] ** 2 - slid[2] ** 2)
        else:
            assert (along, turned) == pytest.approx((math.hypot(*step[:2]), abs(step[2])))
        slid = (1.0 - dt) * grown
    add_up(slid, np.zeros(3), dt, False)
    np.testing.assert_array_equal(slid, 0.0)


@given(speed=st.floats(0.3, 0.8), patch_share=st.floats(0.05, 0.9), least=st.floats(0.05, 0.3))
def test_where_patches_differ_their_mean_is_taken_out_and_the_longest_slide_declared(
    speed: float, patch_share: float, least: float
) -> None:
    """Wheels that have gone at one speed stop at once; the robot slides v² / 2 a, for v / a, by the patch's a."""
    most, dt, readings = least + 0.2, 0.1, 20
    noise = NoiseConfig(
        encoder=0.0, radius_error=0.0, base_error=0.0, slip=0.0, friction=2.0, patch_share=patch_share,
        patch_friction=(least, most),
    )  # fmt: skip
    encoders = WheelEncoders(ROBOT, noise, np.random.default_rng(0))
    turned = speed / ROBOT.wheel_radius_m * dt * np.arange(1, readings + 1)[:, None] / readings * np.ones(4)
    for _ in range(100):
        encoders.odometry(turned, dt, np.random.default_rng(0))
    slid, longest = 0.0, speed / grip_m_s2(least)
    for step in range(100):
        odometry = encoders.odometry(np.zeros((readings, 4)), dt, np.random.default_rng(0))
        slid += odometry.twist[0] * dt
        assert odometry.slip[0] > 1e-3 or (step + 1) * dt > longest
    frictions = np.linspace(least, most, 1001)
    on_patches = np.mean([speed**2 / (2.0 * grip_m_s2(mu)) for mu in frictions])
    on_the_floor = speed**2 / (2.0 * grip_m_s2(2.0))
    expected = (1.0 - patch_share) * on_the_floor + patch_share * on_patches
    # A wheel that slips by less than s₀ does not pull with all its grip.
    assert 0.97 * expected < slid < 1.12 * expected + 1e-3


def jerky_errors(noise: NoiseConfig, steps_each: int) -> tuple[np.ndarray, np.ndarray]:
    """Drive a robot in jerks, a twist for so many steps; return what the odometry is off by, and V.

    Errors ``(n, 3)`` [m, m, rad] and their variances by :class:`slam.motion.OdometryNoise`, each step's.
    """
    declared = odometry_noise(ROBOT, noise)
    errors, variances = [], []
    for seed in range(12):
        world_rng, sensor_rng, drive_rng = (
            np.random.Generator(np.random.PCG64(s)) for s in np.random.SeedSequence(seed).spawn(3)
        )
        encoders = WheelEncoders(ROBOT, noise, world_rng)
        world = World(
            open_floor(), ROBOT, noise, world_rng, true_radii=encoders.true_radii, true_lever=encoders.true_lever
        )
        targets, body, action = WheelTargets(ROBOT), (0.0, 0.0, 0.0), np.zeros(3)
        for step in range(160):
            if step % steps_each == 0:
                action = drive_rng.uniform(-1, 1, 3)
            before = world.pose
            world.step(targets.of_twist(action), STEP, 0.02)
            odometry = encoders.odometry(world.wheel_readings, STEP, sensor_rng)
            twist, var_v, var_w, body = declared.of_step(odometry, body)
            errors.append(STEP * (np.array(twist) - twist_between(before, world.pose, STEP)))
            variances.append(STEP**2 * np.array((var_v, var_v, var_w)))
    return np.array(errors), np.array(variances)


NO_OTHER_NOISE = NoiseConfig(encoder=0.0, radius_error=0.0, base_error=0.0)


@pytest.mark.parametrize("friction", [0.4, 0.6])
def test_what_slips_in_jerks_is_taken_out_where_the_floor_is_known(friction: float) -> None:
    """Wheels outrun the body by a centimetre a step; of that a millimetre is left, and declared."""
    errors, variances = jerky_errors(replace(NO_OTHER_NOISE, friction=friction), 1)
    assert np.sqrt(np.mean(errors[:, :2] ** 2)) < 0.001
    assert np.all(np.mean(errors**2, axis=0) < 1.6 * variances.mean(axis=0))


@given(least=st.floats(0.01, 1.0), wide=st.floats(0.0, 1.0), friction=st.floats(0.05, 2.0))
def test_a_patch_is_no_slipperier_than_the_world_makes_it(least: float, wide: float, friction: float) -> None:
    """Where a patch would grip better than the floor, the floor's friction counts: min(F, μ), μ uniform."""
    noise = NoiseConfig(friction=friction, patch_share=0.3, patch_friction=(least, least + wide))
    frictions = np.minimum(least + wide * (np.arange(20_000) + 0.5) / 20_000, friction)
    assert slipperiest(noise) == min(least, friction)
    assert patch_friction(noise) == pytest.approx(frictions.mean(), rel=1e-6)
    assert mean_of_slipperiest(noise) == pytest.approx(np.mean(slipperiest(noise) / frictions), rel=1e-5)
    assert patch_friction(replace(noise, patch_share=0.0)) == friction


def test_patches_that_grip_better_than_the_floor_change_nothing() -> None:
    noise = replace(NO_OTHER_NOISE, friction=0.2, patch_share=0.4, patch_friction=(0.5, 0.8))
    errors, variances = jerky_errors(noise, 8)
    assert np.sqrt(np.mean(errors[:, :2] ** 2)) < 0.001
    np.testing.assert_allclose(errors, jerky_errors(replace(noise, patch_share=0.0), 8)[0], atol=1e-12)
    assert np.all(variances > 0.0)


@pytest.mark.parametrize("patch_share", [0.2, 0.4])
def test_slides_on_patches_are_in_the_declared_covariance(patch_share: float) -> None:
    """A twist is held for 0.8 s, and its errors add up over that time."""
    errors, variances = jerky_errors(replace(NO_OTHER_NOISE, patch_share=patch_share), 8)
    slides, declared = errors.reshape(-1, 8, 3).sum(axis=1), variances.reshape(-1, 8, 3).sum(axis=1)
    ratio = np.sum(slides**2, axis=0) / np.sum(declared, axis=0)
    assert ratio.min() > 0.35 and ratio.max() < 1.2, ratio
    assert np.mean(slides**2 / declared, axis=0).max() < 1.5
    assert np.sqrt(np.median(declared[:, 0])) > 0.02


@pytest.mark.parametrize("name", ["nominal", "slippery"])
def test_what_slips_in_jerks_is_in_the_declared_covariance(name: str) -> None:
    errors, variances = jerky_errors(NOISE_PRESETS[name], 1)
    hard = variances[:, 0] > np.median(variances[:, 0])
    for steps in (hard, ~hard):
        ratio = np.sum(errors[steps] ** 2, axis=0) / variances[steps].sum(axis=0)
        assert ratio.max() < 1.6, ratio


def test_a_body_that_spins_fast_is_imagined_no_faster_than_it_is() -> None:
    """12 cm long, at 20 rad/s on ice: to first order turns would stretch what friction does not take back."""
    robot = RobotConfig(
        length_m=0.12, width_m=0.1, mass_kg=0.25, wheel_radius_m=0.02, wheelbase_m=0.06, track_m=0.05,
        motor_torque_nm=0.1, motor_gain=0.01, wheel_inertia_kg_m2=1e-5, wheel_friction=0.0, max_speed_m_s=3.0,
        max_turn_rate_rad_s=20.0,
    )  # fmt: skip
    noise = NoiseConfig(friction=0.2, encoder=0.0, radius_error=0.0, base_error=0.0)
    rng = np.random.default_rng(0)
    encoders, world = WheelEncoders(robot, noise, rng), World(open_floor(), robot, noise, rng)
    targets = WheelTargets(robot)
    for step in range(200):
        if step % 5 == 0:
            action = rng.uniform(-1.0, 1.0, 4)
        if math.hypot(*world.pose[:2]) > 6.0:
            world.put([0.0, 0.0, 0.0])
        world.step(targets.of_wheels(action), STEP, 0.02)
        assert math.hypot(*encoders.odometry(world.wheel_readings, STEP, rng).twist[:2]) < 2.0
