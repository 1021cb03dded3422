from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings

import slam
from slam import Observations, Odometry
from slam.fastslam import FastSlam, FastSlam1, FastSlam2, FastSlamConfig
from slam.geometry import compose, inverse, wrap
from slam.motion import OdometryNoise, jacobians, move
from slam.particles.maps import ParticleMaps, correct_landmark
from slam.particles.resampling import ResamplingPolicy
from slam.settings import from_mapping
from tests.slam.particles.sights import OFFSET, random_sight, seeds
from tests.slam.simulated import circle_twist, drive, observe_landmarks, room_scan

BOTH = pytest.mark.parametrize("kind", [FastSlam1, FastSlam2])
WITHOUT_SLIP = OdometryNoise(slip_share=0.0)
NOISE = np.diag([1e-4, 1e-5])


def make(kind: Callable[..., FastSlam], **settings: object) -> FastSlam:
    return kind(FastSlamConfig(odometry=WITHOUT_SLIP, **settings))  # type: ignore[arg-type]


# ---- shared landmarks ------------------------------------------------------------------------------------------


def check_references(maps: ParticleMaps) -> None:
    """Every record is referred to as often as it says, or free, once."""
    counted = np.bincount(maps.table[:, : maps.count].ravel(), minlength=len(maps.records))
    np.testing.assert_array_equal(maps.references, counted)
    free = maps.free[: maps.free_count[0]]
    np.testing.assert_array_equal(np.sort(free), np.flatnonzero(counted == 0))


@settings(max_examples=15)
@given(seeds)
def test_shared_maps_are_what_deep_copies_would_be(seed: int) -> None:
    """A random run of additions, updates, resamplings and removals, against particles with maps of their own."""
    rng = np.random.default_rng(seed)
    config = {"particles": int(rng.integers(1, 7)), "lidar_offset_m": OFFSET}
    backend = make(FastSlam1, **config)
    n = backend.config.particles
    alone: list[list[np.ndarray]] = [[] for _ in range(n)]
    maps = backend._maps
    for _ in range(30):
        backend._poses = rng.normal(0, 0.3, (n, 3))
        what = rng.choice(["add", "observe", "observe", "observe", "resample", "drop"])
        _, _, _, z, _ = random_sight(int(rng.integers(10_000)))
        if what == "add":
            maps.add(backend._poses, z, OFFSET)
            backend._inherited.add(backend._poses[0], z, OFFSET)
            for i in range(n):
                single = ParticleMaps(1)
                single.add(backend._poses[i : i + 1], z, OFFSET)
                alone[i].append(single.of(0)[0])
        elif what == "observe" and maps.count:
            match = rng.integers(-2, maps.count, (n, 3))
            rows = np.array([random_sight(int(rng.integers(10_000)))[3] for _ in range(3)])
            backend._correct(rows, match)
            for i in range(n):
                c, s = math.cos(backend._poses[i, 2]), math.sin(backend._poses[i, 2])
                for k in range(3):
                    if match[i, k] >= 0:
                        record = alone[i][match[i, k]]
                        correct_landmark(backend._poses[i], c, s, OFFSET, rows[k], record.copy(), record)
        elif what == "resample":
            survivors = rng.integers(0, n, n)
            ancestors = np.where(np.isin(np.arange(n), survivors), np.arange(n), survivors)
            maps.resample(ancestors)
            alone = [[record.copy() for record in alone[a]] for a in ancestors]
        elif what == "drop" and maps.count:
            row = int(rng.integers(maps.count))
            maps.drop(row)
            backend._inherited.drop(row)
            for landmarks in alone:
                del landmarks[row]
        check_references(maps)
        for i in range(n):
            np.testing.assert_array_equal(maps.of(i), np.reshape(alone[i], (-1, 5)))
            xy = maps.of(i)[:, :2]
            extents = maps.extents[: maps.count]
            assert np.all((extents[:, 0::2] <= xy) & (xy <= extents[:, 1::2]))


@BOTH
def test_copies_of_one_particle_do_not_write_to_one_landmark(kind: type[FastSlam]) -> None:
    """All particles descend from one and see its landmarks again: each must update its own estimate, once.

    With maps that are copied by reference the estimates of all particles end up as one, updated many times.
    """
    n = 8
    rng = np.random.default_rng(4)
    landmarks = np.array([[2.0, 1.0], [1.5, -1.0], [-1.0, 2.0]])
    backend = make(kind, particles=n, resampling=ResamplingPolicy(when="every_k", every=1000))
    backend.reset()
    backend.observe(observe_landmarks(np.zeros(3), landmarks, OFFSET, NOISE, rng))
    backend._weights[:] = np.eye(n)[3]
    backend.config = from_mapping(FastSlamConfig, {"resampling": {"when": "every_step"}}, base=backend.config)
    backend._resample(1)
    assert backend.resampled
    assert backend.ancestors == 1
    assert np.count_nonzero(backend._maps.references) == 3  # nothing was copied
    before = backend._maps.of(3)
    for i in range(n):
        np.testing.assert_array_equal(backend._maps.of(i), before)
    backend.config = from_mapping(FastSlamConfig, {"resampling": {"when": "every_k"}}, base=backend.config)
    backend.predict(Odometry((0.5, 0.1, 0.2), 0.1))
    seen = observe_landmarks(move(np.zeros(3), np.array([0.5, 0.1, 0.2]), 0.1), landmarks[:2], OFFSET, NOISE, rng)
    backend.observe(seen)
    assert len(np.unique(backend._poses, axis=0)) == n
    z = np.column_stack([seen.range_bearing, np.tile([1e-4, 0.0, 1e-5], (2, 1))])
    for i in range(n):
        pose, own = backend._poses[i], before.copy()
        for k in range(2):
            correct_landmark(pose, math.cos(pose[2]), math.sin(pose[2]), OFFSET, z[k], before[k], own[k])
        np.testing.assert_array_equal(backend._maps.of(i), own)
    assert np.count_nonzero(backend._maps.references) == 2 * n + 1  # … and what nobody saw is still shared
    check_references(backend._maps)


# ---- the filter ------------------------------------------------------------------------------------------------


@BOTH
def test_prediction_spreads_as_the_motion_model_says(kind: type[FastSlam]) -> None:
    backend = make(kind, particles=4000)
    pose, cov = np.array([1.0, 2.0, 3.0]), np.diag([4e-4, 1e-4, 1e-3])
    backend.reset(pose, pose_cov=cov, seed=2)
    for k in range(8):
        twist = circle_twist(10 * k)
        var_v, var_w = WITHOUT_SLIP.variances(*twist)
        fx, fu = jacobians(pose, twist, 0.1)
        cov = fx @ cov @ fx.T + fu @ np.diag([var_v, var_v, var_w]) @ fu.T
        pose = move(pose, twist, 0.1)
        backend.predict(Odometry(twist, 0.1))
    error = backend.pose - pose
    error[2] = wrap(error[2])
    np.testing.assert_allclose(error / np.sqrt(np.diag(cov)), 0, atol=0.06)
    scale = np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
    np.testing.assert_allclose(backend.pose_cov / scale, cov / scale, atol=0.06)


@BOTH
def test_agrees_with_the_joint_filter_on_a_small_world(kind: type[FastSlam]) -> None:
    """Three landmarks, twelve steps, where test_ekf shows the EKF to be the batch least-squares solution."""
    rng = np.random.default_rng(5)
    landmarks = np.array([[3.0, 1.0], [1.5, -2.0], [-2.0, 2.5]])
    ekf = slam.make("ekf", config={"lidar_offset_m": OFFSET, "odometry": {"slip_share": 0.0}})
    backend = make(kind, particles=3000, lidar_offset_m=OFFSET)
    for b in (ekf, backend):
        b.reset((0, 0, 0), pose_cov=np.diag([1e-4, 1e-4, 1e-4]), seed=1)
    pose = np.zeros(3)
    for k in range(12):
        twist = circle_twist(5 * k)
        var_v, var_w = WITHOUT_SLIP.variances(*twist)
        pose, odometry = drive(pose, twist, (math.sqrt(var_v), math.sqrt(var_w)), rng)
        seen = observe_landmarks(pose, landmarks, OFFSET, NOISE, rng)
        for b in (ekf, backend):
            b.predict(odometry)
            b.observe(seen)
    want, got = ekf.belief, backend.belief
    sigma = np.sqrt(np.diag(want.pose_cov))
    np.testing.assert_allclose((got.pose - want.pose) / sigma, 0, atol=0.25)
    np.testing.assert_allclose(np.sqrt(np.diag(got.pose_cov)) / sigma, 1, atol=0.2)
    order = np.argsort(got.landmark_ids)
    variances = np.diagonal(want.landmark_cov, axis1=1, axis2=2)
    error = got.landmarks[order] - want.landmarks[np.argsort(want.landmark_ids)]
    np.testing.assert_allclose(error / np.sqrt(variances), 0, atol=0.25)
    ratio = np.diagonal(got.landmark_cov, axis1=1, axis2=2)[order] / variances
    np.testing.assert_allclose(np.sqrt(ratio), 1, atol=0.2)
    assert got.joint_cov is None


def test_knowing_what_is_seen_keeps_the_weights_more_even() -> None:
    rng = np.random.default_rng(6)
    landmarks = rng.uniform(-4, 4, (6, 2))
    mean = {}
    for kind in (FastSlam1, FastSlam2):
        backend, pose, values = make(kind), np.zeros(3), []
        backend.reset()
        for k in range(40):
            backend.observe(observe_landmarks(pose, landmarks, OFFSET, NOISE, rng))
            values.append(backend.n_eff)
            pose, odometry = drive(pose, circle_twist(k), (0.01, 0.02), rng)
            backend.predict(odometry)
        mean[kind] = np.mean(values)
    assert mean[FastSlam2] > 1.3 * mean[FastSlam1]


def test_one_particle_that_knows_what_is_seen_follows_the_truth() -> None:
    rng = np.random.default_rng(7)
    landmarks = rng.uniform(-4, 4, (8, 2))
    backend, pose, r = make(FastSlam2, particles=1), np.zeros(3), np.diag([1e-8, 1e-9])
    backend.reset()
    for k in range(200):
        backend.observe(observe_landmarks(pose, landmarks, OFFSET, r, rng))
        pose, odometry = drive(pose, circle_twist(k), (0.01, 0.02), rng)
        backend.predict(odometry)
    backend.observe(observe_landmarks(pose, landmarks, OFFSET, r, rng))
    np.testing.assert_allclose(backend.pose, pose, atol=1e-3)
    np.testing.assert_allclose(backend.belief.landmarks, landmarks[backend.belief.landmark_ids], atol=1e-3)
    assert np.all(np.linalg.eigvalsh(backend.pose_cov) > 0)


@BOTH
@pytest.mark.parametrize("when", ["every_step", "every_k", "n_eff"])
def test_policies_resample_when_they_say_and_ancestors_die_out(kind: type[FastSlam], when: str) -> None:
    rng = np.random.default_rng(8)
    landmarks = rng.uniform(-4, 4, (5, 2))
    backend = make(kind, particles=20, resampling=ResamplingPolicy(when=when, every=4))
    backend.reset()
    assert backend.ancestors == 20
    pose, resampled, n_eff = np.zeros(3), [], []
    for k in range(40):
        backend.observe(observe_landmarks(pose, landmarks, OFFSET, NOISE, rng))
        resampled.append(backend.resampled)
        n_eff.append(backend.n_eff)
        pose, odometry = drive(pose, circle_twist(k), (0.01, 0.02), rng)
        backend.predict(odometry)
    want = {
        "every_step": [True] * 40,
        "every_k": [k % 4 == 3 for k in range(40)],
        "n_eff": [value < 10 for value in n_eff],
    }[when]
    assert resampled == want
    assert any(resampled)
    assert backend.ancestors < 20
    check_references(backend._maps)


@BOTH
def test_the_same_seed_gives_the_same_belief_and_reset_starts_over(kind: type[FastSlam]) -> None:
    landmarks = np.random.default_rng(9).uniform(-4, 4, (70, 2))

    def run(backend: FastSlam, seed: int) -> slam.Belief:
        rng = np.random.default_rng(9)
        backend.reset((0.5, 0.2, -3.0), pose_cov=np.eye(3) * 1e-4, seed=seed)
        assert backend.landmark_count == 0
        pose = np.array([0.5, 0.2, -3.0])
        for k in range(20):
            backend.observe(observe_landmarks(pose, landmarks, OFFSET, NOISE, rng, reach=3.0))
            pose, odometry = drive(pose, circle_twist(k), (0.01, 0.02), rng)
            backend.predict(odometry)
        return backend.belief

    used = make(kind, particles=30)
    first, again, other = run(used, 1), run(used, 1), run(make(kind, particles=30), 2)
    fresh = run(make(kind, particles=30), 1)
    for name in ("pose", "pose_cov", "landmarks", "landmark_cov", "landmark_ids"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
        np.testing.assert_array_equal(getattr(first, name), getattr(fresh, name))
    assert not np.array_equal(first.pose, other.pose)
    assert np.hypot(*(first.pose - other.pose)[:2]) < 0.05


@BOTH
def test_impossible_observations_leave_finite_beliefs(kind: type[FastSlam]) -> None:
    rng = np.random.default_rng(10)
    backend = make(kind, particles=10)
    backend.reset()
    seen = observe_landmarks(np.zeros(3), np.array([[2.0, 1.0], [1.0, -2.0]]), OFFSET, np.eye(2) * 1e-6, rng)
    backend.observe(seen)
    far_off = Observations(seen.range_bearing[::-1] * 40.0, np.repeat(np.eye(2)[None] * 1e-12, 2, 0), seen.ids)
    for _ in range(3):
        backend.predict(Odometry((0.0, 0.0, 0.0), 0.1))
        backend.observe(far_off)
        backend.observe(Observations(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, np.int64)))
    belief = backend.belief
    for values in (belief.pose, belief.pose_cov, belief.landmarks, belief.landmark_cov, backend._weights):
        assert np.all(np.isfinite(values))
    assert backend._weights.sum() == pytest.approx(1)
    with pytest.raises(ValueError, match="finite"):
        backend.observe(Observations(np.array([[np.nan, 0.0]]), np.eye(2)[None]))


@BOTH
def test_landmarks_without_known_ids_are_confirmed_and_told_apart(kind: type[FastSlam]) -> None:
    rng = np.random.default_rng(11)
    landmarks = np.array([[2.0, 1.0], [1.0, -2.0], [-3.0, 0.5], [0.5, 3.0]])
    backend, pose = make(kind), np.zeros(3)
    backend.reset()
    counts = []
    for k in range(60):
        seen = observe_landmarks(pose, landmarks, OFFSET, NOISE, rng)
        backend.observe(Observations(seen.range_bearing, seen.cov))
        counts.append(backend.landmark_count)
        pose, odometry = drive(pose, circle_twist(k), (0.01, 0.02), rng)
        backend.predict(odometry)
    assert counts[:2] == [0, 4]
    assert counts[-1] == 4
    np.testing.assert_allclose(backend.belief.landmarks, landmarks, atol=0.05)
    times, directions = backend.landmark_details()
    assert np.all((times > 52) & (times <= 59))  # the gate lets most of them through
    assert np.all(np.isnan(directions))


@BOTH
def test_dropped_landmarks_leave_the_rest_and_their_ids(kind: type[FastSlam]) -> None:
    rng = np.random.default_rng(12)
    landmarks = rng.uniform(-5, 5, (40, 2))
    backend = make(kind, particles=15)
    backend.reset()
    for _ in range(3):
        backend.observe(observe_landmarks(backend.pose, landmarks, OFFSET, NOISE, rng))
    before = backend.belief
    out = np.empty((32, 6), np.float32)
    backend.near_landmarks(out)
    order = np.argsort(np.hypot(*(before.landmarks - before.pose[:2]).T))[:32]
    np.testing.assert_allclose(out[:, :2], before.landmarks[order], atol=1e-2)  # at the start, heading 0
    np.testing.assert_allclose(out[:, 2], before.landmark_cov[order, 0, 0], rtol=0.1, atol=1e-6)
    assert out[:, 5].tolist() == [1.0] * 32
    backend._maps.drop(2)
    backend._inherited.drop(2)
    backend._book.drop(2)
    backend._believe()
    keep = [i for i in range(40) if i != 2]
    np.testing.assert_array_equal(backend.belief.landmark_ids, before.landmark_ids[keep])
    np.testing.assert_array_equal(backend.belief.landmarks, before.landmarks[keep])
    check_references(backend._maps)
    backend.observe(observe_landmarks(backend.pose, landmarks, OFFSET, NOISE, rng))
    assert sorted(backend.belief.landmark_ids.tolist()) == list(range(40))


def run_in_a_room(backend: FastSlam, steps: int, spinning: range) -> np.ndarray:
    """Drive round a room by its scans; return the error of the believed pose at the end.

    The wheels of this world do not slip, and the filter is told so: what it would allow for at the first step,
    5 cm/s and 50 mrad before it has any landmark, no measurement can take back. An EKF keeps the mean of that; the
    particles that die out do so at random, until one direction is left that is some mrad off.
    """
    rng = np.random.default_rng(3)
    start = np.array([2.0, 2.0, 0.3])
    backend.reset()
    pose = start
    for k in range(steps):
        backend.update(room_scan(compose(pose, np.array([OFFSET, 0, 0])), rng))
        if k in spinning:
            backend.predict(Odometry((0.7, 0.3, 0.8), 0.1))
        else:
            pose, odometry = drive(pose, circle_twist(k), (0.01, 0.02), rng)
            backend.predict(odometry)
    return compose(inverse(start), pose) - backend.pose


@BOTH
def test_scans_of_a_room_give_its_corners_and_keep_the_pose(kind: type[FastSlam]) -> None:
    backend = make(kind)
    error = run_in_a_room(backend, 150, range(0))
    assert np.hypot(*error[:2]) < 0.04
    assert abs(float(wrap(error[2]))) < 0.02
    belief = backend.belief
    assert len(belief.landmarks) == 4
    assert belief.landmark_kinds.tolist() == [slam.CONCAVE] * 4
    c, s = math.cos(0.3), math.sin(0.3)
    mapped = belief.landmarks @ np.array([[c, s], [-s, c]]) + 2.0
    for corner in mapped:
        assert np.min(np.hypot(*(np.array([[0, 0], [6, 0], [6, 5], [0, 5]]) - corner).T)) < 0.04
    assert backend.grid.known_cells > 0


@BOTH
def test_spinning_wheels_do_not_lose_the_filter(kind: type[FastSlam]) -> None:
    """For two seconds the wheels drive on and turn while the robot stands against something."""
    backend = make(kind)
    error = run_in_a_room(backend, 120, range(50, 70))
    assert np.hypot(*error[:2]) < 0.05
    assert abs(float(wrap(error[2]))) < 0.03
    assert backend.landmark_count == 4


def test_configuration_is_checked() -> None:
    config = from_mapping(FastSlamConfig, {"particles": 30, "resampling": {"when": "every_k", "every": 3}})
    assert config.resampling.every == 3
    for bad, message in (
        ({"particles": 0}, "particles"),
        ({"gate": 0.0}, "gate"),
        ({"unexplained": -1.0}, "unexpl"),
    ):
        with pytest.raises(ValueError, match=message):
            FastSlamConfig(**bad)  # type: ignore[arg-type]
