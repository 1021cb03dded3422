"""The node's core, without ROS: a simulated robot with real physics is driven by the messages it says."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mecanum_env.arguments import make_config
from slam.geometry import compose
from slam.ros import Mount, pose_of, transform_message, transforms_of
from slam.types import Scan
from tests.slam.ros.bags_on_disk import ODOMETRY, TF, scan
from tests.training.ros.drives import STAND, Drive, begun
from tests.training.ros.robots import Robot, packed
from training.ros.driver import Driver, lidar_of

pytest.importorskip("rosbags")


def test_it_explores_a_room_by_its_messages_alone() -> None:
    drive = begun(0)
    for _ in range(900):
        drive.step()
        if drive.driver.status == "covered":
            break
    info, env = drive.robot.info, drive.robot.env
    assert info["coverage"] > 0.95 and info["collisions"] == 0 and drive.driver.status == "covered"
    assert drive.step() == STAND
    backend = drive.driver.backend
    assert backend is not None
    # map → odom → base_link is the belief, though the odometry began elsewhere.
    (placed,) = transforms_of(packed(TF, {"transforms": [drive.driver.map_to_odom()]}))
    odometry = drive.robot.odometry().pose.pose
    assert (placed.parent, placed.child) == ("map", "odom")
    x, y, theta = compose(
        np.array([*placed.matrix[:2, 3], math.atan2(*placed.matrix[1::-1, 0])]), pose_of(odometry)
    )
    assert np.allclose([x, y], info["true_pose"][:2], atol=0.05) and abs(theta - info["true_pose"][2]) < 0.05
    said = packed("geometry_msgs/msg/PoseWithCovarianceStamped", drive.driver.pose())
    assert np.allclose(pose_of(said.pose.pose), backend.pose, atol=1e-9)
    drawn = packed("nav_msgs/msg/OccupancyGrid", drive.driver.map())
    assert np.array_equal(drawn.data.reshape(drawn.info.height, drawn.info.width), backend.grid.classes())
    assert env.truth.ground is not None and drive.said[-1] == "covered"


@pytest.mark.parametrize("missing", ["scans", "odometry"])
def test_it_stands_while_something_is_late_and_then_goes_on(missing: str) -> None:
    drive = begun()
    twists = [drive.step(**{missing: False}) for _ in range(12)]
    assert twists[0] != STAND and all(twist == STAND for twist in twists[6:])
    name = missing.rstrip("s")
    assert any(text.startswith("standing: no ") and name in text for text in drive.said)
    assert any(drive.step() != STAND for _ in range(10)) and drive.driver.status == "driving"


def test_it_stands_when_the_belief_is_lost() -> None:
    drive = begun(60)
    elsewhere = Robot(rooms="cave", seed=8)
    for _ in range(60):
        elsewhere.clock_s = drive.robot.clock_s
        drive.driver.hear_odometry(drive.robot.odometry(), drive.now_s)
        drive.driver.hear_scan(elsewhere.scan(), drive.now_s)
        twist = drive.driver.command(drive.now_s)
        drive.robot.drive(twist)
        drive.now_s += 0.1
        if drive.driver.status == "standing: the belief is lost":
            break
    assert twist == STAND and drive.driver.status == "standing: the belief is lost"


def test_what_no_robot_says_is_passed_over_said_once_and_late_before_long() -> None:
    drive = begun()
    twists = []
    for _ in range(12):
        drive.driver.hear_odometry(packed(ODOMETRY, {}), drive.now_s)  # a quaternion of zeros
        drive.hear(odometry=False)
        twists.append(drive.driver.command(drive.now_s))
        drive.robot.drive(twists[-1])
        drive.now_s += 0.1
    assert twists[-1] == STAND
    assert sum("quaternion" in text for text in drive.said) == 1


def test_odometry_that_begins_anew_moves_nobody() -> None:
    drive = begun(30)
    backend = drive.driver.backend
    assert backend is not None
    before = backend.pose
    drive.robot.odometry_pose = np.array([500.0, 0.0, 0.0])
    drive.step()
    assert np.hypot(*(backend.pose - before)[:2]) < 0.2 and any("jumped" in text for text in drive.said)
    for _ in range(20):
        drive.step()
    assert drive.robot.info["position_error_m"] < 0.1


def test_a_jump_between_two_scans_is_no_motion() -> None:
    """Neither of the belief, nor of what the agent drives by, nor of map → base."""
    drive = begun(30)
    backend = drive.driver.backend
    assert backend is not None
    before = backend.pose
    drive.robot.odometry_pose = drive.robot.odometry_pose + np.array([1.0, 0.4, 0.3])
    drive.robot.clock_s += 0.1
    drive.driver.hear_odometry(drive.robot.odometry(), drive.now_s)
    assert np.allclose(drive.driver._belief_now().pose, before, atol=1e-9)
    (placed,) = transforms_of(packed(TF, {"transforms": [drive.driver.map_to_odom()]}))
    in_odom = np.array([*placed.matrix[:2, 3], math.atan2(*placed.matrix[1::-1, 0])])
    assert np.allclose(compose(in_odom, pose_of(drive.robot.odometry().pose.pose)), before, atol=1e-6)
    drive.robot.clock_s -= 0.05
    drive.hear(odometry=False)  # a scan from the middle of the jump
    assert np.hypot(*(backend.pose - before)[:2]) < 0.1  # what it drove in that step


def test_a_clock_that_is_set_back_is_gone_on_by() -> None:
    drive = begun(30)
    drive.robot.clock_s += 3600.0
    drive.driver.hear_odometry(drive.robot.odometry(), drive.now_s)
    drive.robot.clock_s -= 3600.0
    twists = [drive.step() for _ in range(30)]
    assert all(twist != STAND for twist in twists[15:])
    assert any("clock was set back" in text for text in drive.said)
    assert drive.robot.info["position_error_m"] < 0.1


@pytest.mark.parametrize("back_s", [0.35, 0.6, 5.0])
def test_what_was_driven_while_a_clock_was_set_back_is_no_jump(back_s: float) -> None:
    drive = begun(60)
    drive.robot.clock_s -= back_s
    for _ in range(30):
        drive.step()
    assert any("clock was set back" in text for text in drive.said) and not any("jump" in t for t in drive.said)
    assert drive.robot.info["position_error_m"] < 0.02


def test_no_wheel_is_asked_for_more_than_there_is() -> None:
    drive = begun(20, agent="random")
    robot = drive.driver.config.robot
    for _ in range(50):
        twist = drive.step()
        along = abs(twist["linear"]["x"]) + abs(twist["linear"]["y"])
        assert along + robot.lever_m * abs(twist["angular"]["z"]) <= robot.max_speed_m_s * (1.0 + 1e-9)


def test_a_transform_that_is_none_hides_no_other() -> None:
    drive = Drive()
    message = drive.robot.mount()
    bad = packed(TF, {"transforms": [transform_message("utm", "map", 0.0, [448262.0, 5411932.0, 0.0])]})
    message.transforms = [*bad.transforms, *message.transforms]
    drive.driver.hear_transforms(message)
    assert drive.step() is not None


def test_a_lidar_that_sees_farther_than_a_hundred_metres_is_taken_as_far() -> None:
    scan = Scan(np.full(360, 110.0), -math.pi, 2.0 * math.pi / 360, 120.0)
    assert lidar_of(scan, 0.0).range_max_m == 100.0


def test_nobody_is_told_to_drive_before_it_has_begun() -> None:
    drive = Drive()
    assert drive.driver.map() is drive.driver.pose() is drive.driver.map_to_odom() is None
    assert (
        drive.step() is None and "waiting for a transform from base_link to the lidar laser" in drive.driver.status
    )
    drive.driver.hear_transforms(drive.robot.mount())
    drive.hear(odometry=False)
    assert drive.step() is not None
    given = Drive(mount=Mount(0.2, 0.0, 0.0))
    assert given.step() is not None
    with pytest.raises(ValueError, match="off the middle"):
        Drive(mount=Mount(0.2, 0.3, 0.0))


def test_a_scan_waits_for_the_odometry_of_its_time() -> None:
    drive = begun(5)
    backend = drive.driver.backend
    assert backend is not None
    drive.hear(odometry=False)
    before = backend.pose
    assert np.array_equal(backend.pose, before)
    drive.robot.clock_s += 0.04
    drive.driver.hear_odometry(drive.robot.odometry(), drive.now_s)
    assert not np.array_equal(backend.pose, before)


def test_odometry_may_be_later_than_the_next_scan() -> None:
    drive = begun(0)
    late: list[Any] = []
    for _ in range(30):
        late.append(drive.robot.odometry())
        drive.driver.hear_scan(drive.robot.scan(), drive.now_s)
        if len(late) > 2:
            drive.driver.hear_odometry(late.pop(0), drive.now_s)
        drive.step(scans=False, odometry=False)
    assert drive.driver.backend is not None and drive.driver.status == "driving"
    assert drive.driver._at[0] == pytest.approx(drive.robot.clock_s - 0.3)  # that of the odometry that came last


def test_names_that_are_not_known() -> None:
    with pytest.raises(ValueError, match="agent"):
        Driver(make_config(), "nobody")


@given(beams=st.integers(400, 2000), turn=st.floats(-3.0, 3.0), cut=st.floats(0.0, 4.0))
def test_the_lidar_is_the_sector_that_is_seen_whole(beams: int, turn: float, cut: float) -> None:
    step = 2.0 * math.pi / beams
    seen = scan(np.ones(beams), angle_min=-math.pi + turn)
    whole = lidar_of(seen, 0.2)
    assert (whole.beams, whole.field_of_view_deg, whole.offset_m) == (beams, 360.0, 0.2)
    left = max(int(cut / step), 1)
    sector = Mount(0.0, 0.0, 0.0).level(
        seen._replace(ranges=seen.ranges[left:], angle_min=seen.angle_min + left * step)
    )
    last = sector.angle_min + (len(sector.ranges) - 1) * step
    try:
        lidar = lidar_of(sector, 0.2)
    except ValueError as error:
        assert min(-sector.angle_min, last) < math.radians(15.0) + step and "straight ahead" in str(error)
        return
    assert lidar.angle_increment == pytest.approx(step)
    half = 0.5 * math.radians(lidar.field_of_view_deg)
    assert half <= min(-sector.angle_min, last) + 2e-3 * step and half > min(-sector.angle_min, last) - step
