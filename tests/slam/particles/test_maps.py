"""One particle's landmarks: innovation, update and association."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given

from slam.geometry import wrap
from slam.landmarks.association import nearest_neighbour
from slam.particles.maps import ParticleMaps, associate, correct_landmark, innovation
from tests.slam.numerics import random_covariance
from tests.slam.particles.sights import (
    OFFSET,
    innovation_of,
    noise_of,
    predicted,
    random_sight,
    seeds,
    upper_terms,
)


@given(seeds)
def test_observation_jacobian_against_finite_differences(seed: int) -> None:
    state, _, _, z, _ = random_sight(seed)
    nu, h = innovation_of(state, z)
    values = innovation(state[:3], math.cos(state[2]), math.sin(state[2]), OFFSET, state[3], state[4], z)
    np.testing.assert_allclose(values[:2], nu, atol=1e-12)
    np.testing.assert_allclose(np.reshape(values[2:], (2, 3)), h[:, :3], atol=1e-5)
    np.testing.assert_allclose(-np.reshape(values[2:], (2, 3))[:, :2], h[:, 3:], atol=1e-5)


@given(seeds)
def test_landmark_update_against_the_filter_equations(seed: int) -> None:
    state, _, p_m, z, _ = random_sight(seed)
    nu, h = innovation_of(state, z)
    gain = p_m @ h[:, 3:].T @ np.linalg.inv(h[:, 3:] @ p_m @ h[:, 3:].T + noise_of(z))
    record = np.array([*state[3:], *upper_terms(p_m)])
    correct_landmark(state[:3], math.cos(state[2]), math.sin(state[2]), OFFSET, z, record, record)  # in place
    np.testing.assert_allclose(record[:2], state[3:] + gain @ nu, atol=1e-6)
    np.testing.assert_allclose(record[2:], upper_terms(p_m - gain @ h[:, 3:] @ p_m), atol=1e-7)


@given(seeds)
def test_association_is_that_of_the_joint_filter_without_correlations(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, m = 12, 6
    marks = np.zeros((n, 8))
    marks[:, 0], marks[:, 1] = rng.choice([-1.0, 0.0, 1.0], n), rng.uniform(-math.pi, math.pi, n)
    marks[:, 6] = rng.choice([-1.0, 0.0], n)
    x, p = np.concatenate([rng.uniform(-2, 2, 3), rng.uniform(-3, 3, 2 * n)]), np.zeros((3 + 2 * n, 3 + 2 * n))
    p[:3, :3] = random_covariance(3, rng, 0.002)
    maps = ParticleMaps(2)
    z = np.zeros((m, 8))
    for i in range(n):
        p[3 + 2 * i : 5 + 2 * i, 3 + 2 * i : 5 + 2 * i] = cov = random_covariance(2, rng, 0.003)
        maps.add(np.zeros((2, 3)), z[0], 0.0)
        maps.records[maps.table[:, i]] = [*x[3 + 2 * i : 5 + 2 * i], *upper_terms(cov)]
    for k in range(m):
        i = int(rng.integers(n))
        z[k, :2] = predicted(np.concatenate([x[:3], x[3 + 2 * i : 5 + 2 * i]])) + rng.normal(0, 0.1, 2)
        z[k, 2:5] = upper_terms(random_covariance(2, rng, 0.002))
        z[k, 5:8] = marks[i, 0], wrap(marks[i, 1] - x[2] + rng.normal(0, 0.4)), rng.choice([-1.0, 0.0])
    maps.extents[:n] = np.repeat(x[3:].reshape(n, 2), 2, axis=1)
    want, distance = np.zeros(m, np.int64), np.zeros(m)
    nearest_neighbour(x, np.triu(p), OFFSET, z, marks, 11.8, 0.2, 0.6, False, want, distance)
    match, covs = np.zeros((2, m), np.int64), np.repeat(np.triu(p[:3, :3])[None], 2, axis=0)
    leader = associate(
        np.repeat(x[None, :3], 2, axis=0), covs, OFFSET, z, marks, 11.8, 0.2, 0.6, maps.table, maps.records,
        maps.extents, match,
    )  # fmt: skip
    assert leader == 0
    np.testing.assert_array_equal(match, [want, want])
