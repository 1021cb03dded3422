from __future__ import annotations

from collections.abc import Callable

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from slam.geometry import compose, inverse, transform_points, wrap
from slam.teams.frames import (
    compose_jacobians,
    ends_into,
    inverse_jacobian,
    points_into,
    pose_into,
    walls_into,
)
from slam.teams.sighting import combine, relative_pose

Array = NDArray[np.float64]
numbers = st.floats(-3.0, 3.0)
poses = st.tuples(numbers, numbers, numbers).map(np.array)


def differences(function: Callable[[Array], Array], at: Array, *, angles: tuple[int, ...] = ()) -> Array:
    columns = []
    for k in range(len(at)):
        step = np.zeros(len(at))
        step[k] = 1e-6
        off = function(at + step) - function(at - step)
        for i in angles:
            off[i] = wrap(off[i])
        columns.append(off / 2e-6)
    return np.array(columns).T


@given(poses, poses)
def test_jacobians_of_poses(a: Array, b: Array) -> None:
    first, second = compose_jacobians(a, b)
    np.testing.assert_allclose(first, differences(lambda v: compose(v, b), a, angles=(2,)), atol=1e-7)
    np.testing.assert_allclose(second, differences(lambda v: compose(a, v), b, angles=(2,)), atol=1e-7)
    np.testing.assert_allclose(inverse_jacobian(a), differences(inverse, a, angles=(2,)), atol=1e-7)
    _, by_pose, by_frame = pose_into(a, b)
    np.testing.assert_array_equal(by_pose, second)
    np.testing.assert_array_equal(by_frame, first)


@given(poses, st.tuples(numbers, numbers).map(np.array))
def test_jacobians_of_points_and_walls(frame: Array, value: Array) -> None:
    for into, angles in ((points_into, ()), (walls_into, (0,))):
        _, by_value, by_frame = into(frame, value[None])
        there = differences(lambda v, into=into: into(frame, v[None])[0][0], value, angles=angles)
        np.testing.assert_allclose(by_value[0], there, atol=1e-7)
        there = differences(lambda v, into=into: into(v, value[None])[0][0], frame, angles=angles)
        np.testing.assert_allclose(by_frame[0], there, atol=1e-7)


@given(poses, st.floats(-3.1, 3.1), numbers, numbers)
def test_a_walls_points_stay_on_it_and_its_normal_into_it(
    frame: Array, alpha: float, r: float, along: float
) -> None:
    normal = np.array([np.cos(alpha), np.sin(alpha)])
    point = r * normal + along * np.array([-normal[1], normal[0]])
    moved = walls_into(frame, np.array([[alpha, r]]))[0][0]
    there = np.array([np.cos(moved[0]), np.sin(moved[0])])
    assert abs(there @ transform_points(frame, point[None])[0] - moved[1]) < 1e-9
    turned = transform_points(np.array([0.0, 0.0, frame[2]]), normal[None])[0]
    np.testing.assert_allclose(there, turned, atol=1e-9)
    ends = np.concatenate([point, normal])[None]
    np.testing.assert_allclose(ends_into(inverse(frame), ends_into(frame, ends)), ends, atol=1e-9)


@given(poses, poses, poses)
def test_a_sighting_finds_the_frame(frame: Array, pose_a: Array, pose_b: Array) -> None:
    seen_pose = compose(inverse(pose_a), compose(frame, pose_b))
    seen = np.array([np.hypot(*seen_pose[:2]), np.arctan2(seen_pose[1], seen_pose[0]), seen_pose[2]])
    zero = np.zeros((3, 3))
    found, cov = relative_pose(seen, zero, pose_a, zero, pose_b, zero)
    np.testing.assert_allclose(found[:2], frame[:2], atol=1e-9)
    assert abs(float(wrap(found[2] - frame[2]))) < 1e-9
    assert not cov.any()


def test_jacobians_of_a_sighting() -> None:
    seen, a, b = np.array([2.0, 0.4, -1.0]), np.array([1.0, -2.0, 0.7]), np.array([-0.5, 3.0, 2.1])
    zero = np.zeros((3, 3))
    for k in range(3):
        given_values = [seen, a, b]

        def frame(v: Array, k: int = k, given_values: list[Array] = given_values) -> Array:
            values = [*given_values[:k], v, *given_values[k + 1 :]]
            return relative_pose(values[0], zero, values[1], zero, values[2], zero)[0]

        jacobian = differences(frame, given_values[k], angles=(2,))
        own = np.diag([0.01, 0.02, 0.03]) + 0.001
        covs = [own if j == k else zero for j in range(3)]
        found = relative_pose(seen, covs[0], a, covs[1], b, covs[2])[1]
        np.testing.assert_allclose(found, jacobian @ own @ jacobian.T, atol=1e-8)


def test_sightings_that_share_their_errors_are_not_counted_twice() -> None:
    one = (np.array([1.0, 2.0, np.pi - 0.01]), np.diag([0.01, 0.04, 0.001]))
    pose, cov = combine([one, one, one])
    np.testing.assert_allclose(cov, one[1], rtol=1e-6)
    np.testing.assert_allclose(pose, one[0])
    other = (np.array([1.0, 2.0, -np.pi + 0.01]), np.diag([0.04, 0.01, 0.001]))
    pose, cov = combine([one, other])
    assert abs(abs(pose[2]) - np.pi) < 0.011  # across the wrap, not through zero
    assert np.linalg.det(cov) < np.linalg.det(one[1])
