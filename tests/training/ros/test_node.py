"""The node under ROS 2 itself, where it is there: ``mecanum ros`` beside a simulated robot, on real topics."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam.ros import fill, odometry_message, scan_message, transform_message
from tests.slam.written_files import read_map_server
from tests.training.ros.robots import Robot
from training.cli import main

SECONDS = float(os.environ.get("MECANUM_ROS_SECONDS", "12"))  # of driving


def test_without_ros_it_says_so_in_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)
    assert main(["ros"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("mecanum ros: it needs ROS 2") and "setup.bash" in line


class RobotNode:
    """The simulated robot on ROS's topics, a step every 0.1 s of the clock on the wall."""

    def __init__(self) -> None:
        rclpy = pytest.importorskip("rclpy")
        pytest.importorskip("tf2_msgs.msg")
        from geometry_msgs.msg import TransformStamped, Twist
        from nav_msgs.msg import OccupancyGrid, Odometry
        from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
        from sensor_msgs.msg import LaserScan
        from tf2_msgs.msg import TFMessage

        rclpy.init(args=[])
        self._rclpy, self.node = rclpy, rclpy.create_node("robot")
        self.robot = Robot(rooms="apartment", seed=4)
        self.twist, self.transforms, self.maps = Twist(), [], []
        self._types = (LaserScan, Odometry)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._scan = self.node.create_publisher(LaserScan, "/scan", qos_profile_sensor_data)
        self._odometry = self.node.create_publisher(Odometry, "/odom", 10)
        still = self.node.create_publisher(TFMessage, "/tf_static", latched)
        offset = self.robot.env.config.lidar.offset_m
        still.publish(
            TFMessage(
                transforms=[
                    fill(TransformStamped(), transform_message("base_link", "laser", 0.0, [offset, 0.0, 0.0]))
                ]
            )
        )
        self._still = still
        self.node.create_subscription(Twist, "/cmd_vel", self._told, 1)
        self.node.create_subscription(TFMessage, "/tf", lambda m: self.transforms.extend(m.transforms), 100)
        self.node.create_subscription(OccupancyGrid, "/map", self.maps.append, latched)

    def _told(self, twist: Any) -> None:
        self.twist = twist

    def live(self, seconds: float, *, scans: bool = True) -> None:
        """Drive as told, publish, listen."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            due, robot = time.monotonic() + 0.1, self.robot
            told = {
                "linear": {"x": self.twist.linear.x, "y": self.twist.linear.y},
                "angular": {"z": self.twist.angular.z},
            }
            robot.drive(told)
            scan, odometry = self._types
            twist = np.asarray(robot.env.odometry.twist)
            pose = robot.odometry_pose
            self._odometry.publish(
                fill(odometry(), odometry_message(robot.clock_s, "odom", "base_link", pose, twist))
            )
            if scans:
                self._scan.publish(fill(scan(), scan_message(robot.clock_s, "laser", robot.env.scan)))
            while (left := due - time.monotonic()) > 0:
                self._rclpy.spin_once(self.node, timeout_sec=left)

    def close(self) -> None:
        self.node.destroy_node()
        self._rclpy.shutdown()


@pytest.fixture
def robot() -> Iterator[RobotNode]:
    node = RobotNode()
    yield node
    node.close()


def test_it_explores_stands_when_scans_stay_away_and_leaves_its_map(robot: RobotNode, tmp_path: Path) -> None:
    argv = [sys.executable, "-m", "training.cli", "ros", "--agent", "brisk-tour", "--out", str(tmp_path / "out")]
    with open(tmp_path / "log", "w") as log:
        process = subprocess.Popen(argv, stdout=log, stderr=subprocess.STDOUT)
        try:
            waited = time.monotonic() + 120.0
            while robot.twist.linear.x == robot.twist.linear.y == 0.0 and time.monotonic() < waited:
                robot.live(1.0)
            before = robot.robot.info["coverage"]
            robot.live(SECONDS)
            covered = robot.robot.info
            assert robot.robot.info["path_length_m"] > 1.0 and covered["coverage"] > before, (
                tmp_path / "log"
            ).read_text()
            robot.live(1.5, scans=False)
            assert robot.twist.linear.x == robot.twist.linear.y == robot.twist.angular.z == 0.0
            assert process.poll() is None
            robot.live(2.0)
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(30.0)
    said = (tmp_path / "log").read_text()
    assert process.returncode == 0, said
    assert "begun: lidar 0.20 m ahead, 360 beams over 360°" in said and "standing: no scan for 0.5 s" in said
    # map → odom is the frame's offset, since the odometry began elsewhere.
    last = robot.transforms[-1]
    assert (last.header.frame_id, last.child_frame_id) == ("map", "odom")
    classes, resolution, _ = read_map_server(tmp_path / "out" / "map.yaml")
    drawn = robot.maps[-1]
    assert drawn.info.resolution == pytest.approx(resolution) and set(drawn.data) <= {-1, 0, 100}
    assert (classes == 100).sum() > 100 and robot.robot.info["collisions"] == 0
    print(covered["coverage"], covered["time_s"], robot.robot.info["position_error_m"])
