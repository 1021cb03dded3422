"""From ROS 2 messages to our types, whatever library they come from; what no robot says is refused.

Every function raises ``ValueError`` in words that stand after the name of a topic.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from slam.files import quoted
from slam.types import Array, Scan

__all__ = ["Placed", "odometry_of", "pose_of", "scan_of", "stamp_of", "transforms_of"]

_FEWEST_BEAMS, _MOST_BEAMS = 2, 10_000
_FARTHEST_M = 1e5  # no robot's log spans 100 km
_FARTHEST_RANGE_M = 1e4
_LARGEST_TURN = 2.0 * math.pi + 0.1  # [rad] of a sweep: the last beam may lie on the first
_UNIT = 0.01  # by which a quaternion's length may differ from 1: some are written by hand


class Placed(NamedTuple):
    """A frame's place in another."""

    time_s: float
    parent: str
    child: str
    matrix: Array  # (4, 4) from the child's coordinates to the parent's


def stamp_of(message: Any) -> float:
    """Return the time of a message with a header [s]."""
    at = message.header.stamp
    return float(at.sec) + 1e-9 * float(at.nanosec)


def scan_of(message: Any) -> Scan:
    """Return a ``sensor_msgs/LaserScan`` in its own frame, by REP 117.

    ``inf``, and a range at ``range_max``, which older drivers say instead: nothing returned. −``inf``, ``nan``
    and what is below ``range_min`` or above ``range_max``, which is to be discarded: the beam is lost, ``nan``.
    """
    ranges = np.array(message.ranges, np.float64)
    first, step = float(message.angle_min), float(message.angle_increment)
    low, high = float(message.range_min), float(message.range_max)
    if not _FEWEST_BEAMS <= len(ranges) <= _MOST_BEAMS:
        raise ValueError(f"has a scan of {len(ranges)} beams; {_FEWEST_BEAMS} to {_MOST_BEAMS} are read")
    if not (abs(first) <= 4.0 * math.pi and 0.0 < abs(step) * (len(ranges) - 1) <= _LARGEST_TURN):
        raise ValueError(f"has a scan from angle_min {first:.4g} in {len(ranges)} steps of {step:.4g} rad, which "
                         "is no sweep")  # fmt: skip
    if not 0.0 <= low < high <= _FARTHEST_RANGE_M:
        raise ValueError(f"has a scan with range_min {low:.4g} and range_max {high:.4g}, in m; correct its driver")
    return Scan(ranges, first, step, high, low).by_rep_117()


def odometry_of(message: Any) -> Array:
    """Return the pose ``(3,)`` of a ``nav_msgs/Odometry``, in its ``header.frame_id``."""
    return pose_of(message.pose.pose)


def pose_of(pose: Any) -> Array:
    """Return a ``geometry_msgs/Pose`` seen from above ``(3,)``: x [m], y [m], heading [rad]."""
    p, q = pose.position, pose.orientation
    matrix = _matrix(p, q)
    return np.array([matrix[0, 3], matrix[1, 3], math.atan2(matrix[1, 0], matrix[0, 0])])


def transforms_of(message: Any) -> Iterator[Placed]:
    """Yield what a ``tf2_msgs/TFMessage`` says; a slash before a frame's name, as in ROS 1, is taken off.

    What is no transform, or one to kilometres away as from a map to the earth, is passed over: whoever needs it
    will miss it.
    """
    for each in message.transforms:
        try:
            matrix = _matrix(each.transform.translation, each.transform.rotation)
        except ValueError:
            continue
        yield Placed(stamp_of(each), each.header.frame_id.lstrip("/"), each.child_frame_id.lstrip("/"), matrix)


def _matrix(p: Any, q: Any) -> Array:
    numbers = [float(v) for v in (p.x, p.y, p.z, q.x, q.y, q.z, q.w)]
    if not max(map(abs, numbers[:3])) <= _FARTHEST_M:  # nan is not below
        raise ValueError(f"has a position of {quoted(tuple(numbers[:3]))}, which no robot has")
    length = math.hypot(*numbers[3:])
    if not abs(length - 1.0) <= _UNIT:
        raise ValueError(f"has a quaternion of length {length:.4g}; it must be 1")
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(numbers[3:]).as_matrix()
    matrix[:3, 3] = numbers[:3]
    return matrix
