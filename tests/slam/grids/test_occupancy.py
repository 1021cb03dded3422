from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam import Scan
from slam.features.extraction import FeatureExtractor
from slam.grids.occupancy import CLASS_OF, FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slam.grids.scan_drawing import (
    ENTROPY_BIT,
    FREE_UP_TO,
    HIT,
    IN_BETWEEN,
    IN_BRIDGE,
    IN_FREE,
    IN_SURFACE,
    MAX_LOG_ODDS,
    MIN_LOG_ODDS,
    MISS,
    OCCUPIED_FROM,
    WINDOW,
    WORD,
    fuse,
)
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


@given(st.integers(0, 2**32 - 1), st.sampled_from([64, 100, 200, 300]), st.floats(0.0, 1.0))
def test_fusing_a_mask_follows_the_rule_of_one_cell(seed: int, side: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    grid = OccupancyGrid()
    grid._grow(-side // 2, -side // 2, side // 2, side // 2)
    settled = rng.choice([MIN_LOG_ODDS, 0, MAX_LOG_ODDS], grid.shape)
    any_value = rng.integers(MIN_LOG_ODDS, MAX_LOG_ODDS + 1, grid.shape)
    before = np.where(rng.random(grid.shape) < share, settled, any_value)
    grid.log_odds[:] = before
    grid._build_overview()
    # A mask that lies somewhere over the grid, with marks in a box of whole words.
    rows, cols = 40, 12 * WORD
    row, col = rng.integers(0, grid.shape[0] - rows + 1), WORD * rng.integers(-4, grid.shape[1] // WORD - 8 + 1)
    left = WORD * int(rng.integers(4, 8))
    right = min(left + WORD * int(rng.integers(1, 8)), cols, grid.shape[1] - col) - 1
    top, bottom = 3, 35
    mask = np.zeros((rows, cols + WINDOW), np.uint8)
    box = (slice(top, bottom + 1), slice(left, right + 1))
    mask[box] = rng.choice([0, IN_FREE, IN_SURFACE, IN_BETWEEN, IN_BRIDGE], mask[box].shape)
    marks = np.zeros(grid.shape, np.uint8)
    marks[row + top : row + bottom + 1, col + left : col + right + 1] = mask[box]

    changes = np.zeros((marks.size + 1, 4), np.int32)
    lattice_row, lattice_col = grid.lattice_origin
    count, known, entropy = fuse(
        mask, lattice_row + row, lattice_col + col, top, left, bottom, right, grid.cells, grid.shape[1],
        lattice_row, lattice_col, grid.overview_sums, grid._overview_shift, changes, 0,
    )  # fmt: skip

    after = np.where(marks == IN_FREE, np.maximum(before + MISS, MIN_LOG_ODDS), before)
    after = np.where(marks == IN_SURFACE, np.minimum(before + HIT, MAX_LOG_ODDS), after)
    after = np.where((marks == IN_BETWEEN) & (before <= 0), np.minimum(before, FREE_UP_TO), after)
    after = np.where((marks == IN_BRIDGE) & (before >= FREE_UP_TO), np.maximum(before, OCCUPIED_FROM), after)
    after[(marks != 0) & (after == 0)] = -1
    np.testing.assert_array_equal(grid.log_odds, after)
    assert not mask.any()
    assert known == np.count_nonzero(after) - np.count_nonzero(before)
    gained = ENTROPY_BIT[after & 255] - ENTROPY_BIT[before & 255]
    assert entropy == gained.astype(np.float64).sum()  # exactly: the order does not matter
    class_before, class_after = CLASS_OF[before & 255], CLASS_OF[after & 255]
    r, c = np.nonzero(class_before != class_after)
    want = np.column_stack([r + lattice_row, c + lattice_col, class_before[r, c], class_after[r, c]])
    np.testing.assert_array_equal(changes[:count], want)
    kept = grid.overview_sums.copy()
    grid._build_overview()
    np.testing.assert_array_equal(kept, grid.overview_sums)


def around_the_sensor(cells: int, kind: int) -> OccupancyGrid:
    return OccupancyGrid.from_classes(
        np.full((2 * cells, 2 * cells), kind, np.int8), 0.05, (-0.05 * cells, -0.05 * cells)
    )


@pytest.mark.parametrize(("beams", "erased"), [(90, False), (360, True)])
def test_a_wall_s_end_between_two_beams_that_lie_far_apart_is_not_erased(beams: int, erased: bool) -> None:
    grid = around_the_sensor(200, FREE)
    between = np.array([[5.0 * math.cos(math.radians(2.0)), 5.0 * math.sin(math.radians(2.0))]])  # beams at 0°, 4°
    row, col = grid.to_cells(between)[0]
    grid.log_odds[row - 1 : row + 2, col : col + 20] = MAX_LOG_ODDS
    scan = Scan(np.full(beams, np.inf), 0.0, 2 * math.pi / beams, 8.0)
    for _ in range(20):
        grid.integrate(np.zeros(3), scan)
    assert (grid.classes()[row, col] == FREE) == erased
    # What nothing is known of is taken for free between beams, too, though not for certain.
    unknown = OccupancyGrid()
    for _ in range(20):
        unknown.integrate(np.zeros(3), scan)
    at = tuple(unknown.to_cells(between)[0])
    assert unknown.classes()[at] == FREE
    assert unknown.log_odds[at] == (MIN_LOG_ODDS if erased else FREE_UP_TO)
    on_beam = tuple(unknown.to_cells(np.array([[5.0, 0.01]]))[0])
    assert unknown.log_odds[on_beam] == MIN_LOG_ODDS


@pytest.mark.parametrize("beams", [90, 360])
def test_a_passage_is_not_walled_up_where_the_beams_into_it_were_lost(beams: int) -> None:
    increment = 2 * math.pi / beams
    angles = increment * np.arange(beams)
    with np.errstate(divide="ignore"):
        ranges = np.where(np.sin(angles) > 0.05, 1.02 / np.sin(angles), np.inf)  # the wall y = 1.02 m
    surface = np.where(ranges <= 8.0, 0, -1).astype(np.int16)
    passage = np.abs(np.cos(angles) * ranges - 4.5) < 0.5  # beams into it are lost
    if beams == 90:
        assert np.count_nonzero(passage) == 1
    ranges[passage], surface[passage] = np.nan, -1
    scan = Scan(np.where(ranges > 8.0, np.inf, ranges), 0.0, increment, 8.0)
    grid = around_the_sensor(200, FREE)
    blank = OccupancyGrid()
    for _ in range(5):
        grid.integrate(np.zeros(3), scan, surface)
        blank.integrate(np.zeros(3), scan, surface)
    passage_cell, wall_cell = (tuple(grid.to_cells(np.array([[x, 1.02]]))[0]) for x in (4.5, 2.5))
    assert grid.classes()[passage_cell] == FREE
    assert (grid.classes()[wall_cell] == FREE) == (beams == 90)
    passage_cell, wall_cell = (tuple(blank.to_cells(np.array([[x, 1.02]]))[0]) for x in (4.5, 2.5))
    assert blank.classes()[passage_cell] == UNKNOWN
    # Too narrow for a passage, and nothing is known of it: a wall, though not for certain.
    assert blank.log_odds[wall_cell] == (OCCUPIED_FROM if beams == 90 else MAX_LOG_ODDS)


def test_every_reader_is_told_what_was_drawn_since_it_looked() -> None:
    grid, rng = OccupancyGrid(), np.random.default_rng(0)
    read = {"often": (grid.drawings, grid.log_odds.copy()), "seldom": (grid.drawings, grid.log_odds.copy())}
    origins = dict.fromkeys(read, grid.lattice_origin)
    for k in range(24):
        pose = np.array([rng.uniform(-20, 20), rng.uniform(-20, 20), rng.uniform(-3, 3)])
        seen = room_scan(np.array([3.0, 2.5, pose[2]]))  # wherever it is taken from
        happens = rng.integers(0, 4)  # or nothing does
        if happens == 0:
            grid.mark_visited(pose[0], pose[1], 0.25)
        elif happens == 1 and k > 10:
            grid.redraw(pose[None], [(seen, np.zeros(0, np.int16))])
        elif happens < 3:
            grid.integrate(pose, seen, body=(pose[0] + 5.0, pose[1], 0.25))
        for name in ("often", "seldom") if k % 5 == 4 else ("often",):
            drawing, before = read[name]
            row0, col0, row1, col1 = grid.drawn_since(drawing)
            kept = np.zeros(grid.shape, np.int8)
            r, c = (old - new for old, new in zip(origins[name], grid.lattice_origin, strict=True))
            kept[r : r + before.shape[0], c : c + before.shape[1]] = before
            now = np.where(grid.visited, 100, grid.log_odds).astype(np.int8)
            kept[row0:row1, col0:col1] = now[row0:row1, col0:col1]
            np.testing.assert_array_equal(kept, now)
            assert drawing != grid.drawings or row0 == row1
            read[name], origins[name] = (grid.drawings, now.copy()), grid.lattice_origin


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda grid: pickle.loads(pickle.dumps(grid))])
def test_a_copy_goes_its_own_way_and_has_the_bytes_that_kernels_read_behind_the_cells(
    duplicate: Callable[[OccupancyGrid], OccupancyGrid],
) -> None:
    pose = np.array([3.0, 2.0, 0.4])
    grid = mapped(pose)
    copied, before = duplicate(grid), grid.log_odds.copy()
    np.testing.assert_array_equal(copied.log_odds, before)
    copied.integrate(pose, room_scan(pose), body=(3.0, 2.0, 0.25))
    np.testing.assert_array_equal(grid.log_odds, before)
    assert copied.visited.any() and not grid.visited.any()
    for plane, row in ((copied.log_odds, copied.cells), (copied.visited, copied.trail)):
        assert np.shares_memory(plane, row) and row.nbytes >= plane.nbytes + WINDOW


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


@given(
    st.tuples(st.floats(-9, 9), st.floats(-9, 9)), st.one_of(st.floats(0, 12), st.just(math.inf)),
    st.sampled_from([FREE, OCCUPIED]),
)  # fmt: skip
def test_cells_of_a_class_around_a_point_are_those_of_the_whole_grid(
    centre: tuple[float, float], radius: float, kind: int
) -> None:
    grid = mapped(np.array([3.0, 2.0, 0.5]))
    points = grid.to_points(np.argwhere(grid.classes() == kind))
    expected = points[np.hypot(*(points - centre).T) <= radius]
    assert np.array_equal(grid.points_of(kind, centre, radius), expected)


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


@pytest.mark.parametrize("wrong", [-1e-9, -48.0, -math.inf])
def test_a_range_below_zero_is_a_lost_beam(wrong: float) -> None:
    drawn = []
    for value in (math.nan, wrong):
        ranges = np.full(BEAMS, 2.0)
        ranges[40:90] = ranges[200] = value
        grid = OccupancyGrid()
        grid.integrate(np.array([0.4, -0.3, 0.5]), Scan(ranges, ANGLE_MIN, INCREMENT, 8.0))
        drawn.append(grid.log_odds)
    assert np.array_equal(*drawn)


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


@pytest.mark.parametrize("lost", [(100, 101, 102), (359, 0, 1), (358, 359, 0), (358, 359, 0, 1)])
def test_three_lost_beams_in_a_row_are_a_gap_wherever_the_row_lies(lost: tuple[int, ...]) -> None:
    ranges = np.full(360, 4.0)
    ranges[list(lost)] = np.nan
    grid = OccupancyGrid()
    grid.integrate(np.zeros(3), Scan(ranges, ANGLE_MIN, INCREMENT, 5.0))
    angle = ANGLE_MIN + lost[1] * INCREMENT
    middle = np.array([[r * math.cos(angle), r * math.sin(angle)] for r in (2.0, 2.5, 3.0, 3.5)])
    assert all(grid.classes()[tuple(cell)] != FREE for cell in grid.to_cells(middle))


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


def test_the_centres_of_all_cells_are_those_of_each() -> None:
    grid = OccupancyGrid(0.1)
    grid.mark_visited(7.0, -3.0, 0.3)  # it grows, to another shape
    cells = np.column_stack([index.ravel() for index in np.indices(grid.shape)])
    np.testing.assert_array_equal(grid.centres(), grid.to_points(cells))
