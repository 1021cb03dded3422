"""Recorded logs of real robots: one reader a format (``docs/how-to/replay.md``).

``utias`` and ``victoria_park`` are logs of landmark observations and become a ``recorded`` log, ``carmen``,
``dpslam`` and ``ros_bag`` are logs of ``laser`` scans and become ``scans``; ``log`` is what both are, ``tables``
reads numbers.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from slam.files import ROS1_BAG, ROS1_REMEDY, is_bag
from slam.logs import carmen, dpslam, ros_bag, utias, victoria_park
from slam.logs.log import Event
from slam.logs.recorded import ObservationNoise, RecordedLog
from slam.logs.ros_bag import BagTopics, parse_mount
from slam.logs.scans import ScanLog, beside
from slam.logs.tables import read_lines
from slam.types import Indices

__all__ = [
    "AnyLog", "BagTopics", "Event", "ObservationNoise", "RecordedLog", "ScanLog", "open_log", "parse_mount",
    "with_reference",
]  # fmt: skip

AnyLog = RecordedLog | ScanLog

Rows = Indices

_UTIAS_FILE = re.compile(r"Robot(\d+)_Odometry\.dat(?:\.gz)?")


# By the first word of a line; CARMEN has more, which are not read.
_CARMEN_WORDS = ("ODOM", "FLASER", "RLASER", "PARAM", "SYNC", "TRUEPOS", "ROBOTLASER1", "NEFF")
_READERS = dict.fromkeys(_CARMEN_WORDS, carmen.read) | dict.fromkeys(("Odometry", "Laser"), dpslam.read)
_LINES_TO_KNOW_BY = 10_000


def open_log(
    path: str | Path, *, robot: int | None = None, raw: bool = False, topics: BagTopics | None = None
) -> AnyLog:
    """Read a log; its format is known by the names of its files, that of one with scans by its lines.

    Parameters
    ----------
    path : path
        A UTIAS MRCLAM odometry file ``Robot1_Odometry.dat[.gz]`` or its folder; Victoria Park's folder; a ROS 2
        bag, its folder or a file ``.mcap`` or ``.db3``; or a CARMEN or DP-SLAM log, plain or gzip, whatever its
        name.
    robot : int, optional
        Which robot of a UTIAS folder; not needed where it has only one.
    raw : bool
        Of a UTIAS log: ranges, stamps and commands as recorded, not as calibrated (:mod:`slam.logs.utias`).
    topics : BagTopics, optional
        Of a bag: which topics, and where the lidar sits.

    Raises
    ------
    ValueError
        One line: the file (and line) that is missing or damaged, or what ``path`` should have been.
    """
    path = Path(path)
    if not path.exists():
        raise ValueError(f"log {path} does not exist; check the path")
    if is_bag(path):
        _refuse(robot, raw, path)
        return ros_bag.read(path, topics or BagTopics())
    if topics is not None:
        raise ValueError(f"log {path} is no ROS 2 bag; leave --scan-topic, --odom-topic, --reference-topic and "
                         "--mount out")  # fmt: skip
    if path.is_dir():
        if any((path / f"steering.txt{end}").exists() for end in ("", ".gz")):
            _refuse(robot, raw, path)
            return victoria_park.read(path)
        matches = [m for p in sorted(path.iterdir()) if (m := _UTIAS_FILE.fullmatch(p.name))]
        found = sorted({int(m[1]) for m in matches})
        if not found:
            raise ValueError(f"folder {path} holds no log that is known: {_KNOWN}")
        if robot is None and len(found) == 1:
            robot = found[0]
        if robot not in found:
            given = "no robot was chosen" if robot is None else f"there is no robot {robot}"
            raise ValueError(f"folder {path}: {given}; give --robot {' or '.join(map(str, found))}")
        return utias.read(path, robot, raw=raw)
    match = _UTIAS_FILE.fullmatch(path.name)
    if match is None:
        _refuse(robot, raw, path)
        if (read := _reader_of(path)) is None:
            raise ValueError(f"file {path} is no log that is known: {_KNOWN}")
        return read(path)
    if robot is not None and robot != int(match[1]):
        raise ValueError(f"log {path} is robot {match[1]}'s, not robot {robot}'s; leave --robot out")
    return utias.read(path.parent, int(match[1]), raw=raw)


def with_reference(log: AnyLog, path: str | Path) -> ScanLog:
    """Return a log of scans with the reference that another log of the same scans holds.

    Parameters
    ----------
    log : ScanLog
        What is replayed.
    path : path
        A CARMEN log, whose FLASER poses are taken; beside a bag they are of the robot's frame. Scans are matched
        by their time stamps, equal ones in order. Or a DP-SLAM log of as many scans, which are matched by their
        number.

    Raises
    ------
    ValueError
        One line: where the log has a reference of its own, the file is damaged or holds none of the scans.
    """
    path = Path(path)
    if not isinstance(log, ScanLog):
        raise ValueError(f"log {log.name} has its own reference; leave --reference out")
    if not path.is_file():
        raise ValueError(f"reference {path} is no file; give a log of the same scans with corrected poses")
    read = _reader_of(path)
    if read is None:
        raise ValueError(f"reference {path} is no log that is known: give a CARMEN or DP-SLAM log")
    note = f"reference: poses of {path.name} at the same scans; the start pose is the reference's"
    if read is dpslam.read:
        poses = read(path).odometry_poses
        if len(poses) != len(log.times):
            counts = f"{len(poses)} scans, {log.name} {len(log.times)}"
            raise ValueError(f"reference {path} has {counts}; give a log of the same scans")
        return log.with_reference(np.arange(len(poses)), poses, note)
    stamps, poses = carmen.read_poses(path)
    scans, matched = _with_equal_stamps(log.stamps.tolist(), stamps.tolist())
    if not len(scans):
        raise ValueError(
            f"reference {path} has no scan at a time stamp of {log.name}'s; give a log of the same scans"
        )
    return log.with_reference(scans, beside(poses[matched], log.beside_m), note)


_KNOWN = (
    "give Robot1_Odometry.dat[.gz] or its folder (UTIAS), the folder with steering.txt[.gz] (Victoria Park), a "
    "ROS 2 bag's folder, .mcap or .db3, or a file with FLASER or ROBOTLASER1 lines (CARMEN) or Odometry and Laser "
    "lines (DP-SLAM)"
)


def _with_equal_stamps(stamps: list[float], of_reference: list[float]) -> tuple[Rows, Rows]:
    """Return the rows of one list and those of the other with the same stamp to 0.1 ms, equal ones in order."""
    rows_of: dict[int, list[int]] = {}
    for row in reversed(range(len(of_reference))):  # taken from the end: the first of equal stamps first
        rows_of.setdefault(round(of_reference[row] * 1e4), []).append(row)
    pairs: list[tuple[int, int]] = []
    for i, stamp in enumerate(stamps):
        if rows := rows_of.get(round(stamp * 1e4)):
            pairs.append((i, rows.pop()))
    mine, others = np.array(pairs, np.int64).reshape(-1, 2).T
    return mine, others


def _reader_of(path: Path) -> Callable[[Path], ScanLog] | None:
    """Return what reads a log of scans; ``None`` where no line at its beginning is either format's."""
    for number, line in read_lines(path):
        if number == 1 and line.startswith(ROS1_BAG):
            raise ValueError(f"{path} is a bag of ROS 1; {ROS1_REMEDY}")
        word = "".join(line[:20].split(maxsplit=1)[:1])
        if word in _READERS or number >= _LINES_TO_KNOW_BY:
            return _READERS.get(word)
    return None


def _refuse(robot: int | None, raw: bool, path: Path) -> None:
    if robot is not None:
        raise ValueError(f"log {path} has one vehicle only; leave --robot out")
    if raw:
        raise ValueError(f"log {path} is handed on as recorded in any case; leave raw out")
