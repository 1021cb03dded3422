from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam import CONCAVE, CONVEX, Scan
from slam.features.extraction import FeatureConfig, FeatureExtractor
from slam.features.surfaces import SIGMA, _breaks, _farthest, points_in_order
from slam.geometry import inverse, transform_points, wrap
from slam.types import LINE
from tests.slam.simulated import ANGLE_MIN, ANGLES, BEAMS, INCREMENT, room_scan

ROOM = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 5.0], [0.0, 5.0]])
inside = st.tuples(st.floats(1, 5), st.floats(1, 4), st.floats(-3.1, 3.1)).map(np.array)


class Corners(NamedTuple):
    range_bearing: np.ndarray  # (m, 2)
    cov: np.ndarray  # (m, 2, 2)
    kind: np.ndarray  # (m,)
    direction: np.ndarray  # (m,)


def corners_in(extractor: FeatureExtractor, scan: Scan) -> Corners:
    rows = extractor.extract(scan).copy()
    return Corners(rows[:, :2], rows[:, [2, 3, 3, 4]].reshape(-1, 2, 2), rows[:, 5], rows[:, 6])


def polygon_scan(pose: np.ndarray, loops: list[np.ndarray], rng: np.random.Generator | None = None) -> Scan:
    """Scan closed polygons by brute force."""
    direction = np.column_stack([np.cos(ANGLES + pose[2]), np.sin(ANGLES + pose[2])])
    ranges = np.full(BEAMS, np.inf)
    for loop in loops:
        for a, b in zip(loop, np.roll(loop, -1, axis=0), strict=True):
            e, d = b - a, a - pose[:2]
            det = direction[:, 0] * -e[1] + direction[:, 1] * e[0]
            with np.errstate(divide="ignore", invalid="ignore"):
                t = (d[0] * -e[1] + d[1] * e[0]) / det
                u = (direction[:, 0] * d[1] - direction[:, 1] * d[0]) / det
            hit = (t > 0) & (u >= 0) & (u <= 1)
            ranges = np.where(hit & (t < ranges), t, ranges)
    if rng is not None:
        ranges = ranges + 0.01 * rng.standard_normal(BEAMS)
    return Scan(ranges, angle_min=ANGLE_MIN, angle_increment=INCREMENT, range_max=20.0)


def polar(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    local = transform_points(inverse(pose), points)
    return np.column_stack([np.hypot(*local.T), np.arctan2(local[:, 1], local[:, 0])])


@given(inside)
def test_a_clean_room_has_exact_corners_and_walls(pose: np.ndarray) -> None:
    extractor = FeatureExtractor()
    corners = corners_in(extractor, room_scan(pose))
    rows = extractor.with_walls()
    true = polar(pose, ROOM)
    assert 3 <= len(corners.kind) <= 4  # one may lie where the circle of beams begins
    for seen, direction, kind in zip(corners.range_bearing, corners.direction, corners.kind, strict=True):
        error = np.column_stack([true[:, 0] - seen[0], wrap(true[:, 1] - seen[1])])
        i = int(np.argmin(np.abs(error).sum(1)))
        assert np.abs(error[i]).max() < 1e-3
        assert kind == CONCAVE
        inward = math.atan2(*np.sign(np.array([3.0, 2.5]) - ROOM[i])[::-1])
        assert abs(float(wrap(direction + pose[2] - inward))) < 1e-2
    walls = {0.0: pose[0], math.pi / 2: pose[1], math.pi: 6 - pose[0], -math.pi / 2: 5 - pose[1]}
    for r, alpha in rows[rows[:, 5] == LINE, :2]:
        outward = float(wrap(alpha + pose[2] + math.pi))
        nearest = min(walls, key=lambda a: abs(float(wrap(a - outward))))
        assert abs(r - walls[nearest]) < 1e-6


def test_corner_errors_have_the_declared_covariance() -> None:
    """NEES of corners over noisy scans: no surer than they should be, and not much less sure."""
    rng = np.random.default_rng(0)
    extractor = FeatureExtractor()
    nees, found = [], 0
    for _ in range(400):
        pose = np.array([rng.uniform(1, 5), rng.uniform(1, 4), rng.uniform(-3, 3)])
        corners, true = corners_in(extractor, room_scan(pose, rng)), polar(pose, ROOM)
        found += len(corners.kind)
        for z, cov in zip(corners.range_bearing, corners.cov, strict=True):
            error = np.column_stack([true[:, 0] - z[0], wrap(true[:, 1] - z[1])])
            e = error[np.argmin(np.abs(error[:, 1]))]
            nees.append(e @ np.linalg.solve(cov, e))
    assert found > 0.9 * 4 * 400
    assert 0.8 < np.mean(nees) < 2.2  # two degrees of freedom; the floor makes it less
    assert np.quantile(nees, 0.997) < 13


def test_convex_corners_of_a_box_and_no_corner_where_it_hides_the_wall() -> None:
    box = np.array([[3.0, 2.0], [3.6, 2.0], [3.6, 2.6], [3.0, 2.6]])
    pose = np.array([1.5, 1.0, 0.4])
    corners = corners_in(FeatureExtractor(), polygon_scan(pose, [ROOM, box], np.random.default_rng(1)))
    convex = corners.range_bearing[corners.kind == CONVEX]
    # (3, 2) faces the sensor, and the visible faces end at corners of the box too; what the box hides of the
    # walls ends at the rim of its shadow, which is no corner.
    true = polar(pose, box[[0, 1, 3]])
    assert len(convex) >= 2
    for z in convex:
        assert np.min(np.abs(true - z).max(axis=1)) < 0.05
    facing = int(np.argmin(np.abs(convex - true[0]).max(axis=1)))
    assert np.abs(convex[facing] - true[0]).max() < 0.02
    direction = float(wrap(corners.direction[corners.kind == CONVEX][facing] + pose[2]))
    assert abs(direction - math.atan2(-1, -1)) < 0.1


@pytest.mark.parametrize("thick", [0.1, 0.3])
def test_an_end_face_that_noise_hides_is_in_the_covariance(thick: float) -> None:
    """From the sides a wall's end face is seen, and its first points pass for the wall's: no heavy tail."""
    nees = np.array(ends_of_a_wall(0.03, thick=thick, from_x=(1.0, 5.0))[1])
    assert 0.7 < np.mean(nees) / 2 < 1.2
    assert np.quantile(nees, 0.99) < 13.0  # of χ² with two degrees of freedom 9.2


@pytest.mark.parametrize("sigma", [0.01, 0.03])
def test_the_end_of_a_wall_is_a_corner_wherever_it_is_seen_from(sigma: float) -> None:
    """The two ends of a free-standing wall, their bias and spread against the declared covariance."""
    errors, nees = ends_of_a_wall(sigma, thick=0.3, from_x=(2.2, 3.8))
    assert len(errors) > 300
    assert np.abs(np.mean(errors, axis=0)).max() < 0.002
    assert 0.85 < np.mean(nees) / 2 < 1.15


def test_an_end_face_that_is_seen_tells_the_end() -> None:
    """From beyond the end: millimetres, where the beams' spacing alone leaves centimetres."""
    errors, nees = ends_of_a_wall(0.01, thick=0.2, from_x=(4.8, 5.8), ends=(1,))
    off = np.array(errors)[:, 0]
    assert len(off) > 150
    assert abs(np.mean(off)) < 0.001 and np.quantile(np.abs(off), 0.95) < 0.008
    assert 0.6 < np.mean(nees) / 2 < 1.1  # less, as a step nearer the wall might have been hidden
    assert np.quantile(nees, 0.99) < 12.0  # of χ² with two degrees of freedom 9.2


def frame_of_a_door(depth: float) -> np.ndarray:
    """A wall along y = 3 that ends at x = 3, the frame of its door a step farther back and out."""
    return np.array([[1.0, 3.0], [3.0, 3.0], [3.0, 3.0 + depth], [3.1, 3.0 + depth], [3.1, 3.4], [1.0, 3.4]])


def ends_of(frame: np.ndarray, *, from_x: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Errors along the wall [m], positive where it seems too long, and normalised ones, of ends near (3, 3)."""
    rng = np.random.default_rng(0)
    extractor = FeatureExtractor(FeatureConfig(edge_sigma=0.29, edge_floor_m=0.0))
    along, normalised = [], []
    for _ in range(400):
        pose = np.array([rng.uniform(*from_x), rng.uniform(1.0, 2.5), rng.uniform(-3, 3)])
        corners = corners_in(extractor, polygon_scan(pose, [ROOM, frame], rng))
        for (rho, phi), cov, kind in zip(corners.range_bearing, corners.cov, corners.kind, strict=True):
            bearing = phi + pose[2]
            x, y = pose[0] + rho * math.cos(bearing), pose[1] + rho * math.sin(bearing)
            if kind == CONVEX and math.hypot(x - 3.0, y - 3.0) < 0.3 and abs(y - 3.0) < 0.05:
                slope = np.array([math.cos(bearing), -rho * math.sin(bearing)])
                along.append(x - 3.0)
                normalised.append((x - 3.0) / math.sqrt(slope @ cov @ slope))
    return np.array(along), np.array(normalised)


@pytest.mark.parametrize("depth", [0.1, 0.15])
@pytest.mark.parametrize("from_x", [(1.2, 2.8), (3.4, 5.0)])
def test_an_end_is_the_same_from_both_sides_of_a_door(depth: float, from_x: tuple[float, float]) -> None:
    """Otherwise whoever drives past is dragged along, by every door alike."""
    along, normalised = ends_of(frame_of_a_door(depth), from_x=from_x)
    assert len(along) > 150
    assert abs(np.mean(along)) < 0.004
    assert 0.5 < np.mean(normalised**2) < 1.5


@pytest.mark.parametrize(("sigma", "thick"), [(0.03, 0.1), (0.02, 0.07), (0.01, 0.05)])
def test_an_end_face_that_passes_for_the_wall_does_not_make_it_longer(sigma: float, thick: float) -> None:
    """From beyond the end of a thin wall: its last points are on the end face, and met past the end."""
    errors, nees = ends_of_a_wall(sigma, thick=thick, from_x=(4.8, 6.0), ends=(1,))
    assert len(errors) > 100
    assert abs(np.mean(errors, axis=0)[0]) < 0.01
    assert 0.2 < np.mean(nees) / 2 < 1.2


def test_a_wall_that_noise_has_split_ends_where_it_ends() -> None:
    """Near a wall some point is far enough off to split it: the end is beyond the piece that is left."""
    along, _ = ends_of(frame_of_a_door(0.1), from_x=(2.0, 2.8))
    assert np.quantile(np.abs(along), 0.98) < 0.03


def test_door_jambs_do_not_bend_a_wall() -> None:
    """Beams on the end faces of a wall's pieces are nearly in line with them; thousands of looks add up."""
    rng = np.random.default_rng(1)
    extractor = FeatureExtractor(FeatureConfig())
    pieces = [np.array([[a, 3.0], [a + 3.9, 3.0], [a + 3.9, 3.15], [a, 3.15]]) for a in (0.0, 5.0, 10.0)]
    measured = []
    for _ in range(400):
        pose = np.array([rng.uniform(1.0, 13.0), rng.uniform(1.5, 2.5), rng.uniform(-3, 3)])
        extractor.extract(polygon_scan(pose, pieces, rng))
        measured += [
            (z[10], z[11])
            for z in extractor.with_walls()
            if z[5] == LINE and abs(math.remainder(z[1] + pose[2] - 0.5 * math.pi, math.tau)) < 0.1
        ]
    kappa, variance = np.array(measured).T
    assert len(kappa) > 700
    assert abs(np.sum(kappa / variance)) < 3.0 * math.sqrt(np.sum(1.0 / variance))
    assert np.mean(kappa**2 / variance) == pytest.approx(1.0, abs=0.2)


def test_a_surface_that_bends_away_has_no_end() -> None:
    """From its own side; of 400 looks some pass the horizon of the bend, and look beyond it like past an end."""
    angles = np.linspace(0.0, 0.5 * math.pi, 60)
    bend = np.column_stack([3.0 + 1.5 * np.sin(angles), 4.5 - 1.5 * np.cos(angles)])
    rounded = np.vstack([[[1.0, 3.0]], bend, [[1.0, 4.5]]])
    along, _ = ends_of(rounded, from_x=(1.5, 2.8))
    assert len(along) < 25


def test_a_surface_that_lies_a_little_farther_back_is_no_end_face() -> None:
    """The frame of a door, seen from where no end face can be: the wall before it ends between two beams."""
    frame = np.array([[1.0, 3.0], [3.0, 3.0], [3.0, 3.1], [3.15, 3.1], [3.15, 3.3], [1.0, 3.3]])
    rng = np.random.default_rng(0)
    extractor = FeatureExtractor(FeatureConfig(range_sigma_m=0.01))
    along = []
    for _ in range(200):
        pose = np.array([rng.uniform(1.2, 2.6), rng.uniform(0.5, 2.0), rng.uniform(-3, 3)])
        scan = polygon_scan(pose, [ROOM, frame], rng)
        corners, true = corners_in(extractor, scan), polar(pose, frame[1:2])[0]
        for z, kind in zip(corners.range_bearing, corners.kind, strict=True):
            error = np.array([true[0] - z[0], wrap(true[1] - z[1])])
            if kind == CONVEX and np.abs(error).max() < 0.15:
                along.append(z[0] * error[1])
    assert len(along) > 100
    assert np.max(along) < 0.03  # half of what the beams are apart; the frame's own points are 0.1 m too far out


def ends_of_a_wall(
    sigma: float, *, thick: float, from_x: tuple[float, float], ends: tuple[int, ...] = (0, 1)
) -> tuple[list, list]:
    """Errors (range, bearing) and NEES of the ends of a wall, seen from its south."""
    wall = np.array([[2.0, 3.0], [4.0, 3.0], [4.0, 3.0 + thick], [2.0, 3.0 + thick]])
    rng = np.random.default_rng(0)
    extractor = FeatureExtractor(FeatureConfig(range_sigma_m=sigma, edge_sigma=0.29, edge_floor_m=0.0))
    errors, nees = [], []
    for _ in range(200):
        pose = np.array([rng.uniform(*from_x), rng.uniform(0.5, 2.0), rng.uniform(-3, 3)])
        scan = polygon_scan(pose, [ROOM, wall])
        scan.ranges[:] += sigma * rng.standard_normal(BEAMS)
        corners = corners_in(extractor, scan)
        for z, cov, kind in zip(corners.range_bearing, corners.cov, corners.kind, strict=True):
            if kind != CONVEX:
                continue
            error = polar(pose, wall[list(ends)]) - z
            error[:, 1] = wrap(error[:, 1])
            e = error[np.argmin(np.abs(error).sum(1))]
            if len(ends) == 1 and np.abs(e).max() > 0.1:
                continue  # the other one
            errors.append(e)
            nees.append(e @ np.linalg.solve(cov, e))
    return errors, nees


def test_noise_neither_turns_nor_moves_the_walls_of_a_closet() -> None:
    """Short walls seen at an angle, with a corner at both ends, and noise that hides where one begins."""
    rng = np.random.default_rng(2)
    size, sigma = np.array([2.4, 1.6]), 0.03
    closet = size * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    extractor = FeatureExtractor(FeatureConfig(range_sigma_m=sigma))
    errors, nees = [], []
    for _ in range(600):
        pose = np.array([*(size * rng.uniform(0.2, 0.8, 2)), rng.uniform(-3, 3)])
        scan = polygon_scan(pose, [closet])
        scan.ranges[:] += sigma * rng.standard_normal(BEAMS)
        extractor.extract(scan)
        rows = extractor.with_walls()
        for row in rows[rows[:, 5] == LINE]:
            turned = float(wrap(row[1] + pose[2]))
            alpha = math.pi / 2 * round(turned / (math.pi / 2))
            true = {0: size[0] - pose[0], 1: size[1] - pose[1], -1: pose[1]}.get(
                round(alpha / (math.pi / 2)), pose[0]
            )
            e = np.array([row[0] - true, turned - alpha])
            nees.append(e @ np.linalg.solve(np.array([[row[2], row[3]], [row[3], row[4]]]), e))
            # Turned towards the middle of what is seen or away from it, whichever way the scan runs.
            errors.append(e * (1.0, np.sign(row[8] + row[9])))
    assert len(errors) > 4 * 500
    assert 0.6 < np.mean(nees) / 2 < 1.05
    assert np.all(np.abs(np.mean(errors, axis=0)) < 3 * np.std(errors, axis=0) / math.sqrt(len(errors)))


def test_lost_beams_and_open_space_are_no_surfaces() -> None:
    rng = np.random.default_rng(2)
    scan = room_scan(np.array([2.0, 2.0, 0.0]), rng)
    scan.ranges[:90] = np.inf
    scan.ranges[rng.random(BEAMS) < 0.05] = np.nan
    extractor = FeatureExtractor(FeatureConfig())
    extractor.extract(scan)
    assert np.all(extractor.surface[~np.isfinite(scan.ranges)] == -1)
    assert np.count_nonzero(extractor.surface >= 0) > 0.85 * np.count_nonzero(np.isfinite(scan.ranges))
    scan.ranges[:] = np.nan
    assert len(extractor.extract(scan)) == 0


def test_a_round_column_is_no_corner() -> None:
    pose = np.array([1.0, 1.0, 0.0])
    around = np.linspace(0, 2 * math.pi, 90, endpoint=False)
    column = np.array([2.5, 2.0]) + 0.3 * np.column_stack([np.cos(around), np.sin(around)])
    extractor = FeatureExtractor()
    for seed in range(20):
        scan = polygon_scan(pose, [ROOM, column], np.random.default_rng(seed))
        assert not np.any(corners_in(extractor, scan).kind == CONVEX)


def test_few_beams_far_apart_are_never_joined() -> None:
    angles = ANGLE_MIN + 2 * math.pi / 36 * np.arange(36)
    ranges = np.full(36, 2.0)
    extractor = FeatureExtractor()
    assert len(extractor.extract(Scan(ranges, angles[0], angles[1] - angles[0], 8.0))) == 0
    assert np.all(extractor.surface == -1)


@given(st.integers(0, 2**32 - 1))
def test_breaks_are_found_as_between_single_points(seed: int) -> None:
    """Whatever beams are lost, and wherever the circle begins."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(8, 400))
    increment = 2.0 * math.pi / n * (1.0 if rng.random() < 0.5 else 0.6)
    ranges = np.repeat(rng.uniform(0.5, 6.0, n), rng.integers(1, 9, n))[:n] + 0.02 * rng.standard_normal(n)
    ranges[rng.random(n) < rng.choice([0.0, 0.02, 0.5])] = rng.choice([np.nan, np.inf])
    extractor = FeatureExtractor()
    gaps, limits, angles = extractor._gap_table(increment), extractor._limits, increment * np.arange(n)
    rays = np.column_stack([np.cos(angles), np.sin(angles)])
    xy, reach, beam, apart = np.zeros((n, 2)), np.zeros(n), np.zeros(n, np.int64), np.full(n + 2, 7)
    count = points_in_order(ranges, rays, increment, 0.0, limits, gaps, xy, reach, beam, apart)
    assert sorted(beam[:count]) == np.flatnonzero(np.isfinite(ranges)).tolist()
    np.testing.assert_array_equal(reach[:count], ranges[beam[:count]])
    for k in range(count - 1):
        step = int(beam[k + 1] - beam[k]) % n
        assert apart[k] == _breaks(reach[k], reach[k + 1], step, gaps, limits[SIGMA])


@given(st.integers(0, 2**32 - 1))
def test_the_farthest_point_is_the_first_of_the_largest_distance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    xy = rng.integers(0, 4, (int(rng.integers(2, 40)), 2)).astype(float)  # of a few places, so that there are ties
    first, last = sorted(rng.integers(0, len(xy), 2).tolist())
    (dx, dy), relative = xy[last] - xy[first], xy - xy[first]
    distance = np.abs(dx * relative[:, 1] - dy * relative[:, 0])[first + 1 : last]
    expected = -1
    if len(distance) and distance.max() > 0.5 * math.sqrt(dx * dx + dy * dy):
        expected = first + 1 + int(np.argmax(distance))
    assert _farthest(xy, first, last, 0.5) == expected
