"""Reading back what :mod:`slam.formats` writes, by other means than its own."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

Array = NDArray[np.float64]


def read_tum(path: Path) -> tuple[Array, Array]:
    """Return times ``(n,)`` and planar poses ``(n, 3)``."""
    rows = np.array([line.split() for line in path.read_text("utf-8").splitlines()], np.float64).reshape(-1, 8)
    assert not rows[:, 3:6].any()
    return rows[:, 0], np.column_stack([rows[:, 1:3], 2.0 * np.arctan2(rows[:, 6], rows[:, 7])])


def read_map_server(path: Path) -> tuple[NDArray[np.int8], float, tuple[float, float]]:
    """Return classes ``(rows, cols)``, row 0 at the lowest y, resolution and origin."""
    values = yaml.safe_load(path.read_text("utf-8"))
    pixels = cv2.imread(str(path.parent / values["image"]), cv2.IMREAD_UNCHANGED)
    assert pixels is not None and pixels.dtype == np.uint8 and pixels.ndim == 2
    occupied = (255 - pixels[::-1].astype(np.float64)) / 255
    classes = np.full(pixels.shape, -1, np.int8)
    classes[occupied > values["occupied_thresh"]] = 100
    classes[occupied < values["free_thresh"]] = 0
    x, y, yaw = values["origin"]
    assert values["mode"] == "trinary" and values["negate"] == yaw == 0
    return classes, values["resolution"], (x, y)
