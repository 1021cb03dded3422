"""Lessons for the learned tour: what it cost, in the end, to begin a tour otherwise.

On plans that the benchmark has not (:mod:`training.dungeon_plans`) an episode is driven by the tour over what is
known, now and then by a hop drawn at random. At some of its stops every opening is tried out: from there the first
hop is made and the tour goes on to the end, on the true plan. How much longer one opening made the path than
another is the lesson; averaged over many plans it is what a robot that does not know the plan may expect. (A step
of policy iteration with rollouts: Bertsekas, "Rollout algorithms", 1997.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.routing import draw_luck
from agents.station_network import SIDE, Picture, picture, pixels
from agents.station_survey import Openings, Survey, begin, find_pieces, first_hop, no_pieces, options, survey
from slam.formats import replacing
from slam.occupancy import FREE, OCCUPIED, UNKNOWN
from training.campaign import run_all
from training.dungeon_plans import dungeon_plan
from training.dungeon_world import CELL_M, TREE, Dungeon, look, scan

__all__ = ["MOST", "Lessons", "Walk", "gather", "lessons_of", "read_lessons", "rest_of_the_tour"]

Array = NDArray[np.float64]
Cells = NDArray[np.int64]

MOST = 5
"""Openings that are weighed at a stop."""
MOST_LOSS_M = 40.0
"""What by the tour itself is worse by more is not tried."""
REACH = 30.0
"""Cells from which the tour counts a piece of frontier as settled: 12 m."""
LUCK = draw_luck(6, 700)
"""Covers that the tour is chosen from; the first two, where it is driven to the end."""

_ASKED = 0.4  # share of the stops that lessons are drawn from
_AT_RANDOM = 0.1  # share of the hops that are drawn at random
_STREAM = 5
_MOST_HOPS = 400


@dataclass(frozen=True, eq=False)
class Lessons:
    """Stops ``(n,)``, and what became of the openings at each; those beyond the last are NaN in ``path_m``."""

    planes: NDArray[
        np.uint8
    ]  # (n, 13, SIDE, SIDE) the picture × 100, but its last plane, which follows from the rest
    free: NDArray[np.uint8]  # (n, 4, SIDE, SIDE) free cells of the true plan in each quarter of a pixel
    targets: NDArray[np.int64]  # (n, MOST, 2) pixels
    hops: NDArray[np.int64]  # (n, MOST, 2) pixels
    losses_m: NDArray[np.float32]  # (n, MOST) by what was known
    legs_m: NDArray[np.float32]  # (n, MOST)
    path_m: NDArray[np.float32]  # (n, MOST) to the end


class Walk:
    """A robot on a plan: where it is and what it has seen."""

    def __init__(self, plan: Dungeon) -> None:
        self.plan, self.cell, self.path_m = plan, plan.start, 0.0
        self.known: NDArray[np.int8] = np.full(plan.free.shape, UNKNOWN, dtype=np.int8)
        self.visited = np.zeros(plan.free.shape, dtype=np.bool_)
        self.pieces = no_pieces(plan.free.shape)
        self._look()

    def hop(self, cell: tuple[int, int]) -> None:
        """Go straight to a station's cell, and look."""
        self.path_m += math.hypot(cell[0] - self.cell[0], cell[1] - self.cell[1]) * CELL_M
        self.cell = cell
        self._look()

    def survey(self) -> Survey:
        """Return what there is to do."""
        return survey(self.known, self.pieces, self.visited, self.plan.start, self.cell, CELL_M, REACH)

    def rest_m(self, hop: tuple[int, int]) -> float:
        """Return how long the path is from here [m] if the tour goes on after a hop; nothing here changes."""
        length = math.hypot(hop[0] - self.cell[0], hop[1] - self.cell[1]) * CELL_M
        known, pieces, visited = self.known.copy(), self.pieces.copy(), self.visited.copy()
        find_pieces(known, pieces, scan(self.plan.free, *hop, known))
        return length + rest_of_the_tour(
            self.plan.free, self.plan.start, hop, known, pieces, visited, LUCK[:2], CELL_M, REACH, TREE
        )

    def _look(self) -> None:
        self.visited[self.cell] = True
        find_pieces(self.known, self.pieces, scan(self.plan.free, *self.cell, self.known))


@njit(cache=True, nogil=True)
def rest_of_the_tour(
    free: NDArray[np.bool_], first: tuple[int, int], robot: tuple[int, int], known: NDArray[np.int8], pieces:
    Cells, visited: NDArray[np.bool_], luck: Array, cell_m: float, reach: float, tree: NDArray[np.int32],
) -> float:  # fmt: skip
    """Return the length [m] of the tour's path to the end; ``known``, ``pieces`` and ``visited`` are used up."""
    total = 0.0
    visited[robot[0], robot[1]] = True
    for _ in range(_MOST_HOPS):
        found = survey(known, pieces, visited, first, robot, cell_m, reach)
        if not found.worth.any():
            break
        target = found.places[begin(found, luck)]
        cell = found.cells[first_hop(found.before, found.places[0], target)]
        total += math.hypot(cell[0] - robot[0], cell[1] - robot[1]) * cell_m
        robot = (cell[0], cell[1])
        visited[cell[0], cell[1]] = True
        find_pieces(known, pieces, look(free, cell[0], cell[1], tree, known))
    return total


def lessons_of(seed: int) -> Lessons:
    """Drive one episode on the plan of a seed, and return the lessons drawn on the way."""
    walk, rng = Walk(dungeon_plan(seed)), np.random.default_rng([_STREAM, seed])
    drawn: list[tuple[NDArray[Any], ...]] = []
    for _ in range(_MOST_HOPS):
        found = walk.survey()
        if not found.worth.any():
            break
        openings = options(found, LUCK, most=MOST, most_loss_m=MOST_LOSS_M)
        count = len(openings.targets)
        if count > 1 and rng.random() < _ASKED:
            drawn.append(_lesson(walk, found, openings))
        choice = int(rng.integers(count)) if rng.random() < _AT_RANDOM else 0
        walk.hop(_cell(found, int(openings.hops[choice])))
    if not drawn:
        return _none()
    return Lessons(*(np.stack(column) for column in zip(*drawn, strict=True)))


def _lesson(walk: Walk, found: Survey, openings: Openings) -> tuple[NDArray[Any], ...]:
    first, absent = walk.plan.start, MOST - len(openings.targets)
    paths = [walk.rest_m(_cell(found, int(hop))) for hop in openings.hops]
    shown = picture(walk.known, walk.visited, first, CELL_M, found)
    return (
        np.rint(100.0 * shown.planes[:-1]).astype(np.uint8),
        _true_share(walk, found, shown),
        np.pad(pixels(found.cells[openings.targets], first, shown), ((0, absent), (0, 0))),
        np.pad(pixels(found.cells[openings.hops], first, shown), ((0, absent), (0, 0))),
        np.pad(openings.losses, (0, absent)).astype(np.float32),
        np.pad(openings.legs, (0, absent)).astype(np.float32),
        np.pad(paths, (0, absent), constant_values=np.nan).astype(np.float32),
    )


def _true_share(walk: Walk, found: Survey, shown: Picture) -> NDArray[np.uint8]:
    """Return how many free cells of the plan lie in each quarter of each pixel ``(4, SIDE, SIDE)``."""
    truth = np.where(walk.plan.free, FREE, OCCUPIED).astype(np.int8)
    whole = picture(truth, walk.visited, walk.plan.start, CELL_M, found)
    shift = shown.corner - whole.corner
    out = np.zeros((4, SIDE, SIDE), dtype=np.uint8)
    own = [slice(max(-s, 0), SIDE - max(s, 0)) for s in shift]
    theirs = [slice(max(s, 0), SIDE - max(-s, 0)) for s in shift]
    out[:, own[0], own[1]] = np.rint(25.0 * whole.planes[:4, theirs[0], theirs[1]])
    return out


def _cell(found: Survey, station: int) -> tuple[int, int]:
    return int(found.cells[station, 0]), int(found.cells[station, 1])


def _none() -> Lessons:
    return Lessons(
        planes=np.zeros((0, 13, SIDE, SIDE), np.uint8),
        free=np.zeros((0, 4, SIDE, SIDE), np.uint8),
        targets=np.zeros((0, MOST, 2), np.int64),
        hops=np.zeros((0, MOST, 2), np.int64),
        losses_m=np.zeros((0, MOST), np.float32),
        legs_m=np.zeros((0, MOST), np.float32),
        path_m=np.zeros((0, MOST), np.float32),
    )


# ---- on disk ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Job:
    seed: int
    path: Path


def gather(folder: Path, seeds: range, *, workers: int = 1) -> None:
    """Write the lessons of each seed that the folder does not hold yet, a file a plan.

    Raises
    ------
    Interrupted
        On Ctrl-C.
    """
    folder.mkdir(parents=True, exist_ok=True)
    jobs = [_Job(seed, _file(folder, seed)) for seed in seeds if not _file(folder, seed).exists()]
    if jobs:
        run_all(jobs, _write, workers=workers, keep=lambda _job, _result: None, what="plans")


def read_lessons(folder: Path, seeds: range) -> Lessons:
    """Return the lessons of all seeds, which :func:`gather` has written."""
    parts = []
    for seed in seeds:
        with np.load(_file(folder, seed), allow_pickle=False) as file:
            parts.append(Lessons(**file))
    return Lessons(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in Lessons.__dataclass_fields__)
    )


def _file(folder: Path, seed: int) -> Path:
    return folder / f"{seed:06d}.npz"


def _write(job: _Job) -> None:
    lessons = lessons_of(job.seed)
    with replacing(job.path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **{name: getattr(lessons, name) for name in Lessons.__dataclass_fields__})
