"""Walls as landmarks: extraction, Jacobians, the filters over them, and their extents."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares

import slam
from slam import LINE
from slam.features.extraction import FeatureConfig, FeatureExtractor
from slam.gaussian.joint_gaussian import add_landmark
from slam.gaussian.stacked_update import NO_LIMITS, stacked_update, work_space
from slam.geometry import compose, inverse, wrap
from slam.invariant import invariant_update
from slam.landmarks.association import line_blocks
from slam.motion import move
from tests.slam.numerics import numerical_jacobian, random_covariance
from tests.slam.simulated import circle_twist, drive, room_scan

OFFSET = 0.2
J = np.array([[0.0, -1.0], [1.0, 0.0]])
seeds = st.integers(0, 10_000)


def n_of(alpha: float) -> np.ndarray:
    return np.array([math.cos(alpha), math.sin(alpha)])


def predicted(v: np.ndarray, i: int = 0) -> np.ndarray:
    """Distance and bearing of line ``i`` of a state, from the geometry."""
    sensor = v[:2] + OFFSET * n_of(v[2])
    alpha, r = v[3 + 2 * i : 5 + 2 * i]
    return np.array([r - n_of(alpha) @ sensor, float(wrap(alpha - v[2]))])


def observation(rng: np.random.Generator, distance: float, bearing: float) -> np.ndarray:
    z = np.zeros(12)
    noise = 1e-3 * random_covariance(2, rng)
    z[:5] = distance, bearing, noise[0, 0], noise[0, 1], noise[1, 1]
    z[5], z[6], z[8], z[9], z[11] = LINE, bearing, -1.0, 1.0, 1e-12
    return z


@given(seeds)
def test_line_jacobian_against_finite_differences(seed: int) -> None:
    x = np.random.default_rng(seed).uniform(-3, 3, 5)
    h = np.zeros((2, 5))
    np.testing.assert_allclose(line_blocks(x, 0, OFFSET, h), predicted(x), atol=1e-12)
    np.testing.assert_allclose(h, numerical_jacobian(predicted, x, angle=1), atol=1e-5)


@given(seeds, st.integers(0, 3))
def test_adding_a_line_propagates_pose_and_noise(seed: int, landmarks: int) -> None:
    rng = np.random.default_rng(seed)
    n = 3 + 2 * landmarks
    x, p = rng.uniform(-3, 3, n), random_covariance(n, rng)
    z = observation(rng, rng.uniform(0.5, 6), rng.uniform(-3, 3))

    def place(v: np.ndarray) -> np.ndarray:
        """From pose and observation (distance, bearing) to α, r."""
        alpha = v[2] + v[4]
        return np.array([float(wrap(alpha)), v[3] + n_of(alpha) @ (v[:2] + OFFSET * n_of(v[2]))])

    jacobian = numerical_jacobian(place, np.concatenate([x[:3], z[:2]]), angle=0)
    g = np.zeros((2, n))
    g[:, :3] = jacobian[:, :3]
    want = np.zeros((n + 2, n + 2))
    want[:n, :n] = p
    want[:n, n:] = p @ g.T
    r = np.array([[z[2], z[3]], [z[3], z[4]]])
    want[n:, n:] = g @ p @ g.T + jacobian[:, 3:] @ r @ jacobian[:, 3:].T
    state, upper = np.zeros(n + 2), np.zeros((n + 2, n + 2))
    state[:n], upper[:n, :n] = x, np.triu(p)
    add_landmark(state, upper, n, z, OFFSET)
    np.testing.assert_allclose(predicted(state, landmarks), [z[0], float(wrap(z[1]))], atol=1e-9)
    np.testing.assert_allclose(np.triu(upper), np.triu(want), atol=1e-5)


@pytest.mark.parametrize("name", ["ekf", "ekf-lines", "invariant-ekf"])
def test_a_robot_that_drives_off_at_once_has_its_map_from_the_start_pose(name: str) -> None:
    """The wheels claim a turn that is none, before a landmark could be seen three times."""
    backend = slam.make(name, config={"odometry": {"turn_floor_rad_s": 0.5}, "lidar_offset_m": 0.0})
    start = np.array([2.5, 2.0, 0.3])
    rng = np.random.default_rng(4)
    backend.reset(pose=start, seed=0)
    backend.update(room_scan(start, rng))
    for _ in range(8):
        backend.predict(slam.Odometry(twist=(0.0, 0.0, 0.4), dt=0.1))
        backend.update(room_scan(start, rng))
    assert abs(float(wrap(backend.belief.pose[2] - start[2]))) < 0.01
    np.testing.assert_allclose(backend.belief.pose[:2], start[:2], atol=0.02)


def test_a_wall_s_covariance_is_the_noise_s() -> None:
    """Distance and bearing of the four walls over 400 noisy scans from one place, normalised."""
    rng = np.random.default_rng(1)
    pose = np.array([2.0, 1.7, 0.4])
    extractor = FeatureExtractor(FeatureConfig())
    floors = np.diag([extractor.config.wall_sigma_m**2, extractor.config.wall_sigma_rad**2])
    errors = []
    for _ in range(400):
        extractor.extract(room_scan(pose, rng))
        rows = extractor.with_walls()
        walls = rows[rows[:, 5] == LINE]
        for row in walls:
            side = [(6.0, 0.0), (5.0, math.pi / 2), (0.0, math.pi), (0.0, -math.pi / 2)]
            turned = float(wrap(row[1] + pose[2]))
            r, alpha = min(side, key=lambda s: abs(float(wrap(s[1] - turned))))
            e = np.array([row[0] - (r - n_of(alpha) @ pose[:2]), float(wrap(turned - alpha))])
            cov = np.array([[row[2], row[3]], [row[3], row[4]]]) - floors
            errors.append(e @ np.linalg.solve(cov, e))
    assert len(errors) > 4 * 390  # now and then noise makes one look curved, or cuts one in two
    assert np.mean(errors) / 2 == pytest.approx(1.0, abs=0.15)


def test_a_wall_s_end_keeps_what_the_wall_does_not_say() -> None:
    """The visible end of a wall: its covariance across the wall grows, and along it stays."""
    angles = -math.pi + 2 * math.pi / 360 * np.arange(360)
    x, half = 2.0, 1.5  # a wall at x = 2 from y = −1.5 to 1.5, nothing else
    with np.errstate(divide="ignore"):
        reach = np.where(np.cos(angles) > 1e-9, x / np.cos(angles), np.inf)
    ranges = np.where(np.abs(reach * np.sin(angles)) <= half, reach, np.inf)
    scan = slam.Scan(ranges, angle_min=-math.pi, angle_increment=2 * math.pi / 360, range_max=8.0)
    extractor = FeatureExtractor()
    ends = extractor.extract(scan).copy()
    rows = extractor.with_walls()
    assert len(ends) == 2 and len(rows) == 3
    for before, after in zip(ends, rows[1:], strict=True):
        to_polar = np.array([n_of(before[1]), J @ n_of(before[1]) / before[0]])
        cov = [
            np.linalg.inv(to_polar) @ np.array([[z[2], z[3]], [z[3], z[4]]]) @ np.linalg.inv(to_polar).T
            for z in (before, after)
        ]
        added = cov[1] - cov[0]
        np.testing.assert_allclose(added, [[0.02**2, 0.0], [0.0, 0.0]], atol=1e-6)  # the wall's normal is x


@pytest.mark.parametrize("name", ["ekf-lines", "invariant-ekf"])
def test_a_room_s_walls_are_mapped_and_hold_the_pose(name: str) -> None:
    rng = np.random.default_rng(7)
    backend = slam.make(name, config={"lines": True, "odometry": {"slip_share": 0.0}})
    start = pose = np.array([2.0, 2.0, 0.3])
    backend.reset()
    for k in range(80):
        backend.update(room_scan(compose(pose, np.array([OFFSET, 0, 0])), rng))
        pose, odometry = drive(pose, circle_twist(k), (0.01, 0.02), rng)
        backend.predict(odometry)
    belief = backend.belief
    # A corner becomes a landmark only where one of its walls is now and then too short to be a wall.
    points = len(belief.landmarks)
    assert len(belief.lines) == 4 and points <= 4
    assert belief.joint_cov is not None and belief.joint_cov.shape == (3 + 2 * points, 3 + 2 * points)
    assert belief.whole_cov is not None and belief.whole_cov.shape == (11 + 2 * points, 11 + 2 * points)
    np.testing.assert_array_equal(belief.whole_cov[: 3 + 2 * points, : 3 + 2 * points], belief.joint_cov)
    # The walls' own part: their variances, in the order of ``lines``, from the filter's state.
    wall_rows = 3 + 2 * np.flatnonzero(backend._book.marks[:, 0] == LINE)
    joint = backend.joint_cov
    np.testing.assert_array_equal(np.diag(belief.whole_cov)[3 + 2 * points :: 2], np.diag(joint)[wall_rows])
    np.testing.assert_array_equal(belief.whole_cov[0, 3 + 2 * points :: 2], joint[0, wall_rows])
    error = compose(inverse(start), pose) - belief.pose
    assert np.hypot(*error[:2]) < 0.02
    assert abs(float(wrap(error[2]))) < 0.01
    ends = np.vstack([belief.line_ends[:, :2], belief.line_ends[:, 2:]])
    world = ends @ np.array([[math.cos(0.3), math.sin(0.3)], [-math.sin(0.3), math.cos(0.3)]]) + start[:2]
    for corner in ([0, 0], [6, 0], [6, 5], [0, 5]):  # each wall reaches from corner to corner
        assert np.sort(np.hypot(*(world - corner).T))[1] < 0.15


def state_with_lines(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pose, a point, two lines; an observation of each."""
    rng = np.random.default_rng(seed)
    x = np.concatenate([rng.uniform(-3, 3, 3), rng.uniform(3, 6, 2), [0.4, 8.0], [-2.0, 9.0]])
    z = np.array([observation(rng, rng.uniform(3, 8), rng.uniform(-3, 3)) for _ in range(3)])
    z[0, 5] = 0.0
    marks = np.zeros((3, 8))
    marks[1:, 0] = LINE
    return x, 0.01 * random_covariance(9, rng), z, marks


def transform(x: np.ndarray, seen_from: np.ndarray) -> np.ndarray:
    """T(x) of the invariant filter with a point and two lines: invariant error coordinates to ordinary ones.

    Of a line the direction, and the distance from where the robot is, which was ``seen_from`` by the estimate.
    """
    out = np.eye(9)
    out[:2, 2], out[3:5, 2] = J @ x[:2], J @ x[3:5]
    for i in (5, 7):
        out[i + 1, :3] = n_of(x[i]) @ np.column_stack([np.eye(2), J @ seen_from])
        out[i + 1, i] = (J @ n_of(x[i])) @ seen_from
    return out


@given(seeds)
def test_invariant_update_of_lines_is_gain_retraction_and_reset(seed: int) -> None:
    x, p, z, marks = state_with_lines(seed)
    work = work_space(3, 9)
    plain_x, plain_p = x.copy(), np.triu(p)
    stacked_update(plain_x, plain_p, 9, z, np.arange(3), OFFSET, *work, NO_LIMITS)
    plain_p = np.triu(plain_p) + np.triu(plain_p, 1).T
    got_x, got_p = x.copy(), np.triu(p)
    invariant_update(got_x, got_p, 9, z, np.arange(3), OFFSET, marks, *work, np.zeros(9), NO_LIMITS)
    got_p = np.triu(got_p) + np.triu(got_p, 1).T
    np.testing.assert_allclose(wrap(got_x[5::2] - plain_x[5::2]), 0.0, atol=1e-12)
    delta = plain_x - x
    for i in (5, 7):
        about = (n_of(got_x[i]) - n_of(x[i])) @ (x[:2] + 0.5 * delta[:2])
        turned = about - (J @ n_of(x[i])) @ x[:2] * delta[i]
        assert got_x[i + 1] == pytest.approx(plain_x[i + 1] + turned, abs=1e-12)
    gamma = transform(got_x, x[:2]) @ np.linalg.inv(transform(x, x[:2]))
    # Coordinates are left as they were where that makes less than a tenth of a millimetre a radian.
    np.testing.assert_allclose(got_p, gamma @ plain_p @ gamma.T, atol=1e-4 * np.abs(plain_p).max())


@pytest.mark.parametrize("update", [stacked_update, invariant_update])
def test_an_update_beyond_its_limit_is_not_made(update) -> None:
    """Each piece of a wall may well be it, but not both: their offsets differ by more than either's noise."""
    x, p, z, marks = state_with_lines(0)
    z = np.vstack([z[1], z[1]])
    z[1, 0] += 0.3
    match, extra = np.ones(2, np.int64), [marks, *work_space(2, 9), np.zeros(9)]
    extra = extra if update is invariant_update else extra[1:4]
    got_x, got_p = x.copy(), p.copy()
    rows, nis = update(got_x, got_p, 9, z, match, OFFSET, *extra, np.array([0.0, 10.0, 28.0]))
    assert (rows, nis > 28.0) == (0, True)
    np.testing.assert_array_equal(got_x, x)
    np.testing.assert_array_equal(np.triu(got_p), np.triu(p))
    rows, same = update(got_x, got_p, 9, z, match, OFFSET, *extra, np.array([0.0, nis + 1e-9]))
    assert (rows, same) == (4, nis)
    assert not np.array_equal(got_x, x)


def test_a_ledge_beside_a_wall_does_not_turn_the_robot() -> None:
    """Two pieces, either of which the wall could be while the heading is unsure; one is a ledge's beside it."""
    backend = slam.make("invariant-ekf")
    backend.reset()
    wall = np.array([5.89, -2.0, 1e-6, 0.0, 1e-6, LINE, -2.0, 0.0, -5.4, 3.4, 0.0, 1e-8])
    backend._add(wall, None)
    backend._p[2, 2] = 0.0087**2
    # The ledge's line has its foot 4.5 m from its middle, where it lies 6.4 cm nearer.
    ledge = np.array([5.89 - 0.023, -2.0 + 0.009, 1.8e-3, 4.0e-4, 0.9e-4, LINE, -1.991, 0.0, 3.7, 5.3, 0.0, 1e9])
    backend._take(np.array([wall, ledge]), None)
    seen_twice = 2e8  # the refused match does not count
    assert backend._book.marks[0, 8] == pytest.approx(seen_twice, rel=1e-6)
    assert abs(backend.pose[2]) < 5e-4
    assert backend.nis_dof == 2


def test_a_correction_of_the_heading_alone_leaves_lines_unmoved() -> None:
    """What docs/reference/invariant.md warns of: otherwise a line drifts by −½ t² nᵀ p each time."""
    x = np.array([30.0, -20.0, 0.1, 5.0, 5.0, 0.3, 25.0])
    p = np.diag([1e-12, 1e-12, 0.04, 1e-12, 1e-12, 1e-12, 1e-12])
    marks = np.zeros((2, 8))
    marks[1, 0] = LINE
    z = np.zeros((1, 10))
    z[0, :7] = *predicted(x, 1), 1e-4, 0.0, 1e-6, LINE, 0.0
    z[0, 1] -= 0.3  # the line is seen turned: it is the heading that is wrong
    z[0, 2] = 1e6
    got, cov = x.copy(), p.copy()
    invariant_update(got, cov, 7, z, np.array([1]), OFFSET, marks, *work_space(1, 7), np.zeros(7), NO_LIMITS)
    assert got[2] == pytest.approx(0.4, abs=1e-3)
    np.testing.assert_allclose(got[5:], x[5:], atol=1e-9)
    np.testing.assert_allclose(got[:2], x[:2], atol=1e-9)


def test_a_wall_far_from_the_start_that_few_beams_meet_is_where_it_is() -> None:
    """Its piece is seen to 1 mm, its direction to 20 mrad; first by that alone, then by scan after scan."""
    ahead, turn_sigma, offset_sigma = 5.0, 0.02, 0.001
    marks = np.zeros((1, 8))
    marks[0, 0] = LINE
    errors, rng = [], np.random.default_rng(0)
    for _ in range(300):
        x, p = np.zeros(5), np.zeros((5, 5))
        x[0], p[:3, :3] = 60.0, 1e-14 * np.eye(3)
        for k in range(10):
            z = np.zeros((1, 12))
            turn, offset = rng.normal(0.0, turn_sigma), rng.normal(0.0, offset_sigma)
            along = -ahead * math.sin(turn)  # of the piece, from the foot of the line that is seen
            z[0, :2] = ahead * math.cos(turn) + offset, turn
            z[0, 2:5] = offset_sigma**2 + (along * turn_sigma) ** 2, along * turn_sigma**2, turn_sigma**2
            z[0, 5] = LINE
            if k == 0:
                add_landmark(x, p, 3, z[0], OFFSET)
            else:
                invariant_update(
                    x, p, 5, z, np.zeros(1, np.int64), OFFSET, marks, *work_space(1, 5), np.zeros(5), NO_LIMITS
                )
        piece = np.array([60.0 + OFFSET + ahead, 0.0])
        errors.append(x[4] - n_of(x[3]) @ piece)
    assert np.std(errors) < 1.5 * offset_sigma / math.sqrt(10)
    assert abs(np.mean(errors)) < 0.25e-3  # of a second order that is left, ½ d t² of the first scan


def test_a_wall_that_turns_with_the_robot_stays_where_it_is_to_it() -> None:
    """Heading and position are known together with it alone: it is mapped by them, then they are put right."""
    centre, turn = np.array([3.0, 40.0]), 0.03  # the heading was lost there

    def wall_from(x: np.ndarray) -> np.ndarray:
        return np.array([wrap(x[3] - x[2]), x[4] - n_of(x[3]) @ x[:2]])

    x = np.array([9.0, 60.0, 0.4, 1.1, 0.0])
    x[4] = 4.0 + n_of(x[3]) @ x[:2]
    jacobian = np.array([*(J @ (x[:2] - centre)), 1.0, 1.0, (J @ n_of(x[3])) @ centre])
    p = np.zeros((7, 7))
    p[:5, :5] = 0.01 * np.outer(jacobian, jacobian)
    # A known wall, through the centre, shows by how much it is turned.
    x, marks, z = np.append(x, [0.0, centre[0]]), np.zeros((2, 8)), np.zeros((1, 12))
    marks[:, 0] = LINE
    z[0, :6] = *predicted(x, 1), 1e2, 0.0, 1e-10, LINE
    z[0, 1] -= turn
    before = wall_from(x)
    invariant_update(
        x, np.triu(p), 7, z, np.ones(1, np.int64), OFFSET, marks, *work_space(1, 7), np.zeros(7), NO_LIMITS
    )
    assert x[2] == pytest.approx(0.4 + turn, abs=1e-5)
    np.testing.assert_allclose(wall_from(x), before, atol=0.05 * 40.0 * turn**2 / 2)


@pytest.mark.parametrize("name", ["ekf-lines", "invariant-ekf"])
def test_filters_over_walls_agree_with_batch_least_squares(name: str) -> None:
    """Three walls, twelve steps, little noise: the filter's last belief is the batch solution's."""
    rng = np.random.default_rng(9)
    walls = np.array([[0.2, 4.0], [1.8, 3.0], [-2.4, 5.0]])
    r = np.diag([1e-4, 4e-6])  # of distance and bearing
    backend = slam.make(name, config={"odometry": {"slip_share": 0.0}})
    start_cov = np.diag([1e-4, 1e-4, 1e-4])
    backend.reset(pose_cov=start_cov)
    pose, odometry, seen = np.zeros(3), [], []
    for k in range(12):
        twist = circle_twist(5 * k)
        var_v, var_w = backend.config.odometry.variances(*twist)
        pose, odo = drive(pose, twist, (math.sqrt(var_v), math.sqrt(var_w)), rng)
        z = np.zeros((3, 12))
        z[:, 11] = 1e-12  # they are straight
        for i in range(3):
            z[i, :2] = predicted(np.concatenate([pose, walls.ravel()]), i) + rng.multivariate_normal([0, 0], r)
            z[i, 2], z[i, 4], z[i, 5], z[i, 6], z[i, 8:10] = r[0, 0], r[1, 1], LINE, z[i, 1], (-1.0, 1.0)
        backend.predict(odo)
        backend._correct(z, np.arange(3) if k else np.full(3, -1))
        for row in z if k == 0 else ():
            backend._add(row, None)
        odometry.append(odo)
        seen.append(z)

    def residuals(v: np.ndarray) -> np.ndarray:
        poses, lines = v[:39].reshape(13, 3), v[39:]
        out = [poses[0] / np.sqrt(np.diag(start_cov))]
        for k in range(12):
            twist = np.array(odometry[k].twist)
            var_v, var_w = backend.config.odometry.variances(*twist)
            relative = inverse(move(np.zeros(3), twist, 0.1))
            error = compose(relative, compose(inverse(poses[k]), poses[k + 1]))
            out.append(error / (0.1 * np.sqrt([var_v, var_v, var_w])))
            for i in range(3):
                e = seen[k][i, :2] - predicted(np.concatenate([poses[k + 1], lines]), i)
                out.append(np.array([e[0], float(wrap(e[1]))]) / np.sqrt(np.diag(r)))
        return np.concatenate(out)

    guess = np.concatenate([np.zeros(39), walls.ravel()])
    solution = least_squares(residuals, guess, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    cov = np.linalg.inv(solution.jac.T @ solution.jac)
    sigma = np.sqrt(np.diag(cov))
    np.testing.assert_allclose((backend.pose - solution.x[36:39]) / sigma[36:39], 0, atol=0.06)
    np.testing.assert_allclose((backend.belief.lines.ravel() - solution.x[39:]) / sigma[39:], 0, atol=0.06)
    np.testing.assert_allclose(np.diag(backend.joint_cov)[3:], np.diag(cov)[39:], rtol=0.05)
    np.testing.assert_allclose(backend.pose_cov, cov[36:39, 36:39], rtol=0.05, atol=1e-7)
