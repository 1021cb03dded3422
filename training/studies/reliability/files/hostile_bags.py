"""ROS 2 bags: sound ones, of a drive along a circle, and those that are made to do harm."""

from __future__ import annotations

import io
import math
import sqlite3
import tempfile
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from slam.ros import Message, nanoseconds, odometry_message, rosbags_message, scan_message, transform_message
from slam.types import Scan
from training.studies.reliability.files.samples import Files, Hostile, Link, Pipe, Sound, one

__all__ = ["BAGS", "bags"]

_SCAN, _ODOMETRY, _TF = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
_NUMBERS = (math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, 1e10, -1.0, 0.0)


_Messages = list[tuple[str, str, float, Message]]


def _drive(ranges: Any = None, *, twisted: Mapping[str, Any] | None = None) -> _Messages:
    """Return topics, types, times and messages; ``twisted`` replaces fields of the sixth scan."""
    out: _Messages = [
        ("/tf_static", _TF, 1e9, {"transforms": [transform_message("base_link", "laser", 1e9, [0.2, 0.0, 0.0])]})
    ]
    for k in range(12):
        at, turned = 1e9 + 0.1 * k, 0.1 * k
        pose = np.array([math.sin(turned), 1.0 - math.cos(turned), turned])
        out.append(("/odom", _ODOMETRY, at, odometry_message(at, "odom", "base_link", pose, np.zeros(3))))
        measured = 3.0 + np.sin(0.1 * np.arange(90) + 0.1 * k) if ranges is None else ranges
        scan = scan_message(at, "laser", Scan(measured, -1.5, 3.0 / 89, 8.0, 0.1))
        out.append(("/scan", _SCAN, at, {**scan, **(twisted or {})} if k == 5 else scan))
    return out


def _encoded(messages: _Messages) -> list[tuple[str, str, int, bytes]]:
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE)
    return [
        (topic, kind, nanoseconds(at), bytes(types.serialize_cdr(rosbags_message(types, kind, message), kind)))
        for topic, kind, at, message in messages
    ]


def _mcap(messages: _Messages) -> bytes:
    from mcap.writer import Writer

    stream = io.BytesIO()
    writer: Any = Writer(stream)
    writer.start(profile="ros2", library="sample")
    channels: dict[str, int] = {}
    for topic, kind, at, data in _encoded(messages):
        if topic not in channels:
            channels[topic] = writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", b""))
        writer.add_message(channels[topic], at, data, at)
    writer.finish()
    return stream.getvalue()


def _db3(messages: _Messages, *, more: str = "") -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bag.db3"
        database = sqlite3.connect(path)
        database.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT,"
            " offered_qos_profiles TEXT);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
        )
        numbers: dict[str, int] = {}
        for topic, kind, at, data in _encoded(messages):
            if topic not in numbers:
                numbers[topic] = len(numbers) + 1
                row = (numbers[topic], topic, kind, "cdr", "")
                database.execute("INSERT INTO topics VALUES (?, ?, ?, ?, ?)", row)
            row_of = (numbers[topic], at, data)
            database.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", row_of)
        database.executescript(more)
        database.commit()
        database.close()
        return path.read_bytes()


@cache
def bags() -> Sound:
    """Return a drive as MCAP and as SQLite."""
    return {"drive.mcap": _mcap(_drive()), "drive.db3": _db3(_drive())}


def _bomb(compression: str) -> Files:
    """Return a chunk that unpacks to 600 MB of zeros, and says so."""
    import lz4.frame
    import zstandard
    from mcap.data_stream import RecordBuilder
    from mcap.records import Chunk

    zeros = bytes(600 * 2**20)
    builder: Any = RecordBuilder()
    packed = (lz4.frame if compression == "lz4" else zstandard).compress(zeros)
    Chunk(compression, packed, 0, 0, 0, len(zeros)).write(builder)
    whole = bags()["drive.mcap"]
    header = 8 + 9 + int.from_bytes(whole[9:17], "little")
    return {"drive.mcap": whole[:header] + builder.end() + whole[header:]}


def _made(content: Callable[[], bytes], name: str = "drive.mcap") -> Callable[[], Files]:
    return lambda: {name: content()}


_ENDLESS = (
    "DROP TABLE messages; CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) "
    "SELECT 1 AS topic_id, i AS timestamp, x'00' AS data FROM n;"
)
_MORE = {
    "a view without end": _ENDLESS,
    "packed messages without end": "UPDATE messages SET data = zeroblob(50000000);",
    "no data": "UPDATE messages SET data = NULL;",
    "text for data": "UPDATE messages SET data = 'text';",
    "numbers for names": "UPDATE topics SET name = 7;",
    "a name of a megabyte": "UPDATE topics SET name = printf('%.1000000c', 'x');",
    "escape sequences in names": "UPDATE topics SET name = char(27) || '[2J', type = 'a' || char(10) || 'b';",
    "no topics": "DELETE FROM topics;",
}
BAGS: Hostile = {
    "zstd of 600 MB": lambda: _bomb("zstd"),
    "lz4 of 600 MB": lambda: _bomb("lz4"),
    "empty": one("drive.mcap", b""),
    "the magic alone": one("drive.mcap", b"\x89MCAP0\r\n"),
    "zeros behind the magic": one("drive.mcap", b"\x89MCAP0\r\n" + bytes(10**6)),
    "a pipe": one("drive.mcap", Pipe()),
    "a link to itself": one("drive.mcap", Link("drive.mcap")),
    "an endless device": one("drive.mcap", Link("/dev/zero")),
    "a device that is empty": one("drive.mcap", Link("/dev/null")),
    **{f"a scan's {field} of {value}": _made(lambda f=field, v=value: _mcap(_drive(twisted={f: v})))  # type: ignore[misc]
       for field in ("angle_min", "angle_increment", "range_min", "range_max")
       for value in _NUMBERS if abs(value) < 1e38 or not math.isfinite(value)},
    **{f"all ranges {value}": _made(lambda v=value: _mcap(_drive(np.full(90, v))))  # type: ignore[misc]
       for value in _NUMBERS if abs(value) < 1e38 or not math.isfinite(value)},
    "a scan of 100000 beams": _made(lambda: _mcap(_drive(np.ones(100_000)))),
    "a scan of no beams": _made(lambda: _mcap(_drive(np.ones(0)))),
    **{what: _made(lambda m=more: _db3(_drive(), more=m), "drive.db3") for what, more in _MORE.items()},  # type: ignore[misc]
}  # fmt: skip
