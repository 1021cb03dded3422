"""Files in and out: atomic writing, ROS map_server maps and TUM trajectories.

Whatever the project writes goes to a temporary name first and is then renamed (:func:`replacing`): a reader
sees the old file or the new one, never half of one, and a failed run leaves nothing behind.
"""

from __future__ import annotations

import math
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray

from slam.geometry import wrap
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

__all__ = ["atomic_write", "read_map_server", "read_tum", "replacing", "write_map_server", "write_tum"]

Array = NDArray[np.float64]

# The grey values that ROS map_saver gives the cell classes.
_GREY = {UNKNOWN: 205, FREE: 254, OCCUPIED: 0}
_OCCUPIED_THRESHOLD, _FREE_THRESHOLD = 0.65, 0.196

# Netpbm "P5": magic, width, height and largest value, parted by white space and # comments, then one byte of
# white space, then the pixels.
_GAP = rb"(?:\s|#[^\n]*\n)+"
_PGM_HEADER = re.compile(rb"P5" + _GAP + rb"(\d{1,6})" + _GAP + rb"(\d{1,6})" + _GAP + rb"(\d{1,5})\s")


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
    temporary = path.with_name(f".{path.stem}.{os.getpid()}-{secrets.token_hex(4)}{path.suffix}")
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


def read_map_server(path: str | Path) -> tuple[NDArray[np.int8], float, tuple[float, float]]:
    """Read a trinary ROS map_server map from its YAML description.

    Returns
    -------
    classes : (rows, cols) int8
        -1 unknown, 0 free, 100 occupied; row 0 at the lowest y.
    resolution : float
        Side of a cell [m].
    origin : (x, y)
        Position of the lower-left corner of cell (0, 0) in the map's frame [m].

    Raises
    ------
    ValueError
        One line: the file, and what is missing, damaged or not supported (modes other than trinary, rotated
        maps, images other than 8-bit binary PGM).
    """
    path = Path(path)
    try:
        values = yaml.safe_load(_read(path, "map description"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"map description {path} is not YAML: {' '.join(str(error).split())}") from error
    try:
        resolution = float(values["resolution"])
        x, y, yaw = (float(v) for v in values["origin"])
        occupied, free = float(values["occupied_thresh"]), float(values["free_thresh"])
        negate, mode, image = bool(int(values["negate"])), values.get("mode", "trinary"), str(values["image"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(f"map description {path}: missing or damaged value ({error})") from error
    if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(resolution) and resolution > 0):
        raise ValueError(f"map description {path}: resolution must be > 0 and origin finite")
    if mode != "trinary" or yaw != 0.0:
        raise ValueError(f"map description {path}: only mode trinary and origin yaw 0 are read, not {mode}, {yaw}")
    pixels = _read_pgm(path.parent / image)
    # facts.md: the probability of being occupied, from the grey value.
    probability = (pixels if negate else 255 - pixels.astype(np.int16)) / 255.0
    classes = np.full(pixels.shape, UNKNOWN, np.int8)
    classes[probability > occupied] = OCCUPIED
    classes[probability < free] = FREE
    return np.ascontiguousarray(classes[::-1]), resolution, (x, y)


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


def read_tum(path: str | Path) -> tuple[Array, Array]:
    """Read a TUM trajectory as times ``(n,)`` [s] and planar poses ``(n, 3)`` [m, m, rad].

    Height, roll and pitch are dropped; ``#`` lines and empty lines are skipped.

    Raises
    ------
    ValueError
        One line, naming the file and the line, where a line is not eight finite numbers with a quaternion
        that is not null; or where the file cannot be read.
    """
    path = Path(path)
    times: list[float] = []
    poses: list[tuple[float, float, float]] = []
    for number, line in enumerate(_read(path, "trajectory").decode(errors="replace").splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            t, x, y, z, qx, qy, qz, qw = (float(word) for word in line.split())
        except ValueError:
            raise _damaged(path, number, "expected 8 numbers t tx ty tz qx qy qz qw", line) from None
        if not all(map(math.isfinite, (t, x, y, z, qx, qy, qz, qw))):
            raise _damaged(path, number, "values must be finite", line)
        if math.hypot(qx, qy, qz, qw) < 1e-3:
            raise _damaged(path, number, "the quaternion is null", line)
        # Yaw of a quaternion of any length.
        yaw = math.atan2(2.0 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz)
        times.append(t)
        poses.append((x, y, yaw))
    result = np.array(poses, np.float64).reshape(-1, 3)
    result[:, 2] = wrap(result[:, 2])
    return np.array(times, np.float64), result


def _read(path: Path, what: str) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"cannot read {what} {path}: {error.strerror}") from error


def _read_pgm(path: Path) -> NDArray[np.uint8]:
    data = _read(path, "map image")
    header = _PGM_HEADER.match(data)
    if header is None or int(header[3]) != 255:
        raise ValueError(f"map image {path} is not an 8-bit binary PGM (P5 with 255 grey levels)")
    cols, rows = int(header[1]), int(header[2])
    if rows * cols == 0 or len(data) - header.end() < rows * cols:
        held = len(data) - header.end()
        raise ValueError(f"map image {path} is damaged: {cols} x {rows} pixels announced, {held} bytes held")
    return np.frombuffer(data, np.uint8, rows * cols, header.end()).reshape(rows, cols)


def _damaged(path: Path, number: int, problem: str, line: str) -> ValueError:
    return ValueError(f"{path}, line {number}: {problem}, got {line[:80]!r}")
