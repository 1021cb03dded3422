"""Foresight against the filter it foresees, against a batch in information form, and against common sense."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import slam
from agents.view_points.foresight import Foresight, ForesightConfig, anchoring, d_optimality, marks_of, spread_m
from agents.view_points.sightings import SensorModel, expected_sightings
from agents.ways import cost_map as cost_maps
from agents.ways.cost_map import PlannerConfig
from mecanum_env.config import LidarConfig, RobotConfig
from slam import geometry
from slam.belief import Belief
from slam.grids.occupancy import FREE
from slam.landmarks.association import predicted
from slam.motion import OdometryNoise, jacobians, move, twist_between
from slam.types import LINE, Observations, Odometry
from tests.agents.grids import belief_of, fill, room

LIDAR, ROBOT = LidarConfig(), RobotConfig()
NOISE = OdometryNoise(speed_share=0.03, turn_share_rad_m=0.08, slip_share=0.0)  # driven without jerks
CORNERS = np.array([[0.1, 0.1], [7.9, 0.1], [7.9, 3.9], [0.1, 3.9]])
STEP_S = 0.1


def foresight(**config) -> Foresight:
    return Foresight(ForesightConfig(**config), lidar=LIDAR, odometry=NOISE, step_s=STEP_S)


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


def believed(backend, classes) -> Belief:
    """A backend's belief, but over a room that is known already."""
    flat = belief_of(classes, tuple(backend.pose))
    return replace(backend.belief, grid=flat.grid)


def mapped(name: str, corners=CORNERS, *, looks: int = 3):
    """A backend that has seen corners, and driven a little, all without noise."""
    backend = slam.make(name, config={"odometry": vars_of(NOISE)})
    backend.reset((1.5, 2.0, 0.3))
    for _ in range(looks):
        see(backend, corners)
        backend.predict(Odometry((0.3, 0.05, 0.2), STEP_S))
    see(backend, corners)
    return backend


def vars_of(noise: OdometryNoise) -> dict:
    return {name: getattr(noise, name) for name in noise.__dataclass_fields__}


def see(backend, corners) -> None:
    rb, cov = sightings(corners, backend.pose)
    backend.observe(Observations(rb, cov, np.arange(len(corners))))


def drive(backend, poses, steps: int, corners) -> None:
    """Drive through poses, each in so many steps of one twist, looking after every step."""
    for a, b in pairwise(poses):
        twist = twist_between(a, b, steps * STEP_S)
        for _ in range(steps):
            backend.predict(Odometry(tuple(twist), STEP_S))
            see(backend, corners)


@pytest.mark.parametrize("name", ["ekf", "invariant-ekf"])
def test_one_step_legs_are_the_filter_itself(name):
    """Noise-free, every leg one step: the covariance that the real backend ends with, to rounding."""
    backend = mapped(name)
    belief = believed(backend, room(8.0, 4.0))
    poses = [belief.pose]
    for k in range(12):
        poses.append(move(poses[-1], np.array([0.4, 0.1, 0.5 * (-1) ** k]), STEP_S))
    times = np.r_[0.0, np.full(12, STEP_S)]
    foreseen = foresight().through(marks_of(belief), cost_map_of(belief), np.array(poses), times)
    assert (foreseen.sightings == 4).all()
    drive(backend, poses, 1, CORNERS)
    np.testing.assert_allclose(foreseen.pose_cov, backend.pose_cov, rtol=1e-7, atol=1e-13)


@pytest.mark.parametrize("name", ["ekf", "invariant-ekf"])
def test_folded_legs_are_near_the_filter(name):
    """Ten scans taken as one from the leg's end: positions within 5 %, the heading within 30 %.

    Real scans are spread over the leg, and most of what they say of the heading the next steps lose again.
    """
    backend = mapped(name)
    belief = believed(backend, room(8.0, 4.0))
    poses = [np.asarray(belief.pose)]
    for _ in range(8):
        poses.append(move(poses[-1], np.array([0.45, 0.0, 0.0]), 1.0))
    poses = np.array(poses)[:, :]
    times = np.r_[0.0, np.full(8, 1.0)]
    foreseen = foresight().through(marks_of(belief), cost_map_of(belief), poses, times)
    drive(backend, poses, 10, CORNERS)
    real = backend.pose_cov
    ratio = np.sqrt(np.diag(foreseen.pose_cov) / np.diag(real))
    np.testing.assert_allclose(ratio[:2], 1.0, atol=0.05)
    assert 0.7 < ratio[2] <= 1.0
    assert spread_m(foreseen.pose_cov, 4.0) == pytest.approx(spread_m(real, 4.0), rel=0.2)


def test_against_a_batch_in_information_form():
    """The whole trajectory and map in one information matrix, its last pose's block of the inverse."""
    backend = mapped("ekf")
    belief = believed(backend, room(8.0, 4.0))
    poses = [np.asarray(belief.pose)]
    for _ in range(5):
        poses.append(move(poses[-1], np.array([0.5, 0.0, 0.3]), 0.5))
    marks = marks_of(belief)
    n = len(marks.kinds)
    # States: the first pose and the map, then each later pose.
    size = 3 + 2 * n + 3 * 5
    information = np.zeros((size, size))
    information[: 3 + 2 * n, : 3 + 2 * n] = np.linalg.inv(marks.cov)
    looks = np.zeros_like(information)
    before = [0, 1, 2]
    for k in range(1, 6):
        now = list(range(3 + 2 * n + 3 * (k - 1), 3 + 2 * n + 3 * k))
        twist = np.array([0.5, 0.0, 0.3])
        fx, fu = jacobians(poses[k - 1], twist, 0.5)
        var_v, var_w = NOISE.variances(*twist)
        q = fu @ np.diag([var_v, var_v, var_w]) @ fu.T * (STEP_S / 0.5)
        j = np.zeros((3, size))
        j[:, before], j[:, now] = -fx, np.eye(3)
        information += j.T @ np.linalg.solve(q, j)
        _, cov = sightings(CORNERS, poses[k])
        for i in range(n):
            h = np.zeros((2, 5))
            predicted(np.concatenate([poses[k], marks.x[3:]]), i, 0.0, LIDAR.offset_m, h)
            j = np.zeros((2, size))
            j[:, now], j[:, [3 + 2 * i, 4 + 2 * i]] = h[:, :3], h[:, 3:]
            looks += j.T @ np.linalg.solve(cov[i] / 5.0, j)
        before = now
    posterior = information + looks
    gained = 0.5 * (np.linalg.slogdet(posterior)[1] - np.linalg.slogdet(information)[1])
    times = np.r_[0.0, np.full(5, 0.5)]
    foreseen = foresight().through(marks, cost_map_of(belief), np.array(poses), times)
    np.testing.assert_allclose(foreseen.pose_cov, np.linalg.inv(posterior)[-3:, -3:], rtol=1e-6, atol=1e-14)
    assert foreseen.information == pytest.approx(gained, rel=1e-6)


def test_more_landmarks_leave_less():
    spreads = []
    path = np.column_stack([np.linspace(1.5, 6.0, 20), np.full(20, 2.0)])
    for count in range(5):
        backend = mapped("invariant-ekf", CORNERS[:count])
        belief = believed(backend, room(8.0, 4.0))
        foreseen = foresight().along(marks_of(belief), cost_map_of(belief), path)
        spreads.append(d_optimality(foreseen.pose_cov))
    assert (np.diff(spreads) < 0.0).all()


def test_dead_reckoning_only_grows_and_the_determinant_is_that_of_the_invariant_error():
    belief = belief_of(room(8.0, 4.0), (1.5, 2.0, 0.0), sigma=0.02)
    path = np.column_stack([np.linspace(1.5, 7.0, 30), np.full(30, 2.0)])
    spreads = []
    for end in (5, 10, 20, 30):
        foreseen = foresight().along(marks_of(belief), cost_map_of(belief), path[:end])
        assert foreseen.information == 0.0
        spreads.append(d_optimality(foreseen.pose_cov))
        x, y = path[end - 1]
        t = np.array([[1.0, 0.0, y], [0.0, 1.0, -x], [0.0, 0.0, 1.0]])  # T⁻¹: δ → ξ
        assert d_optimality(t @ foreseen.pose_cov @ t.T) == pytest.approx(spreads[-1], rel=1e-9)
    assert (np.diff(spreads) > 0.0).all()


def test_d_optimality_is_the_geometric_mean_of_the_axes():
    cov = np.diag([4.0, 1.0, 0.25])
    assert d_optimality(cov) == pytest.approx(1.0)
    assert d_optimality(np.zeros((3, 3))) == 0.0
    assert spread_m(np.diag([1e-4, 1e-4, 1e-4 / 16.0]), 4.0) == pytest.approx(0.01)


def test_without_a_joint_covariance_and_without_landmarks():
    belief = belief_of(room(8.0, 4.0), (1.5, 2.0, 0.0))
    some = replace(belief, landmarks=CORNERS, landmark_cov=np.tile(1e-5 * np.eye(2), (4, 1, 1)))
    path = np.column_stack([np.linspace(1.5, 4.0, 10), np.full(10, 2.0)])
    bare = foresight().along(marks_of(belief), cost_map_of(belief), path)
    held = foresight().along(marks_of(some), cost_map_of(some), path)
    assert spread_m(held.pose_cov, 4.0) < 0.5 * spread_m(bare.pose_cov, 4.0)


# ---- what is seen ------------------------------------------------------------------------------------------


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


# ---- the beginning of a map --------------------------------------------------------------------------------


def test_anchoring_is_the_error_that_a_robot_inherits():
    """Leave a known place with wheels that tell nothing: the pose is what the landmarks say, and no better."""
    backend = slam.make("ekf", config={"odometry": vars_of(NOISE)})
    backend.reset((1.5, 2.0, 0.3))
    for _ in range(4):
        see(backend, CORNERS)
    marks = marks_of(backend.belief)
    expected = anchoring(marks, np.ones(4, np.bool_), LIDAR.offset_m)
    wide = np.zeros_like(marks.cov)
    wide[:3, :3] = 1e4 * np.eye(3)
    # Perfect looks at landmarks known as now, the pose not at all.
    h = np.zeros((8, 11))
    for i in range(4):
        block = np.zeros((2, 5))
        predicted(marks.x, i, 0.0, LIDAR.offset_m, block)
        h[2 * i : 2 * i + 2, :3], h[2 * i : 2 * i + 2, 3 + 2 * i : 5 + 2 * i] = block[:, :3], block[:, 3:]
    s = h @ marks.cov @ h.T
    relative = np.zeros_like(s)
    for i in range(4):  # each landmark by itself, as anchoring takes them
        relative[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = s[2 * i : 2 * i + 2, 2 * i : 2 * i + 2]
    information = h[:, :3].T @ np.linalg.solve(relative, h[:, :3])
    np.testing.assert_allclose(expected, np.linalg.inv(information), rtol=1e-6)
    assert math.isinf(anchoring(marks, np.zeros(4, np.bool_), LIDAR.offset_m)[0, 0])
    # More looks from the same place: less of it.
    for _ in range(12):
        see(backend, CORNERS)
    later = anchoring(marks_of(backend.belief), np.ones(4, np.bool_), LIDAR.offset_m)
    assert spread_m(later, 4.0) == pytest.approx(0.5 * spread_m(expected, 4.0), rel=0.1)


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
