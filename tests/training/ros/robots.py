"""A simulated robot that speaks in ROS 2 messages: real physics, messages packed and unpacked as CDR."""

from __future__ import annotations

from functools import cache
from typing import Any, cast

import gymnasium
import numpy as np

import mecanum_env  # noqa: F401 - registers the environments
from mecanum_env.env import ExploreEnv
from slam.geometry import compose
from slam.motion import move
from slam.ros import (
    Message,
    odometry_message,
    rosbags_message,
    scan_message,
    transform_message,
)
from tests.slam.ros.bags_on_disk import ODOMETRY, SCAN, TF


@cache
def humble() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def packed(datatype: str, message: Message) -> Any:
    """Return a message as it comes out of CDR."""
    types = humble()
    return types.deserialize_cdr(
        types.serialize_cdr(rosbags_message(types, datatype, message), datatype), datatype
    )


class Robot:
    """The environment's robot behind its topics: its clock began long ago, its odometry somewhere.

    Its base is ``beside_m`` to the right of the lidar, which is in the middle of the body that drives.
    """

    def __init__(
        self, *, rooms: str = "rectangular", seed: int = 3, clock_s: float = 1.7e9, beside_m: float = 0.0,
        **settings: Any,
    ) -> None:  # fmt: skip
        # An episode that has ended is summed up at each step.
        settings = {"config": {"coverage_target": 1.0}} | settings
        wrapped = gymnasium.make("mecanum_env/Explore-v0", rooms=rooms, disable_env_checker=True, **settings)
        wrapped.reset(seed=seed)
        self.env = cast("ExploreEnv", wrapped.unwrapped)
        self.clock_s, self.odometry_pose = clock_s, np.array([4.0, -2.0, 2.5])
        self.beside_m, self.info = beside_m, cast("dict[str, Any]", {})

    def scan(self) -> Any:
        return packed(SCAN, scan_message(self.clock_s, "laser", self.env.scan))

    def odometry(self) -> Any:
        twist = np.asarray(self.env.odometry.twist)
        base = compose(self.odometry_pose, np.array([0.0, -self.beside_m, 0.0]))
        return packed(ODOMETRY, odometry_message(self.clock_s, "odom", "base_link", base, twist))

    def mount(self) -> Any:
        at = [self.env.config.lidar.offset_m, self.beside_m, 0.0]
        placed = transform_message("base_link", "laser", 0.0, at)
        return packed(TF, {"transforms": [placed]})

    def drive(self, twist: Message | None) -> None:
        """Drive by a ``geometry_msgs/Twist`` for a step."""
        config = self.env.config
        action = np.zeros(3, np.float32)
        if twist is not None:
            got = packed("geometry_msgs/msg/Twist", twist)
            limits = [config.robot.max_speed_m_s] * 2 + [config.robot.max_turn_rate_rad_s]
            action = np.array([got.linear.x, got.linear.y, got.angular.z], np.float32) / np.array(
                limits, np.float32
            )
        *_, self.info = self.env.step(action)
        self.odometry_pose = move(self.odometry_pose, np.asarray(self.env.odometry.twist), config.step_s)
        self.clock_s += config.step_s
