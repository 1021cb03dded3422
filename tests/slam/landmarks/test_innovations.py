"""What a filter's witness is told: innovations as the belief before the correction has them."""

from __future__ import annotations

import numpy as np
import pytest

import slam
from slam.geometry import wrap_scalar
from slam.landmarks.innovations import Innovation
from slam.types import Observations, Odometry
from tests.slam.numerics import numerical_jacobian

R = np.array([[4e-4, 1e-5], [1e-5, 1e-4]])
OFFSET = 0.2


def seen(x: np.ndarray) -> np.ndarray:
    """Range and bearing of the only landmark of a state (docs/reference/ekf.md)."""
    dx, dy = x[3] - x[0] - OFFSET * np.cos(x[2]), x[4] - x[1] - OFFSET * np.sin(x[2])
    return np.array([np.hypot(dx, dy), wrap_scalar(np.arctan2(dy, dx) - x[2])])


@pytest.mark.parametrize("name", ["ekf", "invariant-ekf", "compressed-ekf"])
def test_the_witness_is_told_before_the_correction(name: str) -> None:
    backend = slam.make(name)
    backend.reset()
    first = np.array([[3.0, 0.4]])
    backend.observe(Observations(first, R[None], np.array([7])))
    backend.predict(Odometry((0.3, 0.1, 0.2), 0.1))
    told: list[Innovation] = []
    backend.witness = told.extend
    belief = backend.belief
    x, p = np.concatenate([belief.pose, belief.landmarks[0]]), belief.joint_cov
    z = seen(x) + np.array([0.03, -0.02])
    backend.observe(Observations(z[None], R[None], np.array([7])))
    (innovation,) = told
    h = numerical_jacobian(seen, x, angle=1)
    nu = z - seen(x)
    assert innovation.landmark == 7
    assert innovation.kind == "landmark"
    assert innovation.seen == pytest.approx(z)
    assert innovation.expected == pytest.approx(seen(x))
    assert innovation.nis == pytest.approx(nu @ np.linalg.solve(h @ p @ h.T + R, nu), rel=1e-4)
