from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mecanum_env.observation import (
    LOCAL_CELL_M,
    MAP_SIZE,
    UNKNOWN_BYTE,
    _fill_global,
    _fill_local,
    find_row_cells,
    map_frame,
)
from slam.grids.occupancy import PROBABILITY_BYTE, OccupancyGrid
from tests.slam.simulated import room_scan

poses = st.tuples(st.floats(-6, 6), st.floats(-6, 6), st.floats(-3.1, 3.1))


def room_grid(resolution: float = 0.05) -> OccupancyGrid:
    grid = OccupancyGrid(resolution)
    for pose in ((1.0, 1.0, 0.0), (4.0, 3.0, 1.0)):
        grid.integrate(np.array(pose), room_scan(np.array(pose)))
        grid.mark_visited(pose[0], pose[1], 0.25)
    return grid


@given(poses, st.sampled_from([0.05, 0.1]))
def test_local_map_against_the_simple_version(pose: tuple[float, float, float], resolution: float) -> None:
    grid = room_grid(resolution)
    x, y, theta = pose
    out = np.empty((3, MAP_SIZE, MAP_SIZE), np.uint8)
    _fill_local(out, grid.cells, grid.trail, *grid.shape, *grid.lattice_origin, resolution, x, y, theta)
    c, s = math.cos(theta), math.sin(theta)
    differing = 0
    for i in range(0, MAP_SIZE, 3):
        for j in range(0, MAP_SIZE, 3):
            values = []
            for da in (-0.25, 0.25):
                dl = da if (i + j) % 2 else -da
                ahead = (MAP_SIZE / 2 - i - 0.5 + da) * LOCAL_CELL_M
                left = (MAP_SIZE / 2 - j - 0.5 + dl) * LOCAL_CELL_M
                point = np.array([[x + c * ahead - s * left, y + s * ahead + c * left]])
                row, col = grid.to_cells(point)[0]
                if 0 <= row < grid.shape[0] and 0 <= col < grid.shape[1]:
                    values.append(int(grid.log_odds[row, col]))
            seen = [v for v in values if v != 0]
            want = PROBABILITY_BYTE[max(seen) & 255] if seen and len(values) == 2 else UNKNOWN_BYTE
            differing += int(out[0, i, j] != want)
            assert (out[1, i, j] == 255) == (out[0, i, j] != UNKNOWN_BYTE)
    assert differing <= 3  # fixed-point rounding at the edge of a cell, and of the grid


def local_map_simply(
    grid: OccupancyGrid, resolution: float, x: float, y: float, theta: float
) -> tuple[np.ndarray, np.ndarray]:
    """Probabilities and trail of the local map, a whole picture at a time, in the kernel's float32."""
    step = LOCAL_CELL_M / resolution
    c, s = np.float32(math.cos(theta) * step), np.float32(math.sin(theta) * step)
    half = MAP_SIZE / 2 - 0.5
    i, j = np.indices((MAP_SIZE, MAP_SIZE))
    row0, col0 = grid.lattice_origin
    x0 = (x / resolution - col0 + float(c) * (half - i) - float(s) * half).astype(np.float32)
    y0 = (y / resolution - row0 + float(s) * (half - i) + float(c) * half).astype(np.float32)
    px, py = x0 + j.astype(np.float32) * s, y0 - j.astype(np.float32) * c
    quarter = np.float32(0.25)
    one_way = (i + j) % 2 == 1
    dx = np.where(one_way, quarter * (c - s), quarter * (c + s))
    dy = np.where(one_way, quarter * (s + c), quarter * (s - c))
    reach_x, reach_y = np.abs(dx).max(), np.abs(dy).max()
    rows, cols = grid.shape
    inside = (px >= reach_x) & (py >= reach_y)
    inside &= (px < np.float32(cols) - reach_x) & (py < np.float32(rows) - reach_y)

    def at(plane: np.ndarray, column: np.ndarray, row: np.ndarray) -> np.ndarray:
        cells = plane[np.where(inside, row, 0).astype(int), np.where(inside, column, 0).astype(int)]
        return np.where(inside, cells, plane.dtype.type(0))

    first, second = at(grid.log_odds, px + dx, py + dy), at(grid.log_odds, px - dx, py - dy)
    best = np.where(first == 0, second, np.where(second == 0, first, np.maximum(first, second)))
    trail = np.where((best != 0) & (at(grid.visited, px, py) != 0), 255, 0)
    return PROBABILITY_BYTE[best.view(np.uint8)], trail


@given(poses, st.sampled_from([0.05, 0.1]), st.integers(0, 2**32 - 1))
def test_local_map_equals_one_made_a_whole_picture_at_a_time(
    pose: tuple[float, float, float], resolution: float, seed: int
) -> None:
    grid = room_grid(resolution)
    rng = np.random.default_rng(seed)
    speckled = rng.random(grid.shape) < 0.5
    grid.log_odds[speckled] = rng.integers(-39, 71, np.count_nonzero(speckled))
    grid.visited[:] = rng.random(grid.shape) < 0.3
    out = np.empty((3, MAP_SIZE, MAP_SIZE), np.uint8)
    _fill_local(out, grid.cells, grid.trail, *grid.shape, *grid.lattice_origin, resolution, *pose)
    probability, trail = local_map_simply(grid, resolution, *pose)
    np.testing.assert_array_equal(out[0], probability)
    np.testing.assert_array_equal(out[1] == 255, probability != UNKNOWN_BYTE)
    np.testing.assert_array_equal(out[2], trail)


def test_the_local_map_is_heading_up() -> None:
    grid = OccupancyGrid()
    pose = np.array([2.0, 2.5, math.pi / 2])  # facing +y: the wall ahead is 2.5 m away, the left one 2 m
    grid.integrate(pose, room_scan(pose))
    out = np.empty((3, MAP_SIZE, MAP_SIZE), np.uint8)
    _fill_local(out, grid.cells, grid.trail, *grid.shape, *grid.lattice_origin, 0.05, *pose)
    middle = MAP_SIZE // 2
    assert np.argmax(out[0, :middle, middle] > 170) in (6, 7)  # 2.5 m ahead is row 32 - 25
    assert np.flatnonzero(out[0, middle, :middle] > 170)[-1] in (11, 12)  # 2 m to the left is column 32 - 20


def test_the_global_map_puts_the_robot_where_the_pose_says() -> None:
    grid = room_grid()
    out = np.empty((3, MAP_SIZE, MAP_SIZE), np.uint8)
    cx, cy, half = map_frame(grid)
    x, y = 4.0, 3.0
    _fill_global(out, grid.overview_sums, grid.overview_block, (x - cx) / half, (y - cy) / half)
    row, col = np.argwhere(out[2] == 255).mean(axis=0)
    assert abs((MAP_SIZE / 2 - row - 0.5) / (MAP_SIZE / 2) * half + cy - y) <= half / MAP_SIZE * 2
    assert abs((col + 0.5 - MAP_SIZE / 2) / (MAP_SIZE / 2) * half + cx - x) <= half / MAP_SIZE * 2
    # The area that the map shows as observed is the area known.
    pixel = (2 * half / MAP_SIZE) ** 2
    assert abs(out[1].astype(float).sum() / 255 * pixel - grid.known_area_m2) < 0.3
    # A point of the room is free where it should be on the picture.
    i = MAP_SIZE - 1 - int(((1.0 - cy) / half + 1) / 2 * MAP_SIZE)
    j = int(((1.0 - cx) / half + 1) / 2 * MAP_SIZE)
    assert out[0, i, j] < 110


def test_a_row_of_pixels_looks_at_the_cells_under_it_and_at_none_beyond_the_edges() -> None:
    rng, n, shape = np.random.default_rng(0), MAP_SIZE, (220, 260)
    within = 0
    for _ in range(300):
        theta = rng.uniform(-math.pi, math.pi)
        c, s = np.float32(2.0 * math.cos(theta)), np.float32(2.0 * math.sin(theta))
        x0, y0 = rng.uniform(-10, 270, 2).astype(np.float32)
        steps = np.arange(n, dtype=np.float32)
        along = np.stack([steps * s, steps * c])
        sides = np.array([[c - s, c + s], [s + c, s - c]], np.float32) / 4
        offset = np.ascontiguousarray(np.tile(sides, n // 2))
        found = np.empty((3, n), np.int32)
        find_row_cells(x0, y0, along, offset, *shape, *found)
        # One pixel after the other, each asked whether it may reach over an edge.
        x, y = x0 + along[0], y0 - along[1]
        low_x, low_y = np.abs(sides).max(axis=1)
        inside = (x >= low_x) & (y >= low_y) & (x < shape[1] - low_x) & (y < shape[0] - low_y)
        for sign, got in zip((1, -1, 0), found, strict=True):
            row, col = (y + sign * offset[1]).astype(int), (x + sign * offset[0]).astype(int)
            np.testing.assert_array_equal(got, np.where(inside, row * shape[1] + col, shape[0] * shape[1]))
        within += bool(inside.all())
    assert 20 < within < 280  # both ways were gone


def test_no_sum_is_rounded_up_to_a_row_beyond_the_last() -> None:
    rng, n, shape = np.random.default_rng(0), MAP_SIZE, (220, 260)
    for theta in rng.uniform(-math.pi, math.pi, 2000):
        c, s = np.float32(2.0 * math.cos(theta)), np.float32(2.0 * math.sin(theta))
        sides = np.array([[c - s, c + s], [s + c, s - c]], np.float32) / 4
        offset, found = np.ascontiguousarray(np.tile(sides, n // 2)), np.empty((3, n), np.int32)
        y0 = np.nextafter(np.float32(shape[0]) - np.abs(sides[1]).max(), np.float32(0.0))
        find_row_cells(np.float32(100.0), y0, np.zeros((2, n), np.float32), offset, *shape, *found)
        assert found.max() <= shape[0] * shape[1]
