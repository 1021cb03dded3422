"""What a team has mapped: cells that at least one of its robots rightly has as free."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mecanum_env.ground_truth import GroundTruth, on_lattice
from slam.geometry import inverse, transform_points
from slam.grids.occupancy import FREE, OccupancyGrid
from slam.types import Bytes, Flags, Indices

__all__ = ["TeamCoverage"]


class TeamCoverage:
    """Share of the mappable cells that are rightly free on some robot's own map, kept up from their changes.

    Parameters
    ----------
    ground : GroundTruth
        In the frame of the team's first robot.
    frames : sequence of GroundTruth
        One a robot, in the frame of its belief: the same object where the frames are the same.

    Attributes
    ----------
    each_step : bool
        Whether an update costs little: where frames differ, it goes over the whole map.
    layers : NDArray[np.bool_]
        What each robot rightly has as free ``(robots, rows, cols)``, on the truth's raster; live.
    """

    def __init__(self, ground: GroundTruth, frames: Sequence[GroundTruth]) -> None:
        self._ground = ground
        self.each_step = all(frame is ground for frame in frames)
        self.layers = np.zeros((len(frames), *ground.mappable.shape), np.bool_)
        self._counts = np.zeros(ground.mappable.shape, np.uint8)
        self._covered = 0
        self._frames = tuple(frames)
        self._cells = None if self.each_step else [_same_cells(ground, frame) for frame in frames]

    @property
    def share(self) -> float:
        """The coverage in [0, 1]."""
        return self._covered / self._ground.mappable_cells

    def update(self, robot: int, changes: NDArray[np.int32] | None, grid: OccupancyGrid) -> None:
        """Take over a robot's own grid, in which these cells have changed (see ``Coverage``), or any (None)."""
        if self._cells is not None or changes is None:
            free = grid.classes() == FREE
            ground = self._frames[robot]
            layer = on_lattice(free, grid.lattice_origin, ground)
            if self._cells is not None:
                layer = np.append(layer, False)[self._cells[robot]].reshape(self._counts.shape)
            layer &= self._ground.mappable
            self._counts += layer
            self._counts -= self.layers[robot]
            self.layers[robot] = layer
            self._covered = int(np.count_nonzero(self._counts))
        else:
            row0, col0 = self._ground.lattice_origin
            self._covered += _mark(changes, self._ground.mappable, row0, col0, self.layers[robot], self._counts)


def _same_cells(ground: GroundTruth, frame: GroundTruth) -> Indices:
    """Return for each cell of ``ground`` the index of the same place in another frame's raster, or its size."""
    rows, cols = ground.mappable.shape
    row0, col0 = ground.lattice_origin
    x = (np.arange(cols) + col0 + 0.5) * ground.resolution
    y = (np.arange(rows) + row0 + 0.5) * ground.resolution
    points = np.column_stack([np.tile(x, rows), np.repeat(y, cols)])
    world = transform_points(ground.start, points)
    placed = transform_points(inverse(frame.start), world) / frame.resolution
    cells = np.floor(placed[:, ::-1]).astype(np.int64) - np.array(frame.lattice_origin)
    shape = np.array(frame.mappable.shape)
    inside = ((cells >= 0) & (cells < shape)).all(axis=1)
    return np.where(inside, cells[:, 0] * shape[1] + cells[:, 1], frame.mappable.size)


@njit(cache=True, nogil=True, error_model="numpy")
def _mark(changes: NDArray[np.int32], mappable: Flags, row0: int, col0: int, layer: Flags, counts: Bytes) -> int:
    """Take over changed cells of one robot; return by how many cells the team's coverage went up."""
    gained = 0
    for k in range(changes.shape[0]):
        r, c = changes[k, 0] - row0, changes[k, 1] - col0
        if 0 <= r < mappable.shape[0] and 0 <= c < mappable.shape[1] and mappable[r, c]:
            now = changes[k, 3] == FREE
            if now and not layer[r, c]:
                gained += counts[r, c] == 0
                counts[r, c] += 1
            elif not now and layer[r, c]:
                counts[r, c] -= 1
                gained -= counts[r, c] == 0
            layer[r, c] = now
    return gained
