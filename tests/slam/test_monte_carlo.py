"""Long statistical runs, left out by default: ``make monte-carlo``."""

from __future__ import annotations

import math

import numpy as np
import pytest

import slam
from slam.metrics.measures import nees_band, nees_pose
from tests.slam.simulated import drive, observe_landmarks

pytestmark = pytest.mark.monte_carlo

RUNS, STEPS = 50, 600


def circle_runs(start_sigma_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """Drive a circle among 20 landmarks; return pose NEES (runs, steps) and NIS per degree of freedom."""
    rng = np.random.default_rng(1)
    around = np.linspace(0, 2 * math.pi, 20, endpoint=False)
    landmarks = np.column_stack([8 * np.cos(around), 4 + 8 * np.sin(around)])
    cov = np.diag([0.02**2, 0.01**2])
    values, nis = np.zeros((RUNS, STEPS)), []
    for run in range(RUNS):
        backend = slam.make("ekf")
        start_cov = np.diag([1e-6, 1e-6, start_sigma_rad**2])
        backend.reset((0, 0, 0), pose_cov=start_cov)
        pose = np.array([0.0, 0.0, start_sigma_rad * rng.standard_normal()])
        for k in range(STEPS):
            twist = np.array([0.5, 0.0, 0.5 / 4.0])
            var_v, var_w = backend.config.odometry.variances(*twist)
            pose, odometry = drive(pose, twist, (math.sqrt(var_v), math.sqrt(var_w)), rng)
            backend.predict(odometry)
            sensor = backend.config.lidar_offset_m
            backend.observe(observe_landmarks(pose, landmarks, sensor, cov, rng, reach=7.0))
            values[run, k] = nees_pose(backend.pose, backend.pose_cov, pose)
            if backend.nis_dof:
                nis.append(backend.nis / backend.nis_dof)
    return values, np.array(nis)


def test_the_ekf_is_consistent_while_the_heading_is_known_to_a_degree() -> None:
    values, nis = circle_runs(math.radians(0.3))
    averages = values.mean(axis=0) / 3
    assert 0.9 < nis.mean() < 1.1
    low, high = nees_band(3, RUNS)
    assert np.mean((averages >= low) & (averages <= high)) > 0.8


def test_the_ekf_grows_too_sure_once_the_heading_is_not() -> None:
    """The known inconsistency of the standard EKF; NIS does not show it."""
    values, nis = circle_runs(math.radians(3.0))
    assert 0.9 < nis.mean() < 1.1
    assert values.mean() / 3 > 2.0
