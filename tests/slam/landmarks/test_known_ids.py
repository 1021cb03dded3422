"""Landmarks with labels: misread ones are refused, and neither a wrong place nor a wrong pose lasts."""

from __future__ import annotations

import math

import numpy as np
import pytest

import slam
from slam import Observations, Odometry
from slam.gaussian.joint_gaussian import ANYWHERE_COV
from slam.geometry import compose, transform_points, wrap
from slam.landmarks.association import IGNORED
from slam.landmarks.known_ids import KnownIds
from slam.metrics.measures import align_se2
from slam.particles.gate import refuse_unlikely
from slam.particles.maps import ParticleMaps
from tests.slam.simulated import circle_twist, drive, observe_landmarks

GAUSSIAN = ("ekf", "ekf-lines", "invariant-ekf", "compressed-ekf")
BACKENDS = (*GAUSSIAN, "fastslam1", "fastslam2")
COV = np.diag([0.03**2, 0.02**2])
SIGMAS = (0.03, 0.03)
LANDMARKS = np.random.default_rng(4).uniform(-4.0, 4.0, (14, 2))
NOISE = {
    "speed_floor_m_s": SIGMAS[0], "turn_floor_rad_s": SIGMAS[1], "speed_share": 0.0, "turn_share_rad_m": 0.0,
    "slip_share": 0.0,
}  # fmt: skip


def run(name, *, steps=150, misread=0.0, pushed=None, first=None, seed=0):
    """Drive among the landmarks; return the backend, and by step its position error [m] and NEES / 3."""
    more = {"particles": 60} if name.startswith("fast") else {}
    backend = slam.make(name, config={"known_gate": 18.4, "odometry": NOISE, "lidar_offset_m": 0.1} | more)
    backend.reset(np.zeros(3), seed=seed)
    rng = np.random.default_rng(seed)
    pose, errors, nees = np.zeros(3), [], []
    for k in range(steps):
        pose, odometry = drive(pose, circle_twist(k), SIGMAS, rng)
        if k == pushed:
            pose = compose(pose, np.array([0.7, -0.4, 0.6]))
        backend.predict(odometry)
        seen = observe_landmarks(pose, LANDMARKS, 0.1, COV, rng, reach=3.5)
        ids = np.where(
            rng.random(len(seen.ids)) < misread, rng.integers(len(LANDMARKS), size=len(seen.ids)), seen.ids
        )
        if k == 0 and first is not None:  # the very first sighting has another one's label
            ids = ids[:1] * 0 + first
            seen = Observations(seen.range_bearing[:1], seen.cov[:1], ids)
        backend.observe(Observations(seen.range_bearing, seen.cov, ids))
        errors.append(math.hypot(*(backend.pose - pose)[:2]))
        nees.append(backend.pose_nees(pose) / 3.0)
    return backend, np.array(errors), np.array(nees)


@pytest.mark.parametrize("name", BACKENDS)
def test_misread_labels_do_no_harm(name):
    _, errors, nees = run(name, misread=0.05)
    assert errors.max() < 0.15
    if name in GAUSSIAN:
        assert nees.mean() < 2.0


@pytest.mark.parametrize("name", BACKENDS)
def test_a_robot_that_was_pushed_is_found_again(name):
    _, errors, _ = run(name, misread=0.05, pushed=80)
    assert errors[79] < 0.15 < errors[80] and errors[100:].max() < 0.2


@pytest.mark.parametrize("name", BACKENDS)
def test_a_landmark_that_was_first_misread_comes_to_its_place(name):
    first = 13
    backend, errors, _ = run(name, steps=60, first=first)
    belief = backend.belief
    at = belief.landmarks[np.flatnonzero(belief.landmark_ids == first)]
    off = np.hypot(*(at - LANDMARKS[first]).T)
    assert errors.max() < 0.15 and (not len(off) or off[0] < 0.2)


def test_the_region_of_the_compressed_filter_forgets_a_pose_as_the_full_one_does():
    beliefs = []
    for name in ("ekf", "compressed-ekf"):
        backend, *_ = run(name, steps=60)
        if name == "compressed-ekf":
            backend._choose_region(np.array([0]))
        backend._place(backend.pose + np.array([0.02, -0.01, 0.01]), ANYWHERE_COV)
        rng = np.random.default_rng(3)
        backend.predict(Odometry(np.array([0.1, 0.0, 0.1]), 0.1))
        seen = observe_landmarks(backend.pose, LANDMARKS, 0.1, COV, rng, reach=3.0)
        backend.observe(seen)
        belief = backend.belief
        order = np.argsort(belief.landmark_ids)
        states = np.concatenate([np.arange(3), (3 + 2 * order[:, None] + [0, 1]).ravel()])
        beliefs.append((belief.pose, belief.landmarks[order], belief.joint_cov[np.ix_(states, states)]))
    for full, compressed in zip(*beliefs, strict=True):
        np.testing.assert_allclose(compressed, full, atol=1e-9)


def test_a_forgotten_pose_is_found_by_the_landmarks_alone():
    """It comes from the map and what is seen, from wherever it is linearised, and the map stays."""
    backend, *_ = run("ekf", steps=80)
    belief, pose = backend.belief, backend.pose
    rng = np.random.default_rng(5)
    seen = observe_landmarks(pose, belief.landmarks, 0.1, 1e-12 * np.eye(2), rng)
    backend._place(pose + np.array([0.01, 0.02, -0.01]), ANYWHERE_COV)
    backend.observe(Observations(seen.range_bearing, np.tile(1e-6 * np.eye(2), (len(seen.ids), 1, 1)),
                                 belief.landmark_ids[seen.ids]))  # fmt: skip
    np.testing.assert_allclose(backend.pose, pose, atol=2e-3)
    assert np.all(np.trace(backend.belief.landmark_cov, axis1=1, axis2=2)
                  <= np.trace(belief.landmark_cov, axis1=1, axis2=2) + 1e-9)  # fmt: skip


@pytest.mark.parametrize("seed", range(3))
def test_the_rigid_fit_is_the_motion_that_was_made(seed):
    rng = np.random.default_rng(seed)
    pose, points = rng.uniform(-3.0, 3.0, 3), rng.normal(size=(4, 2))
    np.testing.assert_allclose(align_se2(transform_points(pose, points), points), pose, atol=1e-9)


def test_two_landmarks_alone_do_not_say_that_the_robot_is_elsewhere():
    true, believed = np.array([0.5, 0.5, 0.3]), np.zeros(3)
    places = {i: p for i, p in enumerate(LANDMARKS)}
    rng = np.random.default_rng(0)
    for count, found in ((2, False), (3, True)):
        known = KnownIds(0.0)
        ids = list(range(count))
        z = np.zeros((count, 10))
        z[:, :2] = observe_landmarks(true, LANDMARKS[:count], 0.0, 1e-12 * np.eye(2), rng).range_bearing
        z[:, 2], z[:, 4] = COV[0, 0], COV[1, 1]
        for _ in range(5):
            known.note(ids, z, np.zeros(count, np.int64), believed)
        for _ in range(12):
            known.note(ids, z, np.full(count, IGNORED), believed)
        other = known.elsewhere(believed, places.get)
        assert (other is not None) is found
        if other is not None:
            np.testing.assert_allclose(other.pose, true, atol=1e-5)


def refusals(known, places, believed=0):
    """Believe landmark 7 so often at (3, 0), then refuse it at places (n, 2); return when it was misplaced.

    Landmark 8 is where it should be all along.
    """

    def row(x, y):
        z = np.zeros((1, 12))
        z[0, :5] = math.hypot(x, y), math.atan2(y, x), COV[0, 0], 0.0, COV[1, 1]
        return z

    held, refused, pose = np.array([0]), np.array([IGNORED]), np.zeros(3)
    for _ in range(3):
        known.note([8], row(2.0, 1.0), held, pose)
    for _ in range(believed):
        known.note([7], row(3.0, 0.0), held, pose)
    for k, (x, y) in enumerate(places):
        known.note([7], row(x, y), refused, pose)
        known.note([8], row(2.0, 1.0), held, pose)
        if known.misplaced() == [7]:
            return k + 1
    return None


@pytest.mark.parametrize("believed", [2, 40])
@pytest.mark.parametrize("strays", [0, 1, 3])
def test_a_misread_label_in_between_does_not_hold_a_wrong_place(believed, strays):
    """It is dropped once those that agree outnumber the believed ones, and the strays among the last 24."""
    places = [(1.0, -2.0 - k) for k in range(strays)] + [(4.0, 2.0)] * 100
    found = refusals(KnownIds(0.0), places, believed)
    # Strays that are longer ago than 24 refusals are counted with the others.
    expected = max(believed, strays) + 1 + (strays if believed + 1 < 24 else 0)
    assert found == expected


def test_refusals_that_agree_on_nothing_drop_no_landmark_and_take_no_memory():
    known = KnownIds(0.0)
    scattered = np.random.default_rng(1).uniform([-8.0, -8.0], [8.0, 8.0], (500, 2))
    assert refusals(known, scattered, believed=2) is None
    assert len(known._refused[7]) == 24


def test_the_gate_of_particles_is_that_of_their_mixture():
    """Against drawn samples of what is expected: the squared distance by their mean and covariance."""
    rng = np.random.default_rng(2)
    poses = rng.normal([0.0, 0.0, 0.2], [0.05, 0.05, 0.03], (40, 3))
    weights = rng.random(40)
    weights /= weights.sum()
    covs = np.tile(np.diag([0.02**2, 0.03**2, 0.02**2]), (40, 1, 1))
    covs[:, 0, 2] = 0.0002
    maps = ParticleMaps(40)
    row = np.array([2.0, 0.3, COV[0, 0], 0.0, COV[1, 1], 0.0, 0.0, 0.0, 0.0, 0.0])
    maps.add(poses, row, 0.1)
    landmark = maps.records[maps.table[:, 0]]
    drawn = []
    for i in range(40):
        full = np.triu(covs[i]) + np.triu(covs[i], 1).T
        count = round(4e4 * weights[i])
        at = rng.multivariate_normal(poses[i], full, count)
        where = rng.multivariate_normal(landmark[i, :2], landmark[i, [[2, 3], [3, 4]]], count)
        d = where - at[:, :2] - 0.1 * np.column_stack([np.cos(at[:, 2]), np.sin(at[:, 2])])
        drawn.append(np.column_stack([np.hypot(*d.T), wrap(np.arctan2(d[:, 1], d[:, 0]) - at[:, 2])]))
    expected = np.vstack(drawn)
    off = np.array([2.3, 0.38]) - expected.mean(axis=0)
    distance = off @ np.linalg.solve(np.cov(expected.T) + COV, off)
    seen = row[None].copy()
    seen[0, :2] = [2.3, 0.38]
    for share, refused in ((0.9, True), (1.1, False)):
        rows = np.zeros(1, np.int64)
        refuse_unlikely(poses, covs, weights, maps, 0.1, seen, share * distance, rows)
        assert bool(rows[0] == IGNORED) is refused
