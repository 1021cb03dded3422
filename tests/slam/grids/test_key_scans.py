from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import least_squares

from slam.geometry import compose, inverse
from slam.grids.key_scans import KeyScanConfig, KeyScans
from slam.grids.occupancy import FREE, OCCUPIED, OccupancyGrid
from tests.slam.simulated import room_scan

CORNERS = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 5.0], [0.0, 5.0]])
IDS = np.arange(4)


def points(places: np.ndarray) -> np.ndarray:
    return np.column_stack([places, np.zeros(len(places))])


def drawn(shift: np.ndarray) -> tuple[OccupancyGrid, KeyScans, np.ndarray]:
    """Draw a room from poses that are all off by ``shift`` (an SE(2) error about the origin)."""
    grid, keys = OccupancyGrid(), KeyScans(KeyScanConfig(check_every=1))
    wrong = np.array([compose(shift, np.array([*c, 0.0]))[:2] for c in CORNERS])
    for k in range(8):
        pose = np.array([1.0 + 0.5 * k, 2.0, 0.1 * k])
        scan = room_scan(pose)
        seen = compose(shift, pose)
        surface = np.full(len(scan.ranges), -1, np.int16)
        grid.integrate(seen, scan, surface)
        keys.keep(seen, scan, surface, IDS, points(wrong))
    return grid, keys, wrong


def test_a_correction_of_the_landmarks_redraws_the_map_where_it_belongs() -> None:
    grid, keys, _ = drawn(np.array([0.3, -0.2, 0.05]))
    assert keys.redraw_if_moved(grid, CORNERS, IDS)
    truth, _, _ = drawn(np.zeros(3))
    # No doubled walls: the redrawn map is the one drawn from the true poses.
    a, b = grid.classes(), truth.classes()
    r, c = np.array(truth.lattice_origin) - np.array(grid.lattice_origin)
    a = a[r : r + b.shape[0], c : c + b.shape[1]]
    assert np.mean((a == OCCUPIED)[b == OCCUPIED]) > 0.85
    assert np.mean((a == FREE)[b == FREE]) > 0.99
    np.testing.assert_allclose(keys.poses[3], [2.5, 2.0, 0.3], atol=1e-3)


def test_less_than_half_a_cell_is_left_alone() -> None:
    grid, keys, wrong = drawn(np.array([0.3, -0.2, 0.05]))
    before = grid.log_odds.copy()
    assert not keys.redraw_if_moved(grid, wrong + 0.01, IDS)
    np.testing.assert_array_equal(grid.log_odds, before)
    assert grid.revision == 0


def test_a_dropped_landmark_is_passed_over() -> None:
    grid, keys, wrong = drawn(np.zeros(3))
    row_of_id = np.array([0, 1, -1, 2])
    moved = wrong[[0, 1, 3]] + np.array([0.2, 0.0])
    assert keys.redraw_if_moved(grid, moved, row_of_id)
    np.testing.assert_allclose(keys.poses[0], [1.2, 2.0, 0.0], atol=5e-3)


def test_a_wall_takes_a_scan_along_and_what_it_leaves_open_follows_the_scan_before() -> None:
    """Three corners and then one wall alone: it says how far off and which way, the scan before how far along."""
    keys, grid = KeyScans(), OccupancyGrid()
    scan = room_scan(np.array([2.0, 2.0, 0.0]))
    surface = np.full(len(scan.ranges), -1, np.int16)
    keys.keep(np.array([1.0, 2.0, 0.1]), scan, surface, IDS[:3], points(CORNERS[:3]))
    for x in (2.0, 3.0):
        keys.keep(np.array([x, 2.0, 0.2]), scan, surface, np.array([3]), np.array([[0.5 * np.pi, 5.0, 1.0]]))
    moved = np.vstack([CORNERS[:3] + np.array([0.4, 0.0]), [0.5 * np.pi + 0.02, 5.0]])
    assert keys.redraw_if_moved(grid, moved, np.arange(4))
    np.testing.assert_allclose(keys.poses[0], [1.4, 2.0, 0.1], atol=1e-2)
    for k, x in ((1, 2.4), (2, 3.4)):
        np.testing.assert_allclose(keys.poses[k, [0, 2]], [x, 0.22], atol=1e-2)
        normal = np.array([-np.sin(0.02), np.cos(0.02)])
        assert abs(5.0 - normal @ keys.poses[k, :2] - 3.0) < 2e-3  # as far from the wall as it was seen


def test_walls_that_are_nearly_parallel_do_not_move_a_scan_along_them() -> None:
    keys, scan = KeyScans(), room_scan(np.array([2.0, 2.0, 0.0]))
    walls = np.array([[0.5 * np.pi, 5.0, 1.0], [0.5 * np.pi + 0.005, 5.0, 1.0]])
    keys.keep(np.array([1.0, 2.0, 0.1]), scan, np.full(len(scan.ranges), -1, np.int16), IDS[:2], walls)
    assert keys.redraw_if_moved(OccupancyGrid(), walls[:, :2] + [[0.0, 0.05], [0.0, 0.02]], IDS)
    np.testing.assert_allclose(keys.poses[0], [1.0, 2.035, 0.1], atol=0.005)


def test_the_normal_of_a_wall_may_turn_about() -> None:
    """A wall whose map passes the origin has the opposite normal afterwards, and is the same wall."""
    keys, grid = KeyScans(), OccupancyGrid()
    scan = room_scan(np.array([2.0, 2.0, 0.0]))
    wall, surface = np.array([[0.0, 0.05, 1.0]]), np.full(len(scan.ranges), -1, np.int16)
    for y in (0.0, 0.5):
        keys.keep(np.array([-2.0, y, 0.0]), scan, surface, np.zeros(1, np.int64), wall)
    assert keys.redraw_if_moved(grid, np.array([[np.pi, 0.05]]), np.zeros(1, np.int64))
    np.testing.assert_allclose(keys.poses, [[-2.1, 0.0, 0.0], [-2.1, 0.5, 0.0]], atol=5e-3)


@given(st.integers(0, 2**32 - 1))
def test_least_squares_over_points_and_walls(seed: int) -> None:
    """The correction agrees with a general solver's, for any landmarks that moved a little."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 9))
    walls = rng.random(n) < 0.5
    marks = np.column_stack([rng.uniform(-6, 6, (n, 2)), walls])
    marks[walls, 0], marks[walls, 1] = rng.uniform(-3, 3, walls.sum()), rng.uniform(0.5, 5, walls.sum())
    pose = rng.uniform([-3, -3, -3], [3, 3, 3])
    keys, scan = KeyScans(), room_scan(np.array([2.0, 2.0, 0.0]))
    for _ in range(2):
        keys.keep(pose, scan, np.full(len(scan.ranges), -1, np.int16), np.arange(n), marks)
    now = marks[:, :2] + rng.normal(0, 0.03, (n, 2))
    before = pose.copy()

    def residuals(q: np.ndarray) -> list[float]:
        out = [*(q[:2] - before[:2]) / 0.1, (q[2] - before[2]) / 0.02]
        for k in range(n):
            if walls[k]:
                far = marks[k, 1] - pose[0] * np.cos(marks[k, 0]) - pose[1] * np.sin(marks[k, 0])
                here = now[k, 1] - q[0] * np.cos(now[k, 0]) - q[1] * np.sin(now[k, 0])
                out += [(now[k, 0] - marks[k, 0] - (q[2] - pose[2])) / 0.005, (here - far) / 0.02]
            else:
                local = compose(inverse(pose), np.array([*marks[k, :2], 0.0]))
                out += [*(compose(q, local)[:2] - now[k]) / 0.02]
        return out

    first = before = least_squares(residuals, pose, xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    second = least_squares(residuals, first, xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    shift = np.array([first, second]) - pose
    assume(np.max(np.hypot(*shift[:, :2].T) + 4.0 * np.abs(shift[:, 2])) > 0.026)
    assert keys.redraw_if_moved(OccupancyGrid(), now, np.arange(n))
    np.testing.assert_allclose(keys.poses[0], first, atol=3e-4)
    np.testing.assert_allclose(keys.poses[1], second, atol=3e-4)


def test_only_scans_from_new_places_are_kept() -> None:
    keys = KeyScans(KeyScanConfig(spacing_m=0.2, spacing_rad=0.25))
    scan = room_scan(np.array([2.0, 2.0, 0.0]))
    surface = np.full(len(scan.ranges), -1, np.int16)
    for x, theta in ((0.0, 0.0), (0.1, 0.0), (0.21, 0.0), (0.21, 0.2), (0.21, 0.3)):
        if keys.wants(x, 0.0, theta):
            keys.keep(np.array([x, 0.0, theta]), scan, surface, IDS, points(CORNERS))
    np.testing.assert_allclose(keys.poses, [[0, 0, 0], [0.21, 0, 0], [0.21, 0, 0.3]])
    for k in range(200):
        keys.keep(np.array([k, 1.0, 0.0]), scan, surface, IDS, points(CORNERS))
    assert len(keys) == 203


def test_how_unsure_the_old_drawing_is_around_a_place() -> None:
    keys, scan = KeyScans(), room_scan(np.array([2.0, 2.0, 0.0]))
    none, surface = np.zeros(0, np.int64), np.full(len(scan.ranges), -1, np.int16)
    for k in range(150):
        assert k > 100 or keys.old_variance(0.0, 0.0, 8.0) == 0.0
        keys.keep(np.array([float(k), 0.0, 0.0]), scan, surface, none, np.zeros((0, 3)), 0.01 * (k + 1))
    assert keys.old_variance(10.0, 0.0, 5.5) == pytest.approx(0.16)
    assert keys.old_variance(48.0, 0.0, 5.5) == pytest.approx(0.5)  # the hundred after it are not old
    assert keys.old_variance(100.0, 0.0, 5.5) == 0.0
    keys.put_back(OccupancyGrid(), keys.poses[:112])
    assert keys.old_variance(10.0, 0.0, 5.5) == pytest.approx(0.12)
