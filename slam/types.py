"""The values that travel between the rooms of the house: what is sensed, and what is believed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from slam.grids.occupancy import OccupancyGrid

__all__ = ["CONCAVE", "CONVEX", "LINE", "Belief", "Observations", "Odometry", "Scan"]

Array = NDArray[np.float64]

CONVEX = 1
"""A corner that stands out into free space: the end of a wall, the edge of a cupboard."""
CONCAVE = -1
"""A corner of the free space itself: where two walls of a room meet."""
LINE = 2
"""A straight wall, not a point: its two coordinates are α [rad] and r [m], x cos α + y sin α = r."""


# Named tuples where each step makes a new one: a frozen dataclass takes 0.5 µs longer to build.
class Odometry(NamedTuple):
    """The wheels' account of one step: a body twist held for ``dt``."""

    twist: Array | tuple[float, float, float]  # (3,) vx [m/s], vy [m/s], ω [rad/s] in the body frame
    dt: float  # [s]


class Scan(NamedTuple):
    """One sweep of a planar lidar, in the sensor frame (REP 117 values).

    A range is metres, ``inf`` where nothing within ``range_max`` returned, ``nan`` where the beam was lost.
    """

    ranges: Array  # (beams,) [m]
    angle_min: float  # bearing of the first beam [rad]
    angle_increment: float  # [rad]
    range_max: float  # [m]
    range_min: float = 0.0  # [m]


@dataclass(frozen=True, slots=True)
class Observations:
    """Landmarks seen at one instant, in the sensor frame."""

    range_bearing: Array  # (m, 2): range [m], bearing [rad]
    cov: Array  # (m, 2, 2): their covariance [m², m·rad, rad²]
    ids: NDArray[np.int64] | None = None  # (m,) where the association is known


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
    whole_cov: Array | None = None  # joint_cov with the walls' (α, r) behind the points: (3 + 2n + 2k, …)
