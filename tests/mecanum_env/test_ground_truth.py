from __future__ import annotations

import math

import gymnasium as gym
import numpy as np
import pytest

from mecanum_env import rooms
from mecanum_env.config import EnvConfig, LidarConfig, RobotConfig
from mecanum_env.episode import score_map
from mecanum_env.ground_truth import Coverage, GroundTruth, on_lattice
from mecanum_env.rooms.files.importers import from_raster
from slam.geometry import transform_points
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid


def truth_of(name: str, seed: int) -> GroundTruth:
    plan = rooms.make(name, seed=seed)
    return GroundTruth(plan, np.array(plan.start), robot=RobotConfig(), lidar=LidarConfig(), resolution=0.05)


@pytest.mark.parametrize("name", rooms.names())
def test_all_but_hidden_nooks_of_the_free_space_is_mappable(name: str) -> None:
    for seed in (0, 1):
        truth = truth_of(name, seed)
        area = truth.mappable_cells * truth.resolution**2
        assert 0.95 * truth.plan.area_m2 < area <= truth.plan.area_m2


def test_mappable_cells_are_free_and_walls_are_near_surfaces() -> None:
    truth = truth_of("apartment", 3)
    row0, col0 = truth.lattice_origin

    def in_world(mask: np.ndarray) -> np.ndarray:
        cells = np.argwhere(mask) + np.array([row0, col0])
        return transform_points(truth.start, (cells[:, ::-1] + 0.5) * truth.resolution)

    assert np.all(truth.plan.is_free(in_world(truth.mappable)))
    walls = in_world(truth.walls)
    assert np.max(truth.plan.distance_to_surfaces(walls)) < 0.06
    assert np.max(truth.plan.distance_to_surfaces(transform_points(truth.start, truth.corners))) < 1e-6


def test_a_start_beside_a_wall_reaches_what_one_in_the_open_does() -> None:
    free = np.zeros((120, 200), bool)
    free[10:110, 10:100] = free[10:110, 102:190] = free[50:70, 100:102] = True  # two rooms, a door
    plan = from_raster(free, name="two rooms", resolution=0.05, start=(2.5, 2.5, 0.0))
    robot = RobotConfig()
    cells = [
        GroundTruth(plan, np.array(start), robot=robot, lidar=LidarConfig(), resolution=0.05).mappable_cells
        for start in ((2.5, 2.5, 0.0), (2.5, 0.5 + robot.inscribed_radius_m - 0.02, 0.0))
    ]
    assert cells[1] == pytest.approx(cells[0], rel=0.005)
    assert cells[0] * 0.05**2 > 0.95 * plan.area_m2


def test_nobody_is_held_to_what_lies_behind_a_wall() -> None:
    free = np.zeros((70, 180), bool)
    free[5:65, 60:170] = free[10:60, 10:14] = True
    # In a corridor of 0.4 m no cell has room for the body, though it fits; the hall is beyond a wall.
    plan = from_raster(free, name="apart", resolution=0.1, start=(1.2, 3.0, 0.5 * np.pi))
    truth = GroundTruth(plan, np.array(plan.start), robot=RobotConfig(), lidar=LidarConfig(), resolution=0.05)
    assert 1.0 < truth.mappable_cells * 0.05**2 <= 2.0


@pytest.mark.parametrize("range_m", [0.015, 0.3, 0.5, 2.0])
def test_a_lidar_that_sees_less_far_may_map_as_much(range_m: float) -> None:
    plan = rooms.make("rectangular", seed=2)
    lidar = LidarConfig(range_min_m=0.0, range_max_m=range_m)
    resolution = 0.05 if range_m > 0.1 else 0.01
    truth = GroundTruth(plan, np.array(plan.start), robot=RobotConfig(), lidar=lidar, resolution=resolution)
    assert truth.mappable_cells * resolution**2 > (0.95 if range_m > 0.1 else 0.0) * plan.area_m2


@pytest.mark.parametrize("offset", [0, 3, 6, 9, 12])
def test_narrow_passages_are_mappable_wherever_they_lie(offset: int) -> None:
    free = np.zeros((300, 300), bool)
    free[140:160, 10:290] = True  # a corridor of 1 m, and across it aisles of 0.5 m, which a youbot just fits in
    for left in range(20 + offset, 280, 55):
        free[20:280, left : left + 10] = True
    plan = from_raster(free, name="aisles", resolution=0.05, start=(7.0, 7.5, 0.0))
    truth = GroundTruth(plan, np.array(plan.start), robot=RobotConfig(), lidar=LidarConfig(), resolution=0.05)
    assert truth.mappable_cells * 0.05**2 > 0.92 * plan.area_m2  # but for cells that a wall runs along


def test_coverage_follows_changes_and_starts_over_after_a_redraw() -> None:
    truth = truth_of("rectangular", 1)
    rows, cols = truth.mappable.shape
    row0, col0 = truth.lattice_origin
    classes = np.full((rows, cols), UNKNOWN, np.int8)
    classes[truth.mappable] = FREE
    classes[: rows // 2] = UNKNOWN
    grid = OccupancyGrid.from_classes(classes, 0.05, (col0 * 0.05, row0 * 0.05))
    share = np.count_nonzero(truth.mappable[rows // 2 :]) / truth.mappable_cells
    coverage = Coverage(truth)
    assert coverage.update(grid) == pytest.approx(share)
    grid.clear()
    assert coverage.update(grid) == 0.0


def test_a_perfect_map_scores_one_and_a_shifted_one_less() -> None:
    truth = truth_of("apartment", 1)
    rows, cols = truth.walls.shape
    row0, col0 = truth.lattice_origin
    classes = np.where(truth.walls, OCCUPIED, UNKNOWN).astype(np.int8)
    env = gym.make("mecanum_env:mecanum_env/Explore-v0", rooms="rectangular")
    env.reset(seed=0)
    scores = []
    for shift in (0, 1, 8):
        grid = OccupancyGrid.from_classes(classes, 0.05, ((col0 + shift) * 0.05, row0 * 0.05))
        env.unwrapped.backend.grid = grid
        scores.append(score_map(truth, env.unwrapped.belief).iou)
    assert scores[0] == 1.0
    assert scores[1] > 0.95  # within the tolerance of two cells
    assert scores[2] < 0.7
    assert on_lattice(truth.walls, truth.lattice_origin, truth, 3).shape == (rows + 6, cols + 6)


def test_in_coarse_cells_a_wall_at_an_angle_may_be_drawn_a_cell_beside_itself_diagonally() -> None:
    plan = rooms.make("apartment", seed=1)
    start = np.array([*plan.start[:2], math.pi / 4.0])
    truth = GroundTruth(plan, start, robot=RobotConfig(), lidar=LidarConfig(), resolution=0.1)
    row0, col0 = truth.lattice_origin
    classes = np.where(truth.walls, OCCUPIED, UNKNOWN).astype(np.int8)
    coarse = EnvConfig(grid_resolution_m=0.1)
    env = gym.make("mecanum_env:mecanum_env/Explore-v0", rooms="rectangular", config=coarse)
    env.reset(seed=0)
    for shift in (1, -1):
        moved = OccupancyGrid.from_classes(classes, 0.1, ((col0 + shift) * 0.1, (row0 + 1) * 0.1))
        env.unwrapped.backend.grid = moved
        assert score_map(truth, env.unwrapped.belief).iou > 0.99
