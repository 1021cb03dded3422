"""One episode of the dungeons protocol: an agent's goals, turned into hops over the lattice of way-points.

The agent sees a noise-free belief: the exact pose, and the grid of what was scanned so far. It is asked where to
go (``choose``), the robot makes one hop on the shortest way over the lattice to the way-point nearest that goal,
scans, and asks again.
"""

from __future__ import annotations

import math
import statistics
import time
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import agents
from agents.base import Agent, Goal
from agents.stations.lattice import line_is_free
from mecanum_env.config import LidarConfig, RobotConfig
from slam.belief import Belief
from slam.grids.occupancy import FREE, UNKNOWN, OccupancyGrid
from slam.types import Array
from training.dungeons.world import CELL_M, HOP, RANGE_M, SENSORS, STRIDE, Dungeon, Lattice, scan

__all__ = ["NEAREST", "NEAREST_VIEW", "SCANS", "explore", "make_agent"]

SCANS = ("way-points", "continuous")
"""Where the sensor is read: only where a hop ends, or in every cell on the way, too."""

NEAREST = "nearest-way-point"
"""Stands among the agents' names for a rule that belongs to the protocol: to the nearest way-point worth a visit.

Chosen anew at each way-point. It is what planners of the benchmark's family fall back on, and the simplest
reading of its "nearest frontier". Our agent of that name, told of the stations, does the same from its belief.
"""

NEAREST_VIEW = "nearest-view"
"""Stands among the agents' names for ``nearest-frontier`` that is not told of the way-points.

It goes to the nearest place anywhere from which some frontier can be seen.
"""

_MOST_HOPS = 1000
_TRIES = 12  # nearest way-points from which a goal is looked at before the agent counts as stuck
_AROUND_M = 8.0  # a way-point that does not see the goal counts as so much farther from it

# A body that passes where one cell is free, and is as wide as a gap worth looking into: two cells.
_ROBOT = RobotConfig(length_m=0.1, width_m=0.8)
_LIDAR = LidarConfig(beams=720, range_max_m=RANGE_M, offset_m=0.0)
# Frontiers count as in sight from 16 m, as in the benchmark; and a metre costs a metre, near walls, too.
_SETTINGS: dict[str, Any] = {
    "frontiers": {
        "min_extent_m": 0.8, "far_extent_m": 0.8, "min_unknown_m2": 0.5, "min_unknown_width_m": CELL_M,
        "spacing_m": 1.6, "view_range_m": 16.0, "beyond_m": CELL_M,
    },
    "planner": {
        "resolution_m": CELL_M, "unknown_margin_m": 0.0, "preferred_m": 0.1, "near_cost": 0.0, "tight_cost": 0.0,
        "path_spacing_m": CELL_M,
    },
    "stations": {"spacing_m": STRIDE * CELL_M, "hop": HOP},
}  # fmt: skip


def make_agent(name: str, extent_m: tuple[float, float] | None = None, *, sensor: str = SENSORS[0]) -> Agent:
    """Return an agent set up for this world, with as much of the setting as its configuration has.

    ``extent_m`` is how far the map reaches along x and y from the frame's origin.
    """
    told = name != NEAREST_VIEW
    name = name if told else "nearest-frontier"
    config = getattr(agents.make(name), "config", None)
    known = {f.name for f in fields(config)} if is_dataclass(config) else set()
    settings = {key: value for key, value in _SETTINGS.items() if key in known and (told or key != "stations")}
    if "stations" in settings:
        settings["stations"] = settings["stations"] | {"sensor": sensor}
    if extent_m is not None and "extent" in known:
        settings["extent"] = (0.0, 0.0, *extent_m)
    return agents.make(name, config=settings or None, robot=_ROBOT, lidar=_LIDAR)


def explore(
    dungeon: Dungeon, name: str, *, scan: str = SCANS[0], sensor: str = SENSORS[0], seed: int = 0
) -> dict[str, Any]:
    """Run one agent on one map; return what became of it.

    Returns
    -------
    dict
        ``path_m`` the sum of the hops; ``hops``; ``coverage`` the share of the free cells that were seen;
        ``unseen_cells``; ``end``: ``covered`` (no way-point is worth a visit), the agent's own word where it left
        off before, ``stuck`` (a goal that no way-point serves) or ``hop limit``; ``path_to_250_m`` the path until
        at most 250 free cells were unseen, ``None`` where it never came to that.
    """
    run = _Run(dungeon, continuous=scan == "continuous", sensor=sensor)
    rows, cols = dungeon.free.shape
    agent = None if name == NEAREST else make_agent(name, (cols * CELL_M, rows * CELL_M), sensor=sensor)
    if agent is not None:
        agent.reset(run.belief(), seed)
    decisions: list[float] = []
    end = "hop limit"
    for _ in range(_MOST_HOPS):
        run.look()
        if not run.worth.any():
            end = "covered"
            break
        if agent is None:
            run.hop_towards(run.nearest())
            continue
        belief = run.belief()
        agent.looked(belief)
        asked = time.perf_counter()
        goal = agent.choose(belief)
        decisions.append(1e3 * (time.perf_counter() - asked))
        if goal is None:
            end = agent.status if agent.status != "covered" else "nothing left"
            break
        station = run.station_for(goal)
        if station < 0:
            end = "stuck"
            break
        run.hop_towards(station)
    total = int(dungeon.free.sum())
    return {
        "agent": name,
        "map": dungeon.name,
        "path_m": run.path_m,
        "hops": run.hops,
        "coverage": 1.0 - run.unseen / total,
        "unseen_cells": run.unseen,
        "end": end,
        "path_to_250_m": run.path_to_250_m,
        "decision_ms_median": statistics.median(decisions) if decisions else None,
    }


class _Run:
    """The robot on its way: where it is, what is known, how far it has come."""

    def __init__(self, dungeon: Dungeon, *, continuous: bool, sensor: str) -> None:
        self._dungeon, self._continuous, self._sensor = dungeon, continuous, sensor
        self.known: NDArray[np.int8] = np.full(dungeon.free.shape, UNKNOWN, dtype=np.int8)
        self._visited = np.zeros(dungeon.free.shape, dtype=np.bool_)
        self._cell = dungeon.start
        self._heading = 0.0
        self.path_m, self.hops, self.unseen = 0.0, 0, int(dungeon.free.sum())
        self.path_to_250_m: float | None = None
        self._scan()

    def _scan(self) -> None:
        scan(self._dungeon.free, *self._cell, self.known, self._sensor)

    def look(self) -> None:
        """Take stock of what is known now."""
        self._visited[self._cell] = True
        self.unseen = int(np.count_nonzero(self._dungeon.free & (self.known != FREE)))
        if self.path_to_250_m is None and self.unseen <= 250:
            self.path_to_250_m = self.path_m
        self.lattice = Lattice(self.known, self._dungeon.start)
        self._here = self.lattice.index(*self._cell)
        self._length, self._before = self.lattice.ways(self._here)
        self.worth = self.lattice.worth_a_visit(np.isfinite(self._length), self._visited)

    def belief(self) -> Belief:
        """Return what the agent may know, in the map's frame; the grid ends where knowledge does."""
        rows, cols = (np.flatnonzero((self.known != UNKNOWN).any(axis=axis)) for axis in (1, 0))
        low = int(rows[0]), int(cols[0])
        part = self.known[low[0] : int(rows[-1]) + 1, low[1] : int(cols[-1]) + 1]
        origin = low[1] * CELL_M, low[0] * CELL_M
        pose = np.array([*self._point(self._cell), self._heading])
        grid = OccupancyGrid.from_classes(part, CELL_M, origin)
        return Belief.without_landmarks(pose, np.zeros((3, 3)), grid)

    def _point(self, cell: tuple[int, int]) -> Array:
        """Return the centre (x, y) [m] of a cell."""
        return np.array([cell[1] + 0.5, cell[0] + 0.5]) * CELL_M

    def station_for(self, goal: Goal) -> int:
        """Return the way-point that comes nearest to serving a goal, or −1 when all that could were looked from.

        A second look from one place shows nothing new: who still wants to go there has not seen from it what it
        is after, and is given the next nearest.
        """
        cells = self.lattice.cells
        at = np.floor(np.asarray(goal.pose[1::-1], dtype=np.float64) / CELL_M).astype(np.int64)
        target = np.clip(at, 0, np.array(self.known.shape) - 1)
        away = np.hypot(*(cells - target).T) * CELL_M
        for i in range(len(cells)):
            if not line_is_free(self.known, int(target[0]), int(target[1]), int(cells[i, 0]), int(cells[i, 1])):
                away[i] += _AROUND_M
        away[~np.isfinite(self._length)] = math.inf
        nearest = np.argsort(away, kind="stable")[:_TRIES]
        left = nearest[np.isfinite(away[nearest]) & ~self._visited[tuple(cells[nearest].T)]]
        return int(left[0]) if len(left) else -1

    def nearest(self) -> int:
        """Return the nearest way-point that is worth a visit; one is."""
        return int(np.argmin(np.where(self.worth, self._length, math.inf)))

    def hop_towards(self, station: int) -> None:
        """Make the first hop of the way to a way-point, and scan there."""
        while self._before[station] != self._here:
            station = int(self._before[station])
        target = int(self.lattice.cells[station, 0]), int(self.lattice.cells[station, 1])
        d_row, d_col = target[0] - self._cell[0], target[1] - self._cell[1]
        self.path_m += math.hypot(d_row, d_col) * CELL_M
        self.hops += 1
        self._heading = math.atan2(d_row, d_col)
        count = max(abs(d_row), abs(d_col))
        begun = self._cell
        for i in range(1 if self._continuous else count, count + 1):
            share = i / count
            self._cell = math.floor(begun[0] + share * d_row + 0.5), math.floor(begun[1] + share * d_col + 0.5)
            self._scan()
