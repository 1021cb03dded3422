"""CARMEN logs: laser scans and odometry as text, a message a line.

Montemerlo, Roy and Thrun, "Perspectives on standardization in mobile robot programming: the Carnegie Mellon
Navigation (CARMEN) toolkit", IROS 2003::

    ODOM x y theta tv rv accel time host logger_time
    FLASER n r_1 … r_n x y theta odom_x odom_y odom_theta time host logger_time
    ROBOTLASER1 type start_angle field_of_view angular_resolution maximum_range accuracy remission_mode
        n r_1 … r_n m remission_1 … remission_m x y theta robot_x robot_y robot_theta tv rv forward_safety
        side_safety turn_axis time host logger_time

Of FLASER the number n tells where beams stand (:func:`slam.logs.scans.beam_angles`). ROBOTLASER1 is what later
versions write; the earliest of them know of no remissions and no turn axis.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slam.geometry import relative, wrap
from slam.logs.laser import check_jumps, message_of, scan_of
from slam.logs.scans import Beams, ScanLog, chain, moved_by, rising, scan_log
from slam.logs.tables import numbers_of, read_lines
from slam.types import Array

__all__ = ["read", "read_poses"]

_ODOM = "ODOM x y theta tv rv accel time host logger_time"
_AFTER_FLASER = 9  # words after the ranges
_AFTER_ROBOTLASER = 13  # the same, but for remissions and turn axis
_OF_LASER = 7  # words before the ranges' number
_WIDEST_RAD = 2.01 * math.pi
# A laser mounted off the robot's centre stays where it is, but for the last of two decimals; a corrected pose
# wanders off the odometry.
_MOUNT_VARIES, _MOUNT_REACHES_M = 2e-2, 1.0


def read(path: Path) -> ScanLog:
    """Read a CARMEN log, plain or gzip: one event a FLASER line, or a ROBOTLASER1 line where there are none.

    Lines of other kinds are passed over. Odometry at a scan is the ODOM line right before it where that has the
    scan's own time stamp, else the robot's pose of the scan's line. In a log of raw odometry it is the same; in
    one that GMapping's gfs2log has corrected, FLASER has the corrected pose, from which the ODOM lines go on by
    the raw odometry, so that the motion from scan to scan is still there, exactly. Stamps out of order are put
    between their neighbours (:func:`slam.logs.scans.rising`).

    Raises
    ------
    ValueError
        One line: the file and the line that is cut short or damaged or says what no robot does, or that there is
        no scan.
    """
    found = _scans(path)
    poses, odometry, stamps = np.stack(found.poses), np.stack(found.odometry), np.array(found.stamps)
    robot = poses[:, 3:]  # by the scan's line
    travelled = chain(odometry[0], relative(robot[:-1], odometry[1:]))
    mount = relative(robot, poses[:, :3])
    offset = mount[0] + np.median(_turned_less(mount, mount[0]), axis=0)
    if (
        np.abs(_turned_less(mount, offset)).max() < _MOUNT_VARIES
        and math.hypot(offset[0], offset[1]) < _MOUNT_REACHES_M
    ):
        travelled = moved_by(travelled, offset)
    note = "no reference; give one with --reference"
    return scan_log(
        path, np.stack(found.ranges), travelled, times=rising(stamps), stamps=stamps, note=note, beams=found.beams
    )


def _turned_less(poses: Array, pose: Array) -> Array:
    """Return by how much poses ``(n, 3)`` differ from one ``(3,)``, in headings the short way round."""
    less = poses - pose
    less[:, 2] = wrap(less[:, 2])
    return less


def read_poses(path: Path) -> tuple[Array, Array]:
    """Return the time stamps ``(n,)`` [s] and laser poses ``(n, 3)`` of a log's scans, as they stand there.

    Raises ``ValueError`` as :func:`read` does.
    """
    found = _scans(path)
    return np.array(found.stamps), np.stack(found.poses)[:, :3]


@dataclass
class _Scans:
    """What the scans of one kind of line say, scan by scan."""

    ranges: list[Array] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)  # x y θ of the laser, then of the robot
    odometry: list[Array] = field(default_factory=list)  # x y θ there
    stamps: list[float] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)
    beams: Beams | None = None  # where the line tells


def _scans(path: Path) -> _Scans:
    """Return a log's scans, at least one."""
    kinds = {"FLASER": _Scans(), "ROBOTLASER1": _Scans()}
    before: Array | None = None  # x y θ tv rv accel time of the ODOM line right before
    for number, line in read_lines(path):
        kind = "".join(line[:12].split(maxsplit=1)[:1])  # most lines are of a kind that is passed over
        if kind == "ODOM":
            before = _odom(line.split()[1:], path, number)
        elif kind in kinds:
            words, found = line.split()[1:], kinds[kind]
            remissions, after = 0, _AFTER_FLASER
            if kind == "ROBOTLASER1":
                found.beams = _beams(words[:_OF_LASER], found.beams, path, number)
                words = words[_OF_LASER:]
                remissions, after = _after_ranges(words)
            scan = scan_of(
                words, kind=kind, after=remissions + after, earlier=found.ranges, path=path, line=number
            )
            told = words[1 + len(scan) + remissions :]
            at = message_of(
                [*told[:6], told[-3]], poses_at=(0, 3), stamp_at=6, path=path, line=number,
                what=f"pose or time of {kind}",
            )  # fmt: skip
            same = before is not None and before[6] == at[6]
            found.ranges.append(scan)
            found.poses.append(at[:6])
            found.odometry.append(before[:3] if same and before is not None else at[3:6])
            found.stamps.append(float(at[6]))
            found.lines.append(number)
    found = next((found for found in kinds.values() if found.ranges), _Scans())
    if not found.ranges:
        raise ValueError(f"{path} holds neither FLASER nor ROBOTLASER1 lines, the scans of a CARMEN log")
    both = np.stack(found.poses)
    for each in (both[:, :3], both[:, 3:], np.stack(found.odometry)):
        check_jumps(each, path=path, lines=found.lines)
    return found


def _odom(words: Sequence[str], path: Path, number: int) -> Array:
    if len(words) != 9:
        raise ValueError(f"{path}, line {number}: expected 9 values after ODOM ({_ODOM}), got {len(words)}; "
                         "the line is cut short or damaged")  # fmt: skip
    return message_of(words[:7], poses_at=(0,), stamp_at=6, path=path, line=number, what=_ODOM)


def _beams(words: Sequence[str], earlier: Beams | None, path: Path, number: int) -> Beams:
    """Return where beams stand, and how far the laser measures, by the first words of a ROBOTLASER1 line."""
    where = f"{path}, line {number}"
    values = numbers_of(words, path=path, line=number, what="the laser of ROBOTLASER1")
    if len(values) < _OF_LASER:
        raise ValueError(f"{where}: the line is cut short; correct it")
    first, view, step, farthest = values[1:5].tolist()
    if not (abs(first) <= _WIDEST_RAD and 0.0 < step <= view <= _WIDEST_RAD and farthest > 0.0):
        raise ValueError(
            f"{where}: a laser from {first:g} rad on, {step:g} rad between beams, {view:g} rad wide, as far as "
            f"{farthest:g} m is none; correct the line"
        )
    beams = Beams(first, step, farthest)
    if earlier not in (None, beams):
        raise ValueError(f"{where}: a scan whose beams stand otherwise than before; give a log of one laser")
    return beams


def _after_ranges(words: Sequence[str]) -> tuple[int, int]:
    """Return how many words after a ROBOTLASER1's ranges are of remissions, and how many come then."""
    beams = _count(words[0]) if words else 0
    after = words[1 + beams :]
    if len(after) <= _AFTER_ROBOTLASER:
        return 0, _AFTER_ROBOTLASER
    remissions = 1 + _count(after[0])
    axis = len(after) > remissions + _AFTER_ROBOTLASER
    return remissions, _AFTER_ROBOTLASER + axis


def _count(word: str) -> int:
    return int(word[:6]) if word.isascii() and word.isdigit() else 0
