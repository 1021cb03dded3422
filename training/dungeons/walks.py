"""Robots that hop over stations of a plan, many at once: how the paths end that lessons are drawn from.

What goes on after a choice is a *driver*: the tour over what is known, one compiled kernel, or a network, which is
asked for many robots together, as that is several times as fast.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray

from agents.learned.station_network import (
    PLANES,
    SIDE,
    Picture,
    opening_numbers,
    outside,
    picture,
    pixels,
    with_walls,
)
from agents.stations.sensor import BLIND, SENSORS, Rays, look, rays
from agents.stations.survey import Openings, Survey, begin, find_pieces, first_hop, no_pieces, options, survey
from agents.ways.routing import draw_luck
from slam.grids.occupancy import UNKNOWN
from slam.types import Array, Cells, Floats
from training.dungeons.networks import StationNetwork, read_network
from training.dungeons.world import CELL_M, Dungeon, scan

__all__ = [
    "BLIND_REACH", "LUCK", "MOST", "REACH", "LearnedDriver", "Stop", "TourDriver", "Walk", "rest_of_the_tour",
]  # fmt: skip

MOST = 5
"""Openings that are weighed at a stop."""
MOST_LOSS_M = 40.0
"""What by the tour itself is worse by more is not tried."""
REACH = 30.0
"""Cells from which the tour counts a piece of frontier in sight as settled: 12 m."""
BLIND_REACH = 36.0
"""The same, where the tour does not foresee what a look shows: with that it is shortest on plans 1000-1199."""
LUCK = draw_luck(6, 700)
"""Covers that the tour is chosen from; the first two, where it is driven to the end."""

MOST_HOPS = 400
_TOGETHER = 64  # robots that the network is asked for at once


@dataclass(frozen=True, eq=False)
class Stop:
    """A robot that has something to do, and what it may begin with."""

    walk: Walk
    found: Survey
    openings: Openings

    def hop_cell(self, choice: int) -> tuple[int, int]:
        """Return the cell that an opening's first hop goes to."""
        row, col = self.found.cells[self.openings.hops[choice]]
        return int(row), int(col)

    def drawn(self) -> Picture:
        """Return what is known, as a picture; walls beyond the plan are not drawn."""
        return picture(self.walk.known, self.walk.visited, self.walk.plan.start, CELL_M, self.found)

    def beyond(self, shown: Picture) -> Floats:
        """Return what of the picture lies outside of the plan ``(4, SIDE, SIDE)``."""
        return outside(shown, self.walk.plan.start, (0, 0, *self.walk.plan.free.shape))

    def places(self, shown: Picture) -> tuple[Cells, Cells]:
        """Return the pixels of the openings' targets and first hops, ``(c, 2)`` each."""
        start, cells = self.walk.plan.start, self.found.cells
        return pixels(cells[self.openings.targets], start, shown), pixels(cells[self.openings.hops], start, shown)


class Walk:
    """A robot on a plan: where it is and what it has seen."""

    def __init__(self, plan: Dungeon) -> None:
        self.plan, self.cell, self.path_m = plan, plan.start, 0.0
        self.known: NDArray[np.int8] = np.full(plan.free.shape, UNKNOWN, dtype=np.int8)
        self.visited = np.zeros(plan.free.shape, dtype=np.bool_)
        self.pieces = no_pieces(plan.free.shape)
        self.decided_at: set[tuple[int, int]] = set()  # stations, since anything new was seen
        self._known_cells = 0
        self._look()

    def hop(self, cell: tuple[int, int]) -> None:
        """Go straight to a station's cell, and look."""
        self.path_m += math.hypot(cell[0] - self.cell[0], cell[1] - self.cell[1]) * CELL_M
        self.cell = cell
        self._look()

    def after(self, cell: tuple[int, int]) -> Walk:
        """Return another robot that has made a hop from here, its path counted from here; nothing here changes."""
        other = copy.copy(self)
        other.known, other.pieces, other.visited = self.known.copy(), self.pieces.copy(), self.visited.copy()
        other.decided_at = set(self.decided_at)
        other.path_m = 0.0
        other.hop(cell)
        return other

    def stop(self) -> Stop | None:
        """Return what there is to choose from, ``None`` at the end."""
        found = self.survey()
        if not found.worth.any():
            return None
        return Stop(self, found, options(found, LUCK, most=MOST, most_loss_m=MOST_LOSS_M))

    def is_news(self) -> bool:
        """Whether no choice was made here with no more known (see :class:`agents.learned_tour.LearnedTour`)."""
        count = int(np.count_nonzero(self.known != UNKNOWN))
        if count != self._known_cells:
            self._known_cells, self.decided_at = count, set()
        news = self.cell not in self.decided_at
        self.decided_at.add(self.cell)
        return news

    def survey(self) -> Survey:
        """Return what there is to do."""
        sensor, start = rays(SENSORS[0]), self.plan.start
        return survey(self.known, self.pieces, self.visited, start, self.cell, CELL_M, REACH, sensor)

    def _look(self) -> None:
        self.visited[self.cell] = True
        find_pieces(self.known, self.pieces, scan(self.plan.free, *self.cell, self.known))


@njit(cache=True, nogil=True)
def rest_of_the_tour(
    free: NDArray[np.bool_], first: tuple[int, int], robot: tuple[int, int], known: NDArray[np.int8], pieces:
    Cells, visited: NDArray[np.bool_], luck: Array, cell_m: float, reach: float, sensor: Rays,
) -> float:  # fmt: skip
    """Return the length [m] of the tour's path to the end; ``known``, ``pieces`` and ``visited`` are used up."""
    total = 0.0
    visited[robot[0], robot[1]] = True
    for _ in range(MOST_HOPS):
        found = survey(known, pieces, visited, first, robot, cell_m, reach, BLIND)
        if not found.worth.any():
            break
        cell = found.cells[first_hop(found.before, found.places[0], begin(found, luck))]
        total += math.hypot(cell[0] - robot[0], cell[1] - robot[1]) * cell_m
        robot = (cell[0], cell[1])
        visited[cell[0], cell[1]] = True
        find_pieces(known, pieces, look(free, cell[0], cell[1], sensor, known))
    return total


class TourDriver:
    """Goes on with the tour over what is known."""

    stream = 5
    """Number that the draws of an episode begin with."""
    asked = 0.4
    """Share of the stops that lessons are drawn from."""

    def choose(self, stops: Sequence[Stop]) -> list[int]:
        """Return the opening to take at each stop: the first is the best tour."""
        return [0] * len(stops)

    def finish(self, walks: Sequence[Walk]) -> list[float]:
        """Drive all robots to the end; return the lengths of their paths [m]. What they know is used up."""
        return [
            walk.path_m
            + rest_of_the_tour(
                walk.plan.free, walk.plan.start, walk.cell, walk.known, walk.pieces, walk.visited, LUCK[:2],
                CELL_M, BLIND_REACH, rays(SENSORS[0]),
            )
            for walk in walks
        ]  # fmt: skip


class LearnedDriver(TourDriver):
    """Goes on as ``learned-tour`` does that knows how far the plan extends; in PyTorch and half precision."""

    stream, asked = 9, 0.5
    most_hops = MOST_HOPS
    """Hops that a robot is driven to its end by, at most."""

    def __init__(self, network: StationNetwork) -> None:
        halved = copy.deepcopy(network).to(torch.bfloat16)
        self._network = halved.to(memory_format=torch.channels_last).eval()  # type: ignore[call-overload]

    @classmethod
    def read(cls, weights: bytes) -> LearnedDriver:
        """Return the driver of a file of weights, without what only training needs."""
        return cls(read_network(weights))

    def choose(self, stops: Sequence[Stop]) -> list[int]:
        """Return the opening to take at each stop."""
        choices = [0] * len(stops)
        asked = [k for k, stop in enumerate(stops) if stop.walk.is_news() and len(stop.openings.targets) > 1]
        if not asked:
            return choices
        planes = np.empty((len(asked), PLANES, SIDE, SIDE), np.float32)
        targets, hops = (np.zeros((len(asked), MOST, 2), np.int64) for _ in range(2))
        numbers = np.zeros((len(asked), MOST, 3), np.float32)
        for i, k in enumerate(asked):
            stop, count = stops[k], len(stops[k].openings.targets)
            shown = stop.drawn()
            planes[i] = with_walls(shown.planes, stop.beyond(shown))
            targets[i, :count], hops[i, :count] = stop.places(shown)
            numbers[i, :count] = opening_numbers(stop.openings.losses, stop.openings.legs)
        with torch.inference_mode():
            images = torch.tensor(planes, dtype=torch.bfloat16).contiguous(memory_format=torch.channels_last)
            told = torch.tensor(numbers, dtype=torch.bfloat16)
            scores = self._network(images, torch.tensor(targets), torch.tensor(hops), told)[0].float().numpy()
        for i, k in enumerate(asked):
            choices[k] = int(np.argmin(scores[i, : len(stops[k].openings.targets)]))
        return choices

    def finish(self, walks: Sequence[Walk]) -> list[float]:
        """Drive all robots to the end, some of them together; return the lengths of their paths [m]."""
        waiting, hops = list(range(len(walks)))[::-1], [0] * len(walks)
        driven: list[int] = []
        while waiting or driven:
            while waiting and len(driven) < _TOGETHER:
                driven.append(waiting.pop())
            at = [(k, walks[k].stop()) for k in driven if hops[k] < self.most_hops]
            left = [(k, stop) for k, stop in at if stop is not None]
            for (k, stop), choice in zip(left, self.choose([stop for _, stop in left]), strict=True):
                walks[k].hop(stop.hop_cell(choice))
                hops[k] += 1
            driven = [k for k, _ in left]
        return [walk.path_m for walk in walks]
