"""Walls that their sightings contradict are dropped, and no others."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import slam
from slam.landmarks.book import MARKS, LandmarkPolicy
from slam.landmarks.contradicted import DOUBT, doubt
from slam.types import LINE

Array = NDArray[np.float64]

WALL = np.array([0.5 * np.pi, 2.0])  # α, r: the line y = 2
P = np.diag([1e-8, 1e-8, 1e-8, 1e-6, 1e-6])
SIGMAS = np.array([0.01, 0.005])  # of distance and bearing


def sighting(rng: np.random.Generator, off: float) -> Array:
    """Return the row of a wall seen from the origin, turned by so many σ of its bearing."""
    z = np.zeros((1, 12))
    z[0, :2] = WALL[1] + SIGMAS[0] * rng.standard_normal(), WALL[0] + SIGMAS[1] * (rng.standard_normal() + off)
    z[0, [2, 4]], z[0, 5] = SIGMAS**2, LINE
    return z


def highest(seed: int, off: float, scans: int) -> float:
    rng, marks, most = np.random.default_rng(seed), np.zeros((1, MARKS)), 0.0
    for _ in range(scans):
        doubt(np.concatenate([np.zeros(3), WALL]), P, 0.0, sighting(rng, off), np.zeros(1, np.int64), marks)
        most = max(most, float(marks[0, DOUBT]))
    return most


def test_noise_as_declared_leaves_no_doubt() -> None:
    assert max(highest(seed, 0.0, 3000) for seed in range(5)) < LandmarkPolicy().contradicted_after


def test_a_wall_that_is_two_is_found_out() -> None:
    """Off by two σ each time it passes every gate, and is found out within a hundred scans."""
    assert min(highest(seed, 2.0, 100) for seed in range(5)) > LandmarkPolicy().contradicted_after


def test_one_sighting_says_little() -> None:
    assert highest(0, 50.0, 1) < LandmarkPolicy().contradicted_after


def test_a_wall_beyond_doubt_is_dropped_and_found_anew() -> None:
    """Two walls at right angles, seen again and again, one of them not where the filter has it."""
    backend = slam.make("ekf-lines", config={"lidar_offset_m": 0.0})
    backend.reset(np.zeros(3))
    z = np.vstack([sighting(np.random.default_rng(1), 0.0), sighting(np.random.default_rng(2), 0.0)])
    z[1, 1] = 0.0
    z[:, 8:] = -1.0, 1.0, 0.0, 1.0  # from, to, curvature, its variance
    backend._take(z, None)
    backend._take(z, None)
    first = backend._book.ids.tolist()
    assert len(first) == 2
    backend._book.marks[1, DOUBT] = 100.0
    backend._take(z, None)
    assert backend._book.ids.tolist() == first[:1], "the other wall stays"
    backend._take(z, None)
    backend._take(z, None)
    assert backend._book.count == 2 and backend._book.ids[1] not in first
