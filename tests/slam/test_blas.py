"""The downdate by BLAS against the loop, and on the maps that are large enough for it."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

import slam
from slam import ekf, invariant
from slam.blas import rank_k_downdate
from slam.joint_gaussian import downdate
from tests.slam.simulated import circle_twist, drive, observe_landmarks

STEPS = 12
LARGE = 90  # landmarks: a state of 183


def explore_grove(name: str) -> slam.Belief:
    """Return the belief after some steps among more landmarks than the loop would take."""
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


@pytest.mark.parametrize(("n", "rows"), [(7, 2), (133, 20), (203, 6)])
def test_downdate_is_the_loop_s(n: int, rows: int) -> None:
    rng = np.random.default_rng(n)
    p, w = rng.normal(size=(n + 9, n + 9)), rng.normal(size=(rows + 4, n + 9))
    one, two = p.copy(), p.copy()
    rank_k_downdate(one, n, w, rows)
    downdate(two, n, w, rows)
    np.testing.assert_allclose(np.triu(one[:n, :n]), np.triu(two[:n, :n]), atol=1e-12)
    np.testing.assert_array_equal(one[n:], p[n:])  # nothing beyond the state is touched
    np.testing.assert_array_equal(one[:, n:], p[:, n:])


@pytest.mark.parametrize("name", ["ekf", "invariant-ekf"])
def test_large_maps_come_out_the_same_either_way(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    by_blas = explore_grove(name)
    for module in (ekf, invariant):
        monkeypatch.setattr(module, "BLAS_FROM", 10**9)
    by_loop = explore_grove(name)
    np.testing.assert_allclose(by_blas.pose, by_loop.pose, atol=1e-9)
    np.testing.assert_allclose(by_blas.landmarks, by_loop.landmarks, atol=1e-9)
    assert by_blas.joint_cov is not None
    np.testing.assert_allclose(by_blas.joint_cov, by_loop.joint_cov, atol=1e-9)


@pytest.mark.parametrize("name", ["ekf", "compressed-ekf"])
def test_the_same_bits_whatever_the_number_of_threads(name: str) -> None:
    code = (
        f"import hashlib; from tests.slam.test_blas import explore_grove; b = explore_grove('{name}');"
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
