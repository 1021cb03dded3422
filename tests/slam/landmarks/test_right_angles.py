"""Walls that stand square are held against the building's direction, and no others."""

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
from slam.landmarks.right_angles import HELD, HELD_ALONE, SQUARE, find_square
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


def squared(x: Array, p: Array, marks: Array, direction: int = -1) -> list[int]:
    """Return which walls are held against the direction of one, the first that counts if not told which."""
    out: list[int] = []
    while True:
        known = direction >= 0
        i = 3 + 2 * max(direction, 0)
        cross = np.concatenate([p[:i, i], p[i, i:]])
        of_direction = (x[i], (p[i, i] + SIGMA**2) * known, cross * known)
        wall, _, own, first = find_square(x, p, marks, NOW, SIGMA, MODEL, *of_direction, known)
        if wall < 0:
            return out
        assert own == SIGMA and first == (not known)
        out.append(wall)
        direction = direction if known else wall


def alone(length: float, *, direction: float, sigma: float, sure: bool = False) -> tuple[int, float, float, bool]:
    """Ask about the only wall, of direction 0, the building's being known to ``sigma``; 0: unknown."""
    x, p, marks = room([0.0])
    marks[0, 7] = length
    return find_square(x, p, marks, NOW, SIGMA, MODEL, direction, sigma**2, np.zeros(len(x)), sure)


SQUARE_ROOM = [0.3, 0.3 + 0.5 * math.pi, 0.3 - math.pi, 0.3 - 0.5 * math.pi]


def test_walls_of_a_square_room_are_held_once() -> None:
    x, p, marks = room(SQUARE_ROOM)
    assert squared(x, p, marks) == [0, 1, 2, 3]
    assert marks[:, SQUARE].tolist() == [HELD] * 4
    assert squared(x, p, marks) == []


@pytest.mark.parametrize("askew", [0.01, 0.1, 0.5 * math.pi / 3])
def test_a_wall_askew_is_left_alone_wherever_it_stands(askew: float) -> None:
    for place in range(5):
        angles = [*SQUARE_ROOM, *SQUARE_ROOM]
        angles.insert(place, 0.3 + askew)
        assert place not in squared(*room(angles))


@pytest.mark.parametrize("angles", [[0.0, 1.0, 2.1, 0.4, 2.7, -1.2], [k * math.pi / 3 for k in range(6)]])
def test_where_walls_do_not_stand_square_none_is_held(angles: list[float]) -> None:
    assert squared(*room(angles)) == []


def test_what_does_not_count() -> None:
    for column, value in ((0, 0.0), (2, 7.0), (5, NOW - 1.0), (7, 0.5), (BEND + 1, 3e4)):  # 0.03/m over 3 m
        x, p, marks = room([*SQUARE_ROOM, *SQUARE_ROOM])
        marks[4, column] = value
        assert 4 not in squared(x, p, marks), column


def test_a_place_whose_direction_nobody_knows_is_left_alone() -> None:
    """The far walls agree with each other, and are known against the near ones to 5 mrad, then to 50."""
    for sigma, expected in ((0.005, [4, 5, 6, 7]), (0.05, [])):
        x, p, marks = room([*SQUARE_ROOM, *(a + 0.004 for a in SQUARE_ROOM)])
        marks[:4, 5] = NOW - 10.0
        far = np.arange(11, 19, 2)
        p[np.ix_(far, far)] += np.triu(np.full((4, 4), sigma**2))
        assert squared(x, p, marks, direction=0) == expected


def test_a_very_long_wall_counts_alone_where_nothing_else_tells() -> None:
    for length, sigma, direction, expected in (
        (20.0, 0.02, 0.03, (0, False)),  # the direction is lost: any wall that fits tells
        (20.0, 0.02, 0.05, (-1, False)),  # it does not fit
        (20.0, 0.005, 0.003, (-1, False)),  # the direction is better known than such a wall is square
        (4.0, 0.02, 0.03, (-1, False)),  # not long enough
        (20.0, 0.0, 0.0, (0, True)),  # the first one
        (4.0, 0.0, 0.0, (-1, False)),
    ):
        wall, off, own, first = alone(length, direction=direction, sigma=sigma)
        assert (wall, first) == expected
        if wall == 0:
            assert own == 3.0 * SIGMA and off == pytest.approx(-direction)


def test_a_direction_from_a_wall_alone_gives_way_to_that_of_most_where_these_do_not_bear_it_out() -> None:
    for sure, direction, expected in (
        (False, 0.4, (0, SIGMA, True)), (True, 0.4, (-1, 0.0, False)), (False, 0.301, (0, SIGMA, False)),
    ):  # fmt: skip
        x, p, marks = room(SQUARE_ROOM)
        known = direction, 0.003**2, np.zeros(len(x))
        wall, _, own, first = find_square(x, p, marks, NOW, SIGMA, MODEL, *known, sure)
        assert (wall, own, first) == expected


def test_a_wall_held_alone_is_held_once_more_when_most_bear_it_out() -> None:
    x, p, marks = room([*SQUARE_ROOM, *SQUARE_ROOM])
    marks[:, 7] = 20.0
    marks[2, SQUARE] = HELD_ALONE
    assert squared(x, p, marks) == list(range(8))
    x, p, marks = room([0.0])
    marks[0, 7], marks[0, SQUARE] = 20.0, HELD_ALONE
    assert find_square(x, p, marks, NOW, SIGMA, MODEL, 0.01, 0.02**2, np.zeros(len(x)), False)[0] < 0


def test_most_are_two_thirds_of_the_others_that_are_well_known_and_three_at_least() -> None:
    eight, askew = [*SQUARE_ROOM, *SQUARE_ROOM], [0.3 + 0.03 * k for k in range(1, 6)]
    assert squared(*room([*eight, *askew[:3]])) == list(range(8))
    assert squared(*room([*eight, *askew])) == []
    assert squared(*room(SQUARE_ROOM[:3])) == []
    x, p, marks = room(SQUARE_ROOM)
    marks[3, 2] = 5.0  # sightings: too few to tell of the others
    assert squared(x, p, marks) == []
    x, p, marks = room(SQUARE_ROOM, sigma=0.004)  # none of the others is well known
    assert squared(x, p, marks) == []


def test_walls_may_err_as_they_are_said_to() -> None:
    askew = np.array([1.2, -1.2, 1.2, -1.2]) * SIGMA
    assert squared(*room(list(SQUARE_ROOM + askew), sigma=0.1 * SIGMA)) == [0, 1, 2, 3]


def test_what_all_share_tells_nothing_of_a_wall_and_the_direction() -> None:
    """The heading is lost since the start, but the walls are known well among themselves: these do not fit."""
    x, p, marks = room([*SQUARE_ROOM, *(a + 0.004 for a in SQUARE_ROOM)])
    marks[:4, 5] = NOW - 10.0
    directions = np.arange(3, 19, 2)
    p[np.ix_(directions, directions)] += np.triu(np.full((8, 8), 0.02**2))
    assert squared(x, p, marks, direction=0) == []


@given(st.integers(0, 10**6))
def test_a_wall_held_against_the_direction_is_a_correction_like_any_other(seed: int) -> None:
    """Against the plain formulas: the direction is one wall's plus an error; then another wall is held to it.

    Some of the other states beside the map are there all along, some joined: of these only changes are kept.
    """
    rng = np.random.default_rng(seed)
    n, others, joined = 3 + 2 * int(rng.integers(2, 8)), int(rng.integers(0, 4)), int(rng.integers(0, 20))
    first, i = (3 + 2 * int(v) for v in rng.choice((n - 3) // 2, 2, replace=False))
    root = rng.standard_normal((n + others + joined,) * 2)
    whole, x, nu, variance = root @ root.T, rng.standard_normal(n), float(rng.standard_normal()), 0.5
    p = aligned_zeros(n, n)
    p[:, :n] = np.triu(whole[:n, :n])
    own = n + others
    beside = Companions(4, n, whole[n:own, n:own].copy(), direction=True)
    beside.cross[:others, :n] = whole[n:own, :n]
    assert beside.direction[1] == 0.0
    beside.take_direction(x, p, n, first, variance)

    copy = np.insert(np.eye(len(whole)), own, np.eye(len(whole))[first], axis=0)
    whole = copy @ whole @ copy.T
    whole[own, own] += variance
    own += 1
    assert beside.direction[0] == x[first]
    np.testing.assert_allclose(beside.cov, whole[n:own, n:own], atol=1e-9)
    np.testing.assert_allclose(beside.cross[:, :n], whole[n:own, :n], atol=1e-9)

    if joined:
        beside.join(whole[own:, :n], whole[n:own, own:])
    mean, (_, known, cross), (_, w, s) = beside.mean.copy(), beside.direction, work_space(4, n)
    assert whiten_difference(p, n, i, known, cross, nu, variance, w, s) == 2
    beside.correct_direction(n, i, w, s)
    h = np.zeros(len(whole))
    h[i], h[own - 1] = 1.0, -1.0
    gain = whole @ h / (h @ whole @ h + variance)
    change = -np.outer(gain, h @ whole)
    after = whole + change
    np.testing.assert_allclose(w[:2, :n].T @ s[:2, 2], nu * gain[:n], atol=1e-9)
    np.testing.assert_allclose(np.triu(p[:, :n] - w[:2, :n].T @ w[:2, :n]), np.triu(after[:n, :n]), atol=1e-9)
    np.testing.assert_allclose(beside.mean - mean, nu * gain[n:], atol=1e-9)
    np.testing.assert_allclose(beside.cross[:, :n], after[n:, :n], atol=1e-9)
    cov, k = beside.cov, own - n
    np.testing.assert_allclose(cov[:k], after[n:own, n:], atol=1e-9)
    np.testing.assert_allclose(cov[:, :k], after[n:, n:own], atol=1e-9)
    np.testing.assert_allclose(np.triu(cov[k:, k:]), np.triu(change[own:, own:]), atol=1e-9)


def hold_all(askew: Array, sigma: float) -> tuple[Array, Array, float, float]:
    """Hold walls that are seen to ``sigma`` against the direction; return the state, covariance and direction."""
    x, p, marks = room([*askew], sigma=sigma)
    n = len(x)
    aligned, beside, (_, w, s) = aligned_zeros(n, n), Companions(4, n, direction=True), work_space(4, n)
    aligned[:, :n] = p
    beside.take_direction(x, aligned, n, 3, SIGMA**2)
    for i in range(5, n, 2):
        direction, variance, cross = beside.direction
        off = x[i] - direction
        whiten_difference(aligned, n, i, variance, cross, -off, SIGMA**2, w, s)
        apply(x, aligned, n, 2, marks, w, s, np.zeros(n))
        beside.correct_direction(n, i, w, s, reset=True)
    return x, aligned[:, :n], *beside.direction[:2]


def test_the_invariant_filter_takes_directions_as_they_are() -> None:
    """Angles keep their coordinates, whatever turns with them: what is known of the direction adds up."""
    askew = np.array([0.02, -0.01, 0.0, 0.005, 0.03])
    x, p, direction, variance = hold_all(askew, sigma=0.01)
    assert variance == pytest.approx((0.01**2 + SIGMA**2) / len(askew), rel=1e-6)
    assert direction == pytest.approx(askew.mean(), rel=1e-6)
    left = SIGMA**2 / (0.01**2 + SIGMA**2)
    np.testing.assert_allclose(x[3::2] - direction, left * (askew - direction), rtol=1e-6)
    np.testing.assert_allclose(np.diag(p)[3::2], 0.01**2 * left + (1.0 - left) ** 2 * variance, rtol=1e-6)


def test_the_covariance_knows_of_the_error_that_all_walls_share() -> None:
    """The first wall's own error is in all that is held against it: their mean has its true variance."""
    rng, walls, sigma, squares = np.random.default_rng(5), 12, 0.0002, []
    for _ in range(400):
        own = SIGMA * rng.standard_normal(walls)  # a building of direction 0
        _, _, direction, variance = hold_all(own + sigma * rng.standard_normal(walls), sigma)
        squares.append(direction**2 / variance)
    assert 0.85 < np.mean(squares) < 1.17


@pytest.mark.parametrize(("rooms", "most"), [("apartment", True), ("cave", False)])
def test_in_rooms_most_walls_are_held_and_in_caves_none(rooms: str, most: bool) -> None:
    env = gymnasium.make("mecanum_env/Explore-v0", rooms=rooms)
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
