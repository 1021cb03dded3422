"""A simulated robot and the node's core, driven by the messages that it says."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from mecanum_env.arguments import make_config
from slam.geometry import compose
from slam.ros import Mount, pose_of, transforms_of
from tests.slam.ros.bags_on_disk import TF
from tests.training.ros.robots import Robot, packed
from training.ros.driver import Driver

STAND = {"linear": {"x": 0.0, "y": 0.0}, "angular": {"z": 0.0}}


class Drive:
    """A robot and its driver, a step every 0.1 s of a clock."""

    def __init__(self, *, agent: str = "brisk-tour", mount: Mount | None = None, **robot: Any) -> None:
        self.said: list[str] = []
        self.robot, self.now_s = Robot(**robot), 0.0
        self.driver = Driver(make_config(), agent, mount=mount, log=self.said.append)

    @property
    def pose(self) -> Any:
        """The pose that it says, and its covariance of x, y and heading."""
        said = packed("geometry_msgs/msg/PoseWithCovarianceStamped", self.driver.pose()).pose
        return pose_of(said.pose), said.covariance.reshape(6, 6)[np.ix_([0, 1, 5], [0, 1, 5])]

    @property
    def by_transforms(self) -> Any:
        """Where the base is by map → odom and the newest odometry."""
        (placed,) = transforms_of(packed(TF, {"transforms": [self.driver.map_to_odom()]}))
        in_map = np.array([*placed.matrix[:2, 3], math.atan2(*placed.matrix[1::-1, 0])])
        return compose(in_map, pose_of(self.robot.odometry().pose.pose))

    def hear(self, *, scans: bool = True, odometry: bool = True) -> None:
        if odometry:
            self.driver.hear_odometry(self.robot.odometry(), self.now_s)
        if scans:
            self.driver.hear_scan(self.robot.scan(), self.now_s)

    def step(self, **what: bool) -> Any:
        """Hear, drive, and return the twist."""
        self.hear(**what)
        twist = self.driver.command(self.now_s)
        self.robot.drive(twist)
        self.now_s += 0.1
        return twist


def begun(steps: int = 20, *, agent: str = "brisk-tour") -> Drive:
    drive = Drive(agent=agent)
    drive.driver.hear_transforms(drive.robot.mount())
    for _ in range(steps):
        drive.step()
    return drive


def driven(drive: Drive, odometry: Callable[[], Any], seen: Callable[[], Any], *, steps: int = 30) -> list[bool]:
    """Return whether it drove in each step, of odometry and scans as they are made; ``None``: of none."""
    drove = []
    for _ in range(steps):
        for hear, message in ((drive.driver.hear_odometry, odometry()), (drive.driver.hear_scan, seen())):
            if message is not None:
                hear(message, drive.now_s)
        twist = drive.driver.command(drive.now_s)
        drove.append(twist not in (None, STAND))
        drive.robot.drive(twist)
        drive.now_s += 0.1
    return drove


def held_up(make: Callable[[], Any], steps: int) -> Callable[[], Any]:
    """Return messages that come so many steps late."""
    made: deque[Any] = deque()

    def late() -> Any:
        made.append(make())
        return made.popleft() if len(made) > steps else None

    return late
