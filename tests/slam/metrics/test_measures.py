from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import spatial, stats

from slam.geometry import compose, exp, transform_points, wrap
from slam.metrics import measures as metrics
from slam.metrics.chi_square import chi2_quantile

RNG_SEED = 7
angles = st.floats(-math.pi, math.pi)
offsets = st.floats(-50.0, 50.0)
transforms = st.tuples(offsets, offsets, angles).map(np.array)


def trajectory(rng: np.random.Generator, n: int = 40) -> np.ndarray:
    poses = [np.zeros(3)]
    for _ in range(n - 1):
        poses.append(compose(poses[-1], exp(rng.normal([0.1, 0.0, 0.0], [0.02, 0.02, 0.3]))))
    return np.array(poses)


def moved(transform: np.ndarray, poses: np.ndarray) -> np.ndarray:
    return np.array([compose(transform, pose) for pose in poses])


def spd(rng: np.random.Generator, k: int) -> np.ndarray:
    factor = rng.normal(size=(k, k))
    return factor @ factor.T + 0.05 * np.eye(k)


# --- trajectories


def test_ate_of_a_constant_offset_is_its_length() -> None:
    true = trajectory(np.random.default_rng(RNG_SEED))
    est = true + np.array([3.0, 4.0, 0.7])
    assert metrics.ate(true, est) == pytest.approx(5.0)
    assert metrics.ate_aligned(true, est) == pytest.approx(0.0, abs=1e-12)


def test_ate_is_root_mean_square() -> None:
    assert metrics.ate(np.zeros((2, 3)), [[1.0, 0.0, 0.0], [0.0, 7.0, 0.0]]) == pytest.approx(5.0)


@given(transforms)
def test_ate_is_invariant_under_a_common_motion_and_aligned_under_any(transform: np.ndarray) -> None:
    rng = np.random.default_rng(RNG_SEED)
    true = trajectory(rng)
    est = true + rng.normal(0, 0.05, true.shape)
    assert metrics.ate(moved(transform, true), moved(transform, est)) == pytest.approx(metrics.ate(true, est))
    aligned = metrics.ate_aligned(true, est)
    assert metrics.ate_aligned(true, moved(transform, est)) == pytest.approx(aligned, rel=1e-6)
    assert metrics.ate_aligned(moved(transform, true), est) == pytest.approx(aligned, rel=1e-6)
    assert aligned <= metrics.ate(true, est)


def test_alignment_is_scipys() -> None:
    rng = np.random.default_rng(RNG_SEED)
    true = trajectory(rng)
    est = moved(np.array([1.0, -2.0, 2.5]), true) + rng.normal(0, 0.1, true.shape)
    pose = metrics.align_se2(true, est)
    t, e = (np.column_stack([p[:, :2] - p[:, :2].mean(axis=0), np.zeros(len(p))]) for p in (true, est))
    rotation, distance = spatial.transform.Rotation.align_vectors(t, e)
    assert pose[2] == pytest.approx(rotation.as_euler("xyz")[2])
    assert metrics.ate_aligned(true, est) == pytest.approx(distance / math.sqrt(len(true)))
    np.testing.assert_allclose(transform_points(pose, est[:, :2]).mean(axis=0), true[:, :2].mean(axis=0))


def test_alignment_keeps_the_scale() -> None:
    true = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    assert metrics.ate_aligned(true, 2.0 * true) == pytest.approx(1.0)


def test_heading_errors_wrap() -> None:
    errors = metrics.heading_errors([[0, 0, 3.0], [0, 0, 0.1]], [[0, 0, -3.0], [0, 0, 0.3]])
    np.testing.assert_allclose(errors, [2 * math.pi - 6.0, 0.2])


@pytest.mark.parametrize("function", [metrics.ate, metrics.ate_aligned, metrics.heading_errors])
def test_unequal_or_empty_trajectories_are_refused(function: object) -> None:
    with pytest.raises(ValueError, match="poses"):
        function(np.zeros((3, 3)), np.zeros((4, 3)))  # type: ignore[operator]
    with pytest.raises(ValueError, match="poses"):
        function(np.zeros((0, 3)), np.zeros((0, 3)))  # type: ignore[operator]


# --- consistency


@given(st.integers(0, 2**32 - 1))
@settings(deadline=None)  # the first call compiles
def test_nees_is_the_quadratic_form(seed: int) -> None:
    rng = np.random.default_rng(seed)
    est, true, cov = rng.uniform(-4, 4, 3), rng.uniform(-4, 4, 3), spd(rng, 3)
    error = true - est
    error[2] = wrap(error[2])
    assert metrics.nees_pose(est, cov, true) == pytest.approx(error @ np.linalg.solve(cov, error), rel=1e-8)


def test_nees_wraps_the_heading() -> None:
    est, true = np.array([0.0, 0.0, 3.1]), np.array([0.0, 0.0, -3.1])
    expected = (2 * math.pi - 6.2) ** 2 / 0.01
    assert metrics.nees_pose(est, 0.01 * np.eye(3), true) == pytest.approx(expected)


def test_nees_of_gaussian_errors_averages_the_degrees_of_freedom() -> None:
    rng = np.random.default_rng(RNG_SEED)
    cov = 0.02 * spd(rng, 3)  # headings far from the wrap
    errors = rng.multivariate_normal(np.zeros(3), cov, size=20_000)
    values = np.array([metrics.nees_pose(np.zeros(3), cov, error) for error in errors])
    # Three standard errors of the mean of χ² with 3 degrees of freedom.
    assert abs(values.mean() - 3.0) < 3.0 * math.sqrt(6.0 / len(values))
    assert stats.kstest(values, stats.chi2(3).cdf).pvalue > 1e-3
    low, high = metrics.nees_band(3, len(values))
    assert low < metrics.anees(values) < high


def test_invariant_nees_counts_the_invariant_error() -> None:
    rng = np.random.default_rng(RNG_SEED)
    est, cov = np.array([4.0, -7.0, 2.8]), spd(rng, 3)
    offset = np.array([[0.0, -1.0], [1.0, 0.0]]) @ est[:2]
    to_ordinary = np.array([[1.0, 0.0, offset[0]], [0.0, 1.0, offset[1]], [0.0, 0.0, 1.0]])  # T(x̂)
    for xi in rng.normal(0, [1.0, 1.0, 0.9], size=(20, 3)):
        true = compose(exp(xi), est)
        cov_xi = np.linalg.inv(to_ordinary) @ cov @ np.linalg.inv(to_ordinary).T
        expected = xi @ np.linalg.solve(cov_xi, xi)
        assert metrics.nees_pose_invariant(est, cov, true) == pytest.approx(expected, rel=1e-9)


def test_invariant_nees_meets_the_ordinary_one_at_small_errors() -> None:
    rng = np.random.default_rng(RNG_SEED)
    est, cov = np.array([1.0, 2.0, -3.0]), spd(rng, 3)
    for size in (1e-5, 1e-8):  # on both sides of the kernel's series
        true = est + size * rng.normal(size=3)
        ordinary = metrics.nees_pose(est, cov, true)
        assert metrics.nees_pose_invariant(est, cov, true) == pytest.approx(ordinary, rel=1e3 * size)


def test_nees_of_a_singular_covariance() -> None:
    flat, origin = np.diag([4.0, 0.0, 1.0]), np.zeros(3)
    error = np.array([[2.0, 0.0, 0.0], [0.0, 1e-9, 0.0]])
    assert metrics.nees_pose(origin, flat, error[0]) == 1.0
    assert metrics.nees_pose(origin, flat, error[1]) == math.inf
    assert metrics.nees_pose(origin, np.zeros((3, 3)), origin) == 0.0
    # Rank one, as after exact knowledge across one direction.
    direction = np.array([1.0, 2.0, 3.0])
    rank_one = np.outer(direction, direction)
    assert metrics.nees_pose(origin, rank_one, 0.5 * direction) == pytest.approx(0.25)


def test_nees_of_what_is_no_covariance_is_nan() -> None:
    origin = np.zeros(3)
    assert math.isnan(metrics.nees_pose(origin, np.diag([1.0, -1.0, 1.0]), np.ones(3)))
    assert math.isnan(metrics.nees_pose(origin, np.full((3, 3), np.nan), np.ones(3)))
    assert math.isnan(metrics.nees_pose(origin, np.eye(3), np.array([0.0, np.nan, 0.0])))


def test_nees_band_is_the_published_one() -> None:
    assert metrics.nees_band(3, 50) == pytest.approx((0.79, 1.24), abs=0.005)


@given(st.integers(1, 6), st.integers(1, 200), st.floats(0.5, 0.999))
def test_nees_band_is_scipys(dof: int, runs: int, confidence: float) -> None:
    expected = np.array(stats.chi2.interval(confidence, dof * runs)) / (dof * runs)
    assert metrics.nees_band(dof, runs, confidence=confidence) == pytest.approx(expected, rel=1e-8)


@given(st.floats(1e-12, 1.0 - 1e-12), st.floats(0.3, 2e4))
def test_chi2_quantile_is_scipys(probability: float, dof: float) -> None:
    # scipy's own upper tail, not 1 - p, where p is near 1.
    upper = probability > 0.5
    expected = stats.chi2.isf(1 - probability, dof) if upper else stats.chi2.ppf(probability, dof)
    assert chi2_quantile(probability, dof) == pytest.approx(expected, rel=1e-8, abs=1e-300)


def test_chi2_quantile_ends_and_errors() -> None:
    assert chi2_quantile(0.0, 3) == 0.0
    assert chi2_quantile(1.0, 3) == math.inf
    assert chi2_quantile(0.95, 2) == pytest.approx(-2.0 * math.log(0.05), rel=1e-12)
    for probability, dof in ((-0.1, 3), (1.1, 3), (math.nan, 3), (0.5, 0), (0.5, math.inf)):
        with pytest.raises(ValueError, match="chi2_quantile"):
            chi2_quantile(probability, dof)


def test_anees_leaves_out_what_is_undefined() -> None:
    values = np.array([[3.0, np.nan, 6.0], [9.0, np.nan, np.inf]])
    np.testing.assert_array_equal(metrics.anees(values, axis=0), [2.0, np.nan, np.inf])
    assert metrics.anees([2.0, 4.0], dof=2) == 1.5
    assert np.isnan(metrics.anees([]))


# --- corners


@given(st.integers(0, 2**32 - 1), st.integers(1, 30), st.integers(1, 30))
@settings(deadline=None)  # the first call compiles
def test_corner_deviation_is_the_nearest_neighbour_distance(seed: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    estimated, true = rng.uniform(-5, 5, (n, 2)), rng.uniform(-5, 5, (m, 2))
    expected, _ = spatial.cKDTree(true).query(estimated)
    mean, worst, each = metrics.corner_deviation(estimated, true)
    np.testing.assert_allclose(each, expected)
    assert (mean, worst) == pytest.approx((expected.mean(), expected.max()))


def test_corner_deviation_does_not_align() -> None:
    corners = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]])
    assert metrics.corner_deviation(corners + np.array([0.3, 0.4]), corners)[:2] == pytest.approx((0.5, 0.5))


def test_corner_deviation_of_nothing_is_nan() -> None:
    for estimated, true in ((np.zeros((0, 2)), np.ones((2, 2))), (np.ones((2, 2)), np.zeros((0, 2)))):
        mean, worst, each = metrics.corner_deviation(estimated, true)
        assert math.isnan(mean) and math.isnan(worst)
        assert each.shape == (len(estimated),) and np.isnan(each).all()


# --- maps


def raster(*rows: str) -> np.ndarray:
    return np.array([[cell == "#" for cell in row] for row in rows])


def test_compare_walls_by_hand() -> None:
    true = raster("####....", "........", "........", "........")
    belief = raster("........", "####....", "........", ".......#")
    # One row off: wrong at tolerance 0; at tolerance 1 all is found, and the speck alone is wrong.
    assert metrics.compare_walls(belief, true, tolerance_cells=0) == (0.0, 0.0, 0.0)
    assert metrics.compare_walls(belief, true, tolerance_cells=1) == (4 / 5, 4 / 5, 1.0)


def test_compare_walls_at_tolerance_zero_is_plain_iou() -> None:
    rng = np.random.default_rng(RNG_SEED)
    belief, true = rng.random((2, 30, 40)) < 0.3
    both = np.count_nonzero(belief & true)
    score = metrics.compare_walls(belief, true, tolerance_cells=0)
    assert score.iou == pytest.approx(both / np.count_nonzero(belief | true))
    assert score.precision == pytest.approx(both / np.count_nonzero(belief))
    assert score.recall == pytest.approx(both / np.count_nonzero(true))


@pytest.mark.parametrize("tolerance", [1.0, math.sqrt(2.0), 2.0, 2.3, 5.0])
def test_compare_walls_measures_euclidean_distance(tolerance: float) -> None:
    rng = np.random.default_rng(RNG_SEED)
    belief, true = rng.random((2, 40, 50)) < 0.02
    b, t = np.argwhere(belief), np.argwhere(true)
    apart = spatial.distance.cdist(b, t) <= tolerance + 1e-9
    right, found = apart.any(axis=1).sum(), apart.any(axis=0).sum()
    score = metrics.compare_walls(belief, true, tolerance_cells=tolerance)
    assert score.precision == pytest.approx(right / len(b))
    assert score.recall == pytest.approx(found / len(t))
    assert score.iou == pytest.approx(found / (len(t) + len(b) - right))


def test_compare_walls_of_empty_rasters() -> None:
    empty, full = np.zeros((3, 3), bool), np.ones((3, 3), bool)
    assert all(map(math.isnan, metrics.compare_walls(empty, empty, tolerance_cells=1)))
    iou, precision, recall = metrics.compare_walls(empty, full, tolerance_cells=1)
    assert (iou, recall) == (0.0, 0.0) and math.isnan(precision)
    iou, precision, recall = metrics.compare_walls(full, empty, tolerance_cells=1)
    assert (iou, precision) == (0.0, 0.0) and math.isnan(recall)
    with pytest.raises(ValueError, match="lattice"):
        metrics.compare_walls(empty, np.zeros((3, 4), bool), tolerance_cells=1)


def test_coverage() -> None:
    belief, true = raster("##..", "#..."), raster(".##.", "#...")
    assert metrics.coverage(belief, true) == pytest.approx(2 / 3)
    assert math.isnan(metrics.coverage(belief, np.zeros_like(true)))


def test_time_to() -> None:
    curve, times = [0.1, 0.5, 0.4, 0.9], [0.0, 0.1, 0.2, 0.3]
    assert metrics.time_to(curve, times, level=0.5) == 0.1
    assert metrics.time_to(curve, times, level=0.9) == 0.3
    assert metrics.time_to(curve, times, level=0.95) is None
    assert metrics.time_to([], [], level=0.5) is None
    with pytest.raises(ValueError, match="times"):
        metrics.time_to(curve, times[1:], level=0.5)
