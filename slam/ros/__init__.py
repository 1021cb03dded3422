"""ROS 2 messages from our types and back, without ROS: whatever has the fields of a message is read.

``write`` makes messages as nested mappings, ``read`` takes them apart, ``frames`` finds where the lidar sits. Axes
and units follow REP 103, frames REP 105, ranges REP 117.
"""

from slam.ros.frames import Frames, Mount, mount_of, resampled
from slam.ros.read import Placed, odometry_of, pose_of, scan_of, stamp_of, transforms_of
from slam.ros.write import (
    Message,
    covariance,
    fill,
    grid_message,
    header,
    nanoseconds,
    odometry_message,
    pose_message,
    pose_with_covariance,
    rosbags_message,
    scan_message,
    stamp,
    transform_message,
    twist_message,
)

__all__ = [
    "Frames",
    "Message",
    "Mount",
    "Placed",
    "covariance",
    "fill",
    "grid_message",
    "header",
    "mount_of",
    "nanoseconds",
    "odometry_message",
    "odometry_of",
    "pose_message",
    "pose_of",
    "pose_with_covariance",
    "resampled",
    "rosbags_message",
    "scan_message",
    "scan_of",
    "stamp",
    "stamp_of",
    "transform_message",
    "transforms_of",
    "twist_message",
]
