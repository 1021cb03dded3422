"""Prices by hindsight: by hand on a line, against all orders, and in a room that is driven by them."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("sb3_contrib")

from training.learning.choice_world import make_rehearsal, make_world
from training.learning.config import RehearsalConfig, WorldConfig
from training.learning.hindsight import _price


def price(seen, distance, cells, places, costs, spare=0.0):
    seen = np.ascontiguousarray(np.asarray(seen, dtype=bool).T)
    cells = np.asarray(cells, dtype=float)
    distance, costs = np.asarray(distance, dtype=float), np.asarray(costs, dtype=float)
    return _price(seen, distance, cells, cells @ seen, np.asarray(places), costs, spare)


def test_on_a_line_by_hand():
    # Places at 0, 1, 2 and 10; a tile of 5 cells is seen from 1 and 2, one of 2 cells from 10.
    at = np.array([0.0, 1.0, 2.0, 10.0])
    distance = np.abs(at[:, None] - at[None])
    seen = [[0, 0], [1, 0], [1, 0], [0, 1]]
    assert price(seen, distance, [5, 2], [0, 1, 2], [0.0, 1.0, 2.0]) == 2.0 + 8.0
    assert price(seen, distance, [5, 2], [0, 1, 2], [0.0, 1.0, 2.0], spare=2) == 1.0  # enough is seen on the way
    assert price(seen, distance, [5, 2], [3], [10.0]) == 10.0 + 8.0
    assert price(seen, distance, [0, 0], [0], [0.0]) == 0.0
    # Of what nobody sees, no account is taken.
    assert price([[0], [0]], [[0, 1], [1, 0]], [4], [1], [1.0]) == 1.0


def test_no_tour_is_shorter_than_the_best_of_all_orders():
    rng = np.random.default_rng(0)
    ratios = []
    for _ in range(40):
        at = rng.uniform(0.0, 8.0, (6, 2))
        distance = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))
        seen = np.hstack([np.eye(6, dtype=bool)[:, 1:], rng.random((6, 3)) < 0.4])
        cells = rng.integers(1, 9, seen.shape[1])
        best = min(
            sum(distance[a, b] for a, b in zip((0, *order), order, strict=False))
            for order in permutations(range(1, 6))
        )
        ratios.append(price(seen, distance, cells * seen.any(axis=0), [0], [0.0]) / best)
    assert min(ratios) >= 1.0 - 1e-9 and np.mean(ratios) < 1.15


def test_a_room_is_covered_for_about_its_first_price():
    world = make_world(WorldConfig(rooms=("apartment",)))
    world.reset(options={"rooms": "apartment", "room_seed": 5})
    first, done = float(world.prices().min()), False
    while not done:
        prices = world.prices()
        assert len(prices) == world.action_masks().sum() and np.isfinite(prices).all() and (prices >= 0).all()
        *_, terminated, truncated, info = world.step(int(np.argmin(prices)))
        done = terminated or truncated
    assert info["is_success"] and 0.5 < info["path_length_m"] / first < 1.3


def _whole(shaping_s_m):
    return make_world(WorldConfig(rooms=("rectangular",), shaping_s_m=shaping_s_m, time_1_s=-0.1))


def _rehearsal(shaping_s_m):
    world = WorldConfig(rooms=("rectangular",), time_1_s=-0.1)
    return make_rehearsal(world, RehearsalConfig(covered_1=0.0, shaping_s_m=shaping_s_m))


def _lowest_price(world):
    return float(world.prices().min())


def _price_from_here(world):
    return world._by_truth().price_from_here(world.env.belief)


@pytest.mark.parametrize(("make", "to_go"), [(_whole, _lowest_price), (_rehearsal, _price_from_here)])
def test_shaping_adds_up_to_what_there_was_to_go_at_the_beginning(make, to_go):
    totals = []
    for world in (make(0.0), make(2.0)):
        world.reset(options={"rooms": "rectangular", "room_seed": 3})
        first = to_go(world)
        total, done = 0.0, False
        while not done:
            _, reward, terminated, truncated, _ = world.step(0)
            total += reward
            done = terminated or truncated
        totals.append(total)
    assert first > 1.0
    assert totals[1] - totals[0] == pytest.approx(0.1 * 2.0 * first, rel=1e-5)


def test_the_price_from_here_is_about_the_lowest_of_all_prices():
    world = make_rehearsal(WorldConfig(rooms=("apartment",)), RehearsalConfig(shaping_s_m=1.0))
    world.reset(options={"rooms": "apartment", "room_seed": 5})
    hindsight, done, ratios = world._by_truth(), False, []
    while not done:
        choice, found = world.env.agent.described
        prices = hindsight.prices(choice, found, world.env.belief)
        if prices.min() > 5.0:
            ratios.append(hindsight.price_from_here(world.env.belief) / prices.min())
        *_, terminated, truncated, _ = world.step(int(np.argmin(prices)))
        done = terminated or truncated
    assert len(ratios) > 5 and min(ratios) > 0.9 and np.median(ratios) < 1.3 and max(ratios) < 2.0
