"""Curved walls: their curvature from scans, pieces made straight, and a filter in a round room."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.stats import norm

import slam
from slam import LINE, Scan
from slam.features.extraction import FeatureConfig, FeatureExtractor
from slam.landmarks.book import MARKS
from slam.landmarks.curved_walls import along_wall, curvature, curvature_model, first_bend, straighten
from tests.slam.simulated import ANGLE_MIN, ANGLES, INCREMENT, circle_twist, drive

OFFSET = 0.2
seeds = st.integers(0, 10_000)


def round_room(pose: np.ndarray, radius: float, rng: np.random.Generator, *, inside: bool) -> Scan:
    """Scan a circle about the origin from within it, or the near side of one that the sensor stands before."""
    c, s = np.cos(ANGLES + pose[2]), np.sin(ANGLES + pose[2])
    b, q = pose[0] * c + pose[1] * s, pose[0] ** 2 + pose[1] ** 2 - radius**2
    root = np.sqrt(np.where(b * b > q, b * b - q, np.nan))
    ranges = -b + root if inside else np.where(-b - root > 0, -b - root, np.nan)
    ranges = np.where(np.abs(ANGLES) < 0.5, ranges, np.nan) + 0.01 * rng.standard_normal(len(ANGLES))
    return Scan(
        np.where(ranges < 8, ranges, np.inf), angle_min=ANGLE_MIN, angle_increment=INCREMENT, range_max=8.0
    )


@pytest.mark.parametrize("inside", [True, False])
@pytest.mark.parametrize("aside", [0.0, 1.2])  # looked at from the front and at an angle
def test_curvature_is_measured_with_the_variance_that_it_says(inside: bool, aside: float) -> None:
    rng, radius = np.random.default_rng(3), 25.0
    extractor = FeatureExtractor(FeatureConfig())
    pose = np.array([radius + (-2.0 if inside else 2.0), aside, 0.0 if inside else math.pi])
    errors = []
    for _ in range(300):
        extractor.extract(round_room(pose, radius, rng, inside=inside))
        rows = extractor.with_walls()
        # Where the wall bends away from the sensor the curvature is positive. Long pieces look bent by themselves
        # and are refused: that would cut the scatter.
        errors += [(z[10] + (1 if inside else -1) / radius) / math.sqrt(z[11]) for z in rows if z[5] == LINE]
    assert len(errors) > 150
    assert abs(np.mean(errors)) < 0.35
    assert np.var(errors) == pytest.approx(1.0, abs=0.35)


@given(seeds)
@example(7658)
def test_a_piece_of_an_arc_is_turned_into_the_line_of_its_landmark(seed: int) -> None:
    """Tangents at two places of one circle: straightened, the second tells what the first does."""
    rng = np.random.default_rng(seed)
    kappa, alpha = rng.uniform(-0.15, 0.15), rng.uniform(-3, 3)
    e, je = np.array([math.cos(alpha), math.sin(alpha)]), np.array([-math.sin(alpha), math.cos(alpha)])
    pose = rng.uniform(-2, 2, 3)
    sensor = pose[:2] + OFFSET * np.array([math.cos(pose[2]), math.sin(pose[2])])
    r = e @ sensor + rng.uniform(1.5, 4)
    at, beyond = je @ sensor + rng.uniform(-1, 1), rng.uniform(-1, 1)
    # The circle that touches the landmark's line at ``at``; kappa > 0: it bends away, along e.
    turn = -math.asin(kappa * beyond)
    normal = np.array([math.cos(alpha + turn), math.sin(alpha + turn)])
    sag = (1 - math.cos(turn)) / kappa if kappa else 0.0
    point = (r + sag) * e + (at + beyond) * je
    tangent = np.array([-normal[1], normal[0]])
    z, middle = np.zeros((1, 12)), tangent @ (point - sensor)
    z[0, :2] = normal @ (point - sensor), alpha + turn - pose[2]
    z[0, 3], z[0, 4], z[0, 5], z[0, 8], z[0, 9] = 1e-4 * middle, 1e-4, LINE, middle - 0.5, middle + 0.5
    z[0, 10], z[0, 11] = kappa, 1e-9
    x, marks = np.concatenate([pose, [alpha, r]]), np.zeros((1, MARKS))
    marks[0, 10] = at
    off = abs(z[0, 1] - (alpha - pose[2]))
    straighten(x, OFFSET, z, np.zeros(1, np.int64), marks, curvature_model(FeatureConfig()))
    # A curvature of a few σ is hardly believed: the wall is more likely straight.
    assert abs(z[0, 1] - (alpha - pose[2])) <= 0.005 * off + 6.0 * math.sqrt(1e-9) * abs(beyond)
    assert z[0, 0] == pytest.approx(r - e @ sensor, abs=0.002)  # of 7 cm that the arc departs by
    assert marks[0, 9] / marks[0, 8] == pytest.approx(kappa)


@pytest.mark.parametrize("pull", [0.0, 1.0, 4.0, 30.0])
def test_the_curvature_s_moments_are_those_of_the_mixture(pull: float) -> None:
    """Against the posterior over a grid: a narrow spike at zero and a normal slab."""
    config, info = FeatureConfig(wall_curved_share=0.4, wall_curvature_sigma=0.2), 100.0
    kappa = np.linspace(-2, 2, 400_001)
    likelihood = np.exp(pull * kappa - 0.5 * info * kappa**2)
    slab = 0.4 * norm.pdf(kappa, scale=0.2) * likelihood * (kappa[1] - kappa[0])
    mean = (slab @ kappa) / (slab.sum() + 0.6)
    square = (slab @ kappa**2) / (slab.sum() + 0.6)
    got = curvature(info, pull, curvature_model(config))
    assert got[0] == pytest.approx(mean, rel=1e-6, abs=1e-12)
    assert got[1] == pytest.approx(square - mean**2, rel=1e-6)


def test_what_is_not_known_of_a_wall_s_shape_goes_along_its_slope_and_offset() -> None:
    config = FeatureConfig()
    z, x = np.zeros((1, 12)), np.array([0.3, -0.2, 0.4, 0.1, 4.0])
    z[0] = [3.0, -0.3, 1e-4, 2e-5, 1e-4, LINE, 0.0, 0.0, -0.6, 1.0, 0.08, 0.05**2]
    before, marks = z[0].copy(), np.zeros((1, MARKS))
    along = along_wall(0.3 + OFFSET * math.cos(0.4), -0.2 + OFFSET * math.sin(0.4), 0.1)
    marks[0, 8:11] = first_bend(along - 0.5, z[0])
    straighten(x, OFFSET, z, np.zeros(1, np.int64), marks, curvature_model(config))
    _, var, square = curvature(2 / 0.05**2, 2 * 0.08 / 0.05**2, curvature_model(config))
    slope = var * 0.25 + square * config.wall_shape_share**2 * (1.6**2 + 0.25)
    across = z[0, 2] - before[2] - 0.2**2 * slope  # at the middle, 0.2 m from the foot
    np.testing.assert_allclose(z[0, 3:5] - before[3:5], [0.2 * slope, slope])
    assert across == pytest.approx(slope * (1.6**2 / 12 + 0.25 / 4))


def test_points_and_what_is_not_matched_stay_as_they_are() -> None:
    z, x, marks = np.ones((3, 12)), np.arange(9.0), np.zeros((3, MARKS))
    z[1:, 5] = LINE
    straighten(x, OFFSET, z, np.array([0, -1, -2]), marks, curvature_model(FeatureConfig()))
    z[1:, 5] = 1.0
    assert np.all(z == 1.0) and not marks.any()


def bay(turns: np.ndarray) -> np.ndarray:
    """Return points ``(n, 2)`` of a smooth wall round the origin with five flat stretches, bent beside them."""
    radius = 3.0 * (1.0 + 0.04 * np.cos(5 * turns))
    return np.column_stack([radius * np.cos(turns), radius * np.sin(turns)])


def bay_scan(pose: np.ndarray, rng: np.random.Generator) -> Scan:
    """Scan the inside of :func:`bay`."""
    wall = bay(np.linspace(0, 2 * math.pi, 361)) - pose[:2]
    ray = np.column_stack([np.cos(ANGLES + pose[2]), np.sin(ANGLES + pose[2])])
    side = ray[:, :1] * wall[:, 1] - ray[:, 1:] * wall[:, 0]  # (beams, points): left of the ray or right
    ahead = ray @ wall.T > 0
    k = np.argmax((side[:, :-1] * side[:, 1:] <= 0) & ahead[:, :-1] & ahead[:, 1:], axis=1)
    a, b = wall[k], wall[k + 1] - wall[k]
    ranges = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / (ray[:, 0] * b[:, 1] - ray[:, 1] * b[:, 0])
    return Scan(ranges + 0.01 * rng.standard_normal(len(ANGLES)), ANGLE_MIN, INCREMENT, 8.0)


def nees_in_the_bay(config: dict[str, object], runs: int) -> float:
    """Return the average pose NEES / 3 of drives within :func:`bay`."""
    values = []
    for run in range(runs):
        rng = np.random.default_rng(run)
        backend = slam.make("invariant-ekf", config={"lidar_offset_m": 0.0, **config})
        pose = np.array([rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5), rng.uniform(-3, 3)])
        backend.reset(pose, seed=0)
        backend.update(bay_scan(pose, rng))
        for k in range(100):
            var_v, var_w = backend.config.odometry.variances(*circle_twist(k))
            pose, odometry = drive(pose, circle_twist(k), (math.sqrt(var_v), math.sqrt(var_w)), rng)
            backend.predict(odometry)
            backend.update(bay_scan(pose, rng))
            values.append(backend.pose_nees(pose))
    return float(np.mean(values)) / 3


def test_a_filter_over_curved_walls_knows_how_far_off_it_is() -> None:
    straight = {"features": {"wall_curved_share": 0.0}}
    with_bends, without = nees_in_the_bay({}, 8), nees_in_the_bay(straight, 8)
    assert with_bends < 1.5 < without
