"""What there is to do for a robot that hops over a lattice of stations and looks only where it stops.

From the grid of what is known: the stations and the ways between them, the pieces of frontier, which stations see
enough of them, and what is lost by beginning the tour over them with each. One kernel, as it is computed at every
hop of every episode that lessons are drawn from (``training/dungeons/lessons.py``). Everything is in cells of the
grid, row and column, unless it says [m].
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.stations.lattice import edges, join, lengths, line_is_free, ways
from agents.stations.sensor import Rays, look
from agents.ways.routing import best_tour, draw_luck, improve, order_cost
from slam.grids.occupancy import FREE, UNKNOWN
from slam.types import Array, Cells, Flags

__all__ = [
    "HOP",
    "STRIDE",
    "VOXEL",
    "Openings",
    "Survey",
    "begin",
    "find_pieces",
    "first_hop",
    "no_pieces",
    "options",
    "survey",
    "tour",
]

Classes = NDArray[np.int8]

STRIDE = 10
"""Cells between two stations."""
HOP = 2
"""Stations a hop goes at most along each axis."""
VOXEL = 4
"""Cells a side of the squares in which frontier cells are taken for one piece."""
_IN_SIGHT = 40.0  # cells from which a piece counts as in sight
_FARTHEST = 51.0  # cells from which a sensor's ray shows anything
_WORTH = 2  # pieces in sight that make a station worth a visit
_FREE, _UNKNOWN = int(FREE), int(UNKNOWN)


class Survey(NamedTuple):
    """What there is to do."""

    cells: Cells  # (n, 2) stations known to be free
    before: Cells  # (n,) the station before each on the way from the robot's, −1 where there is no way
    way: Array  # (n,) length of that way, inf where there is none
    worth: Flags  # (n,) which see enough of the frontier, can be reached, and were not looked from
    views: Cells  # (n,) pieces in sight of each that can be reached and was not looked from
    pieces: Cells  # (m, 2) frontier
    seen: Flags  # (w, m) pieces in sight of each station worth a visit
    places: Cells  # (k,) stations of the tour, the robot's own first
    sight: Flags  # (k, m) what each place is taken to settle
    distance: Array  # (k, k) between places [m]


class Openings(NamedTuple):
    """Tours that begin differently: one for every station that the robot may hop to first, the best one first."""

    targets: Cells  # (c,) station that the tour begins with
    hops: Cells  # (c,) station of the first hop on the way there
    losses: Array  # (c,) what is lost by beginning there, by what is known now [m]; 0 for the first
    legs: Array  # (c,) length of the way to the target [m]


def no_pieces(shape: tuple[int, int]) -> Cells:
    """Return what :func:`find_pieces` fills in, for a grid of this shape: no frontier anywhere."""
    return np.full((shape[0] // VOXEL + 1, shape[1] // VOXEL + 1), -1, dtype=np.int64)


@njit(cache=True, nogil=True)
def find_pieces(known: Classes, pieces: Cells, box: Cells) -> None:
    """Bring ``pieces`` up to date where cells became known: rows ``box[0] … box[1]``, columns ``box[2] … box[3]``.

    A piece is all frontier in a square of :data:`VOXEL` cells a side; it stands at its cell nearest to the middle,
    as row · columns + column, −1 for none. A frontier cell is free and has two to seven unknown neighbours.
    """
    if box[1] < box[0]:
        return
    rows, cols = known.shape
    for i in range(max(box[0] - 1, 0) // VOXEL, min(box[1] + 1, rows - 1) // VOXEL + 1):
        for j in range(max(box[2] - 1, 0) // VOXEL, min(box[3] + 1, cols - 1) // VOXEL + 1):
            pieces[i, j] = _piece(known, i, j)


@njit(cache=True, nogil=True)
def _piece(known: Classes, i: int, j: int) -> int:
    """Return the piece of frontier in a square, see :func:`find_pieces`."""
    rows, cols = known.shape
    nearest, piece = np.inf, -1
    for r in range(VOXEL * i, min(VOXEL * i + VOXEL, rows)):
        for c in range(VOXEL * j, min(VOXEL * j + VOXEL, cols)):
            if known[r, c] != _FREE or not 2 <= _unknown_around(known, r, c) <= 7:
                continue
            middle = 0.5 * (VOXEL - 1)
            away = (r - i * VOXEL - middle) ** 2 + (c - j * VOXEL - middle) ** 2
            if away < nearest:
                nearest, piece = away, r * cols + c
    return piece


@njit(cache=True, nogil=True)
def _unknown_around(known: Classes, row: int, col: int) -> int:
    count = 0
    for r in range(max(row - 1, 0), min(row + 2, known.shape[0])):
        for c in range(max(col - 1, 0), min(col + 2, known.shape[1])):
            if known[r, c] == _UNKNOWN:
                count += 1
    return count


@njit(cache=True, nogil=True)
def _listed(pieces: Cells, cols: int) -> Cells:
    flat = pieces.ravel()
    flat = flat[flat >= 0]
    return np.column_stack((flat // cols, flat % cols))


@njit(cache=True, nogil=True)
def _settled(known: Classes, row: int, col: int, points: Cells, sensor: Rays) -> Flags:
    """Return which pieces ``(m,)`` a look from a cell would leave nothing of, were all that is unknown wall."""
    shown, settled = known.copy(), np.zeros(len(points), np.bool_)
    look(known == _FREE, row, col, sensor, shown)
    for j in range(len(points)):
        r, c = points[j, 0], points[j, 1]
        if (r - row) ** 2 + (c - col) ** 2 < _FARTHEST**2:
            settled[j] = _piece(shown, r // VOXEL, c // VOXEL) < 0
    return settled


@njit(cache=True, nogil=True)
def survey(
    known: Classes, pieces: Cells, visited: Flags, first: tuple[int, int], robot: tuple[int, int],
    cell_m: float, reach: float, sensor: Rays,
) -> Survey:  # fmt: skip
    """Return what there is to do.

    Parameters
    ----------
    known, visited
        ``(rows, cols)``: classes of the cells, and those that were looked from.
    pieces
        From :func:`find_pieces`.
    first
        Any station's cell: it says where the lattice lies.
    robot
        The cell of the station that the robot is on.
    cell_m
        Side of a cell [m].
    reach
        Cells from which the tour counts a piece in sight as settled.
    sensor
        Besides, pieces count as settled that a look would leave nothing of by what is known, as far as it reaches:
        much of a wall far off is not hit by any ray. :data:`agents.stations.sensor.BLIND`: without that, in a
        fifth of the time.
    """
    r0, c0 = first[0] % STRIDE, first[1] % STRIDE
    picked = known[r0::STRIDE, c0::STRIDE] == _FREE
    own = np.ascontiguousarray(np.argwhere(picked))
    index = np.full(picked.shape, -1, dtype=np.int64)
    cells = np.empty_like(own)
    for i in range(len(own)):
        index[own[i, 0], own[i, 1]] = i
        cells[i, 0], cells[i, 1] = r0 + STRIDE * own[i, 0], c0 + STRIDE * own[i, 1]
    joined = join(known, cells, own, index, HOP)
    here = index[(robot[0] - r0) // STRIDE, (robot[1] - c0) // STRIDE]
    way, before = ways(cells, joined, here)
    points = _listed(pieces, known.shape[1])
    n, m = len(cells), len(points)
    seen, near = np.zeros((n, m), np.bool_), np.zeros((n, m), np.bool_)
    views, worth, useful = np.zeros(n, np.int64), np.zeros(n, np.bool_), np.zeros(n, np.bool_)
    for i in range(n):
        if i == here or visited[cells[i, 0], cells[i, 1]] or not np.isfinite(way[i]):
            continue
        for j in range(m):
            away = (points[j, 0] - cells[i, 0]) ** 2 + (points[j, 1] - cells[i, 1]) ** 2
            if away < _IN_SIGHT**2:
                seen[i, j] = line_is_free(known, cells[i, 0], cells[i, 1], points[j, 0], points[j, 1])
                near[i, j] = seen[i, j] and away < reach**2
        views[i] = seen[i].sum()
        worth[i] = views[i] >= _WORTH
        if worth[i] and len(sensor.tree):
            near[i] |= _settled(known, cells[i, 0], cells[i, 1], points, sensor)
        useful[i] = worth[i] and near[i].sum() >= _WORTH
    if worth.any() and not useful.any():
        useful[:], near[:] = worth, seen
    places = np.concatenate((np.array([here]), np.flatnonzero(useful)))
    to, length, count = edges(cells, joined)
    sight, distance = np.zeros((len(places), m), np.bool_), np.empty((len(places), len(places)))
    for a in range(len(places)):
        if a > 0:
            sight[a] = near[places[a]]
        distance[a] = lengths(to, length, count, places[a])[places] * cell_m
    return Survey(cells, before, way, worth, views, points, seen[worth], places, sight, distance)


@njit(cache=True, nogil=True)
def tour(found: Survey, luck: Array) -> Cells:
    """Return the best tour found, as ``places`` in order from 0, the robot's; there is something to do.

    It leaves nothing behind that would make a station worth a visit. A single piece is no reason for one.
    """
    weight = np.zeros(len(found.places))
    order, _ = best_tour(found.sight, found.distance, weight, luck[:, : len(found.places)].copy())
    return _spared(found, order)


@njit(cache=True, nogil=True)
def _spared(found: Survey, order: Cells) -> Cells:
    """Return a tour without places that need not be on it, the first aside; first go those that save most."""
    weight = np.zeros(len(found.places))
    while len(order) > 2:
        cost = order_cost(found.distance, weight, order)
        best, saved = -1, -1.0
        for k in range(1, len(order)):
            without = np.concatenate((order[:k], order[k + 1 :]))
            saves = cost - order_cost(found.distance, weight, without)
            if saves > saved and _is_enough(found, without):
                best, saved = k, saves
        if best < 0:
            break
        order = np.concatenate((order[:best], order[best + 1 :]))
        better = np.arange(len(order))
        improve(found.distance[order][:, order], weight[: len(order)], better)
        order = order[better]
    return order


@njit(cache=True, nogil=True)
def _is_enough(found: Survey, order: Cells) -> bool:
    """Whether no station would be worth a visit after a tour."""
    left = np.ones(len(found.pieces), np.bool_)
    for k in range(len(order)):
        for j in range(len(left)):
            if found.sight[order[k], j]:
                left[j] = False
    for i in range(len(found.seen)):
        count = 0
        for j in range(len(left)):
            if left[j] and found.seen[i, j]:
                count += 1
        if count >= _WORTH:
            return False
    return True


@njit(cache=True, nogil=True)
def _begun_with(found: Survey, order: Cells) -> Array:
    """Return what the tour costs [m] if each place ``(k,)`` is put first, 0 for place 0."""
    costs, weight = np.zeros(len(found.places)), np.zeros(len(found.places))
    for first in range(1, len(costs)):
        rest = order[order != first]
        rest[0] = first  # in the robot's place: the rest of the tour begins here
        better = np.arange(len(rest))
        improve(found.distance[rest][:, rest], weight[: len(rest)], better)
        rest = _spared(found, rest[better])
        costs[first] = found.distance[0, first] + order_cost(found.distance, weight, rest)
    return costs


@njit(cache=True, nogil=True)
def begin(found: Survey, luck: Array) -> int:
    """Return the station that the best tour found begins with."""
    return int(found.places[tour(found, luck)[1]])


@njit(cache=True, nogil=True)
def first_hop(before: Cells, here: int, station: int) -> int:
    """Return the station of the first hop on the way from ``here`` to a station."""
    while before[station] != here:
        station = before[station]
    return int(station)


def options(found: Survey, luck: Array, *, most: int, most_loss_m: float) -> Openings:
    """Return the tours worth weighing: of those with the same first hop the best, at most ``most``, best first.

    ``luck`` is from :func:`agents.ways.routing.draw_luck`; where there are more places than it has columns, it is
    drawn anew.
    """
    if luck.shape[1] < len(found.places):
        luck = draw_luck(len(luck), len(found.places))
    order = tour(found, luck)
    costs = _begun_with(found, order)
    best = int(order[1])
    losses = costs - costs[best]
    ranked = 1 + np.argsort(losses[1:], kind="stable")
    chosen: dict[int, int] = {}  # first hop → place
    for place in [best, *ranked[ranked != best].tolist()]:
        if losses[place] > most_loss_m or len(chosen) == most:
            continue
        chosen.setdefault(first_hop(found.before, int(found.places[0]), int(found.places[place])), place)
    picked = np.fromiter(chosen.values(), dtype=np.int64)
    return Openings(
        found.places[picked], np.fromiter(chosen, dtype=np.int64), losses[picked], found.distance[0, picked]
    )
