"""What a lidar sees of a frontier from where: the places to look from, and what has been looked at already.

A piece of frontier is in *good sight* from a place if the line between them is free and its beams fall on it
densely. Beams fall the sparser the farther away it is and the flatter they meet it, in proportion to
distance / cos(incidence); so the places that see it well fill the circle that touches it, of the diameter
``view_range_m``. What is in good sight and yet stays a frontier is no opening: it is the unsettled drawing of a
wall, and another look tells no more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.ways.cost_map import CostMap, kind_at
from agents.ways.planning import TravelCosts
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN
from slam.types import Array, Cells, Flags, Floats, Indices

__all__ = ["Track", "Watch", "first_in_good_sight", "in_good_sight", "reach_m", "view_points"]

_NEARER = 0.85  # share of the view range that places to look from keep to: the robot stops a little short
_LEAST_CELLS = 2.0  # that they keep to at least


@dataclass(frozen=True, eq=False)
class Watch:
    """Where the sensor has been, and how it sees."""

    poses: Array  # (k, 3) of the sensor in the belief's frame, oldest first
    range_m: float  # diameter of the circle of good sight
    half_view_rad: float  # half the field of view; π and more: all round


class Track:
    """Sensor poses, in an array that grows by doubling: it is read at every choice."""

    def __init__(self) -> None:
        self._room, self._count = np.zeros((64, 3)), 0

    @property
    def poses(self) -> Array:
        """The poses ``(k, 3)``, oldest first; later ones are written behind them."""
        return self._room[: self._count]

    def append(self, pose: tuple[float, float, float]) -> None:
        """Add the latest pose: x [m], y [m], θ [rad]."""
        if self._count == len(self._room):
            self._room = np.vstack([self._room, np.zeros_like(self._room)])
        self._room[self._count] = pose
        self._count += 1


def in_good_sight(cost_map: CostMap, cells: Cells, normals: Array, watch: Watch) -> Flags:
    """Return which frontier cells ``(n, 2)`` (row, column) were in good sight from any of the watch's poses.

    ``normals`` ``(n, 2)`` point from free to unknown; where one is zero, every direction is as good.
    """
    poses = np.array(watch.poses, dtype=np.float64).reshape(-1, 3)
    poses[:, :2] = cost_map.in_cells(poses[:, :2])
    seen = np.zeros(len(cells), dtype=np.bool_)
    if not len(poses):
        return seen
    reach = watch.range_m / cost_map.resolution
    # In bands of y and there in order of x, so that only those near a cell need to be looked at; of equals, the
    # latest are the likeliest. A cell to spare: what rounding puts just within reach is not left out here.
    far = reach + 1.0
    left = poses[:, 0].min()
    width = poses[:, 0].max() - left + 1.0
    place = np.floor(poses[:, 1] / far) * width + (poses[:, 0] - left)
    order = np.argsort(place[::-1], kind="stable")
    poses, place = poses[::-1][order], place[::-1][order]
    x, band = cells[:, 1] + 0.5 - left, np.floor((cells[:, 0] + 0.5) / far)
    for aside in (0.0, -1.0, 1.0):
        begin = (band + aside) * width
        first = np.searchsorted(place, begin + np.clip(x - far, 0.0, width - 0.5))
        beyond = np.searchsorted(place, begin + np.clip(x + far, 0.0, width - 0.5), side="right")
        some = np.flatnonzero(~seen & (first < beyond))
        seen[some] = _first_seen(
            cost_map.classes, cells[some], normals[some], poses, first[some], beyond[some], reach,
            watch.half_view_rad,
        ) >= 0  # fmt: skip
    return seen


def first_in_good_sight(
    cost_map: CostMap,
    cells: Cells,
    normals: Array,
    places: Array,
    worth: Array,
    least: Array,
    range_m: float,
) -> Indices:
    """Return, for each frontier cell ``(n, 2)``, the first place that has it in good sight, −1 where none has.

    Parameters
    ----------
    cost_map : CostMap
        The planning grid.
    cells, normals : NDArray
        Frontier cells (row, column) and their normals ``(n, 2)``, as for :func:`in_good_sight`.
    places : Array
        Places ``(k, 2)`` [m] of a sensor that sees all round, worthiest first.
    worth : Array
        What each place is worth ``(k,)``, never rising: the search of a cell ends where it falls to ``least``.
    least : Array
        What a place must be worth more than, for each cell ``(n,)``.
    range_m : float
        Diameter of the circle of good sight.
    """
    poses = np.column_stack([cost_map.in_cells(places), np.zeros(len(places))])
    beyond = np.searchsorted(-worth, -least)
    reach = range_m / cost_map.resolution
    first = np.zeros_like(beyond)
    return np.asarray(_first_seen(cost_map.classes, cells, normals, poses, first, beyond, reach, math.pi))


def reach_m(range_m: float, short_m: float, resolution_m: float) -> float:
    """Return the diameter of the circle that places to look from keep to [m].

    Good sight reaches ``range_m``; the sensor may come to look from ``short_m`` beside the place.
    """
    return max(min(_NEARER * range_m, range_m - short_m), _LEAST_CELLS * resolution_m)


def view_points(
    cost_map: CostMap, travel: TravelCosts, targets: Array, normals: Array, *, range_m: float, beyond_m: float,
    short_m: float = 0.0,
) -> tuple[Indices, Array]:  # fmt: skip
    """Return, for each piece of frontier ``(m, 2)`` [m], the cheapest cell that has it in good sight.

    Row and column ``(m, 2)``, −1 where there is none, and the cell's travel cost ``(m,)``, there infinite.

    Places keep to :func:`reach_m` of ``range_m`` and ``short_m``; where the body cannot come that near to a piece,
    to the farther reach of a sensor that comes to look from the place itself.
    Sight lines are walked backwards from a point ``beyond_m`` behind the frontier. Where no reachable cell sees
    that point, one near the frontier that sees the frontier itself will do: it is the last that can be tried.
    A piece whose cost is ``travel.beyond_m`` is seen from no cell that costs less, and from any of the others.
    """
    resolution = cost_map.resolution
    start, beyond = cost_map.in_cells(targets), beyond_m / resolution
    reach, farther = (reach_m(range_m, short, resolution) / resolution for short in (short_m, 0.0))
    cells, costs = _cheapest(cost_map, travel, start, normals, reach, beyond)
    left = np.flatnonzero(np.isinf(costs))
    if farther > reach and len(left):
        cells[left], costs[left] = _cheapest(cost_map, travel, start[left], normals[left], farther, beyond)
    return cells, costs


def _cheapest(
    cost_map: CostMap, travel: TravelCosts, start: Array, normals: Array, reach: float, beyond: float
) -> tuple[Indices, Array]:
    """Return what :func:`view_points` does, of one reach; positions ``(m, 2)`` and lengths in cells."""
    cells = np.full((len(start), 2), -1, dtype=np.int64)
    costs = np.full(len(start), np.inf)
    # No way is shorter than the straight line: where that alone is too long, one place is as good as another.
    away = np.hypot(start[:, 0] - cost_map.start[1], start[:, 1] - cost_map.start[0]) - (
        reach + 2.0 * beyond + 4.0
    )
    enough = np.where(away * cost_map.resolution > travel.beyond_m, travel.beyond_m, 0.0)
    _look(cost_map.classes, travel.cost, start, normals, reach, beyond, enough, cells, costs)
    return cells, costs


@njit(cache=True, nogil=True)
def _first_seen(
    classes: NDArray[np.int8], cells: Cells, normals: Array, poses: Array, first: Indices,
    beyond: Indices, reach: float, half_view: float,
) -> Indices:  # fmt: skip
    """Return each cell's first pose, from ``first`` to before ``beyond``, that has it in good sight; or −1."""
    found = np.full(len(cells), -1, dtype=np.int64)
    for i in range(len(cells)):
        x, y, nx, ny = cells[i, 1] + 0.5, cells[i, 0] + 0.5, normals[i, 0], normals[i, 1]
        for k in range(first[i], beyond[i]):
            if _is_good(classes, x, y, nx, ny, poses[k, 0], poses[k, 1], poses[k, 2], reach, half_view):
                found[i] = k
                break
    return found


@njit(cache=True, nogil=True)
def _is_good(
    classes: NDArray[np.int8], x: float, y: float, nx: float, ny: float, px: float, py: float, heading: float,
    reach: float, half_view: float,
) -> bool:  # fmt: skip
    """Tell whether a sensor at px, py has the point x, y with its normal in good sight; positions in cells."""
    dx, dy = x - px, y - py
    square = dx * dx + dy * dy
    flat = nx == 0.0 and ny == 0.0
    # distance ≤ reach · cos(incidence), times distance
    if square > (reach * math.sqrt(square) if flat else reach * (dx * nx + dy * ny)):
        return False
    if half_view < math.pi:
        off = math.atan2(dy, dx) - heading
        if abs(math.atan2(math.sin(off), math.cos(off))) > half_view:
            return False
    return _is_free_line(classes, x, y, px, py)


@njit(cache=True, nogil=True)
def _is_free_line(classes: NDArray[np.int8], x0: float, y0: float, x1: float, y1: float) -> bool:
    length = math.hypot(x1 - x0, y1 - y0)
    count = int(length / 0.7) + 1  # less than a cell: no wall is stepped over, diagonal ones included
    for i in range(count):
        share = i / count
        if kind_at(classes, math.floor(y0 + share * (y1 - y0)), math.floor(x0 + share * (x1 - x0))) != FREE:
            return False
    return True


@njit(cache=True, nogil=True)
def _look(
    classes: NDArray[np.int8], cost: Floats, targets: Array, normals: Array, reach: float,
    beyond: float, enough: Array, cells: Cells, costs: Array,
) -> None:  # fmt: skip
    """Find the cheapest cell in sight of each target, or one that costs no more than ``enough`` of it.

    Positions are in cells, x first.
    """
    for i in range(targets.shape[0]):
        x, y = targets[i, 0], targets[i, 1]
        nx, ny = normals[i, 0], normals[i, 1]
        push = beyond
        while push > 0.0 and kind_at(classes, math.floor(y + push * ny), math.floor(x + push * nx)) == OCCUPIED:
            push -= 1.0
        push = max(push, 0.0)
        _sweep(classes, cost, x, y, nx, ny, reach, push, push + 2.0, i, enough[i], cells, costs)
        if costs[i] == np.inf:
            _sweep(classes, cost, x, y, 0.0, 0.0, 0.4 * reach, 0.0, 1.0, i, enough[i], cells, costs)


@njit(cache=True, nogil=True)
def _sweep(
    classes: NDArray[np.int8], cost: Floats, x: float, y: float, nx: float, ny: float, reach: float,
    push: float, blind: float, index: int, enough: float, cells: Cells, costs: Array,
) -> None:  # fmt: skip
    """Walk sight lines from ``push`` cells behind (x, y) and keep to the places that see it well.

    They go through anything but walls for ``blind`` cells, then through free ones.
    """
    flat = nx == 0.0 and ny == 0.0
    directions = 96
    for k in range(directions):
        angle = 2.0 * math.pi * k / directions
        dx, dy = math.cos(angle), math.sin(angle)
        away = 0.0
        while away <= reach + push:
            px, py = x + push * nx + away * dx, y + push * ny + away * dy
            away += 0.7  # less than a cell: no wall is stepped over, diagonal ones included
            row, col = math.floor(py), math.floor(px)
            kind = kind_at(classes, row, col)
            if kind == OCCUPIED or (kind == UNKNOWN and away > blind + 0.7):
                break
            if kind != FREE:
                continue
            if cost[row, col] >= costs[index]:
                continue
            ex, ey = x - (col + 0.5), y - (row + 0.5)
            square = ex * ex + ey * ey
            if square <= (reach * math.sqrt(square) if flat else reach * (ex * nx + ey * ny)):
                costs[index] = cost[row, col]
                cells[index, 0], cells[index, 1] = row, col
                if costs[index] <= enough:
                    return
