"""CARMEN logs: laser scans and odometry as text, a message a line.

Montemerlo, Roy and Thrun, "Perspectives on standardization in mobile robot programming: the Carnegie Mellon
Navigation (CARMEN) toolkit", IROS 2003::

    ODOM x y theta tv rv accel time host logger_time
    FLASER n r_1 … r_n x y theta odom_x odom_y odom_theta time host logger_time

The number n tells where beams stand (:func:`slam.logs.scans.beam_angles`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slam.geometry import relative, wrap
from slam.logs.laser import check_jumps, message_of, scan_of
from slam.logs.scans import ScanLog, chain, moved_by, rising, scan_log
from slam.logs.tables import read_lines
from slam.types import Array

__all__ = ["read", "read_poses"]

_ODOM = "ODOM x y theta tv rv accel time host logger_time"
_AFTER_RANGES = 9  # words
# A laser mounted off the robot's centre stays where it is, but for the last of two decimals; a corrected pose
# wanders off the odometry.
_MOUNT_VARIES, _MOUNT_REACHES_M = 2e-2, 1.0


def read(path: Path) -> ScanLog:
    """Read a CARMEN log, plain or gzip: one event a FLASER line; lines of other kinds are passed over.

    Odometry at a scan is the ODOM line right before it where that has the scan's own time stamp, else the pose of
    the FLASER line. In a log of raw odometry it is the same; in one that GMapping's gfs2log has corrected, FLASER
    has the corrected pose, from which the ODOM lines go on by the raw odometry, so that the motion from scan to
    scan is still there, exactly. Stamps out of order are put between their neighbours
    (:func:`slam.logs.scans.rising`).

    Raises
    ------
    ValueError
        One line: the file and the line that is cut short or damaged or says what no robot does, or that there is
        no scan.
    """
    ranges, poses, odometry, stamps = _scans(path)
    robot = poses[:, 3:6]  # FLASER's odometry
    travelled = chain(odometry[0], relative(robot[:-1], odometry[1:]))
    mount = relative(robot, poses[:, :3])
    offset = mount[0] + np.median(_turned_less(mount, mount[0]), axis=0)
    if (
        np.abs(_turned_less(mount, offset)).max() < _MOUNT_VARIES
        and math.hypot(offset[0], offset[1]) < _MOUNT_REACHES_M
    ):
        travelled = moved_by(travelled, offset)
    note = "no reference; give one with --reference"
    return scan_log(path, ranges, travelled, times=rising(stamps), stamps=stamps, note=note)


def _turned_less(poses: Array, pose: Array) -> Array:
    """Return by how much poses ``(n, 3)`` differ from one ``(3,)``, in headings the short way round."""
    less = poses - pose
    less[:, 2] = wrap(less[:, 2])
    return less


def read_poses(path: Path) -> tuple[Array, Array]:
    """Return the time stamps ``(n,)`` [s] and laser poses ``(n, 3)`` of a log's FLASER lines, as they stand there.

    Raises ``ValueError`` as :func:`read` does.
    """
    _, poses, _, stamps = _scans(path)
    return stamps, poses[:, :3].copy()


def _scans(path: Path) -> tuple[Array, Array, Array, Array]:
    """Return ranges (n, beams), FLASER's two poses (n, 6), odometry there (n, 3) and time stamps (n,)."""
    ranges: list[Array] = []
    poses: list[Array] = []
    odometry: list[Array] = []
    stamps: list[float] = []
    lines: list[int] = []
    before: Array | None = None  # x y θ tv rv accel time of the ODOM line right before
    for number, line in read_lines(path):
        kind = line[:7].split(maxsplit=1)[:1]  # most lines are of a kind that is passed over
        if kind == ["ODOM"]:
            before = _odom(line.split()[1:], path, number)
        elif kind == ["FLASER"]:
            words = line.split()[1:]
            scan = scan_of(words, kind="FLASER", after=_AFTER_RANGES, earlier=ranges, path=path, line=number)
            at = message_of(
                words[1 + len(scan) : 8 + len(scan)], poses_at=(0, 3), stamp_at=6, path=path, line=number,
                what="pose or time of FLASER",
            )  # fmt: skip
            same = before is not None and before[6] == at[6]
            ranges.append(scan)
            poses.append(at[:6])
            odometry.append(before[:3] if same and before is not None else at[3:6])
            stamps.append(float(at[6]))
            lines.append(number)
    if not ranges:
        raise ValueError(f"{path} holds no FLASER line, the only scans of a CARMEN log that are read")
    both, reckoned = np.stack(poses), np.stack(odometry)
    for each in (both[:, :3], both[:, 3:], reckoned):
        check_jumps(each, path=path, lines=lines)
    return np.stack(ranges), both, reckoned, np.array(stamps)


def _odom(words: Sequence[str], path: Path, number: int) -> Array:
    if len(words) != 9:
        raise ValueError(f"{path}, line {number}: expected 9 values after ODOM ({_ODOM}), got {len(words)}; "
                         "the line is cut short or damaged")  # fmt: skip
    return message_of(words[:7], poses_at=(0,), stamp_at=6, path=path, line=number, what=_ODOM)
