"""Two maps laid on each other: how much of one's walls stands where the other has free space."""

from __future__ import annotations

import cv2
import numpy as np

from slam.geometry import inverse, transform_points
from slam.grids.occupancy import FREE, OCCUPIED, OccupancyGrid
from slam.types import Array

__all__ = ["contradiction"]

_DEEP_M = 0.2  # from anything that is not free: a wall there is not merely drawn askew


def contradiction(grid_a: OccupancyGrid, grid_b: OccupancyGrid, pose: Array) -> float:
    """Return the share of either map's wall cells, of those the other knows something of, deep in its free space.

    ``pose`` ``(3,)`` is of b's frame in a's. The larger of both shares; 0 where they do not overlap.
    """
    return max(_share(grid_a, grid_b, inverse(pose)), _share(grid_b, grid_a, pose))


def _share(walls_of: OccupancyGrid, free_of: OccupancyGrid, pose: Array) -> float:
    """Return the share of wall cells within the other's free space, with their frame at a pose in the other's."""
    classes = free_of.classes()
    depth = cv2.distanceTransform((classes == FREE).astype(np.uint8), cv2.DIST_L2, 3) * free_of.resolution
    cells = walls_of.to_points(np.argwhere(walls_of.classes() == OCCUPIED))
    there = free_of.to_cells(transform_points(pose, cells))
    there = there[((there >= 0) & (there < free_of.shape)).all(axis=1)]
    known = classes[there[:, 0], there[:, 1]] != -1
    if not known.any():
        return 0.0
    return float((depth[there[:, 0], there[:, 1]] > _DEEP_M).sum() / known.sum())
