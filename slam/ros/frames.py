"""Where the lidar sits: the tree of frames, and a scan as the robot's own heading has it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from slam.files import quoted
from slam.ros.read import Placed
from slam.types import Array, Scan

__all__ = ["Frames", "Mount", "mount_of", "resampled"]

_LEVEL = math.cos(math.radians(10.0))  # a lidar that leans more sees floor and ceiling
_MOST_FRAMES = 10_000
_FARTHEST_M = 10.0  # what backends take for a lidar's place on a robot


class Mount(NamedTuple):
    """A level lidar's place on the robot, maybe upside down."""

    x_m: float  # ahead of the robot's frame
    y_m: float  # to the left
    yaw_rad: float
    flipped: bool = False  # upside down: its bearings run clockwise, seen from above

    def level(self, scan: Scan) -> Scan:
        """Return a scan by the robot's heading, bearings counter-clockwise, its middle one in [-π, π)."""
        side = -1.0 if self.flipped else 1.0
        ranges, step = scan.ranges, side * scan.angle_increment
        first, sweep = self.yaw_rad + side * scan.angle_min, (len(ranges) - 1) * step
        if step < 0.0:
            ranges, first, step, sweep = ranges[::-1], first + sweep, -step, -sweep
        turn = 2.0 * math.pi
        first -= turn * math.floor((first + 0.5 * sweep + math.pi) / turn)
        return scan._replace(ranges=ranges, angle_min=first, angle_increment=step)


def resampled(scan: Scan, angle_min: float, angle_increment: float, beams: int) -> Array:
    """Return the ranges ``(beams,)`` at other bearings: each the nearest beam's; nan where there is none near."""
    asked = angle_min + angle_increment * np.arange(beams)
    whole = round(2.0 * math.pi / scan.angle_increment)  # beams of a circle
    nearest = np.rint((asked - scan.angle_min) / scan.angle_increment).astype(np.int64) % whole
    count = len(scan.ranges)
    out: Array = np.where(nearest < count, scan.ranges[np.minimum(nearest, count - 1)], math.nan)
    return out


class Frames:
    """The tree of frames, as far as it stands still: of each frame the first place that is told."""

    def __init__(self) -> None:
        self._above: dict[str, tuple[str, Array]] = {}

    def add(self, placed: Placed) -> None:
        """Take note of a frame's place, where none is known."""
        if len(self._above) < _MOST_FRAMES:
            self._above.setdefault(placed.child, (placed.parent, placed.matrix))

    def between(self, base: str, sensor: str) -> Array | None:
        """Return the sensor's place on the base ``(4, 4)``; ``None`` where the tree does not connect them."""
        over_base = self._chain(base)
        for frame, matrix in self._chain(sensor).items():  # the nearest that both hang on comes first
            if frame in over_base:
                found: Array = np.linalg.inv(over_base[frame]) @ matrix
                return found
        return None

    def carries(self, frame: str, sensor: str) -> bool:
        """Tell whether a sensor is on a frame, or on what hangs from that."""
        return frame in self._chain(sensor)

    def _chain(self, frame: str) -> dict[str, Array]:
        """Return a frame and those above it, each with the first one's place in it."""
        matrix = np.eye(4)
        chain = {frame: matrix}
        while frame in self._above:
            frame, step = self._above[frame]
            if frame in chain:
                raise ValueError(f"has frames in a circle, at {quoted(frame)}; correct its transforms")
            matrix = step @ matrix
            chain[frame] = matrix
        return chain


def mount_of(matrix: Array) -> Mount:
    """Return a lidar's place on the robot by its matrix ``(4, 4)``.

    Raises
    ------
    ValueError
        Where it leans by more than 10°, or sits farther away than a robot is long.
    """
    up = float(matrix[2, 2])
    if abs(up) < _LEVEL:
        lean = math.degrees(math.acos(min(max(abs(up), -1.0), 1.0)))
        raise ValueError(f"has a lidar that leans by {lean:.0f}°; a level one is needed, or one upside down")
    x, y = float(matrix[0, 3]), float(matrix[1, 3])
    if max(abs(x), abs(y)) > _FARTHEST_M:
        raise ValueError(
            f"has a lidar {x:.4g} m ahead and {y:.4g} m to the left of the robot; correct its transforms"
        )
    return Mount(x, y, math.atan2(matrix[1, 0], matrix[0, 0]), up < 0.0)
