"""What holds for every backend that has a name."""

from __future__ import annotations

import math

import numpy as np
import pytest

import slam
from slam.types import Odometry, Scan


@pytest.mark.parametrize("name", slam.names())
def test_no_backend_minds_what_a_broken_lidar_says(name: str) -> None:
    """A sixth of the beams are anything, scan after scan: the pose stays where the others have it."""
    rng, backend = np.random.default_rng(0), slam.make(name)
    backend.reset()
    for k in range(30):
        ranges = 2.0 + rng.normal(0.0, 0.01, 360)
        if k > 3:
            broken = rng.integers(0, 360, 60)
            ranges[broken] = rng.choice([-48.0, -math.inf, -1e-300, 0.0, 1e9, 1e300, math.inf, math.nan], 60)
        backend.predict(Odometry((0.0, 0.0, 0.0), 0.1))
        backend.update(Scan(ranges, -math.pi, 2.0 * math.pi / 360, 8.0))
    assert np.hypot(*backend.pose[:2]) < 0.05 and np.all(np.isfinite(backend.pose_cov))
