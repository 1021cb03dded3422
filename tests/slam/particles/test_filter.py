"""The arithmetic of one particle: proposal, weight, draws."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given

from slam.geometry import wrap
from slam.particles.filter import draw, narrow
from tests.slam.numerics import random_covariance
from tests.slam.particles.sights import OFFSET, innovation_of, noise_of, random_sight, seeds, upper_terms


@given(seeds)
def test_proposal_and_weight_of_one_landmark_against_direct_computation(seed: int) -> None:
    """The pose's Gaussian given z, p(x | z, u, the path so far), and the likelihood p(z | the path so far)."""
    state, p, p_m, z, _ = random_sight(seed)
    nu, h = innovation_of(state, z)
    h_x, h_m = h[:, :3], h[:, 3:]
    rest = h_m @ p_m @ h_m.T + noise_of(z)
    s = h_x @ p @ h_x.T + rest
    want_cov = np.linalg.inv(np.linalg.inv(p) + h_x.T @ np.linalg.inv(rest) @ h_x)
    want_mean = state[:3] + want_cov @ h_x.T @ np.linalg.solve(rest, nu)
    want_log = -0.5 * (nu @ np.linalg.solve(s, nu) + np.linalg.slogdet(2 * math.pi * s)[1])
    pose, cov = state[:3].copy(), np.triu(p)
    records, table = np.array([[*state[3:], *upper_terms(p_m)]]), np.array([0])
    log_likelihood = narrow(pose, cov, records, table, z[None], np.array([0]), OFFSET, 0.0)
    assert log_likelihood == pytest.approx(want_log, abs=1e-4)
    difference = pose - want_mean
    difference[2] = wrap(difference[2])
    np.testing.assert_allclose(difference, 0, atol=1e-5)
    np.testing.assert_allclose(np.triu(cov), np.triu(want_cov), atol=1e-6)
    # Where the pose is known, only the landmark and the sensor are left to be uncertain.
    want_log = -0.5 * (nu @ np.linalg.solve(rest, nu) + np.linalg.slogdet(2 * math.pi * rest)[1])
    pose, nothing = state[:3].copy(), np.zeros((3, 3))
    assert narrow(pose, nothing, records, table, z[None], np.array([0]), OFFSET, 0.0) == pytest.approx(
        want_log, abs=1e-4
    )
    np.testing.assert_array_equal(pose, state[:3])


def test_an_unexplained_observation_weighs_as_one_at_the_given_distance() -> None:
    _, _, _, z, _ = random_sight(1)
    pose = np.zeros(3)
    got = narrow(pose, np.zeros((3, 3)), np.zeros((1, 5)), np.array([0]), z[None], np.array([-1]), OFFSET, 9.0)
    assert got == pytest.approx(-0.5 * (9.0 + np.linalg.slogdet(2 * math.pi * noise_of(z))[1]))


@given(seeds)
def test_poses_are_drawn_with_their_covariance(seed: int) -> None:
    """The draws of the three unit vectors are the columns of a root of P."""
    p = random_covariance(3, np.random.default_rng(seed))
    root = []
    for unit in np.eye(3):
        pose, cov = np.zeros(3), np.triu(p)
        draw(pose, cov, unit)
        root.append(pose)
        assert not cov.any()
    np.testing.assert_allclose(np.transpose(root) @ root, p, atol=1e-12)


def test_drawing_from_a_singular_covariance_adds_nothing_where_there_is_none() -> None:
    pose, normal = np.zeros(3), np.array([1.0, 2.0, 3.0])
    draw(pose, np.diag([0.0, -1e-20, 0.04]), normal)
    np.testing.assert_allclose(pose, [0, 0, 0.6])
    way = np.array([1.0, 2.0, 0.5])  # of rank one
    draw(pose := np.zeros(3), np.triu(np.outer(way, way)), normal)
    np.testing.assert_allclose(pose, way, atol=1e-7)
