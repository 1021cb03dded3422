"""Kinematics against their definition, dynamics against an ODE solver, energy and closed forms."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from mecanum_env.config import ROBOT_PRESETS, RobotConfig
from mecanum_env.physics.robot import (
    INCREMENTS,
    POSE,
    REFERENCES,
    STATE_SIZE,
    TWIST,
    WHEELS,
    WheelTargets,
    dynamics_constants,
    forward_kinematics,
    forward_matrix,
    inverse_kinematics,
    motor_constants,
    turn_wheels,
    wheel_positions,
)

Array = NDArray[np.float64]

PRESETS = list(ROBOT_PRESETS.values())
G = 9.80665
ROLLERS = np.array([[1, -1], [1, 1], [1, 1], [1, -1]]) / math.sqrt(2.0)  # a_i, docs/reference/robot.md


def speeds(limit: float) -> st.SearchStrategy[float]:
    return st.floats(-limit, limit, allow_subnormal=False)


def drive(
    robot: RobotConfig,
    state: Array,
    targets: Array,
    *,
    duration: float,
    dt: float = 0.02,
    substeps: int = 20,
    mu: float = 0.6,
    radii: Array | None = None,
    constants: Array | None = None,
) -> None:
    """Advance ``state`` by ``duration`` [s], its pose included."""
    motion, motor, h = np.zeros(3), np.empty(7), dt / substeps
    targets, friction = np.asarray(targets, dtype=np.float64), np.full(4, mu)
    radii = np.full(4, robot.wheel_radius_m) if radii is None else radii
    constants = dynamics_constants(robot) if constants is None else constants
    motor_constants(constants, h, motor)
    for _ in range(round(duration / dt)):
        turn_wheels(state, targets, radii, friction, constants, motor, h, substeps, motion)
        state[POSE] += motion


def energy(robot: RobotConfig, state: Array) -> float:
    vx, vy, omega = state[TWIST]
    body = robot.mass_kg * (vx**2 + vy**2) + robot.inertia_kg_m2 * omega**2
    return float(0.5 * body + 0.5 * robot.wheel_inertia_kg_m2 * np.sum(state[WHEELS] ** 2))


# ---- kinematics --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("robot", PRESETS)
@given(vx=speeds(2), vy=speeds(2), omega=speeds(5))
def test_rolling_wheels_do_not_slip_along_their_rollers(
    robot: RobotConfig, vx: float, vy: float, omega: float
) -> None:
    wheels = inverse_kinematics(robot, (vx, vy, omega))
    for roller, (x, y), speed in zip(ROLLERS, wheel_positions(robot), wheels, strict=True):
        at_wheel = np.array([vx - omega * y, vy + omega * x])
        slip = roller @ (at_wheel - np.array([robot.wheel_radius_m * speed, 0.0]))
        assert abs(slip) < 1e-12


@pytest.mark.parametrize("robot", PRESETS)
@given(vx=speeds(2), vy=speeds(2), omega=speeds(5))
def test_forward_inverts_inverse_kinematics(robot: RobotConfig, vx: float, vy: float, omega: float) -> None:
    twist = np.array([vx, vy, omega])
    np.testing.assert_allclose(
        forward_kinematics(robot, inverse_kinematics(robot, twist)), twist, rtol=0, atol=1e-13
    )


@pytest.mark.parametrize("robot", PRESETS)
def test_forward_kinematics_is_the_pseudo_inverse(robot: RobotConfig) -> None:
    inverse = np.column_stack([inverse_kinematics(robot, axis) for axis in np.eye(3)])
    np.testing.assert_allclose(forward_matrix(robot), np.linalg.pinv(inverse), atol=1e-14)
    r, lever = robot.wheel_radius_m, robot.lever_m
    fl, fr, rl, rr = wheels = np.array([3.0, -1.0, 4.0, 1.5])
    expected = [
        r / 4 * (fl + fr + rl + rr),
        r / 4 * (-fl + fr + rl - rr),
        r / (4 * lever) * (-fl + fr - rl + rr),
    ]
    np.testing.assert_allclose(forward_kinematics(robot, wheels), expected, atol=1e-15)


def test_matrices_are_copies() -> None:
    robot = RobotConfig()
    forward_matrix(robot)[:] = 0.0
    assert np.all(forward_matrix(robot)[0] > 0)


@pytest.mark.parametrize("robot", PRESETS)
@given(action=st.tuples(speeds(1), speeds(1), speeds(1)))
def test_twist_actions_keep_their_direction_within_the_wheels_limits(
    robot: RobotConfig, action: tuple[float, float, float]
) -> None:
    wheels = WheelTargets(robot).of_twist(action)
    limit = robot.max_wheel_speed_rad_s
    assert np.max(np.abs(wheels)) <= limit * (1 + 1e-12)
    wanted = np.array(action) * (robot.max_speed_m_s, robot.max_speed_m_s, robot.max_turn_rate_rad_s)
    scale = min(1.0, limit / max(np.max(np.abs(inverse_kinematics(robot, wanted))), 1e-300))
    np.testing.assert_allclose(forward_kinematics(robot, wheels), scale * wanted, atol=1e-12)


def test_actions_are_clipped_and_checked() -> None:
    robot = RobotConfig()
    limit = robot.max_wheel_speed_rad_s
    targets = WheelTargets(robot)
    np.testing.assert_allclose(targets.of_wheels([2.0, -0.5, 0.0, 1.0]), limit * np.array([1, -0.5, 0, 1]))
    np.testing.assert_allclose(targets.of_twist([5, 0, 0]), np.full(4, limit))
    np.testing.assert_array_equal(targets.of_twist([1e308] * 3), targets.of_twist([1, 1, 1]))
    with pytest.raises(ValueError, match="3 finite numbers"):
        targets.of_twist([math.nan, 0, 0])
    with pytest.raises(ValueError, match="4 finite numbers"):
        targets.of_wheels([0, 0, 0])


@pytest.mark.parametrize(
    "bad", [[[0, 0, 0]], "abc", [None, 0, 0], [1j, 0, 0], 0.5, [], [[0], 0, 0], [math.inf, 0, 0]]
)
def test_what_is_no_action_is_refused_in_words(bad: object) -> None:
    with pytest.raises(ValueError, match="3 finite numbers"):
        WheelTargets(RobotConfig()).of_twist(bad)  # type: ignore[arg-type]


def test_an_action_may_be_of_any_numbers_anywhere_in_memory() -> None:
    robot = RobotConfig()
    expected = WheelTargets(robot).of_twist([1.0, 0.0, -1.0])
    numbers = np.array([1.0, 9.0, 0.0, 9.0, -1.0, 9.0])
    for action in (numbers[::2], numbers[::2].astype(np.float32), numbers[::2].astype(int), (1, 0, -1)):
        np.testing.assert_array_equal(WheelTargets(robot).of_twist(action), expected)
    np.testing.assert_array_equal(numbers, [1.0, 9.0, 0.0, 9.0, -1.0, 9.0])


# ---- dynamics ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("robot", PRESETS)
@pytest.mark.parametrize(
    "twist", [(0.4, 0, 0), (-0.4, 0, 0), (0, 0.4, 0), (0, -0.4, 0), (0, 0, 1.2), (0.3, 0.1, 0)]
)
def test_free_rolling_reaches_the_commanded_twist(robot: RobotConfig, twist: tuple[float, ...]) -> None:
    state = np.zeros(STATE_SIZE)
    drive(robot, state, inverse_kinematics(robot, twist), duration=3.0)
    np.testing.assert_allclose(state[TWIST], twist, atol=1e-6)


@pytest.mark.parametrize("robot", PRESETS)
@pytest.mark.parametrize("twist", [(0.3, -0.2, 0.5), (0.2, 0, 1.0), (0, 0.25, -0.8)])
def test_on_a_curve_only_the_creep_that_turns_the_path_is_missing(
    robot: RobotConfig, twist: tuple[float, float, float]
) -> None:
    state = np.zeros(STATE_SIZE)
    drive(robot, state, inverse_kinematics(robot, twist), duration=3.0)
    vx, vy, omega = twist
    # The centripetal force m ω × v comes from the rollers' creep s₀/(μN) and the wheels' droop against their
    # controllers, R²/2 (gain + friction), per newton along a roller; four rollers at 45° share it.
    compliance = robot.slip_speed_m_s / (0.6 * robot.mass_kg * G / 4.0)
    compliance += robot.wheel_radius_m**2 / (2.0 * (robot.motor_gain + robot.wheel_friction))
    missing = 0.5 * robot.mass_kg * omega * compliance * np.array([vy, -vx])
    np.testing.assert_allclose(state[TWIST][:2] - (vx, vy), missing, rtol=0.2, atol=2e-4)
    assert state[TWIST][2] == pytest.approx(omega, abs=1e-3)


@given(
    twist=st.tuples(speeds(2), speeds(2), speeds(4)),
    wheels=st.tuples(*[speeds(40)] * 4),
    lost=st.tuples(*[st.floats(0, 0.4)] * 4),
    dt=st.sampled_from([2e-4, 1e-3, 5e-3, 0.02]),
    mu=st.floats(0.05, 1.5),
)
def test_energy_never_grows_when_coasting(
    twist: tuple[float, ...], wheels: tuple[float, ...], lost: tuple[float, ...], dt: float, mu: float
) -> None:
    robot = RobotConfig()
    constants = dynamics_constants(robot)
    constants[6] = 0.0  # motors off
    state = np.zeros(STATE_SIZE)
    state[TWIST], state[WHEELS] = twist, wheels
    radii = robot.wheel_radius_m * (1.0 - np.array(lost))
    before = energy(robot, state)
    for _ in range(40):
        drive(robot, state, np.zeros(4), duration=dt, dt=dt, substeps=1, mu=mu, radii=radii, constants=constants)
        after = energy(robot, state)
        assert after <= before * (1 + 1e-12) + 1e-15
        before = after


def test_coasting_ends_at_rest() -> None:
    robot = RobotConfig()
    constants = dynamics_constants(robot)
    constants[6] = 0.0
    state = np.zeros(STATE_SIZE)
    state[TWIST] = 0.5, -0.3, 1.0
    drive(robot, state, np.zeros(4), duration=30.0, dt=0.1, substeps=100, constants=constants)
    assert energy(robot, state) < 1e-6


def reference_path(robot: RobotConfig, state: Array, targets: Array, duration: float, mu: float) -> Array:
    """Integrate docs/reference/robot.md with a stiff solver, in the world frame, from pose to wheel speeds."""
    corners = wheel_positions(robot)
    load = robot.mass_kg * G / 4.0

    def rates(_: float, y: Array) -> Array:
        theta, v, omega, wheels, reference = y[2], y[3:5], y[5], y[6:10], y[10:14]
        c, s = math.cos(theta), math.sin(theta)
        rotate = np.array([[c, -s], [s, c]])
        v_body = rotate.T @ v
        force, moment, wheel_rates = np.zeros(2), 0.0, np.zeros(4)
        for i in range(4):
            x, yy = corners[i]
            at_wheel = v_body + omega * np.array([-yy, x]) - np.array([robot.wheel_radius_m * wheels[i], 0.0])
            slip = ROLLERS[i] @ at_wheel / robot.slip_speed_m_s
            f = -mu * load * slip / math.sqrt(1.0 + slip**2)
            force += f * ROLLERS[i]
            moment += f * (x * ROLLERS[i, 1] - yy * ROLLERS[i, 0])
            torque = robot.motor_gain * (reference[i] - wheels[i]) + robot.wheel_friction * reference[i]
            torque = min(max(torque, -robot.motor_torque_nm), robot.motor_torque_nm)
            wheel_rates[i] = torque - robot.wheel_radius_m * f * ROLLERS[i, 0] - robot.wheel_friction * wheels[i]
        return np.concatenate(
            [
                v,
                [omega],
                rotate @ force / robot.mass_kg,
                [moment / robot.inertia_kg_m2],
                wheel_rates / robot.wheel_inertia_kg_m2,
                (targets - reference) / robot.motor_lag_s,
                wheels,
            ]
        )

    c, s = math.cos(state[2]), math.sin(state[2])
    start = state.copy()
    start[3:5] = c * state[3] - s * state[4], s * state[3] + c * state[4]
    end: Array = solve_ivp(rates, (0, duration), start, method="LSODA", rtol=1e-9, atol=1e-10, max_step=0.01).y[
        :, -1
    ]
    c, s = math.cos(end[2]), math.sin(end[2])
    end[3:5] = c * end[3] + s * end[4], c * end[4] - s * end[3]
    return end


@pytest.mark.parametrize("robot", PRESETS)
def test_converges_to_the_equations_of_motion_as_the_substep_shrinks(robot: RobotConfig) -> None:
    start = np.zeros(STATE_SIZE)
    start[POSE], start[TWIST] = (1.0, 2.0, 0.7), (0.2, -0.1, 0.5)
    start[WHEELS] = inverse_kinematics(robot, (0.2, -0.1, 0.5))
    start[REFERENCES] = start[WHEELS]
    targets = inverse_kinematics(robot, (-0.2, 0.3, -1.0))
    exact = reference_path(robot, start, targets, 0.4, mu=0.4)
    errors = []
    for substeps in (20, 40, 80, 160):
        state = start.copy()
        drive(robot, state, targets, duration=0.4, substeps=substeps, mu=0.4)
        scaled = np.abs(state - exact)
        scaled[WHEELS] *= robot.wheel_radius_m
        scaled[INCREMENTS] *= robot.wheel_radius_m
        scaled[REFERENCES] *= robot.wheel_radius_m
        errors.append(np.max(scaled))
    assert errors[0] < 7e-3  # m, m/s, rad at 1 ms
    ratios = np.array(errors[:-1]) / errors[1:]
    assert np.all(ratios > 1.8), errors


@pytest.mark.parametrize(
    ("changes", "bound"),
    [
        ({"motor_torque_nm": 20.0, "motor_gain": 20.0}, 0.002),  # m/s; 0.007 with the grip of the slip before
        ({"motor_torque_nm": 20.0, "wheel_radius_m": 0.1}, 0.008),  # 0.018
        ({"motor_torque_nm": 20.0, "motor_gain": 20.0, "wheel_radius_m": 0.1, "mass_kg": 100.0}, 0.03),  # 0.06
    ],
)
def test_motors_strong_for_their_wheels_leave_the_friction_law_as_it_is(
    changes: dict[str, float], bound: float
) -> None:
    """A substep's motors move the slip by several s₀; the body goes as it does with substeps of 20 µs."""
    robot = dataclasses.replace(RobotConfig(), **changes)
    rng, errors = np.random.default_rng(1), []
    for _ in range(8):
        coarse, fine = np.zeros(STATE_SIZE), np.zeros(STATE_SIZE)
        for action in rng.uniform(-1, 1, (4, 3)):
            targets = WheelTargets(robot).of_twist(action)
            for _ in range(4):
                drive(robot, coarse, targets, duration=0.1)
                drive(robot, fine, targets, duration=0.1, substeps=1000)
                errors.append((coarse - fine)[TWIST][:2])
    assert np.sqrt(np.mean(np.square(errors))) < bound


@pytest.mark.parametrize("robot", PRESETS)
@pytest.mark.parametrize(("axis", "share"), [((1, 0), 1 / math.sqrt(2)), ((0, 1), 1 / math.sqrt(2))])
@pytest.mark.parametrize("mu", [0.15, 0.6])
def test_friction_limits_acceleration_however_strong_the_motors(
    robot: RobotConfig, axis: tuple[int, int], share: float, mu: float
) -> None:
    strong = dataclasses.replace(robot, motor_torque_nm=1e6, motor_gain=1e3, motor_lag_s=0.0)
    state = np.zeros(STATE_SIZE)
    targets = inverse_kinematics(strong, (5.0 * axis[0], 5.0 * axis[1], 0.0))
    drive(strong, state, targets, duration=0.2, mu=mu)
    reached = math.hypot(state[3], state[4])
    # All four rollers at μN, each at 45° to the motion: μ g/√2, and never more than μ g.
    assert reached == pytest.approx(mu * G * share * 0.2, rel=0.01)
    assert reached <= mu * G * share * 0.2


def test_without_slip_wheels_and_body_accelerate_as_one_mass() -> None:
    robot = dataclasses.replace(RobotConfig(), motor_torque_nm=0.3, wheel_friction=0.0, motor_lag_s=0.0)
    state = np.zeros(STATE_SIZE)
    drive(robot, state, np.full(4, 1e3), duration=0.5)
    r = robot.wheel_radius_m
    acceleration = 4 * 0.3 / r / (robot.mass_kg + 4 * robot.wheel_inertia_kg_m2 / r**2)
    assert state[3] == pytest.approx(0.5 * acceleration, rel=0.01)
    np.testing.assert_allclose(state[WHEELS] * r, state[3], rtol=0.02)


def test_without_friction_the_body_flies_straight_while_it_turns() -> None:
    robot = RobotConfig()
    state = np.zeros(STATE_SIZE)
    state[POSE], state[TWIST] = (0, 0, 0.3), (1.0, 0.5, 2.0)
    drive(robot, state, np.zeros(4), duration=1.0, dt=0.1, substeps=100, mu=0.0)
    c, s = math.cos(0.3), math.sin(0.3)
    v_world = np.array([c * 1.0 - s * 0.5, s * 1.0 + c * 0.5])
    np.testing.assert_allclose(state[POSE], [*v_world, 2.3], atol=1e-5)
    c, s = math.cos(2.3), math.sin(2.3)
    np.testing.assert_allclose(
        state[TWIST][:2], [c * v_world[0] + s * v_world[1], c * v_world[1] - s * v_world[0]], atol=1e-9
    )


def test_increments_are_the_wheels_rotation() -> None:
    robot = RobotConfig()
    state = np.zeros(STATE_SIZE)
    targets = inverse_kinematics(robot, (0.4, 0.0, 0.0))
    drive(robot, state, targets, duration=2.0)
    before = state.copy()
    drive(robot, state, targets, duration=1.0)
    np.testing.assert_allclose(state[INCREMENTS] - before[INCREMENTS], targets, rtol=1e-6)
    np.testing.assert_allclose(state[0] - before[0], 0.4, rtol=1e-6)
