"""A robot that stands on a station of its lattice: what it makes of its belief there.

Shared by the agents that choose among stations with :mod:`agents.stations.survey`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from agents.base import Agent, Goal
from agents.stations.sensor import SENSORS, rays
from agents.stations.survey import HOP, STRIDE, VOXEL, Survey, find_pieces, no_pieces, survey
from slam.belief import Belief
from slam.grids.occupancy import FREE, UNKNOWN
from slam.settings import Config, Few, Gap, Length, OneOf, require
from slam.types import Array, Cells, Flags, Floats

__all__ = ["StationAgent", "StationStop", "StationsConfig"]

Cell = tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class StationsConfig(Config):
    """The lattice that the robot hops on, where it is no robot that drives anywhere and looks all the while."""

    spacing_m: Gap = 0.0  # between stations, through the start; 0: there are none
    hop: Few = 2  # stations a hop goes at most along each axis
    reach_m: Length = 12.0  # from which a piece of frontier is looked at
    sensor: Annotated[str, OneOf(SENSORS)] = SENSORS[0]  # that the robot looks with


@dataclass(frozen=True, eq=False)
class StationStop:
    """Where the robot stands, and what there is to do. Cells are those of ``known``."""

    known: NDArray[np.int8]  # (rows, cols) classes of what is known, with a margin
    visited: Flags  # (rows, cols) cells that were looked from
    corner: Cell  # lattice row and column of the first cell
    first: Cell  # the station that the lattice goes through
    robot: Cell
    resolution: float  # [m]
    found: Survey

    def goal(self, station: int, belief: Belief) -> Goal:
        """Return a station as a goal."""
        at = self._point(self.found.cells[station])
        return Goal(pose=np.array([*at, belief.pose[2]]), path=np.array([belief.pose[:2], at]))

    def frontiers(self) -> Array:
        """Return the pieces of frontier ``(m, 2)`` [m]."""
        return self._point(self.found.pieces)

    def box(self, extent: tuple[float, ...]) -> tuple[int, int, int, int]:
        """Return the first row and column of a rectangle of the frame [m], and the first beyond it."""
        x0, y0, x1, y1 = (round(value / self.resolution) for value in extent)
        return y0 - self.corner[0], x0 - self.corner[1], y1 - self.corner[0], x1 - self.corner[1]

    def _point(self, cells: Cells) -> Array:
        return np.asarray((cells[..., ::-1] + np.array(self.corner[::-1]) + 0.5) * self.resolution)


class StationAgent(Agent):
    """What agents share that may hop over the lattice ``config.stations``: where they began, and have looked."""

    _began_at: Array = np.zeros(2)  # [m], a station
    _looked_at: tuple[Array, ...] = ()  # [m]

    def reset(self, belief: Belief, seed: int = 0) -> None:
        """Start an episode; where the robot is now is a station, if there are any."""
        super().reset(belief, seed)
        self._began_at, self._looked_at = np.array(belief.pose[:2], dtype=np.float64), ()

    def act(self, observation: Mapping[str, Any] | None, belief: Belief) -> Floats:
        """Return the next action; see :meth:`agents.base.Agent.act`.

        Raises
        ------
        ValueError
            With ``stations``: who hops from one to the next looks only there, and is driven by ``choose``.
        """
        require(
            self.config.stations.spacing_m == 0.0,
            f"with stations {type(self).__name__} is driven by choose, not by act; leave stations.spacing_m at 0",
        )
        return super().act(observation, belief)  # type: ignore[safe-super]

    def choose(self, belief: Belief) -> Goal | None:
        """Return where to go next: a station, where the robot stands on one and there is something to see."""
        return self._hop(belief) or super().choose(belief)  # type: ignore[safe-super]

    def looked(self, belief: Belief) -> None:
        """Take note that the sensor looked from the belief's pose."""
        super().looked(belief)
        self._looked_at += (np.array(belief.pose[:2], dtype=np.float64),)

    def _hop(self, belief: Belief) -> Goal | None:
        """Return the station to go to, ``None`` where the robot stands on none or there is nothing to see."""
        stop = self._stop(belief)
        if stop is None:
            return None
        self._frontiers, self._status = stop.frontiers(), "driving"
        return stop.goal(self._station(stop), belief)

    def _station(self, stop: StationStop) -> int:
        """Return the station to go to, of those in ``stop.found.cells``."""
        raise NotImplementedError

    def _stop(self, belief: Belief) -> StationStop | None:
        """Return what there is to do, ``None`` where there is nothing or the robot stands on no station.

        Only lattices of :data:`agents.stations.survey.STRIDE` cells of the grid, and hops of
        :data:`agents.stations.survey.HOP` stations, are known here.
        """
        stations: StationsConfig = self.config.stations
        resolution = belief.grid.resolution
        if round(stations.spacing_m / resolution) != STRIDE or stations.hop != HOP:
            return None
        known, corner = _aligned(belief)
        robot, first = (_cell_of(at, resolution, corner) for at in (belief.pose, self._began_at))
        if not _is_free(known, robot) or any((robot[k] - first[k]) % STRIDE for k in (0, 1)):
            return None
        visited = np.zeros(known.shape, dtype=np.bool_)
        for position in self._looked_at:
            cell = _cell_of(position, resolution, corner)
            if _is_free(known, cell):
                visited[cell] = True
        pieces = no_pieces(known.shape)
        find_pieces(known, pieces, np.array([0, known.shape[0] - 1, 0, known.shape[1] - 1]))
        reach = stations.reach_m / resolution
        found = survey(known, pieces, visited, first, robot, resolution, reach, rays(stations.sensor))
        return StationStop(known, visited, corner, first, robot, resolution, found) if found.worth.any() else None


def _aligned(belief: Belief) -> tuple[NDArray[np.int8], Cell]:
    """Return the classes of what is known, with a margin, and the lattice row and column of its first cell.

    The corner lies on a multiple of :data:`VOXEL`, wherever the grid begins: squares of frontier are the frame's.
    """
    classes = belief.grid.classes()
    rows, cols = (np.flatnonzero((classes != UNKNOWN).any(axis=axis)) for axis in (1, 0))
    row0, col0 = belief.grid.lattice_origin
    low = [row0 + int(rows[0]), col0 + int(cols[0])]
    corner = [(value - 1) // VOXEL * VOXEL for value in low]  # at least one unknown cell all round
    part = classes[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
    pad = [(value - own, STRIDE) for value, own in zip(low, corner, strict=True)]
    return np.pad(part, pad, constant_values=UNKNOWN), (corner[0], corner[1])


def _is_free(known: NDArray[np.int8], cell: Cell) -> bool:
    """Whether a cell, which may lie beyond what is known, is known to be free."""
    inside = all(0 <= value < size for value, size in zip(cell, known.shape, strict=True))
    return inside and bool(known[cell] == FREE)


def _cell_of(pose: NDArray[np.float64], resolution: float, corner: Cell) -> Cell:
    return (int(np.floor(pose[1] / resolution)) - corner[0], int(np.floor(pose[0] / resolution)) - corner[1])
