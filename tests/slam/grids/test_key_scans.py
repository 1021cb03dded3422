from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam.geometry import compose, inverse, wrap
from slam.grids.key_scans import KeyScanConfig, KeyScans
from slam.grids.occupancy import FREE, OCCUPIED, OccupancyGrid
from tests.slam.simulated import room_scan

CORNERS = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 5.0], [0.0, 5.0]])
IDS = np.arange(4)


def points(places: np.ndarray) -> np.ndarray:
    return np.column_stack([places, np.zeros(len(places))])


def marks_from(pose: np.ndarray, marks: np.ndarray) -> np.ndarray:
    """Return the marks ``(k, 2)`` that the same measurements give from another pose, made from the origin's."""
    points = [compose(pose, np.array([*m[:2], 0.0]))[:2] for m in marks]
    lines = [(a := m[0] + pose[2], m[1] + pose[0] * np.cos(a) + pose[1] * np.sin(a)) for m in marks]
    return np.where(marks[:, 2:] > 0, lines, points).reshape(-1, 2)


def rigid(pose: np.ndarray, marks: np.ndarray, pose_cov: np.ndarray) -> np.ndarray:
    """Return the covariance of an unsure pose ``(3,)`` and of marks ``(k, 3)`` measured well from there."""
    local = np.column_stack([marks_from(inverse(pose), marks), marks[:, 2]])
    step = 1e-6
    ways = step * np.eye(3)
    jacobian = np.column_stack([
        ((marks_from(pose + d, local) - marks_from(pose - d, local)) / (2 * step)).ravel() for d in ways
    ])  # fmt: skip
    both = np.vstack([np.eye(3), jacobian])
    cov = both @ pose_cov @ both.T
    cov[3:, 3:] += 1e-6 * np.eye(2 * len(marks))
    return cov


UNSURE = np.diag([0.5, 0.5, 0.1]) ** 2


def keep(keys: KeyScans, pose: list[float], ids: np.ndarray, marks: np.ndarray) -> None:
    """Keep a scan of a pose that is unsure, with marks measured well from there."""
    scan, at = room_scan(np.array([2.0, 2.0, 0.0])), np.array(pose)
    keys.keep(at, scan, np.full(len(scan.ranges), -1, np.int16), ids, marks, rigid(at, marks, UNSURE))


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
        keys.keep(seen, scan, surface, IDS, points(wrong), rigid(seen, points(wrong), UNSURE))
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


def test_a_scan_that_is_surer_than_its_landmarks_stays() -> None:
    """Landmarks that were seen badly are corrected; the scan was never off, so its walls are not drawn aside."""
    keys, pose, marks = KeyScans(), np.array([1.0, 2.0, 0.1]), points(CORNERS)
    scan = room_scan(pose)
    cov = rigid(pose, marks, 0.003**2 * np.eye(3))
    cov[3:, 3:] += 0.2**2 * np.eye(8)
    keys.keep(pose, scan, np.full(len(scan.ranges), -1, np.int16), IDS, marks, cov)
    assert not keys.redraw_if_moved(OccupancyGrid(), CORNERS + np.array([0.3, 0.0]), IDS)


def test_a_wall_takes_a_scan_along_and_what_it_leaves_open_follows_the_scan_before() -> None:
    """Three corners and then one wall alone: it says how far off and which way, the scan before how far along."""
    keys, grid = KeyScans(), OccupancyGrid()
    keep(keys, [1.0, 2.0, 0.1], IDS[:3], points(CORNERS[:3]))
    for x in (2.0, 3.0):
        keep(keys, [x, 2.0, 0.2], np.array([3]), np.array([[0.5 * np.pi, 5.0, 1.0]]))
    moved = np.vstack([CORNERS[:3] + np.array([0.4, 0.0]), [0.5 * np.pi + 0.02, 5.0]])
    assert keys.redraw_if_moved(grid, moved, np.arange(4))
    np.testing.assert_allclose(keys.poses[0], [1.4, 2.0, 0.1], atol=1e-2)
    for k, x in ((1, 2.4), (2, 3.4)):
        np.testing.assert_allclose(keys.poses[k, [0, 2]], [x, 0.22], atol=2e-2)
        normal = np.array([-np.sin(0.02), np.cos(0.02)])
        assert abs(5.0 - normal @ keys.poses[k, :2] - 3.0) < 2e-3  # as far from the wall as it was seen


def test_walls_that_are_nearly_parallel_do_not_move_a_scan_along_them() -> None:
    keys, ids = KeyScans(), np.arange(6)
    walls = np.array([[0.5 * np.pi, 5.0, 1.0], [0.5 * np.pi + 0.0005, 5.0, 1.0]])
    keep(keys, [0.8, 2.0, 0.1], IDS, points(CORNERS))
    keep(keys, [1.0, 2.0, 0.1], ids[4:], walls)
    now = np.vstack([CORNERS, walls[:, :2] + [[0.0, 0.05], [0.0, 0.048]]])
    assert keys.redraw_if_moved(OccupancyGrid(), now, ids)
    np.testing.assert_allclose(keys.poses[1], [1.0, 2.049, 0.1], atol=0.005)


def test_the_normal_of_a_wall_may_turn_about() -> None:
    """A wall whose map passes the origin has the opposite normal afterwards, and is the same wall."""
    keys, grid, wall = KeyScans(), OccupancyGrid(), np.array([[0.0, 0.05, 1.0]])
    for y in (0.0, 0.5):
        keep(keys, [-2.0, y, 0.0], np.zeros(1, np.int64), wall)
    assert keys.redraw_if_moved(grid, np.array([[np.pi, 0.05]]), np.zeros(1, np.int64))
    np.testing.assert_allclose(keys.poses, [[-2.1, 0.0, 0.0], [-2.1, 0.5, 0.0]], atol=5e-3)


@given(st.integers(0, 2**32 - 1))
def test_the_pose_is_what_a_joint_gaussian_makes_of_the_corrected_landmarks(seed: int) -> None:
    """The filter's past pose as a state of its own: E[q | landmarks, scan before], for any small correction."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 9))
    marks = np.column_stack([rng.uniform(-6, 6, (n, 2)), rng.random(n) < 0.5])
    walls = marks[:, 2] > 0
    marks[walls, 0], marks[walls, 1] = rng.uniform(-3, 3, walls.sum()), rng.uniform(0.5, 5, walls.sum())
    pose, ahead = rng.uniform([-3, -3, -3], [3, 3, 3]), 0.2
    body = pose - [ahead * np.cos(pose[2]), ahead * np.sin(pose[2]), 0.0]
    root = rng.normal(0.0, 1.0, (3 + 2 * n, 3 + 2 * n)) * rng.uniform(0.01, 0.3, 3 + 2 * n)[:, None]
    cov = root @ root.T + 1e-4 * np.eye(3 + 2 * n)
    keys, scan = KeyScans(), room_scan(np.array([2.0, 2.0, 0.0]))
    surface = np.full(len(scan.ranges), -1, np.int16)
    for _ in range(2):
        keys.keep(pose, scan, surface, np.arange(n), marks, cov, ahead_m=ahead)
    change = rng.normal(0, 1e-5, (n, 2))

    lever = np.eye(3)
    lever[:2, 2] = pose[1::-1] - body[1::-1]
    lever[0, 2] *= -1.0
    p_ab, p_bb = lever @ cov[:3, 3:], cov[3:, 3:]
    seen = p_ab @ np.linalg.solve(p_bb, change.ravel())
    rest = lever @ cov[:3, :3] @ lever.T - p_ab @ np.linalg.solve(p_bb, p_ab.T)
    way = np.diag([0.01, 0.01, 0.0025]) ** 2
    by_way = rest @ np.linalg.inv(rest + way)
    first = seen  # nothing lies before it
    second = seen + by_way @ (first - seen)
    got, _ = keys._corrected(marks[:, :2] + change, np.arange(n))
    size = np.abs(seen).max()
    np.testing.assert_allclose(got[:, :2] - pose[:2], [first[:2], second[:2]], atol=0.01 * size + 1e-7)
    np.testing.assert_allclose(wrap(got[:, 2] - pose[2]), [first[2], second[2]], atol=0.01 * size + 1e-7)


@given(st.integers(0, 2**32 - 1))
def test_landmarks_that_are_gone_let_nothing_run_away(seed: int) -> None:
    """Whatever is left of its landmarks, a scan moves hardly farther than they do; a rigid motion is followed."""
    rng = np.random.default_rng(seed)
    keys, ids = KeyScans(), np.arange(8)
    marks = points(rng.uniform(-6, 6, (8, 2)))
    scan, surface = room_scan(np.array([2.0, 2.0, 0.0])), np.full(360, -1, np.int16)
    for k in range(6):
        pose = np.array([0.2 * k, 0.0, 0.1])
        root = rng.normal(0.0, 1.0, (19, 19)) * 0.02
        keys.keep(pose, scan, surface, ids, marks, rigid(pose, marks, UNSURE) + root @ root.T)
    shift = rng.uniform(-0.1, 0.1, 2)
    rows = np.where(rng.random(8) < rng.random(), -1, ids)
    got, _ = keys._corrected(marks[:, :2] + shift, rows)
    off = np.hypot(*(got - keys.poses)[:, :2].T)
    assert off.max() < 1.5 * np.hypot(*shift) + 0.01
    if (rows >= 0).sum() >= 4:
        np.testing.assert_allclose((got - keys.poses)[-1, :2], shift, atol=0.3 * np.abs(shift).max() + 0.01)


@pytest.mark.parametrize("along", [0, 15])
def test_a_scan_just_kept_stays_where_it_is_after_a_closed_loop(along: int) -> None:
    """What the scans before it moved by, they moved before it was kept: it is not carried on for good."""
    keys, corners, wall = KeyScans(), points(CORNERS), np.array([[0.5 * np.pi, 5.0, 1.0]])
    ids, scan = np.arange(5), room_scan(np.array([2.0, 2.0, 0.0]))
    surface = np.full(len(scan.ranges), -1, np.int16)
    for x in (1.0, 1.2):
        keep(keys, [x, 2.0, 0.1], IDS, corners)
    before = np.vstack([CORNERS, wall[:, :2]])
    for k in range(along):
        pose = np.array([1.4 + 0.2 * k, 2.0, 0.1])
        keys.keep(pose, scan, surface, ids[4:], wall, rigid(pose, wall, UNSURE), before, ids)
    now = np.vstack([CORNERS + np.array([0.4, 0.0]), wall[:, :2]])
    for x in (1.8, 2.0):  # after the loop has closed, with a wall in sight
        pose = np.array([x, 2.0, 0.1])
        keys.keep(pose, scan, surface, ids[4:], wall, rigid(pose, wall, UNSURE), now, ids)
    got, _ = keys._corrected(now, ids)
    np.testing.assert_allclose(got[:2, 0], [1.4, 1.6], atol=0.01)
    np.testing.assert_allclose(got[-2:], [[1.8, 2.0, 0.1], [2.0, 2.0, 0.1]], atol=5e-3)


def test_landmarks_that_are_there_again_hold_a_scan_again() -> None:
    """As after a belief was put back to before it was lost: what was dropped meanwhile never was."""
    keys, shift = KeyScans(), np.array([0.3, 0.1])
    keep(keys, [1.0, 2.0, 0.1], IDS, points(CORNERS))
    none = np.full(4, -1)
    still, _ = keys._corrected(CORNERS + shift, none)
    np.testing.assert_allclose(still[0], [1.0, 2.0, 0.1])
    again, _ = keys._corrected(CORNERS + shift, IDS)
    np.testing.assert_allclose(again[0], [1.3, 2.1, 0.1], atol=5e-3)


def test_only_scans_from_new_places_are_kept() -> None:
    keys = KeyScans(KeyScanConfig(spacing_m=0.2, spacing_rad=0.25))
    scan = room_scan(np.array([2.0, 2.0, 0.0]))
    surface = np.full(len(scan.ranges), -1, np.int16)
    cov = np.eye(11)
    for x, theta in ((0.0, 0.0), (0.1, 0.0), (0.21, 0.0), (0.21, 0.2), (0.21, 0.3)):
        if keys.wants(x, 0.0, theta):
            keys.keep(np.array([x, 0.0, theta]), scan, surface, IDS, points(CORNERS), cov)
    np.testing.assert_allclose(keys.poses, [[0, 0, 0], [0.21, 0, 0], [0.21, 0, 0.3]])
    for k in range(200):
        keys.keep(np.array([k, 1.0, 0.0]), scan, surface, IDS, points(CORNERS), cov)
    assert len(keys) == 203


def test_how_unsure_the_old_drawing_is_around_a_place() -> None:
    keys, scan = KeyScans(), room_scan(np.array([2.0, 2.0, 0.0]))
    none, surface = np.zeros(0, np.int64), np.full(len(scan.ranges), -1, np.int16)
    for k in range(150):
        assert k > 100 or keys.old_variance(0.0, 0.0, 8.0) == 0.0
        keys.keep(
            np.array([float(k), 0.0, 0.0]),
            scan,
            surface,
            none,
            np.zeros((0, 3)),
            np.eye(3),
            variance=0.01 * (k + 1),
        )
    assert keys.old_variance(10.0, 0.0, 5.5) == pytest.approx(0.16)
    assert keys.old_variance(48.0, 0.0, 5.5) == pytest.approx(0.5)  # the hundred after it are not old
    assert keys.old_variance(100.0, 0.0, 5.5) == 0.0
    keys.put_back(OccupancyGrid(), keys.poses[:112])
    assert keys.old_variance(10.0, 0.0, 5.5) == pytest.approx(0.12)
