"""Beams that speak for a pose and against it: counted as a simple loop counts them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slam.health.evidence import Agreement, agreement, agrees, through_walls
from slam.types import Scan
from tests.slam.simulated import room_scan

poses = st.tuples(st.floats(0.5, 5.5), st.floats(0.5, 4.5), st.floats(-3.1, 3.1))
TAKEN_AT = (np.array([2.0, 2.0, 0.3]), np.array([4.0, 3.0, -1.0]), np.array([3.0, 1.0, 2.0]))


def room_grid(resolution: float = 0.05) -> OccupancyGrid:
    grid = OccupancyGrid(resolution)
    for pose in TAKEN_AT:
        for _ in range(3):
            grid.integrate(pose, room_scan(pose))
    return grid


def simply(grid: OccupancyGrid, pose: tuple[float, float, float], scan: Scan, stride: int) -> Agreement:
    """The same, cell by cell: beside a wall is 5 cm from it, or one cell."""
    classes, beside = grid.classes(), max(1, math.floor(0.05 / grid.resolution + 0.501))

    def around(cells: int) -> tuple[slice, slice]:
        return slice(row - cells, row + cells + 1), slice(col - cells, col + cells + 1)

    on_walls = sharp = blurred = in_the_open = 0
    for k in range(0, len(scan.ranges), stride):
        r = scan.ranges[k]
        if not r <= scan.range_max:
            continue
        angle, reach = pose[2] + scan.angle_min + k * scan.angle_increment, r + 0.25 * grid.resolution
        end = np.array([[pose[0] + reach * math.cos(angle), pose[1] + reach * math.sin(angle)]])
        row, col = grid.to_cells(end)[0]
        if min(row, col) < beside or row >= grid.shape[0] - beside or col >= grid.shape[1] - beside:
            continue
        if (classes[around(beside)] == OCCUPIED).any():
            on_walls += 1
            hit = bool((classes[around((beside - 1) // 2)] == OCCUPIED).any())
            back = reach - beside * grid.resolution
            last = np.array([[pose[0] + back * math.cos(angle), pose[1] + back * math.sin(angle)]])
            before = classes[tuple(grid.to_cells(last)[0])]
            sharp += hit
            blurred += not hit and (classes[row, col] == FREE or before == OCCUPIED)
        elif (classes[around(beside)] == FREE).all() and (grid.log_odds[around(beside)] != 0).all():
            in_the_open += 1
    return Agreement(on_walls, int(sharp), int(blurred), in_the_open)


@settings(max_examples=30)
@given(poses, poses, st.sampled_from([0.01, 0.02, 0.05, 0.1]))
def test_against_the_simple_version(
    true: tuple[float, float, float], believed: tuple[float, float, float], resolution: float
) -> None:
    grid, scan = room_grid(resolution), room_scan(np.array(true), np.random.default_rng(0))
    scan.ranges[::7], scan.ranges[1::7] = np.nan, np.inf
    seen, simple = agreement(grid, believed, scan, 90), simply(grid, believed, scan, 4)
    assert np.abs(np.array(seen) - np.array(simple)).max() <= 1  # a beam's end on the very edge of a cell


@pytest.mark.parametrize("resolution", [0.01, 0.02, 0.05])
def test_two_centimetres_are_as_little_in_fine_cells(resolution: float) -> None:
    true = np.array([3.0, 2.5, 0.4])
    seen = agreement(room_grid(resolution), (3.015, 2.515, 0.4), room_scan(true, np.random.default_rng(1)), 90)
    assert seen.against < 0.03 and seen.sharpness > 0.6


def test_a_noisy_scan_is_as_sharp_in_cells_of_two_centimetres_as_in_others_about_that() -> None:
    true = np.array([3.0, 2.5, 0.4])
    scan = room_scan(true, np.random.default_rng(1), sigma=0.04)
    sizes = 0.05, 0.02, 0.016
    coarser, two, finer = (agreement(room_grid(m), (3.0, 2.5, 0.4), scan, 360).sharpness for m in sizes)
    assert two > 0.9 * min(coarser, finer)


@given(poses)
def test_the_right_pose_agrees_and_the_map_of_nothing_says_nothing(true: tuple[float, float, float]) -> None:
    scan = room_scan(np.array(true), np.random.default_rng(1))
    seen = agreement(room_grid(), true, scan, 90)
    assert seen.against == 0.0
    assert seen.beams > 80
    empty = agreement(OccupancyGrid(0.05), true, scan, 90)
    assert empty == Agreement(0, 0, 0, 0)
    assert empty.against == 0.0


def test_a_wall_drawn_in_pieces_does_not_blur_a_scan() -> None:
    classes = np.full((60, 100), FREE, np.int8)
    classes[:, 70:] = UNKNOWN
    classes[::3, 70] = OCCUPIED  # every third cell of the wall at x = 3.5 to 3.55 m
    grid = OccupancyGrid.from_classes(classes, 0.05, (0.0, 0.0))
    angles = np.arange(-4, 5) * 0.02  # a cell of the wall each

    def seen(wall_m: float) -> Agreement:
        scan = Scan((wall_m - 1.0) / np.cos(angles), angles[0], 0.02, 8.0)
        return agreement(grid, (1.0, 1.525, 0.0), scan, 9)

    assert seen(3.51) == Agreement(on_walls=9, sharp=3, blurred=0, in_the_open=0)
    assert seen(3.46) == Agreement(on_walls=9, sharp=0, blurred=9, in_the_open=0)
    assert seen(3.56) == Agreement(on_walls=9, sharp=0, blurred=3, in_the_open=0)  # through what is drawn of it
    assert (seen(3.51).sharpness, seen(3.46).sharpness, seen(3.56).sharpness) == (1.0, 0.0, 0.0)


def test_what_was_only_ever_between_two_beams_says_nothing() -> None:
    grid = OccupancyGrid(0.05)
    for _ in range(3):
        grid.integrate(np.zeros(3), Scan(np.full(90, np.inf), 0.0, np.radians(4.0), 8.0))
    for away_m, told in ((1.5, 90), (5.0, 0)):  # 4° apart are 0.1 m, and 0.35 m
        things = Scan(np.full(90, away_m), np.radians(2.0), np.radians(4.0), 8.0)  # in the open, half way
        assert agreement(grid, (0.0, 0.0, 0.0), things, 90) == Agreement(0, 0, 0, told)


def test_a_glance_at_the_body_s_pose_is_a_look_at_the_sensor_s() -> None:
    grid, true = room_grid(), np.array([3.0, 2.0, 0.5])
    scan = room_scan(true)
    body = true - np.array([0.2 * math.cos(0.5), 0.2 * math.sin(0.5), 0.0])
    assert agrees(grid, body, 0.2, scan, 36)
    assert not agrees(grid, body + np.array([0.5, 0.0, 0.2]), 0.2, scan, 36)


@pytest.mark.parametrize("inside", [True, False])
def test_beams_through_a_wall_are_counted_and_those_along_it_are_not(inside: bool) -> None:
    classes = np.full((60, 100), FREE, np.int8)
    classes[:, 70] = OCCUPIED  # x from 3.5 to 3.55 m
    classes[:5] = UNKNOWN
    grid = OccupancyGrid.from_classes(classes, 0.05, (0.0, 0.0))
    ranges = np.full(8, 2.4 if inside else 2.5)
    scan = Scan(ranges, -0.2, 0.05, 8.0)
    crossing, beams = through_walls(grid, (1.05 if inside else 1.8, 1.5, 0.0), scan, 8)
    assert beams == 8
    assert crossing == (0 if inside else 8)
