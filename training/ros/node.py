"""The node: :class:`training.ros.driver.Driver` on ROS 2's topics. All that needs ROS is here, loaded late."""

from __future__ import annotations

import time
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from slam.formats import write_map_server
from slam.ros import Message, fill
from training.ros.driver import Driver
from training.runs.errors import BadInput
from training.runs.signals import interrupt_flag

__all__ = ["Topics", "check_ros", "run"]

_MAP_EVERY_S = 2.0
_FAREWELLS = 3  # twists of zero at the end: the first may be lost
_REMEDY = (
    "it needs ROS 2 and its Python packages; source /opt/ros/DISTRO/setup.bash, with mecanum-slam "
    "installed for ROS's own Python (python3 -m venv --system-site-packages)"
)


@dataclass(frozen=True, kw_only=True)
class Topics:
    """Names of what it hears and says."""

    scan: str
    odom: str
    cmd_vel: str
    map: str
    pose: str
    stamped: bool  # cmd_vel as a TwistStamped


def check_ros() -> None:
    """Raise :class:`BadInput` in one line where ROS 2 is not there."""
    try:
        for name in ("rclpy", "geometry_msgs.msg", "nav_msgs.msg", "sensor_msgs.msg", "tf2_msgs.msg"):
            import_module(name)
    except ImportError as error:
        raise BadInput(f"{_REMEDY}: {error}") from error


def run(driver: Driver, topics: Topics, out: Path) -> bool:
    """Drive until Ctrl-C or SIGTERM, then stand, and write the map into ``out``; tell whether there was one."""
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    # Its own handlers would close the topics before the robot is told to stand.
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = rclpy.create_node("mecanum_slam")
        driver.log = node.get_logger().info
        said = _Wiring(node, driver, topics)
        with interrupt_flag() as interrupted:
            try:
                while not interrupted.is_set():
                    rclpy.spin_once(node, timeout_sec=0.1)
            finally:
                said.stand()
        node.destroy_node()
    finally:
        rclpy.shutdown()
    if driver.backend is None:
        return False
    out.mkdir(parents=True, exist_ok=True)
    write_map_server(out / "map", driver.backend.grid)
    return True


class _Wiring:
    """Subscriptions, publishers and timers of a node."""

    def __init__(self, node: Any, driver: Driver, topics: Topics) -> None:
        from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped, Twist, TwistStamped
        from nav_msgs.msg import OccupancyGrid, Odometry
        from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
        from sensor_msgs.msg import LaserScan
        from tf2_msgs.msg import TFMessage

        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        many = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._driver, self._types = driver, (TransformStamped, TFMessage, OccupancyGrid, PoseWithCovarianceStamped)
        self._twist = TwistStamped if topics.stamped else Twist
        self._node, self._stamped = node, topics.stamped
        self._cmd = node.create_publisher(self._twist, topics.cmd_vel, 1)
        self._tf = node.create_publisher(TFMessage, "/tf", 100)
        self._map = node.create_publisher(OccupancyGrid, topics.map, latched)
        self._pose = node.create_publisher(PoseWithCovarianceStamped, topics.pose, 1)
        # Best effort hears those who offer it, and those who offer more.
        sensor, clock, ros = qos_profile_sensor_data, time.monotonic, self._ros_s
        node.create_subscription(LaserScan, topics.scan, lambda m: driver.hear_scan(m, clock(), ros()), sensor)
        node.create_subscription(Odometry, topics.odom, lambda m: driver.hear_odometry(m, clock(), ros()), sensor)
        node.create_subscription(TFMessage, "/tf_static", driver.hear_transforms, many)
        node.create_timer(driver.config.step_s, self._drive)
        node.create_timer(_MAP_EVERY_S, self._draw)

    def stand(self) -> None:
        """Tell the robot to stand, if it was ever told to drive."""
        for _ in range(_FAREWELLS if self._driver.backend is not None else 0):
            self._send({})

    def _ros_s(self) -> float:
        return 1e-9 * float(self._node.get_clock().now().nanoseconds)

    def _send(self, twist: Message) -> None:
        self._cmd.publish(fill(self._twist(), self._driver.stamped(twist) if self._stamped else twist))

    def _drive(self) -> None:
        if (twist := self._driver.command(time.monotonic())) is not None:
            self._send(twist)
        transform, frames, _, placed = self._types
        if (at := self._driver.map_to_odom()) is not None:
            self._tf.publish(frames(transforms=[fill(transform(), at)]))
        if (pose := self._driver.pose()) is not None:
            self._pose.publish(fill(placed(), pose))

    def _draw(self) -> None:
        if (drawn := self._driver.map()) is not None:
            self._map.publish(fill(self._types[2](), drawn))
