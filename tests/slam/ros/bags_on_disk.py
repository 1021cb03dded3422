"""Real ROS 2 bags, written by rosbags: messages as nested mappings, and those of a log of scans."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slam.logs import ScanLog
from slam.ros import (
    Message,
    nanoseconds,
    odometry_message,
    rosbags_message,
    scan_message,
    transform_message,
)
from slam.types import Scan

SCAN, ODOMETRY, TF = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"

Recorded = tuple[str, str, float, Message]
"""Topic, type, time [s], message."""


def write_bag(
    path: Path, messages: Iterable[Recorded], *, storage: str = "mcap", mode: str = "", topics: Sequence[str] = ()
) -> Path:
    """Write a bag's folder by rosbags' own writer; ``mode`` packs: storage, message or file."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE)
    writer = Writer(path, version=9, storage_plugin=getattr(StoragePlugin, storage.upper()))
    if mode:
        writer.set_compression(getattr(CompressionMode, mode.upper()), CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, datatype, time_s, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, datatype, typestore=types)
            data = types.serialize_cdr(rosbags_message(types, datatype, message), datatype)
            writer.write(connections[topic], nanoseconds(time_s), data)
        for topic in topics:
            writer.add_connection(topic, "std_msgs/msg/String", typestore=types)
    return path


def mounted(x: float, y: float, yaw: float, *, flipped: bool = False, base: str = "base_link") -> Recorded:
    """Return the transform that says where the laser is."""
    placed: Any = transform_message(base, "laser", 0.0, [x, y, yaw])
    if flipped:  # a half-turn about its own x, after the turn about z
        half = 0.5 * yaw
        placed["transform"]["rotation"] = {"x": np.cos(half), "y": np.sin(half), "z": 0.0, "w": 0.0}
    return "/tf_static", TF, 0.0, {"transforms": [placed]}


def recorded(log: ScanLog, *, odometry: str = "/odom", reference: str = "") -> Iterator[Recorded]:
    """Yield the messages that a robot with a laser at its middle would have recorded."""
    yield mounted(0.0, 0.0, 0.0)
    true = dict(zip(log.reference_times.tolist(), log.reference_poses, strict=True))
    for i, (time_s, pose) in enumerate(zip(log.times.tolist(), log.odometry_poses, strict=True)):
        at = log.clock_start_s + time_s
        if odometry == "/tf":
            yield "/tf", TF, at, {"transforms": [transform_message("odom", "base_link", at, pose)]}
        else:
            yield odometry, ODOMETRY, at, odometry_message(at, "odom", "base_link", pose, np.zeros(3))
        if reference and time_s in true:
            yield reference, ODOMETRY, at, odometry_message(at, "map", "base_link", true[time_s], np.zeros(3))
        scan = log.scan(i)
        yield "/scan", SCAN, at, scan_message(at, "laser", scan)


def scan(ranges: Any, **fields: float) -> Scan:
    """Return a scan of a circle, unless its fields say otherwise."""
    ranges = np.asarray(ranges, np.float64)
    like = {"angle_min": -np.pi, "angle_increment": 2.0 * np.pi / len(ranges), "range_max": 8.0, "range_min": 0.02}
    return Scan(ranges, **{**like, **fields})
