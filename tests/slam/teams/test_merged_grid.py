"""Maps of several robots in one grid."""

from __future__ import annotations

import numpy as np
import pytest

from slam.geometry import inverse, transform_points
from slam.grids.occupancy import FREE, OCCUPIED, OccupancyGrid
from slam.teams.merged_grid import Chart, MergedGrid
from slam.types import Scan


def _scan(rng: np.random.Generator) -> Scan:
    return Scan(rng.uniform(1.0, 4.0, 90), -np.pi, 2 * np.pi / 90, 8.0)


def _draw(grid: OccupancyGrid, rng: np.random.Generator, count: int, reach: float = 3.0) -> None:
    for _ in range(count):
        x, y = rng.uniform(-reach, reach, 2)
        grid.integrate(
            (float(x), float(y), float(rng.uniform(-3, 3))), _scan(rng), body=(float(x), float(y), 0.25)
        )


def _whole(grid: OccupancyGrid) -> np.ndarray:
    """A grid's cells on one lattice for all."""
    out = np.zeros((1600, 1600), np.int64)
    r, c = (at + 800 for at in grid.lattice_origin)
    out[r : r + grid.shape[0], c : c + grid.shape[1]] = grid.log_odds
    return out


def _check_sums(grid: MergedGrid) -> None:
    known = grid.log_odds != 0
    assert grid.known_cells == np.count_nonzero(known)
    kept = grid.overview_sums.copy()
    grid._build_overview()
    assert np.array_equal(kept, grid.overview_sums)
    p = grid.probability().astype(np.float64)[known]
    entropy = -(p * np.log2(p) + (1 - p) * np.log2(1 - p)) - 1.0
    assert grid.entropy_bit == pytest.approx(entropy.sum(), abs=0.5)


def test_alone_it_is_the_own_grid() -> None:
    rng = np.random.default_rng(0)
    own = OccupancyGrid()
    merged = MergedGrid(own)
    for _ in range(5):
        _draw(own, rng, 4, reach=6.0)
        merged.follow()
        merged.take({})
        assert np.array_equal(_whole(own), _whole(merged))
        assert merged.known_cells == own.known_cells
        assert merged.entropy_bit == pytest.approx(own.entropy_bit, abs=1e-2)
        _check_sums(merged)
    own.clear()
    merged.follow()
    assert merged.known_cells == 0


def test_it_is_the_sum_of_what_each_saw_itself_once() -> None:
    rng = np.random.default_rng(1)
    own, other, third = OccupancyGrid(), OccupancyGrid(), OccupancyGrid()
    merged = MergedGrid(own)
    for _ in range(4):
        _draw(own, rng, 3)
        _draw(other, rng, 3, reach=9.0)
        _draw(third, rng, 2, reach=5.0)
        merged.follow()
        merged.take({1: (Chart.of(other), None), 2: (Chart.of(third), None)})
        parts = [_whole(g) for g in (own, other, third)]
        expected = np.clip(np.sum(parts, axis=0), -39, 70)
        observed = np.any([p != 0 for p in parts], axis=0)
        # What cancels out, among the others or in all, is still observed.
        assert np.array_equal(_whole(merged) != 0, observed)
        assert np.abs(_whole(merged) - expected).max() <= 1
        _check_sums(merged)


@pytest.mark.parametrize("own_at", [0.0, 70.0])
@pytest.mark.parametrize("others_at", [(0.0,), (-80.0,), (70.0, -80.0)])
@pytest.mark.parametrize("taken_first", [False, True])
def test_maps_may_begin_far_from_each_other(
    own_at: float, others_at: tuple[float, ...], taken_first: bool
) -> None:
    rng, own = np.random.default_rng(2), OccupancyGrid()
    charts: dict[int, tuple[Chart, None]] = {}
    for k, x in enumerate((own_at, *others_at)):
        grid = own if k == 0 else OccupancyGrid()
        grid.integrate((x, 5.0, 0.3), _scan(rng), body=(x, 5.0, 0.25))
        if k:
            charts[k] = Chart.of(grid), None
    merged = MergedGrid(own)
    for step in ("take", "follow") if taken_first else ("follow", "take"):
        merged.take(charts) if step == "take" else merged.follow()
    seen_twice = sum(x == own_at for x in others_at)
    known = own.known_cells + sum(int(np.count_nonzero(chart.cells)) for chart, _ in charts.values())
    assert merged.known_cells == known if not seen_twice else merged.known_cells < known
    _check_sums(merged)


def test_what_is_drawn_is_told() -> None:
    rng = np.random.default_rng(2)
    own, other = OccupancyGrid(), OccupancyGrid()
    merged = MergedGrid(own)
    _draw(own, rng, 3)
    _draw(other, rng, 3)
    merged.follow()
    before, drawings = _whole(merged), merged.drawings
    merged.take({1: (Chart.of(other), None)})
    r0, c0, r1, c1 = merged.drawn_since(drawings)
    row, col = (at + 800 for at in merged.lattice_origin)
    outside = np.ones(before.shape, bool)
    outside[row + r0 : row + r1, col + c0 : col + c1] = False
    assert not ((_whole(merged) != before) & outside).any()
    assert merged.drawings > drawings


@pytest.mark.parametrize("frame", [(1.3, -0.7, 0.4), (-2.0, 0.5, 3.0), (0.0, 0.0, -1.57)])
def test_a_chart_of_another_frame_lands_where_its_cells_are(frame: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(3)
    pose = np.array(frame)
    other = OccupancyGrid()
    _draw(other, rng, 20)
    merged = MergedGrid(OccupancyGrid())
    merged.take({1: (Chart.of(other), pose)})
    centres = merged.to_points(np.argwhere(np.ones(merged.shape, bool)))
    cells = other.to_cells(transform_points(inverse(pose), centres))
    rows, cols = other.shape
    inside = (cells >= 0).all(axis=1) & (cells < (rows, cols)).all(axis=1)
    expected = np.zeros(len(cells), np.int64)
    expected[inside] = other.log_odds[tuple(cells[inside].T)]
    same = merged.log_odds.ravel() == expected
    assert same.mean() > 0.99  # OpenCV rounds to a 32nd of a cell
    for what in (FREE, OCCUPIED):
        assert np.count_nonzero(merged.classes() == what) == pytest.approx(
            np.count_nonzero(other.classes() == what), rel=0.03
        )
