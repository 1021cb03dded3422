"""What lasts of an odometry's errors: how it moves the frame, its Jacobian, and that scans teach it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam.geometry import compose, inverse, symmetric
from slam.graph.lasting import LastingStates, Motion
from slam.motion import LastingErrors, OdometryNoise, jacobians, move
from tests.slam.numerics import numerical_jacobian

ONE = st.floats(-1.0, 1.0)
WHEELS = OdometryNoise(lever_m=0.4, lasting=LastingErrors(radius_sigma=0.02, lever_sigma=0.03))
NOISES = {"frame": OdometryNoise(mount_sigma_m=0.1), "wheels": WHEELS, "both": replace(WHEELS, mount_sigma_m=0.1)}


def moved(states: LastingStates, twists: np.ndarray, dt: float = 0.1) -> Motion:
    motion = Motion()
    for claimed in twists:
        motion.add(*states.twist(tuple(claimed.tolist())), dt, 1e-4, 4e-4)
    return motion


@given(ONE, ONE, ONE, ONE, ONE)
def test_the_frame_moves_as_a_rigid_body(vx: float, vy: float, omega: float, x: float, y: float) -> None:
    states, dt = LastingStates(NOISES["frame"]), 0.01
    states.mean[:2] = x, y
    at = np.array([x, y, 0.0])
    wheels = move(np.zeros(3), np.array([vx, vy, omega]), dt)
    frame = move(np.zeros(3), np.array(states.twist((vx, vy, omega))[0]), dt)
    assert frame == pytest.approx(compose(inverse(at), compose(wheels, at)), abs=1e-6)


@given(st.integers(0, 2**31))
def test_a_motion_s_jacobian_is_that_of_its_mean(seed: int) -> None:
    rng = np.random.default_rng(seed)
    twists = rng.uniform((-0.5, -0.5, -1.0), (0.5, 0.5, 1.0), (8, 3))

    def mean(c: np.ndarray) -> np.ndarray:
        states = LastingStates(NOISES["both"])
        states.mean[:] = c
        return moved(states, twists).mean

    states = LastingStates(NOISES["both"])
    states.mean[:] = rng.normal(0.0, 0.02, 7)
    motion = moved(states, twists)
    np.testing.assert_allclose(motion.by, numerical_jacobian(mean, states.mean), atol=1e-7)
    np.testing.assert_allclose(states.motion_cov(motion), motion.by @ states.cov @ motion.by.T, atol=1e-12)


def test_the_rest_of_a_motion_s_covariance_is_that_of_its_steps() -> None:
    states, twists = LastingStates(NOISES["frame"]), np.random.default_rng(0).uniform(-1.0, 1.0, (5, 3))
    pose, cov = np.zeros(3), np.zeros((3, 3))
    for twist in twists:
        fx, fu = jacobians(pose, twist, 0.1)
        pose, cov = move(pose, twist, 0.1), fx @ cov @ fx.T + fu @ np.diag([1e-4, 1e-4, 4e-4]) @ fu.T
    motion = moved(states, twists)
    np.testing.assert_allclose(motion.white, cov, atol=1e-15)
    motion.doubt(np.eye(3))
    np.testing.assert_allclose(motion.white, cov + np.eye(3), atol=1e-12)


@pytest.mark.parametrize("known", sorted(NOISES))
def test_motions_teach_it_as_exactly_as_it_says(known: str) -> None:
    rng, nees, sigmas = np.random.default_rng(0), [], []
    free = np.flatnonzero(np.diag(LastingStates(NOISES[known]).cov))
    for _ in range(120):
        states, truth = LastingStates(NOISES[known]), LastingStates(NOISES[known])
        truth.mean[free] = rng.multivariate_normal(np.zeros(len(free)), truth.cov[np.ix_(free, free)])
        for _ in range(30):
            twists = np.tile(rng.uniform((-0.5, -0.5, -1.0), (0.5, 0.5, 1.0)), (10, 1))
            foretold, seen = moved(states, twists), np.diag([0.004, 0.004, 0.002]) ** 2
            slipped = rng.multivariate_normal(np.zeros(3), foretold.white)
            z = moved(truth, twists).mean + slipped + rng.multivariate_normal(np.zeros(3), seen)
            prior = foretold.white + states.motion_cov(foretold)
            gain = prior @ np.linalg.inv(prior + seen)
            states.learn(foretold, prior, gain @ (z - foretold.mean), prior - gain @ prior)
        off = (states.mean - truth.mean)[free]
        nees.append(off @ np.linalg.solve(states.cov[np.ix_(free, free)], off) / len(free))
        sigmas.append(np.sqrt(np.diag(states.cov)[free]))
    assert 0.8 < np.mean(nees) < 1.25
    assert np.all(np.mean(sigmas, axis=0) < 0.6 * np.sqrt(np.diag(LastingStates(NOISES[known]).cov)[free]))


@pytest.mark.parametrize(("noise", "change"), [("both", [0.0, 0.0, 0.5]), ("none", [0.0, 0.001, 0.0])])
def test_wheels_that_spun_teach_nothing_and_what_is_known_stays(noise: str, change: list[float]) -> None:
    states = LastingStates(NOISES.get(noise, OdometryNoise()))
    motion, before = moved(states, np.full((5, 3), 0.5)), states.cov.copy()
    cov = motion.white + states.motion_cov(motion)
    states.learn(motion, cov, np.array(change), 0.5 * symmetric(cov))
    assert np.array_equal(states.mean, np.zeros(7)) and np.array_equal(states.cov, before)
    assert states.unknown == (noise == "both")
