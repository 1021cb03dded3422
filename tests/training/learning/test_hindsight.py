"""Prices by hindsight: by hand on a line, against all orders, and in a room that is driven by them."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("sb3_contrib")

from training.learning.choice_world import make_rehearsal
from training.learning.config import RehearsalConfig, WorldConfig
from training.learning.hindsight import _price


def price(seen, distance, cells, place, spare=0.0):
    seen = np.ascontiguousarray(np.asarray(seen, dtype=bool).T)
    cells, distance = np.array(cells, dtype=float), np.asarray(distance, dtype=float)
    return _price(seen, distance, cells, cells @ seen, place, float(spare))


def test_on_a_line_by_hand():
    # Places at 0, 1, 2 and 10; a tile of 5 cells is seen from 1 and 2, one of 2 cells from 10.
    at = np.array([0.0, 1.0, 2.0, 10.0])
    distance = np.abs(at[:, None] - at[None])
    seen = [[0, 0], [1, 0], [1, 0], [0, 1]]
    assert price(seen, distance, [5, 2], 0) == 1.0 + 9.0
    assert price(seen, distance, [5, 2], 0, spare=2) == 1.0  # enough is seen on the way
    assert price(seen, distance, [5, 2], 2) == 8.0
    assert price(seen, distance, [5, 2], 3) == 8.0
    assert price(seen, distance, [0, 0], 0) == price(seen, distance, [5, 2], 1, spare=2) == 0.0
    # Of what nobody sees, no account is taken.
    assert price([[0], [0]], [[0, 1], [1, 0]], [4], 1) == 0.0


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
        ratios.append(price(seen, distance, cells * seen.any(axis=0), 0) / best)
    assert min(ratios) >= 1.0 - 1e-9 and np.mean(ratios) < 1.15


def _rehearsal(shaping_s_m, rooms="rectangular", gamma=1.0):
    world = WorldConfig(rooms=(rooms,), time_1_s=-0.1)
    return make_rehearsal(world, RehearsalConfig(shaping_s_m=shaping_s_m, gamma=gamma))


@pytest.mark.parametrize("gamma", [1.0, 0.9])
def test_shaping_adds_up_to_what_there_was_to_go_at_the_beginning(gamma):
    """Discounted as PPO discounts: else it would tell what is best to do."""
    totals = []
    for world in (_rehearsal(0.0, gamma=gamma), _rehearsal(2.0, gamma=gamma)):
        world.reset(options={"rooms": "rectangular", "room_seed": 3})
        first = world.price_from_here()
        total, weight, done = 0.0, 1.0, False
        while not done:
            _, reward, terminated, truncated, info = world.step(0)
            total += weight * reward
            weight *= gamma ** info["duration_s"]
            done = terminated or truncated
        totals.append(total)
    assert first > 1.0
    assert totals[1] - totals[0] == pytest.approx(0.1 * 2.0 * first, rel=1e-5)


def test_a_room_is_not_covered_for_much_less_than_its_first_price():
    world = _rehearsal(0.0, "apartment")
    world.reset(options={"rooms": "apartment", "room_seed": 5})
    prices, way, done = [world.price_from_here()], 0.0, False
    while not done:
        here = world.env.belief.pose[:2]
        *_, terminated, truncated, info = world.step(0)
        way += float(np.hypot(*(world.env.belief.pose[:2] - here)))
        prices.append(world.price_from_here())
        done = terminated or truncated
    assert info["is_success"] and prices[0] > 10.0 and prices[-1] < 0.5 * prices[0]
    assert 0.5 < way / prices[0] < 4.0
