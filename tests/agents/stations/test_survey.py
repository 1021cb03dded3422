"""What there is to do on stations, and the ways to begin with it."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from agents.stations.lattice import edges, in_sight, join, lengths, ways
from agents.stations.sensor import BLIND, SENSORS, look, rays
from agents.stations.survey import STRIDE, VOXEL, Survey, find_pieces, first_hop, no_pieces, options, survey, tour
from agents.ways.routing import draw_luck
from slam.grids.occupancy import FREE, UNKNOWN
from tests.agents.stations.floors import CELL_M, LUCK, rooms, stop


@pytest.mark.parametrize("seed", range(5))
def test_lengths_are_those_of_the_ways(seed):
    known = rooms(seed)
    picked = known[5::STRIDE, 5::STRIDE] == FREE
    own = np.argwhere(picked)
    index = np.full(picked.shape, -1, np.int64)
    index[picked] = np.arange(len(own))
    cells = own * STRIDE + 5
    joined = join(known, cells, own, index, 2)
    to, length, count = edges(cells, joined)
    for station in range(len(cells)):
        np.testing.assert_allclose(lengths(to, length, count, station), ways(cells, joined, station)[0], atol=1e-6)


def test_pieces_are_the_same_whether_found_at_once_or_bit_by_bit():
    truth = rooms(3)
    known = np.full(truth.shape, UNKNOWN, np.int8)
    pieces = no_pieces(known.shape)
    rng = np.random.default_rng(0)
    for _ in range(30):
        row, col = rng.integers(0, 110, 2)
        known[row : row + 25, col : col + 25] = truth[row : row + 25, col : col + 25]
        find_pieces(known, pieces, np.array([row, min(row + 24, 129), col, min(col + 24, 129)]))
    whole = no_pieces(known.shape)
    find_pieces(known, whole, np.array([0, 129, 0, 129]))
    np.testing.assert_array_equal(pieces, whole)
    assert (whole >= 0).any()
    before = whole.copy()
    find_pieces(known, whole, np.array([130, -1, 130, -1]))  # nothing became known
    np.testing.assert_array_equal(whole, before)


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("seed", range(3))
def test_what_counts_as_settled_is_settled_by_a_look(seed, sensor):
    """Where all that is unknown is wall, each piece that counts, and is no near one in sight, is gone then."""
    known, robot = rooms(seed), (65, 65)
    visited = np.zeros(known.shape, np.bool_)
    pieces = no_pieces(known.shape)
    find_pieces(known, pieces, np.array([0, 129, 0, 129]))
    blind, seeing = (
        survey(known, pieces, visited, robot, robot, CELL_M, 30.0, rays_) for rays_ in (BLIND, rays(sensor))
    )
    np.testing.assert_array_equal(blind.worth, seeing.worth)
    assert set(blind.places) <= set(seeing.places) and seeing.sight.sum() > blind.sight.sum()
    near = in_sight(known, seeing.cells, seeing.pieces, 30.0)
    for place, settles in list(zip(seeing.places.tolist(), seeing.sight, strict=True))[1:]:
        shown, left = known.copy(), no_pieces(known.shape)
        look(known == FREE, *seeing.cells[place].tolist(), rays(sensor), shown)
        find_pieces(shown, left, np.array([0, 129, 0, 129]))
        rows, cols = (seeing.pieces[settles & ~near[place]] // VOXEL).T
        assert (left[rows, cols] < 0).all()


@pytest.mark.parametrize("seed", range(4))
def test_openings_begin_differently(seed):
    found, _ = stop(rooms(seed), (65, 65))
    assert found.worth.any()
    np.testing.assert_allclose(found.distance, found.distance.T, atol=1e-6)
    assert found.worth[found.places[1:]].all() and (found.views[found.worth] >= 2).all()
    openings = options(found, LUCK, most=5, most_loss_m=40.0)
    assert 1 <= len(openings.targets) <= 5 and openings.losses[0] == 0.0
    assert len(set(openings.hops.tolist())) == len(openings.hops)  # no two by the same first hop
    assert (np.diff(openings.losses[1:]) >= 0).all() and (openings.losses <= 40.0).all()
    for target, hop, leg in zip(openings.targets, openings.hops, openings.legs, strict=True):
        assert first_hop(found.before, found.places[0], target) == hop
        assert leg == pytest.approx(found.way[target] * CELL_M)
    few = draw_luck(6, 2)  # fewer columns than places: drawn anew
    assert len(options(found, few, most=3, most_loss_m=40.0).targets) <= 3


def to_do(seed: int) -> Survey:
    """What there is to do for a robot among six places in a square of 30 m that settle nine pieces."""
    rng = np.random.default_rng(seed)
    at = rng.uniform(0.0, 30.0, (7, 2))
    seen = rng.random((6, 9)) < 0.5
    sight = np.vstack([np.zeros(9, np.bool_), seen & (rng.random((6, 9)) < 0.8)])
    seen &= sight.any(axis=0)  # any piece can be settled
    distance = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))
    own = np.arange(7)
    return Survey(
        np.zeros((7, 2), np.int64), own, distance[0], own > 0, own, np.zeros((9, 2), np.int64), seen, own, sight,
        distance,
    )  # fmt: skip


def shortest(found: Survey, first: int | None = None) -> float:
    """The shortest order of places, by trying all, after which no station sees two pieces that are not settled."""
    best = math.inf
    for count in range(7):
        for order in itertools.permutations(range(1, 7), count):
            left = ~found.sight[list(order)].any(axis=0)
            if (found.seen[:, left].sum(axis=1) < 2).all() and (first is None or order[:1] == (first,)):
                best = min(best, sum(found.distance[a, b] for a, b in itertools.pairwise((0, *order))))
    return best


def test_a_tour_leaves_nothing_worth_a_visit_and_is_not_much_longer_than_the_shortest():
    shares, begun = [], []
    for seed in range(12):
        found = to_do(seed)
        if shortest(found) == 0.0:
            continue
        order = tour(found, LUCK)
        left = ~found.sight[order].any(axis=0)
        assert order[0] == 0 and len(set(order.tolist())) == len(order)
        assert (found.seen[:, left].sum(axis=1) < 2).all()
        cost = sum(found.distance[a, b] for a, b in itertools.pairwise(order))
        shares.append(cost / shortest(found))
        openings = options(found._replace(before=np.zeros(7, np.int64)), LUCK, most=6, most_loss_m=1e3)
        assert openings.targets[0] == order[1]
        for target, loss in zip(openings.targets, openings.losses, strict=True):
            begun.append((cost + loss) / shortest(found, int(target)))
    assert min(shares + begun) > 1.0 - 1e-9
    assert np.mean(shares) < 1.25 and np.mean(begun) < 1.25
