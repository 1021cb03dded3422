"""The window: what a scan corrects, and what no scan can tell."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from slam.geometry import compose, exp, inverse, wrap
from slam.graph.matching import Links
from slam.graph.window import Window, carried, moved
from tests.slam.numerics import numerical_jacobian, random_covariance

Array = np.ndarray
seeds = st.integers(0, 2**32 - 1)


def window_of(seed: int) -> tuple[Window, np.random.Generator]:
    """Return a window whose key scan and three patches stand anywhere, far from the origin."""
    rng = np.random.default_rng(seed)
    poses = np.column_stack([rng.uniform(-30.0, 30.0, (4, 2)), rng.uniform(-math.pi, math.pi, 4)])
    window = Window(poses[0], np.eye(3))
    window.replace(poses[0], poses[1:], np.arange(3), random_covariance(12, rng, 0.01))
    return window, rng


def turning(poses: Array) -> Array:
    """Return by how much poses ``(k, 3)`` err where all are turned about the origin: ``(3k,)``."""
    return np.column_stack([-poses[:, 1], poses[:, 0], np.ones(len(poses))]).ravel()


def links_of(window: Window, at: Array, rng: np.random.Generator, off: float) -> Links:
    """Return what a scan ``at`` a pose says of the first two patches: that they are somewhat elsewhere."""
    relative = np.array([compose(inverse(frame), at) for frame in window.frames[:2]])
    info = np.array([np.linalg.inv(random_covariance(3, rng, 0.002)) for _ in range(2)])
    gradient = np.einsum("kab,kb->ka", info, off * rng.standard_normal((2, 3)))
    return Links(np.array([0, 1]), relative, info, gradient)


@given(seeds)
def test_no_scan_tells_how_the_whole_is_turned(seed: int) -> None:
    window, rng = window_of(seed)
    sigma, turned = 0.3, turning(np.vstack([window.pose, window.frames]))
    window.cov = 1e-8 * np.eye(12) + sigma**2 * np.outer(turned, turned)
    for _ in range(20):
        window.step(np.array([0.3, 0.1, 0.4]), 1e-4 * np.eye(3))
        at = window.pose + 0.02 * rng.standard_normal(3)
        window.correct(at, links_of(window, at, rng, 0.02))
    turned = turning(np.vstack([window.pose, window.frames]))
    # In the direction of that error there is as much left as there was: σ⁻² = vᵀ P⁻¹ v.
    assert 1.0 / (turned @ np.linalg.solve(window.cov, turned)) >= 0.99 * sigma**2
    assert math.sqrt(window.cov[2, 2]) >= 0.99 * sigma


@given(seeds)
def test_a_covariance_is_carried_along_as_the_poses_errors_are(seed: int) -> None:
    """What turns the one turns the other: the same world, turned and shifted by (a, b, φ), about either mean."""
    window, rng = window_of(seed)
    poses = np.vstack([window.pose, window.frames])
    by = rng.normal(size=(4, 2))

    def errors_of(around: Array) -> Array:
        def errors(t: Array) -> Array:
            return np.concatenate([compose(t, pose) - pose for pose in around])

        return numerical_jacobian(errors, np.zeros(3))

    moved_by = np.column_stack([by, np.zeros(4)])
    cov = errors_of(poses) @ errors_of(poses).T
    want = errors_of(poses + moved_by) @ errors_of(poses + moved_by).T
    np.testing.assert_allclose(carried(cov, by), want, atol=1e-4)


@given(seeds)
def test_a_correction_is_that_of_least_squares(seed: int) -> None:
    """For small errors, against the normal equations of prior and links."""
    window, rng = window_of(seed)
    window.cov *= 1e-4
    poses, prior = np.vstack([window.pose, window.frames]), window.cov.copy()
    at = window.pose + 1e-4 * rng.standard_normal(3)
    links = links_of(window, at, rng, 1e-4)

    def relative_to(x: Array) -> Array:
        robot, frames = poses[0] + x[:3], poses[1:3] + x[3:9].reshape(2, 3)
        return np.concatenate([compose(inverse(frame), robot) for frame in frames])

    j = numerical_jacobian(relative_to, np.zeros(12))
    off = relative_to(np.zeros(12)) - links.relative.ravel()
    off[2::3] = wrap(off[2::3])
    info = np.zeros((6, 6))
    info[:3, :3], info[3:, 3:] = links.info
    cov = np.linalg.inv(np.linalg.inv(prior) + j.T @ info @ j)
    change = -cov @ j.T @ (info @ off + links.gradient.ravel())
    ahead = window.corrected(at, links, *window.ahead(np.zeros(3), np.zeros((3, 3))))
    window.correct(at, links)
    got = np.vstack([window.pose, window.frames]) - poses
    got[:, 2] = wrap(got[:, 2])
    scale = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(got.ravel() / scale, change / scale, atol=0.02)
    np.testing.assert_allclose(window.cov / np.outer(scale, scale), cov / np.outer(scale, scale), atol=0.02)
    np.testing.assert_allclose(ahead[0], window.pose, atol=1e-9)
    np.testing.assert_allclose(ahead[1], window.cov[:3, :3], atol=1e-12)


@given(seeds)
def test_a_motion_s_jacobians(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose, motion = rng.normal(size=3), exp(rng.normal(size=3))
    _, by_pose, by_motion = moved(pose, motion)
    np.testing.assert_allclose(by_pose, numerical_jacobian(lambda x: moved(x, motion)[0], pose), atol=1e-6)
    np.testing.assert_allclose(by_motion, numerical_jacobian(lambda x: moved(pose, x)[0], motion), atol=1e-6)
