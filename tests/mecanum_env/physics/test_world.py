"""Driving, touching and slipping in hand-made worlds."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mecanum_env.config import NOISE_PRESETS, ROBOT_PRESETS, NoiseConfig, RobotConfig
from mecanum_env.physics.robot import WheelTargets
from mecanum_env.physics.world import CONTACT_GAP_S, MAX_TRAVEL_M, World
from mecanum_env.rooms.floor_plan import FloorPlanError
from mecanum_env.sensing.sensors import WheelEncoders
from tests.mecanum_env.physics.worlds import EXACT, ROBOT, STEP, Array, drive, random_drive, room, world

G = 9.80665


def footprint(w: World) -> Array:
    x, y, theta = w.pose
    half_x, half_y = 0.5 * w.robot.length_m, 0.5 * w.robot.width_m
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (half_x, half_y)
    c, s = math.cos(theta), math.sin(theta)
    return corners @ np.array([[c, s], [-s, c]]) + (x, y)


def depth(w: World, size: float = 6.0) -> float:
    """Return how deep the robot is in the walls of the room [m], at most."""
    corners = footprint(w)
    return float(max(0.0, -corners.min(), corners.max() - size))


# ---- driving -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["youbot", "cavity"])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_robot_goes_where_its_wheels_take_it(name: str, axis: int) -> None:
    w = world(room(), robot=ROBOT_PRESETS[name])
    action = [0.0, 0.0, 0.0]
    action[axis] = 0.5
    drive(w, (action[0], action[1], action[2]), 2.0)
    before = w.pose
    drive(w, (action[0], action[1], action[2]), 1.0)
    limits = (w.robot.max_speed_m_s, w.robot.max_speed_m_s, w.robot.max_turn_rate_rad_s)
    expected = np.zeros(3)
    expected[axis] = 0.5 * limits[axis]
    np.testing.assert_allclose(w.pose - before, expected, atol=1e-5)
    np.testing.assert_allclose(w.twist, expected, atol=1e-5)
    assert w.collisions == 0


def test_with_exact_encoders_and_gentle_driving_odometry_is_nearly_the_path() -> None:
    w = world(room())
    encoders = WheelEncoders(ROBOT, EXACT, np.random.default_rng(0))
    rng = np.random.default_rng(0)
    total = np.zeros(3)
    for k in range(60):
        w.step(WheelTargets(ROBOT).of_twist((0.3 * math.sin(0.1 * k), 0.0, 0.0)), STEP, 0.02)
        total += STEP * np.asarray(encoders.odometry(w.wheel_readings, STEP, rng).twist)
    np.testing.assert_allclose(w.pose, np.array([3.0, 3.0, 0.0]) + total, atol=5e-3)


def test_true_radii_and_lever_change_what_the_wheels_do() -> None:
    w = world(room(), true_radii=np.full(4, 1.02 * ROBOT.wheel_radius_m))
    drive(w, (0.5, 0, 0), 2.0)
    assert w.twist[0] == pytest.approx(1.02 * 0.5 * ROBOT.max_speed_m_s, rel=1e-4)
    w = world(room(), true_lever=1.03 * ROBOT.lever_m)
    drive(w, (0, 0, 0.5), 2.0)
    assert w.twist[2] == pytest.approx(0.5 * ROBOT.max_turn_rate_rad_s / 1.03, rel=1e-4)


@pytest.mark.parametrize("noise", ["nominal", "slippery"])
def test_leaving_pymunk_out_changes_nothing_in_the_open(noise: str) -> None:
    plan = room(12.0, (6.0, 6.0, 0.4))
    paths = []
    for shortcut in (True, False):
        w = world(plan, noise=NOISE_PRESETS[noise], shortcut=shortcut)
        paths.append(random_drive(w, 150, scale=0.7))
        assert w.collisions == 0
    np.testing.assert_allclose(paths[0], paths[1], rtol=0, atol=1e-12)
    assert np.ptp(paths[0][:, 0]) > 0.3


def test_leaving_pymunk_out_changes_nothing_among_obstacles() -> None:
    box = np.array([[3.8, 2.5], [4.4, 2.5], [4.4, 3.4], [3.8, 3.4]])
    plan = room(6.0, (2.2, 3.0, 0.1), polygons=(box,), circles=np.array([[1.0, 1.2, 0.3]]))
    worlds = [world(plan, shortcut=shortcut) for shortcut in (True, False)]
    paths = [random_drive(w, 250, seed=1, hold=20) for w in worlds]
    assert worlds[0].collisions == worlds[1].collisions > 2
    assert worlds[0].last_impulse == pytest.approx(worlds[1].last_impulse, abs=1e-6)
    np.testing.assert_allclose(paths[0], paths[1], rtol=0, atol=1e-6)


def test_finer_physics_steps_give_the_same_path() -> None:
    plan = room()
    wheels = WheelTargets(ROBOT).of_twist((0.6, 0.3, 0.4))
    ends = []
    for physics_step in (0.02, 0.01, 0.002):
        w = world(plan)
        for _ in range(10):
            w.step(wheels, STEP, physics_step)
        ends.append(w.pose)
    np.testing.assert_allclose(ends[0], ends[2], atol=1e-6)
    np.testing.assert_allclose(ends[1], ends[2], atol=1e-6)


# ---- the floor ---------------------------------------------------------------------------------------------


def test_wheels_feel_the_patch_they_stand_on() -> None:
    # Started with everything spinning: what is reached in 0.2 s is limited by friction (μ g/√2 at most).
    strong = RobotConfig(motor_torque_nm=50.0, motor_gain=50.0, max_speed_m_s=5.0)
    reached = []
    for share in (0.0, 0.97):
        noise = NoiseConfig(patch_share=share, patch_friction=(0.15, 0.15))
        w = World(room(), strong, noise, np.random.default_rng(7))
        w.step(np.full(4, 60.0), 0.2, 0.02)
        reached.append(w.twist[0])
    assert reached[0] == pytest.approx(0.6 * G / math.sqrt(2) * 0.2, rel=0.1)
    assert reached[1] == pytest.approx(0.15 * G / math.sqrt(2) * 0.2, rel=0.1)


def test_slip_loses_its_mean_share_and_odometry_does_not_see_it() -> None:
    noise = NoiseConfig(slip=0.1, encoder=0, radius_error=0, base_error=0)
    w = World(room(40.0, (2.0, 20.0, 0.0)), ROBOT, noise, np.random.default_rng(0))
    drive(w, (0.8, 0, 0), 1.0)
    before, rolled = w.pose, 0.0
    wheels = WheelTargets(ROBOT).of_twist((0.8, 0, 0))
    for _ in range(400):
        w.step(wheels, STEP, 0.02)
        rolled += ROBOT.wheel_radius_m * float(np.mean(w.wheel_readings[-1]))
    moved = float(np.hypot(*(w.pose - before)[:2]))
    # Slip is drawn apart for each wheel, so the path bends, too: compare lengths only roughly.
    assert moved / rolled == pytest.approx(0.9, abs=0.015)
    assert np.abs(w.pose[1] - 20.0) > 1e-3


def test_odometry_reads_too_much_where_it_accelerates_on_ice_that_nobody_told_of() -> None:
    for friction, declared in ((0.6, 0.6), (0.1, 0.1), (0.1, 0.6)):
        exact = NoiseConfig(friction=declared, encoder=0, radius_error=0, base_error=0)
        encoders = WheelEncoders(ROBOT, exact, np.random.default_rng(0))
        w = world(room(), noise=replace(exact, friction=friction))
        read = 0.0
        for _ in range(4):
            w.step(WheelTargets(ROBOT).of_twist((1, 0, 0)), STEP, 0.02)
            odometry = encoders.odometry(w.wheel_readings, STEP, np.random.default_rng(0))
            read += STEP * float(odometry.twist[0])
        excess = read - (w.pose[0] - 3.0)
        if friction == declared:
            assert abs(excess) < 0.01
        else:
            assert excess > 0.1


# ---- contacts ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["youbot", "cavity"])
def test_a_wall_is_struck_once_with_the_robots_momentum(name: str) -> None:
    robot = ROBOT_PRESETS[name]
    w = world(room(6.0, (4.5, 3.0, 0.0)), robot=robot)
    deepest = 0.0
    wheels = WheelTargets(robot).of_twist((1, 0, 0))
    for _ in range(50):
        w.step(wheels, STEP, 0.02)
        deepest = max(deepest, depth(w))
        if w.collisions == 0:
            speed = w.twist[0]
    assert w.collisions == 1
    assert speed == pytest.approx(robot.max_speed_m_s, rel=0.01)
    # Elasticity 0.2²; the motors push on a little while it lasts.
    assert w.last_impulse == pytest.approx(robot.mass_kg * speed * 1.04, rel=0.05)
    assert deepest < MAX_TRAVEL_M
    assert w.pose[0] == pytest.approx(6.0 - 0.5 * robot.length_m, abs=3e-3)
    np.testing.assert_allclose(w.twist, 0.0, atol=5e-3)


def test_the_impulse_of_pressing_is_the_force_of_traction_times_time() -> None:
    w = world(room(6.0, (5.6, 3.0, 0.0)))
    drive(w, (1, 0, 0), 2.0)
    before = w.last_impulse_total
    drive(w, (1, 0, 0), 2.0)
    spin, s0 = ROBOT.wheel_radius_m * float(np.mean(w.wheel_speeds)) / math.sqrt(2), ROBOT.slip_speed_m_s
    force = 0.6 * ROBOT.mass_kg * G / math.sqrt(2) * spin / math.hypot(spin, s0)
    assert w.last_impulse_total - before == pytest.approx(2.0 * force, rel=0.02)
    assert w.collisions == 1


def test_both_walls_of_a_corner_are_one_contact_and_a_later_one_is_another() -> None:
    w = world(room(6.0, (5.2, 5.3, 0.0)))
    drive(w, (0.6, 0.6, 0), 3.0)
    assert depth(w) < 4e-3
    assert footprint(w).max() > 5.995
    assert w.collisions == 1
    drive(w, (-0.5, -0.5, 0), 0.6)
    drive(w, (0.0, 0.0, 0), CONTACT_GAP_S + 0.2)
    drive(w, (0.6, 0.0, 0), 2.0)
    assert w.collisions == 2


def test_tapping_a_wall_again_at_once_is_the_same_contact() -> None:
    w = world(room(6.0, (5.6, 3.0, 0.0)))
    drive(w, (0.3, 0, 0), 1.0)
    peak = w.last_impulse
    assert w.collisions == 1
    drive(w, (-0.3, 0, 0), 0.2)
    assert footprint(w).max() < 5.995
    drive(w, (0.3, 0, 0), 0.6)
    assert w.collisions == 1
    assert w.last_impulse >= peak


def test_sliding_along_a_wall_hardly_ever_catches_on_its_seams() -> None:
    caught = 0
    cases = [(11, (0.8, 0.1, 0.1)), (11, (1.0, 0.3, 0.0)), (40, (0.5, 0.1, 0.0)), (11, (0.3, 0.1, 0.05))]
    for pieces, action in cases:
        worlds = [world(room(6.0, (0.6, 5.6, 0.0), pieces=parts)) for parts in (1, pieces)]
        for w in worlds:
            drive(w, action, 7.0)
            assert depth(w) < MAX_TRAVEL_M
        whole, in_pieces = worlds
        assert in_pieces.pose[0] - 0.6 == pytest.approx(whole.pose[0] - 0.6, rel=0.1)
        caught += in_pieces.last_impulse > 2 * whole.last_impulse
    assert caught <= 1  # in 40 seams; all four are, if pymunk is not told of the neighbours


def test_obstacles_stop_the_robot_at_their_surface() -> None:
    box = np.array([[4.0, 2.0], [4.5, 2.0], [4.5, 4.0], [4.0, 4.0]])
    w = world(room(polygons=(box,)))
    drive(w, (0.6, 0, 0), 4.0)
    assert w.pose[0] == pytest.approx(4.0 - 0.29, abs=4e-3)
    w = world(room(circles=np.array([[3.0, 4.5, 0.4]])))
    drive(w, (0, 0.6, 0), 4.0)
    assert w.pose[1] == pytest.approx(4.1 - 0.19, abs=4e-3)
    assert w.collisions == 1


@pytest.mark.parametrize("seed", range(3))
def test_random_driving_never_leaves_the_room(seed: int) -> None:
    w = world(room(2.0, (1.0, 1.0, 0.0), pieces=6))
    rng = np.random.default_rng(seed)
    deepest = 0.0
    for _ in range(25):
        wheels = WheelTargets(ROBOT).of_twist(rng.uniform(-1, 1, 3))
        for _ in range(10):
            w.step(wheels, STEP, 0.02)
            deepest = max(deepest, depth(w, 2.0))
    assert w.collisions > 3
    assert deepest < 0.008


def test_a_start_in_a_wall_is_refused() -> None:
    with pytest.raises(FloorPlanError, match=r"0\.58 m by 0\.38 m, touch something"):
        world(room(start=(0.2, 3.0, 0.0)))
    world(room(start=(0.2, 3.0, 0.5 * math.pi)))  # across, it fits


# ---- repeatability -----------------------------------------------------------------------------------------

SCRIPT = """
from mecanum_env.config import NOISE_PRESETS
from tests.mecanum_env.physics.worlds import random_drive, room, world
w = world(room(3.0, (1.5, 1.5, 0.0)), noise=NOISE_PRESETS["slippery"])
path = random_drive(w, 120, hold=20)
assert w.collisions
print(path.tobytes().hex())
"""


def test_a_seed_gives_the_same_path_to_the_last_bit_in_any_process() -> None:
    w = world(room(3.0, (1.5, 1.5, 0.0)), noise=NOISE_PRESETS["slippery"])
    own = random_drive(w, 120, hold=20).tobytes().hex()
    child = subprocess.run(
        [sys.executable, "-c", SCRIPT], cwd=Path(__file__).parents[3], capture_output=True, text=True, check=True
    )
    assert child.stdout.strip() == own
    other = World(w.plan, ROBOT, NOISE_PRESETS["slippery"], np.random.default_rng(8))
    assert random_drive(other, 120, hold=20).tobytes().hex() != own


def test_the_generator_yields_the_same_numbers_whatever_is_done() -> None:
    states = []
    for action, noise in (((0, 0, 0), EXACT), ((1, 0.5, 0), NoiseConfig(slip=0.3))):
        rng = np.random.default_rng(2)
        w = World(room(), ROBOT, noise, rng)
        drive(w, action, 2.0)
        states.append(rng.random())
    assert states[0] == states[1]


def test_what_is_handed_out_is_not_overwritten() -> None:
    w = world(room())
    drive(w, (0.5, 0, 0), 0.5)
    held = [w.pose, w.twist, w.wheel_speeds, w.wheel_readings[-1]]
    copies = [v.copy() for v in held]
    drive(w, (0, 0.5, 0.5), 0.5)
    for value, copy in zip(held, copies, strict=True):
        np.testing.assert_array_equal(value, copy)
