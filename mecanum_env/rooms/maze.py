"""Mazes with many ways round: a perfect maze on a grid, some of whose walls are taken out again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from mecanum_env.rooms.floor_plan import FloorPlan, clearance_of
from mecanum_env.rooms.layout.assembly import START_M, choose_start, generator, unreached
from mecanum_env.rooms.layout.furniture import CELL_M, Box, cells
from mecanum_env.rooms.outlines.rectilinear import raster, surfaces
from slam.settings import Config, Share, Span
from slam.types import Flags

__all__ = ["Grid", "MazeConfig", "draw_grid", "maze"]

_MARGIN = 4  # solid cells around the maze
_BRANCH = 0.2  # probability to go on from any place reached, not from the last one: shorter, more branched ways


@dataclass(frozen=True, kw_only=True)
class MazeConfig(Config):
    """Limits between which a maze is drawn, by seed."""

    columns: Annotated[tuple[int, int], Span("[2, 24]")] = (6, 8)
    rows: Annotated[tuple[int, int], Span("[2, 24]")] = (6, 8)
    # Width, drawn for each column and each row.
    corridor_m: Annotated[tuple[float, float], Span("[1.1, 4]")] = (1.2, 1.6)
    wall_m: Annotated[tuple[float, float], Span("[0.05, 1]")] = (0.1, 0.2)  # thickness, one for the maze
    loops: Share = 0.15  # share of the perfect maze's inner walls that are taken out


@dataclass(frozen=True, slots=True)
class Grid:
    """Which neighbouring cells of a maze are open to each other."""

    east: Flags  # (rows, columns - 1): from (row, column) to (row, column + 1)
    north: Flags  # (rows - 1, columns): from (row, column) to (row + 1, column)


def maze(config: MazeConfig, *, seed: int) -> FloorPlan:
    """Return the maze of a seed: the same one every time."""
    rng = generator(seed)
    columns, rows = (int(rng.integers(low, high + 1)) for low, high in (config.columns, config.rows))
    grid = draw_grid((columns, rows), config.loops, rng)
    wall = max(1, cells(float(rng.uniform(*config.wall_m))))
    spans_x, spans_y = (
        _spans([max(22, cells(float(w))) for w in rng.uniform(*config.corridor_m, count)], wall)
        for count in (columns, rows)
    )
    floors = _floors(grid, spans_x, spans_y)
    free = raster(floors, (spans_x[-1][1] + _MARGIN, spans_y[-1][1] + _MARGIN))
    clearance = clearance_of(free, CELL_M)
    reach, _ = unreached(free, clearance)
    return FloorPlan(
        name=f"maze-{seed}",
        walls=np.round(surfaces(floors) * CELL_M, 6),
        free=free,
        resolution=CELL_M,
        start=choose_start(clearance, reach, rng),
        start_clearance_m=START_M,
    )


def draw_grid(size: tuple[int, int], loops: float, rng: np.random.Generator) -> Grid:
    """Return a connected grid of ``size`` columns and rows, with a share of its inner walls taken out."""
    columns, rows = size
    grid = Grid(np.zeros((rows, columns - 1), np.bool_), np.zeros((rows - 1, columns), np.bool_))
    _carve(grid, (columns, rows), rng)
    _braid(grid, loops, rng)
    return grid


def _carve(grid: Grid, size: tuple[int, int], rng: np.random.Generator) -> None:
    """Open a tree of ways through all cells, by growing it from its last cell, or at times from any."""
    columns, rows = size
    at = (int(rng.integers(rows)), int(rng.integers(columns)))
    seen, growing = {at}, [at]
    while growing:
        index = int(rng.integers(len(growing))) if rng.random() < _BRANCH else len(growing) - 1
        row, column = growing[index]
        near = [(row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)]
        near = [(r, c) for r, c in near if 0 <= r < rows and 0 <= c < columns and (r, c) not in seen]
        if not near:
            growing.pop(index)
            continue
        following = near[int(rng.integers(len(near)))]
        if following[0] == row:
            grid.east[row, min(column, following[1])] = True
        else:
            grid.north[min(row, following[0]), column] = True
        seen.add(following)
        growing.append(following)


def _braid(grid: Grid, loops: float, rng: np.random.Generator) -> None:
    """Take out a share of the inner walls, and leave no post without one."""
    walls = [(0, int(r), int(c)) for r, c in np.argwhere(~grid.east)]
    walls += [(1, int(r), int(c)) for r, c in np.argwhere(~grid.north)]
    rest = round(loops * len(walls))
    order = [walls[int(i)] for i in rng.permutation(len(walls))]
    for side, row, column in order:
        if rest == 0:
            return
        if not _holds_a_post(grid, side, row, column):
            (grid.east, grid.north)[side][row, column] = True
            rest -= 1


def _holds_a_post(grid: Grid, side: int, row: int, column: int) -> bool:
    """Whether a wall is the last one at either of its ends: without it, a post would stand alone."""
    posts = ((row - 1, column), (row, column)) if side == 0 else ((row, column - 1), (row, column))
    for r, c in posts:
        if not (0 <= r < grid.north.shape[0] and 0 <= c < grid.east.shape[1]):
            continue  # on the outer wall
        walls = (
            4 - int(grid.east[r, c]) - int(grid.east[r + 1, c]) - int(grid.north[r, c]) - int(grid.north[r, c + 1])
        )
        if walls == 1:
            return True
    return False


def _spans(widths: list[int], wall: int) -> list[tuple[int, int]]:
    """Return from where to where each column or row reaches [cells]."""
    begins = _MARGIN + np.concatenate([[0], np.cumsum(np.array(widths[:-1], np.int64) + wall)])
    return [(int(begin), int(begin) + width) for begin, width in zip(begins, widths, strict=True)]


def _floors(grid: Grid, spans_x: list[tuple[int, int]], spans_y: list[tuple[int, int]]) -> list[Box]:
    """Return the free rectangles of a maze: its cells and the openings between them [cells]."""
    floors = [(x0, y0, x1, y1) for y0, y1 in spans_y for x0, x1 in spans_x]
    for row, column in np.argwhere(grid.east):
        floors.append((spans_x[column][1], spans_y[row][0], spans_x[column + 1][0], spans_y[row][1]))
    for row, column in np.argwhere(grid.north):
        floors.append((spans_x[column][0], spans_y[row][1], spans_x[column][1], spans_y[row + 1][0]))
    return floors
