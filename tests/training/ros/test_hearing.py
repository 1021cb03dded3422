"""What the node's core makes of messages that come late, say nothing, or are not what it can begin by."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
import pytest

from slam.geometry import compose, inverse
from slam.ros import Mount
from tests.training.ros.drives import STAND, Drive, begun, driven, held_up
from tests.training.ros.robots import packed

pytest.importorskip("rosbags")


@pytest.mark.parametrize(("said", "drives"), [(math.nan, False), (0.0, False), (math.inf, True)])
def test_a_blind_lidar_stops_it_and_a_hall_without_walls_does_not(said: float, drives: bool) -> None:
    drive = begun(30)

    def scan_of_one_range() -> Any:
        message = drive.robot.scan()
        message.ranges = np.full_like(message.ranges, said)
        return message

    assert any(driven(drive, drive.robot.odometry, scan_of_one_range)[6:]) == drives
    assert sum("measures nothing" in text for text in drive.said) == (not drives)


@pytest.mark.parametrize("late", ["odometry", "scan"])
def test_what_is_late_by_its_stamp_stops_it(late: str) -> None:
    """Scans that come at their rate may be old ones."""
    drive = begun(30)
    robot = drive.robot
    odometry, seen = held_up(robot.odometry, 15 * (late == "odometry")), held_up(robot.scan, 15 * (late == "scan"))
    assert not any(driven(drive, odometry, seen, steps=60)[6:])
    assert any(text.startswith(f"{late} is more than 0.5 s behind the") for text in drive.said)
    assert any(driven(drive, robot.odometry, robot.scan)[5:]) and robot.info["position_error_m"] < 0.05


@pytest.mark.parametrize(("ahead_s", "drives"), [(0.0, False), (0.3, False), (3600.0, True), (math.nan, True)])
def test_what_is_late_alike_is_told_by_the_clock_of_ros(ahead_s: float, drives: bool) -> None:
    """Unless the robot has another clock, as in a simulation, or that of ROS is not known."""
    drive = Drive()
    drive.driver.hear_transforms(drive.robot.mount())
    made: deque[Any] = deque()
    twists = []
    for k in range(60):
        made.append((drive.robot.odometry(), drive.robot.scan()))
        for _ in range(1 if k < 20 else int(len(made) > 8)):  # from then on 0.8 s late
            odometry, seen = made.popleft()
            drive.driver.hear_odometry(odometry, drive.now_s, drive.robot.clock_s + ahead_s)
            drive.driver.hear_scan(seen, drive.now_s, drive.robot.clock_s + ahead_s)
        twists.append(drive.driver.command(drive.now_s))
        drive.robot.drive(twists[-1])
        drive.now_s += 0.1
    assert STAND not in twists[:20] and any(twist != STAND for twist in twists[40:]) == drives
    assert any("behind ROS's clock" in text for text in drive.said) != drives


def test_odometry_that_is_said_again_is_none() -> None:
    drive = begun(30)
    frozen = drive.robot.odometry()
    assert not any(driven(drive, lambda: frozen, drive.robot.scan)[6:])
    assert not any("set back" in text for text in drive.said)
    assert any(driven(drive, drive.robot.odometry, drive.robot.scan)[5:])
    assert drive.robot.info["position_error_m"] < 0.05


@pytest.mark.parametrize("beside_m", [0.04, -0.05])
def test_poses_are_of_the_base_beside_whose_middle_the_lidar_is(beside_m: float) -> None:
    """Turned by half a circle the base is where it was: the point behind the lidar is twice as far off as that."""
    drive = Drive(beside_m=beside_m)
    drive.driver.hear_transforms(drive.robot.mount())
    to_base = np.array([0.0, -beside_m, 0.0])

    def base() -> Any:
        """Return where the base is, in the frame in which it began."""
        body = drive.robot.info["true_pose"] if drive.robot.info else np.zeros(3)
        return compose(inverse(to_base), compose(np.asarray(body), to_base))

    for _ in range(45):
        drive.hear()
        assert drive.driver.command(drive.now_s) is not None
        assert np.allclose(drive.pose[0][:2], base()[:2], atol=0.01)
        drive.robot.drive({"linear": {"x": 0.0, "y": 0.0}, "angular": {"z": 0.7}})
        drive.driver.hear_odometry(drive.robot.odometry(), drive.now_s)  # newer than the scan
        assert np.allclose(drive.by_transforms[:2], base()[:2], atol=0.01)
        body = drive.driver._belief_now().pose  # what the agent drives by
        assert np.allclose(compose(body, to_base)[:2], base()[:2], atol=0.01)
        drive.now_s += 0.1
    assert abs(drive.pose[0][2]) > 2.0 and drive.driver.status == "driving"


def test_the_covariance_is_of_the_base() -> None:
    drive = Drive(beside_m=0.05)
    drive.driver.hear_transforms(drive.robot.mount())
    drive.step()
    backend: Any = drive.driver.backend
    backend._x[2], backend._p[:3, :3] = 0.5 * math.pi, np.diag([1e-4, 4e-4, 0.04])
    # Seen along y, the base is 5 cm to the right, +x: what the heading errs by moves it along y.
    assert np.allclose(drive.pose[0], backend.pose + np.array([0.05, 0.0, 0.0]))
    lever = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.05], [0.0, 0.0, 1.0]])
    assert np.allclose(drive.pose[1], lever @ backend.pose_cov @ lever.T)


def test_it_says_what_it_waits_for_again_and_again() -> None:
    drive = Drive()
    driven(drive, lambda: None, lambda: None, steps=2)
    assert drive.said == ["waiting for odometry and a scan and /tf_static"]
    driven(drive, lambda: None, drive.robot.scan, steps=110)
    waits = "waiting for odometry and /tf_static"
    assert drive.said[1:] == [waits] * 3 and drive.driver.status == waits
    driven(drive, drive.robot.odometry, drive.robot.scan, steps=2)
    assert "is waiting for a transform from base_link to the lidar laser; publish it" in drive.said[-1]
    drive.driver.hear_transforms(drive.robot.mount())
    assert any(driven(drive, drive.robot.odometry, drive.robot.scan, steps=5))


def test_scans_that_it_cannot_begin_by_are_named_as_such() -> None:
    """Whichever message came last."""
    drive = Drive()
    message = drive.robot.mount()
    message.transforms[0].transform.rotation.x, message.transforms[0].transform.rotation.w = 0.6, 0.8
    drive.driver.hear_transforms(message)
    driven(drive, held_up(drive.robot.odometry, 1), drive.robot.scan, steps=70)
    assert drive.driver.status.startswith("scan has a lidar that leans by") and drive.driver.map() is None
    assert drive.said.count(drive.driver.status) == 2
    aside = Drive(beside_m=0.2)
    aside.driver.hear_transforms(aside.robot.mount())
    aside.step()
    assert aside.driver.status == "scan is of a lidar 0.20 m to the left of the middle; 0.05 m is the most"


def test_what_was_good_in_between_is_said_again() -> None:
    drive = begun(30)
    for times in (1, 2):
        drive.robot.odometry_pose = drive.robot.odometry_pose + np.array([3.0, 0.0, 0.0])
        driven(drive, drive.robot.odometry, drive.robot.scan, steps=60)
        assert sum("jumped" in text for text in drive.said) == times


def test_of_two_lidars_on_a_topic_the_first_is_heard() -> None:
    drive = begun(30)

    def rear() -> Any:
        message = drive.robot.scan()
        message.header.frame_id, message.ranges = "laser_rear", np.full_like(message.ranges, 1.0)
        drive.driver.hear_scan(drive.robot.scan(), drive.now_s)
        return message

    assert any(driven(drive, drive.robot.odometry, rear)[6:]) and drive.robot.info["position_error_m"] < 0.02
    two = "scan has scans in frames 'laser' and 'laser_rear'; give a topic for each lidar"
    assert drive.said.count(two) == 1


def test_a_twist_is_stamped_by_the_clock_and_frame_of_the_base() -> None:
    drive = Drive(clock_s=7.0, mount=Mount(0.2, 0.0, 0.0))
    odometry = drive.robot.odometry()
    odometry.child_frame_id = "base_footprint"
    drive.driver.hear_odometry(odometry, 0.0)
    drive.hear(odometry=False)
    twist = drive.driver.command(0.0)
    assert twist is not None
    said = packed("geometry_msgs/msg/TwistStamped", drive.driver.stamped(twist))
    assert (said.header.frame_id, said.header.stamp.sec) == ("base_footprint", 7)
    assert said.twist.linear.x == twist["linear"]["x"]
