from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

import slam
from slam import Observations, Odometry
from slam.gaussian.joint_gaussian import add_landmark, leave_out, near_landmarks
from slam.gaussian.stacked_update import NO_LIMITS, stacked_update, work_space
from slam.geometry import compose, inverse, wrap
from slam.landmarks import association
from slam.landmarks.association import IGNORED, UNMATCHED, nearest_neighbour
from slam.metrics.chi_square import chi2_quantile
from slam.metrics.measures import nees_pose, nees_pose_invariant
from slam.motion import move
from tests.slam.numerics import numerical_jacobian, random_covariance
from tests.slam.simulated import circle_twist, drive, observe_landmarks, room_scan

OFFSET = 0.2
FILTERS = ("ekf", "ekf-lines", "invariant-ekf", "compressed-ekf")  # that keep a joint Gaussian
states = st.integers(0, 10_000)


def predicted(state: np.ndarray, i: int = 0) -> np.ndarray:
    """h of docs/reference/ekf.md, written down once more from the geometry."""
    x, y, theta = state[:3]
    d = state[3 + 2 * i : 5 + 2 * i] - np.array([x + OFFSET * math.cos(theta), y + OFFSET * math.sin(theta)])
    return np.array([np.hypot(*d), float(wrap(math.atan2(d[1], d[0]) - theta))])


def random_state(seed: int, landmarks: int) -> tuple[np.ndarray, np.ndarray, np.random.Generator]:
    rng = np.random.default_rng(seed)
    x = np.concatenate([rng.uniform(-3, 3, 3), rng.uniform(-6, 6, 2 * landmarks)])
    for i in range(landmarks):  # not on top of the sensor
        while predicted(x, i)[0] < 0.5:
            x[3 + 2 * i : 5 + 2 * i] = rng.uniform(-6, 6, 2)
    return x, random_covariance(len(x), rng), rng


@given(states)
def test_observation_jacobian_against_finite_differences(seed: int) -> None:
    x, _, _ = random_state(seed, 1)
    h = np.zeros((2, 5))
    z = association.predicted(x, 0, 0.0, OFFSET, h)
    np.testing.assert_allclose(z, predicted(x), atol=1e-12)
    np.testing.assert_allclose(h, numerical_jacobian(predicted, x, angle=1), atol=1e-5)


@given(states, st.integers(0, 5))
def test_adding_a_landmark_propagates_pose_and_noise(seed: int, landmarks: int) -> None:
    """Against the Jacobians of the inverse observation, by finite differences."""
    x, p, rng = random_state(seed, landmarks)
    n = len(x)
    z = np.zeros(8)
    z[:2] = rng.uniform(0.5, 6), rng.uniform(-3, 3)
    r = random_covariance(2, rng)
    z[2:5] = r[0, 0], r[0, 1], r[1, 1]

    def place(v: np.ndarray) -> np.ndarray:
        a, b = v[2] + v[4], OFFSET
        return np.array(
            [v[0] + b * math.cos(v[2]) + v[3] * math.cos(a), v[1] + b * math.sin(v[2]) + v[3] * math.sin(a)]
        )

    jacobian = numerical_jacobian(place, np.concatenate([x[:3], z[:2]]))
    gr, gz = jacobian[:, :3], jacobian[:, 3:]
    want = np.zeros((n + 2, n + 2))
    want[:n, :n] = p
    want[n:, :n] = gr @ p[:3]
    want[:n, n:] = want[n:, :n].T
    want[n:, n:] = gr @ p[:3, :3] @ gr.T + gz @ r @ gz.T
    state, cov = np.concatenate([x, [0, 0]]), np.zeros((n + 2, n + 2))
    cov[:n, :n] = np.triu(p)
    add_landmark(state, cov, n, z, OFFSET)
    np.testing.assert_allclose(state[n:], place(np.concatenate([x[:3], z[:2]])))
    np.testing.assert_allclose(np.triu(cov), np.triu(want), atol=1e-8)


@settings(max_examples=60)
@given(states, st.integers(0, 7), st.integers(7, 40))
def test_stacked_update_is_the_textbook_one(seed: int, seen: int, landmarks: int) -> None:
    x, p, rng = random_state(seed, landmarks)
    n = len(x)
    which = rng.permutation(landmarks)[:seen]
    z = np.zeros((seen + 1, 8))
    match = np.full(seen + 1, UNMATCHED)
    h, r, nu = np.zeros((2 * seen, n)), np.zeros((2 * seen, 2 * seen)), np.zeros(2 * seen)
    for k, i in enumerate(which):
        noise = random_covariance(2, rng)
        z[k, :2] = predicted(x, i) + rng.multivariate_normal([0, 0], noise)
        z[k, 2:5] = noise[0, 0], noise[0, 1], noise[1, 1]
        match[k] = i
        block = np.zeros((2, 5))
        association.predicted(x, int(i), 0.0, OFFSET, block)
        h[2 * k : 2 * k + 2, :3] = block[:, :3]
        h[2 * k : 2 * k + 2, 3 + 2 * i : 5 + 2 * i] = block[:, 3:]
        r[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = noise
        nu[2 * k : 2 * k + 2] = z[k, :2] - predicted(x, i)
        nu[2 * k + 1] = wrap(nu[2 * k + 1])
    s = h @ p @ h.T + r
    gain = p @ h.T @ np.linalg.inv(s)
    want_x, want_p = x + gain @ nu, p - gain @ s @ gain.T
    state, upper = x.copy(), np.triu(p)
    dof, nis = stacked_update(state, upper, n, z, match, OFFSET, *work_space(8, n), NO_LIMITS)
    assert dof == 2 * seen
    assert nis == pytest.approx(nu @ np.linalg.solve(s, nu), rel=1e-8)
    np.testing.assert_allclose(np.triu(upper), np.triu(want_p), atol=1e-10)
    difference = state - want_x
    difference[2] = wrap(difference[2])
    np.testing.assert_allclose(difference, 0, atol=1e-10)
    np.testing.assert_array_less(-1e-12, np.linalg.eigvalsh(want_p))


def test_nearest_neighbour_takes_the_right_one_once_and_leaves_new_ones() -> None:
    x = np.array([0.0, 0.0, 0.0, 2.0, 1.0, 2.0, 1.6, 4.0, -1.0])
    p = np.triu(np.eye(9) * 1e-4)
    marks = np.zeros((3, 8))
    marks[:, :2] = [1.0, 0.0], [1.0, 0.0], [-1.0, 0.5]
    marks[1, 6] = -1.0  # the right end of a surface

    def row(px: float, py: float, kind: float, direction: float = 0.0, end: float = 0.0) -> list[float]:
        d = np.array([px - OFFSET, py])
        return [float(np.hypot(*d)), math.atan2(d[1], d[0]), 1e-4, 0.0, 1e-5, kind, direction, end]

    z = np.array([
        row(2.005, 1.0, 1.0),  # landmark 0
        row(2.0, 1.61, 1.0, end=-1.0),  # landmark 1
        row(2.01, 1.0, 1.0),  # landmark 0 too, but farther: gives way
        row(4.0, -1.0, 1.0),  # on landmark 2, but of another kind: new
        row(4.0, -1.0, -1.0, 0.5 + math.pi),  # … or facing the other way: new
        row(2.0, 1.15, 1.0),  # too far to be landmark 0, too near to be new
        row(5.0, 3.0, 1.0),
        row(2.0, 1.0, 1.0, end=1.0),  # on landmark 0, but the end of a surface, not where two meet: new
    ])  # fmt: skip
    match, distance = np.zeros(len(z), np.int64), np.zeros(len(z))
    nearest_neighbour(x, p, OFFSET, z, marks, chi2_quantile(0.997, 2), 0.2, 0.6, False, match, distance)
    assert match.tolist() == [0, 1, IGNORED, UNMATCHED, UNMATCHED, IGNORED, UNMATCHED, UNMATCHED]
    assert distance[0] < distance[2]


@pytest.mark.parametrize("name", FILTERS)
def test_filters_agree_with_batch_least_squares_on_a_small_world(name: str) -> None:
    """Three landmarks, twelve steps, little noise: the filter's last belief is the batch solution's."""
    rng = np.random.default_rng(5)
    landmarks = np.array([[3.0, 1.0], [1.5, -2.0], [-2.0, 2.5]])
    r = np.diag([1e-4, 1e-5])
    backend = slam.make(name, config={"lidar_offset_m": OFFSET, "odometry": {"slip_share": 0.0}})
    start_cov = np.diag([1e-4, 1e-4, 1e-4])
    backend.reset((0, 0, 0), pose_cov=start_cov)
    noise = backend.config.odometry
    pose, odometry, seen = np.zeros(3), [], []
    for k in range(12):
        twist = circle_twist(5 * k)
        var_v, var_w = noise.variances(*twist)
        pose, odo = drive(pose, twist, (math.sqrt(var_v), math.sqrt(var_w)), rng)
        obs = observe_landmarks(pose, landmarks, OFFSET, r, rng)
        backend.predict(odo)
        backend.observe(obs)
        odometry.append(odo)
        seen.append(obs)

    def residuals(v: np.ndarray) -> np.ndarray:
        poses, points = v[: 3 * 13].reshape(13, 3), v[39:].reshape(3, 2)
        out = [poses[0] / np.sqrt(np.diag(start_cov))]
        for k in range(12):
            twist = np.array(odometry[k].twist)
            var_v, var_w = noise.variances(*twist)
            relative = inverse(move(np.zeros(3), twist, 0.1))
            error = compose(relative, compose(inverse(poses[k]), poses[k + 1]))
            out.append(error / (0.1 * np.sqrt([var_v, var_v, var_w])))
            for i in range(3):
                e = seen[k].range_bearing[i] - predicted(np.concatenate([poses[k + 1], points[i]]))
                out.append(np.array([e[0], float(wrap(e[1]))]) / np.sqrt(np.diag(r)))
        return np.concatenate(out)

    guess = np.concatenate([np.zeros(39), landmarks.ravel() + 0.01])
    solution = least_squares(residuals, guess, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    cov = np.linalg.inv(solution.jac.T @ solution.jac)
    belief = backend.belief
    sigma = np.sqrt(np.diag(cov))
    # The filter linearises once, the batch at the solution: they agree to a small part of a sigma.
    np.testing.assert_allclose((belief.pose - solution.x[36:39]) / sigma[36:39], 0, atol=0.06)
    np.testing.assert_allclose((belief.landmarks.ravel() - solution.x[39:]) / sigma[39:], 0, atol=0.06)
    np.testing.assert_allclose(belief.pose_cov, cov[36:39, 36:39], rtol=0.05, atol=1e-7)
    assert belief.joint_cov is not None
    np.testing.assert_allclose(np.diag(belief.joint_cov)[3:], np.diag(cov)[39:], rtol=0.05)


def test_pose_nees_is_consistent_where_the_heading_is_known_well() -> None:
    """30 runs among known landmarks with the filter's own noise: average NEES within its 99.9 % band."""
    rng = np.random.default_rng(11)
    landmarks = np.array([[3.0, 3.0], [-3.0, 3.0], [-3.0, -3.0], [3.0, -3.0], [0.0, 4.0]])
    r = np.diag([4e-4, 4e-5])
    values = []
    for _ in range(30):
        backend = slam.make("ekf", config={"lidar_offset_m": OFFSET, "odometry": {"slip_share": 0.0}})
        backend.reset()
        pose = np.zeros(3)
        for k in range(60):
            twist = circle_twist(k)
            var_v, var_w = backend.config.odometry.variances(*twist)
            pose, odo = drive(pose, twist, (math.sqrt(var_v), math.sqrt(var_w)), rng)
            backend.predict(odo)
            backend.observe(observe_landmarks(pose, landmarks, OFFSET, r, rng))
        values.append(nees_pose(backend.pose, backend.pose_cov, pose))
    low, high = chi2_quantile(0.0005, 90) / 90, chi2_quantile(0.9995, 90) / 90
    assert low < np.mean(values) / 3 < high


def test_scans_of_a_room_give_its_corners_and_keep_the_pose() -> None:
    rng = np.random.default_rng(3)
    backend = slam.make("ekf")
    start = np.array([2.0, 2.0, 0.3])
    backend.reset()
    pose = start
    for k in range(150):
        backend.update(room_scan(compose(pose, np.array([OFFSET, 0, 0])), rng))
        pose, odo = drive(pose, circle_twist(k), (0.01, 0.02), rng)
        backend.predict(odo)
    belief = backend.belief
    assert len(belief.landmarks) == 4
    assert belief.landmark_kinds.tolist() == [slam.CONCAVE] * 4
    corners = np.array([[0, 0], [6, 0], [6, 5], [0, 5]])
    mapped = (
        belief.landmarks @ np.array([[math.cos(0.3), math.sin(0.3)], [-math.sin(0.3), math.cos(0.3)]]) + start[:2]
    )
    for corner in mapped:
        assert np.min(np.hypot(*(corners - corner).T)) < 0.04
    error = compose(inverse(start), pose) - belief.pose
    assert np.hypot(*error[:2]) < 0.04
    assert abs(float(wrap(error[2]))) < 0.02


def test_spinning_wheels_do_not_lose_the_filter() -> None:
    """For two seconds the wheels drive on and turn while the robot stands against something."""
    rng = np.random.default_rng(8)
    backend = slam.make("ekf")
    start = np.array([2.0, 2.0, 0.3])
    backend.reset()
    pose = start
    for k in range(120):
        backend.update(room_scan(compose(pose, np.array([OFFSET, 0, 0])), rng))
        if 50 <= k < 70:
            backend.predict(Odometry((0.7, 0.3, 0.8), 0.1))
        else:
            pose, odo = drive(pose, circle_twist(k), (0.01, 0.02), rng)
            backend.predict(odo)
    error = compose(inverse(start), pose) - backend.pose
    assert np.hypot(*error[:2]) < 0.05
    assert abs(float(wrap(error[2]))) < 0.03
    assert backend.landmark_count == 4


def test_a_hard_start_adds_to_the_noise_and_a_gentle_one_does_not() -> None:
    noise = slam.config_type("ekf")().odometry
    assert noise.slip((0.0, 0.0, 0.0), (0.1, 0.0, 0.0), 0.1) == ((0.0, 0.0), (0.1, 0.0, 0.0))
    slip, body = noise.slip((0.0, 0.0, 0.0), (0.8, 0.0, 0.0), 0.1)
    may = 0.65 * noise.slip_share
    assert slip == pytest.approx((may, may / noise.lever_m))
    assert body == pytest.approx((0.15, 0.0, 0.0))
    slip, body = noise.slip(body, (0.0, 0.0, 0.0), 0.1)  # the wheels stand, and the body slides by what is left
    assert (slip, body) == ((0.0, 0.0), pytest.approx((0.0, 0.0, 0.0)))
    rough = dataclasses.replace(noise, slide_m_s2=4.0)
    slip, body = rough.slip((0.0, 0.0, 0.0), (0.8, 0.0, 0.0), 0.1)
    assert (slip[0], body) == (pytest.approx(may), pytest.approx((0.4, 0.0, 0.0)))
    calm, hard = noise.variances(0.5, 0.0, 0.0), noise.variances(0.5, 0.0, 0.0, slip=(0.5, 0.4))
    assert hard[0] - calm[0] == pytest.approx(0.5**2)
    along = 0.25 * 0.5 / noise.lever_m  # turns the body, too
    assert hard[1] - calm[1] == pytest.approx(0.4**2 + along**2)


def test_innovations_are_taken_once_and_all_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, taken = np.random.default_rng(0), []
    landmarks = rng.uniform(-20, 20, (100, 2))
    backend = slam.make("ekf")
    monkeypatch.setattr(backend.recovery.monitor, "take_innovations", lambda nis, dof: taken.append((nis, dof)))
    for _ in range(2):
        backend.observe(observe_landmarks(backend.pose, landmarks, OFFSET, np.diag([1e-4, 1e-5]), rng))
    backend.observe(Observations(np.zeros((0, 2)), np.zeros((0, 2, 2))))
    assert [dof for _, dof in taken] == [0, 200, 0]
    assert taken[1][0] / 200 == pytest.approx(1.0, abs=0.5)


@pytest.mark.parametrize("name", [n for n in slam.names() if slam.make(n).observes_landmarks])
def test_every_backend_takes_observations_grows_and_starts_over(name: str) -> None:
    rng = np.random.default_rng(0)
    landmarks = rng.uniform(-20, 20, (150, 2))
    backend = slam.make(name)
    backend.reset((1.0, 2.0, 0.5))
    backend.predict(Odometry((0.1, 0.0, 0.0), 0.1))
    backend.observe(observe_landmarks(backend.pose, landmarks, OFFSET, np.diag([1e-4, 1e-5]), rng))
    belief = backend.belief
    assert belief.landmarks.shape == (150, 2)
    assert belief.landmark_cov.shape == (150, 2, 2)
    assert sorted(belief.landmark_ids.tolist()) == list(range(150))
    assert np.max(np.abs(belief.landmarks - landmarks[belief.landmark_ids])) < 0.3
    before = belief.landmarks.copy()
    backend.observe(observe_landmarks(backend.pose, landmarks, OFFSET, np.diag([1e-4, 1e-5]), rng))
    np.testing.assert_array_equal(belief.landmarks, before)  # a belief is a copy
    backend.reset()
    assert backend.landmark_count == 0
    assert backend.grid.known_cells == 0
    with pytest.raises(ValueError, match="finite"):
        backend.observe(Observations(np.array([[np.nan, 0.0]]), np.eye(2)[None]))
    with pytest.raises(ValueError, match="three finite numbers"):
        backend.reset((0, 0, math.nan))


def test_landmarks_can_be_dropped_without_disturbing_the_rest() -> None:
    rng = np.random.default_rng(1)
    landmarks = rng.uniform(-5, 5, (6, 2))
    backend = slam.make("ekf")
    backend.reset()
    for _ in range(5):
        backend.observe(observe_landmarks(backend.pose, landmarks, OFFSET, np.diag([1e-4, 1e-5]), rng))
    before = backend.belief
    assert before.joint_cov is not None
    backend._drop(2)
    after = backend.belief
    keep = [0, 1, 3, 4, 5]
    np.testing.assert_array_equal(after.landmark_ids, before.landmark_ids[keep])
    np.testing.assert_array_equal(after.landmarks, before.landmarks[keep])
    index = np.concatenate([[0, 1, 2], *[[3 + 2 * i, 4 + 2 * i] for i in keep]])
    np.testing.assert_array_equal(after.joint_cov, before.joint_cov[np.ix_(index, index)])
    backend.observe(observe_landmarks(backend.pose, landmarks, OFFSET, np.diag([1e-4, 1e-5]), rng))
    assert sorted(backend.belief.landmark_ids.tolist()) == list(range(6))


def test_near_landmarks_are_sorted_and_in_the_robot_frame() -> None:
    x, p, _ = random_state(4, 40)
    out = np.empty((32, 6), np.float32)
    near_landmarks(x, np.triu(p), np.zeros((40, 8)), out)
    points = x[3:].reshape(-1, 2) - x[:2]
    order = np.argsort(np.hypot(*points.T))[:32]
    c, s = math.cos(x[2]), math.sin(x[2])
    turn = np.array([[c, s], [-s, c]])
    np.testing.assert_allclose(out[:, :2], points[order] @ turn.T, atol=1e-5)
    i = order[3]
    cov = turn @ p[3 + 2 * i : 5 + 2 * i, 3 + 2 * i : 5 + 2 * i] @ turn.T
    np.testing.assert_allclose(out[3, 2:5], [cov[0, 0], cov[0, 1], cov[1, 1]], atol=1e-6)
    assert out[:, 5].tolist() == [1.0] * 32
    near_landmarks(x[:9], np.triu(p)[:9, :9].copy(), np.zeros((3, 8)), out)
    assert out[:, 5].sum() == 3
    assert not out[3:].any()


def test_unknown_names_and_keys_are_listed() -> None:
    with pytest.raises(
        ValueError,
        match=r"unknown SLAM backend 'ekff' \(did you mean 'ekf'\?\); valid: compressed-ekf, dp-slam, ekf",
    ):
        slam.make("ekff")
    with pytest.raises(ValueError, match=r"unknown key of EkfConfig 'gates'.*valid: .*gate"):
        slam.make("ekf", config={"gates": 1.0})


@given(states, st.integers(1, 6))
def test_leaving_a_landmark_out_takes_its_rows_and_columns(seed: int, landmarks: int) -> None:
    x, p, rng = random_state(seed, landmarks)
    n, i = len(x), 3 + 2 * int(rng.integers(landmarks))
    keep = np.r_[0:i, i + 2 : n]
    left_x, left_p = x.copy(), np.triu(p)
    leave_out(left_x, left_p, n, i)
    np.testing.assert_array_equal(left_x[: n - 2], x[keep])
    np.testing.assert_array_equal(np.triu(left_p[: n - 2, : n - 2]), np.triu(p[np.ix_(keep, keep)]))


@pytest.mark.parametrize(
    ("name", "nees"), [("ekf", nees_pose), ("odometry", nees_pose_invariant), ("truth", nees_pose_invariant)]
)
def test_the_pose_nees_is_that_of_pose_and_covariance(name: str, nees: Callable[..., float]) -> None:
    backend = slam.make(name)
    for k in range(5):
        backend.predict(Odometry((0.3, 0.1, 0.2), 0.1))
        backend.update(room_scan(np.array([2.0 + 0.03 * k, 2.0, 0.02 * k])))
    true = backend.pose + np.array([1e-3, -2e-3, 1e-3])
    assert backend.pose_nees(true) == nees(backend.pose, backend.pose_cov, true)


def test_a_backend_of_ones_own_is_registered_once_under_its_name(monkeypatch):
    from slam import registry
    from slam.ekf import EkfSlam
    from slam.gaussian.settings import EkfConfig, EkfLinesConfig

    monkeypatch.setattr(registry, "_BACKENDS", dict(registry._BACKENDS))
    slam.register("mine", EkfSlam, EkfConfig)
    slam.register("mine", EkfSlam, EkfConfig)  # the same again is no quarrel
    assert "mine" in slam.names() and isinstance(slam.make("mine"), EkfSlam)
    with pytest.raises(ValueError, match="'ekf' is registered already"):
        slam.register("ekf", EkfSlam, EkfLinesConfig)
