"""A belief as a small picture, for whoever looks at one in a notebook; the simulator's own are in its views."""

from __future__ import annotations

import math

import cv2
import numpy as np

from slam.grids.occupancy import UNKNOWN, OccupancyGrid
from slam.types import Array, Bytes

__all__ = ["draw_known"]

_LONGEST_PX, _MARGIN_CELLS = 480, 8
_UNSEEN = 175  # its tone: free cells are lighter from their first scan on, occupied ones darker
_LANDMARK, _ROBOT = (30, 110, 230), (200, 90, 20)  # blue, green, red


def draw_known(grid: OccupancyGrid, landmarks: Array, pose: Array) -> Bytes:
    """Return what is known as a picture ``(h, w, 3)``, blue-green-red, y upwards, cropped to it.

    Parameters
    ----------
    grid : OccupancyGrid
        Shown by its probabilities; what was never seen is toned.
    landmarks : (n, 2) array
        Dots [m].
    pose : (3,) array
        The robot, a disc with a line ahead.
    """
    classes = grid.classes()
    rows, cols = np.nonzero(classes != UNKNOWN)
    if len(rows) == 0:
        rows = cols = np.array([0, 1])
    row, col = max(rows.min() - _MARGIN_CELLS, 0), max(cols.min() - _MARGIN_CELLS, 0)
    window = slice(row, rows.max() + _MARGIN_CELLS + 1), slice(col, cols.max() + _MARGIN_CELLS + 1)
    tones = np.round(255.0 * (1.0 - grid.probability()[window])).astype(np.uint8)
    tones[classes[window] == UNKNOWN] = _UNSEEN
    scale = max(1, _LONGEST_PX // max(tones.shape))
    image = cv2.cvtColor(tones[::-1].repeat(scale, 0).repeat(scale, 1), cv2.COLOR_GRAY2BGR)
    per_m, height = scale / grid.resolution, image.shape[0]
    left, below = grid.origin[0] + col * grid.resolution, grid.origin[1] + row * grid.resolution

    def pixel(x: float, y: float) -> tuple[int, int]:
        return round((x - left) * per_m), height - round((y - below) * per_m)

    for x, y in landmarks:
        cv2.circle(image, pixel(x, y), 3, _LANDMARK, cv2.FILLED, cv2.LINE_AA)
    x, y, theta = pose
    radius = max(0.25, 4 / per_m)
    ahead = x + 2.0 * radius * math.cos(theta), y + 2.0 * radius * math.sin(theta)
    cv2.line(image, pixel(x, y), pixel(*ahead), _ROBOT, 2, cv2.LINE_AA)
    cv2.circle(image, pixel(x, y), round(radius * per_m), _ROBOT, cv2.FILLED, cv2.LINE_AA)
    return np.asarray(image, np.uint8)
