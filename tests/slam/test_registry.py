"""What holds for every backend that has a name."""

from __future__ import annotations

import math
from typing import Any

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


@pytest.mark.parametrize("name", slam.names())
@pytest.mark.parametrize(
    ("wrong", "what"),
    [
        ({"ranges": np.zeros(0)}, r"one at least, got float64 \(0,\)"),
        ({"ranges": np.ones((2, 180))}, r"got float64 \(2, 180\)"),
        ({"ranges": [2.0] * 360}, "got list"),
        ({"range_max": math.inf}, "range_max inf"),
        ({"range_max": math.nan}, "range_max nan"),
        ({"angle_increment": math.nan}, "angle_increment nan"),
    ],
)
def test_what_is_no_scan_is_refused_in_a_sentence(name: str, wrong: dict[str, Any], what: str) -> None:
    scan = Scan(np.full(360, 2.0), -math.pi, 2.0 * math.pi / 360, 8.0)
    backend = slam.make(name)
    with pytest.raises(ValueError, match=what):
        backend.update(scan._replace(**wrong))
    backend.update(scan)
    assert backend.grid.known_cells > 0


@pytest.mark.parametrize("name", [name for name in slam.names() if name != "truth"])  # which is told the pose
@pytest.mark.parametrize("twist", [(math.nan, 0.0, 0.0), (0.0, math.inf, 0.0), np.array([0.0, 0.0, math.nan])])
def test_odometry_that_is_no_number_changes_nothing(name: str, twist: Any) -> None:
    backend = slam.make(name)
    backend.predict(Odometry((0.2, 0.0, 0.1), 0.1))
    pose, cov = backend.pose, backend.pose_cov
    with pytest.raises(ValueError, match="finite numbers"):
        backend.predict(Odometry(twist, 0.1))
    assert np.array_equal(backend.pose, pose) and np.array_equal(backend.pose_cov, cov)
