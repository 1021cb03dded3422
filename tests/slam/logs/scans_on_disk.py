"""Small logs of laser scans as files: a robot drives a circle in a bare room, its wheels slipping a little."""

from __future__ import annotations

import gzip
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slam.geometry import compose, exp, inverse

WIDTH, HEIGHT = 7.0, 5.0
CLOCK = 500.0  # [s] at the first scan
SECONDS = 0.5  # from scan to scan


def room_ranges(pose: np.ndarray, beams: int) -> np.ndarray:
    """Return the ranges of a half-circle laser, beams 1° apart from -90° on, in the room about the origin [m]."""
    angles = pose[2] + np.radians(np.arange(beams) - 90.0)
    c, s = (np.where(np.abs(v) < 1e-12, 1e-12, v) for v in (np.cos(angles), np.sin(angles)))
    along_x = (np.sign(c) * WIDTH / 2 - pose[0]) / c
    along_y = (np.sign(s) * HEIGHT / 2 - pose[1]) / s
    return np.minimum(along_x, along_y)


def drive(scans: int) -> tuple[np.ndarray, np.ndarray]:
    """Return true poses and those by odometry ``(scans, 3)``: a circle, and one that turns 2 % too far."""
    true, reckoned = [np.array([0.0, -1.0, 0.0])], [np.array([4.0, 2.0, 1.0])]
    for _ in range(scans - 1):
        true.append(compose(true[-1], exp(np.array([0.1, 0.0, 0.1]))))
        reckoned.append(compose(reckoned[-1], exp(np.array([0.1, 0.0, 0.102]))))
    return np.array(true), np.array(reckoned)


def words(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(format(v, ".10g") for v in values)


def flaser(ranges: np.ndarray, laser: np.ndarray, robot: np.ndarray, stamp: float) -> str:
    at = f"{words(laser)} {words(robot)} {stamp:.6f} host {stamp:.6f}"
    return f"FLASER {len(ranges)} {words(ranges)} {at}"


def odom(pose: np.ndarray, stamp: float) -> str:
    return f"ODOM {words(pose)} 0.2 0.2 0 {stamp:.6f} host {stamp:.6f}"


def carmen_lines(scans: int = 40, *, beams: int = 180, kind: str = "raw") -> list[str]:
    """Return a CARMEN log's lines.

    ``kind``: ``raw``; ``corrected``, true poses in FLASER; or ``gfs2log``, true poses in FLASER, from which ODOM
    lines go on by the odometry, and the particle filter's own lines.
    """
    true, reckoned = drive(scans)
    lines = ["# message formats defined: PARAM SYNC ODOM FLASER", "PARAM robot_frontlaser_offset 0.0 nohost 0"]
    frame = np.zeros(3)  # that the odometry is written in, as seen from its own
    for i in range(scans):
        stamp = CLOCK + SECONDS * i
        before = reckoned[max(i - 1, 0)]
        half = compose(before, exp(0.5 * np.array([0.1, 0.0, 0.102]) * (i > 0)))
        pose = reckoned[i] if kind == "raw" else true[i]
        for at, time in ((half, stamp - 0.5 * SECONDS), (reckoned[i], stamp)):
            lines.append(odom(compose(frame, at), time))
        lines.append(flaser(room_ranges(true[i], beams), pose, pose, stamp))
        if kind == "gfs2log":
            frame = compose(true[i], inverse(reckoned[i]))
            lines += [odom(true[i], 0.0), "NEFF 15"]
    return lines


def dpslam_lines(scans: int = 40) -> list[str]:
    true, reckoned = drive(scans)
    pairs = [(f"Odometry {words(reckoned[i])} ", f"Laser 181 {words(room_ranges(true[i], 181))} ") for i in
             range(scans)]  # fmt: skip
    return [line for pair in pairs for line in pair]


def put_lines(path: Path, lines: Sequence[str], *, packed: bool = False) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    text = "".join(f"{line}\n" for line in lines).encode()
    path.write_bytes(gzip.compress(text) if packed else text)
    return path
