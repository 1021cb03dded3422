"""The error that a map starts with: against information by hand, and against common sense."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import slam
from agents.view_points.anchoring import anchoring, d_optimality, marks_of, spread_m
from mecanum_env.config import LidarConfig
from slam.landmarks.association import predicted
from slam.motion import OdometryNoise
from slam.types import Observations
from tests.agents.grids import belief_of, room
from tests.agents.view_points.test_sightings import sightings

LIDAR = LidarConfig()
NOISE = OdometryNoise(speed_share=0.03, turn_share_rad_m=0.08, slip_share=0.0)  # driven without jerks
CORNERS = np.array([[0.1, 0.1], [7.9, 0.1], [7.9, 3.9], [0.1, 3.9]])


def vars_of(noise: OdometryNoise) -> dict:
    return {name: getattr(noise, name) for name in noise.__dataclass_fields__}


def see(backend, corners) -> None:
    rb, cov = sightings(corners, backend.pose)
    backend.observe(Observations(rb, cov, np.arange(len(corners))))


def test_d_optimality_is_the_geometric_mean_of_the_axes():
    cov = np.diag([4.0, 1.0, 0.25])
    assert d_optimality(cov) == pytest.approx(1.0)
    assert d_optimality(np.zeros((3, 3))) == 0.0
    assert spread_m(np.diag([1e-4, 1e-4, 1e-4 / 16.0]), 4.0) == pytest.approx(0.01)


def test_without_a_joint_covariance_pose_and_corners_stand_for_themselves():
    belief = belief_of(room(8.0, 4.0), (1.5, 2.0, 0.0), sigma=0.02)
    alone = replace(belief, landmarks=CORNERS, landmark_cov=np.tile(1e-5 * np.eye(2), (4, 1, 1)))
    marks = marks_of(alone)
    assert (marks.kinds == 0.0).all()
    np.testing.assert_allclose(np.diag(marks.cov), [4e-4, 4e-4, 1e-4, *[1e-5] * 8])
    # The pose's own error is in what separates it from each corner: more corners, less of it.
    spreads = [spread_m(anchoring(marks, np.arange(4) < n, LIDAR.offset_m), 4.0) for n in (2, 3, 4)]
    assert (np.diff(spreads) < 0.0).all()


def test_anchoring_is_the_error_that_a_robot_inherits():
    """Leave a known place with wheels that tell nothing: the pose is what the landmarks say, and no better."""
    backend = slam.make("ekf", config={"odometry": vars_of(NOISE)})
    backend.reset((1.5, 2.0, 0.3))
    for _ in range(4):
        see(backend, CORNERS)
    marks = marks_of(backend.belief)
    expected = anchoring(marks, np.ones(4, np.bool_), LIDAR.offset_m)
    wide = np.zeros_like(marks.cov)
    wide[:3, :3] = 1e4 * np.eye(3)
    # Perfect looks at landmarks known as now, the pose not at all.
    h = np.zeros((8, 11))
    for i in range(4):
        block = np.zeros((2, 5))
        predicted(marks.x, i, 0.0, LIDAR.offset_m, block)
        h[2 * i : 2 * i + 2, :3], h[2 * i : 2 * i + 2, 3 + 2 * i : 5 + 2 * i] = block[:, :3], block[:, 3:]
    s = h @ marks.cov @ h.T
    relative = np.zeros_like(s)
    for i in range(4):  # each landmark by itself, as anchoring takes them
        relative[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = s[2 * i : 2 * i + 2, 2 * i : 2 * i + 2]
    information = h[:, :3].T @ np.linalg.solve(relative, h[:, :3])
    np.testing.assert_allclose(expected, np.linalg.inv(information), rtol=1e-6)
    assert math.isinf(anchoring(marks, np.zeros(4, np.bool_), LIDAR.offset_m)[0, 0])
    # More looks from the same place: less of it.
    for _ in range(12):
        see(backend, CORNERS)
    later = anchoring(marks_of(backend.belief), np.ones(4, np.bool_), LIDAR.offset_m)
    assert spread_m(later, 4.0) == pytest.approx(0.5 * spread_m(expected, 4.0), rel=0.1)
