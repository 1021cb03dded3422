"""What is sensed: the values that travel between the rooms of the house (``belief`` holds what is believed)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.files import quoted

__all__ = [
    "CONCAVE", "CONVEX", "FARTHEST_M", "LINE", "VIRTUAL", "Array", "Bytes", "Cells", "Flags", "Floats", "Indices",
    "Observations", "Odometry", "Scan", "Sighting",
]  # fmt: skip

Array = NDArray[np.float64]
"""Numbers; their shape and units stand where they are named."""
Floats = NDArray[np.float32]
"""The same, where half the bits do: what is observed, and what networks compute."""
Cells = NDArray[np.int64]
"""Rows and columns on a grid, or cells counted row by row."""
Indices = NDArray[np.int64]
"""Other whole numbers: places in arrays, ids, counts."""
Flags = NDArray[np.bool_]
"""Of which it is so, and of which not."""
Bytes = NDArray[np.uint8]
"""Pictures, masks, and what else one number in 256 says."""

CONVEX = 1
"""A corner that stands out into free space: the end of a wall, the edge of a cupboard."""
CONCAVE = -1
"""A corner of the free space itself: where two walls of a room meet."""
LINE = 2
"""A straight wall, not a point: its two coordinates are α [rad] and r [m], x cos α + y sin α = r."""
VIRTUAL = 3
"""A point that no scan shows: with its twin it stands for a place, see :mod:`slam.graph.places`."""
FARTHEST_M = 100.0
"""As far as estimators look at what a lidar says [m]: maps are drawn in memory."""


# Named tuples where each step makes a new one: a frozen dataclass takes 0.5 µs longer to build.
class Odometry(NamedTuple):
    """The wheels' account of one step: a body twist held for ``dt``."""

    twist: Array | tuple[float, float, float]  # (3,) vx [m/s], vy [m/s], ω [rad/s] in the body frame
    dt: float  # [s]
    slip: tuple[float, float] | None = None  # [m/s, rad/s] 1σ of what the wheels slip; None: not told

    @property
    def numbers(self) -> tuple[float, float, float]:
        """The twist as three numbers."""
        twist = self.twist
        if isinstance(twist, tuple) and len(twist) == 3:
            return twist
        try:
            vx, vy, omega = map(float, np.asarray(twist, np.float64).tolist())
        except (TypeError, ValueError):
            message = f"the twist of an odometry is three numbers vx, vy, ω, got {quoted(twist)}"
            raise ValueError(message) from None
        return vx, vy, omega


class Scan(NamedTuple):
    """One sweep of a planar lidar, in the sensor frame (REP 117 values).

    A range is metres, ``inf`` where nothing within ``range_max`` returned, ``nan`` where the beam was lost.
    """

    ranges: Array  # (beams,) [m]
    angle_min: float  # bearing of the first beam [rad]
    angle_increment: float  # [rad]
    range_max: float  # [m]
    range_min: float = 0.0  # [m]

    def check(self) -> None:
        """Raise ``ValueError``, saying what is wrong, where this is no scan; its ranges may be what they like."""
        ranges = self.ranges
        if not isinstance(ranges, np.ndarray):
            raise ValueError(f"a scan's ranges are a NumPy array (beams,), got {type(ranges).__name__}")
        if ranges.ndim != 1 or not len(ranges) or ranges.dtype.kind not in "fiu":
            raise ValueError(
                f"ranges of a scan are numbers (beams,), one at least, got {ranges.dtype} {ranges.shape}"
            )
        if not ranges.dtype.isnative or (ranges.dtype.kind == "f" and ranges.dtype.itemsize not in (4, 8)):
            raise ValueError(f"no kernel reads ranges of type {ranges.dtype.str}; give them as float64")
        if not (math.isfinite(self.angle_min + self.angle_increment) and 0.0 < self.range_max < math.inf):
            raise ValueError(
                "a scan's angles are finite, and its range_max is what its lidar sees [m]; got angle_min "
                f"{self.angle_min}, angle_increment {self.angle_increment}, range_max {self.range_max}"
            )
        if self.angle_increment <= 0.0 and len(ranges) > 1:
            raise ValueError(
                f"a scan's beams go counter-clockwise, angle_increment > 0, got {self.angle_increment}; turn the "
                "order of the ranges round, and begin at what was the last angle"
            )

    def by_rep_117(self) -> Scan:
        """Return the scan with ``inf`` and ``nan`` for what drivers say instead; itself where they do not.

        At ``range_max`` or beyond 100 m nothing returned. Below ``range_min``, at 0 or beyond ``range_max`` the
        beam is lost.
        """
        low, high = self.range_min, self.range_max
        if high <= FARTHEST_M and _all_within(self.ranges, low, high):
            return self
        ranges, farthest = self.ranges.astype(np.float64), min(high, FARTHEST_M)
        lost = (ranges < low) | (ranges <= 0.0) | ((ranges > high) & (ranges < np.inf))
        ranges[ranges >= farthest] = np.inf
        ranges[lost] = np.nan
        return self._replace(ranges=ranges, range_max=farthest)

    def kept(self) -> Scan:
        """Return a scan with ranges of its own: those given may be a buffer that the next scan goes into."""
        return Scan(self.ranges.copy(), self.angle_min, self.angle_increment, self.range_max, self.range_min)


@njit(cache=True, nogil=True)
def _all_within(ranges: Array, low: float, high: float) -> bool:
    """Tell whether all ranges lie within their bounds, but for infinite ones and those that are no numbers."""
    beyond = False
    for r in ranges:
        beyond |= r < low or r <= 0.0 or high <= r < np.inf
    return not beyond


class Sighting(NamedTuple):
    """Another robot, measured from this one: centre to centre, in this one's body frame."""

    robot: int
    measured: Array  # (3,) range [m], bearing [rad], the other's heading less one's own [rad]
    cov: Array  # (3, 3)


@dataclass(frozen=True, slots=True)
class Observations:
    """Landmarks seen at one instant, in the sensor frame."""

    range_bearing: Array  # (m, 2): range [m], bearing [rad]
    cov: Array  # (m, 2, 2): their covariance [m², m·rad, rad²], positive definite
    ids: Indices | None = None  # (m,) where the association is known, from 0 to 10⁶
