"""A scan's place on a map is found from anywhere; and none where two places look alike."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slam.geometry import wrap
from slam.grids.occupancy import OccupancyGrid
from slam.grids.scan_matching import body_points
from slam.health.relocalisation import RelocalisationConfig, Relocaliser
from slam.types import Scan
from tests.slam.simulated import ANGLE_MIN, ANGLES, BEAMS, INCREMENT, room_scan

ROOM = ((0.0, 0.0), (6.0, 0.0), (6.0, 3.0), (4.0, 3.0), (4.0, 5.0), (0.0, 5.0))  # an L


def l_scan(pose: np.ndarray, rng: np.random.Generator | None = None) -> Scan:
    """Scan the inside of the L from a sensor pose."""
    ranges = np.full(BEAMS, np.inf)
    c, s = np.cos(ANGLES + pose[2]), np.sin(ANGLES + pose[2])
    for (ax, ay), (bx, by) in zip(ROOM, (*ROOM[1:], ROOM[0]), strict=True):
        ex, ey, fx, fy = bx - ax, by - ay, ax - pose[0], ay - pose[1]
        with np.errstate(divide="ignore", invalid="ignore"):
            area = c * ey - s * ex
            along, across = (fx * ey - fy * ex) / area, (fx * s - fy * c) / area
        hit = (along > 0) & (across >= 0) & (across <= 1)
        ranges[hit] = np.minimum(ranges[hit], along[hit])
    if rng is not None:
        ranges = ranges + 0.01 * rng.standard_normal(BEAMS)
    return Scan(ranges, ANGLE_MIN, INCREMENT, 20.0)


def grid_of(scan_from: object, places: tuple[tuple[float, float], ...]) -> OccupancyGrid:
    grid = OccupancyGrid(0.05)
    for x, y in places:
        for heading in (0.0, 0.3, 0.6):
            pose = np.array([x, y, heading])
            grid.integrate(pose, scan_from(pose))  # type: ignore[operator]
    return grid


@pytest.mark.parametrize("radius", [1.5, math.inf])
def test_a_scan_is_found_from_anywhere(radius: float) -> None:
    grid = grid_of(l_scan, ((1.0, 1.0), (5.0, 1.5), (2.0, 4.0)))
    rng = np.random.default_rng(3)
    finder = Relocaliser(RelocalisationConfig(), grid, 0.0)
    for true in ((1.5, 1.2, 2.0), (5.0, 1.0, -2.5), (2.5, 4.0, 0.4), (3.3, 2.2, -0.9)):
        pose = np.array(true)
        guess = pose + np.array([0.7, -0.7, 0.35]) if radius < 10 else np.array([1.0, 1.0, 0.0])
        place = finder.find(l_scan(pose, rng), guess, radius)
        assert place is not None
        assert place.good
        assert np.hypot(*(place.pose - pose)[:2]) < 0.04
        assert abs(float(wrap(place.pose[2] - pose[2]))) < 0.01


def test_places_that_are_looked_at_lie_apart_from_each_other() -> None:
    grid = grid_of(l_scan, ((1.0, 1.0), (5.0, 1.5), (2.0, 4.0)))
    config = RelocalisationConfig()
    finder = Relocaliser(config, grid, 0.0)
    points = body_points(l_scan(np.array([2.5, 4.0, 0.4])), config.matching, offset_m=0.0)
    likelihood = finder._field_around(np.zeros(3), math.inf)
    found = finder._candidates(likelihood, finder._free, points)
    assert len(found) == config.candidates
    assert all(finder._apart(a, b) for k, a in enumerate(found) for b in found[:k])


def test_a_rectangle_has_two_places_for_every_scan() -> None:
    grid = grid_of(room_scan, ((1.0, 1.0), (5.0, 4.0)))
    true = np.array([2.0, 2.0, 0.3])
    scan = room_scan(true, np.random.default_rng(0))
    finder = Relocaliser(RelocalisationConfig(), grid, 0.0)
    assert finder.find(scan, true, math.inf) is None  # or turned about the middle
    near = finder.check(scan, true + np.array([0.05, 0.05, 0.02]))
    assert near.good
    assert np.hypot(*(near.pose - true)[:2]) < 0.03


def test_another_room_is_no_place() -> None:
    grid = grid_of(l_scan, ((1.0, 1.0), (5.0, 1.5), (2.0, 4.0)))
    scan = room_scan(np.array([1.0, 1.0, 0.2]), width=3.0, height=2.2)
    assert Relocaliser(RelocalisationConfig(), grid, 0.0).find(scan, np.zeros(3), math.inf) is None


def test_nothing_is_found_on_an_empty_map_or_by_a_blind_lidar() -> None:
    pose = np.array([1.0, 1.0, 0.0])
    empty = Relocaliser(RelocalisationConfig(), OccupancyGrid(0.05), 0.0)
    assert empty.find(l_scan(pose), pose, math.inf) is None
    finder = Relocaliser(RelocalisationConfig(), grid_of(l_scan, ((1.0, 1.0),)), 0.0)
    blind = l_scan(pose)._replace(ranges=np.full(BEAMS, np.nan))
    assert finder.find(blind, pose, math.inf) is None
    assert not finder.check(blind, pose).good
