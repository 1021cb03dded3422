"""What a backend believes: the value that agents, observations and pictures are made from."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from slam.grids.occupancy import OccupancyGrid

__all__ = ["Belief"]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Belief:
    """What a backend believes now, in the frame of its start. Arrays are copies; the grid is live."""

    pose: Array  # (3,) x [m], y [m], θ [rad]
    pose_cov: Array  # (3, 3)
    landmarks: Array  # (n, 2) [m]
    landmark_cov: Array  # (n, 2, 2) [m²]
    landmark_ids: NDArray[np.int64]  # (n,) never reused within an episode
    grid: OccupancyGrid
    joint_cov: Array | None = None  # (3 + 2n, 3 + 2n), robot first, where the backend has one
    landmark_kinds: NDArray[np.int8] = field(  # (n,) CONVEX, CONCAVE or 0 where not known
        default_factory=lambda: np.zeros(0, np.int8)
    )
    lines: Array = field(default_factory=lambda: np.zeros((0, 2)))  # (k, 2) walls: α [rad], r [m]
    line_ends: Array = field(default_factory=lambda: np.zeros((0, 4)))  # (k, 4) x1, y1, x2, y2 [m]
    health: float = 1.0  # probability that the true pose lies within the 99.7 % region of pose and pose_cov
    whole_cov: Array | None = None  # joint_cov with the walls' (α, r) behind the points: (3 + 2n + 2k, …)
