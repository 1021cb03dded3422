"""Files in and out: atomic writing, ROS map_server maps and TUM trajectories.

Whatever the project writes goes to a temporary name first and is then renamed (:func:`replacing`): a reader
sees the old file or the new one, never half of one, and a failed run leaves nothing behind.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import ArrayLike

from slam.geometry import wrap
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

__all__ = ["atomic_write", "replacing", "write_map_server", "write_tum"]

# The grey values that ROS map_saver gives the cell classes.
_GREY = {UNKNOWN: 205, FREE: 254, OCCUPIED: 0}
_OCCUPIED_THRESHOLD, _FREE_THRESHOLD = 0.65, 0.196


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside ``path``; rename it to ``path`` on success, remove it on failure.

    The temporary name keeps the suffix, from which encoders know the format. The file is not created here.

    Raises
    ------
    FileNotFoundError
        At once, where the folder does not exist.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: no folder {path.parent}; create it first")
    # Not tempfile.mkstemp: its files are readable by their owner alone, and stay so when renamed.
    # A name may be 255 bytes long; of a long one the temporary one has but the beginning.
    beginning, suffix = path.stem[:40], path.suffix[-20:]
    temporary = path.with_name(f".{beginning}.{os.getpid()}-{secrets.token_hex(4)}{suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def atomic_write(path: str | Path, data: bytes | str) -> None:
    """Write a whole file, text as UTF-8 with the line ends given, through :func:`replacing`."""
    with replacing(path) as temporary:
        temporary.write_bytes(data.encode() if isinstance(data, str) else data)


def write_map_server(stem: str | Path, grid: OccupancyGrid) -> tuple[Path, Path]:
    """Write a grid as a ROS map_server map, ``STEM.pgm`` and ``STEM.yaml``, and return the two paths.

    Occupied cells are 0, unknown 205, free 254; the image's first row is the highest y. The image is written
    first, so that a description never names an image that is not there.
    """
    stem = Path(stem)
    image, description = stem.with_name(f"{stem.name}.pgm"), stem.with_name(f"{stem.name}.yaml")
    classes = grid.classes()
    pixels = np.full(classes.shape, _GREY[UNKNOWN], np.uint8)
    for value in (FREE, OCCUPIED):
        pixels[classes == value] = _GREY[value]
    rows, cols = grid.shape
    atomic_write(image, b"P5\n%d %d\n255\n" % (cols, rows) + pixels[::-1].tobytes())
    values = {
        "image": image.name,
        "mode": "trinary",
        "resolution": float(grid.resolution),
        "origin": [float(grid.origin[0]), float(grid.origin[1]), 0.0],
        "negate": 0,
        "occupied_thresh": _OCCUPIED_THRESHOLD,
        "free_thresh": _FREE_THRESHOLD,
    }
    atomic_write(description, yaml.safe_dump(values, sort_keys=False, default_flow_style=None))
    return image, description


def write_tum(path: str | Path, times: ArrayLike, poses: ArrayLike) -> None:
    """Write a planar trajectory in the TUM format: ``t tx ty tz qx qy qz qw`` a line, single spaces.

    Parameters
    ----------
    path : path
        The file to write.
    times : (n,) array_like
        Seconds, written with 6 decimals.
    poses : (n, 3) array_like
        x [m], y [m], heading [rad], written with 9 decimals (the quaternion with 12).
    """
    t, p = np.asarray(times, np.float64), np.asarray(poses, np.float64)
    if t.ndim != 1 or p.shape != (len(t), 3):
        raise ValueError(f"a trajectory is times (n,) and poses (n, 3), got {t.shape} and {p.shape}")
    if not (np.isfinite(t).all() and np.isfinite(p).all()):
        raise ValueError(f"trajectory for {path} holds values that are not finite")
    half = 0.5 * wrap(p[:, 2])
    rows = zip(t.tolist(), p[:, 0].tolist(), p[:, 1].tolist(), np.sin(half), np.cos(half), strict=True)
    atomic_write(
        path,
        "".join(f"{s:.6f} {x:.9f} {y:.9f} 0 0 0 {qz:.12f} {qw:.12f}\n" for s, x, y, qz, qw in rows),
    )
