"""Walls that their sightings contradict are dropped, and no others; errors that last are told from noise."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

import slam
from slam.landmarks.book import MARKS, LandmarkPolicy
from slam.landmarks.wall_evidence import DOUBT, lasting_factor, take_back, take_evidence
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


X = np.concatenate([np.zeros(3), WALL])
FIRST = np.zeros(1, np.int64)  # the match of one observation with the only landmark


def highest(seed: int, off: float, scans: int) -> float:
    rng, marks, most = np.random.default_rng(seed), np.zeros((1, MARKS)), 0.0
    for _ in range(scans):
        take_evidence(X, P, 0.0, sighting(rng, off), FIRST, marks, 0, np.zeros(2))
        most = max(most, float(marks[0, DOUBT]))
    return most


def factor_after(seed: int, share: float, scans: int, lasting: int = 16) -> float:
    """Return what walls whose noise has that share of its variance in common for so many scans come to."""
    rng, marks, products, walls = np.random.default_rng(seed), np.zeros((8, MARKS)), np.zeros(2), np.arange(8)
    x, p, off = np.concatenate([np.zeros(3), *[WALL] * 8]), np.zeros((19, 19)), np.zeros(8)
    for now in range(scans):
        off = np.where((now + 2 * walls) % lasting == 0, rng.standard_normal(8), off)
        z = np.vstack([sighting(rng, 0.0) for _ in walls])
        z[:, 1] = WALL[0] + np.sqrt(1.0 - share) * (z[:, 1] - WALL[0]) + np.sqrt(share) * SIGMAS[1] * off
        given, factor = z.copy(), lasting_factor(products)
        take_evidence(x, p, 0.0, z, walls, marks, now, products)
        np.testing.assert_allclose(z[:, 2:5], factor * given[:, 2:5])
        marks[:, 5] = now
    return float(lasting_factor(products))


def test_white_noise_is_left_as_it_is() -> None:
    assert sum(factor_after(seed, 0.0, 600) > 1.0 for seed in range(20)) <= 1


def test_what_pieces_of_a_wall_share_in_one_scan_does_not_last() -> None:
    """Three pieces of each wall, whose errors are mostly that of the pose: as white as one."""

    def factor(seed: int) -> float:
        rng, marks, products = np.random.default_rng(seed), np.zeros((8, MARKS)), np.zeros(2)
        x, p, match = np.concatenate([np.zeros(3), *[WALL] * 8]), np.zeros((19, 19)), np.repeat(np.arange(8), 3)
        for now in range(300):
            z = np.vstack([sighting(rng, 0.0) for _ in match])
            pose = SIGMAS[1] * np.repeat(rng.standard_normal(8), 3)
            z[:, 1] = WALL[0] + np.sqrt(0.3) * (z[:, 1] - WALL[0]) + np.sqrt(0.7) * pose
            take_evidence(x, p, 0.0, z, match, marks, now, products)
            marks[:, 5] = now
        return float(lasting_factor(products))

    assert sum(factor(seed) > 1.0 for seed in range(20)) <= 1


@pytest.mark.parametrize("share", [0.05, 0.15, 0.3])
def test_errors_that_last_count_as_often_as_they_do(share: float) -> None:
    """The mean of 16 scans with a share s of their variance in common is 1 + 15 s times as uncertain."""
    factors = [factor_after(seed, share, 1500) for seed in range(5)]
    assert np.mean(factors) == pytest.approx(1.0 + 15.0 * share, rel=0.25)


def test_a_wall_not_seen_for_long_begins_anew() -> None:
    rng, marks, products = np.random.default_rng(0), np.zeros((1, MARKS)), np.zeros(2)
    for now in range(0, 200, 20):
        take_evidence(X, P, 0.0, sighting(rng, 2.0), FIRST, marks, now, products)
        marks[0, 5] = now
    assert products[1] == 1.0  # the first: a landmark is as old as its sighting


def test_evidence_of_a_match_that_does_not_stand_is_taken_back() -> None:
    rng, marks, products = np.random.default_rng(0), np.zeros((1, MARKS)), np.array([3.0, 400.0])
    take_evidence(X, P, 0.0, sighting(rng, 1.0), FIRST, marks, 0, products)
    kept, sums = marks.copy(), products.copy()
    before = take_evidence(X, P, 0.0, sighting(rng, 4.0), FIRST, marks, 0, products)
    assert np.any(marks != kept) and np.any(products != sums)
    take_back(before, marks, products)
    np.testing.assert_array_equal(marks, kept)
    np.testing.assert_array_equal(products, sums)


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
