"""What the network of stations is shown of a map."""

from __future__ import annotations

import numpy as np
import pytest

from agents.learned.station_network import PLANES, SIDE, outside, picture, pixels, with_walls
from agents.stations.survey import STRIDE
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN
from tests.agents.stations.floors import CELL_M, rooms, stop


def test_the_picture_is_made_of_what_is_known():
    known = rooms(1)
    robot = (65, 65)
    found, visited = stop(known, robot)
    shown = picture(known, visited, robot, CELL_M, found)
    assert shown.planes.shape == (PLANES, SIDE, SIDE)
    assert shown.planes[:4].sum() * 25 == pytest.approx((known == FREE).sum())
    assert shown.planes[4:8].sum() * 25 == pytest.approx((known == OCCUPIED).sum())
    assert shown.planes[8].sum() == pytest.approx(0.2 * len(found.pieces), rel=1e-5)
    np.testing.assert_allclose(shown.planes[:8].sum(axis=0) / 4.0 + shown.planes[13], 1.0, atol=1e-5)
    own = pixels(np.array([robot]), robot, shown)[0]
    assert shown.planes[12, own[0], own[1]] == 1.0 == shown.planes[12].sum()
    assert shown.planes[9, own[0], own[1]] == 1.0
    farthest = int(np.argmax(np.where(np.isfinite(found.way), found.way, -1.0)))
    far = pixels(found.cells[farthest : farthest + 1], robot, shown)[0]
    assert shown.planes[10, far[0], far[1]] == pytest.approx(0.25 + 0.01 * CELL_M * found.way[farthest], rel=1e-5)
    # A quarter of a pixel, by hand: five by five cells from half a stride before the station on.
    station = found.cells[3]
    corner = known[station[0] - 5 : station[0], station[1] : station[1] + 5]
    at = pixels(found.cells[3:4], robot, shown)[0]
    assert shown.planes[1, at[0], at[1]] == pytest.approx((corner == FREE).mean(), abs=1e-5)


def test_the_picture_does_not_tell_where_on_the_map_it_is():
    known = rooms(2)
    shifted = np.pad(known, ((30, 0), (20, 0)), constant_values=UNKNOWN)
    pictures = []
    for grid, robot in ((known, (65, 65)), (shifted, (95, 85))):
        found, visited = stop(grid, robot)
        pictures.append(picture(grid, visited, robot, CELL_M, found).planes)
    without = [k for k in range(PLANES) if k not in (8, 11)]  # pieces are counted by squares of the grid
    np.testing.assert_allclose(pictures[0][without], pictures[1][without], atol=1e-6)


def test_walls_beyond_the_extent_are_drawn_cell_by_cell():
    """What the shares say is what a grid says whose cells beyond the extent are known to be walls."""
    known = rooms(2)
    robot, box = (65, 65), (3, -20, 127, 111)
    found, visited = stop(known, robot)
    shown = picture(known, visited, robot, CELL_M, found)
    beyond = outside(shown, robot, box)
    for i, j in ((0, 0), (SIDE // 2, SIDE // 2), (7, 20), (8, 19), (20, 22)):
        for quarter in range(4):
            row = (shown.corner[0] + i) * STRIDE + robot[0] % STRIDE - 5 + 5 * (quarter // 2)
            col = (shown.corner[1] + j) * STRIDE + robot[1] % STRIDE - 5 + 5 * (quarter % 2)
            inside = [
                box[0] <= r < box[2] and box[1] <= c < box[3]
                for r in range(row, row + 5)
                for c in range(col, col + 5)
            ]
            assert beyond[quarter, i, j] == pytest.approx(1.0 - np.mean(inside))
    walled = with_walls(shown.planes, beyond)
    np.testing.assert_array_equal(walled[:4], shown.planes[:4])
    np.testing.assert_array_equal(walled[8:13], shown.planes[8:13])
    assert (walled[4:8] >= shown.planes[4:8] - 1e-6).all() and walled[:8].sum(axis=0).max() <= 4.0 + 1e-5
    np.testing.assert_allclose(walled[:8].sum(axis=0) / 4.0 + walled[13], 1.0, atol=1e-5)
    assert 0 < beyond.mean() < 1 and (beyond == 1).any() and (beyond == 0).any()


def test_on_a_map_too_large_the_robot_stays_in_the_picture():
    known = np.full((60, 900), FREE, np.int8)
    known[:, 890:] = UNKNOWN
    robot = (25, 15)
    found, visited = stop(known, robot)
    shown = picture(known, visited, robot, CELL_M, found)
    assert shown.planes[12].sum() == 1.0
    own = pixels(found.cells, robot, shown)
    assert own.min() >= 0 and own.max() < SIDE
