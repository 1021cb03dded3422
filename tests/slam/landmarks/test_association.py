"""Joint compatibility: against exhaustive search, and where gates one by one are fooled."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import slam
from slam import Observations, Odometry
from slam.gaussian.stacked_update import NO_LIMITS
from slam.geometry import compose, inverse, wrap
from slam.landmarks.association import IGNORED, nearest_neighbour, predicted
from slam.landmarks.book import MARKS
from slam.landmarks.joint_compatibility import JOINT_GATES, joint_compatibility
from tests.slam.numerics import random_covariance
from tests.slam.simulated import circle_twist, drive, observe_landmarks, room_scan

OFFSET = 0.2


def observe(x: np.ndarray, i: int, *, sigma: float = 1e-4) -> np.ndarray:
    """Return the observation row of landmark ``i`` as predicted, of unknown kind."""
    row = np.zeros(8)
    row[:2] = predicted(x, i, 0.0, OFFSET, np.zeros((2, 5)))
    row[2], row[4] = sigma**2, sigma**2
    return row


def joint_distance(x: np.ndarray, p: np.ndarray, z: np.ndarray, pairs: list[tuple[int, int]]) -> float:
    """Return νᵀ S⁻¹ ν of the pairings (observation, landmark), from dense matrices."""
    h = np.zeros((2 * len(pairs), len(x)))
    r = np.zeros((2 * len(pairs), 2 * len(pairs)))
    nu = np.zeros(2 * len(pairs))
    for q, (k, i) in enumerate(pairs):
        block = np.zeros((2, 5))
        nu[2 * q : 2 * q + 2] = z[k, :2] - np.array(predicted(x, i, 0.0, OFFSET, block))
        nu[2 * q + 1] = wrap(nu[2 * q + 1])
        h[2 * q : 2 * q + 2, :3] = block[:, :3]
        h[2 * q : 2 * q + 2, 3 + 2 * i : 5 + 2 * i] = block[:, 3:]
        r[2 * q : 2 * q + 2, 2 * q : 2 * q + 2] = [[z[k, 2], z[k, 3]], [z[k, 3], z[k, 4]]]
    return float(nu @ np.linalg.solve(h @ p @ h.T + r, nu))


def exhaustive(x: np.ndarray, p: np.ndarray, z: np.ndarray, landmarks: int) -> tuple[int, float]:
    """Return the number of pairings and the distance of the best jointly compatible set, by trying all."""
    best = (0, 0.0)
    for choice in itertools.product(range(-1, landmarks), repeat=len(z)):
        taken = [i for i in choice if i >= 0]
        if len(set(taken)) < len(taken) or len(taken) < best[0]:
            continue
        pairs = [(k, i) for k, i in enumerate(choice) if i >= 0]
        steps = [joint_distance(x, p, z, pairs[: n + 1]) for n in range(len(pairs))]
        if any(d > JOINT_GATES[n + 1] for n, d in enumerate(steps)):
            continue
        if pairs and (len(pairs) > best[0] or steps[-1] < best[1]):
            best = (len(pairs), steps[-1])
    return best


@given(st.integers(0, 10_000))
def test_joint_compatibility_finds_the_best_set_of_all(seed: int) -> None:
    """Four landmarks near one another, three observations that may be any of them, an uncertain pose."""
    rng = np.random.default_rng(seed)
    x = np.concatenate([rng.uniform(-1, 1, 3), (np.array([3.0, 0.0]) + rng.uniform(-0.6, 0.6, (4, 2))).ravel()])
    p = 0.002 * random_covariance(len(x), rng) + np.diag([0.02, 0.02, 0.002] + [1e-4] * 8)
    z = np.array([observe(x, int(i), sigma=0.02) for i in rng.integers(0, 4, 3)])
    z[:, :2] += rng.normal(0, 0.08, (3, 2))
    match = np.zeros(3, np.int64)
    distance = joint_compatibility(x, np.triu(p), OFFSET, z, np.zeros((4, MARKS)), 0.2, 0.6, match)
    pairs = [(k, int(i)) for k, i in enumerate(match) if i >= 0]
    count, nearest = exhaustive(x, p, z, 4)
    assert len(pairs) == count
    np.testing.assert_allclose(distance, nearest, rtol=1e-6, atol=1e-12)
    if pairs:
        np.testing.assert_allclose(joint_distance(x, p, z, pairs), nearest, rtol=1e-6)


def test_joint_compatibility_holds_where_nearest_neighbour_is_fooled() -> None:
    """A row of equal posts, and a pose that is off by more than half their distance along it."""
    x = np.zeros(3 + 2 * 5)
    x[3:] = np.array([[2.0, 0.0], [2.0, 0.2], [2.0, 0.4], [2.0, 0.6], [3.0, 0.3]]).ravel()
    p = np.diag([1e-6, 0.01, 1e-6] + [1e-6] * 10)
    truth = x.copy()
    truth[1] = 0.12
    z = np.array([observe(truth, i, sigma=0.01) for i in (1, 2, 3, 4)])
    nearest, joint = np.zeros(4, np.int64), np.zeros(4, np.int64)
    marks = np.zeros((5, MARKS))
    nearest_neighbour(x, p, OFFSET, z, marks, JOINT_GATES[1], 0.1, 0.6, False, nearest, np.zeros(4))
    joint_compatibility(x, p, OFFSET, z, marks, 0.1, 0.6, joint)
    assert nearest[:3].tolist() == [0, 1, 2]
    assert joint.tolist() == [1, 2, 3, 4]


def test_what_could_be_a_landmark_but_is_not_jointly_is_not_new() -> None:
    x = np.array([0.0, 0.0, 0.0, 2.0, 1.0, 2.0, -1.0, 3.0, 0.0])
    p = np.diag([0.01, 0.01, 1e-4] + [1e-6] * 6)
    z = np.array([observe(x, i, sigma=0.002) for i in range(3)])
    z[2, 0] += 0.1  # within the pose's own gate, not together with the other two
    match = np.zeros(3, np.int64)
    joint_compatibility(x, p, OFFSET, z, np.zeros((3, MARKS)), 0.1, 0.6, match)
    assert match.tolist() == [0, 1, IGNORED]


def test_a_changed_view_is_not_taken_for_wheels_that_spin() -> None:
    """Corners that give way to others near by, as at a door, must not move a filter that knows where it is."""
    rng = np.random.default_rng(3)
    backend = slam.make("ekf")
    backend.reset()
    start = pose = np.array([2.0, 2.0, 0.3])
    for k in range(60):
        sensor = compose(pose, np.array([OFFSET, 0, 0]))
        backend.update(room_scan(sensor, rng) if k < 50 else room_scan(sensor, rng, width=6.08, height=5.09))
        error = compose(inverse(start), pose) - backend.pose
        assert math.hypot(error[0], error[1]) < 0.03
        assert abs(float(wrap(error[2]))) < 0.02
        pose, odometry = drive(pose, circle_twist(k), (0.01, 0.02), rng)
        backend.predict(Odometry(odometry.twist, odometry.dt))


@pytest.mark.parametrize("name", ["ekf", "compressed-ekf", "fastslam1", "fastslam2"])
def test_what_is_seen_metres_off_is_a_landmark_that_is_known(name: str) -> None:
    """Each by its own covariance: of a robot that knows where it is, too."""
    backend = slam.make(name, config={"landmarks": {"confirm_after": 5, "tentative_gate_m": 1.5}})
    backend.reset()
    rng, cov = np.random.default_rng(0), np.diag([1.5**2, math.radians(2.8) ** 2])
    trees = np.array([[20.0, 0.0], [15.0, 12.0], [10.0, -9.0]])
    for _ in range(100):
        backend.predict(Odometry((0.0, 0.0, 0.0), 0.1))
        seen = observe_landmarks(backend.pose, trees, OFFSET, cov, rng)
        backend.observe(Observations(seen.range_bearing, seen.cov))
    assert backend.landmark_count == 3
    apart = np.hypot(*(backend.belief.landmarks[:, None] - trees).transpose(2, 0, 1)).min(axis=1)
    assert apart.max() < 0.6


@pytest.mark.parametrize("name", ["ekf", "invariant-ekf"])
def test_a_misread_label_is_refused_where_there_is_a_gate(name: str) -> None:
    """Two landmarks known well; then one is reported in the place of the other."""
    noise = np.diag([1e-4, 1e-5])
    errors = {}
    for gate in (math.inf, 18.4):
        backend = slam.make(name, config={"known_gate": gate})
        backend.reset()
        places = np.array([[3.0, 1.0], [2.0, -2.0]])
        seen = observe_landmarks(np.zeros(3), places, OFFSET, noise, np.random.default_rng(0))
        for _ in range(5):
            backend.observe(seen)
        wrong = Observations(seen.range_bearing[:1], seen.cov[:1], np.array([1]))
        backend.observe(wrong)
        assert backend.landmark_count == 2
        assert backend.landmark_details()[0].tolist() == ([5, 6] if gate == math.inf else [5, 5])
        errors[gate] = float(np.hypot(*(backend.belief.landmarks[1] - places[1])))
    assert errors[18.4] < 0.02 < 0.1 < errors[math.inf]


def close_a_loop(association: str, name: str = "ekf") -> tuple[float, float]:
    """Map a row of equal posts and an odd one, drive round unseeing, come back; return the error before and after.

    The wheels have drifted by more than half the posts' distance, along the row.
    """
    rng = np.random.default_rng(1)
    noise = np.diag([0.02**2, 0.005**2])
    posts = np.array([[2.0, 0.3 * i] for i in range(-3, 4)] + [[2.6, 0.47]])
    backend = slam.make(name, config={"association": association, "landmarks": {"new_distance_m": 0.05}})
    backend.reset()
    for _ in range(10):
        backend.observe(observe_landmarks(np.zeros(3), posts, OFFSET, noise, rng))
    # A square of 4 m a side, back to the start; the odometry says a little too much on the way home.
    for twist in ((-1.0, 0, 0), (0, -1.0, 0), (1.0, 0, 0), (0, 1.045, 0)):
        for _ in range(40):
            backend.predict(Odometry(twist, 0.1))
    before = float(np.hypot(*backend.pose[:2]))
    seen = observe_landmarks(np.zeros(3), posts[[2, 3, 4, 7]], OFFSET, noise, rng)
    backend.observe(Observations(seen.range_bearing, seen.cov))
    return before, float(np.hypot(*backend.pose[:2]))


@pytest.mark.parametrize("name", ["ekf", "invariant-ekf"])
def test_a_loop_closes_by_joint_compatibility_where_nearest_neighbour_fails(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, nearest = close_a_loop("nearest", name)
    _, joint = close_a_loop("joint", name)
    _, individual = close_a_loop("individual", name)
    assert before > 0.15
    assert joint < 0.03
    assert nearest < 0.03  # its pairings contradict each other, so they are made jointly
    assert individual > 0.1  # more than one post within each gate: nothing is taken, nothing gained
    monkeypatch.setattr("slam.ekf.JOINT_LIMITS", NO_LIMITS)
    _, nearest_alone = close_a_loop("nearest", name)
    assert nearest_alone > 0.08  # matched one post too far
