"""Walls that stand square are held against one another, and no others."""

from __future__ import annotations

import math

import gymnasium
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import agents
from slam.features.extraction import FeatureConfig
from slam.gaussian.companions import Companions
from slam.gaussian.lanes import aligned_zeros
from slam.gaussian.stacked_update import whiten_difference, work_space
from slam.geometry import wrap
from slam.invariant import apply
from slam.landmarks.book import MARKS
from slam.landmarks.curved_walls import curvature_model
from slam.landmarks.right_angles import REFERENCE, SQUARE, find_square
from slam.types import LINE

Array = NDArray[np.float64]

MODEL = curvature_model(FeatureConfig())
NOW, SIGMA, SURE = 50, 0.001, 0.0005
BEND = 8  # column of marks: information of a wall's curvature, then the same times the curvature


def room(angles: list[float], *, sigma: float = SURE) -> tuple[Array, Array, Array]:
    """Return state, covariance and marks of walls in these directions [rad], all of them just seen."""
    n = len(angles)
    x, p, marks = np.zeros(3 + 2 * n), np.zeros((3 + 2 * n, 3 + 2 * n)), np.zeros((n, MARKS))
    x[3::2] = wrap(np.array(angles))
    p[np.arange(3 + 2 * n), np.arange(3 + 2 * n)] = sigma**2
    marks[:, 0], marks[:, 2], marks[:, 5], marks[:, 7], marks[:, BEND] = LINE, 20.0, NOW, 3.0, 1e6
    return x, p, marks


def squared(x: Array, p: Array, marks: Array) -> list[tuple[int, int]]:
    """Return which walls are held against which, one after the other."""
    out = []
    while (found := find_square(x, p, marks, NOW, SIGMA, MODEL))[0] >= 0:
        out.append(found[:2])
    return out


SQUARE_ROOM = [0.3, 0.3 + 0.5 * math.pi, 0.3 - math.pi, 0.3 - 0.5 * math.pi]


def test_walls_of_a_square_room_are_held_against_the_first() -> None:
    x, p, marks = room(SQUARE_ROOM)
    assert squared(x, p, marks) == [(1, 0), (2, 0), (3, 0)]
    assert marks[:, SQUARE].tolist() == [REFERENCE, 1.0, 1.0, 1.0]
    assert squared(x, p, marks) == []


@pytest.mark.parametrize("askew", [0.01, 0.1, 0.5 * math.pi / 3])
def test_a_wall_askew_is_left_alone_wherever_it_stands(askew: float) -> None:
    for place in range(5):
        angles = [*SQUARE_ROOM, *SQUARE_ROOM]
        angles.insert(place, 0.3 + askew)
        assert place not in {wall for pair in squared(*room(angles)) for wall in pair}


@pytest.mark.parametrize("angles", [[0.0, 1.0, 2.1, 0.4, 2.7, -1.2], [k * math.pi / 3 for k in range(6)]])
def test_where_walls_do_not_stand_square_none_is_held(angles: list[float]) -> None:
    assert squared(*room(angles)) == []


def test_what_does_not_count() -> None:
    for column, value in ((0, 0.0), (2, 7.0), (5, NOW - 1.0), (7, 0.5), (BEND + 1, 3e4)):  # 0.03/m over 3 m
        x, p, marks = room([*SQUARE_ROOM, *SQUARE_ROOM])
        marks[4, column] = value
        assert 4 not in {wall for pair in squared(x, p, marks) for wall in pair}, column


def test_a_place_whose_direction_nobody_knows_is_left_alone() -> None:
    """The far walls agree with each other, and are known against the near ones to 5 mrad, then to 20."""
    for sigma, expected in ((0.005, [4, 5, 6, 7]), (0.02, [])):
        x, p, marks = room([*SQUARE_ROOM, *(a + 0.004 for a in SQUARE_ROOM)])
        marks[:4, 5] = NOW - 10.0
        marks[0, SQUARE] = REFERENCE
        far = np.arange(11, 19, 2)
        p[np.ix_(far, far)] += np.triu(np.full((4, 4), sigma**2))
        assert [wall for wall, _ in squared(x, p, marks)] == expected


@given(st.integers(0, 10**6))
def test_a_difference_is_a_correction_like_any_other(seed: int) -> None:
    """Against the plain formulas, states beside the map included."""
    rng = np.random.default_rng(seed)
    n, k = 3 + 2 * int(rng.integers(2, 8)), 3
    i, j = (3 + 2 * int(v) for v in rng.choice((n - 3) // 2, 2, replace=False))
    root = rng.standard_normal((n + k, n + k))
    whole, nu, variance = root @ root.T, float(rng.standard_normal()), 0.5
    p = aligned_zeros(n, n)
    p[:, :n] = np.triu(whole[:n, :n])
    beside = Companions(4, n, whole[n:, n:].copy())
    beside.cross[:, :n] = whole[n:, :n]
    _, w, s = work_space(4, n)
    assert whiten_difference(p, n, i, j, nu, variance, w, s) == 2
    beside.correct_difference(n, i, j, w, s)
    h = np.zeros(n + k)
    h[i], h[j] = 1.0, -1.0
    gain = whole @ h / (h @ whole @ h + variance)
    after = whole - np.outer(gain, h @ whole)
    np.testing.assert_allclose(w[:2, :n].T @ s[:2, 2], nu * gain[:n], atol=1e-9)
    np.testing.assert_allclose(np.triu(p[:, :n] - w[:2, :n].T @ w[:2, :n]), np.triu(after[:n, :n]), atol=1e-9)
    np.testing.assert_allclose(beside.mean, nu * gain[n:], atol=1e-9)
    np.testing.assert_allclose(beside.cov, after[n:, n:], atol=1e-9)
    np.testing.assert_allclose(beside.cross[:, :n], after[n:, :n], atol=1e-9)


def test_the_invariant_filter_takes_directions_as_they_are() -> None:
    """Angles keep their coordinates, whatever turns with them: what is known of them adds up."""
    x, p, marks = room(SQUARE_ROOM, sigma=0.01)
    x[3] += 0.02
    size = len(x)
    _, w, s = work_space(4, size)
    aligned = aligned_zeros(size, size)
    aligned[:, :size] = p
    whiten_difference(aligned, size, 3, 7, -0.02, SIGMA**2, w, s)
    apply(x, aligned, size, 2, marks, w, s, np.zeros(size))
    before, after = 2 * 0.01**2, aligned[3, 3] + aligned[7, 7] - 2 * aligned[3, 7]
    assert after == pytest.approx(1.0 / (1.0 / before + 1.0 / SIGMA**2), rel=1e-6)
    off = float(wrap(np.array([x[3] - x[7] - math.pi]))[0])
    assert off == pytest.approx(0.02 * SIGMA**2 / (before + SIGMA**2), rel=1e-6)


@pytest.mark.parametrize(("rooms", "most"), [("apartment", True), ("cave", False)])
def test_in_rooms_most_walls_are_held_and_in_caves_none(rooms: str, most: bool) -> None:
    env = gymnasium.make(
        "mecanum_env/Explore-v0", rooms=rooms, config={"slam_config": {"right_angle_sigma_rad": SIGMA}}
    )
    world, agent = env.unwrapped, agents.make("brisk-tour")
    observation, _ = env.reset(seed=3)
    agent.reset(world.belief, seed=3)
    for _ in range(250):
        observation, *_ = env.step(agent.act(observation, world.belief))
    marks, walls = world.backend._book.marks, world.backend._points
    held = marks[:, SQUARE] > 0.0
    if not most:
        assert not held.any()
        return
    often = (marks[:, 0] == LINE) & (marks[:, 2] > 20.0) & (marks[:, 7] - marks[:, 6] > 1.0)
    assert held.sum() > 8 and held[often].mean() > 0.7
    off = walls[held, 0] - walls[held, 0][0]
    assert np.abs(off - 0.5 * math.pi * np.round(off / (0.5 * math.pi))).max() < 0.003
