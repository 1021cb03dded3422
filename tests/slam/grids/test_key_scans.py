from __future__ import annotations

import numpy as np

from slam.geometry import compose
from slam.grids.key_scans import KeyScanConfig, KeyScans
from slam.grids.occupancy import FREE, OCCUPIED, OccupancyGrid
from tests.slam.simulated import room_scan

CORNERS = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 5.0], [0.0, 5.0]])
IDS = np.arange(4)


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
        keys.keep(seen, scan, surface, IDS, wrong)
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
    np.testing.assert_allclose(keys.poses[3], [2.5, 2.0, 0.3], atol=1e-9)


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
    np.testing.assert_allclose(keys.poses[0], [1.2, 2.0, 0.0], atol=1e-9)


def test_only_scans_from_new_places_are_kept() -> None:
    keys = KeyScans(KeyScanConfig(spacing_m=0.2, spacing_rad=0.25))
    scan = room_scan(np.array([2.0, 2.0, 0.0]))
    surface = np.full(len(scan.ranges), -1, np.int16)
    for x, theta in ((0.0, 0.0), (0.1, 0.0), (0.21, 0.0), (0.21, 0.2), (0.21, 0.3)):
        if keys.wants(x, 0.0, theta):
            keys.keep(np.array([x, 0.0, theta]), scan, surface, IDS, CORNERS)
    np.testing.assert_allclose(keys.poses, [[0, 0, 0], [0.21, 0, 0], [0.21, 0, 0.3]])
    for k in range(200):
        keys.keep(np.array([k, 1.0, 0.0]), scan, surface, IDS, CORNERS)
    assert len(keys) == 203
