"""The wheels' lasting errors as states: against one dense filter of everything, and whether they are found."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import slam
from mecanum_env.config import RobotConfig
from mecanum_env.physics.robot import forward_matrix
from slam import Observations, Odometry
from slam.ekf import EkfSlam
from slam.gaussian.joint_gaussian import add_landmark, landmark_by_pose
from slam.gaussian.stacked_update import NO_LIMITS, stacked_update, work_space
from slam.gaussian.wheel_errors import WheelErrors
from slam.geometry import wrap
from slam.invariant import _turn_columns, invariant_update
from slam.metrics.measures import nees_band
from slam.motion import LastingErrors, OdometryNoise, jacobians, move
from slam.settings import from_mapping
from slam.types import LINE
from tests.slam.numerics import numerical_jacobian, random_covariance
from tests.slam.simulated import room_scan
from tests.slam.test_invariant import coordinates
from tests.slam.test_lines import state_with_lines, transform

ROBOT = RobotConfig()
NOISE = OdometryNoise(
    lever_m=ROBOT.lever_m,
    lasting=LastingErrors(
        radius_sigma=0.02, lever_sigma=0.03, white_speed_share=0.005, white_turn_share_rad_m=0.01
    ),
)
OFFSET = 0.2
R = np.diag([0.02**2, 0.01**2])


def backend(noise: OdometryNoise = NOISE, name: str = "invariant-ekf") -> EkfSlam:
    return slam.make(name, config={"odometry": noise, "lidar_offset_m": OFFSET})


def drives(rng: np.random.Generator, steps: int) -> np.ndarray:
    """Twists ``(steps, 3)`` that change every second, in all directions."""
    some = rng.uniform((-0.5, -0.5, -1.0), (0.5, 0.5, 1.0), (steps // 10 + 1, 3))
    return np.repeat(some, 10, axis=0)[:steps]


def rolled(twist: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """The twist of a robot whose wheels claim ``twist``, radii and lever being off by ``errors`` ``(5,)``."""
    forward = forward_matrix(ROBOT)  # (3, 4)
    true = forward @ (np.linalg.pinv(forward) @ twist * (1.0 + errors[:4]))
    true[2] += errors[4] * twist[2]
    return true


def seen(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Range and bearing of points, from the sensor."""
    d = points - pose[:2] - OFFSET * np.array([math.cos(pose[2]), math.sin(pose[2])])
    return np.column_stack([np.hypot(*d.T), wrap(np.arctan2(d[:, 1], d[:, 0]) - pose[2])])


def test_twist_by_errors_is_that_of_the_wheels() -> None:
    wheels = WheelErrors(LastingErrors(radius_sigma=0.01, lever_sigma=0.01), ROBOT.lever_m, 4, 8)
    twist = np.array([0.4, -0.2, 0.7])
    base = np.array(wheels.corrected(tuple(twist)))
    np.testing.assert_allclose(base, twist)
    columns = []
    for k in range(5):
        wheels.mean[:] = np.eye(5)[k]
        columns.append(np.array(wheels.corrected(tuple(twist))) - twist)
    # Which wheel is which does not matter: each combination of directions is on one.
    want = [rolled(twist, e) - twist for e in np.eye(5)]
    found = np.array(sorted(np.round(columns[:4], 12).tolist()))
    np.testing.assert_allclose(found, np.array(sorted(np.round(want[:4], 12).tolist())), atol=1e-9)
    np.testing.assert_allclose(columns[4], want[4], atol=1e-12)


def test_equals_one_dense_filter_of_everything() -> None:
    """State: pose, landmarks, errors. Jacobians by differences, the reset as in docs/reference/invariant.md."""
    rng = np.random.default_rng(4)
    points = np.array([[2.0, 1.0], [-1.5, 2.0], [0.5, -2.5], [3.0, -1.0]])
    filter_ = backend()
    filter_.reset((0.3, -0.2, 0.4), pose_cov=np.diag([0.01, 0.02, 0.005]))
    x, e = np.array([0.3, -0.2, 0.4]), np.zeros(5)
    p = np.zeros((8, 8))  # pose, errors, then landmarks
    p[:3, :3] = np.diag([0.01, 0.02, 0.005])
    p[3:, 3:] = filter_.wheel_errors[1]
    white = NOISE.white()
    truth = x + np.array([0.05, -0.05, 0.03])
    wheels = WheelErrors(NOISE.lasting, NOISE.lever_m, 4, 8)

    def claimed(twist: np.ndarray, errors: np.ndarray) -> np.ndarray:
        wheels.mean[:] = errors
        return np.array(wheels.corrected(tuple(twist)))

    known, body = np.zeros((0, 2)), (0.0, 0.0, 0.0)
    for twist in drives(rng, 30):
        truth = move(truth, claimed(twist, np.array([0.02, -0.01, 0.03, 0.0, -0.02])), 0.1)
        filter_.predict(Odometry(twist, 0.1))
        u = claimed(twist, e)
        slip, body = white.slip(body, tuple(u), 0.1)
        v, w = white.variances(*u, slip=slip)
        fx, fu = jacobians(x, u, 0.1)
        f = np.eye(len(p))
        f[:3, :3], f[:3, 3:8] = (
            fx,
            numerical_jacobian(lambda a, x=x, twist=twist: move(x, claimed(twist, a), 0.1), e),
        )
        x = move(x, u, 0.1)
        p = f @ p @ f.T
        p[:3, :3] += fu @ np.diag([v, v, w]) @ fu.T
        z = seen(truth, points) + rng.normal(0, [0.02, 0.01], (4, 2))
        filter_.observe(Observations(z, np.tile(R, (4, 1, 1)), np.arange(4)))
        if len(known) == 0:
            for row in z:  # appended as the filter appends them, one by one

                def placed(pose: np.ndarray, row: np.ndarray = row) -> np.ndarray:
                    c, s = math.cos(pose[2]), math.sin(pose[2])
                    b = pose[2] + row[1]
                    return pose[:2] + OFFSET * np.array([c, s]) + row[0] * np.array([math.cos(b), math.sin(b)])

                g = np.hstack([numerical_jacobian(placed, x), np.zeros((2, len(p) - 3))])
                b = x[2] + row[1]
                gz = np.array([[math.cos(b), -row[0] * math.sin(b)], [math.sin(b), row[0] * math.cos(b)]])
                p = np.block([[p, p @ g.T], [g @ p, g @ p @ g.T + gz @ R @ gz.T]])
                known = np.vstack([known, placed(x)])
            continue
        state = np.concatenate([x, e, known.ravel()])
        h = numerical_jacobian(lambda a: seen(a[:3], a[8:].reshape(-1, 2)).ravel(), state)
        s = h @ p @ h.T + np.kron(np.eye(4), R)
        nu = (z - seen(x, known)).ravel()
        nu[1::2] = wrap(nu[1::2])
        gain = np.linalg.solve(s, h @ p).T
        delta, p = gain @ nu, p - gain @ s @ gain.T
        map_x = np.concatenate([x, known.ravel()])
        map_delta = np.delete(delta, np.s_[3:8])
        t = coordinates(map_x)
        xi = np.linalg.solve(t, map_delta)  # the invariant error; then along the exponential
        turned, after = float(xi[2]), map_x.copy()
        c, sn = math.cos(turned), math.sin(turned)
        rotation = np.array([[c, -sn], [sn, c]])
        v_of = np.array([[sn, -(1 - c)], [1 - c, sn]]) / turned
        for i in (0, *range(3, len(map_x), 2)):
            after[i : i + 2] = rotation @ map_x[i : i + 2] + v_of @ xi[i : i + 2]
        after[2] = wrap(map_x[2] + turned)
        reset = np.eye(len(p))
        rows = np.r_[0:3, 8 : len(p)]
        reset[np.ix_(rows, rows)] = coordinates(after) @ np.linalg.inv(t)
        p = reset @ p @ reset.T
        x, known, e = after[:3], after[3:].reshape(-1, 2), e + delta[3:8]
    np.testing.assert_allclose(filter_.pose, x, atol=1e-8)
    np.testing.assert_allclose(filter_.wheel_errors[0], e, atol=1e-8)
    np.testing.assert_allclose(filter_.wheel_errors[1], p[3:8, 3:8], atol=1e-9)
    rows = np.r_[0:3, 8 : len(p)]
    np.testing.assert_allclose(filter_.joint_cov, p[np.ix_(rows, rows)], atol=1e-8)
    np.testing.assert_allclose(filter_._beside.cross[:5, : len(rows)], p[3:8][:, rows], atol=1e-8)
    assert np.sqrt(np.diag(p)[3:8]).max() < 0.02  # and something was learnt


@pytest.mark.parametrize(
    ("name", "runs"), [("ekf", 30), ("ekf-lines", 30), ("compressed-ekf", 30), ("invariant-ekf", 120)]
)
def test_errors_are_found_and_their_covariance_is_right(name: str, runs: int) -> None:
    nees, learnt = [], []
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        errors = rng.normal(0, [0.02] * 4 + [0.03])
        points = rng.uniform(-6, 6, (12, 2))
        filter_ = backend(name=name)
        filter_.reset((0.0, 0.0, 0.0))
        wheels = WheelErrors(NOISE.lasting, NOISE.lever_m, 4, 8)
        wheels.mean[:] = errors
        truth, white = np.zeros(3), NOISE.white()
        for twist in drives(rng, 200):
            true = np.array(wheels.corrected(tuple(twist)))
            v, w = white.variances(*true)
            truth = move(truth, true + rng.normal(0, np.sqrt([v, v, w])), 0.1)
            filter_.predict(Odometry(twist, 0.1))
            z = seen(truth, points) + rng.normal(0, [0.02, 0.01], (12, 2))
            filter_.observe(Observations(z, np.tile(R, (12, 1, 1)), np.arange(12)))
        mean, cov = filter_.wheel_errors
        nees.append((mean - errors) @ np.linalg.solve(cov, mean - errors) / 5)
        learnt.append(np.sqrt(np.diag(cov)))
    assert np.mean(learnt, axis=0).max() < 0.008
    assert np.mean(nees) == pytest.approx(1.0, abs=3 * math.sqrt(2 / 5 / runs))


def test_dead_reckoning_is_as_sure_as_errors_that_last_let_it() -> None:
    """Over half a minute: the band is that of an exactly consistent filter."""
    nees, rng = [], np.random.default_rng(0)
    for _ in range(120):
        robot = slam.make("odometry", config={"odometry": NOISE})
        robot.reset((3.0, 2.0, 0.3))
        wheels, truth, white = WheelErrors(NOISE.lasting, NOISE.lever_m, 4, 8), robot.pose, NOISE.white()
        wheels.mean[:] = rng.normal(0, [0.02] * 4 + [0.03])
        for twist in drives(rng, 300):
            true = np.array(wheels.corrected(tuple(twist)))
            v, w = white.variances(*true)
            truth = move(truth, true + rng.normal(0, np.sqrt([v, v, w])), 0.1)
            robot.predict(Odometry(twist, 0.1, (0.0, 0.0)))  # nothing slipped
        nees.append(robot.pose_nees(truth))
    low, high = nees_band(3, 120, confidence=0.99)
    assert low < np.mean(nees) / 3 < high


def test_what_a_scan_shows_corrects_no_wheels_of_dead_reckoning() -> None:
    robot = slam.make("odometry", config={"odometry": NOISE, "lidar_offset_m": OFFSET})
    alone = slam.make("odometry", config={"odometry": NOISE, "lidar_offset_m": OFFSET})
    for filter_ in (robot, alone):
        filter_.reset((2.0, 2.0, 0.3))
    for k in range(20):
        for filter_ in (robot, alone):
            filter_.predict(Odometry((0.3, 0.1, 0.2), 0.1))
        robot.update(room_scan(np.array([2.0 + 0.02 * k, 2.0, 0.3 + 0.02 * k])))
    assert robot.landmark_count > 0
    np.testing.assert_array_equal(robot.pose, alone.pose)
    np.testing.assert_allclose(robot.pose_cov, alone.pose_cov, rtol=1e-12)
    np.testing.assert_array_equal(robot.wheel_errors[0], np.zeros(5))


def test_update_and_reset_with_walls_are_those_of_one_large_state() -> None:
    """The errors as landmarks that nobody sees: the standard update, then the reset of pose and map alone."""
    for seed in range(20):
        x, _, z, marks = state_with_lines(seed)
        joint = 0.01 * random_covariance(15, np.random.default_rng(seed))  # a sixth error, left out below
        plain_x, plain_p = np.concatenate([x, np.zeros(6)]), np.triu(joint)
        stacked_update(plain_x, plain_p, 15, z, np.arange(3), OFFSET, *work_space(3, 15), NO_LIMITS)
        plain_p = np.triu(plain_p) + np.triu(plain_p, 1).T
        wheels = WheelErrors(LastingErrors(), 0.4, 3, 9)
        wheels.cov[:], wheels.cross[:, :9] = joint[9:14, 9:14], joint[9:14, :9]
        got, p = x.copy(), np.triu(joint[:9, :9])
        h, w, s = work_space(3, 9)
        levers = np.zeros(9)
        rows, _ = invariant_update(got, p, 9, z, np.arange(3), OFFSET, marks, h, w, s, levers, NO_LIMITS)
        wheels.correct(9, np.arange(3), h, w, s, rows, reset=True)
        _turn_columns(wheels.cross, 9, levers)
        gamma = transform(got, x[:2]) @ np.linalg.inv(transform(x, x[:2]))
        np.testing.assert_allclose(wheels.mean, plain_x[9:14], atol=1e-12)
        np.testing.assert_allclose(wheels.cov, plain_p[9:14, 9:14], atol=1e-12)
        np.testing.assert_allclose(wheels.cross[:, :9], plain_p[9:14, :9] @ gamma.T, atol=1e-9)


@pytest.mark.parametrize("kind", [0.0, LINE])
def test_a_landmark_s_jacobian_by_the_pose(kind: float) -> None:
    z = np.array([3.0, 0.7, 1e-4, 0.0, 1e-4, kind, 0.0, 0.0, 0.0, 0.0])

    def placed(pose: np.ndarray) -> np.ndarray:
        x = np.concatenate([pose, np.zeros(2)])
        add_landmark(x, np.zeros((5, 5)), 3, z, OFFSET)
        return x[3:]

    pose = np.array([1.0, -2.0, 0.5])
    want = numerical_jacobian(placed, pose)
    np.testing.assert_allclose(landmark_by_pose(pose, z, OFFSET), want, atol=1e-8)


def in_a_room(steps: int) -> tuple[EkfSlam, slam.Scan]:
    """A filter that has driven about a room and has learnt something, and its last scan."""
    filter_, rng = backend(), np.random.default_rng(1)
    truth = np.array([2.0, 2.0, 0.3])
    filter_.reset(truth)
    for twist in drives(rng, steps):
        truth = move(truth, twist, 0.1)
        filter_.predict(Odometry(1.01 * twist, 0.1))
        sensor = truth + OFFSET * np.array([math.cos(truth[2]), math.sin(truth[2]), 0.0])
        scan = room_scan(sensor, rng)
        filter_.update(scan)
    return filter_, scan


def test_a_trial_leaves_no_trace() -> None:
    filter_, scan = in_a_room(30)
    filter_.extractor.extract(scan)
    z = filter_.extractor.with_walls()
    match = filter_._associate(z).copy()
    assert np.count_nonzero(match >= 0) >= 2 and np.abs(filter_.wheel_errors[0]).max() > 1e-4
    before = filter_._beside.snapshot()
    filter_._fit(z, match, scan)
    for kept, now in zip(before, filter_._beside.snapshot(), strict=True):
        np.testing.assert_array_equal(kept, now)


def test_landmarks_come_and_go_with_their_correlations() -> None:
    filter_, _ = in_a_room(30)
    rng = np.random.default_rng(3)
    many = np.column_stack([rng.uniform(2, 6, 40), rng.uniform(-3, 3, 40)])
    filter_.observe(
        Observations(many, np.tile(R, (40, 1, 1)), np.arange(1000, 1040))
    )  # more than there was room for
    n, pose_rows = filter_._n, filter_._beside.cross[:, :3].copy()
    theta = float(filter_.pose[2])
    last = many[-1, 1] + theta
    rx, ry = np.array([math.cos(theta), math.sin(theta)]) * OFFSET + many[-1, 0] * np.array(
        [math.cos(last), math.sin(last)]
    )
    gr = np.array([[1.0, 0.0, -ry], [0.0, 1.0, rx]])
    np.testing.assert_allclose(filter_._beside.cross[:, n - 2 : n], pose_rows @ gr.T, atol=1e-12)
    before = filter_._beside.cross[:, :n].copy()
    assert np.all(np.any(before != 0.0, axis=0))
    filter_._drop(5)
    np.testing.assert_array_equal(filter_._beside.cross[:, : n - 2], np.delete(before, [13, 14], axis=1))


def test_wheels_of_two_sides_that_differ_bend_a_straight_way_and_do_nothing_else() -> None:
    """Going straight, ω = v δ / l: no other component is in doubt, and the bend is found."""
    lever, delta, sigma = 0.13, 0.02, 0.03
    wheels = WheelErrors(LastingErrors(difference_sigma=sigma), lever, 1, 3)
    wheels.corrected((0.4, 0.0, 0.0))
    np.testing.assert_allclose(
        wheels._b @ wheels.cov @ wheels._b.T, np.diag([0.0, 0.0, (0.4 * sigma / lever) ** 2]), atol=1e-15
    )
    noise = OdometryNoise(lever_m=lever, lasting=LastingErrors(difference_sigma=sigma))
    robot, rng = backend(noise), np.random.default_rng(1)
    robot.reset(np.zeros(3))
    pose, points, claimed = np.zeros(3), rng.uniform(-4.0, 4.0, (10, 2)), np.array([0.4, 0.0, 0.0])
    for _ in range(100):
        pose = move(pose, claimed + np.array([0.0, 0.0, 0.4 * delta / lever]), 0.1)
        robot.predict(Odometry(claimed, 0.1))
        robot.observe(Observations(seen(pose, points), np.tile(R, (10, 1, 1)), np.arange(10)))
    assert robot.wheel_errors is not None
    mean, cov = robot.wheel_errors
    found = mean[:4] @ np.array([-1.0, 1.0, -1.0, 1.0]) / 4.0
    assert found == pytest.approx(delta, abs=0.005) and math.sqrt(cov[1, 1]) < 0.2 * sigma


def test_errors_that_cannot_be_are_no_states() -> None:
    """Of no size they change nothing, and no more do they where the states are switched off."""
    share = {"white_speed_share": NOISE.speed_share, "white_turn_share_rad_m": NOISE.turn_share_rad_m}
    none = backend(replace(NOISE, lasting=None))
    zero = backend(replace(NOISE, lasting=LastingErrors(**share)))
    off = slam.make("invariant-ekf", config={"odometry": NOISE, "wheel_states": False, "lidar_offset_m": OFFSET})
    assert none.wheel_errors is None and off.wheel_errors is None
    rng = np.random.default_rng(0)
    points = rng.uniform(-4, 4, (6, 2))
    for filter_ in (none, zero, off):
        filter_.reset((0.0, 0.0, 0.0))
        rng = np.random.default_rng(0)
        for twist in drives(rng, 40):
            filter_.predict(Odometry(twist, 0.1))
            z = seen(filter_.pose, points) + rng.normal(0, [0.02, 0.01], (6, 2))
            filter_.observe(Observations(z, np.tile(R, (6, 1, 1)), np.arange(6)))
    for other in (zero, off):
        np.testing.assert_allclose(other.pose, none.pose, atol=1e-12)
        np.testing.assert_allclose(other.joint_cov, none.joint_cov, atol=1e-12)


@pytest.mark.parametrize("field", ["radius_sigma", "lever_sigma", "white_speed_share", "white_turn_share_rad_m"])
def test_shares_below_zero_are_refused(field: str) -> None:
    with pytest.raises(ValueError, match=f"config.odometry.lasting.{field} must be"):
        slam.make("invariant-ekf", config={"odometry": {"lasting": {field: -0.1}}})


def test_shares_that_are_not_given_are_the_whole_of_v() -> None:
    noise = OdometryNoise(speed_share=0.02, lasting=LastingErrors(radius_sigma=0.01)).white()
    assert (noise.speed_share, noise.turn_share_rad_m, noise.lasting) == (0.02, 0.03, None)


def test_none_given_in_a_mapping_is_none() -> None:
    made = slam.make("invariant-ekf", config={"odometry": {"lasting": None}})
    assert made.config.odometry.lasting is None
    over = from_mapping(OdometryNoise, {"lasting": None}, base=NOISE)
    assert over.lasting is None and over.lever_m == NOISE.lever_m
