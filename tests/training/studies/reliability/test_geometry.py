"""Where a body stands, against points laid densely along the surfaces."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from training.studies.reliability.steps.geometry import gap, towards, went_through

NONE, NO_CIRCLES = np.zeros((0, 4)), np.zeros((0, 3))
near = st.floats(-1.0, 1.0, allow_nan=False)


def densely(pose: np.ndarray, half: tuple[float, float], points: np.ndarray) -> float:
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x, y = ((points - pose[:2]) @ np.array([[c, -s], [s, c]])).T
    over = np.abs(np.column_stack([x, y])) - half
    outside = np.hypot(*np.maximum(over, 0.0).T) + np.minimum(over.max(axis=1), 0.0)
    return float(outside.min())


@given(st.tuples(near, near, st.floats(-7, 7)), st.tuples(near, near, near, near), st.floats(0.05, 0.5))
def test_the_gap_to_a_wall(pose: tuple[float, ...], wall: tuple[float, ...], half_x: float) -> None:
    at, ends = np.array(pose), np.array(wall).reshape(2, 2)
    points = ends[0] + np.linspace(0.0, 1.0, 3001)[:, None] * (ends[1] - ends[0])
    found = gap(at, half_x, 0.2, np.array([wall]), NO_CIRCLES)
    assert found == pytest.approx(densely(at, (half_x, 0.2), points), abs=1e-3)


@given(st.tuples(near, near, st.floats(-7, 7)), st.tuples(near, near, st.floats(0.05, 0.6)))
def test_the_gap_to_a_disc(pose: tuple[float, ...], disc: tuple[float, ...]) -> None:
    at, angles = np.array(pose), np.linspace(0.0, 2.0 * math.pi, 181)
    radii = disc[2] * np.linspace(0.0, 1.0, 61)[:, None, None]
    points = (np.array(disc[:2]) + radii * np.column_stack([np.cos(angles), np.sin(angles)])).reshape(-1, 2)
    found = gap(at, 0.3, 0.2, NONE, np.array([disc]))
    dense = densely(at, (0.3, 0.2), points)
    if dense > 0.0:  # of discs that overlap the depth is that of the middle, and the radius
        assert found == pytest.approx(dense, abs=5e-3)
    else:
        assert found < 5e-3


def test_the_nearest_of_many_counts() -> None:
    walls = np.array([[5.0, -1.0, 5.0, 1.0], [0.5, -1.0, 0.5, 1.0], [-0.8, -1.0, -0.8, 1.0]])
    assert gap(np.zeros(3), 0.3, 0.2, walls, NO_CIRCLES) == pytest.approx(0.2)
    assert gap(np.array([0.0, 0.0, math.pi / 2]), 0.3, 0.2, walls, NO_CIRCLES) == pytest.approx(0.3)
    assert gap(np.array([0.25, 0.0, 0.0]), 0.3, 0.2, walls, NO_CIRCLES) == pytest.approx(-0.05)
    assert gap(np.zeros(3), 0.3, 0.2, NONE, NO_CIRCLES) == math.inf


def test_a_way_through_a_surface() -> None:
    wall, disc = np.array([[0.0, -1.0, 0.0, 1.0]]), np.array([[0.0, 3.0, 0.1]])
    for end, through in (((1.0, 0.5), True), ((-0.1, 0.5), False), ((1.0, 2.5), False), ((0.05, 3.0), True)):
        assert went_through(np.array([-1.0, 0.5]), np.array(end), wall, disc) is through, end


def test_the_way_to_the_nearest_surface_is_in_the_bodys_frame() -> None:
    walls = np.array([[2.0, -1.0, 2.0, 1.0], [-5.0, 1.0, 5.0, 1.0]])
    assert towards(np.zeros(3), walls, NO_CIRCLES) == pytest.approx([0.0, 1.0])
    assert towards(np.array([1.5, 0.0, math.pi / 2]), walls, NO_CIRCLES) == pytest.approx([0.0, -1.0])
    assert towards(np.zeros(3), walls, np.array([[-0.5, 0.0, 0.2]])) == pytest.approx([-1.0, 0.0])
