"""What the end-to-end policy remembers: the whole map, what it made of it, and where it got no further.

A map in the belief's frame that grows with the belief's own (Neural Map: Parisotto and Salakhutdinov, 2018). The
convolutions' answers are kept in it, and made anew only around what was drawn since. The planning layer finds ways
over all of it, so that what was left behind in a large building is not forgotten.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.learned.drive_plan import descend, distances, node_prices
from agents.ways.boxes import Box, carried
from slam.belief import Belief
from slam.grids.occupancy import PROBABILITY_BYTE, OccupancyGrid
from slam.types import Array, Bytes, Flags, Floats

__all__ = ["CELL_M", "CHANNELS", "LOG_PRICES", "MARGIN", "MapMemory", "Plan", "PlanSettings", "draw_memory"]

CELL_M = 0.1
"""Side of a pixel of the memory [m], or the next power of two of the grid's cells below it."""
CHANNELS = 4
"""Probability of a surface, share that is known, share that is free, nearness of where the robot has been."""
LOG_PRICES = (0.0, 3.5)
"""Bounds of the log price of a metre."""
MARGIN = 9
"""Pixels that the convolutions see beyond one."""
PATH_POINTS = 10
PATH_STEP_M = 0.2
_REFRESH_S = 0.5  # between two looks at the map
_REACH_M = 3.2  # from which on a place counts as never come near
_LEAVES_M = 0.4  # around where it stands
_MOVED_M = 1.0  # that it drives between two looks, and half its body
_HERE_M = 0.3  # nearer goals are none: from here the robot looks already
_KEPT_M = 0.6  # around the goal that it is on the way to
_STALLS_M = 1.2  # around the goal that it does not come nearer to
_STALL_S = 2.0  # that it may take to, before the goal is doubted
_HOPE_S = 10.0  # … and before it is held for none
_WALL = 3.0  # log price from which on the robot's middle cannot be there: a way ends before, and looks from there
_NEARER = 0.2  # price [m] that a way must fall by in a second, for that


class PlanSettings(NamedTuple):
    """Numbers of the planning layer that are set with the network."""

    goal_m: float = 8.0  # what a goal costs per nat of doubt [m]
    keep_m: float = 1.5  # how much cheaper the goal is that it is on the way to [m]: no dithering between two
    stall_m: float = 4.0  # how much dearer one gets for each second on the way that comes no nearer [m]


class Plan(NamedTuple):
    """What the planning layer says."""

    path: Array  # (n, 2) [m] forward, left of the robot, from the robot on
    cost: float  # of the way, its goal included [m]
    likely: bool  # whether its end is rather a goal than none
    prices: Floats  # (PATH_POINTS,) log price of a metre at each of the resampled points
    points: Floats  # (PATH_POINTS, 2) the path resampled [m]
    length: float  # of the path [m]


class MapMemory:
    """The map as the network reads it, and the ways over it.

    Parameters
    ----------
    read : callable
        The network's convolutions: of a map ``(CHANNELS, n, m)`` log prices and goals' log odds ``(2, n, m)``.
    settings : PlanSettings
        Of the planning layer.
    step_s : float
        Time between two calls of :meth:`way` [s].
    """

    def __init__(self, read: Callable[[Bytes], Floats], settings: PlanSettings, *, step_s: float = 0.1) -> None:
        self._read_map, self._settings, self._step_s = read, settings, step_s
        self._every = max(round(_REFRESH_S / step_s), 1)
        self._calls, self._drawing = 0, -1
        self._grid: OccupancyGrid | None = None
        self._frame = (0, 0, 0, 0)  # lattice row and column of the first cell, rows and columns of pixels
        self._log_price = self._goal_m = np.zeros((0, 0), np.float32)  # as read; what ending there costs by that
        self._stalled = np.zeros((0, 0), np.float32)  # [s] on the way there without coming nearer
        self._target: tuple[float, float] | None = None  # where the way led [m]

    def way(self, belief: Belief) -> Plan:
        """Return the way on from where the robot is; every so often the map is looked at again."""
        if self._calls % self._every == 0:
            self._refresh(belief)
        self._calls += 1
        return self._way_from(np.asarray(belief.pose, dtype=np.float64))

    # ---- remembering ---------------------------------------------------------------------------------------

    def _refresh(self, belief: Belief) -> None:
        pose = np.asarray(belief.pose, dtype=np.float64)
        x, y = pose[:2].tolist()
        stalled_s = self._stalled_for(pose)
        self._read(belief.grid, x, y)
        if self._target is not None:
            place, distance = self._away(*self._target, _STALLS_M)
            self._stalled[place] += np.float32(stalled_s) * (distance < _STALLS_M)
        self._window = _used(self._known)
        goal = self._goal_m + np.float32(self._settings.stall_m) * np.maximum(
            self._stalled - np.float32(_STALL_S), 0.0
        )
        hopeful = (self._goal_m < self._settings.goal_m * math.log(2.0)) & (self._stalled < _HOPE_S)
        self._likely = hopeful[self._window]
        if self._target is not None:
            kept, distance = self._away(*self._target, _KEPT_M)
            goal[kept] -= np.float32(self._settings.keep_m) * (distance < _KEPT_M)
        here, distance = self._away(x, y, _HERE_M)
        goal[here] = np.where(distance < _HERE_M, np.float32(1e6), goal[here])
        price = np.exp(self._log_price[self._window])
        self._best, self._parent = distances(node_prices(price, self._cell), goal[self._window].copy())
        self._cost_then = float(self._best[self._pixel(pose)])

    def _stalled_for(self, pose: Array) -> float:
        """Return the time since the last look, less what getting nearer to the goal since then may take [s]."""
        if self._target is None:
            return 0.0
        nearer = self._cost_then - float(self._best[self._pixel(pose)])
        return max(self._every * self._step_s - max(nearer, 0.0) / _NEARER, 0.0)

    def _read(self, grid: OccupancyGrid, x: float, y: float) -> None:
        """Let the network read what has changed since it last looked: what was drawn, and where it came near."""
        block = 1 << max(math.floor(math.log2(CELL_M / grid.resolution + 1e-9)), 0)
        shape = grid.shape[0] // block, grid.shape[1] // block
        frame = (*grid.lattice_origin, *shape)
        whole = grid is not self._grid or frame != self._frame
        if whole:
            row, col = (self._frame[0] - frame[0]) // block, (self._frame[1] - frame[1]) // block
            old, new = Box(0, 0, *self._stalled.shape).moved(row, col), Box(0, 0, *shape)
            self._stalled = carried(self._stalled, old, new, old.within(new), 0.0)
            self._log_price, self._goal_m = np.zeros((2, *shape), np.float32)
        box = (n // block for n in grid.drawn_since(self._drawing))
        self._grid, self._frame, self._drawing = grid, frame, grid.drawings
        self._cell, self._origin = block * grid.resolution, np.array(grid.origin)
        maps = draw_memory(grid, block)
        self._known = maps[1] > 0
        r0, c0, r1, c1 = (0, 0, *shape) if whole else box
        rows, cols = self._away(x, y, _REACH_M + _MOVED_M)[0]
        r0, c0 = max(min(r0, rows.start) - MARGIN, 0), max(min(c0, cols.start) - MARGIN, 0)
        r1, c1 = min(max(r1, rows.stop) + MARGIN, shape[0]), min(max(c1, cols.stop) + MARGIN, shape[1])
        # The convolutions look around what they answer for.
        top, left = max(r0 - MARGIN, 0), max(c0 - MARGIN, 0)
        said = self._read_map(maps[:, top : r1 + MARGIN, left : c1 + MARGIN])
        said = said[:, r0 - top : r1 - top, c0 - left : c1 - left]
        self._log_price[r0:r1, c0:c1] = np.clip(said[0], *LOG_PRICES)
        self._goal_m[r0:r1, c0:c1] = np.float32(self._settings.goal_m) * np.logaddexp(np.float32(0.0), -said[1])

    def _away(self, x: float, y: float, within_m: float) -> tuple[tuple[slice, slice], Floats]:
        """Return a window around a place [m], and its pixels' distances to that [m]."""
        cell, n = self._cell, math.ceil(within_m / self._cell) + 1
        col, row = (math.floor(v) for v in ((np.array([x, y]) - self._origin) / cell))
        (r0, r1), (c0, c1) = (
            (min(max(at - n, 0), size), min(max(at + n + 1, 0), size))
            for at, size in zip((row, col), self._stalled.shape, strict=True)
        )
        dy = (np.arange(r0, r1) + 0.5) * cell + self._origin[1] - y
        dx = (np.arange(c0, c1) + 0.5) * cell + self._origin[0] - x
        return (slice(r0, r1), slice(c0, c1)), np.hypot(dy[:, None], dx[None]).astype(np.float32)

    # ---- planning ------------------------------------------------------------------------------------------

    @property
    def _corner(self) -> Array:
        """Of the part that is planned on [m]."""
        rows, cols = self._window
        return np.asarray(self._origin + self._cell * np.array([cols.start, rows.start]))

    def _pixel(self, pose: Array) -> tuple[int, int]:
        """Return row and column of a place in that part."""
        col, row = ((pose[:2] - self._corner) / self._cell).astype(np.int64).tolist()
        rows, cols = self._best.shape
        return min(max(row, 0), rows - 1), min(max(col, 0), cols - 1)

    def _way_from(self, pose: Array) -> Plan:
        start = self._pixel(pose)
        way = descend(self._parent, *start)
        places = self._corner + (way[:, ::-1] + 0.5) * self._cell
        self._target = float(places[-1, 0]), float(places[-1, 1])
        likely = bool(self._likely[tuple(way[-1])])
        along = self._log_price[self._window][way[:, 0], way[:, 1]]
        # From where it stands it may leave, whatever that is.
        walls = np.flatnonzero((along > _WALL) & (np.hypot(*(places - pose[:2]).T) > _LEAVES_M))
        way, places = (v[: max(walls[0], 1)] if len(walls) else v for v in (way, places))
        c, s = math.cos(pose[2]), math.sin(pose[2])
        path = _smooth((places - pose[:2]) @ np.array([[c, -s], [s, c]]))
        arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
        reached = np.minimum(np.arange(1, PATH_POINTS + 1) * PATH_STEP_M, arc[-1])
        points = np.stack([np.interp(reached, arc, path[:, k]) for k in (0, 1)], axis=1)
        # The pixels of the way nearest to the points: where it is smoothed it leaves them by less than one.
        nearest = np.minimum(np.searchsorted(arc, reached), len(way) - 1)
        cost, length = float(self._best[start]), float(arc[-1])
        return Plan(path, cost, likely, along[nearest], points.astype(np.float32), length)


def draw_memory(grid: OccupancyGrid, block: int) -> Bytes:
    """Return the whole grid as the network is shown it ``(CHANNELS, n, m)``, ``block`` cells a pixel's side."""
    rows, cols = (n // block for n in grid.shape)
    out = np.empty((CHANNELS, rows, cols), np.uint8)
    _draw(grid.log_odds, grid.visited, block, out)
    away = cv2.distanceTransform(out[3], cv2.DIST_L2, 3) * np.float32(block * grid.resolution / _REACH_M)
    out[3] = 255.0 * np.maximum(1.0 - away, 0.0)
    return out


@njit(cache=True, nogil=True)
def _draw(log_odds: NDArray[np.int8], visited: Bytes, block: int, out: Bytes) -> None:
    area = block * block
    for r in range(out.shape[1]):
        for c in range(out.shape[2]):
            most, known, free, been = 0, 0, 0, 0
            for i in range(r * block, (r + 1) * block):
                for j in range(c * block, (c + 1) * block):
                    odds = log_odds[i, j]
                    been |= visited[i, j]
                    if odds != 0:
                        known += 1
                        free += odds < 0
                        most = max(most, PROBABILITY_BYTE[np.uint8(odds)])
            out[0, r, c] = most if known else 128
            out[1, r, c] = 255 * known // area
            out[2, r, c] = 255 * free // area
            out[3, r, c] = 0 if been else 1


def _used(known: Flags) -> tuple[slice, slice]:
    """Return the rows and columns in which anything is known, and a margin."""
    whole = Box(0, 0, *known.shape)
    used = Box.of(known).grown(MARGIN).within(whole)
    return (whole if used.empty else used).slices


def _smooth(path: Array) -> Array:
    """Return the path from the robot on, its steps' corners taken off."""
    path = np.vstack([np.zeros(2), path[1:]])
    if len(path) < 3:
        return path if len(path) > 1 else np.zeros((2, 2))
    padded = np.vstack([np.repeat(path[:1], 3, axis=0), path, np.repeat(path[-1:], 3, axis=0)])
    kernel = np.full(7, 1.0 / 7.0)
    out = np.stack([np.convolve(padded[:, k], kernel, mode="valid") for k in (0, 1)], axis=1)
    out[0], out[-1] = path[0], path[-1]
    return np.asarray(out)
