"""What a scan says for or against a map and a pose: beams that end on its walls, and beams that end in the open.

Cells that the map does not know say nothing, nor do those that were only ever between two beams, or a beam that
returned nothing or was lost.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.grids.occupancy import OccupancyGrid
from slam.grids.scan_drawing import FREE_UP_TO, OCCUPIED_FROM
from slam.types import Array, Scan

__all__ = ["Agreement", "agreement", "agrees", "through_walls"]


_BESIDE_M = 0.05


class Agreement(NamedTuple):
    """Beams of a scan that say something about a pose on a map."""

    on_walls: int  # ended in an occupied cell, or beside one
    sharp: int  # of those, ended in it
    blurred: int  # of those, ended before it, in a cell that is known to be free, or right behind it
    in_the_open: int  # ended among cells that are known to be free

    @property
    def beams(self) -> int:
        """Number of beams that said anything."""
        return self.on_walls + self.in_the_open

    @property
    def against(self) -> float:
        """Share of the beams that speak against the pose; 0 where none said anything."""
        beams = self.on_walls + self.in_the_open
        return self.in_the_open / beams if beams else 0.0

    @property
    def sharpness(self) -> float:
        """Share of the beams that end right to the cell, of those that tell; 1 where none does.

        A wall that was seen from far away is drawn in pieces: what ends beside one, in a cell hardly seen yet,
        may have ended on the next.
        """
        tell = self.sharp + self.blurred
        return self.sharp / tell if tell else 1.0


def agreement(grid: OccupancyGrid, sensor_pose: tuple[float, float, float], scan: Scan, beams: int) -> Agreement:
    """Return what at most ``beams`` evenly spaced beams of a scan say, the sensor at a pose (x, y, θ)."""
    row0, col0 = grid.lattice_origin
    x, y, theta = sensor_pose
    ranges, angle_min, increment, range_max, _ = scan
    return Agreement(*_count_beams(
        grid.log_odds, row0, col0, grid.resolution, ranges, angle_min, increment, range_max, x, y, theta,
        len(ranges) // beams or 1,
    ))  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _around(log_odds: NDArray[np.int8], row: int, col: int, near: int) -> tuple[int, bool]:
    """Return the highest value of a cell and those near it, and whether all of them were ever observed."""
    highest, known = -128, True
    for i in range(row - near, row + near + 1):
        for j in range(col - near, col + near + 1):
            value = log_odds[i, j]
            highest = max(highest, value)
            known &= value != 0
    return highest, known


@njit(cache=True, nogil=True, error_model="numpy")
def _count_beams(
    log_odds: NDArray[np.int8], row0: int, col0: int, resolution: float, ranges: Array, angle_min: float,
    increment: float, range_max: float, x: float, y: float, theta: float, stride: int,
) -> tuple[int, int, int, int]:  # fmt: skip
    rows, cols = log_odds.shape
    on_walls, sharp, blurred, in_the_open = 0, 0, 0, 0
    # Beside a cell is 5 cm away, and within it half of that, however fine cells are: beliefs are no finer for it.
    near = max(1, int(_BESIDE_M / resolution + 0.5 + 1e-9))  # half a cell rounds up, as in cells of 2 cm
    within = (near - 1) // 2
    # Directions of the beams one after the other, each turned on from the one before it.
    c, s = math.cos(theta + angle_min), math.sin(theta + angle_min)
    turn_c, turn_s = math.cos(stride * increment), math.sin(stride * increment)
    u0, v0 = x / resolution - col0, y / resolution - row0
    for k in range(0, ranges.shape[0], stride):
        r = ranges[k]
        if r <= range_max:  # neither lost nor without return
            reach = r / resolution + 0.25  # what stopped the beam lies behind where it returned from
            col, row = int(u0 + c * reach), int(v0 + s * reach)
            if near <= row < rows - near and near <= col < cols - near:
                value = log_odds[row, col]
                if value >= OCCUPIED_FROM:  # as most are
                    on_walls += 1
                    sharp += 1
                else:
                    highest, known = _around(log_odds, row, col, near)
                    if highest >= OCCUPIED_FROM:
                        on_walls += 1
                        if within > 0 and _around(log_odds, row, col, within)[0] >= OCCUPIED_FROM:
                            sharp += 1
                        else:
                            before = log_odds[int(v0 + s * (reach - near)), int(u0 + c * (reach - near))]
                            blurred += value < FREE_UP_TO or before >= OCCUPIED_FROM
                    in_the_open += highest < FREE_UP_TO and known
        c, s = c * turn_c - s * turn_s, s * turn_c + c * turn_s
    return on_walls, sharp, blurred, in_the_open


def agrees(grid: OccupancyGrid, body: Array, offset_m: float, scan: Scan, beams: int) -> bool:
    """Tell whether a scan agrees with a map as well as scans do, from a pose of the body ``(3,)``.

    Nine tenths of the beams on walls end in the very cell of one, and next to none in the open.
    """
    ranges, angle_min, increment, range_max, _ = scan
    row0, col0 = grid.lattice_origin
    return bool(_agrees(
        grid.log_odds, row0, col0, grid.resolution, ranges, angle_min, increment, range_max, body, offset_m,
        len(ranges) // beams or 1,
    ))  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _agrees(
    log_odds: NDArray[np.int8], row0: int, col0: int, resolution: float, ranges: Array, angle_min: float,
    increment: float, range_max: float, body: Array, offset: float, stride: int,
) -> bool:  # fmt: skip
    theta = body[2]
    x, y = body[0] + offset * math.cos(theta), body[1] + offset * math.sin(theta)
    on_walls, sharp, blurred, in_the_open = _count_beams(
        log_odds, row0, col0, resolution, ranges, angle_min, increment, range_max, x, y, theta, stride
    )
    return in_the_open <= 0.03 * on_walls and sharp >= 0.9 * (sharp + blurred)


def through_walls(
    grid: OccupancyGrid, sensor_pose: tuple[float, float, float], scan: Scan, beams: int
) -> tuple[int, int]:
    """Return how many of at most ``beams`` beams come through a wall, and how many have an end at all."""
    row0, col0 = grid.lattice_origin
    x, y, theta = sensor_pose
    return _count_crossings(
        grid.log_odds, row0, col0, grid.resolution, scan.ranges, scan.angle_min, scan.angle_increment,
        scan.range_max, x, y, theta, max(len(scan.ranges) // beams, 1),
    )  # fmt: skip


_SHORT_CELLS = 5.0  # of a beam's end, where the wall is that it ended on


@njit(cache=True, nogil=True, error_model="numpy")
def _alone(log_odds: NDArray[np.int8], row: int, col: int) -> bool:
    """Tell whether a cell has no occupied neighbour."""
    for i in range(row - 1, row + 2):
        for j in range(col - 1, col + 2):
            if log_odds[i, j] >= OCCUPIED_FROM:
                return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _count_crossings(
    log_odds: NDArray[np.int8], row0: int, col0: int, resolution: float, ranges: Array, angle_min: float,
    increment: float, range_max: float, x: float, y: float, theta: float, stride: int,
) -> tuple[int, int]:  # fmt: skip
    rows, cols = log_odds.shape
    crossing = beams = 0
    u0, v0 = x / resolution - col0, y / resolution - row0
    for k in range(0, ranges.shape[0], stride):
        if not ranges[k] <= range_max:
            continue
        beams += 1
        c, s = math.cos(theta + angle_min + k * increment), math.sin(theta + angle_min + k * increment)
        met = False
        for step in range(1, int(2.0 * (ranges[k] / resolution - _SHORT_CELLS))):
            col, row = int(u0 + 0.5 * step * c), int(v0 + 0.5 * step * s)
            if not (1 <= row < rows - 1 and 1 <= col < cols - 1):
                continue
            if log_odds[row, col] >= OCCUPIED_FROM:
                met = True
            elif met and log_odds[row, col] <= FREE_UP_TO and _alone(log_odds, row, col):
                crossing += 1  # and out again: what runs along a wall does not count
                break
    return crossing, beams
