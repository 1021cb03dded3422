"""A time below which nobody can have mapped so much of a plan, whatever they know: loose, but a bound.

The plan is cut into tiles. For each there is a region that the lidar must have been in for any of its cells to be
seen, and from region to region it takes at least the shortest way between them. Say a path of length L saw all but
a share ε. Let x be 1 for the tiles it saw nothing of, else 0: then their cells sum up to ε at most. And of any set
of tiles whose regions no path of length L passes through (the shortest sequence of hops, in the best order, is
longer), it saw nothing of one at least: Σ x ≥ 1. If the least Σ cells · x under some such sets, with x any numbers
of [0, 1] (a linear program), is more than ε, there is no such path, and it takes longer than L at the largest
wheels' fastest. Which sets are looked at makes the bound better or worse, not wrong.

What makes that true on rasters: a lidar that moves about touches no wall with the body around it. All cells about
where it can be are nodes of an 8-connected lattice, whose ways are at most 1.0824 times as long as straight ones.
Places 0.1 m apart are looked from, and each stands for what is seen within 0.25 m of it. Single cells at rims are
seen from between places and from none of these; so a twentieth of a tile does not count. This step alone is not
proven but tested, by looks from other places.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.optimize import linprog

from agents.ways.planning import D_COL, D_ROW
from mecanum_env.config import LidarConfig, NoiseConfig, RobotConfig
from mecanum_env.ground_truth import GroundTruth
from slam.geometry import transform_points
from slam.types import Array
from training.truth.places import cells_per_tile
from training.truth.sights import Eye

__all__ = ["Tiles", "least_length", "lower_bound", "shortest_hops"]

_LONGER = 1.0824  # an 8-connected way against a straight one, at most: 1 / cos(22.5°)
_RASTER_M = 0.15  # that both ends of a way may be nearer than their cells are
_VIEW = 2  # cells of the truth between two places that are looked from
_TILE = 12  # … a side of a tile
_REACH_M = 0.25  # a place stands for what is seen within this …
_LEAK = 0.05  # … but for so much of a tile
_MOST = 8  # tiles of a set
_ROUNDS = 40  # of sets that are added to one linear program
_SETS = 12  # tried in each
_PRECISION_M = 0.1


def lower_bound(
    ground: GroundTruth, share: float, *, robot: RobotConfig, lidar: LidarConfig, noise: NoiseConfig
) -> float:
    """Return a time [s] below which nobody has mapped a share of the truth; 0 where nothing can be said.

    It holds for a body that touches nothing, and a belief that draws what it sees within 0.1 m of where it is.
    """
    tiles = Tiles(ground, robot=robot, lidar=lidar)
    metres = least_length(tiles.apart, tiles.cells, (1.0 - share) * ground.mappable_cells)
    # The lidar is no farther from the middle than the lever is long: it goes no faster than a wheel's rim.
    return metres / (robot.max_speed_m_s * (1.0 + noise.radius_error))


class Tiles:
    """Tiles of a true map and how far the lidar has to go to see any of one, and from there any of another.

    Parameters
    ----------
    ground : GroundTruth
        The truth of an episode.
    robot, lidar
        Who drives and how far is seen; the lidar is taken to see all round.

    Attributes
    ----------
    cells : NDArray[np.int64]
        The mappable cells of each tile ``(tiles,)`` that count.
    apart : Array
        ``(tiles + 1, tiles + 1)`` [m]: no way is shorter; row and column 0 are the start's.
    places : NDArray[np.int64]
        Row and column ``(places, 2)`` of the truth's cells that are looked from.
    sees : NDArray[np.bool_]
        Whether a place shows any of a tile ``(places, tiles)``.
    """

    def __init__(self, ground: GroundTruth, *, robot: RobotConfig, lidar: LidarConfig) -> None:
        shape, cell = ground.mappable.shape, ground.resolution
        corner = np.array(ground.lattice_origin[::-1])
        every = np.argwhere(np.ones(shape, dtype=np.bool_))
        points = transform_points(ground.start, (every[:, ::-1] + 0.5 + corner) * cell)
        # The lidar is within the body, and the body within the walls.
        gap = max(min(0.5 * robot.width_m, 0.5 * robot.length_m - abs(lidar.offset_m)), 0.0)
        room = np.where(ground.plan.is_free(points), ground.plan.distance_to_surfaces(points), 0.0)
        nodes = (room > max(gap - math.sqrt(2.0) * cell, 0.0)).reshape(shape)
        start = np.floor(np.array([0.0, lidar.offset_m]) / cell).astype(np.int64) - corner[::-1]
        nodes[tuple(start)] = True
        reached = np.isfinite(_distances(nodes, start[None]))
        others = np.ascontiguousarray(np.argwhere(reached[::_VIEW, ::_VIEW]))
        self.places = np.vstack([start[None], others * _VIEW])
        cells = cells_per_tile(ground.mappable, _TILE).ravel()
        eye = Eye(ground, lidar)
        eyes = (self.places[:, ::-1] + 0.5 + corner) * cell
        sees = np.array([cells_per_tile(eye.sees(point) & ground.mappable, _TILE).ravel() > 0 for point in eyes])
        kept = (cells > 0) & sees.any(axis=0)
        self.cells, self.sees = np.floor((1.0 - _LEAK) * cells[kept]).astype(np.int64), sees[:, kept]
        starts = [self.places[:1], *(self.places[seen] for seen in self.sees.T)]
        ways = np.array([_distances(nodes, own)[tuple(self.places.T)] for own in starts])
        to_tiles = np.array([np.where(seen, ways, np.inf).min(axis=1) for seen in self.sees.T]).T
        self.apart = np.zeros((len(starts), len(starts)))
        self.apart[:, 1:] = np.maximum(to_tiles * cell / _LONGER - _RASTER_M - 2.0 * _REACH_M, 0.0)
        self.apart[0, 1:] = np.maximum(to_tiles[0] * cell / _LONGER - _RASTER_M - _REACH_M, 0.0)
        self.apart[1:, 0] = self.apart[0, 1:]


def least_length(apart: Array, cells: NDArray[np.int64], spare: float) -> float:
    """Return a length [m] that every path has that sees something of all tiles but for ``spare`` cells of them.

    Parameters
    ----------
    apart
        ``(tiles + 1, tiles + 1)`` [m], as :class:`Tiles` has it.
    cells
        Of each tile ``(tiles,)``.
    """
    low, high = 0.0, 4.0 * float(apart[0].max(initial=0.0)) + 1.0
    known: list[tuple[int, ...]] = []
    rng = np.random.default_rng(0)
    while high - low > _PRECISION_M:
        length = 0.5 * (low + high)
        if _excluded(apart, cells, spare, length, known, rng):
            low = length
        else:
            high = length
    return low


def _excluded(
    apart: Array, cells: NDArray[np.int64], spare: float, length: float, known: list[tuple[int, ...]],
    rng: np.random.Generator,
) -> bool:  # fmt: skip
    """Whether no path of a length sees enough; sets found are added to those known, for other lengths."""
    sets = [found for found in known if _hops(apart, found) > length]
    sets += [(k,) for k in np.flatnonzero(apart[0, 1:] > length).tolist()]
    for _ in range(_ROUNDS):
        unseen = np.zeros(len(cells))
        if sets:
            rows = np.zeros((len(sets), len(cells)))
            for row, members in zip(rows, sets, strict=True):
                row[list(members)] = -1.0
            solved = linprog(cells, A_ub=rows, b_ub=-np.ones(len(sets)), bounds=(0.0, 1.0), method="highs")
            if solved.fun > spare * (1.0 + 1e-9) + 1e-6:
                return True
            unseen = solved.x
        fresh = {found for _ in range(_SETS) if (found := _too_far(apart, unseen, length, rng)) is not None}
        if not fresh:
            return False
        sets += sorted(fresh)
        known += sorted(fresh)
    return False


def _too_far(apart: Array, unseen: Array, length: float, rng: np.random.Generator) -> tuple[int, ...] | None:
    """Return tiles that no path of a length passes the regions of, and that the linear program has as seen."""
    members: list[int] = []
    nearest = apart[0, 1:] * rng.uniform(0.5, 1.5, len(unseen))  # of what is chosen, or the start
    left = 1.0 - 1e-3
    while len(members) < _MOST:
        worth = np.where(unseen < left, nearest, -1.0)
        worth[members] = -1.0
        best = int(np.argmax(worth))
        if worth[best] <= 0.0:
            return None
        members.append(best)
        left -= float(unseen[best])
        nearest = np.minimum(nearest, apart[best + 1, 1:])
        if _hops(apart, tuple(members)) > length:
            break
    else:
        return None
    for one in list(members):  # the smaller a set, the more it says
        rest = tuple(other for other in members if other != one)
        if rest and _hops(apart, rest) > length:
            members.remove(one)
    return tuple(sorted(members))


def _hops(apart: Array, members: tuple[int, ...]) -> float:
    index = [0, *(k + 1 for k in members)]
    return shortest_hops(apart[np.ix_(index, index)])


def shortest_hops(apart: Array) -> float:
    """Return the length of the shortest path from place 0 through all others, of ``(k + 1, k + 1)`` hops."""
    return float(_held_karp(np.ascontiguousarray(apart, dtype=np.float64)))


@njit(cache=True, nogil=True)
def _held_karp(apart: Array) -> float:
    """Find it by subsets of places (Held and Karp 1962)."""
    k = len(apart) - 1
    way = np.full((1 << k, k), np.inf)  # through a subset, to the last place of it
    for i in range(k):
        way[1 << i, i] = apart[0, i + 1]
    for subset in range(1, 1 << k):
        for i in range(k):
            here = way[subset, i]
            if here < np.inf:
                for j in range(k):
                    if not subset >> j & 1:
                        there = subset | 1 << j
                        way[there, j] = min(way[there, j], here + apart[i + 1, j + 1])
    return float(way[-1].min()) if k > 0 else 0.0


@njit(cache=True, nogil=True)
def _distances(nodes: NDArray[np.bool_], starts: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return how far [cells] each node is from the nearest start over 8 neighbours; inf where not at all.

    Buckets of one cell (Dial 1969): no edge is shorter.
    """
    rows, cols = nodes.shape
    out = np.full((rows, cols), np.inf, dtype=np.float32)
    now, later, last, bucket = [(0, 0)], [(0, 0)], [(0, 0)], 0
    now.clear()
    later.clear()
    last.clear()
    for i in range(len(starts)):
        out[starts[i, 0], starts[i, 1]] = 0.0
        now.append((starts[i, 0], starts[i, 1]))
    while len(now) or len(later):
        k = 0
        while k < len(now):
            r, c = now[k]
            k += 1
            here = out[r, c]
            if int(here) != bucket:
                continue
            for i in range(8):
                y, x = r + D_ROW[i], c + D_COL[i]
                if 0 <= y < rows and 0 <= x < cols and nodes[y, x]:
                    there = here + np.float32(1.0 if i % 2 == 0 else math.sqrt(2.0))
                    if there < out[y, x]:
                        out[y, x] = there
                        if int(there) == bucket + 1:
                            later.append((y, x))
                        else:
                            last.append((y, x))
        now, later, last = later, last, now
        last.clear()
        bucket += 1
    return out
