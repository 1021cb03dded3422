"""Sights of a landmark from a pose, drawn at random, and their innovation, from the geometry once more."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import strategies as st

from slam.geometry import wrap
from tests.slam.numerics import numerical_jacobian, random_covariance

OFFSET = 0.2
seeds = st.integers(0, 10_000)


def predicted(state: np.ndarray) -> np.ndarray:
    """h of docs/reference/ekf.md for x, y, θ, xi, yi, written down once more from the geometry."""
    x, y, theta = state[:3]
    d = state[3:5] - np.array([x + OFFSET * math.cos(theta), y + OFFSET * math.sin(theta)])
    return np.array([np.hypot(*d), float(wrap(math.atan2(d[1], d[0]) - theta))])


def upper_terms(cov: np.ndarray) -> list[float]:
    return [cov[0, 0], cov[0, 1], cov[1, 1]]


def random_sight(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.random.Generator]:
    """Return pose and landmark, their covariances, and an observation row some sigmas off."""
    rng = np.random.default_rng(seed)
    state = np.concatenate([rng.uniform(-3, 3, 3), rng.uniform(-6, 6, 2)])
    while predicted(state)[0] < 0.5:
        state[3:] = rng.uniform(-6, 6, 2)
    r = random_covariance(2, rng, 0.001)
    z = np.concatenate([predicted(state) + rng.normal(0, 0.05, 2), upper_terms(r), [0.0, 0.0, 0.0]])
    return state, random_covariance(3, rng), random_covariance(2, rng), z, rng


def noise_of(z: np.ndarray) -> np.ndarray:
    return np.array([[z[2], z[3]], [z[3], z[4]]])


def innovation_of(state: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ν and H ``(2, 5)``, by finite differences."""
    nu = z[:2] - predicted(state)
    nu[1] = wrap(nu[1])
    return nu, numerical_jacobian(predicted, state, angle=1)
