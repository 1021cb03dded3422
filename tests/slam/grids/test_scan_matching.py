from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slam import Scan
from slam.geometry import compose, transform_points, wrap
from slam.grids.match_kernels import field_sum, slope
from slam.grids.scan_matching import (
    LikelihoodField,
    MatchConfig,
    body_points,
    match,
    refine,
    search,
)
from slam.settings import from_mapping
from tests.slam.numerics import numerical_jacobian
from tests.slam.simulated import room_scan

CONFIG = MatchConfig()
seeds = st.integers(0, 10_000)
HERE = np.array([2.3, 2.1, 0.4])


def room_field(config: MatchConfig = CONFIG) -> LikelihoodField:
    """A field of the room's walls themselves, 6 m × 5 m."""
    x, y = np.arange(0, 6.0, 0.02), np.arange(0, 5.0, 0.02)
    walls = [(x, 0 * x), (x, 0 * x + 5.0), (0 * y, y), (0 * y + 6.0, y)]
    return LikelihoodField(config, np.vstack([np.column_stack(w) for w in walls]))


def difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    d = a - b
    d[2] = wrap(d[2])
    return d


def random_field(seed: int) -> tuple[LikelihoodField, np.ndarray, np.random.Generator]:
    rng = np.random.default_rng(seed)
    surface = rng.uniform(-1.5, 1.5, (60, 2))
    return LikelihoodField(CONFIG, surface), rng.uniform(-1.5, 1.5, (40, 2)), rng


@settings(max_examples=25)
@given(seeds)
def test_a_known_offset_in_a_room_is_recovered(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = np.array([rng.uniform(1.0, 5.0), rng.uniform(1.0, 4.0), rng.uniform(-math.pi, math.pi)])
    points = body_points(room_scan(true, rng), CONFIG)
    off = rng.uniform(-1, 1, 3) * np.array([0.28, 0.28, 0.23])
    found = match(room_field(), points, compose(true, off), CONFIG)
    error = difference(found.pose, true)
    assert np.hypot(*error[:2]) < 0.01
    assert abs(error[2]) < 0.004
    assert found.score > 0.9


def test_a_scan_matches_the_scan_before_it_seen_through_an_offset_sensor() -> None:
    rng = np.random.default_rng(2)
    poses = [HERE, compose(HERE, np.array([0.2, -0.1, 0.15]))]
    ahead = np.array([0.2, 0.0, 0.0])
    points = [body_points(room_scan(compose(p, ahead), rng), CONFIG, offset_m=0.2) for p in poses]
    field = LikelihoodField(CONFIG, transform_points(poses[0], points[0]))
    np.testing.assert_allclose(difference(match(field, points[1], poses[0], CONFIG).pose, poses[1]), 0, atol=0.02)


@settings(max_examples=20)
@given(seeds)
def test_the_search_by_bounds_finds_what_trying_everything_finds(seed: int) -> None:
    field, points, rng = random_field(seed)
    config = from_mapping(MatchConfig, {"window_m": 0.2, "window_rad": 0.05}, base=CONFIG)
    guess = rng.uniform(-0.5, 0.5, 3)
    info = np.diag(rng.uniform(0, 30, 3))

    def value(pose: np.ndarray) -> float:
        x, y = transform_points(pose, points).T
        row, col = (np.floor((v - v0) / 0.05 + 0.5).astype(int) for v, v0 in ((y, field.y0), (x, field.x0)))
        rows, cols = field.values.shape
        inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
        d = difference(pose, guess)
        return config.gain * float(field.values[row[inside], col[inside]].sum()) - 0.5 * d @ info @ d

    steps, turns = np.arange(-4, 5) * 0.05, np.arange(-4, 5) * config.step_rad
    # The search shifts whole cells, so compare by the value and not by the pose.
    best = max(value(guess + np.array(s)) for s in itertools.product(steps, steps, turns))
    found = search(field, points, guess, config, prior_info=info)
    # A point on a cell's edge may round either way: one point's worth.
    assert value(found) >= best - config.gain * 1.0


@settings(max_examples=40)
@given(seeds)
def test_gradient_against_finite_differences(seed: int) -> None:
    field, points, rng = random_field(seed)
    pose = rng.uniform(-0.4, 0.4, 3)
    # The field ends with a step: keep points away from its rim.
    shape = np.array(field.values.shape[::-1])
    cells = (transform_points(pose, points) - np.array([field.x0, field.y0])) / field.cell_m
    points = points[np.all((cells > 1) & (cells < shape - 2), axis=1)]
    args = (field.values, field.x0, field.y0, field.cell_m, points)
    gradient, curvature = np.empty(3), np.empty((3, 3))
    total = slope(*args, pose, gradient, curvature)
    assert total == pytest.approx(field_sum(*args, pose), rel=1e-12)
    want = numerical_jacobian(lambda p: np.array([field_sum(*args, p)]), pose)[0]
    np.testing.assert_allclose(gradient, want, atol=1e-5 * max(1.0, float(np.abs(want).max())))
    np.testing.assert_array_equal(curvature, curvature.T)
    assert np.linalg.eigvalsh(curvature)[0] > -1e-6


def test_covariance_against_the_scatter_of_matches() -> None:
    """A field without error and independent beams: the covariance is that of the range noise, each beam one."""
    sigma = 0.02
    config = MatchConfig(sigma_m=sigma, beam_weight=1.0, beams=360)
    field, rng = room_field(config), np.random.default_rng(3)
    errors, covs = [], []
    for _ in range(150):
        points = body_points(room_scan(HERE, rng, sigma=sigma), config)
        found = refine(field, points, HERE, config)
        errors.append(difference(found.pose, HERE))
        covs.append(found.cov)
    scatter, cov = np.cov(np.transpose(errors)), np.mean(covs, axis=0)
    ratio = np.sqrt(np.diag(cov) / np.diag(scatter))
    # Range noise acts along the beam: across a wall seen at an angle less of it is left than σ. Never too sure.
    assert np.all((ratio > 0.8) & (ratio < 2.0)), ratio


def test_a_corridor_leaves_its_own_direction_open() -> None:
    x = np.arange(-20, 20, 0.02)
    field = LikelihoodField(CONFIG, np.vstack([np.column_stack([x, 0 * x + s]) for s in (-1.0, 1.0)]))
    angles = np.radians(np.arange(0, 360))
    with np.errstate(divide="ignore"):
        ranges = 1.0 / np.abs(np.sin(angles))
    scan = Scan(np.where(ranges < 8, ranges, np.inf), 0.0, math.radians(1.0), 8.0)
    found = refine(field, body_points(scan, CONFIG), np.array([0.3, 0.05, 0.02]), CONFIG)
    np.testing.assert_allclose(found.pose[1:], 0, atol=0.01)
    assert found.cov[0, 0] > 100 * found.cov[1, 1]
    prior = refine(field, body_points(scan, CONFIG), np.array([0.3, 0.05, 0.02]), CONFIG,
                   prior=np.zeros(3), prior_info=np.diag([1e4, 1e-6, 1e-6]))  # fmt: skip
    assert abs(prior.pose[0]) < 0.1


def test_lost_and_endless_beams_are_left_out() -> None:
    scan = room_scan(HERE)
    ranges = scan.ranges.copy()
    ranges[::3], ranges[1::7], ranges[5], ranges[8] = np.nan, np.inf, 20.0, 0.0
    points = body_points(scan._replace(ranges=ranges, range_min=0.1), CONFIG)
    assert np.all(np.isfinite(points)) and 0 < len(points) <= CONFIG.beams
    found = match(room_field(), points, HERE + np.array([0.2, -0.1, 0.1]), CONFIG)
    np.testing.assert_allclose(difference(found.pose, HERE), 0, atol=0.01)
    nothing = match(room_field(), np.zeros((0, 2)), HERE, CONFIG)
    np.testing.assert_array_equal(nothing.pose, HERE)
    assert nothing.score == 0.0 and np.all(np.linalg.eigvalsh(nothing.cov) > 1.0)


def test_people_in_the_way_do_not_move_the_match() -> None:
    rng = np.random.default_rng(1)
    scan = room_scan(HERE, rng)
    ranges = scan.ranges.copy()
    ranges[40:130] *= 0.5
    points = body_points(scan._replace(ranges=ranges), CONFIG)
    found = match(room_field(), points, HERE + np.array([0.2, -0.1, 0.1]), CONFIG)
    np.testing.assert_allclose(difference(found.pose, HERE), 0, atol=0.02)


@pytest.mark.parametrize("bad", [{"cell_m": 0.0}, {"smooth_m": 0.01}, {"beams": 0}, {"window_m": -1.0}])
def test_configuration_is_checked(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="MatchConfig"):
        MatchConfig(**bad)  # type: ignore[arg-type]
