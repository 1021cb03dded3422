from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam.geometry import compose, exp, inverse, log, relative, rotation, transform_points, wrap, wrap_scalar

lengths = st.floats(-50, 50)
angles = st.floats(-math.pi, math.pi - 1e-9)
poses = st.tuples(lengths, lengths, angles).map(np.array)


@given(st.floats(-1e4, 1e4))
def test_wrap_is_half_open_and_keeps_the_direction(angle: float) -> None:
    wrapped = float(wrap(angle))
    assert -math.pi <= wrapped < math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)
    assert wrap_scalar(angle) == wrapped


@pytest.mark.parametrize("angle", [math.pi, -math.pi, 3 * math.pi])
def test_wrap_at_pi(angle: float) -> None:
    assert float(wrap(angle)) == pytest.approx(-math.pi, abs=1e-12)


@given(poses)
def test_inverse_undoes(pose: np.ndarray) -> None:
    np.testing.assert_allclose(wrap(compose(pose, inverse(pose))), 0, atol=1e-9)


@given(poses, poses)
def test_relative_poses_are_the_inverse_composed(pose: np.ndarray, seen: np.ndarray) -> None:
    out = relative(np.array([pose, seen]), np.array([seen, pose]))
    for row, (a, b) in zip(out, ((pose, seen), (seen, pose)), strict=True):
        difference = row - compose(inverse(a), b)
        np.testing.assert_allclose(np.append(difference[:2], wrap(difference[2])), 0, atol=1e-9)


@given(poses, poses, poses)
def test_composition_is_associative(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    difference = compose(compose(a, b), c) - compose(a, compose(b, c))
    np.testing.assert_allclose(difference[:2], 0, atol=1e-9)
    assert abs(wrap_scalar(difference[2])) < 1e-9


@given(st.tuples(lengths, lengths, st.floats(-3.1, 3.1)).map(np.array))
def test_log_undoes_exp(twist: np.ndarray) -> None:
    np.testing.assert_allclose(log(exp(twist)), twist, atol=1e-7)


def test_exp_is_the_limit_of_small_steps() -> None:
    twist = np.array([0.7, -0.4, 1.9])
    pose = np.zeros(3)
    for _ in range(20000):
        pose = compose(pose, twist / 20000)
    np.testing.assert_allclose(pose, exp(twist), atol=1e-4)


@given(poses, poses)
def test_points_move_as_poses_do(a: np.ndarray, b: np.ndarray) -> None:
    np.testing.assert_allclose(transform_points(a, b[None, :2])[0], compose(a, b)[:2], atol=1e-9)
    np.testing.assert_allclose(rotation(a[2]) @ rotation(a[2]).T, np.eye(2), atol=1e-12)
