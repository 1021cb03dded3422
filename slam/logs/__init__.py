"""Recorded logs of real robots: one reader a format, all into one :class:`RecordedLog` (``docs/replay.md``)."""

from __future__ import annotations

import re
from pathlib import Path

from slam.logs import utias, victoria_park
from slam.logs.recorded import ObservationNoise, RecordedLog

__all__ = ["ObservationNoise", "RecordedLog", "open_log"]

_UTIAS_FILE = re.compile(r"Robot(\d+)_Odometry\.dat(?:\.gz)?")


def open_log(path: str | Path, *, robot: int | None = None) -> RecordedLog:
    """Read a log; its format is known by the names of its files.

    Parameters
    ----------
    path : path
        A UTIAS MRCLAM odometry file ``Robot1_Odometry.dat[.gz]`` or its folder; or Victoria Park's folder.
    robot : int, optional
        Which robot of a UTIAS folder; not needed where it has only one.

    Raises
    ------
    ValueError
        One line: the file (and line) that is missing or damaged, or what ``path`` should have been.
    """
    path = Path(path)
    if not path.exists():
        raise ValueError(f"log {path} does not exist; check the path")
    if path.is_dir():
        if any((path / f"steering.txt{end}").exists() for end in ("", ".gz")):
            _refuse_robot(robot, path)
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
        return utias.read(path, robot)
    match = _UTIAS_FILE.fullmatch(path.name)
    if match is None:
        raise ValueError(f"file {path} is no log that is known: {_KNOWN}")
    if robot is not None and robot != int(match[1]):
        raise ValueError(f"log {path} is robot {match[1]}'s, not robot {robot}'s; leave --robot out")
    return utias.read(path.parent, int(match[1]))


_KNOWN = (
    "give Robot1_Odometry.dat[.gz] or its folder (UTIAS), or the folder with steering.txt[.gz] (Victoria Park)"
)


def _refuse_robot(robot: int | None, path: Path) -> None:
    if robot is not None:
        raise ValueError(f"log {path} has one vehicle only; leave --robot out")
