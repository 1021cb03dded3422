"""Ray casting against brute force and pymunk; the sensors' noise against what the config declares."""

from __future__ import annotations

import math

import numpy as np
import pymunk
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from mecanum_env.config import LIDAR_PRESETS, NOISE_PRESETS, ROBOT_PRESETS, LidarConfig, NoiseConfig
from mecanum_env.physics.robot import WheelTargets, forward_kinematics, forward_matrix
from mecanum_env.physics.world import World
from mecanum_env.rooms.floor_plan import FloorPlan
from mecanum_env.sensing.noise import noise_stream
from mecanum_env.sensing.raycast import beam_directions, cast_rays
from mecanum_env.sensing.sensors import _CREEP, Lidar, WheelEncoders

Array = NDArray[np.float64]

NO_CIRCLES = np.zeros((0, 3))
NO_SEGMENTS = np.zeros((0, 4))
EXACT = NoiseConfig(encoder=0, radius_error=0, base_error=0, range_sigma_m=0, dropout=0)
SQUARE = np.array([[0, 0, 4, 0], [4, 0, 4, 4], [4, 4, 0, 4], [0, 4, 0, 0]], dtype=np.float64)


def cast(
    segments: Array,
    circles: Array,
    pose: tuple[float, float, float],
    *,
    beams: int = 360,
    angle_min: float = -math.pi,
    increment: float | None = None,
    range_max: float = 20.0,
) -> Array:
    step = 2 * math.pi / beams if increment is None else increment
    out = np.full(beams, -1.0)
    cast_rays(segments, circles, *pose, beam_directions(beams, angle_min, step), angle_min, step, range_max, out)
    return out


def brute_force(
    segments: Array,
    circles: Array,
    pose: tuple[float, float, float],
    *,
    beams: int = 360,
    angle_min: float = -math.pi,
    increment: float | None = None,
    range_max: float = 20.0,
) -> tuple[Array, Array]:
    """Return ranges, every beam against every surface, and how close each beam passes an end point [m]."""
    x, y, theta = pose
    angles = theta + angle_min + (2 * math.pi / beams if increment is None else increment) * np.arange(beams)
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    ranges, miss = np.full(beams, np.inf), np.full(beams, np.inf)
    for x1, y1, x2, y2 in segments:
        a, e = np.array([x1 - x, y1 - y]), np.array([x2 - x1, y2 - y1])
        with np.errstate(all="ignore"):
            across = directions[:, 0] * e[1] - directions[:, 1] * e[0]
            t = (a[0] * e[1] - a[1] * e[0]) / across
            u = (a[0] * directions[:, 1] - a[1] * directions[:, 0]) / across
        hit = (t >= 0) & (u >= 0) & (u <= 1)
        ranges[hit] = np.minimum(ranges[hit], t[hit])
        for end in (a, a + e):
            ahead = directions @ end > 0
            off = np.abs(directions[:, 0] * end[1] - directions[:, 1] * end[0])
            miss = np.minimum(miss, np.where(ahead, off, np.inf))
    for cx, cy, radius in circles:
        centre = np.array([cx - x, cy - y])
        along = directions @ centre
        inside = along**2 - centre @ centre + radius**2
        t = along - np.sqrt(np.maximum(inside, 0))
        hit = (inside >= 0) & (t >= 0)
        ranges[hit] = np.minimum(ranges[hit], t[hit])
        if centre @ centre <= radius**2:
            ranges[:] = 0.0
        miss = np.minimum(miss, np.where(along > 0, np.abs(np.sqrt(centre @ centre - along**2) - radius), np.inf))
    ranges[ranges > range_max] = np.inf
    return ranges, miss


def random_scene(rng: np.random.Generator) -> tuple[Array, Array, tuple[float, float, float]]:
    segments = rng.uniform(-6, 6, (rng.integers(0, 15), 4))
    circles = np.column_stack([rng.uniform(-6, 6, (2, 2)), rng.uniform(0.05, 1.0, 2)])
    x, y = rng.uniform(-5, 5, 2)
    outside = np.hypot(circles[:, 0] - x, circles[:, 1] - y) > circles[:, 2]
    return segments, circles[outside], (float(x), float(y), float(rng.uniform(-8, 8)))


def assert_agree(found: Array, expected: Array, miss: Array, tolerance: float = 1e-6) -> None:
    clear = miss > 1e-6  # of end points; near one, either answer will do
    assert np.mean(clear) > 0.9
    np.testing.assert_array_equal(np.isinf(found[clear]), np.isinf(expected[clear]))
    hit = clear & np.isfinite(expected)
    np.testing.assert_allclose(found[hit], expected[hit], rtol=0, atol=tolerance)


# ---- ray casting -------------------------------------------------------------------------------------------


@given(seed=st.integers(0, 2**32 - 1))
def test_a_full_circle_agrees_with_brute_force(seed: int) -> None:
    rng = np.random.default_rng(seed)
    segments, circles, pose = random_scene(rng)
    beams, range_max = int(rng.integers(8, 720)), float(rng.uniform(1, 12))
    found = cast(segments, circles, pose, beams=beams, range_max=range_max)
    assert_agree(found, *brute_force(segments, circles, pose, beams=beams, range_max=range_max))


@given(seed=st.integers(0, 2**32 - 1))
def test_a_sector_agrees_with_brute_force(seed: int) -> None:
    rng = np.random.default_rng(seed)
    segments, circles, pose = random_scene(rng)
    beams = int(rng.integers(8, 400))
    increment = math.radians(float(rng.uniform(5, 359))) / (beams - 1)
    angle_min = float(rng.uniform(-7, 7))
    options = {"beams": beams, "angle_min": angle_min, "increment": increment}
    found = cast(segments, circles, pose, **options)  # type: ignore[arg-type]
    assert_agree(found, *brute_force(segments, circles, pose, **options))  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", range(5))
def test_agrees_with_pymunk(seed: int) -> None:
    rng = np.random.default_rng(seed)
    segments, circles, pose = random_scene(rng)
    space = pymunk.Space()
    for x1, y1, x2, y2 in segments:
        space.add(pymunk.Segment(space.static_body, (x1, y1), (x2, y2), 0))
    for x, y, radius in circles:
        space.add(pymunk.Circle(space.static_body, radius, (x, y)))
    expected = np.full(360, np.inf)
    for k in range(360):
        angle = pose[2] - math.pi + k * math.radians(1)
        end = (pose[0] + 20 * math.cos(angle), pose[1] + 20 * math.sin(angle))
        hit = space.segment_query_first((pose[0], pose[1]), end, 0, pymunk.ShapeFilter())
        if hit is not None:
            expected[k] = 20 * hit.alpha
    assert_agree(cast(segments, circles, pose), expected, brute_force(segments, circles, pose)[1])


@given(
    walls=st.lists(st.tuples(*[st.integers(-3, 3)] * 4).filter(lambda w: w[:2] != w[2:]), max_size=6),
    x=st.integers(-3, 3),
    y=st.integers(-3, 3),
    quarter=st.integers(0, 3),
)
def test_sensors_on_a_wall_or_in_line_with_one(
    walls: list[tuple[int, int, int, int]], x: int, y: int, quarter: int
) -> None:
    segments = np.array(walls, dtype=np.float64).reshape(-1, 4)
    pose = (float(x), float(y), quarter * math.pi / 2)
    found = cast(segments, NO_CIRCLES, pose, beams=72)
    expected, miss = brute_force(segments, NO_CIRCLES, pose, beams=72)
    on_wall = [
        (x1 - x) * (y2 - y) == (y1 - y) * (x2 - x) and (x1 - x) * (x2 - x) + (y1 - y) * (y2 - y) <= 0
        for x1, y1, x2, y2 in walls
    ]
    if any(on_wall):
        assert np.all(found == 0.0)
    else:
        clear = miss > 1e-6
        np.testing.assert_allclose(found[clear], expected[clear], atol=1e-9)
        # Through an end point, the beam stops there or goes on; it never stops short.
        assert np.all(found[~clear] <= expected[~clear] + 1e-9)


def test_a_wall_seen_edge_on_is_as_near_as_its_nearer_end() -> None:
    found = cast(np.array([[3.0, 1.0, 2.0, 1.0]]), NO_CIRCLES, (0.5, 1.0, 0.0))
    assert found[180] == pytest.approx(1.5, abs=1e-12)
    assert np.isinf(np.delete(found, 180)).all()


@given(
    corners=st.lists(st.floats(0.5, 5.0), min_size=3, max_size=12),
    x=st.floats(-0.1, 0.1),
    y=st.floats(-0.1, 0.1),
    beams=st.integers(8, 500),
)
def test_no_ray_slips_out_where_walls_meet(corners: list[float], x: float, y: float, beams: int) -> None:
    # The walls' corners lie on the beams themselves.
    angles = -math.pi + 2 * math.pi / len(corners) * np.arange(len(corners))
    points = np.array([x, y]) + np.array(corners)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    found = cast(
        np.hstack([points, np.roll(points, -1, axis=0)]), NO_CIRCLES, (x, y, 0.0), beams=len(corners) * beams
    )
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[::beams], corners, atol=1e-6)


def test_ranges_in_a_square_room() -> None:
    found = cast(SQUARE, NO_CIRCLES, (1.0, 1.5, 0.0))
    np.testing.assert_allclose(found[[0, 90, 180, 270]], [1.0, 1.5, 3.0, 2.5], atol=1e-12)
    turned = cast(SQUARE, NO_CIRCLES, (1.0, 1.5, math.pi / 2))
    np.testing.assert_allclose(turned[[0, 90, 180, 270]], [1.5, 3.0, 2.5, 1.0], atol=1e-12)


def test_nothing_beyond_the_maximum_range() -> None:
    found = cast(SQUARE, NO_CIRCLES, (1.0, 1.5, 0.0), range_max=2.0)
    assert np.isinf(found[180])
    assert found[90] == pytest.approx(1.5)
    assert np.all((found <= 2.0) | np.isinf(found))


def test_inside_a_solid_disc_everything_is_at_hand() -> None:
    assert np.all(cast(NO_SEGMENTS, np.array([[0.0, 0.0, 1.0]]), (0.3, 0.0, 0.0)) == 0.0)


# ---- lidar -------------------------------------------------------------------------------------------------


def test_the_lidar_is_mounted_ahead_of_the_centre() -> None:
    lidar = Lidar(LidarConfig(offset_m=0.25), EXACT)
    scan = lidar.scan(SQUARE, NO_CIRCLES, (1.0, 2.0, math.pi / 2), np.random.default_rng(0))
    assert scan.ranges[180] == pytest.approx(4.0 - 2.25)  # ahead
    assert scan.ranges[90] == pytest.approx(3.0)  # right
    assert (scan.angle_min, scan.range_max, scan.range_min) == (-math.pi, 8.0, 0.02)


def test_a_sector_looks_ahead() -> None:
    lidar = Lidar(LIDAR_PRESETS["cavity"], EXACT)
    wall = np.array([[2.0, -0.3, 2.0, 0.3]])
    scan = lidar.scan(wall, NO_CIRCLES, (0.0, 0.0, 0.0), np.random.default_rng(0))
    assert scan.ranges.shape == (121,)
    assert scan.ranges[60] == pytest.approx(2.0 - 0.08)
    assert np.isinf(scan.ranges[[0, 120]]).all()


def test_range_noise_and_dropouts_are_as_declared() -> None:
    noise = NoiseConfig(range_sigma_m=0.02, dropout=0.03)
    lidar = Lidar(LidarConfig(), noise)
    pose = np.array([1.7, 1.5, 0.2])
    true = lidar.true_ranges(SQUARE, NO_CIRCLES, pose)
    rng = np.random.default_rng(1)
    errors = np.array([lidar.scan(SQUARE, NO_CIRCLES, pose, rng).ranges - true for _ in range(300)])
    lost = np.isnan(errors)
    n = errors.size
    assert np.mean(lost) == pytest.approx(0.03, abs=4 * math.sqrt(0.03 * 0.97 / n))
    good = errors[~lost]
    assert np.mean(good) == pytest.approx(0.0, abs=4 * 0.02 / math.sqrt(n))
    assert np.std(good) == pytest.approx(0.02, rel=4 / math.sqrt(2 * n))
    # Neighbouring beams and successive scans do not know of each other.
    filled = np.where(lost, 0.0, errors)
    assert abs(np.corrcoef(filled[:, :-1].ravel(), filled[:, 1:].ravel())[0, 1]) < 4 / math.sqrt(n)
    assert abs(np.corrcoef(filled[:-1].ravel(), filled[1:].ravel())[0, 1]) < 4 / math.sqrt(n)


def test_too_near_is_no_measurement_and_too_far_no_return() -> None:
    config = LidarConfig(range_min_m=0.5, range_max_m=2.5, offset_m=0.0)
    scan = Lidar(config, EXACT).scan(SQUARE, NO_CIRCLES, (0.3, 2.0, 0.0), np.random.default_rng(0))
    assert np.isnan(scan.ranges[0])
    assert np.isinf(scan.ranges[180])
    assert scan.ranges[90] == pytest.approx(2.0)
    noisy = NoiseConfig(range_sigma_m=0.5, dropout=0)
    ranges = Lidar(config, noisy).scan(SQUARE, NO_CIRCLES, (2.0, 2.0, 0.0), np.random.default_rng(0)).ranges
    known = ranges[np.isfinite(ranges)]
    assert known.min() >= 0.5
    assert known.max() <= 2.5


def test_noise_does_not_depend_on_the_scene() -> None:
    lidar = Lidar(LidarConfig(), NOISE_PRESETS["slippery"])
    after = []
    for segments, circles in ((SQUARE, NO_CIRCLES), (NO_SEGMENTS, np.array([[3.0, 2.0, 0.4]]))):
        rng = np.random.default_rng(4)
        lidar.scan(segments, circles, (2.0, 2.0, 0.0), rng)
        after.append(rng.random())
    assert after[0] == after[1]


def test_scans_are_fresh_arrays() -> None:
    lidar = Lidar(LidarConfig(), EXACT)
    first = lidar.scan(SQUARE, NO_CIRCLES, (2.0, 2.0, 0.0), np.random.default_rng(0)).ranges
    copy = first.copy()
    lidar.scan(SQUARE, NO_CIRCLES, (1.0, 2.0, 0.0), np.random.default_rng(0))
    np.testing.assert_array_equal(first, copy)


@given(st.integers(0, 10**6))
def test_what_bodies_sent_back_is_left_out_of_a_scan(seed: int) -> None:
    """A room with a pillar and a screen, and bodies in it: some in front, some hidden, some behind one another."""
    rng = np.random.default_rng(seed)
    lidar, disc = Lidar(LidarConfig(beams=180), EXACT), np.array([[3.2, 3.0, 0.3]])
    screen = np.vstack([SQUARE, [[1.0, 2.0, 2.0, 3.0]]])
    at, turn = rng.uniform(0.3, 3.7, (3, 1, 2)), rng.uniform(-math.pi, math.pi, (3, 1))
    angles = turn + np.array([[0.6, 2.5, 3.7, 5.7]])
    corners = at + 0.25 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    bodies = np.concatenate([corners, np.roll(corners, -1, axis=1)], axis=-1)
    pose = np.array([*rng.uniform(0.2, 3.8, 2), rng.uniform(-math.pi, math.pi)])
    scan = lidar.scan(np.vstack([screen, bodies.reshape(-1, 4)]), disc, pose, rng)
    mapped, seen = lidar.without(bodies, screen, disc, pose, scan)
    walls = lidar.true_ranges(screen, disc, pose)
    each = np.array([lidar.true_ranges(body, NO_CIRCLES, pose) for body in bodies])
    nearest = each.min(axis=0)
    gone = nearest < walls
    np.testing.assert_array_equal(mapped.ranges, np.where(gone, np.nan, scan.ranges))
    np.testing.assert_array_equal(seen, [((row == nearest) & gone).any() for row in each])
    assert mapped is scan if not gone.any() else mapped.ranges is not scan.ranges


@pytest.mark.parametrize("name", ["youbot", "cavity"])
def test_pressed_against_a_wall_the_lidar_reads_the_robots_half_width(name: str) -> None:
    robot = ROBOT_PRESETS[name]
    free = np.ones((80, 80), bool)
    plan = FloorPlan(name="square", walls=SQUARE, free=free, resolution=0.05, start=(2.0, 3.4, 0.0))
    world = World(plan, robot, EXACT, np.random.default_rng(0))
    for _ in range(30):
        world.step(WheelTargets(robot).of_twist((0.0, 0.5, 0.0)), 0.1, 0.02)
    lidar = Lidar(LidarConfig(offset_m=0.0), EXACT)
    ranges = lidar.true_ranges(plan.segments, plan.circles, world.pose)
    assert world.collisions == 1
    assert ranges[270] == pytest.approx(0.5 * robot.width_m, abs=2e-3)


# ---- encoders ----------------------------------------------------------------------------------------------


def test_encoder_noise_has_its_declared_covariance() -> None:
    robot, noise = ROBOT_PRESETS["youbot"], NoiseConfig(encoder=0.05)
    encoders = WheelEncoders(robot, noise, np.random.default_rng(0))
    increments = np.array([[1.2, 0.7, -0.4, 1.0]])
    rng, n = np.random.default_rng(1), 20_000
    # On a floor that does not give, or the creep would be reckoned from the noise, too.
    encoders._fixed[_CREEP] = 0.0
    twists = np.array([encoders.odometry(increments, 0.1, rng).twist for _ in range(n)])
    forward = forward_matrix(robot)
    declared = forward @ np.diag((0.05 * increments[0] / 0.1) ** 2) @ forward.T
    mean = forward_kinematics(robot, increments[0] / 0.1)
    sigma = np.sqrt(np.diag(declared))
    assert np.all(np.abs(twists.mean(axis=0) - mean) < 4 * sigma / math.sqrt(n))
    np.testing.assert_allclose(np.cov(twists.T), declared, atol=4 * np.max(sigma) ** 2 * math.sqrt(2 / n))
    np.testing.assert_allclose(np.diag(np.cov(twists.T)), sigma**2, rtol=4 * math.sqrt(2 / n))


def test_perfect_encoders_read_the_kinematics() -> None:
    robot = ROBOT_PRESETS["cavity"]
    encoders = WheelEncoders(robot, EXACT, np.random.default_rng(0))
    wheels, rng = np.array([1.0, -1.0, -1.0, 1.0]), np.random.default_rng(0)
    encoders.odometry(wheels[None], 0.2, rng)
    odometry = encoders.odometry(wheels[None], 0.2, rng)  # as fast as before: nothing creeps
    np.testing.assert_allclose(odometry.twist, forward_kinematics(robot, 5.0 * wheels), atol=1e-12)
    assert odometry.dt == 0.2
    np.testing.assert_array_equal(encoders.true_radii, robot.wheel_radius_m)
    assert encoders.true_lever == robot.lever_m


def test_systematic_errors_are_drawn_once_within_their_bounds() -> None:
    robot, noise = ROBOT_PRESETS["youbot"], NOISE_PRESETS["slippery"]
    rng = np.random.default_rng(0)
    drawn = [WheelEncoders(robot, noise, rng) for _ in range(400)]
    radii = np.array([e.true_radii for e in drawn]) / robot.wheel_radius_m - 1
    lever = np.array([e.true_lever for e in drawn]) / robot.lever_m - 1
    for errors in (*radii.T, lever):
        assert np.max(np.abs(errors)) <= 0.03
        assert np.std(errors) == pytest.approx(0.03 / math.sqrt(3), rel=0.15)
        assert abs(np.mean(errors)) < 4 * 0.03 / math.sqrt(3 * 400)
    assert abs(np.corrcoef(radii[:, 0], radii[:, 1])[0, 1]) < 0.2


def test_odometry_always_draws_four_numbers() -> None:
    robot = ROBOT_PRESETS["youbot"]
    for noise in (EXACT, NOISE_PRESETS["slippery"]):
        encoders = WheelEncoders(robot, noise, np.random.default_rng(0))
        rng, expected = np.random.default_rng(3), np.random.default_rng(3)
        encoders.odometry(np.zeros((1, 4)), 0.1, rng)
        expected.standard_normal(4)
        assert rng.random() == expected.random()


def test_a_noise_stream_gives_the_readings_of_its_generator() -> None:
    robot, noise = ROBOT_PRESETS["youbot"], NOISE_PRESETS["slippery"]
    lidar = Lidar(LidarConfig(), noise)
    seed = np.random.SeedSequence(3)
    streams = noise_stream(seed), np.random.Generator(np.random.PCG64(seed))
    encoders = [WheelEncoders(robot, noise, np.random.default_rng(0)) for _ in streams]
    for k in range(20):
        (odometry, scan), (expected_odometry, expected_scan) = (
            (
                wheels.odometry(np.full((1, 4), 0.1 * k), 0.1, rng),
                lidar.scan(SQUARE, NO_CIRCLES, (1.0 + 0.1 * k, 2.0, 0.3 * k), rng),
            )
            for wheels, rng in zip(encoders, streams, strict=True)
        )
        np.testing.assert_array_equal(odometry.twist, expected_odometry.twist)
        np.testing.assert_array_equal(scan.ranges, expected_scan.ranges)
