"""Where a frame sits on the base: its velocity, its Jacobian, and that turns teach it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam.geometry import compose, inverse
from slam.motion import move
from slam.odometry.mount import Mount

ONE = st.floats(-1.0, 1.0)


@given(ONE, ONE, ONE, ONE, ONE)
def test_the_frame_moves_as_a_rigid_body(vx: float, vy: float, omega: float, x: float, y: float) -> None:
    mount = Mount(0.1)
    mount.mean = np.array([x, y])
    at = np.array([x, y, 0.0])
    dt = 0.01
    wheels = move(np.zeros(3), np.array([vx, vy, omega]), dt)
    frame = move(np.zeros(3), np.array([*mount.velocity(vx, vy, omega), omega]), dt)
    assert frame == pytest.approx(compose(inverse(at), compose(wheels, at)), abs=1e-6)


@given(st.floats(-3.0, 3.0), ONE, ONE)
def test_what_it_adds_to_a_motion_is_its_own_uncertainty(turn: float, x: float, y: float) -> None:
    mount, step = Mount(0.1), 1e-6
    wheels = np.array([0.3, -0.2, turn])

    def motion(place: np.ndarray) -> np.ndarray:
        at = np.append(place, 0.0)
        return np.asarray(compose(inverse(at), compose(wheels, at)))

    place = np.array([x, y])
    by = np.column_stack([(motion(place + step * e) - motion(place - step * e)) / (2 * step) for e in np.eye(2)])
    assert mount.motion_cov(turn) == pytest.approx(0.01 * by @ by.T, abs=1e-8)


def test_turns_teach_it_as_exactly_as_it_says() -> None:
    rng = np.random.default_rng(0)
    nees = []
    for _ in range(200):
        true = 0.1 * rng.standard_normal(2)
        mount = Mount(0.1)
        for turn in rng.uniform(-0.6, 0.6, 12):
            at, here = np.append(true, 0.0), np.append(mount.mean, 0.0)
            wheels = np.array([0.2, 0.0, turn])
            foretold = compose(inverse(here), compose(wheels, here))
            noise, seen = np.diag([0.02, 0.02, 0.01]) ** 2, np.diag([0.01, 0.01, 0.004]) ** 2
            slip = rng.multivariate_normal(np.zeros(3), noise)
            z = compose(inverse(at), compose(wheels, at)) + slip + rng.multivariate_normal(np.zeros(3), seen)
            prior = noise + mount.motion_cov(turn)
            gain = prior @ np.linalg.inv(prior + seen)
            mount.learn(turn, prior, gain @ (z - foretold), prior - gain @ prior)
        off = mount.mean - true
        nees.append(off @ np.linalg.solve(mount.cov, off) / 2)
    assert 0.8 < np.mean(nees) < 1.2
    assert np.sqrt(np.diag(mount.cov)).max() < 0.03


def test_wheels_that_spun_teach_nothing_and_what_is_known_stays() -> None:
    cov = np.diag([1e-4, 1e-4, 1e-4])
    for mount, change in ((Mount(0.1), [0.0, 0.0, 0.5]), (Mount(0.0), [0.0, 0.01, 0.0])):
        before = mount.cov.copy()
        mount.learn(0.5, cov + mount.motion_cov(0.5), np.array(change), 0.5 * cov)
        assert np.array_equal(mount.mean, np.zeros(2)) and np.array_equal(mount.cov, before)
