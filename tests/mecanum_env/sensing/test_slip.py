from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mecanum_env.config import NOISE_PRESETS, ROBOT_PRESETS, NoiseConfig
from mecanum_env.physics.robot import WheelTargets, inverse_kinematics
from mecanum_env.physics.world import World
from mecanum_env.sensing.calibration import odometry_noise
from mecanum_env.sensing.odometry_calibration import open_floor
from mecanum_env.sensing.sensors import WheelEncoders
from mecanum_env.sensing.slip import follow, grip_m_s2, traction_constants
from slam.motion import twist_between

ROBOT = ROBOT_PRESETS["youbot"]
CONSTANTS = traction_constants(ROBOT, NoiseConfig())
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
    pull = grip_m_s2(NoiseConfig()) / (CONSTANTS[1] if axis == 2 else 1.0)
    np.testing.assert_allclose(body, twist, atol=1e-6)
    # Above v² / 2 a, since a wheel that slips by less than s₀ does not pull with all its grip.
    assert speed**2 / (2 * pull) < lost[axis] < 1.15 * speed**2 / (2 * pull) + 1e-3
    np.testing.assert_allclose(np.delete(lost, axis), 0.0, atol=1e-12)


def test_wheels_that_speed_up_gently_do_not_slip() -> None:
    body, lost, last = np.zeros(3), np.zeros(3), np.zeros(4)
    for k in range(1, 40):
        now = wheels_of(0.02 * k, -0.01 * k, 0.01 * k)  # 2, 1 and 1 m/s² where the floor passes on 4.2
        follow(body, last, now, 0.01, CONSTANTS, lost)
        last = now
    np.testing.assert_array_equal(lost, 0.0)
    np.testing.assert_allclose(body, (0.78, -0.39, 0.39))


def jerky_errors(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return squared errors of the wheels' twist and V's variances ``(n, 3)``: a robot is driven in jerks."""
    noise = NOISE_PRESETS[name]
    declared = odometry_noise(ROBOT, noise)
    squares, variances = [], []
    for seed in range(12):
        world_rng, sensor_rng, drive_rng = (
            np.random.Generator(np.random.PCG64(s)) for s in np.random.SeedSequence(seed).spawn(3)
        )
        encoders = WheelEncoders(ROBOT, noise, world_rng)
        world = World(
            open_floor(), ROBOT, noise, world_rng, true_radii=encoders.true_radii, true_lever=encoders.true_lever
        )
        targets, body = WheelTargets(ROBOT), (0.0, 0.0, 0.0)
        for _ in range(100):
            before = world.pose
            world.step(targets.of_twist(drive_rng.uniform(-1, 1, 3)), STEP, 0.02)
            odometry = encoders.odometry(world.wheel_readings, STEP, sensor_rng)
            twist, var_v, var_w, body = declared.of_step(odometry, body)
            squares.append((np.array(twist) - twist_between(before, world.pose, STEP)) ** 2)
            variances.append((var_v, var_v, var_w))
    return np.array(squares), np.array(variances)


@pytest.mark.parametrize("name", ["nominal", "slippery"])
def test_what_slips_in_jerks_is_in_the_declared_covariance(name: str) -> None:
    squares, variances = jerky_errors(name)
    hard = variances[:, 0] > np.median(variances[:, 0])
    for steps in (hard, ~hard):
        ratio = squares[steps].sum(axis=0) / variances[steps].sum(axis=0)
        # Below 1 on patches: wheels are taken to stand on one, where three quarters of the floor hold better.
        assert ratio.min() > 0.35 and ratio.max() < 1.6, ratio
    assert math.sqrt(np.median(variances[:, 0])) > 0.02
