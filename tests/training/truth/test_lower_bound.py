"""The lower bound: no path found by brute force is below it, and what its regions take for unseen is so."""

from __future__ import annotations

from itertools import combinations, pairwise, permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mecanum_env.config import LidarConfig, NoiseConfig, RobotConfig
from mecanum_env.ground_truth import GroundTruth
from mecanum_env.rooms import make
from training.truth.lower_bound import (
    _LEAK,
    _REACH_M,
    _TILE,
    Tiles,
    _distances,
    least_length,
    lower_bound,
    shortest_hops,
)
from training.truth.places import cells_per_tile
from training.truth.sights import Eye

ROBOT, LIDAR = RobotConfig(), LidarConfig()
PLACES = st.lists(st.tuples(st.floats(0.0, 10.0), st.floats(0.0, 10.0)), min_size=2, max_size=6)


def distances(places: list[tuple[float, float]]) -> np.ndarray:
    at = np.array(places)
    return np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))


def shortest(apart: np.ndarray, through: tuple[int, ...]) -> float:
    ways = ([0, *order] for order in permutations(through))
    return min(sum(apart[a, b] for a, b in pairwise(way)) for way in ways)


@given(PLACES)
def test_hops_are_the_shortest_of_all_orders(places):
    apart = distances(places)
    everything = tuple(range(1, len(places)))
    assert shortest_hops(apart) == pytest.approx(shortest(apart, everything))


@given(PLACES, st.lists(st.integers(1, 9), min_size=5, max_size=5), st.integers(0, 12))
def test_no_path_that_sees_enough_is_shorter(places, cells, spare):
    apart, cells = distances(places), np.array(cells[: len(places) - 1])
    tiles = range(1, len(places))
    every = [s for n in range(len(places)) for s in combinations(tiles, n)]
    enough = [s for s in every if cells.sum() - sum(cells[k - 1] for k in s) <= spare]
    assert least_length(apart, cells, spare) <= min(shortest(apart, s) for s in enough) + 1e-9


def test_the_bound_is_met_where_two_ends_must_be_seen_and_one_may_be_left_out():
    apart = distances([(0.0, 0.0), (-3.0, 0.0), (5.0, 0.0)])
    cells = np.array([10, 10])
    assert least_length(apart, cells, 5.0) == pytest.approx(3.0 + 8.0, abs=0.11)
    assert least_length(apart, cells, 9.9) == pytest.approx(11.0, abs=0.11)
    # Half of either may be left out by the linear program, all of one by a path: the bound is lower, not wrong.
    assert least_length(apart, cells, 10.0) <= 3.0
    assert least_length(apart, cells, 20.0) == 0.0


def test_ways_over_the_lattice_by_hand():
    nodes = np.ones((5, 6), dtype=bool)
    nodes[:4, 3] = False
    found = _distances(nodes, np.array([[0, 0]]))
    assert found[0, 2] == 2.0 and found[2, 2] == pytest.approx(2.0 * 2**0.5)
    assert found[0, 5] == pytest.approx(found[4, 3] + 2.0 * 2**0.5 + 2.0)
    assert np.isinf(found[0, 3])
    both = _distances(nodes, np.array([[0, 0], [0, 5]]))
    assert both[0, 5] == 0.0 and both[0, 2] == 2.0


@pytest.mark.parametrize("seed", [0, 1])
def test_a_place_nearby_sees_every_tile_of_which_more_than_a_rim_is_seen_from_anywhere(seed):
    plan = make("rectangular", seed=seed)
    ground = GroundTruth(plan, np.array(plan.start), robot=ROBOT, lidar=LIDAR, resolution=0.05)
    tiles = Tiles(ground, robot=ROBOT, lidar=LIDAR)
    eye, rng, cell = Eye(ground, LIDAR), np.random.default_rng(seed), ground.resolution
    every = cells_per_tile(ground.mappable, _TILE).ravel()
    looked_at = every > 0
    assert looked_at.sum() == tiles.sees.shape[1]
    centres = (tiles.places[:, ::-1] + 0.5 + np.array(ground.lattice_origin[::-1])) * cell
    for _ in range(300):
        point = centres[rng.integers(len(centres))] + rng.uniform(-0.1, 0.1, 2)
        row, col = np.floor(point[::-1] / cell).astype(int) - np.array(ground.lattice_origin)
        if not ground.mappable[row, col]:
            continue
        seen = (cells_per_tile(eye.sees(point) & ground.mappable, _TILE).ravel() > _LEAK * every)[looked_at]
        near = np.hypot(*(centres - point).T) <= _REACH_M
        assert not (seen & ~tiles.sees[near].any(axis=0)).any()


def test_the_bound_grows_with_what_must_be_seen():
    plan = make("rectangular", seed=0)
    ground = GroundTruth(plan, np.array(plan.start), robot=ROBOT, lidar=LIDAR, resolution=0.05)
    tiles = Tiles(ground, robot=ROBOT, lidar=LIDAR)
    total = ground.mappable_cells
    times = [least_length(tiles.apart, tiles.cells, (1.0 - share) * total) for share in (0.0, 0.9, 0.99)]
    assert times == sorted(times) and times[0] == 0.0 < times[-1]
    assert lower_bound(ground, 0.99, robot=ROBOT, lidar=LIDAR, noise=NoiseConfig()) == pytest.approx(
        times[-1] / 0.808
    )


def test_tiles_at_the_rim_are_counted_too():
    cells = np.zeros((25, 13), dtype=bool)
    cells[[0, 11, 12, 24], [0, 11, 12, 12]] = True
    np.testing.assert_array_equal(cells_per_tile(cells, 12), [[2, 0], [0, 1], [0, 1]])
