"""The error that FastSLAM's particles inherit: against dense matrices, the joint filter, and the truth."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import slam
from slam.motion import jacobians
from slam.particles.filter import narrow
from slam.particles.inherited import InheritedError, beyond, common_descent
from slam.particles.maps import correct_landmark
from tests.slam.numerics import numerical_jacobian, random_covariance
from training.studies.circle_world import WORLDS, LandmarkWorld
from training.studies.circle_world import drive as drive_in_world

OFFSET = 0.2
Array = np.ndarray
seeds = st.integers(0, 10_000)


def sight(pose: Array, point: Array) -> Array:
    d = point - pose[:2] - OFFSET * np.array([math.cos(pose[2]), math.sin(pose[2])])
    return np.array([np.hypot(*d), math.atan2(d[1], d[0]) - pose[2]])


def seen(pose: Array, point: Array, rng: np.random.Generator) -> Array:
    """Return a landmark seen without an error, with the covariance of one that errs."""
    r = random_covariance(2, rng, 0.001)
    return np.concatenate([sight(pose, point), [r[0, 0], r[0, 1], r[1, 1], 0.0, 0.0, 0.0]])


def full(terms: Array) -> Array:
    return np.array([[terms[0], terms[1]], [terms[1], terms[2]]])


def random_book(rng: np.random.Generator, landmarks: int) -> tuple[InheritedError, Array, Array]:
    """Return a joint covariance full of correlations, the pose, and the landmarks."""
    pose, points = rng.uniform(-1, 1, 3), rng.uniform(2, 5, (landmarks, 2))
    error = InheritedError(random_covariance(3, rng))
    for point in points:
        error.add(pose, seen(pose, point, rng), OFFSET)
    error.motion[:] = random_covariance(3, rng, 0.003)
    return error, pose, points


@given(seeds)
def test_prediction_and_new_landmarks_are_the_joint_filter_s(seed: int) -> None:
    rng = np.random.default_rng(seed)
    error, pose, _ = random_book(rng, 3)
    before, motion = error.cov.copy(), error.motion.copy()
    twist, dt, v, w = rng.uniform(-1, 1, 3), 0.3, 0.02, 0.03
    error.predict(pose, twist, dt, v, w)
    fx, fu = jacobians(pose, twist, dt)
    big, noise = np.eye(9), fu @ np.diag([v, v, w]) @ fu.T
    big[:3, :3] = fx
    want = big @ before @ big.T
    want[:3, :3] += noise
    np.testing.assert_allclose(error.cov, want, atol=1e-12)
    np.testing.assert_allclose(error.motion, fx @ motion @ fx.T + noise, atol=1e-12)
    # A new one errs as h's inverse says, by finite differences.
    z = seen(pose, rng.uniform(2, 5, 2), rng)

    def where(x: Array) -> Array:
        a = x[2] + x[4]
        sensor = x[:2] + OFFSET * np.array([math.cos(x[2]), math.sin(x[2])])
        return np.array([*x[:2], x[2], *(sensor + x[3] * np.array([math.cos(a), math.sin(a)]))])

    jacobian = numerical_jacobian(where, np.concatenate([pose, z[:2]]))[3:]
    before = error.cov.copy()
    error.add(pose, z, OFFSET)
    cross = jacobian[:, :3] @ before[:3]
    own = jacobian[:, :3] @ before[:3, :3] @ jacobian[:, :3].T + jacobian[:, 3:] @ full(z[2:5]) @ jacobian[:, 3:].T
    np.testing.assert_allclose(error.cov[9:, :9], cross, atol=1e-7)
    np.testing.assert_allclose(error.cov[9:, 9:], own, atol=1e-7)


@given(seeds)
def test_correction_against_the_covariance_of_what_the_filter_really_does(seed: int) -> None:
    """The filter's own kernels are run from perturbed states: their Jacobian by errors and noises is A, B."""
    rng = np.random.default_rng(seed)
    error, pose, points = random_book(rng, 4)
    match = np.array([2, -1, 0, -2, 3])
    z = np.array([seen(pose, points[max(i, 0)], rng) for i in match])
    covs = np.array([random_covariance(2, rng, 0.004)[[0, 0, 1], [0, 1, 1]] for _ in points])
    motion, before = error.motion.copy(), error.cov.copy()

    def updated(x: Array) -> Array:
        """Return pose and landmarks after the update, from ones off by ``x[:11]`` and measurements by the rest."""
        at, rows = pose + x[:3], z.copy()
        records = np.column_stack([points + x[3:11].reshape(-1, 2), covs])
        rows[:, :2] += x[11:].reshape(-1, 2)
        narrow(at, np.triu(motion), records, np.arange(4), rows, match, OFFSET, 0.0)
        for row, i in zip(rows, match, strict=True):
            if i >= 0:
                correct_landmark(at, math.cos(at[2]), math.sin(at[2]), OFFSET, row, records[i].copy(), records[i])
        return np.concatenate([at, records[:, :2].ravel()])

    jacobian = numerical_jacobian(updated, np.zeros(21))
    a, b = jacobian[:, :11], jacobian[:, 11:]
    want = a @ before @ a.T
    for k, row in enumerate(z):
        want += b[:, 2 * k : 2 * k + 2] @ full(row[2:5]) @ b[:, 2 * k : 2 * k + 2].T
    error.correct(pose, points, covs, z, match, OFFSET, 0.0)
    np.testing.assert_allclose(error.cov, want, atol=2e-6)
    np.testing.assert_array_equal(error.cov, error.cov.T)
    assert not error.motion.any()


def test_equals_the_batch_answer_where_the_gains_are_the_best_ones() -> None:
    """Landmarks known independently of the pose, which only the motion makes uncertain: Kalman's own update."""
    rng = np.random.default_rng(3)
    pose, points, r = np.zeros(3), np.array([[2.0, 1.0], [1.0, -3.0]]), full(np.array([1e-3, 2e-4, 4e-4]))
    p, known = random_covariance(3, rng), random_covariance(2, rng, 0.002)
    error = InheritedError(np.zeros((3, 3)))
    terms = np.array([known[0, 0], known[0, 1], known[1, 1]])
    for _ in points:
        error.add(pose, np.array([1.0, 0.0, 0.0, 0.0, 0.0]), OFFSET)
    error.cov[3:5, 3:5] = error.cov[5:7, 5:7] = known
    error.widen(p)
    z = np.array([[*sight(pose, point), r[0, 0], r[0, 1], r[1, 1]] for point in points])
    information = np.linalg.inv(p)
    for point in points:
        h = numerical_jacobian(lambda x: sight(x[:3], x[3:]), np.concatenate([pose, point]))
        information += h[:, :3].T @ np.linalg.solve(h[:, 3:] @ known @ h[:, 3:].T + r, h[:, :3])
    error.correct(pose, points, np.tile(terms, (2, 1)), z, np.array([0, 1]), OFFSET, 0.0)
    np.testing.assert_allclose(error.cov[:3, :3], np.linalg.inv(information), rtol=1e-5)


def test_a_draw_stays_as_an_error_by_its_share() -> None:
    error = InheritedError(np.zeros((3, 3)))
    error.widen(cov := np.diag([0.04, 0.01, 0.02]))
    nothing = np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((1, 5)), np.array([-1])
    error.correct(np.zeros(3), *nothing, OFFSET, 0.25)
    np.testing.assert_allclose(error.cov, 1.25 * cov)
    error.correct(np.zeros(3), *nothing, OFFSET, 0.25)  # nothing has moved since
    np.testing.assert_allclose(error.cov, 1.25 * cov)


def test_landmarks_come_and_go() -> None:
    rng = np.random.default_rng(0)
    error, _, _ = random_book(rng, 60)  # more than there is room for at first
    before = error.cov.copy()
    error.drop(17)
    kept = np.delete(np.arange(123), [37, 38])
    np.testing.assert_array_equal(error.cov, before[np.ix_(kept, kept)])
    np.testing.assert_array_equal(error.of_landmarks()[58], before[-2:, -2:])
    assert np.linalg.eigvalsh(error.cov).min() > 0


@given(seeds)
def test_what_one_covariance_has_beyond_another(seed: int) -> None:
    rng = np.random.default_rng(seed)
    p, s = random_covariance(3, rng), random_covariance(3, rng)
    both, half, none = s.copy(), s.copy(), s.copy()
    for share, out in ((1.0, both), (0.5, half), (0.0, none)):
        beyond(p[None], out[None], share)
    for less in (p, s):
        assert np.linalg.eigvalsh(both - less).min() > -1e-12
    np.testing.assert_allclose(half, 0.5 * (both + s))
    np.testing.assert_allclose(none, s)
    smaller = p.copy()
    beyond(0.5 * p[None], smaller[None], 1.0)
    np.testing.assert_allclose(smaller, p)


def test_common_descent() -> None:
    assert common_descent(np.arange(8), np.full(8, 0.125)) == pytest.approx(1 / 8)
    assert common_descent(np.full(8, 3), np.full(8, 0.125)) == pytest.approx(1)
    assert common_descent(np.array([0, 0, 5]), np.array([0.25, 0.25, 0.5])) == pytest.approx(0.5)


# ---- against the truth -----------------------------------------------------------------------------------------


def mean_nees(name: str, world: LandmarkWorld, runs: range, steps: int, **settings: object) -> Array:
    """Return NEES/3 of every run, averaged over its steps."""
    nees = []
    for seed in runs:
        backend = slam.make(name, config={**world.backend_settings(), **settings})
        nees.append(
            np.mean([backend.pose_nees(s.true_pose) / 3 for s in drive_in_world(world, backend, seed, steps)])
        )
    return np.array(nees)


def test_of_a_single_particle_it_is_exact() -> None:
    """With one particle every draw stays: a linear filter with chance in it, whose covariance is known."""
    nees = mean_nees("fastslam2", WORLDS["circle"].scaled(0.5), range(60), 150, particles=1)
    assert np.mean(nees) == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize("name", ["fastslam1", "fastslam2"])
def test_true_within_a_factor_of_three_long_after_all_descend_from_one(name: str) -> None:
    nees = mean_nees(name, WORLDS["circle"], range(10), 400, particles=30)
    assert 1 / 3 < np.mean(nees) < 3


def test_grows_on_the_way_out_and_is_bounded_where_the_first_landmarks_are_seen_again() -> None:
    world = WORLDS["circle"]
    backend = slam.make("fastslam2", config={**world.backend_settings(), "particles": 20})
    area = [np.linalg.det(backend.pose_cov[:2, :2]) ** 0.25 for _ in drive_in_world(world, backend, 1, 450)]
    once_round = round(2 * math.pi * 6.0 / (world.speed_m_s * world.dt))
    out, back = area[once_round * 2 // 3], np.mean(area[once_round : once_round + 10])
    assert area[20] < 0.5 * out
    assert back < 0.5 * out
    again = np.mean(area[2 * once_round : 2 * once_round + 10])
    assert again < 1.5 * back


@pytest.mark.monte_carlo
@pytest.mark.parametrize("name", ["fastslam1", "fastslam2"])
@pytest.mark.parametrize("world", ["circle", "room"])
def test_true_within_a_factor_of_three_over_many_rounds(name: str, world: str) -> None:
    nees = mean_nees(name, WORLDS[world], range(20), 1200)
    assert 1 / 3 < np.mean(nees) < 3


@settings(max_examples=10)
@given(seeds)
def test_covariances_of_the_belief_are_covariances(seed: int) -> None:
    world = WORLDS["room"]
    backend = slam.make("fastslam2", config={**world.backend_settings(), "particles": 10})
    for _ in drive_in_world(world, backend, seed, 30):
        belief = backend.belief
        for cov in (belief.pose_cov, *belief.landmark_cov):
            np.testing.assert_allclose(cov, cov.T, atol=1e-15)
            assert np.linalg.eigvalsh(cov).min() > 0
