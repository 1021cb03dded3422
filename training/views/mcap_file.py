"""An episode as an MCAP file of ROS 2 messages, for Foxglove, RViz 2 and whatever else reads bags.

Frames follow REP 105: ``map`` (the belief's, which is the start frame) → ``odom`` (dead reckoning) →
``base_link`` → ``laser``, so that map → odom → base_link is the believed pose; the true one is ``base_link_true``.
Axes and units follow REP 103, ranges REP 117. Time is the episode's own, from 0 s.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Mapping
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mecanum_env.config import LidarConfig, RobotConfig
from slam.formats import replacing
from slam.geometry import compose, inverse
from slam.motion import twist_between
from slam.ros import (
    Message,
    grid_message,
    header,
    nanoseconds,
    odometry_message,
    pose_message,
    pose_with_covariance,
    rosbags_message,
    scan_message,
    transform_message,
)
from training.episodes.playback import dead_reckoned, ellipses, map_origin, maps
from training.episodes.recording import Recording
from training.runs.errors import needs_extra

__all__ = ["TOPICS", "check_mcap", "write_mcap"]

TOPICS = {
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/robot": "visualization_msgs/msg/MarkerArray",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/odom": "nav_msgs/msg/Odometry",
    "/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/ground_truth": "nav_msgs/msg/Odometry",
    "/scan": "sensor_msgs/msg/LaserScan",
    "/map": "nav_msgs/msg/OccupancyGrid",
    "/landmarks": "visualization_msgs/msg/MarkerArray",
    "/plan": "nav_msgs/msg/Path",
}

_LATCHED = ("/tf_static", "/robot", "/map", "/plan")
_LEAST_AXIS_M = 0.02  # an ellipse smaller than this could not be seen
_BODY_HEIGHT_M = 0.14
_LANDMARK_HEIGHT_M = 0.02

_CUBE, _CYLINDER = 1, 3
_ADD, _DELETE = 0, 2
_BELIEVED, _TRUE, _LANDMARK = (0.17, 0.38, 0.80, 1.0), (0.09, 0.55, 0.44, 0.5), (0.70, 0.15, 0.50, 0.6)

# A recorder's account of a publisher, in numbers as Humble has it. ``ros2 bag play`` offers the same again, and a
# listener to static transforms hears none that were not offered as transient local (durability 1).
_QOS = """\
- history: 1
  depth: {depth}
  reliability: 1
  durability: {durability}
  deadline: {{sec: 9223372036, nsec: 854775807}}
  lifespan: {{sec: 9223372036, nsec: 854775807}}
  liveliness: 1
  liveliness_lease_duration: {{sec: 9223372036, nsec: 854775807}}
  avoid_ros_namespace_conventions: false
"""
# Without this record newer rosbag2 expects words in place of the numbers.
_ROSBAG2 = ("rosbag2", {"ROS_DISTRO": "humble"})


def check_mcap() -> None:
    """Raise :class:`BadInput` where a library is missing, before an episode is run in vain."""
    with needs_extra("ros", "--mcap"):
        import mcap.writer  # noqa: F401
        import rosbags.typesys  # noqa: F401


def write_mcap(
    recording: Recording,
    path: str | Path,
    *,
    robot: RobotConfig,
    lidar: LidarConfig,
    about: Mapping[str, str] | None = None,
) -> None:
    """Write an episode as ROS 2 messages; docs/how-to/exports.md lists the topics.

    What the file says of itself, ``about`` (agent, backend, seed, …), is the metadata record ``mecanum-slam``.

    Raises
    ------
    BadInput
        Where the packages ``mcap`` and ``rosbags`` are missing.
    """
    check_mcap()
    from mcap.writer import Writer
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE)  # what is written here is the same until Kilted
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        writer: Any = Writer(stream)
        writer.start(profile="ros2", library="mecanum-slam")
        writer.add_metadata(*_ROSBAG2)
        if about:
            writer.add_metadata("mecanum-slam", dict(about))
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        for topic, datatype in TOPICS.items():
            if datatype not in schemas:
                definition, _ = types.generate_msgdef(datatype, ros_version=2)
                schemas[datatype] = writer.register_schema(datatype, "ros2msg", definition.encode())
            latched = topic in _LATCHED
            qos = _QOS.format(depth=1 if latched else 10, durability=1 if latched else 2)
            channels[topic] = writer.register_channel(
                topic, "cdr", schemas[datatype], {"offered_qos_profiles": qos}
            )
        for step, topic, message in _messages(recording, robot, lidar):
            at = nanoseconds(recording.times[step])
            encoded = types.serialize_cdr(rosbags_message(types, TOPICS[topic], message), TOPICS[topic])
            writer.add_message(channels[topic], at, bytes(encoded), at)
        writer.finish()


def _messages(recording: Recording, robot: RobotConfig, lidar: LidarConfig) -> Iterable[tuple[int, str, Message]]:
    """Return every message with its step and topic, in order of time."""
    times, landmarks = recording.times, recording.landmarks
    before = [0, *map(len, landmarks.values)]
    laser = {"transforms": [transform_message("base_link", "laser", 0.0, [lidar.offset_m, 0.0, 0.0])]}
    return heapq.merge(
        [(0, "/tf_static", laser), (0, "/robot", _robot(robot))],
        _poses(recording),
        ((step, "/scan", _scan(recording, times[step], ranges)) for step, ranges in recording.scans.items()),
        (
            (step, "/map", grid_message(times[step], "map", classes, recording.resolution, map_origin(recording)))
            for step, classes in maps(recording)
        ),
        (
            (step, "/landmarks", _landmarks(times[step], rows, shown))
            for (step, rows), shown in zip(landmarks.items(), before, strict=False)
        ),
        ((step, "/plan", _plan(times[step], path)) for step, path in recording.goals.items()),
        key=itemgetter(0),
    )


def _poses(recording: Recording) -> Iterator[tuple[int, str, Message]]:
    """Return what is known of the pose at each step."""
    true_before = recording.true_poses[0]
    for step, (time_s, odom, believed, true) in enumerate(
        zip(recording.times, dead_reckoned(recording), recording.estimates, recording.true_poses, strict=True)
    ):
        frames = [
            transform_message("map", "odom", time_s, compose(believed, inverse(odom))),
            transform_message("odom", "base_link", time_s, odom),
            transform_message("map", "base_link_true", time_s, true),
        ]
        yield step, "/tf", {"transforms": frames}
        yield step, "/odom", odometry_message(time_s, "odom", "base_link", odom, recording.twists[step])
        yield step, "/pose", pose_with_covariance(time_s, "map", believed, recording.pose_covs[step])
        twist = twist_between(true_before, true, recording.step_s)
        yield step, "/ground_truth", odometry_message(time_s, "map", "base_link_true", true, twist)
        true_before = true


# ---- messages --------------------------------------------------------------------------------------------------


def _scan(recording: Recording, time_s: float, ranges: NDArray[np.generic]) -> Message:
    scan = recording.scan._replace(ranges=np.asarray(ranges, np.float64))
    apart = int(recording.scans.steps[1]) if len(recording.scans.steps) > 1 else 1  # the first is the start's
    return scan_message(time_s, "laser", scan, scan_time_s=apart * recording.step_s)


def _plan(time_s: float, path: NDArray[np.generic]) -> Message:
    """Return the way ahead, each pose looking along it."""
    points = np.asarray(path, np.float64)
    top = header(time_s, "map")
    along = np.diff(points, axis=0, append=points[-1:])
    headings = np.arctan2(along[:, 1], along[:, 0])
    headings[-1:] = headings[-2:-1] if len(points) > 1 else 0.0
    poses = np.column_stack([points, headings])
    return {"header": top, "poses": [{"header": top, "pose": pose_message(p)} for p in poses]}


def _landmarks(time_s: float, rows: NDArray[Any], shown: int) -> Message:
    """Return a flat cylinder for each landmark's 3σ ellipse; of those ``shown`` the rest go."""
    axes, directions = ellipses(rows)
    size = np.maximum(2.0 * axes, _LEAST_AXIS_M)
    ns, top = "landmarks", header(time_s, "map")
    markers = [
        _marker(ns, k, top, _CYLINDER, _LANDMARK, pose_message([x, y, turn]), (width, height, _LANDMARK_HEIGHT_M))
        for k, (x, y, turn, width, height) in enumerate(np.column_stack([rows[:, :2], directions, size]).tolist())
    ]
    gone = [
        {"header": top, "ns": ns, "id": k, "action": _DELETE, "pose": pose_message([0.0, 0.0, 0.0])}
        for k in range(len(rows), shown)
    ]
    return {"markers": markers + gone}


def _robot(robot: RobotConfig) -> Message:
    """Return the body where it is believed to be and where it is, both moving along with their frames."""
    pose, size = (
        pose_message([0.0, 0.0, 0.0], z=0.5 * _BODY_HEIGHT_M),
        (robot.length_m, robot.width_m, _BODY_HEIGHT_M),
    )
    bodies = (("base_link", _BELIEVED), ("base_link_true", _TRUE))
    return {
        "markers": [
            {**_marker("robot", k, header(0.0, frame), _CUBE, colour, pose, size), "frame_locked": True}
            for k, (frame, colour) in enumerate(bodies)
        ]
    }


def _marker(
    ns: str, number: int, top: Message, kind: int, colour: tuple[float, ...], pose: Message,
    size: tuple[float, float, float],
) -> dict[str, Any]:  # fmt: skip
    return {
        "header": top, "ns": ns, "id": number, "type": kind, "action": _ADD, "pose": pose,
        "scale": dict(zip("xyz", size, strict=True)), "color": dict(zip("rgba", colour, strict=True)),
    }  # fmt: skip
