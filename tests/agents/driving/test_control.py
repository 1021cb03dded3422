from __future__ import annotations

import math

import numpy as np
import pytest

from agents.driving.control import ControlConfig, PathFollower
from agents.driving.safety import Guard, body_gaps, footprint, local_map, scan_points
from agents.ways.planning import resample
from mecanum_env.config import LIDAR_PRESETS, ROBOT_PRESETS, LidarConfig, RobotConfig
from slam import geometry
from tests.agents.grids import belief_of, body_gap, drive, fill, room, two_rooms

ROBOT, LIDAR = RobotConfig(), LidarConfig()
CORNERS = 0.5 * np.array([[0.58, 0.38], [-0.58, 0.38], [-0.58, -0.38], [0.58, -0.38]])


def follower(config: ControlConfig | None = None, lidar: LidarConfig = LIDAR) -> PathFollower:
    return PathFollower(config or ControlConfig(), robot=ROBOT, lidar=lidar, step_s=0.1)


def follow(classes, pose, path, *, heading=None, steps=300, observation=None, sigma=0.01, config=None):
    """Drive a kinematic robot along a path; return its poses and the twists."""
    pose = np.array(pose, dtype=np.float64)
    control = follower(config)
    control.set_path(resample(np.array(path, dtype=np.float64), 0.1), heading)
    limits = np.array([0.8, 0.8, 1.5])
    poses, twists = [pose], []
    for _ in range(steps):
        twist = control.follow(observation, belief_of(classes, tuple(pose), sigma=sigma))
        twists.append(twist)
        pose = drive(pose, twist / limits, ROBOT)
        poses.append(pose)
        if control.arrived:
            break
    return np.array(poses), np.array(twists), control


def test_converges_within_the_limits():
    path = [(1.5, 1.5), (4.0, 1.5), (4.0, 4.5)]
    poses, twists, control = follow(room(6.0, 6.0), (1.5, 1.5, math.pi), path)
    assert control.arrived
    assert np.hypot(*(poses[-1, :2] - path[-1])) < 0.15
    # It keeps to the path: never farther from it than the corner's cut.
    dense = resample(np.array(path), 0.02)
    off = [np.hypot(*(dense - p[:2]).T).min() for p in poses]
    assert max(off) < 0.2
    demand = np.abs(twists) @ np.array([1.0, 1.0, ROBOT.lever_m])
    assert demand.max() <= ROBOT.max_speed_m_s + 1e-9
    velocity = np.array([geometry.rotation(p[2]) @ t[:2] for p, t in zip(poses, twists, strict=False)])
    change = np.hypot(*np.diff(velocity[:-2], axis=0).T) / 0.1
    assert change.max() <= 1.5 + 0.1
    # It moves fast where there is room: 5.5 m within what a trapezoid of speed and the corner take.
    assert len(twists) < 150
    # And with its long side along the way, however it stood at first.
    assert abs(geometry.wrap(poses[-1, 2] - 0.5 * math.pi)) < 0.3


def test_ends_with_the_heading_asked_for():
    poses, _, control = follow(room(6.0, 6.0), (1.5, 1.5, 0.0), [(1.5, 1.5), (3.0, 1.5)], heading=2.5)
    assert control.arrived
    assert abs(geometry.wrap(poses[-1, 2] - 2.5)) <= 0.2


@pytest.mark.parametrize("any_side", [False, True])
@pytest.mark.parametrize(("door_m", "start"), [(0.9, 0.0), (0.9, 1.5), (0.7, 1.4), (0.7, -2.5)])
def test_passes_a_door_without_touching(door_m, start, any_side):
    classes, config = two_rooms(door_m), ControlConfig(any_side=any_side)
    way = [(1.2, 2.0), (6.0, 2.0)]
    poses, _, control = follow(classes, (1.2, 2.0, start), way, steps=500, config=config)
    assert control.arrived
    assert min(body_gap(classes, p, ROBOT) for p in poses) > 0.02


def test_keeps_the_farther_from_walls_the_less_sure_it_is():
    classes = room(6.0, 6.0)
    fill(classes, 3.0, 0.0, 3.2, 6.0)
    gaps = []
    for sigma in (0.0, 0.01, 0.02, 1.0):
        poses, _, _ = follow(classes, (1.5, 3.0, 0.0), [(1.5, 3.0), (5.0, 3.0)], steps=150, sigma=sigma)
        gaps.append(min(body_gap(classes, p, ROBOT) for p in poses))
    # 2σ more each time, up to the cap; it stops where the next step would be too far, a step short at most.
    assert np.array(gaps) == pytest.approx(gaps[0] + np.array([0.0, 0.02, 0.04, 0.05]), abs=0.012)
    assert gaps[0] > 0.03


def test_never_drives_into_a_wall_it_is_led_into():
    classes = room(6.0, 6.0)
    fill(classes, 3.0, 0.0, 3.2, 6.0)
    poses, _, control = follow(classes, (1.5, 3.0, 0.3), [(1.5, 3.0), (5.0, 3.0)], steps=150)
    assert not control.arrived
    assert min(body_gap(classes, p, ROBOT) for p in poses) > 0.02


@pytest.mark.parametrize("wish", [(0.0, 0.0, 0.4), (0.3, 0.0, 0.0), (0.3, -0.1, 0.0), (0.2, -0.2, -0.3)])
def test_a_body_too_near_a_wall_comes_no_nearer_step_by_step(wish):
    classes, control = room(6.0, 6.0), follower()
    fill(classes, 0.0, 0.0, 6.0, 1.0)
    pose = np.array([3.0, 1.0 + 0.19 + 0.02, 0.0])  # its side two centimetres from the wall, where four are kept
    first, limits = body_gap(classes, pose, ROBOT), np.array([0.8, 0.8, 1.5])
    for _ in range(150):
        twist = control.drive(np.array(wish[:2]), wish[2], None, belief_of(classes, tuple(pose), sigma=0.0))
        pose = drive(pose, twist / limits, ROBOT)
        assert body_gap(classes, pose, ROBOT) > first - 0.006  # 2 mm, and what cells and rim points leave out


@pytest.mark.parametrize("seed", [0, 6, 15, 21, 56, 69, 108, 203])
def test_askew_in_a_door_it_gets_away_by_what_way_there_is(seed):
    """Too near on both sides it is refused all that it is led to, as once a robot was, for minutes."""
    rng, limits = np.random.default_rng(seed), np.array([0.8, 0.8, 1.5])
    classes = room(4.0, 4.0)
    fill(classes, 1.85, 0.0, 2.05, 1.65)
    fill(classes, 1.85, 2.35, 2.05, 4.0)
    pose = np.array([1.95 + rng.uniform(-0.15, 0.15), 2.0 + rng.uniform(-0.02, 0.02), -0.5 * math.pi])
    control, gap = follower(), 0.043

    def now():
        return belief_of(classes, tuple(pose), sigma=0.0015)

    for _ in range(40):  # led in, and turned there
        velocity = np.array([-0.1 * rng.random(), 0.02 * rng.normal()])
        twist = control.drive(velocity, 0.5 * rng.random(), None, now())
        pose = drive(pose, twist / limits, ROBOT)
    assert not twist.any() and body_gap(classes, pose, ROBOT) < gap
    for _ in range(15):
        pose = drive(pose, control.escape(None, now()) / limits, ROBOT)
        assert body_gap(classes, pose, ROBOT) > 0.03
    assert body_gap(classes, pose, ROBOT) > gap + 0.01  # straight in the door, 0.06 m on either side


def test_a_body_wider_than_long_goes_sideways_through_a_door():
    robot, classes = RobotConfig(length_m=0.38, width_m=0.7), two_rooms(0.7)
    for config, start in ((ControlConfig(), 0.0), (ControlConfig(any_side=True), 0.4)):
        control, pose = PathFollower(config, robot=robot, lidar=LIDAR, step_s=0.1), np.array([1.2, 2.0, start])
        control.set_path(resample(np.array([(1.2, 2.0), (6.0, 2.0)]), 0.1), None)
        for _ in range(500):
            twist = control.follow(None, belief_of(classes, tuple(pose)))
            pose = drive(pose, twist / np.array([0.8, 0.8, 1.5]), robot)
            assert body_gap(classes, pose, robot) > 0.02
            if control.arrived:
                break
        assert control.arrived


def test_it_counts_on_no_more_than_the_robot_can():
    def guard(step_s=0.1, **robot):
        return PathFollower(ControlConfig(), robot=RobotConfig(**robot), lidar=LIDAR, step_s=step_s)

    usual = guard()
    assert (usual._guard.lag_s, usual._guard.braking_m_s2) == (0.2, 1.5) and usual._pace.max_speed_m_s == 0.76
    assert guard(motor_lag_s=1.5)._guard.lag_s == pytest.approx(1.6)
    assert guard(step_s=1.0)._guard.lag_s == pytest.approx(1.05)
    heavy = RobotConfig(mass_kg=600.0)
    braking = guard(mass_kg=600.0)._guard.braking_m_s2
    assert braking < 4.0 * heavy.motor_torque_nm / (heavy.wheel_radius_m * heavy.mass_kg) < 0.3
    fast = guard(max_speed_m_s=6.0)
    speed = fast._pace.max_speed_m_s
    stops_in = speed * fast._guard.lag_s + speed**2 / (2.0 * fast._guard.braking_m_s2)
    assert stops_in == pytest.approx(2.0 - RobotConfig().circumscribed_radius_m)


def limits(**body) -> list[float]:
    """Accelerations and decelerations, along [m/s²] and in turning [rad/s²], that a robot is driven with."""
    control = PathFollower(ControlConfig(), lidar=LIDAR, step_s=0.1, **body)
    pace, motors, guard = control._pace, control._motors, control._guard
    return [
        motors.acceleration_m_s2, pace.deceleration_m_s2, guard.braking_m_s2,
        motors.turn_acceleration_rad_s2, guard.turn_braking_rad_s2,
    ]  # fmt: skip


@pytest.mark.parametrize("preset", sorted(ROBOT_PRESETS))
def test_the_presets_motors_give_all_that_is_asked(preset):
    assert limits(robot=ROBOT_PRESETS[preset]) == [1.2, 0.8, 1.5, 3.0, 6.0]


def test_a_heavy_robot_is_driven_as_its_motors_can():
    robot = RobotConfig(mass_kg=600.0)
    wheels_kg = 4.0 * 0.01 / robot.wheel_radius_m**2
    along = 4.0 * 2.0 / robot.wheel_radius_m / (600.0 + wheels_kg) / math.sqrt(2.0)  # two wheels drive a diagonal
    lever = robot.lever_m
    turn = 4.0 * 2.0 * lever / robot.wheel_radius_m / (robot.inertia_kg_m2 + wheels_kg * lever**2)
    assert along < 0.8 and turn < 3.0
    assert limits(robot=robot) == pytest.approx([along, along, along, turn, turn])


def test_brakes_for_what_only_the_scan_shows():
    classes, control, pose = room(8.0, 6.0), follower(), np.array([1.5, 3.0, 0.0])
    control.set_path(resample(np.array([(1.5, 3.0), (6.5, 3.0)]), 0.1), None)
    angles = LIDAR.angle_min + LIDAR.angle_increment * np.arange(LIDAR.beams)
    for _ in range(100):
        sensor = pose[0] + LIDAR.offset_m
        with np.errstate(divide="ignore"):
            ranges = np.where(np.cos(angles) > 1e-3, (4.0 - sensor) / np.cos(angles), np.inf)
        hit = np.abs(ranges * np.sin(angles)) < 0.5  # a board 1 m wide at x = 4 m, across the way
        scan = np.where(hit, np.minimum(ranges / LIDAR.range_max_m, 1.0), 1.0).astype(np.float32)
        twist = control.follow({"scan": scan}, belief_of(classes, tuple(pose)))
        pose = drive(pose, twist / np.array([0.8, 0.8, 1.5]), ROBOT)
        if abs(pose[1] - 3.0) < 0.5:
            assert geometry.transform_points(pose, CORNERS)[:, 0].max() < 4.0
    assert pose[0] > 3.0


def test_gaps_against_brute_force():
    classes = room(4.0, 4.0)
    fill(classes, 2.5, 1.9, 2.6, 2.1)
    pose = np.array([1.9, 2.0, 0.0])
    near = local_map(belief_of(classes, tuple(pose)), 2.0)
    guard = Guard(
        rim=footprint(ROBOT),
        half=np.array([0.29, 0.19]),
        lag_s=0.2,
        braking_m_s2=1.5,
        turn_braking_rad_s2=6.0,
        scan_gap_m=0.04,
    )
    hits = np.array([[0.6, 0.05], [0.5, 0.4]])
    twist = np.array([0.3, 0.0, 0.0])
    now, ahead, scan_now, scan_ahead = body_gaps(twist, pose, near, hits, guard)
    assert now == pytest.approx(body_gap(classes, pose, ROBOT), abs=0.02)
    travelled = 0.3 * 0.2 + 0.3**2 / (2 * 1.5)  # v t + v²/2a
    assert ahead == pytest.approx(now - travelled, abs=0.02)
    assert scan_now == pytest.approx(math.hypot(0.21, 0.21))  # to the corner, less than 0.31 ahead
    assert scan_ahead == pytest.approx(min(0.31 - travelled, math.hypot(0.21 - travelled, 0.21)), abs=1e-6)


SMALL = RobotConfig(
    length_m=0.2, width_m=0.16, mass_kg=2.5, wheel_radius_m=0.03, wheelbase_m=0.13, track_m=0.1, max_speed_m_s=2.0,
    motor_torque_nm=1.0,
)  # fmt: skip


@pytest.mark.parametrize(("robot", "speed"), [(SMALL, 2.0), (RobotConfig(max_speed_m_s=2.0), 1.5)])
def test_a_fast_body_steps_over_nothing(robot, speed):
    """Neither a wall that the scan shows nor a post of one cell on the map, wherever on the way it stands."""
    guard = PathFollower(ControlConfig(), robot=robot, lidar=LIDAR, step_s=0.1)._guard
    free, pose = np.zeros((80, 80)), np.array([1.0, 2.0, 0.0])
    nothing, twist = np.zeros((0, 2)), np.array([speed, 0.0, 0.0])
    front = 0.5 * robot.length_m
    stopped = front + speed * guard.lag_s + speed**2 / (2.0 * guard.braking_m_s2)
    for ahead in np.arange(front + 0.05, stopped, 0.05):
        wall = np.stack([np.full(200, ahead), np.linspace(-1.0, 1.0, 200)], axis=1)
        assert body_gaps(twist, pose, local_map(belief_of(free, tuple(pose)), 2.0), wall, guard)[3] < 0.04
        classes = room(4.0, 4.0)
        fill(classes, 1.0 + ahead, 2.0, 1.05 + ahead, 2.05)
        assert body_gaps(twist, pose, local_map(belief_of(classes, tuple(pose)), 2.0), nothing, guard)[1] < 0.04


def test_scan_points_stand_in_the_body_frame():
    scan = np.ones(360, np.float32)
    scan[180], scan[270], scan[0] = 1.0 / 8.0, 0.5 / 8.0, 0.0
    points = scan_points({"scan": scan}, LIDAR)
    np.testing.assert_allclose(points, [[1.2, 0.0], [0.2, 0.5]], atol=1e-6)
    assert scan_points(None, LIDAR).shape == scan_points({}, LIDAR).shape == (0, 2)
    with pytest.raises(ValueError, match="360 beams"):
        scan_points({"scan": np.ones(10)}, LIDAR)
    sector = LIDAR_PRESETS["cavity"]
    ahead = np.ones(sector.beams)
    ahead[sector.beams // 2] = 0.1
    np.testing.assert_allclose(scan_points({"scan": ahead}, sector), [[0.08 + 0.8, 0.0]], atol=1e-6)


def test_lost_in_the_open_it_creeps_back_and_turns_where_it_loses_sight():
    """A wall ahead, farther off than the scan is looked at for safety; behind, nothing."""
    classes, control, pose = room(30.0, 6.0), follower(), np.array([8.0, 3.0, 0.0])
    control.set_path(resample(np.array([(6.0, 3.0), (10.0, 3.0)]), 0.1), None)
    angles = LIDAR.angle_min + LIDAR.angle_increment * np.arange(LIDAR.beams)

    def creep(wall_m: float, least: float = 1.0) -> np.ndarray:
        with np.errstate(divide="ignore"):
            ranges = np.where(np.cos(angles) > 0.9, wall_m / np.cos(angles), np.inf)
        scan = np.maximum(np.minimum(ranges / LIDAR.range_max_m, 1.0), least)
        return control.creep({"scan": scan.astype(np.float32)}, belief_of(classes, tuple(pose)))

    places = []
    for _ in range(600):
        pose = drive(pose, creep(12.0 - pose[0] - LIDAR.offset_m, 0.0) / np.array([0.8, 0.8, 1.5]), ROBOT)
        places.append(pose[0])
    lost_sight = 12.0 - LIDAR.offset_m - LIDAR.range_max_m
    assert min(places) == pytest.approx(lost_sight, abs=0.3)  # back, as far as the wall is seen …
    assert places[-1] > lost_sight + 3.0  # … and then to what is to be seen
    assert max(places) < 12.0 - 0.29
    for _ in range(800):  # now the lidar is blind
        pose = drive(pose, creep(1.0) / np.array([0.8, 0.8, 1.5]), ROBOT)
    assert pose[0] == pytest.approx(8.0, abs=0.3)  # over what it has crept, and no farther
    assert not creep(1.0).any()


def test_without_a_scan_it_does_not_creep():
    control, belief = follower(), belief_of(room(6.0, 6.0), (3.0, 3.0, 0.0))
    assert not control.creep({}, belief).any() and not control.creep(None, belief).any()


def test_it_creeps_to_nothing_at_the_edge_of_its_view():
    """Half of the way there would be out of sight; first and last beam are not neighbours."""
    lidar = LIDAR_PRESETS["cavity"]
    angles = np.degrees(lidar.angle_min + lidar.angle_increment * np.arange(lidar.beams))
    scan = np.where(np.abs(angles) > 30.0, 0.9, 0.1).astype(np.float32)
    twist = follower(lidar=lidar).creep({"scan": scan}, belief_of(room(20.0, 20.0), (10.0, 10.0, 0.0)))
    assert twist.any() and abs(math.degrees(math.atan2(twist[1], twist[0]))) < 41.0
