from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import slam
from slam.accounts.account import Account
from slam.geometry import compose, inverse, wrap
from slam.teams.apart import Apart, Start, without_start
from slam.teams.centralised import JointEkf
from slam.teams.frames import points_into, pose_into, walls_into
from slam.types import Observations, Odometry
from tests.slam.numerics import numerical_jacobian, random_covariance
from tests.slam.simulated import observe_landmarks
from tests.slam.teams.test_centralised import CONFIG, MET, OFFSET, SEEN, rooms

BADLY = np.diag([0.1, 0.1, 0.06]) ** 2


def team_of_two() -> JointEkf:
    team = JointEkf(2, CONFIG)
    team.reset([[0, 0, 0], [2.0, 1.0, 0.5]], [np.eye(3) * 1e-8, BADLY])
    return team


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_what_a_start_is_off_by_the_whole_map_is(seed: int) -> None:
    rng = np.random.default_rng(seed)
    start, cov = rng.normal(size=3), random_covariance(3, rng)
    pose, points = rng.normal(size=3), rng.normal(size=(4, 2))
    walls = np.column_stack([rng.uniform(-1.0, 1.0, 3), rng.normal(size=3)])

    def moved(begun: np.ndarray) -> np.ndarray:
        frame = compose(begun, inverse(start))
        return np.concatenate([
            pose_into(frame, pose)[0], points_into(frame, points)[0].ravel(), walls_into(frame, walls)[0].ravel()
        ])  # fmt: skip

    jacobian = numerical_jacobian(moved, start)
    added = Apart(start=Start(start, cov)).in_all(pose, points, walls)
    np.testing.assert_allclose(added, jacobian @ cov @ jacobian.T, rtol=1e-4, atol=1e-6)


def test_one_that_knows_its_start_badly_maps_alone_and_says_how_badly() -> None:
    team = team_of_two()
    rooms(team, 30, np.random.default_rng(1))
    one, two = team.members
    assert two.apart and not one.apart
    assert one.grid is team.grid is not two.grid
    belief = two.belief
    assert belief.whole_cov is not None and len(belief.lines) == 4
    assert np.linalg.eigvalsh(belief.whole_cov).min() > 0.0
    assert belief.pose_cov[2, 2] > 0.9 * BADLY[2, 2]
    for k, cov in enumerate(belief.landmark_cov):
        rows = slice(3 + 2 * k, 5 + 2 * k)
        np.testing.assert_allclose(cov, belief.whole_cov[rows, rows])
    walls = belief.whole_cov[3 + 2 * len(belief.landmarks) :: 2]
    assert np.all(np.diag(walls[:, 3 + 2 * len(belief.landmarks) :: 2]) > 0.9 * BADLY[2, 2])  # all turn with it
    np.testing.assert_array_equal(team.poses[1], two.pose)
    np.testing.assert_array_equal(team.joint_pose_cov()[3:, 3:], two.pose_cov)
    assert np.all(team.joint_pose_cov()[:3, 3:] == 0.0)


def test_labels_and_a_first_sighting_need_no_map() -> None:
    seen = Observations(np.array([[2.0, 0.1]]), SEEN[None], np.array([7]))
    for met in (False, True):
        team = team_of_two()
        two = team.members[1]
        two.predict(Odometry((0.5, 0.0, 0.0), 0.1))
        if met:
            team.members[0].see(1, [math.hypot(2.0, 1.0), math.atan2(1.0, 2.0), 0.5], MET)
        else:
            two.observe(seen)
        assert not two.apart
        assert abs(two.pose[0] - (2.0 + 0.05 * math.cos(0.5))) < 0.1
    team = team_of_two()
    rooms(team, 2, np.random.default_rng(1))
    assert math.isnan(team.members[0].see(1, [2.0, 0.5, 0.5], MET))
    assert team.members[1].apart


def test_joining_measures_again_what_was_measured() -> None:
    """Told its start exactly, one that mapped alone becomes what it would have been from the beginning."""
    rng = np.random.default_rng(3)
    team = JointEkf(2, CONFIG)
    start = compose(inverse(np.array([2.0, 2.0, 0.3])), np.array([4.0, 3.0, -1.2]))
    team.reset([np.zeros(3), start + np.array([0.1, -0.1, 0.05])], [np.eye(3) * 1e-8, BADLY])
    true = rooms(team, 40, rng)
    off = np.abs(team.poses[1] - true[1])
    assert off.max() > 0.04
    team._join(team.members[1], Start(start, 1e-8 * np.eye(3)))
    off = team.poses - true
    off[:, 2] = wrap(off[:, 2])
    assert np.abs(off).max() < 0.03
    assert team.members[1].grid is team.grid
    assert np.linalg.norm(team.joint_pose_cov()[:3, 3:]) > 0.0
    assert len(team.members[0].belief.lines) == 4


def test_an_account_without_its_start_is_that_of_one_who_knew_it() -> None:
    """The invariant filter carries the start's covariance along: what is left is as though it had been exact."""
    accounts, cov = [], np.diag([0.2, 0.1, 0.03]) ** 2
    start = np.array([3.0, -2.0, 0.7])
    for told in (1e-8 * np.eye(3), cov):
        backend, draw = slam.make("invariant-ekf"), np.random.default_rng(1)
        backend.reset(start, pose_cov=told)
        for _ in range(20):
            backend.predict(Odometry((0.3, 0.1, 0.2), 0.1))
            seen = np.array([[2.0, 0.3], [3.0, -1.0], [4.0, 1.2]]) + 1e-3 * draw.standard_normal((3, 2))
            backend.observe(Observations(seen, np.tile(np.diag([1e-4, 1e-5]), (3, 1, 1)), np.arange(3)))
        accounts.append(Account.of(0, 0.0, backend))
    exact, rough = accounts
    found = without_start(rough, Start(start, cov))
    scale = np.sqrt(np.diag(exact.cov))
    assert np.abs((found.cov - exact.cov) / np.outer(scale, scale)).max() < 0.15
    assert np.trace(rough.cov[3:, 3:]) > 5.0 * np.trace(found.cov[3:, 3:])


def test_odometry_that_is_refused_is_nowhere_when_an_unsure_robot_joins() -> None:
    team = JointEkf(2, CONFIG)
    team.reset([[0, 0, 0], [1, 0, 0]], [1e-6 * np.eye(3), 0.04 * np.eye(3)])
    member, rng = team.members[1], np.random.default_rng(1)
    assert member.apart
    with pytest.raises(ValueError, match="finite"):
        member.predict(Odometry((math.nan, 0.0, 0.0), 0.1))
    member.predict(Odometry((0.5, 0.0, 0.0), 1.0))
    member.observe(observe_landmarks(np.array([1.5, 0.0, 0.0]), np.array([[3.0, 1.0]]), OFFSET, SEEN, rng))
    assert not member.apart
    np.testing.assert_allclose(member.pose, [1.5, 0.0, 0.0], atol=0.01)
