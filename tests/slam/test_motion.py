from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slam.geometry import compose, exp, wrap
from slam.motion import OdometryNoise, jacobians, move, predict_robot, twist_between
from tests.slam.numerics import numerical_jacobian, random_covariance

poses = st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-3, 3)).map(np.array)
twists = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-2, 2)).map(np.array)


@given(poses, twists)
def test_jacobians_against_finite_differences(pose: np.ndarray, twist: np.ndarray) -> None:
    fx, fu = jacobians(pose, twist, 0.1)
    np.testing.assert_allclose(fx, numerical_jacobian(lambda p: move(p, twist, 0.1), pose, angle=2), atol=1e-6)
    np.testing.assert_allclose(fu, numerical_jacobian(lambda u: move(pose, u, 0.1), twist, angle=2), atol=1e-6)


@given(poses, twists)
def test_move_agrees_with_the_exponential_to_third_order(pose: np.ndarray, twist: np.ndarray) -> None:
    exact = compose(pose, exp(twist * 0.1))
    bound = np.hypot(*twist[:2]) * 0.1 * (0.1 * abs(twist[2])) ** 2 / 20 + 1e-12
    assert np.hypot(*(move(pose, twist, 0.1) - exact)[:2]) <= bound


@given(poses, poses, st.floats(0.01, 100.0))
def test_the_twist_between_poses_moves_from_one_to_the_other(
    pose: np.ndarray, after: np.ndarray, dt: float
) -> None:
    twist = twist_between(pose, after, dt)
    moved = move(pose, twist, dt)
    np.testing.assert_allclose(moved[:2], after[:2], atol=1e-9)
    assert abs(wrap(moved[2] - after[2])) < 1e-9 and abs(twist[2] * dt) <= np.pi


@settings(max_examples=50)
@given(poses, twists, st.integers(0, 1000))
def test_joint_prediction_is_f_p_ft_plus_q(pose: np.ndarray, twist: np.ndarray, seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 9
    p = random_covariance(n, rng)
    x = np.concatenate([pose, rng.standard_normal(n - 3)])
    var_v, var_w = 0.03, 0.05
    fx, fu = jacobians(pose, twist, 0.1)
    f = np.eye(n)
    f[:3, :3] = fx
    want = f @ p @ f.T
    want[:3, :3] += fu @ np.diag([var_v, var_v, var_w]) @ fu.T
    upper, state = np.triu(p), x.copy()
    predict_robot(state, upper, n, *twist, 0.1, var_v, var_w)
    np.testing.assert_allclose(np.triu(upper), np.triu(want), atol=1e-12)
    np.testing.assert_allclose(state[:2], move(pose, twist, 0.1)[:2])
    assert abs(float(wrap(state[2] - move(pose, twist, 0.1)[2]))) < 1e-12
    np.testing.assert_array_equal(state[3:], x[3:])


def test_noise_grows_with_the_wheels_speed() -> None:
    noise = OdometryNoise()
    still, slow, fast = noise.variances(0, 0, 0), noise.variances(0.1, 0, 0), noise.variances(0.5, 0.2, 0.3)
    assert still[0] < slow[0] < fast[0]
    assert still[1] < slow[1] < fast[1]
    with pytest.raises(ValueError, match="speed_share"):
        OdometryNoise(speed_share=-1.0)
