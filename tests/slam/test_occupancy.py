from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam import Scan
from slam.features import FeatureExtractor
from slam.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from tests.slam.simulated import ANGLE_MIN, BEAMS, INCREMENT, room_scan

inside = st.tuples(st.floats(1, 5), st.floats(1, 4), st.floats(-3.1, 3.1)).map(np.array)


def mapped(pose: np.ndarray, resolution: float = 0.05) -> OccupancyGrid:
    grid = OccupancyGrid(resolution)
    scan = room_scan(pose)
    extractor = FeatureExtractor()
    extractor.extract(scan)
    grid.integrate(pose, scan, extractor.surface)
    return grid


@given(inside, st.sampled_from([0.05, 0.1]))
def test_a_room_is_free_inside_closed_by_walls_and_unknown_outside(pose: np.ndarray, resolution: float) -> None:
    grid = mapped(pose, resolution)
    classes = grid.classes()
    rows, cols = np.indices(grid.shape)
    x, y = grid.to_points(np.column_stack([rows.ravel(), cols.ravel()])).T
    depth = np.minimum(np.minimum(x, 6 - x), np.minimum(y, 5 - y)).reshape(grid.shape)
    assert np.all(classes[depth > 1.5 * resolution] == FREE)
    assert np.all(classes[depth < -1.5 * resolution] == UNKNOWN)
    # Cells beyond the surface: some corner cells apart, nothing there is taken for free.
    assert np.mean(classes[(depth < 0) & (depth > -resolution)] != FREE) > 0.97
    assert np.count_nonzero(classes == OCCUPIED) > 0.8 * 22 / resolution


@given(inside)
def test_bookkeeping_agrees_with_a_full_count(pose: np.ndarray) -> None:
    grid = OccupancyGrid()
    rng = np.random.default_rng(0)
    followed = np.full((1, 1), UNKNOWN)
    seen: dict[tuple[int, int], int] = {}
    for k in range(6):
        p = pose + np.array([0.0, 0.0, 0.1 * k])
        grid.integrate(p, room_scan(p, rng))
        grid.mark_visited(p[0], p[1], 0.25)
        for row, col, before, now in grid.take_changes().tolist():
            assert seen.get((row, col), UNKNOWN) == before
            seen[(row, col)] = now
    followed = np.full(grid.shape, UNKNOWN)
    for (row, col), now in seen.items():
        followed[row - grid.lattice_origin[0], col - grid.lattice_origin[1]] = now
    np.testing.assert_array_equal(followed, grid.classes())
    assert grid.known_cells == np.count_nonzero(grid.log_odds)
    p = grid.probability()[grid.log_odds != 0].astype(float)
    entropy = -(p * np.log2(p) + (1 - p) * np.log2(1 - p)) - 1
    assert grid.entropy_bit == pytest.approx(entropy.sum(), rel=1e-4)
    kept = grid.overview_sums.copy()
    grid._build_overview()
    byte = np.round(255 * grid.probability().astype(float)) * (grid.log_odds != 0)
    block, (rows, cols) = grid.overview_block, grid.overview_sums.shape[1:]
    for incremental, anew, cells in zip(
        kept, grid.overview_sums, (grid.log_odds != 0, byte, grid.visited), strict=True
    ):
        np.testing.assert_array_equal(incremental, anew)
        simple = cells.astype(int).reshape(rows, block, cols, block).sum(axis=(1, 3))
        np.testing.assert_array_equal(anew, simple)


def test_growing_keeps_every_cell_where_it_was() -> None:
    grid = mapped(np.array([3.0, 2.0, 0.0]))
    points = np.argwhere(grid.log_odds != 0)
    before = dict(zip(map(tuple, grid.to_points(points).round(6)), grid.log_odds[tuple(points.T)], strict=True))
    grid.mark_visited(-31.0, 44.0, 0.2)
    points = np.argwhere(grid.log_odds != 0)
    after = dict(zip(map(tuple, grid.to_points(points).round(6)), grid.log_odds[tuple(points.T)], strict=True))
    assert before == after
    assert grid.visited[tuple(grid.to_cells(np.array([[-31.0, 44.0]]))[0])] == 1


@given(st.lists(st.tuples(st.floats(-40, 40), st.floats(-40, 40)), min_size=1, max_size=20))
def test_cells_and_points_are_inverse(points: list[tuple[float, float]]) -> None:
    grid = OccupancyGrid(0.1)
    xy = np.array(points)
    cells = grid.to_cells(xy)
    assert np.abs(grid.to_points(cells) - xy).max() <= 0.05 + 1e-9
    np.testing.assert_array_equal(grid.to_cells(grid.to_points(cells)), cells)


def test_evidence_saturates_and_can_be_overturned() -> None:
    grid = OccupancyGrid()
    pose = np.zeros(3)
    wall = Scan(np.full(360, 2.0), ANGLE_MIN, INCREMENT, 8.0)
    far = Scan(np.full(360, 4.0), ANGLE_MIN, INCREMENT, 8.0)
    cell = tuple(grid.to_cells(np.array([[2.02, 0.0]]))[0])
    for _ in range(50):
        grid.integrate(pose, wall)
    assert grid.classes()[tuple(grid.to_cells(np.array([[2.02, 0.0]]))[0])] == OCCUPIED
    for _ in range(20):
        grid.integrate(pose, far)
    cell = tuple(grid.to_cells(np.array([[2.02, 0.0]]))[0])
    assert grid.classes()[cell] == FREE
    assert grid.known_area_m2 == pytest.approx(math.pi * 16, rel=0.05)


def test_no_return_is_free_to_the_maximum_and_a_gap_of_lost_beams_is_unknown() -> None:
    grid = OccupancyGrid()
    ranges = np.full(360, np.inf)
    ranges[100:140] = np.nan
    grid.integrate(np.zeros(3), Scan(ranges, ANGLE_MIN, INCREMENT, 5.0))

    def at(beam: int, r: float) -> int:
        angle = ANGLE_MIN + beam * INCREMENT
        point = np.array([[r * math.cos(angle), r * math.sin(angle)]])
        return int(grid.classes()[tuple(grid.to_cells(point)[0])])

    assert at(20, 4.8) == FREE
    assert at(120, 2.0) == UNKNOWN
    assert not np.any(grid.classes() == OCCUPIED)


def test_from_classes_round_trips_and_bad_resolution_is_refused() -> None:
    classes = np.random.default_rng(0).choice(np.array([UNKNOWN, FREE, OCCUPIED], np.int8), (37, 51))
    grid = OccupancyGrid.from_classes(classes, 0.05, (-1.0, 2.5))
    r, c = grid.to_cells(np.array([[-1.0 + 0.025, 2.5 + 0.025]]))[0]
    np.testing.assert_array_equal(grid.classes()[r : r + 37, c : c + 51], classes)
    with pytest.raises(ValueError, match="resolution"):
        OccupancyGrid(0.0)


def test_agreement_is_greatest_where_the_scan_was_taken() -> None:
    grid = OccupancyGrid(0.05)
    pose = np.array([2.0, 2.0, 0.3])
    scan = room_scan(pose)
    for _ in range(3):
        grid.integrate(pose, scan)
    best = grid.agreement(pose, scan)
    for shift in ([0.2, 0.0, 0.0], [0.0, -0.2, 0.0], [0.0, 0.0, 0.1]):
        assert grid.agreement(pose + shift, scan) < 0.5 * best
    nothing = Scan(np.full(BEAMS, np.inf), angle_min=ANGLE_MIN, angle_increment=INCREMENT, range_max=20.0)
    assert grid.agreement(pose, nothing) == 0.0
    assert OccupancyGrid(0.05).agreement(pose, scan) == 0.0
