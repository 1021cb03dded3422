"""Sound files, small ones: what is damaged, and what a reader has to take as it is."""

from __future__ import annotations

import gzip
import json
import math
import os
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mecanum_env.config import EnvConfig, to_toml
from slam.formats import write_map_server
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slam.landmarks.database import write_landmark_map

__all__ = [
    "Files", "Hostile", "Link", "Pipe", "Sound", "as_json", "carmen", "configs", "dpslam", "images", "landmarks",
    "one", "packed", "park", "policies", "put", "robotlaser", "ros_map", "utias",
]  # fmt: skip


@dataclass(frozen=True)
class Link:
    """A symbolic link."""

    to: str


@dataclass(frozen=True)
class Pipe:
    """A named pipe that nobody writes to."""


Files = Mapping[str, bytes | Link | Pipe]
"""Name within a folder → what is there; a name that ends with a slash is a folder."""

Sound = Mapping[str, bytes]
"""As :data:`Files`, but nothing that only harms."""

Hostile = Mapping[str, Callable[[], Files]]
"""What is wrong with them → files, made when they are wanted: some are large."""


def one(name: str, content: str | bytes | Link | Pipe) -> Callable[[], Files]:
    """Return what makes a single file."""
    data = content.encode() if isinstance(content, str) else content
    return lambda: {name: data}


def put(folder: Path, files: Files) -> None:
    """Write files into a folder."""
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if name.endswith("/"):
            path.mkdir()
        elif isinstance(content, Link):
            path.symlink_to(content.to)
        elif isinstance(content, Pipe):
            os.mkfifo(path)
        else:
            path.write_bytes(content)


def _written(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@cache
def ros_map() -> Sound:
    """Return a ROS map of a room."""
    classes = np.full((60, 80), UNKNOWN, np.int8)
    classes[5:-5, 5:-5], classes[10:-10, 10:-10] = OCCUPIED, FREE
    with tempfile.TemporaryDirectory() as folder:
        write_map_server(Path(folder) / "plan", OccupancyGrid.from_classes(classes, 0.1, (-2.0, -1.0)))
        return _written(Path(folder))


@cache
def images() -> Sound:
    """Return the picture of a room in every format that is read."""
    picture = np.zeros((60, 80), np.uint8)
    picture[5:-5, 5:-5] = 255
    picture[30:34, 20:50] = 0
    plain = b"P2\n80 60\n255\n" + b"\n".join(b" ".join(b"%d" % v for v in row) for row in picture.tolist())
    formats = (".png", ".pgm", ".jpg", ".bmp")
    return {f"plan{k}{suffix}": cv2.imencode(suffix, picture)[1].tobytes() for k, suffix in enumerate(formats)} | {
        "plan4.pgm": plain, "plan5.png": cv2.imencode(".png", picture.astype(np.uint16) * 257)[1].tobytes(),
    }  # fmt: skip


# ---- logs ------------------------------------------------------------------------------------------------------


def packed(data: bytes, level: int = 9) -> bytes:
    """Return gzip that is the same at any time: its header tells no hour."""
    return gzip.compress(data, level, mtime=0)


def _circle(n: int) -> NDArray[np.float64]:
    turned = 0.1 * np.arange(n)
    return np.column_stack([np.sin(turned), 1.0 - np.cos(turned), turned])


def _line(*values: float) -> str:
    return " ".join(f"{v:.6g}" if abs(v) < 1e5 else f"{v:.6f}" for v in values)


def _ranges(k: int) -> NDArray[np.float64]:
    return np.asarray(3.0 + np.sin(0.1 * np.arange(180) + 0.1 * k))


@cache
def carmen() -> Sound:
    """Return a CARMEN log."""
    lines = ["# message formats", "PARAM robot_frontlaser_offset 0.0 nohost 0"]
    for k, pose in enumerate(_circle(12)):
        stamp = 1.0e9 + 0.5 * k
        lines.append(f"ODOM {_line(*pose)} 0.2 0.2 0 {_line(stamp)} host {_line(stamp)}")
        scan = f"FLASER 180 {_line(*_ranges(k))} {_line(*pose)} {_line(*pose)}"
        lines.append(f"{scan} {_line(stamp)} host {_line(stamp)}")
    return {"log.clf": _text(lines)}


@cache
def robotlaser() -> Sound:
    """Return a CARMEN log of a later version."""
    lines = []
    for k, pose in enumerate(_circle(12)):
        laser = "ROBOTLASER1 0 -1.570796 3.141593 0.017453 20 0.01 0"
        at = f"{_line(*pose)} {_line(*pose)} 0.2 0.2 0 0 0"
        stamp = _line(1.0e9 + 0.5 * k)
        lines.append(f"{laser} 180 {_line(*_ranges(k))} 2 0.5 0.5 {at} {stamp} host {stamp}")
    return {"log.clf": _text(lines)}


@cache
def dpslam() -> Sound:
    """Return a DP-SLAM log."""
    pairs = [
        (f"Odometry {_line(*pose)}", f"Laser 181 {_line(*_ranges(k), 3.0)}") for k, pose in enumerate(_circle(12))
    ]
    return {"run.log": _text([line for pair in pairs for line in pair])}


def _text(lines: list[str]) -> bytes:
    return "".join(f"{line}\n" for line in lines).encode()


@cache
def utias() -> Sound:
    """Return the five files of a UTIAS log."""
    n, clock = 120, 1.2e9
    poses = _circle(n)
    stamps = (clock + 0.05 * np.arange(n)).tolist()
    subjects = {1: 5, 2: 14, 6: 63, 7: 81, 8: 7}
    seen = [(stamps[k], subjects[6 + k % 3], 2.0 + 0.1 * (k % 5), 0.1 * (k % 5)) for k in range(10, n, 5)]
    return {
        "Robot1_Odometry.dat": _text(["# time v w", *(_line(t, 0.1, 0.2) for t in stamps)]),
        "Robot1_Measurement.dat": _text([_line(*row) for row in seen]),
        "Robot1_Groundtruth.dat": _text([_line(t, *p) for t, p in zip(stamps, poses.tolist(), strict=True)]),
        "Landmark_Groundtruth.dat": _text([_line(6 + k, k, 3.0 - k, 1e-4, 1e-4) for k in range(3)]),
        "Barcodes.dat": _text([_line(*pair) for pair in subjects.items()]),
    }


@cache
def park() -> Sound:
    """Return the files of Victoria Park's log."""
    n, frames = 100, 12
    trees = np.zeros((frames, 18))
    trees[:, :2] = (9.0, 14.0)
    angles = np.full((frames, 18), 2.7e-8)
    angles[:, :2] = (1.2, 1.8)
    return {
        "time.txt": _text([_line(1e6 + 25.0 * k) for k in range(n)]),
        "speed.txt": _text(["2"] * n),
        "steering.txt": _text(["0.05"] * n),
        "lasersampling.txt": _text([_line(1e6 + 10.0 + 200.0 * k) for k in range(frames)]),
        "ObservationDistance.txt": _text([_line(*row) for row in trees]),
        "ObservationAngle.txt": _text([_line(*row) for row in angles]),
        "gps.txt": _text([_line(1e6 + 250.0 * k, 5.0 + 0.4 * k, -3.0 + 0.3 * k) for k in range(10)]),
    }


# ---- what the project itself wrote ------------------------------------------------------------------------------


@cache
def configs() -> Sound:
    """Return an environment's configuration, with the [run] table of an episode."""
    run = '\n[run]\nagent = "random"\nseed = 3\nmax_steps = 2\nstart = [2.0, 2.0, 0.0]\n'
    return {"config.toml": (to_toml(EnvConfig(rooms="rectangular")) + run).encode()}


@cache
def policies() -> Sound:
    """Return the policies of the package."""
    import agents

    return _written(Path(agents.__file__).parent / "policies")


@cache
def landmarks() -> Sound:
    """Return a cartographic database."""
    xy = _circle(9)[:, :2] * 4.0
    cov = np.tile(0.01 * np.eye(2), (9, 1, 1))
    with tempfile.TemporaryDirectory() as folder:
        write_landmark_map(
            Path(folder) / "landmarks.db", xy, cov=cov, joint_cov=0.01 * np.eye(18), kinds=np.ones(9, np.int8),
            angles=np.linspace(-math.pi, math.pi, 9), times_seen=np.arange(9), seen_by=[(0, 1)] * 9, backend="ekf",
        )  # fmt: skip
        return _written(Path(folder))


def as_json(values: object) -> bytes:
    """Return values as JSON."""
    return json.dumps(values, indent=1).encode()
