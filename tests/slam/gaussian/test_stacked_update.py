"""The stacked update's kernels against the plain formulas, at sizes that fill no tile; the same bits always."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import njit

import slam
from slam.gaussian.lanes import LANES, add_product, aligned_zeros, first, load, store, subtract_product, times
from slam.gaussian.stacked_update import SPARE_ROWS
from slam.gaussian.tiles import add_combination, downdate, product
from tests.slam.simulated import circle_twist, drive, observe_landmarks

STEPS = 12
LARGE = 90  # landmarks: a state of 183
sizes = st.integers(1, 90)


def explore_grove(name: str) -> slam.Belief:
    """Return the belief after some steps among many landmarks."""
    rng = np.random.default_rng(4)
    landmarks = rng.uniform(-8, 8, (LARGE, 2))
    backend = slam.make(name)
    backend.reset(pose_cov=np.diag([0.01, 0.01, 0.01]))
    pose = np.zeros(3)
    for k in range(STEPS):
        pose, odometry = drive(pose, circle_twist(10 * k), (0.02, 0.02), rng)
        backend.predict(odometry)
        backend.observe(observe_landmarks(pose, landmarks, 0.2, np.diag([1e-3, 1e-4]), rng))
    assert backend.landmark_count == LARGE
    return backend.belief


@njit
def _twice_less_three(out, a, count):
    mask = first(count)
    v = times(2.0, load(a, 1, mask))
    store(out, (1, 2), mask, subtract_product(add_product(v, 0.5, v), 3.0, load(a, 0, None)))


@pytest.mark.parametrize("count", [-1, 0, 1, LANES - 1, LANES, LANES + 1])
def test_a_mask_leaves_out_lanes(count: int) -> None:
    a, out = np.arange(1.0, 2 * LANES + 1), np.full((2, LANES + 4), -1.0)
    _twice_less_three(out, a, count)
    k = min(max(count, 0), LANES)
    np.testing.assert_array_equal(out[1, 2 : 2 + k], 3 * a[1 : 1 + k] - 3 * a[:k])
    out[1, 2 : 2 + k] = -1.0
    assert np.all(out == -1.0)


@pytest.mark.parametrize("columns", [1, 8, 9, 67, 128])
def test_rows_begin_at_cache_lines_of_their_own(columns: int) -> None:
    a = aligned_zeros(3, columns)
    assert a.shape[0] == 3 and a.shape[1] >= columns and a.flags.c_contiguous and not a.any()
    assert a.ctypes.data % 64 == 0 and a.strides[0] % 128 == 64


@given(sizes, st.integers(0, 4), st.sampled_from([0, 1, 3]))
def test_downdate_is_the_plain_product(n: int, observations: int, pairs: int) -> None:
    rng = np.random.default_rng(n)
    rows = 2 * observations
    p, w = rng.normal(size=(n + 2, n + 2)), rng.normal(size=(rows + SPARE_ROWS, n + 2))
    out = p.copy()
    downdate(out, n, w, w, rows, pairs)
    a, b = w[rows : rows + 2 * pairs : 2, :n], w[rows + 1 : rows + 2 * pairs : 2, :n]
    want = p[:n, :n] - w[:rows, :n].T @ w[:rows, :n] - a.T @ b - b.T @ a
    np.testing.assert_allclose(np.triu(out[:n, :n]), np.triu(want), atol=1e-12)
    np.testing.assert_array_equal(out[n:], p[n:])  # nothing beyond the state is touched
    np.testing.assert_array_equal(out[:, n:], p[:, n:])


@given(sizes, st.sampled_from([0, 1, 3]))
def test_an_entry_s_bits_do_not_depend_on_its_place_in_a_tile(n: int, pairs: int) -> None:
    rng = np.random.default_rng(n)
    p, w = rng.normal(size=(100, 100)), rng.normal(size=(10 + SPARE_ROWS, 100))
    part, whole = p.copy(), p.copy()
    downdate(part, n, w, w, 10, pairs)
    downdate(whole, 100, w, w, 10, pairs)
    np.testing.assert_array_equal(np.triu(part[:n, :n]), np.triu(whole[:n, :n]))


@given(sizes, st.integers(0, 10))
def test_add_combination_is_the_plain_product(n: int, rows: int) -> None:
    rng = np.random.default_rng(n)
    out, factors, w = rng.normal(size=n + 1), rng.normal(size=rows), rng.normal(size=(12, n))
    want = out.copy()
    want[:n] += factors @ w[:rows]
    add_combination(out, n, factors, w)
    np.testing.assert_allclose(out, want, atol=1e-12)


def test_a_large_product_is_rounded_like_a_small_one() -> None:
    """It is done some columns at a time, which changes no bit."""
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(150, 150)), rng.normal(size=(150, 800))
    whole, p = product(a, b, 800), aligned_zeros(800, 800)
    downdate(p, 800, b, b, 150, 0)
    np.testing.assert_allclose(whole[:, :800], a @ b, atol=1e-11)
    np.testing.assert_allclose(np.triu(p[:, :800]), np.triu(-b.T @ b), atol=1e-11)
    for begin in range(0, 800, 50):
        part, q = np.ascontiguousarray(b[:, begin : begin + 50]), aligned_zeros(50, 50)
        np.testing.assert_array_equal(product(a, part, 50)[:, :50], whole[:, begin : begin + 50])
        downdate(q, 50, part, part, 150, 0)
        np.testing.assert_array_equal(np.triu(q[:, :50]), np.triu(p[begin : begin + 50, begin : begin + 50]))


@given(sizes, sizes, st.integers(0, 30))
def test_product_is_the_plain_one(height: int, n: int, depth: int) -> None:
    rng = np.random.default_rng(n)
    a, b = rng.normal(size=(height, depth)), rng.normal(size=(depth, n + 3))
    out = product(a, b, n)
    np.testing.assert_allclose(out[:, :n], a @ b[:, :n], atol=1e-12)
    assert not out[:, n:].any()


@pytest.mark.parametrize("name", ["ekf", "compressed-ekf"])
def test_the_same_bits_whatever_the_number_of_threads(name: str) -> None:
    code = (
        f"import hashlib; from tests.slam.gaussian.test_stacked_update import explore_grove; "
        f"b = explore_grove('{name}');"
        "print(hashlib.sha256(b.pose.tobytes() + b.joint_cov.tobytes()).hexdigest())"
    )
    results = [
        subprocess.run(
            [sys.executable, "-c", code],
            env=os.environ | {"OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for threads in ("1", "2")
    ]
    assert results[0] == results[1] != ""
