"""What a lidar is expected to see, against rays by the simple way and against fitted lines."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from agents.view_points.sightings import SensorModel, expected_sightings
from agents.ways import cost_map as cost_maps
from agents.ways.cost_map import PlannerConfig
from mecanum_env.config import LidarConfig, RobotConfig
from slam import geometry
from slam.grids.occupancy import FREE
from slam.types import LINE
from tests.agents.grids import belief_of, fill, room

LIDAR, ROBOT = LidarConfig(), RobotConfig()
HALL = room(30.0, 4.0)
CORNERS = np.array([[0.1, 0.1], [7.9, 0.1], [7.9, 3.9], [0.1, 3.9]])


def cost_map_of(belief):
    return cost_maps.build(belief, PlannerConfig(), ROBOT)


def sightings(corners, pose, model=SensorModel()):  # noqa: B008 (frozen)
    """What the model says of corners in plain sight, by the simple way: range, bearing, covariance."""
    sensor = geometry.compose(np.asarray(pose, dtype=np.float64), np.array([LIDAR.offset_m, 0.0, 0.0]))
    away = corners - sensor[:2]
    rho = np.hypot(*away.T)
    bearing = np.array([geometry.wrap_scalar(b) for b in np.arctan2(away[:, 1], away[:, 0]) - sensor[2]])
    variance = (model.corner_share * rho * LIDAR.angle_increment) ** 2 + model.corner_sigma_m**2
    cov = np.zeros((len(corners), 2, 2))
    cov[:, 0, 0], cov[:, 1, 1] = variance, variance / rho**2
    return np.column_stack([rho, bearing]), cov


def wall(x1, y1, x2, y2):
    """A wall landmark (α, r) whose ends follow each other counter-clockwise round who sees it."""
    alpha = math.atan2(x1 - x2, y2 - y1) + math.pi
    if (x1 - 3.0) * math.cos(alpha) + (y1 - 2.0) * math.sin(alpha) < 0.0:  # away from the room's inside
        alpha += math.pi
    return np.array([alpha, x1 * math.cos(alpha) + y1 * math.sin(alpha)]), np.array([x1, y1, x2, y2])


def look(classes, pose, marks, kinds, ends):
    cost_map = cost_map_of(belief_of(classes, pose))
    return expected_sightings(
        cost_map, np.array([pose]), np.array(marks), np.array(kinds), np.array(ends),
        lidar=LIDAR, model=SensorModel(), most=32,
    )  # fmt: skip


def test_what_stands_in_between_hides_corners_and_walls():
    classes = room(8.0, 4.0)
    pose = (1.5, 2.0, 0.0)
    right = wall(7.9, 0.1, 7.9, 3.9)
    marks, ends, kinds = [CORNERS[1], right[0]], [np.zeros(4), right[1]], [0.0, float(LINE)]
    seen, cov = look(classes, pose, marks, kinds, ends)
    assert seen.all() and (cov[..., 0] > 0).all() and (cov[..., 2] > 0).all()
    fill(classes, 4.0, 0.0, 4.2, 4.0)
    assert not look(classes, pose, marks, kinds, ends)[0].any()


def test_a_wall_is_seen_from_its_own_side_only_and_the_better_the_more_of_it():
    classes = room(8.0, 4.0)
    behind = wall(7.9, 0.1, 7.9, 3.9)
    turned = np.array([behind[0][0] + math.pi, -behind[0][1]])
    kinds = [float(LINE)]
    assert look(classes, (5.0, 2.0, 0.0), [behind[0]], kinds, [behind[1]])[0].all()
    assert not look(classes, (5.0, 2.0, 0.0), [turned], kinds, [behind[1]])[0].any()
    piece = wall(7.9, 1.5, 7.9, 2.5)
    _, whole_cov = look(classes, (5.0, 2.0, 0.0), [behind[0]], kinds, [behind[1]])
    _, piece_cov = look(classes, (5.0, 2.0, 0.0), [piece[0]], kinds, [piece[1]])
    assert (whole_cov[0, 0, [0, 2]] < piece_cov[0, 0, [0, 2]]).all()


@given(a=st.floats(0.2, 29.0), length=st.floats(0.7, 60.0), heading=st.floats(-3.1, 3.1))
def test_of_a_long_hall_s_wall_what_is_in_reach_is_seen(a: float, length: float, heading: float) -> None:
    pose, b = (15.0, 2.0, heading), min(a + length, 29.8)
    mark, ends = wall(b, 3.9, a, 3.9)
    seen = look(HALL, pose, [mark], [float(LINE)], [ends])[0].all()
    sensor = 15.0 + LIDAR.offset_m * math.cos(heading)

    def within(reach_m: float) -> float:
        return max(min(b, sensor + reach_m) - max(a, sensor - reach_m), 0.0)

    if within(4.0) > 1.0:
        assert seen
    if within(LIDAR.range_max_m) < 0.5:
        assert not seen


def test_a_wall_s_accuracy_is_that_of_the_fitted_line():
    """The expected covariance against the spread of straight lines fitted to noisy points."""
    rng = np.random.default_rng(0)
    away, half, sigma = 3.0, 1.5, SensorModel().range_sigma_m
    mark, ends = wall(3.2 + away, 2.0 - half, 3.2 + away, 2.0 + half)  # the sensor stands 0.2 m ahead
    classes = room(8.0, 4.0)
    _, cov = look(classes, (3.0, 2.0, 0.0), [mark], [float(LINE)], [ends])
    angles = np.arange(-math.atan2(half, away), math.atan2(half, away), LIDAR.angle_increment)
    fits = []
    for _ in range(3000):
        ranges = away / np.cos(angles) + sigma * rng.standard_normal(len(angles))
        y, x = ranges * np.sin(angles), ranges * np.cos(angles)
        slope, offset = np.polyfit(y, x, 1)
        fits.append([offset * math.cos(math.atan(slope)), math.atan(-slope)])
    spread = np.var(fits, axis=0)
    np.testing.assert_allclose(cov[0, 0, [0, 2]], spread, rtol=0.35)


def plainly_seen(cost_map, pose, point) -> bool:
    """Sight by the simple way: every cell of the line but its last ones is free."""
    sensor = geometry.compose(np.asarray(pose, dtype=np.float64), np.array([LIDAR.offset_m, 0.0, 0.0]))[:2]
    rho = float(np.hypot(*(point - sensor)))
    if not 0.05 < rho < LIDAR.range_max_m:
        return False
    steps = np.arange(0.0, rho / cost_map.resolution - 2.5, 0.7) * cost_map.resolution
    line = sensor + steps[:, None] * (point - sensor) / rho
    cells = np.floor((line - np.array(cost_map.origin)) / cost_map.resolution).astype(int)[:, ::-1]
    inside = np.all((cells >= 0) & (cells < cost_map.classes.shape), axis=1)
    return bool(inside.all() and (cost_map.classes[tuple(cells.T)] == FREE).all())


def test_sight_against_the_simple_way():
    rng = np.random.default_rng(5)
    classes = room(8.0, 4.0)
    for _ in range(12):
        x, y = rng.uniform(0.5, 7.0), rng.uniform(0.3, 3.3)
        fill(classes, x, y, x + 0.3, y + 0.3)
    corners = np.column_stack([rng.uniform(-0.5, 8.5, 200), rng.uniform(-0.5, 4.5, 200)])
    poses = np.column_stack([rng.uniform(0.3, 7.7, 10), rng.uniform(0.3, 3.7, 10), rng.uniform(-3.0, 3.0, 10)])
    cost_map = cost_map_of(belief_of(classes, (1.5, 2.0, 0.0)))
    seen, cov = expected_sightings(
        cost_map, poses, corners, np.zeros(200), np.zeros((200, 4)), lidar=LIDAR, model=SensorModel(), most=200
    )
    expected = np.array([[plainly_seen(cost_map, pose, corner) for corner in corners] for pose in poses])
    np.testing.assert_array_equal(seen, expected)
    assert 0.05 < seen.mean() < 0.95
    for pose, row, each in zip(poses, seen, cov, strict=True):
        _, simple = sightings(corners[row], pose)
        np.testing.assert_allclose(each[row][:, [0, 2]], simple[:, [0, 1], [0, 1]], rtol=1e-12)
