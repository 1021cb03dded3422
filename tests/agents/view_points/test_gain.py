from __future__ import annotations

import math

import numpy as np
import pytest

from agents.view_points.gain import expected_area
from agents.ways import cost_map as cost_maps
from agents.ways.cost_map import PlannerConfig
from mecanum_env.config import RobotConfig
from slam.grids.occupancy import OCCUPIED, UNKNOWN
from tests.agents.grids import belief_of, fill, half_known, room


def costs_of(classes):
    return cost_maps.build(belief_of(classes, (1.5, 2.0, 0.0)), PlannerConfig(), RobotConfig())


def cell_at(cost_map, x, y):
    return cost_map.to_cells(np.array([[x, y]]))


def test_area_of_a_disc_in_the_unknown():
    classes = np.full((60, 60), UNKNOWN, np.int8)
    classes[28:32, 28:32] = 0
    cost_map = cost_maps.build(belief_of(classes, (1.5, 1.5, 0.0)), PlannerConfig(), RobotConfig())
    middle = cell_at(cost_map, 1.5, 1.5)
    area = expected_area(cost_map, middle, range_m=3.0)
    assert area[0] == pytest.approx(math.pi * 9.0, rel=0.03)  # the plan's own patch is nothing beside it


def test_all_known_gives_nothing_and_walls_block():
    known = costs_of(room(8.0, 4.0))
    assert expected_area(known, cell_at(known, 4.0, 2.0), range_m=8.0)[0] == 0.0
    half = half_known()
    open_map = costs_of(half)
    fill(half, 3.9, 0.0, 4.0, 4.0, OCCUPIED)
    walled = costs_of(half)
    at = cell_at(open_map, 2.0, 2.0)
    assert expected_area(open_map, at, range_m=4.0)[0] > 2.0
    assert expected_area(walled, cell_at(walled, 2.0, 2.0), range_m=4.0)[0] == 0.0


def test_depth_bounds_what_is_believed_and_no_place_sees_nothing():
    cost_map = costs_of(half_known())
    cells = np.vstack([cell_at(cost_map, 3.0, 2.0), [[-1, -1]]])
    deep = expected_area(cost_map, cells, range_m=6.0)
    shallow = expected_area(cost_map, cells, range_m=6.0, depth_m=0.5)
    assert 0.0 < shallow[0] < 0.5 * deep[0]
    assert deep[1] == shallow[1] == 0.0


def test_nearer_to_the_frontier_is_more():
    cost_map = costs_of(half_known())
    cells = np.vstack([cell_at(cost_map, x, 2.0) for x in (0.8, 1.8, 2.8, 3.6)])
    areas = expected_area(cost_map, cells, range_m=4.0)
    assert (np.diff(areas) > 0).all()
