"""The right-invariant filter: retraction and reset against dense matrices, and what a correction must not do."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import slam
from slam import Odometry
from slam.gaussian.stacked_update import NO_LIMITS, stacked_update, work_space
from slam.geometry import compose, exp, wrap
from slam.invariant import invariant_update
from slam.metrics.measures import nees_band
from tests.slam.numerics import random_covariance
from tests.slam.simulated import drive, observe_landmarks

OFFSET = 0.2
J = np.array([[0.0, -1.0], [1.0, 0.0]])
seeds = st.integers(0, 10_000)


def turn(t: float) -> np.ndarray:
    return np.array([[math.cos(t), -math.sin(t)], [math.sin(t), math.cos(t)]])


def v_of(t: float) -> np.ndarray:
    """V(t) by its integral: the mean of the rotations from 0 to t."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    return sum(0.5 * w * turn(0.5 * t * (1.0 + a)) for a, w in zip(nodes, weights, strict=True))


def coordinates(x: np.ndarray) -> np.ndarray:
    """T(x) of the invariant filter: invariant error coordinates to ordinary ones."""
    out = np.eye(len(x))
    out[:2, 2] = J @ x[:2]
    for i in range(3, len(x), 2):
        out[i : i + 2, 2] = J @ x[i : i + 2]
    return out


def world(seed: int, landmarks: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    x = np.concatenate([rng.uniform(-3, 3, 3), rng.uniform(3, 6, 2 * landmarks)])
    z = np.zeros((landmarks, 8))
    z[:, 0], z[:, 1] = rng.uniform(3, 8, landmarks), rng.uniform(-3, 3, landmarks)
    z[:, 2], z[:, 4] = 0.01, 0.01
    return x, 0.05 * random_covariance(len(x), rng), z


def run(update, x: np.ndarray, p: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    n = len(x)
    x, p = x.copy(), np.triu(p)
    match = np.arange(len(z))
    work = work_space(len(z), n)
    if update is invariant_update:
        work = (np.zeros(((n - 3) // 2, 8)), *work, np.zeros(n))
    _, nis = update(x, p, n, z, match, OFFSET, *work, NO_LIMITS)
    return x, np.triu(p) + np.triu(p, 1).T, nis


@given(seeds, st.integers(1, 4))
def test_update_is_the_standard_gain_with_retraction_and_reset(seed: int, landmarks: int) -> None:
    x, p, z = world(seed, landmarks)
    plain_x, plain_p, plain_nis = run(stacked_update, x, p, z)
    got_x, got_p, nis = run(invariant_update, x, p, z)
    assert nis == pytest.approx(plain_nis)
    delta = plain_x - x
    t = float(wrap(delta[2]))
    want = x.copy()
    want[2] = wrap(x[2] + t)
    for i in (0, *range(3, len(x), 2)):
        want[i : i + 2] = turn(t) @ x[i : i + 2] + v_of(t) @ (delta[i : i + 2] - J @ x[i : i + 2] * t)
    if abs(delta[2]) < math.pi:  # the standard update wraps what it adds
        np.testing.assert_allclose(got_x, want, atol=1e-9)
        gamma = coordinates(want) @ np.linalg.inv(coordinates(x))
        np.testing.assert_allclose(got_p, gamma @ plain_p @ gamma.T, atol=1e-9)


def test_turning_the_whole_map_keeps_its_shape() -> None:
    """What is uncertain is the heading of everything about the origin; a correction may turn, but not bend it."""
    x = np.array([2.0, 1.0, 0.3, 4.0, 1.0, 3.0, -2.0, 9.0, 9.0])
    rigid = np.concatenate([J @ x[:2], [1.0], J @ x[3:5], J @ x[5:7], [0.0, 0.0]])
    p = 0.3**2 * np.outer(rigid, rigid) + 1e-12 * np.eye(9)
    z = np.zeros((1, 8))
    z[0, :5] = 10.2, 0.35, 1e-4, 0.0, 1e-4  # of the landmark that is known: a compass

    def shape(v: np.ndarray) -> np.ndarray:
        points = np.array([v[:2], v[3:5], v[5:7], [0.0, 0.0]])
        return np.linalg.norm(points[:, None] - points[None], axis=2)

    def update(kernel) -> np.ndarray:
        state, cov = x.copy(), np.triu(p)
        work = work_space(1, 9)
        if kernel is invariant_update:
            work = (np.zeros((3, 8)), *work, np.zeros(9))
        kernel(state, cov, 9, z, np.array([2]), OFFSET, *work, NO_LIMITS)
        return state

    turned = update(invariant_update)
    assert abs(turned[2] - x[2]) > 0.05
    np.testing.assert_allclose(shape(turned), shape(x), atol=1e-6)
    assert np.abs(shape(update(stacked_update)) - shape(x)).max() > 0.005  # the standard filter bends it


def test_consistent_where_the_standard_filter_is_not() -> None:
    """20 runs round a circle with a heading that nothing tells: average NEES/3 at the end (seeds 0-19)."""
    runs, steps = 20, 250
    cov = np.diag([0.1**2, 0.05**2])
    last: dict[str, list[float]] = {"ekf": [], "invariant-ekf": []}
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        angles, radii = rng.uniform(0, 2 * math.pi, 20), rng.uniform(1.0, 6.0, 20)
        landmarks = np.column_stack([radii * np.cos(angles), 3.0 + radii * np.sin(angles)])
        noise = {"speed_floor_m_s": 0.03, "turn_floor_rad_s": 0.03, "speed_share": 0.0, "turn_share_rad_m": 0.0}
        config = {"lidar_offset_m": OFFSET, "odometry": noise | {"slip_share": 0.0}}
        backends = {name: slam.make(name, config=config) for name in last}
        for backend in backends.values():
            backend.reset()
        pose = np.zeros(3)
        for k in range(steps):
            pose, odometry = drive(pose, np.array([0.25, 0.0, 0.25 / 3.0]), (0.03, 0.03), rng, dt=1.0)
            seen = observe_landmarks(pose, landmarks, OFFSET, cov, rng, reach=5.0)
            for name, backend in backends.items():
                backend.predict(Odometry(odometry.twist, 1.0))
                backend.observe(seen)
                if k >= steps - 50:
                    last[name].append(backend.pose_nees(pose))
    low, high = nees_band(3, runs, confidence=0.99)
    average = {name: float(np.mean(values)) / 3 for name, values in last.items()}
    assert low < average["invariant-ekf"] < high
    assert average["ekf"] > high


def test_invariant_nees_belongs_to_the_backend() -> None:
    backend = slam.make("invariant-ekf")
    backend.reset((3.0, -1.0, 0.5), pose_cov=np.diag([0.04, 0.04, 0.09]))
    truth = compose(exp(np.array([0.1, 0.2, 0.3])), np.array([3.0, -1.0, 0.5]))
    xi = np.array([0.1, 0.2, 0.3])  # Exp(ξ) x̂ is the truth, and exp here is Exp
    cov_xi = (
        np.linalg.inv(coordinates(backend.pose)) @ backend.pose_cov @ np.linalg.inv(coordinates(backend.pose)).T
    )
    assert backend.pose_nees(truth) == pytest.approx(xi @ np.linalg.solve(cov_xi, xi), rel=1e-6)
