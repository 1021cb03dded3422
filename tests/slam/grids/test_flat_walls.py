from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from slam import Odometry, Scan
from slam.dp_slam import DpSlam, DpSlamConfig
from slam.geometry import compose, exp
from slam.grids.flat_walls import along_walls
from slam.grids.scan_matching import MatchConfig
from slam.motion import OdometryNoise
from tests.slam.simulated import ANGLE_MIN, ANGLES, INCREMENT, room_scan

LONG_M, WIDE_M = 60.0, 2.0


def corridor_scan(pose: np.ndarray, rng: np.random.Generator, reach_m: float = 8.0) -> Scan:
    """Scan a corridor of which neither end is in sight."""
    scan = room_scan(pose, rng, width=LONG_M, height=WIDE_M)
    ranges = np.where(scan.ranges < reach_m, scan.ranges, math.inf)
    return Scan(ranges, angle_min=ANGLE_MIN, angle_increment=INCREMENT, range_max=reach_m)


def ends(scan: Scan) -> np.ndarray:
    seen = np.isfinite(scan.ranges)
    r, a = scan.ranges[seen], ANGLES[seen]
    return np.column_stack([r * np.cos(a), r * np.sin(a)])


def test_a_corridor_without_an_end_does_not_hold_the_robot_back() -> None:
    """Its walls say nothing of the way along it: that is the wheels' to tell."""
    rng, share, pose = np.random.default_rng(0), 0.01, np.array([25.0, 1.0, 0.0])
    noise = OdometryNoise(
        lever_m=0.3, speed_floor_m_s=1e-4, turn_floor_rad_s=3e-4, speed_share=share, turn_share_rad_m=share / 0.3
    )
    backend = DpSlam(DpSlamConfig(odometry=noise))
    backend.reset(pose, pose_cov=1e-8 * np.eye(3))
    twist = np.array([0.5, 0.0, 0.0])
    for _ in range(150):
        pose = compose(pose, exp(0.1 * twist))
        scatter = share * 0.5 * np.array([1.0, 1.0, 1.0 / 0.3]) * rng.standard_normal(3)
        backend.predict(Odometry(twist + scatter, 0.1, (0.0, 0.0)))
        backend.update(corridor_scan(pose, rng))
    error = backend.pose - pose
    assert np.abs(error[:2]).max() < 0.15
    assert error @ np.linalg.solve(backend.pose_cov, error) / 3.0 < 4.0


def test_ends_on_a_wall_seen_flat_become_the_wall() -> None:
    points = ends(corridor_scan(np.array([25.0, 1.0, 0.0]), np.random.default_rng(1)))
    matched, drawn = along_walls(points, MatchConfig())
    assert len(matched) < len(points)
    for side in (-1.0, 1.0):
        wall = np.sort(drawn[np.sign(drawn[:, 1]) == side, 0])
        assert np.diff(wall).max() <= MatchConfig().smooth_m
        assert np.abs(drawn[:, 1]).max() < 0.5 * WIDE_M + 0.1
        # What is drawn goes a little farther than what is matched, which tells nothing of where the wall ends.
        assert wall[-1] > matched[:, 0].max() + 0.2


def test_doors_and_posts_stay_as_they_are() -> None:
    wall = np.column_stack([np.arange(-3.0, 3.01, 0.2), np.ones(31)])
    door = wall[np.abs(wall[:, 0]) > 0.45]
    _, drawn = along_walls(door, MatchConfig())
    assert not np.any(np.abs(drawn[:, 0]) < 0.3)
    post = np.array([[0.0, 0.4]])
    matched, _ = along_walls(np.vstack([wall[:15], post, wall[16:]]), MatchConfig())
    assert any(np.array_equal(point, post[0]) for point in matched)


@given(st.integers(0, 10_000), st.integers(0, 60))
def test_nothing_is_matched_that_was_not_seen_and_all_that_is_matched_is_drawn(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    points = np.cumsum(rng.uniform(-0.5, 0.5, (count, 2)), axis=0)
    matched, drawn = along_walls(points, MatchConfig())
    seen = {tuple(point) for point in points}
    assert all(tuple(point) in seen for point in matched)
    assert {tuple(point) for point in matched} <= {tuple(point) for point in drawn}
    assert np.all(np.isfinite(drawn))
