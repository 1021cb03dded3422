"""ROS 2 bags, MCAP or SQLite: their messages as bytes, read with distrust.

The libraries that read these formats unpack whatever they are given, and open whatever lies there; here nothing
unpacks to more than a bound, and nothing but regular files is opened. ``metadata.yaml`` repeats what the files
say, and is not read.
"""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from slam.files.databases import check_tables, open_database, trust
from slam.files.names import quoted, shown_path
from slam.files.reading import check_file

__all__ = ["ROS1_BAG", "ROS1_REMEDY", "BagMessage", "bag_messages", "is_bag"]

ROS1_BAG = "#ROSBAG V"
"""How a bag of ROS 1 begins."""
ROS1_REMEDY = "make it one of ROS 2 by rosbags-convert --src FILE.bag --dst FOLDER (pip install rosbags)"

_MIB = 2**20
_LARGEST = 256 * _MIB  # of a record; a scan has some kilobytes, a picture some megabytes
# Scans pack to a third or less: what unpacks to many times more is a bomb.
_MOST_PACKED, _FREE_UNPACKED, _FREE_MESSAGE = 50, 8 * _MIB, 2**16
_ZSTD = b"\x28\xb5\x2f\xfd"  # where the recorder packed each message; CDR begins with 0
_SUFFIXES = (".mcap", ".db3")
_NUMBER = re.compile(r"(\d+)")


class BagMessage(NamedTuple):
    """A message as it was recorded."""

    topic: str
    datatype: str  # as "sensor_msgs/msg/LaserScan"
    data: bytes  # CDR


def is_bag(path: Path) -> bool:
    """Tell whether a path is a ROS 2 bag by its name: a file of one, or a folder with such files."""
    if path.is_dir():
        return bool(_files(path) or list(path.glob("*.zstd")))
    return path.suffix.lower() in _SUFFIXES or _packed_whole(path)


def bag_messages(path: Path, datatypes: Collection[str], topics: dict[str, str]) -> Iterator[BagMessage]:
    """Yield the messages of some types, file by file, in the order in which they lie there.

    Parameters
    ----------
    path
        A folder of ``ros2 bag record``, or one of its files.
    datatypes
        Which types to hand out.
    topics
        Filled on the way: every topic that is met, and its type.

    Raises
    ------
    ValueError
        One line: a file is missing, damaged, packed in a way that is not read, or unpacks to more than any log;
        or a package is missing.
    """
    files = _files(path) if path.is_dir() else [path]
    if not files or (path.is_dir() and any(path.glob("*.zstd"))):
        raise ValueError(f"bag {shown_path(path)} is packed file by file; unpack it by zstd -d {path}/*.zstd, and "
                         "take the packed files away")  # fmt: skip
    for file in files:
        check_file(file, what="bag")
        if _packed_whole(file):
            raise ValueError(f"bag {shown_path(file)} is packed; unpack it by zstd -d {shown_path(file)}")
        read = _of_mcap if file.suffix.lower() == ".mcap" else _of_sqlite
        try:
            yield from read(file, datatypes, topics)
        except _Refused as error:
            raise ValueError(f"bag {shown_path(file)} {error}") from error
        except ModuleNotFoundError as error:
            raise ValueError(
                f"bag {shown_path(file)}: reading it needs {error.name}; pip install 'mecanum-slam[ros]'"
            ) from error
        # Whatever the libraries stumble over: they name no common error.
        except Exception as error:
            raise ValueError(f"bag {shown_path(file)} is damaged: {_words(error)}; mend it, for instance by "
                             "mcap recover or ros2 bag reindex") from error  # fmt: skip


class _Refused(Exception):
    """What is no damage, and yet not read."""


def _files(folder: Path) -> list[Path]:
    """Return a bag's files in the order in which they were recorded: they are numbered, without zeros in front."""
    found = [path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES]
    # Words and numbers by turns, so that like is compared with like.
    return sorted(found, key=lambda path: [int(w) if k % 2 else w for k, w in enumerate(_NUMBER.split(path.name))])


def _packed_whole(path: Path) -> bool:
    return path.suffix.lower() in (".zstd", ".zst") and Path(path.stem).suffix.lower() in _SUFFIXES


def _words(error: Exception) -> str:
    text = f"{type(error).__name__} {error}" if str(error) else type(error).__name__
    return quoted(text, 150)[1:-1]


def _of_mcap(path: Path, datatypes: Collection[str], topics: dict[str, str]) -> Iterator[BagMessage]:
    from mcap.records import Channel, Chunk, Message, Schema
    from mcap.stream_reader import StreamReader, breakup_chunk

    left = _FREE_UNPACKED + _MOST_PACKED * path.stat().st_size
    schemas: dict[int, str] = {0: ""}
    channels: dict[int, tuple[str, str, str]] = {}
    with open(path, "rb") as file:
        for outer in StreamReader(file, emit_chunks=True, record_size_limit=_LARGEST).records:
            records: list[Any] = [outer]
            if isinstance(outer, Chunk):
                data = _unpacked(outer.data, outer.compression, min(outer.uncompressed_size, left, _LARGEST))
                left -= len(data)
                records = breakup_chunk(replace(outer, compression="", data=data), validate_crc=True)
            for record in records:
                if isinstance(record, Schema):
                    schemas[record.id] = record.name
                elif isinstance(record, Channel):
                    if record.message_encoding == "ros1":
                        raise _Refused(f"is of ROS 1; take the bag that it was made from, and {ROS1_REMEDY}")
                    channels[record.id] = record.topic, schemas[record.schema_id], record.message_encoding
                    topics[record.topic] = schemas[record.schema_id]
                elif isinstance(record, Message):
                    topic, datatype, encoding = channels[record.channel_id]
                    if datatype in datatypes:
                        yield BagMessage(topic, datatype, _cdr(record.data, encoding))


def _of_sqlite(path: Path, datatypes: Collection[str], topics: dict[str, str]) -> Iterator[BagMessage]:
    with open_database(path) as database:
        check_tables(database, ("messages", "topics"))
        trust(database)
        rows = database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        if not all(isinstance(word, str) for row in rows for word in row[1:]):
            raise sqlite3.DatabaseError("a topic has no name or type")
        topics |= {name: datatype for _, name, datatype, _ in rows}
        wanted = {number: row for number, *row in rows if row[1] in datatypes}
        marks = ",".join("?" * len(wanted))
        found = database.execute(f"SELECT topic_id, data FROM messages WHERE topic_id IN ({marks})", list(wanted))
        for number, data in found:
            topic, datatype, encoding = wanted[number]
            yield BagMessage(topic, datatype, _cdr(data, encoding))


def _cdr(data: bytes, encoding: str) -> bytes:
    """Return a message, unpacked where it was packed."""
    if encoding != "cdr":
        raise _Refused(f"holds messages as {quoted(encoding)}, not as cdr; record it by ros2 bag")
    return _unpacked(data, "zstd", _FREE_MESSAGE + _MOST_PACKED * len(data)) if data[:4] == _ZSTD else data


def _unpacked(data: bytes, compression: str, limit: int) -> bytes:
    """Return what was packed; :class:`_Refused` where that is more than ``limit`` bytes."""
    out: bytes = data
    if compression == "zstd":
        import zstandard

        out = zstandard.ZstdDecompressor().stream_reader(data).read(limit + 1)
    elif compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor

        out = LZ4FrameDecompressor().decompress(data, max_length=limit + 1)
    elif compression:
        raise _Refused(f"is packed by {quoted(compression)}; pack it by zstd or lz4")
    if len(out) > limit:
        raise _Refused("unpacks to more than any log of a robot; it is no such bag")
    return out
