"""Places shared out: the best that there is on small cases, and balanced."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.teams.coordinated import pair_off
from agents.teams.sharing import assign, share_tours, tour_length

seeds = st.integers(0, 2**31 - 1)


@settings(max_examples=60, deadline=None)
@given(seed=seeds, robots=st.integers(1, 4), n=st.integers(1, 6))
def test_no_assignment_costs_less(seed, robots, n):
    costs = np.random.default_rng(seed).uniform(0.0, 10.0, (robots, n))
    owned = assign(costs)
    given_away = owned[owned >= 0]
    assert len(given_away) == min(robots, n) == len(set(given_away.tolist()))
    total = costs[owned >= 0, given_away].sum()
    if robots <= n:
        best = min(costs[np.arange(robots), list(p)].sum() for p in permutations(range(n), robots))
    else:
        best = min(costs[list(p), np.arange(n)].sum() for p in permutations(range(robots), n))
    assert total == pytest.approx(best)


def test_a_robot_that_cannot_get_anywhere_is_given_nothing():
    assert assign(np.array([[1.0, 2.0], [np.inf, np.inf]])).tolist() == [0, -1]
    assert assign(np.array([[1.0, np.inf], [0.5, 3.0]])).tolist() == [0, 1]  # as many as can get one do
    assert assign(np.zeros((2, 0))).tolist() == [-1, -1]


def scene(seed: int, robots: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    places, starts = rng.uniform(0.0, 10.0, (n, 2)), rng.uniform(4.0, 6.0, (robots, 2))
    return (
        np.hypot(*(starts[:, None] - places[None]).transpose(2, 0, 1)),
        np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1)),
    )


def shortest(start: np.ndarray, distance: np.ndarray, own: tuple[int, ...]) -> float:
    return min(tour_length(start, distance, np.array(p, np.int64)) for p in permutations(own))


def longest(starts, distance, owner) -> float:
    tours = [tuple(np.flatnonzero(owner == k).tolist()) for k in range(len(starts))]
    return max(shortest(starts[k], distance, tour) for k, tour in enumerate(tours))


def test_the_length_of_a_tour_by_hand():
    start, distance = np.array([2.0, 5.0]), np.array([[0.0, 4.0], [4.0, 0.0]])
    assert tour_length(start, distance, np.array([0, 1])) == 6.0
    assert tour_length(start, distance, np.zeros(0, np.int64)) == 0.0


def test_the_last_to_end_ends_hardly_later_than_it_must():
    ratios = []
    for seed in range(40):
        starts, distance = scene(seed, 2, 6)
        owner = share_tours(starts, distance)
        assert ((owner >= 0) & (owner < 2)).all()
        best = min(longest(starts, distance, np.array(o)) for o in product(range(2), repeat=6))
        ratios.append(longest(starts, distance, owner) / best)
    assert np.mean(ratios) < 1.1 and max(ratios) < 1.5


def test_tours_are_balanced():
    """Against one that takes places by nearness alone."""
    spread, by_nearness = [], []
    for seed in range(20):
        starts, distance = scene(seed, 3, 8)
        owner = share_tours(starts, distance)
        spread.append(longest(starts, distance, owner))
        by_nearness.append(longest(starts, distance, starts.argmin(axis=0)))
    assert np.mean(spread) < 0.85 * np.mean(by_nearness)


def test_what_one_cannot_reach_goes_to_the_other():
    starts, distance = scene(3, 2, 5)
    starts[0, 2] = 1e6
    assert share_tours(starts, distance)[2] == 1


def test_one_robot_takes_all_and_without_places_there_is_nothing_to_share():
    starts, distance = scene(1, 1, 5)
    assert share_tours(starts, distance).tolist() == [0] * 5
    assert len(share_tours(np.zeros((2, 0)), np.zeros((0, 0)))) == 0


def test_targets_in_sight_of_one_that_is_given_away_are_worth_less():
    utility, price = np.array([5.0, 4.9, 4.0]), np.zeros((2, 3))
    nobody = np.array([-1, -1])
    near = np.eye(3)
    near[0, 1] = near[1, 0] = 0.9  # the two best see the same
    assert sorted(pair_off(utility, near, price, nobody).tolist()) == [0, 2]
    assert sorted(pair_off(utility, np.eye(3), price, nobody).tolist()) == [0, 1]
    assert pair_off(utility, near, price, np.array([1, -1])).tolist() == [1, 2]  # what was announced stands
    assert pair_off(utility, near, np.full((2, 3), np.inf), nobody).tolist() == [-1, -1]
