"""What is written for speed on large grids, against the plain way of saying it: bit for bit."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components

from agents.view_points.frontiers import FrontierConfig, _borders_a_large_pocket, _clusters, find
from agents.view_points.sight import Watch, first_in_good_sight, in_good_sight
from agents.ways import cost_map as cost_maps
from agents.ways.boxes import Box
from agents.ways.coarsening import FAR_M, Blocks, fill_blocks, known_extent, to_walls
from agents.ways.cost_map import CostMap, PlannerConfig
from agents.ways.planning import travel_costs
from mecanum_env.config import RobotConfig
from slam.grids.occupancy import CLASS_OF, FREE, OCCUPIED, UNKNOWN
from tests.agents.grids import belief_of, fill, half_known

seeds = st.integers(0, 2**32 - 1)


def random_grid(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Log-odds of every kind and a body's track, over a part of a grid that is blank elsewhere."""
    rng = np.random.default_rng(seed)
    rows, cols = rng.integers(1, 40, 2)
    log_odds = rng.integers(-30, 30, (rows, cols)).astype(np.int8)
    log_odds[rng.random((rows, cols)) < rng.random()] = 0
    log_odds[:, : rng.integers(0, cols + 1)] = 0
    log_odds[rng.integers(0, rows + 1) :] = 0
    visited = (rng.random((rows, cols)) < 0.1 * rng.integers(0, 2)).astype(np.uint8)
    return log_odds, visited


def plain_cost_map(classes: np.ndarray, weight: np.ndarray, start: tuple[int, int]) -> CostMap:
    nowhere = np.zeros(classes.shape, dtype=np.bool_)
    return CostMap(classes, weight, weight, 0.1, (0.0, 0.0), start, nowhere, weight)


@settings(max_examples=80, deadline=None)
@given(seeds)
def test_the_known_extent_is_the_box_of_what_is_not_blank(seed):
    log_odds, visited = random_grid(seed)
    used = np.argwhere((log_odds != 0) | (visited != 0))
    row0, col0, row1, col1 = known_extent(log_odds, visited)
    if len(used):
        assert [row0, col0] == used.min(axis=0).tolist()
        assert [row1 - 1, col1 - 1] == used.max(axis=0).tolist()
    else:
        assert (row0, col0, row1, col1) == (*log_odds.shape, 0, 0)


def clearance_plainly(classes: np.ndarray, resolution: float) -> np.ndarray:
    """Distance [m] from each cell's centre to the nearest occupied edge, straight from OpenCV."""
    if not (classes == OCCUPIED).any():
        return np.full(classes.shape, FAR_M, dtype=np.float32)
    walls = (classes != OCCUPIED).astype(np.uint8)
    cells = cv2.distanceTransform(walls, cv2.DIST_L2, cv2.DIST_MASK_5) - np.float32(0.5)
    return np.minimum(cells * np.float32(resolution), np.float32(FAR_M))


@settings(max_examples=80, deadline=None)
@given(seeds, st.integers(1, 4), st.booleans())
def test_blocks_against_their_definition(seed, factor, walls):
    log_odds, visited = random_grid(seed)
    if not walls:
        log_odds = np.minimum(log_odds, 0)
    pads = tuple(np.random.default_rng(seed).integers(0, factor, 2).tolist())
    size = [-(-(side + pad) // factor) + 2 for side, pad in zip(log_odds.shape, pads, strict=True)]
    found = Blocks.blank(*size)
    fill_blocks(
        log_odds, visited, to_walls(log_odds), Box(0, 0, *log_odds.shape), Box(1, 1, size[0] - 1, size[1] - 1),
        0.05, factor, *pads, found.classes, found.clearance, found.suspect,
    )  # fmt: skip
    fine = CLASS_OF[log_odds.view(np.uint8)]
    fine[(fine == UNKNOWN) & (visited != 0)] = FREE
    away = clearance_plainly(fine, 0.05)
    np.testing.assert_array_equal(cost_maps.clearance(log_odds, 0.05), away)
    rows, cols = found.classes.shape
    for row, col in np.ndindex(rows, cols):
        r, c = [max((v - 1) * factor - pad, 0) for v, pad in zip((row, col), pads, strict=True)]
        r1, c1 = [max(v * factor - pad, 0) for v, pad in zip((row, col), pads, strict=True)]
        block = fine[r:r1, c:c1]
        occupied, free = (block == OCCUPIED).any(), 2 * (block == FREE).sum() > factor**2
        assert found.classes[row, col] == (OCCUPIED if occupied else FREE if free else UNKNOWN)
        assert found.suspect[row, col] == ((block == UNKNOWN) & (log_odds[r:r1, c:c1] > 0)).any()
        mean = away[r:r1, c:c1].astype(np.float64).sum() / block.size if block.size else FAR_M
        assert found.clearance[row, col] == np.float32(mean)
    assert (found.classes[[0, -1]] == UNKNOWN).all() and (found.classes[:, [0, -1]] == UNKNOWN).all()


def dial_plainly(weight: np.ndarray, start: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Dial's algorithm as it is said: the latest node of the lowest bucket first, and all its neighbours."""
    cost, step = np.full(weight.shape, np.inf, dtype=np.float32), np.full(weight.shape, -1, dtype=np.int8)
    cost[start] = 0.0
    buckets, done = {0: [start]}, set()
    moves = [(0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1)]
    while buckets:
        lowest = min(buckets)
        node = buckets[lowest].pop()
        if not buckets[lowest]:
            del buckets[lowest]
        if node in done:
            continue
        done.add(node)
        for k, (dr, dc) in enumerate(moves):
            r, c = node[0] + dr, node[1] + dc
            if min(weight[r, c], weight[r, node[1]], weight[node[0], c]) <= 0.0:
                continue
            length = 0.5 * np.sqrt(2.0) if k % 2 else 0.5
            total = cost[node] + np.float32(length * float(weight[node] + weight[r, c]))
            if total < cost[r, c]:
                cost[r, c], step[r, c] = total, k
                buckets.setdefault(int(total), []).append((r, c))
    return cost, step


@settings(max_examples=40, deadline=None)
@given(seeds, st.sampled_from([1, 2, 9]))
def test_travel_costs_and_their_ties_against_the_plain_algorithm(seed, levels):
    rng = np.random.default_rng(seed)
    weight = rng.integers(1, levels + 1, rng.integers(4, 24, 2)).astype(np.float32)
    weight[rng.random(weight.shape) < 0.5 * rng.random()] = 0.0
    weight[[0, -1], :] = weight[:, [0, -1]] = 0.0
    start = (int(rng.integers(1, weight.shape[0] - 1)), int(rng.integers(1, weight.shape[1] - 1)))
    weight[start] = 1.0
    travel = travel_costs(plain_cost_map(np.zeros(weight.shape, dtype=np.int8), weight, start))
    cost, step = dial_plainly(weight, start)
    np.testing.assert_array_equal(travel.cost, cost * np.float32(0.1))
    np.testing.assert_array_equal(travel.step, step)


@settings(max_examples=60, deadline=None)
@given(seeds, st.sampled_from([1, 2, 9]), st.floats(0.0, 3.0))
def test_ways_within_a_cost_are_the_same_and_beyond_it_is_known_where_there_are_any(seed, levels, within_m):
    rng = np.random.default_rng(seed)
    weight = rng.integers(1, levels + 1, rng.integers(4, 24, 2)).astype(np.float32)
    weight[rng.random(weight.shape) < 0.5 * rng.random()] = 0.0
    weight[[0, -1], :] = weight[:, [0, -1]] = 0.0
    weight[2, 2] = 1.0
    cost_map = plain_cost_map(np.zeros(weight.shape, dtype=np.int8), weight, (2, 2))
    whole, part = travel_costs(cost_map), travel_costs(cost_map, within_m=within_m)
    near = part.cost < part.beyond_m
    assert near[whole.cost < within_m].all() or np.isfinite(whole.cost).sum() == near.sum()
    np.testing.assert_array_equal(part.cost[near], whole.cost[near])
    np.testing.assert_array_equal(part.step[near], whole.step[near])
    np.testing.assert_array_equal(np.isfinite(part.cost), np.isfinite(whole.cost))
    far = ~near & np.isfinite(whole.cost)
    assert (whole.cost[far] >= part.beyond_m).all() and (part.cost[far] == np.float32(part.beyond_m)).all()
    assert (part.step[far & (part.cost > part.beyond_m)] == -1).all()


@settings(max_examples=80, deadline=None)
@given(seeds)
def test_clusters_against_opencv(seed):
    rng = np.random.default_rng(seed)
    mask = rng.random(rng.integers(1, 60, 2)) < rng.random() ** 2
    cells = np.argwhere(mask)
    labels, boxes = _clusters(cells, mask.shape, 1)
    count, expected, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=8)
    np.testing.assert_array_equal(labels, expected[mask] - 1)
    np.testing.assert_array_equal(boxes, stats[1:, [cv2.CC_STAT_HEIGHT, cv2.CC_STAT_WIDTH]])
    assert len(boxes) == count - 1


@settings(max_examples=80, deadline=None)
@given(seeds, st.integers(1, 4))
def test_clusters_join_what_is_within_reach(seed, reach):
    rng = np.random.default_rng(seed)
    mask = rng.random(rng.integers(1, 40, 2)) < 0.3 * rng.random()
    cells = np.argwhere(mask)
    labels, boxes = _clusters(cells, mask.shape, reach)
    apart = np.abs(cells[:, None] - cells[None]).max(axis=2, initial=0)
    count, expected = connected_components(apart <= reach)
    assert count == len(boxes) == len(set(zip(labels.tolist(), expected.tolist(), strict=True)))
    for k, box in enumerate(boxes):
        np.testing.assert_array_equal(box, np.ptp(cells[labels == k], axis=0) + 1)


@settings(max_examples=60, deadline=None)
@given(seeds, st.sampled_from([0.05, 0.3, 1.0]))
def test_small_and_thin_pockets_are_left_out(seed, least_m2):
    rng = np.random.default_rng(seed)
    classes = rng.choice([UNKNOWN, FREE], rng.integers(3, 40, 2), p=[0.6, 0.4]).astype(np.int8)
    classes = cv2.resize(classes, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
    cost_map = plain_cost_map(classes, np.ones(classes.shape, dtype=np.float32), (1, 1))
    near = _borders_a_large_pocket(cost_map, FrontierConfig(min_unknown_m2=least_m2)) != 0
    padded = np.pad((classes == UNKNOWN).astype(np.uint8), 3, constant_values=1)
    thick = cv2.morphologyEx(padded, cv2.MORPH_OPEN, np.ones((3, 3), dtype=np.uint8))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(thick, connectivity=4)
    large = [i for i in range(1, len(stats)) if stats[i, cv2.CC_STAT_AREA] * 0.1**2 >= least_m2]
    expected = cv2.dilate(np.isin(labels, large).astype(np.uint8), np.ones((3, 3), dtype=np.uint8)) != 0
    np.testing.assert_array_equal(near, expected[3:-3, 3:-3])


@pytest.mark.parametrize("half_view", [np.pi, 1.0])
def test_many_poses_see_what_any_of_them_sees(half_view):
    rng = np.random.default_rng(0)
    classes = half_known()
    fill(classes, 2.4, 1.2, 2.6, 2.8)
    cost_map = cost_maps.build(belief_of(classes, (1.5, 2.0, 0.0)), PlannerConfig(), RobotConfig())
    found = find(cost_map, FrontierConfig())
    cells = cost_map.to_cells(found.targets)
    normals = found.normals.copy()
    normals[0] = 0.0
    for count in (0, 1, 3, 30):
        poses = rng.uniform([0.2, 0.2, -3.0], [3.9, 3.8, 3.0], (count, 3))
        one_by_one = np.zeros(len(cells), dtype=bool)
        for pose in poses:
            one_by_one |= in_good_sight(cost_map, cells, normals, Watch(pose[None], 2.0, half_view))
        together = in_good_sight(cost_map, cells, normals, Watch(poses, 2.0, half_view))
        np.testing.assert_array_equal(together, one_by_one)
        # The worthiest place that sees a piece, one by one, as long as it is worth more than what the piece has.
        worth, least = np.sort(rng.random(count))[::-1], rng.random(len(cells))
        first = np.full(len(cells), -1)
        for k in range(count):
            seen = in_good_sight(cost_map, cells, normals, Watch(poses[k : k + 1] * [1, 1, 0], 2.0, np.pi))
            first[(first < 0) & seen & (least < worth[k])] = k
        np.testing.assert_array_equal(
            first_in_good_sight(cost_map, cells, normals, poses[:, :2], worth, least, 2.0), first
        )
