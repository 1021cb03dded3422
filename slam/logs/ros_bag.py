"""ROS 2 bags: laser scans, odometry, and where on the robot the lidar sits (``docs/how-to/replay.md``).

A scan is a ``sensor_msgs/LaserScan``; odometry is a ``nav_msgs/Odometry``, or the transform odom → base of ``/tf``
where there is none; the lidar's place is that of ``/tf_static``. Poses are of the robot's frame, the child frame
of its odometry. Backends know of a lidar ahead of the robot's middle only: of one beside it the poses are of the
point of the robot's frame that lies straight behind it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from slam.files import BagMessage, bag_messages, plain_name, quoted
from slam.geometry import relative, wrap
from slam.logs.scans import SETTINGS, ScanLog, beside, chain, rising
from slam.ros import Frames, Mount, mount_of, odometry_of, pose_of, resampled, scan_of, stamp_of, transforms_of
from slam.types import Array, Scan

__all__ = ["BagTopics", "parse_mount", "read"]

_SCAN, _ODOMETRY, _TF = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
_POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
_TYPES = (_SCAN, _ODOMETRY, _TF, *_POSES)
_NEEDED = {  # by option: types of topics to choose from, and what to record where there is none
    "scan": ((_SCAN,), "a sensor_msgs/LaserScan"),
    "odom": ((_ODOMETRY,), "a nav_msgs/Odometry, or the transform odom → base in /tf"),
    "reference": ((_ODOMETRY, *_POSES), "a nav_msgs/Odometry, PoseStamped or PoseWithCovarianceStamped"),
}

_MOST_RANGES = 2**28  # of all scans together: a gibibyte
_REFERENCE_GAP_S = 0.5  # that a reference is interpolated over
_GAP_SCANS = 2.0  # intervals of scans, across which it is one line: scans may be rarer than that
_LONGEST_JUMP_M = 1e3  # from one odometry to the next
_FASTEST_M_S, _FASTEST_RAD_S = 25.0, 20.0  # beyond is no motion, but odometry that began anew …
_LEAST_S = 0.04  # … where not just two stamps lie too close together
_LONGEST_NOTE = 600  # in characters
_MOST_TOPICS = 12  # that an error lists
_MOST_ODD = 0.1  # of a topic's messages that are left out: more are no chance, but a driver's fault


@dataclass(frozen=True, kw_only=True)
class BagTopics:
    """What of a bag is read; ``None``: what is found by type, or bears the usual name."""

    scan: str | None = None
    odom: str | None = None  # a topic of Odometry; /tf: the transform odom → base
    reference: str | None = None  # Odometry, PoseStamped or PoseWithCovarianceStamped
    mount: Mount | None = None  # where no transform tells


@dataclass
class _Track:
    """A frame's poses as they come."""

    child: str
    stamps: list[float] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)

    def add(self, stamp: float, pose: Array) -> None:
        self.stamps.append(stamp)
        self.poses.append(pose)

    def sorted(self) -> tuple[Array, Array]:
        """Return times ``(n,)`` that rise, and poses ``(n, 3)`` with unwrapped headings; of equal times one."""
        times, first = np.unique(np.array(self.stamps), return_index=True)
        poses = np.stack(self.poses)[first]
        poses[:, 2] = np.unwrap(poses[:, 2])
        return times, poses


@dataclass
class _Found:
    """What was read of a bag."""

    topics: dict[str, str] = field(default_factory=dict)
    scans: dict[str, list[tuple[float, Scan]]] = field(default_factory=dict)
    scan_frames: dict[str, str] = field(default_factory=dict)
    tracks: dict[str, _Track] = field(default_factory=dict)  # of Odometry and poses, by topic; of odom in /tf
    frames: Frames = field(default_factory=Frames)
    hanging: dict[str, dict[str, _Track]] = field(default_factory=dict)  # from odom, by topic of /tf and frame
    wrong: dict[str, str] = field(default_factory=dict)  # what is wrong on a topic as a whole
    messages: Counter[str] = field(default_factory=Counter)  # how many, by topic, odd ones too
    odd: Counter[str] = field(default_factory=Counter)  # how many of them are invalid …
    first_odd: dict[str, str] = field(default_factory=dict)  # … and why the first one is
    ranges: int = 0

    def left_out(self, *topics: str) -> str:
        """Say in a note how many messages of some topics are left out."""
        odd = ", ".join(f"{self.odd[topic]} of {topic}" for topic in topics if topic in self.odd)
        return f"; invalid messages that are left out: {odd}" if odd else ""


def parse_mount(text: str) -> Mount:
    """Return a lidar's place as it is typed: ``X,Y,DEG`` in m, m and degrees, and ``,flipped`` upside down."""
    words = text.split(",")
    flipped = words[3:] == ["flipped"]
    try:
        x, y, degrees = map(float, words[:3] if flipped else words)
    except ValueError:
        x = y = degrees = math.nan
    if not max(abs(x), abs(y)) <= 10.0 or not abs(degrees) <= 360.0:
        raise ValueError(f"mount {quoted(text)} is not X,Y,DEG in m and degrees; give for instance 0.2,0,180 or "
                         "0.2,0,0,flipped")  # fmt: skip
    return Mount(x, y, math.radians(degrees), flipped)


def read(path: Path, topics: BagTopics) -> ScanLog:
    """Read a ROS 2 bag: a folder of ``ros2 bag record``, or one of its files (MCAP or SQLite).

    Scans before the first odometry and after the last are left out; at the others the odometry is interpolated.
    Where that jumps, as when its driver was started again, it goes on from where it was. Messages may lie in any
    order; their stamps tell. A few that are invalid are left out, and counted in the note.
    Scans whose beams lie otherwise than most scans' take, at each of those bearings, the nearest beam.

    Raises
    ------
    ValueError
        One line: what is missing or damaged or says what no robot does; where topics have to be chosen, which
        there are, and by which option.
    """
    found = _gather(path, topics)
    where = f"bag {path}"
    scan_topic = _choose(found, found.scans, topics.scan, "/scan", "scan", where)
    if topics.reference is not None:
        held = [topic for topic in found.tracks if found.topics[topic] != _TF]  # there it is odometry, no truth
        _choose(found, held, topics.reference, "", "reference", where)
    odom_topic = _odometry_topic(found, topics, where)
    track = found.tracks[odom_topic]
    if odom_topic in found.hanging:
        track = _robots_own(found, odom_topic, found.scan_frames[scan_topic], where)
    mount = topics.mount or _mount(found, track.child, found.scan_frames[scan_topic], where)
    odometry_times, odometry = track.sorted()
    jump = np.hypot(*np.diff(odometry[:, :2], axis=0).T).max(initial=0.0)
    if jump > _LONGEST_JUMP_M:
        raise ValueError(f"{where}: the odometry on {odom_topic} jumps by {jump:.4g} m; correct the log")
    odometry, jumps = _without_jumps(odometry_times, odometry)
    used = f"; scans of {scan_topic}, odometry of {odom_topic}"
    used += f"; jumps of the odometry that are left out: {jumps}" if jumps else ""
    used += found.left_out(scan_topic, odom_topic)
    scans = _in_order(found.scans[scan_topic])
    stamps = np.array([stamp for stamp, _ in scans])
    covered = np.flatnonzero((stamps >= odometry_times[0]) & (stamps <= odometry_times[-1]))
    if not len(covered):
        raise ValueError(f"{where}: no scan of {scan_topic} is from the time of the odometry on {odom_topic}; "
                         "record both by one clock")  # fmt: skip
    if len(covered) > 1 and np.ptp(stamps[covered]) == 0.0:
        raise ValueError(f"{where}: all scans of {scan_topic} have one time stamp; correct its driver")
    stamps = stamps[covered]
    poses = beside(_at(stamps, odometry_times, odometry), mount.y_m)
    ranges, usual = _ranges([scans[i][1] for i in covered], mount)
    if not np.isfinite(ranges).any():
        within = f"range_min and range_max, {usual.range_min:.4g} and {usual.range_max:.4g} m"
        raise ValueError(
            f"{where}: every beam of {scan_topic} is lost: no range lies between {within}; correct its driver"
        )
    times = rising(stamps)
    gap_s = max(_REFERENCE_GAP_S, _GAP_SCANS * float(np.median(np.diff(times)))) if len(times) > 1 else 0.0
    log = ScanLog(
        name=plain_name(path.absolute().name.split(".")[0]), clock_start_s=float(times[0]), times=times - times[0],
        stamps=stamps, ranges=ranges, angle_min=usual.angle_min, angle_increment=usual.angle_increment,
        range_max=usual.range_max, odometry_poses=poses, start_pose=poses[0].copy(), beside_m=mount.y_m,
        reference_times=np.zeros(0),
        reference_poses=np.zeros((0, 3)), reference_gap_s=gap_s,
        settings=SETTINGS | {"lidar_offset_m": mount.x_m},
        note=plain_name(f"no reference; give one with --reference-topic{used}", _LONGEST_NOTE),
    )  # fmt: skip
    if topics.reference is None:
        return log
    reference_times, reference = found.tracks[topics.reference].sorted()
    rows = _bracketed(stamps, reference_times)
    if not len(rows):
        raise ValueError(f"{where}: {topics.reference} has no pose within {_REFERENCE_GAP_S} s of a scan")
    note = f"reference: {topics.reference}; the start pose is the reference's{used}"
    note += found.left_out(topics.reference)
    at = beside(_at(stamps[rows], reference_times, reference), mount.y_m)
    return log.with_reference(rows, at, plain_name(note, _LONGEST_NOTE))


# ---- reading ---------------------------------------------------------------------------------------------------


def _gather(path: Path, topics: BagTopics) -> _Found:
    try:
        from rosbags.typesys import Stores, get_typestore
    except ModuleNotFoundError as error:
        raise ValueError(f"bag {path}: reading it needs {error.name}; pip install 'mecanum-slam[ros]'") from error
    # These types are the same in every ROS 2. What the bag says of its types is not read: it would be made code.
    store = get_typestore(Stores.ROS2_HUMBLE)
    found = _Found()
    for message in bag_messages(path, _TYPES, found.topics):
        given = {_SCAN: topics.scan, **dict.fromkeys(_POSES, topics.reference or "")}.get(message.datatype)
        if given not in (None, message.topic):
            continue
        try:
            decoded = store.deserialize_cdr(message.data, message.datatype)
        except Exception as error:  # struct's, NumPy's, Unicode's …
            raise ValueError(
                f"bag {path}: a message of {quoted(message.topic)} is damaged; mend the bag"
            ) from error
        found.messages[message.topic] += 1
        try:
            _take(found, message, decoded)
        except ValueError as error:  # it matters where the topic is used, and there are many
            found.odd[message.topic] += 1
            found.first_odd.setdefault(message.topic, f"{error} (at stamp {stamp_of(decoded):.3f} s")
    for topic, odd in found.odd.items():
        if odd >= _MOST_ODD * found.messages[topic]:
            share = f"{odd} of {found.messages[topic]} messages are invalid"
            found.wrong.setdefault(topic, f"{found.first_odd[topic]}; {share})")
    return found


def _take(found: _Found, message: BagMessage, decoded: Any) -> None:
    topic = message.topic
    if message.datatype == _TF:
        for placed in transforms_of(decoded):
            found.frames.add(placed)
            if placed.parent.rpartition("/")[2] == "odom" and topic != "/tf_static":
                pose = np.array([*placed.matrix[:2, 3], math.atan2(placed.matrix[1, 0], placed.matrix[0, 0])])
                hanging = found.hanging.setdefault(topic, {})
                track = hanging.setdefault(placed.child, _Track(placed.child))
                track.add(placed.time_s, pose)
                found.tracks.setdefault(topic, track)
        return
    if message.datatype == _SCAN:
        scan = scan_of(decoded)
        found.ranges += len(scan.ranges)
        if found.ranges > _MOST_RANGES:
            found.wrong[topic] = f"has more than {_MOST_RANGES} ranges; cut the bag into shorter ones"
            return
        frame = decoded.header.frame_id.lstrip("/")
        if found.scan_frames.setdefault(topic, frame) != frame:
            both = f"{quoted(found.scan_frames[topic])} and {quoted(frame)}"
            found.wrong[topic] = f"has scans in frames {both}; record a topic for each lidar"
            return
        kept = scan._replace(ranges=scan.ranges.astype(np.float32))  # as they were recorded
        found.scans.setdefault(topic, []).append((stamp_of(decoded), kept))
        return
    child = decoded.child_frame_id.lstrip("/") if message.datatype == _ODOMETRY else ""
    of_pose = decoded.pose if message.datatype == _POSES[0] else decoded.pose.pose
    pose = odometry_of(decoded) if message.datatype == _ODOMETRY else pose_of(of_pose)
    found.tracks.setdefault(topic, _Track(child or "base_link")).add(stamp_of(decoded), pose)


# ---- choosing --------------------------------------------------------------------------------------------------


def _choose(
    found: _Found, held: Collection[str], given: str | None, usual: str, what: str, where: str
) -> str:  # fmt: skip
    """Return the topic that is meant: the one given, the usual one, or the only one."""
    kinds, needed = _NEEDED[what]
    chosen = given if given is not None else usual
    could = list(held) or [topic for topic in found.wrong if found.topics[topic] in kinds]
    if given is None and usual not in (*could, *found.wrong) and len(could) == 1:
        chosen = could[0]
    if chosen in found.wrong:
        raise ValueError(f"{where}: topic {quoted(chosen)} {found.wrong[chosen]}")
    if chosen in held:
        return chosen
    word = "odometry" if what == "odom" else what
    said = f"{len(held)} topics could be the {word}" if held else f"no topic of {word}"
    if given is not None:
        said = f"no {word} on topic {quoted(given)}"
    if not held and not any(datatype in kinds for datatype in found.topics.values()):
        raise ValueError(f"{where}: {said}; record {needed}. Its topics: {_listed(found)}")
    raise ValueError(f"{where}: {said}; choose by --{what}-topic from {_listed(found)}")


def _odometry_topic(found: _Found, topics: BagTopics, where: str) -> str:
    held = [topic for topic in found.tracks if found.topics[topic] == _ODOMETRY]
    if topics.odom is not None or not held:
        held += [topic for topic in found.tracks if found.topics[topic] == _TF]
    if topics.reference not in (topics.odom, "/odom"):  # else it is not meant, where there is another
        held = [topic for topic in held if topic != topics.reference] or held
    chosen = _choose(found, held, topics.odom, "/odom", "odom", where)
    if chosen == topics.reference:
        raise ValueError(f"{where}: topic {quoted(chosen)} cannot be both odometry and reference; choose another "
                         f"by --odom-topic or --reference-topic from {_listed(found)}")  # fmt: skip
    return chosen


def _robots_own(found: _Found, topic: str, sensor: str, where: str) -> _Track:
    """Return the track of the frame that the lidar hangs from, of those that hang from odom in a topic of /tf."""
    hanging = found.hanging[topic]
    if len(hanging) == 1:
        return next(iter(hanging.values()))
    own = [child for child in hanging if found.frames.carries(child, sensor)]
    if len(own) != 1:
        names = ", ".join(quoted(child) for child in sorted(hanging)[:_MOST_TOPICS])
        raise ValueError(
            f"{where}: {names} all hang from odom in {topic}, and transforms do not say which of them carries the "
            f"lidar {quoted(sensor)}; choose by --odom-topic from {_listed(found)}"
        )
    return hanging[own[0]]


def _listed(found: _Found) -> str:
    shown = [
        f"{quoted(topic)[1:-1]} ({quoted(datatype)[1:-1].rpartition('/')[2]})"
        for topic, datatype in sorted(found.topics.items(), key=lambda item: (item[1] not in _TYPES, item[0]))
    ]
    more = f", and {len(shown) - _MOST_TOPICS} more" if len(shown) > _MOST_TOPICS else ""
    return ", ".join(shown[:_MOST_TOPICS]) + more or "none"


def _mount(found: _Found, base: str, sensor: str, where: str) -> Mount:
    try:
        matrix = found.frames.between(base, sensor)
        if matrix is not None:
            return mount_of(matrix)
    except ValueError as error:
        raise ValueError(f"{where} {error}") from error
    raise ValueError(f"{where}: no transform says where the lidar {quoted(sensor)} is on {quoted(base)}; record "
                     "/tf_static, or give --mount X,Y,DEG")  # fmt: skip


# ---- poses and ranges at scans ---------------------------------------------------------------------------------


def _ranges(scans: list[Scan], mount: Mount) -> tuple[Any, Scan]:
    """Return ranges ``(n, beams)`` at most scans' bearings by the robot's heading, and the first of those."""
    lie = [(scan.angle_min, scan.angle_increment, len(scan.ranges)) for scan in scans]
    usual = mount.level(scans[lie.index(Counter(lie).most_common(1)[0][0])])
    like = (usual.angle_min, usual.angle_increment, len(usual.ranges))
    levelled = (mount.level(scan) for scan in scans)
    rows: Iterator[Array] = (
        s.ranges if (s.angle_min, s.angle_increment, len(s.ranges)) == like else resampled(s, *like)
        for s in levelled
    )
    return np.stack([np.asarray(row, np.float32) for row in rows]), usual


def _in_order(scans: list[tuple[float, Scan]]) -> list[tuple[float, Scan]]:
    """Return scans by their stamps, as odometry is taken; what a merged bag has twice, once."""
    kept: list[tuple[float, Scan]] = []
    for stamp, scan in sorted(scans, key=lambda each: each[0]):
        at, before = kept[-1] if kept else (math.nan, scan)
        if stamp != at or not np.array_equal(scan.ranges, before.ranges, equal_nan=True):
            kept.append((stamp, scan))
    return kept


def _without_jumps(times: Array, poses: Array) -> tuple[Array, int]:
    """Return poses ``(n, 3)`` without motions that no robot makes, headings unwrapped, and how many there were."""
    steps, span = relative(poses[:-1], poses[1:]), np.maximum(np.diff(times), _LEAST_S)
    jumped = (np.hypot(steps[:, 0], steps[:, 1]) > _FASTEST_M_S * span) | (
        np.abs(steps[:, 2]) > _FASTEST_RAD_S * span
    )
    if not jumped.any():
        return poses, 0
    steps[jumped] = 0.0
    whole = chain(poses[0], steps)
    whole[:, 2] = np.unwrap(whole[:, 2])
    return whole, int(np.count_nonzero(jumped))


def _at(stamps: Array, times: Array, poses: Array) -> Array:
    """Return poses ``(m, 3)`` at stamps, between those at times ``(n,)``, whose headings are unwrapped."""
    x, y, theta = (np.interp(stamps, times, column) for column in poses.T)
    return np.column_stack([x, y, wrap(theta)])


def _bracketed(stamps: Array, times: Array) -> Any:
    """Return which stamps lie at or between times that are no farther apart than a reference may have gaps."""
    after = np.searchsorted(times, stamps)
    inside = after < len(times)
    to = np.minimum(after, len(times) - 1)
    exact = times[to] == stamps
    gap = times[to] - times[np.maximum(to - 1, 0)]
    return np.flatnonzero(inside & (exact | ((after > 0) & (gap <= _REFERENCE_GAP_S))))
