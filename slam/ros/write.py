"""From our types to ROS 2 messages, as nested mappings; and from those to the messages of a library.

A field that is left out is zero or empty. :func:`rosbags_message` makes a message of the package rosbags, which
packs it as CDR; :func:`fill` fills one of ROS itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.geometry import wrap
from slam.types import Array, Scan

__all__ = [
    "Message", "covariance", "fill", "grid_message", "header", "nanoseconds", "odometry_message", "pose_message",
    "pose_with_covariance", "rosbags_message", "scan_message", "stamp", "transform_message", "twist_message",
]  # fmt: skip

Message = Mapping[str, Any]
"""A message as nested mappings; a field that is left out is zero or empty."""


# ---- messages --------------------------------------------------------------------------------------------------


def nanoseconds(time_s: float) -> int:
    """Return a time [s] in whole nanoseconds."""
    return round(float(time_s) * 1e9)


def stamp(time_s: float) -> dict[str, int]:
    """Return a ``builtin_interfaces/Time``."""
    seconds, rest = divmod(nanoseconds(time_s), 10**9)
    return {"sec": seconds, "nanosec": rest}


def header(time_s: float, frame: str) -> dict[str, Any]:
    """Return a ``std_msgs/Header``."""
    return {"stamp": stamp(time_s), "frame_id": frame}


def scan_message(time_s: float, frame: str, scan: Scan, *, scan_time_s: float = 0.0) -> Message:
    """Return a ``sensor_msgs/LaserScan``; all beams are of one instant."""
    return {
        "header": header(time_s, frame),
        "angle_min": scan.angle_min,
        "angle_max": scan.angle_min + (len(scan.ranges) - 1) * scan.angle_increment,
        "angle_increment": scan.angle_increment,
        "time_increment": 0.0,
        "scan_time": scan_time_s,
        "range_min": scan.range_min,
        "range_max": scan.range_max,
        "ranges": scan.ranges,
    }


def grid_message(
    time_s: float, frame: str, classes: NDArray[np.int8], resolution: float, origin: tuple[float, float]
) -> Message:
    """Return a ``nav_msgs/OccupancyGrid``: −1 unknown, 0 free, 100 occupied.

    Parameters
    ----------
    classes
        ``(rows, columns)``, the lowest y first: UNKNOWN, FREE and OCCUPIED are the values that ROS gives them.
    resolution, origin
        Side of a cell [m], and the outer corner of the first (x, y) [m] in ``frame``.
    """
    return {
        "header": header(time_s, frame),
        "info": {
            "map_load_time": stamp(time_s),
            "resolution": resolution,
            "width": classes.shape[1],
            "height": classes.shape[0],
            "origin": pose_message([*origin, 0.0]),
        },
        "data": classes.ravel(),
    }


def odometry_message(time_s: float, frame: str, child: str, pose: Array, twist: Array) -> Message:
    """Return a ``nav_msgs/Odometry`` of a pose ``(3,)`` and a twist ``(3,)`` in the child's frame."""
    return {
        "header": header(time_s, frame),
        "child_frame_id": child,
        "pose": {"pose": pose_message(pose)},
        "twist": {"twist": twist_message(twist)},
    }


def twist_message(twist: Array | list[float]) -> Message:
    """Return a ``geometry_msgs/Twist`` of vx, vy [m/s], ω [rad/s]."""
    vx, vy, omega = (float(v) for v in twist)
    return {"linear": {"x": vx, "y": vy}, "angular": {"z": omega}}


def transform_message(parent: str, child: str, time_s: float, pose: Array | list[float]) -> Message:
    """Return a ``geometry_msgs/TransformStamped``: the child's pose ``(3,)`` in the parent."""
    placed = pose_message(pose)
    return {
        "header": header(time_s, parent),
        "child_frame_id": child,
        "transform": {"translation": placed["position"], "rotation": placed["orientation"]},
    }


def pose_with_covariance(time_s: float, frame: str, pose: Array, cov: Array) -> Message:
    """Return a ``geometry_msgs/PoseWithCovarianceStamped`` of a pose ``(3,)`` and its covariance ``(3, 3)``."""
    return {"header": header(time_s, frame), "pose": {"pose": pose_message(pose), "covariance": covariance(cov)}}


def pose_message(pose: Array | list[float], *, z: float = 0.0) -> dict[str, Any]:
    """Return a ``geometry_msgs/Pose`` of a planar one."""
    x, y, theta = (float(v) for v in pose)
    half = 0.5 * float(wrap(theta))
    return {
        "position": {"x": x, "y": y, "z": z},
        "orientation": {"x": 0.0, "y": 0.0, "z": math.sin(half), "w": math.cos(half)},
    }


def covariance(cov: Array) -> Array:
    """Return the covariance ``(36,)`` of x, y, z and the turns about them, of a planar pose's ``(3, 3)``."""
    whole = np.zeros((6, 6))
    planar = np.array([0, 1, 5])
    whole[np.ix_(planar, planar)] = cov
    return whole.ravel()


# ---- messages of a library -------------------------------------------------------------------------------------


def rosbags_message(types: Any, datatype: str, message: Message) -> Any:
    """Return a message as rosbags takes it, whole; ``types`` is a store of its types."""
    from rosbags.interfaces import Nodetype

    def filled(node: Any, value: Any) -> Any:
        kind, what = node
        if kind == Nodetype.NAME:
            return rosbags_message(types, what, value or {})
        if kind == Nodetype.BASE:
            return ("" if what[0] == "string" else 0) if value is None else value
        (kind, what), length = what
        if kind == Nodetype.NAME:
            return [rosbags_message(types, what, one) for one in value or ()]
        return np.zeros(length, what[0]) if value is None else np.asarray(value, what[0])

    fields = {name: filled(node, message.get(name)) for name, node in types.fielddefs[datatype][1]}
    return types.types[datatype](**{**message, **fields})


def fill(target: Any, message: Message) -> Any:
    """Fill a fresh message of ROS (rclpy) and return it; sequences of messages are not of what is filled here."""
    for name, value in message.items():
        field = getattr(target, name)
        if isinstance(value, Mapping):
            fill(field, value)
        elif isinstance(value, np.ndarray):
            # An array of the very type is taken as it is; a list would be checked number by number.
            typed = hasattr(field, "typecode")
            of_type = value.astype(field.typecode if typed else field.dtype)
            setattr(target, name, type(field)(field.typecode, of_type.tobytes()) if typed else of_type)
        else:
            setattr(target, name, value)
    return target
