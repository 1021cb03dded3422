"""Small floor plans as files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np


def write_room(path: Path, *, width_m: float = 4.0, height_m: float = 3.0) -> Path:
    """Write an empty room with a pillar in the middle as an image of 5 cm pixels; its wall is 0.25 m thick."""
    rows, cols = round(height_m / 0.05), round(width_m / 0.05)
    image = np.zeros((rows + 10, cols + 10), np.uint8)
    image[5:-5, 5:-5] = 255
    r, c = image.shape[0] // 2, image.shape[1] // 2
    image[r - 6 : r + 6, c - 6 : c + 6] = 0
    assert cv2.imwrite(str(path), image)
    return path
