"""Distances over a raster, to the last bit the same in every process, and its largest part."""

from __future__ import annotations

import cv2
import numpy as np

from slam.types import Bytes, Flags, Floats

__all__ = ["distance_to_zero", "largest_part"]


def distance_to_zero(mask: Flags | Bytes) -> Floats:
    """Return each cell's distance [cells] ``(rows, cols)`` to the nearest one that is 0, centre to centre.

    The last bits of OpenCV's square root depend on how many threads it has and on where an array lies in memory.
    What it is the root of is a whole number, and so near to it (up to 800 cells) that it can be restored.
    """
    rough = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    squared = np.rint(np.square(rough, dtype=np.float64))
    return np.sqrt(squared).astype(np.float32)


def largest_part(mask: Flags) -> Flags | None:
    """Return the largest 4-connected part of a mask ``(rows, cols)``, None if it is empty."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    if count < 2:
        return None
    return np.asarray(labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])), np.bool_)
