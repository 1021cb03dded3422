"""The logs of DP-SLAM (Eliazar and Parr): a pose by odometry, then a scan, a line each and no time stamps.

::

    Odometry x y theta
    Laser n r_1 … r_n

The beams of n = 181 stand 1° apart, the first at -90°.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.logs.laser import check_jumps, message_of, scan_of
from slam.logs.scans import ScanLog, scan_log
from slam.logs.tables import read_lines
from slam.types import Array

__all__ = ["NOMINAL_DT_S", "read"]

NOMINAL_DT_S = 0.5
"""Time between two scans that a log without time stamps is given. Only floors of the noise depend on it."""


def read(path: Path) -> ScanLog:
    """Read a DP-SLAM log, plain or gzip; lines of other kinds are passed over.

    Raises
    ------
    ValueError
        One line: the file and the line that is cut short or damaged or says what no robot does, or that there is
        no scan.
    """
    odometry, ranges = _pairs(path)
    times = np.arange(len(ranges), dtype=np.float64) * NOMINAL_DT_S
    note = f"no reference; without time stamps, taken to be {NOMINAL_DT_S} s from scan to scan"
    return scan_log(path, ranges, odometry, times=times, stamps=times, note=note)


def _pairs(path: Path) -> tuple[Array, Array]:
    """Return the odometry poses ``(n, 3)`` and ranges ``(n, beams)`` of a log."""
    poses: list[Array] = []
    ranges: list[Array] = []
    lines: list[int] = []
    pose: Array | None = None
    for number, line in read_lines(path):
        kind, words = (line.split() or [""])[0], line.split()[1:]
        if kind == "Odometry":
            if len(words) != 3:
                raise ValueError(f"{path}, line {number}: expected 3 values after Odometry (x y theta), got "
                                 f"{len(words)}; the line is cut short or damaged")  # fmt: skip
            pose = message_of(
                words, poses_at=(0,), stamp_at=None, path=path, line=number, what="Odometry x y theta"
            )
        elif kind == "Laser":
            if pose is None:
                raise ValueError(
                    f"{path}, line {number}: a Laser line without an Odometry line of its own before it"
                )
            ranges.append(scan_of(words, kind="Laser", after=0, earlier=ranges, path=path, line=number))
            lines.append(number)
            poses.append(pose)
            pose = None
    if not ranges:
        raise ValueError(f"{path} holds no Laser line; is it cut short?")
    check_jumps(np.stack(poses), path=path, lines=lines)
    return np.stack(poses), np.stack(ranges)
