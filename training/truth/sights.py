"""What is to be seen of a true map from where, and the ways between: what sequences of stops are searched with.

Nothing of it may reach an agent; ``agents/`` cannot import it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.ways.cost_map import PlannerConfig
from agents.ways.planning import resample, shortest_path, travel_costs
from mecanum_env.config import LidarConfig, NoiseConfig, RobotConfig
from mecanum_env.ground_truth import GroundTruth
from mecanum_env.sensing.sensors import Lidar
from slam.geometry import compose
from slam.grids.occupancy import UNKNOWN, OccupancyGrid
from slam.types import Array, Cells, Scan
from training.truth.places import true_cost_map

__all__ = ["Board", "Eye", "Sights", "look"]

Bits = NDArray[np.uint64]

_STOP = 3  # cells of the planning grid between two stops
_VIEW = 2  # … between two places that are looked from on the way
_LEAD = 3  # … from where the robot's middle can be to where its lidar can
_SAMPLE = 2  # one of so many of the truth's cells a side is counted
_NEAR = 24  # stops that count as near a stop


class Board(NamedTuple):
    """What the kernels of the search need to know of a map. Cells are those of the planning grid, row by row."""

    stops: Cells  # (stops,) their cells; the first is the robot's
    near: Cells  # (stops, ≤ 24) the stops nearest to each
    steps: NDArray[np.int8]  # (stops, cells) the last step of the way from a stop to each cell
    cols: int
    price: NDArray[np.float32]  # (cells,) of crossing each [weighted m]
    view_of: NDArray[np.int32]  # (cells,) the view of each cell, −1 where the robot's middle cannot be
    views: Bits  # (views, words) what each view shows: a bit a mappable cell that is counted
    counted: int  # how many are


class Sights:
    """Stops all over a true map, the ways between them, and what is seen on these.

    Parameters
    ----------
    ground : GroundTruth
        The truth of an episode.
    robot, lidar
        Who drives and how far is seen; the lidar is taken to see all round.

    Attributes
    ----------
    map : CostMap
        The true map for planning, in the start frame.
    board : Board
        All of it for kernels.
    eye_of : NDArray[np.int32]
        The view ``(cells,)`` of the lidar where it is in a cell, −1 where it cannot be.
    """

    def __init__(self, ground: GroundTruth, *, robot: RobotConfig, lidar: LidarConfig) -> None:
        self.ground = ground
        self.map = true_cost_map(ground, PlannerConfig(), robot)
        reached = np.isfinite(travel_costs(self.map).cost)
        lattice = np.argwhere(reached[::_STOP, ::_STOP]) * _STOP
        elsewhere = (lattice != np.array(self.map.start)).any(axis=1)
        self._cells = np.vstack([np.array([self.map.start]), lattice[elsewhere]])
        self._maps = [replace(self.map, start=(row, col)) for row, col in self._cells.tolist()]
        self._travels = [travel_costs(at) for at in self._maps]
        apart = ((self._cells[:, None] - self._cells[None]) ** 2).sum(axis=2)
        view_of, looked = _views(reached)
        self.eye_of = _spread(view_of, _LEAD).ravel()
        self.board = Board(
            stops=self._cells @ np.array([reached.shape[1], 1]),
            near=np.argsort(apart, axis=1, kind="stable")[:, 1 : _NEAR + 1].copy(),
            steps=np.array([travel.step.ravel() for travel in self._travels]),
            cols=reached.shape[1],
            price=self.map.weight.ravel() * np.float32(self.map.resolution),
            view_of=view_of.ravel(),
            views=self._look_around(looked, lidar),
            counted=int(self._sampled.sum()),
        )

    @property
    def _sampled(self) -> NDArray[np.bool_]:
        return self.ground.mappable[::_SAMPLE, ::_SAMPLE]

    def _look_around(self, cells: Cells, lidar: LidarConfig) -> Bits:
        eye, sampled = Eye(self.ground, lidar), self._sampled
        seen = np.zeros((len(cells), -(-int(sampled.sum()) // 64) * 64), dtype=np.bool_)
        for k, point in enumerate(self.map.to_points(cells)):
            found = eye.sees(point)[::_SAMPLE, ::_SAMPLE][sampled]
            seen[k, : len(found)] = found
        return np.packbits(seen, axis=1).view(np.uint64)

    def path(self, order: Cells, spacing_m: float = 0.1) -> Array:
        """Return the way ``(n, 2)`` [m] from the robot's start past stops, each piece cut straight."""
        pieces = [np.zeros((1, 2))]
        for a, b in zip(order[:-1].tolist(), order[1:].tolist(), strict=True):
            if a != b:
                row, col = self._cells[b].tolist()
                start = pieces[-1][-1]
                piece = shortest_path(self._maps[a], self._travels[a], (row, col), start=start, spacing_m=np.inf)
                pieces.append(piece[1:])
        return resample(np.vstack(pieces), spacing_m)


class Eye:
    """Looks at the truth as the environment's lidar does, without noise, and says which cells that shows free."""

    def __init__(self, ground: GroundTruth, lidar: LidarConfig) -> None:
        self._ground = ground
        self._config = replace(lidar, field_of_view_deg=360.0, offset_m=0.0)
        self._lidar = Lidar(self._config, NoiseConfig())
        row, col = ground.lattice_origin
        corner = (col * ground.resolution, row * ground.resolution)
        nothing = np.full(ground.mappable.shape, UNKNOWN, np.int8)
        self._grid = OccupancyGrid.from_classes(nothing, ground.resolution, corner)

    def sees(self, point: Array) -> NDArray[np.bool_]:
        """Return which of the truth's cells ``(rows, cols)`` a scan from a point ``(2,)`` [m] shows free."""
        ground, config, grid = self._ground, self._config, self._grid
        pose = np.array([point[0], point[1], 0.0])
        ranges = self._lidar.true_ranges(ground.plan.segments, ground.plan.circles, compose(ground.start, pose))
        grid.clear()
        grid.integrate(pose, Scan(ranges, config.angle_min, config.angle_increment, config.range_max_m))
        row, col = np.array(ground.lattice_origin) - np.array(grid.lattice_origin)
        rows, cols = ground.mappable.shape
        return np.asarray(grid.log_odds[row : row + rows, col : col + cols] < 0)


def _views(reached: NDArray[np.bool_]) -> tuple[NDArray[np.int32], Cells]:
    """Return the view of each cell ``(rows, cols)``, and where they are taken from ``(views, 2)``.

    A cell is looked from at its lattice place; one whose place cannot be reached, at itself.
    """
    row, col = np.nonzero(reached)
    low_row, low_col = row // _VIEW * _VIEW, col // _VIEW * _VIEW
    off = ~reached[low_row, low_col]
    at = np.column_stack([np.where(off, row, low_row), np.where(off, col, low_col)])
    looked, index = np.unique(at, axis=0, return_inverse=True)
    views = np.full(reached.shape, -1, dtype=np.int32)
    views[row, col] = index.ravel()
    return views, looked


def _spread(views: NDArray[np.int32], rings: int) -> NDArray[np.int32]:
    """Return the views with so many rings of cells around them that take that of a neighbour."""
    out = np.pad(views, 1, constant_values=-1)
    for _ in range(rings):
        before = out.copy()
        for shift in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
            beside = np.roll(before, shift, (0, 1))
            out = np.where((out < 0) & (beside >= 0), beside, out)
    return out[1:-1, 1:-1]


@njit(cache=True, nogil=True)
def look(views: Bits, view: int, seen: Bits) -> int:
    """Add what a view shows to what is seen ``(words,)``; return how many cells are new."""
    u = np.uint64
    new = 0
    for w in range(views.shape[1]):
        word = views[view, w] & ~seen[w]
        seen[w] |= word
        # Bits in pairs, in fours, in eights; the product's top byte is the sum of all eight.
        word = word - ((word >> u(1)) & u(0x5555555555555555))
        word = (word & u(0x3333333333333333)) + ((word >> u(2)) & u(0x3333333333333333))
        word = (word + (word >> u(4))) & u(0x0F0F0F0F0F0F0F0F)
        new += int((word * u(0x0101010101010101)) >> u(56))
    return new
