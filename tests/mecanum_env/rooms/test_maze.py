"""Mazes: all cells connected, with as many ways round as were asked for, in corridors of the right width."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from mecanum_env import rooms
from mecanum_env.rooms.layout.assembly import generator
from mecanum_env.rooms.maze import Grid, MazeConfig, draw_grid

seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=40, deadline=None)


def reached(grid: Grid) -> int:
    """How many cells there is a way to from the first one."""
    rows, columns = grid.east.shape[0], grid.north.shape[1]
    seen, front = {(0, 0)}, [(0, 0)]
    while front:
        r, c = front.pop()
        steps = [
            (c + 1 < columns and grid.east[r, min(c, columns - 2)], (r, c + 1)),
            (c > 0 and grid.east[r, c - 1], (r, c - 1)),
            (r + 1 < rows and grid.north[min(r, rows - 2), c], (r + 1, c)),
            (r > 0 and grid.north[r - 1, c], (r - 1, c)),
        ]
        for is_open, cell in steps:
            if is_open and cell not in seen:
                seen.add(cell)
                front.append(cell)
    return len(seen)


def loops(grid: Grid) -> int:
    """How many ways round there are, where all cells are connected."""
    rows, columns = grid.east.shape[0], grid.north.shape[1]
    return int(grid.east.sum() + grid.north.sum()) - rows * columns + 1


@few
@given(seed=seeds, columns=st.integers(2, 10), rows=st.integers(2, 10), share=st.floats(0, 1))
def test_every_cell_is_reached_and_no_post_stands_alone(seed, columns, rows, share):
    grid = draw_grid((columns, rows), share, generator(seed))
    assert reached(grid) == columns * rows
    inner = (columns - 1) * rows + columns * (rows - 1)
    tree = columns * rows - 1
    assert 0 <= loops(grid) <= round(share * (inner - tree))
    walls = (
        (~grid.east[1:]).astype(int) + (~grid.east[:-1]) + (~grid.north[:, 1:]).astype(int) + (~grid.north[:, :-1])
    )
    assert walls.min() >= 1


@few
@given(seed=seeds)
def test_a_maze_without_loops_is_a_tree(seed):
    grid = draw_grid((7, 6), 0.0, generator(seed))
    assert loops(grid) == 0 and reached(grid) == 42


@few
@given(seed=seeds)
def test_a_maze_has_loops_and_dead_ends_are_few(seed):
    plan = rooms.make("maze", seed=seed)
    # By the raster alone: each way round goes about an island of wall.
    islands = ndimage.label(~plan.free, np.ones((3, 3)))[1] - 1
    assert 4 <= islands <= 8
    width, height = plan.free.shape[1] * 0.05 - 0.4, plan.free.shape[0] * 0.05 - 0.4
    assert 6 * 1.2 + 5 * 0.1 - 1e-9 <= min(width, height) <= max(width, height) <= 8 * 1.6 + 7 * 0.2 + 1e-9


@few
@given(seed=seeds)
def test_the_loops_of_the_plan_are_those_of_its_grid(seed):
    config = MazeConfig(columns=(6, 6), rows=(5, 5))
    plan = rooms.make("maze", seed=seed, config=config)
    rng = generator(seed)
    rng.integers(6, 7), rng.integers(5, 6)
    grid = draw_grid((6, 5), config.loops, rng)
    assert ndimage.label(~plan.free, np.ones((3, 3)))[1] - 1 == loops(grid)


@few
@given(seed=seeds, width=st.sampled_from([1.1, 1.2, 1.35, 1.6]), wall=st.sampled_from([0.05, 0.1, 0.2]))
def test_corridors_are_as_wide_as_was_asked_for(seed, width, wall):
    config = {"corridor_m": (width, width), "wall_m": (wall, wall), "columns": (3, 5), "rows": (3, 5)}
    plan = rooms.make("maze", seed=seed, config=config)
    side = round(width / 0.05)
    opened = ndimage.binary_opening(plan.free, np.ones((side, side)))
    assert np.array_equal(opened, plan.free), "somewhere narrower"
    assert plan.distance_to_surfaces(np.array([plan.start[:2]]))[0] >= 0.5
