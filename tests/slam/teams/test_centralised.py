from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import slam
from slam.gaussian.settings import EkfLinesConfig
from slam.geometry import compose, inverse, wrap
from slam.health.monitor import HealthConfig
from slam.metrics.measures import nees_band, nees_pose
from slam.motion import OdometryNoise, jacobians, move
from slam.teams.centralised import JointEkf
from slam.teams.turns import expected_sighting, swap_robots
from slam.types import LINE, Observations, Odometry
from tests.slam.numerics import numerical_jacobian, random_covariance
from tests.slam.simulated import circle_twist, drive, observe_landmarks, room_scan

OFFSET = 0.2
CONFIG = EkfLinesConfig(lidar_offset_m=OFFSET, odometry=OdometryNoise(slip_share=0.0))
SEEN = np.diag([0.02**2, 0.01**2])  # of a landmark
MET = np.diag([0.03**2, 0.01**2, 0.02**2])  # of another robot


def sigmas(twist: np.ndarray) -> tuple[float, float]:
    var_v, var_w = CONFIG.odometry.variances(*twist)
    return math.sqrt(var_v), math.sqrt(var_w)


def see(seer: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """A sighting, written down once more from the geometry."""
    x, y, turn = compose(inverse(seer), seen)
    return np.array([math.hypot(x, y), math.atan2(y, x), turn])


class DenseEkf:
    """The same filter written as plainly as can be: one full matrix, robots first, landmarks in order of ids."""

    def __init__(self, poses: np.ndarray, covs: np.ndarray) -> None:
        self.x, self.robots = poses.ravel().copy(), len(poses)
        self.p = np.zeros((len(self.x), len(self.x)))
        for i, cov in enumerate(covs):
            self.p[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = cov
        self.ids: list[int] = []

    def predict(self, i: int, odometry: Odometry) -> None:
        own, twist = slice(3 * i, 3 * i + 3), np.array(odometry.twist)
        fx, fu = jacobians(self.x[own], twist, odometry.dt)
        var_v, var_w = CONFIG.odometry.variances(*twist)
        f = np.eye(len(self.x))
        f[own, own] = fx
        self.p = f @ self.p @ f.T
        self.p[own, own] += fu @ np.diag([var_v, var_v, var_w]) @ fu.T
        self.x[own] = move(self.x[own], twist, odometry.dt)

    def expected(self, i: int, k: int) -> np.ndarray:
        x, y, theta = self.x[3 * i : 3 * i + 3]
        at = 3 * self.robots + 2 * k
        d = self.x[at : at + 2] - [x + OFFSET * math.cos(theta), y + OFFSET * math.sin(theta)]
        return np.array([np.hypot(*d), float(wrap(math.atan2(d[1], d[0]) - theta))])

    def observe(self, i: int, seen: Observations) -> None:
        assert seen.ids is not None
        own, n = slice(3 * i, 3 * i + 3), len(self.x)
        old = [k for k, id_ in enumerate(seen.ids) if id_ in self.ids]
        if old:
            h, nu = np.zeros((2 * len(old), n)), np.zeros(2 * len(old))
            for row, k in enumerate(old):
                at = 3 * self.robots + 2 * self.ids.index(int(seen.ids[k]))
                (rho, bearing), c, s = self.expected(i, self.ids.index(int(seen.ids[k]))), *self.direction(i)
                theta = self.x[3 * i + 2]
                u, v = math.cos(theta + bearing), math.sin(theta + bearing)
                by_theta = [OFFSET * (u * s - v * c), -1 - OFFSET * (u * c + v * s) / rho]
                h[2 * row : 2 * row + 2, own] = [[-u, -v, by_theta[0]], [v / rho, -u / rho, by_theta[1]]]
                h[2 * row : 2 * row + 2, at : at + 2] = [[u, v], [-v / rho, u / rho]]
                nu[2 * row : 2 * row + 2] = seen.range_bearing[k] - [rho, bearing]
                nu[2 * row + 1] = wrap(nu[2 * row + 1])
            self.correct(h, nu, np.kron(np.eye(len(old)), SEEN))
        for k, id_ in enumerate(seen.ids):
            if int(id_) in self.ids:
                continue
            (rho, phi), theta, n = seen.range_bearing[k], self.x[3 * i + 2], len(self.x)
            u, v, (c, s) = math.cos(theta + phi), math.sin(theta + phi), self.direction(i)
            way = np.array([OFFSET * c + rho * u, OFFSET * s + rho * v])
            gr = np.array([[1, 0, -way[1]], [0, 1, way[0]]])
            gz = np.array([[u, -rho * v], [v, rho * u]])
            p = np.zeros((n + 2, n + 2))
            p[:n, :n] = self.p
            p[n:, :n] = gr @ self.p[own]
            p[:n, n:] = p[n:, :n].T
            p[n:, n:] = gr @ self.p[own, own] @ gr.T + gz @ SEEN @ gz.T
            self.x, self.p = np.concatenate([self.x, self.x[own][:2] + way]), p
            self.ids.append(int(id_))

    def direction(self, i: int) -> tuple[float, float]:
        return math.cos(self.x[3 * i + 2]), math.sin(self.x[3 * i + 2])

    def see(self, i: int, j: int, z: np.ndarray) -> None:
        h = np.zeros((3, len(self.x)))
        a, b = slice(3 * i, 3 * i + 3), slice(3 * j, 3 * j + 3)
        h[:, a] = numerical_jacobian(lambda v: see(v, self.x[b]), self.x[a], step=1e-5)
        h[:, b] = numerical_jacobian(lambda v: see(self.x[a], v), self.x[b], step=1e-5)
        nu = z - see(self.x[a], self.x[b])
        nu[1:] = wrap(nu[1:])
        self.correct(h, nu, MET)

    def correct(self, h: np.ndarray, nu: np.ndarray, r: np.ndarray) -> None:
        s = h @ self.p @ h.T + r
        gain = self.p @ h.T @ np.linalg.inv(s)
        self.x, self.p = self.x + gain @ nu, self.p - gain @ s @ gain.T
        for i in range(self.robots):
            self.x[3 * i + 2] = wrap(self.x[3 * i + 2])


# ---- kernels ---------------------------------------------------------------------------------------------------


@given(st.integers(0, 10_000), st.integers(1, 4), st.integers(0, 6))
def test_a_swap_is_a_permutation(seed: int, others: int, landmarks: int) -> None:
    rng = np.random.default_rng(seed)
    n, k = 3 + 2 * landmarks, 3 * others
    x, cov, s = rng.uniform(-3, 3, n + k), random_covariance(n + k, rng), 3 * int(rng.integers(others))
    order = np.arange(n + k)
    order[:3], order[n + s : n + s + 3] = np.arange(n + s, n + s + 3), np.arange(3)
    state, upper, mean = x[:n].copy(), np.triu(cov[:n, :n]), x[n:].copy()
    own, cross = cov[n:, n:].copy(), np.zeros((k, n + 5))
    cross[:, :n] = cov[n:, :n]
    swap_robots(state, upper, n, mean, own, cross, s)
    want_x, want = x[order], cov[np.ix_(order, order)]
    np.testing.assert_array_equal(np.concatenate([state, mean]), want_x)
    np.testing.assert_array_equal(np.triu(upper), np.triu(want[:n, :n]))
    np.testing.assert_array_equal(own, want[n:, n:])
    np.testing.assert_array_equal(cross[:, :n], want[n:, :n])


@given(st.integers(0, 10_000))
def test_a_sighting_and_its_jacobians(seed: int) -> None:
    rng = np.random.default_rng(seed)
    seer, seen = rng.uniform(-3, 3, 3), rng.uniform(-3, 3, 3)
    if np.hypot(*(seer - seen)[:2]) < 0.3:
        seen[0] += 1.0
    hi, hj = np.zeros((3, 3)), np.zeros((3, 3))
    z = np.array(expected_sighting(seer, seen, hi, hj))
    difference = z - see(seer, seen)
    difference[1:] = wrap(difference[1:])
    np.testing.assert_allclose(difference, 0, atol=1e-12)

    def wrapped(v: np.ndarray) -> np.ndarray:  # about z, so that no difference jumps
        d = see(v[:3], v[3:]) - z
        d[1:] = wrap(d[1:])
        return d

    jacobian = numerical_jacobian(wrapped, np.concatenate([seer, seen]))
    np.testing.assert_allclose(np.hstack([hi, hj]), jacobian, atol=1e-6)


# ---- the filter ------------------------------------------------------------------------------------------------


def test_it_is_the_dense_filter_over_all_robots_and_landmarks() -> None:
    """Three robots in no order of turns, five landmarks, sightings of one another: to 1e-9."""
    rng = np.random.default_rng(4)
    landmarks = rng.uniform(-4, 4, (5, 2))
    true = np.array([[0.0, 0.0, 0.0], [1.0, -0.5, 2.9], [-1.0, 1.0, -1.0]])
    covs = np.array([random_covariance(3, rng, 1e-3) for _ in true])
    team, dense = JointEkf(3, CONFIG), DenseEkf(true, covs)
    team.reset(true, covs)
    for k in range(60):
        i = int(rng.integers(3))
        for _ in range(int(rng.integers(1, 4))):
            true[i], odometry = drive(true[i], circle_twist(3 * k), sigmas(circle_twist(3 * k)), rng)
            team.members[i].predict(odometry)
            dense.predict(i, odometry)
        if k % 2:
            seen = observe_landmarks(true[i], landmarks, OFFSET, SEEN, rng, reach=4.5)
            team.members[i].observe(seen)
            dense.observe(i, seen)
        if k % 5 == 0:
            j = (i + 1) % 3
            z = see(true[i], true[j]) + rng.multivariate_normal(np.zeros(3), MET)
            team.members[i].see(j, z, MET)
            dense.see(i, j, z)
    assert len(dense.ids) == 5
    assert team.members[0].belief.landmark_ids.tolist() == dense.ids
    np.testing.assert_allclose(team.poses, dense.x[:9].reshape(3, 3), atol=1e-9)
    np.testing.assert_allclose(team.members[1].belief.landmarks.ravel(), dense.x[9:], atol=1e-9)
    np.testing.assert_allclose(team.joint_cov(), dense.p, atol=1e-9)
    np.testing.assert_allclose(team.joint_pose_cov(), dense.p[:9, :9], atol=1e-9)
    for i, member in enumerate(team.members):
        rows = np.concatenate([np.arange(3 * i, 3 * i + 3), np.arange(9, len(dense.x))])
        np.testing.assert_allclose(member.pose, dense.x[3 * i : 3 * i + 3], atol=1e-9)
        np.testing.assert_allclose(member.belief.joint_cov, dense.p[np.ix_(rows, rows)], atol=1e-9)


def test_a_sighting_beyond_the_gate_changes_nothing() -> None:
    team = JointEkf(2, CONFIG)
    team.reset([[0, 0, 0], [2, 0, 0]])
    before, cov = team.poses, team.joint_cov()
    assert team.members[0].see(1, [3.0, 0.0, 0.0], MET, gate=16.0) > 16.0
    np.testing.assert_array_equal(team.poses, before)
    np.testing.assert_array_equal(team.joint_cov(), cov)
    assert team.members[0].see(1, [2.01, 0.0, 0.0], MET, gate=16.0) < 1.0
    assert np.all(np.diag(team.joint_cov()) < np.diag(cov) + 1e-18)


def rooms(team: JointEkf, steps: int, rng: np.random.Generator) -> np.ndarray:
    """Drive all members through one room, a scan each step; return the true poses in the frame of the first."""
    start = np.array([[2.0, 2.0, 0.3], [4.0, 3.0, -1.2]])[: len(team.members)]
    poses = start.copy()
    for k in range(steps):
        for i, member in enumerate(team.members):
            if k:
                twist = circle_twist(k + 40 * i)
                poses[i], odometry = drive(poses[i], twist, sigmas(twist), rng)
                member.predict(odometry)
            member.update(room_scan(compose(poses[i], np.array([OFFSET, 0, 0])), rng))
    return np.array([compose(inverse(start[0]), pose) for pose in poses])


def test_one_robot_is_ekf_lines_bit_for_bit() -> None:
    config = dataclasses.replace(CONFIG, health=HealthConfig(recover=False))
    single, team = slam.make("ekf-lines", config=config), JointEkf(1, config)
    single.reset((0.5, 0.0, 0.2), pose_cov=np.eye(3) * 1e-4)
    team.reset([[0.5, 0.0, 0.2]], [np.eye(3) * 1e-4])
    (member,) = team.members
    rng = np.random.default_rng(9)
    pose = np.array([2.0, 2.0, 0.3])
    for k in range(150):
        pose, odometry = drive(pose, circle_twist(k), (0.01, 0.02), rng)
        if 60 <= k < 70:
            odometry = Odometry((0.7, 0.3, 0.8), 0.1)  # wheels that spin
        scan = room_scan(compose(pose, np.array([OFFSET, 0, 0])), rng)
        for backend in (single, member):
            backend.predict(odometry)
            backend.update(scan)
        np.testing.assert_array_equal(member.pose, single.pose)
    np.testing.assert_array_equal(member.joint_cov, single.joint_cov)
    assert single.landmark_count == member.landmark_count > 4
    for name in ("landmarks", "landmark_ids", "lines", "line_ends", "whole_cov", "health"):
        np.testing.assert_array_equal(getattr(member.belief, name), getattr(single.belief, name))
    np.testing.assert_array_equal(member.grid.classes(), single.grid.classes())
    np.testing.assert_array_equal(member.key_scans.poses, single.key_scans.poses)


def test_two_robots_map_one_room_once() -> None:
    """Neither sees the other; they share corners, walls and grid, and the covariance stays one."""
    team = JointEkf(2, CONFIG)
    start = compose(inverse(np.array([2.0, 2.0, 0.3])), np.array([4.0, 3.0, -1.2]))
    rough = np.diag([0.05**2, 0.05**2, 0.03**2])
    guess = start + np.array([0.04, -0.05, 0.02])
    team.reset([np.zeros(3), guess], [np.eye(3) * 1e-8, rough])
    held = team.members[0].belief
    true = rooms(team, 120, np.random.default_rng(2))
    np.testing.assert_array_equal(held.landmarks, np.zeros((0, 2)))
    one, two = (m.belief for m in team.members)
    np.testing.assert_array_equal(one.landmarks, two.landmarks)
    assert len(one.lines) == 4  # each wall once; corners come and go where walls are landmarks
    assert one.grid is two.grid is team.grid
    for member, pose in zip(team.members, true, strict=True):
        error = compose(inverse(pose), member.pose)
        assert np.hypot(*error[:2]) < 0.03
        assert member.pose_nees(pose) < 16
        assert member.health > 0.9
        assert len(member.key_scans) < 60  # a chain of its own: it does not leap from robot to robot
    cov = team.joint_cov()
    assert np.linalg.eigvalsh(cov).min() > -1e-12
    assert np.trace(team.members[1].pose_cov) < 0.01 * np.trace(rough)


def test_where_the_map_moves_all_robots_scans_move_along() -> None:
    team = JointEkf(2, CONFIG)
    starts = [np.zeros(3), compose(inverse(np.array([2.0, 2.0, 0.3])), np.array([4.0, 3.0, -1.2]))]
    team.reset(starts, np.tile(np.diag([0.05, 0.05, 0.01]) ** 2, (2, 1, 1)))
    rooms(team, 40, np.random.default_rng(2))
    member = team.members[1]
    assert not member._redraw_if_moved()
    before, revision = [m.key_scans.poses for m in team.members], team.grid.revision
    for mark, point in zip(member._book.marks, member._points, strict=True):  # the map moves by 0.1 m along x
        if mark[0] == LINE:
            point[1] += 0.1 * math.cos(point[0])
        else:
            point[0] += 0.1
    assert member._redraw_if_moved()
    assert team.grid.revision > revision
    for member, poses in zip(team.members, before, strict=True):
        assert len(poses) > 2
        want = np.tile([0.1, 0, 0], (len(poses), 1))
        np.testing.assert_allclose(member.key_scans.poses - poses, want, atol=0.02)
    assert not member._redraw_if_moved()


def test_common_landmarks_tie_robots_together() -> None:
    """Apart they are uncorrelated; the first common landmarks correlate them, and lower the worse one's error."""
    rng = np.random.default_rng(6)
    here, there = rng.uniform(-2, 2, (6, 2)), rng.uniform(-2, 2, (6, 2)) + np.array([10.0, 0.0])
    landmarks = np.vstack([here, there])
    before, after = [], []
    for _ in range(20):
        rough = np.diag([0.3**2, 0.3**2, 0.05**2])
        true = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
        team = JointEkf(2, CONFIG)
        team.reset([true[0], rng.multivariate_normal(true[1], rough)], [np.eye(3) * 1e-8, rough])
        for k in range(100):
            for i, member in enumerate(team.members):
                twist = np.array([-1.0 * i if k > 30 else 0.1, 0.0, 0.02])  # the second one comes over
                true[i], odometry = drive(true[i], twist, sigmas(twist), rng)
                member.predict(odometry)
                member.observe(observe_landmarks(true[i], landmarks, OFFSET, SEEN, rng, reach=4.0))
            if k == 30:
                assert np.all(team.joint_pose_cov()[:3, 3:] == 0.0)
                before.append(np.hypot(*(team.poses[1] - true[1])[:2]))
                wide = np.trace(team.members[1].pose_cov)
        assert np.linalg.norm(team.joint_pose_cov()[:3, 3:]) > 0.0
        assert np.linalg.eigvalsh(team.joint_cov()).min() > -1e-12
        assert np.trace(team.members[1].pose_cov) < 0.1 * wide
        after.append(np.hypot(*(team.poses[1] - true[1])[:2]))
    assert np.mean(after) < 0.5 * np.mean(before)


def test_robots_and_map_are_consistent() -> None:
    """30 runs of two robots among common landmarks: NEES of both and of the map within their 99.9 % bands."""
    rng, runs = np.random.default_rng(12), 30
    landmarks = np.array([[3.0, 3.0], [-3.0, 3.0], [-3.0, -3.0], [3.0, -3.0], [0.0, 4.0]])
    start_cov = np.array([np.diag([1e-4, 1e-4, 2.5e-5])] * 2)
    nees, of_map = np.zeros((runs, 2)), []
    for run in range(runs):
        begin = np.array([[0.0, 0.0, 0.0], [1.0, -1.0, 2.0]])
        true = np.array([rng.multivariate_normal(b, c) for b, c in zip(begin, start_cov, strict=True)])
        team = JointEkf(2, CONFIG)
        team.reset(begin, start_cov)
        for k in range(60):
            for i, member in enumerate(team.members):
                twist = circle_twist(k + 50 * i)
                true[i], odometry = drive(true[i], twist, sigmas(twist), rng)
                member.predict(odometry)
                member.observe(observe_landmarks(true[i], landmarks, OFFSET, SEEN, rng))
            if k % 10 == 0:
                z = see(true[0], true[1]) + rng.multivariate_normal(np.zeros(3), MET)
                team.members[0].see(1, z, MET)
        nees[run] = [nees_pose(m.pose, m.pose_cov, t) for m, t in zip(team.members, true, strict=True)]
        belief = team.members[0].belief
        error = (belief.landmarks - landmarks[belief.landmark_ids]).ravel()
        assert belief.joint_cov is not None
        of_map.append(error @ np.linalg.solve(belief.joint_cov[3:, 3:], error))
    low, high = nees_band(3, runs, confidence=0.999)
    assert np.all((low < nees.mean(axis=0) / 3) & (nees.mean(axis=0) / 3 < high))
    low, high = nees_band(10, runs, confidence=0.999)
    assert low < np.mean(of_map) / 10 < high


def test_what_others_saw_was_not_seen_lately() -> None:
    """Each robot's book has its own clock and its own last sightings; what a landmark is, all share."""
    team, rng = JointEkf(2, CONFIG), np.random.default_rng(1)
    landmarks = np.array([[2.0, 1.0], [2.0, -1.0]])
    for _ in range(3):
        team.members[0].observe(observe_landmarks(np.zeros(3), landmarks, OFFSET, SEEN, rng))
    one, two = (m._book for m in team.members)
    assert one.marks[:, 5].tolist() == [3.0, 3.0]
    team.members[1].observe(observe_landmarks(np.zeros(3), landmarks[:1], OFFSET, SEEN, rng))
    assert (one.now, two.now) == (3, 1)
    assert two.marks[:, 5].tolist() == [1.0, -np.inf]
    assert two.marks[:, 2].tolist() == [4.0, 3.0]
    _ = team.members[0].pose
    assert one.marks[:, 5].tolist() == [3.0, 3.0]
    team.members[0]._drop(0)
    _ = team.members[1].pose
    assert two.marks[:, 5].tolist() == [-np.inf]
    assert team.members[1].landmark_count == 1


def test_a_belief_is_of_when_it_was_given() -> None:
    team, rng = JointEkf(2, CONFIG), np.random.default_rng(1)
    team.reset([[0, 0, 0], [1, 0, 0]])
    member = team.members[0]
    member.observe(observe_landmarks(np.zeros(3), np.array([[2.0, 1.0]]), OFFSET, SEEN, rng))
    want, belief = member.joint_cov, member.belief
    team.members[1].predict(Odometry((0.5, 0.0, 0.3), 0.1))
    assert belief.joint_cov is not None
    np.testing.assert_array_equal(belief.joint_cov, want)
    np.testing.assert_array_equal(member.belief.joint_cov, want)


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 1 robot"):
        JointEkf(0)
    team = JointEkf(2)
    with pytest.raises(ValueError, match="start poses of 2 robots"):
        team.reset([[0, 0, 0]])
    with pytest.raises(ValueError, match="as many covariances"):
        team.reset(np.zeros((2, 3)), [np.eye(3)])
    with pytest.raises(ValueError, match="cannot see a robot 0"):
        team.members[0].see(0, np.zeros(3), np.eye(3))
    with pytest.raises(ValueError, match="three finite numbers"):
        team.members[0].see(1, [1.0, math.nan, 0.0], np.eye(3))
    with pytest.raises(RuntimeError, match=r"JointEkf\.reset"):
        team.members[1].reset()
