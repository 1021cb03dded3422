"""Beliefs whose landmarks and covariances are read when asked for: they stay what they were when given."""

from __future__ import annotations

import copy
import dataclasses
import gc
import pickle
import weakref

import numpy as np
import pytest

import slam
from slam.types import Observations, Odometry

FIELDS = (
    "pose", "pose_cov", "landmarks", "landmark_ids", "lines", "landmark_cov", "joint_cov", "whole_cov"
)  # fmt: skip


def _backend(name: str) -> slam.Backend:
    backend = slam.make(name)
    backend.reset()
    _observe(backend)
    return backend


def _observe(backend: slam.Backend) -> None:
    seen = np.array([[3.0, 0.2], [2.0, -1.0], [4.0, 1.5]])
    backend.observe(Observations(seen, np.tile(np.diag([1e-3, 1e-4]), (3, 1, 1)), ids=np.arange(3)))


@pytest.mark.parametrize("name", ["ekf", "ekf-lines", "invariant-ekf", "compressed-ekf"])
def test_a_belief_is_that_of_when_it_was_given(name: str) -> None:
    backend = _backend(name)
    read, held = backend.belief, backend.belief
    expected = {field: np.array(getattr(read, field)) for field in FIELDS}
    backend.predict(Odometry((0.5, 0.1, 0.3), 0.1))
    _observe(backend)
    assert not np.array_equal(backend.belief.joint_cov, expected["joint_cov"])
    for field, value in expected.items():
        np.testing.assert_array_equal(getattr(held, field), value)


def test_its_covariances_agree_with_one_another() -> None:
    belief = _backend("invariant-ekf").belief
    assert belief.has_whole_cov
    assert belief.joint_cov is not None and belief.whole_cov is not None
    np.testing.assert_array_equal(belief.joint_cov, belief.whole_cov[:9, :9])
    np.testing.assert_array_equal(belief.pose_cov, belief.joint_cov[:3, :3])
    for i, cov in enumerate(belief.landmark_cov):
        np.testing.assert_array_equal(cov, belief.joint_cov[3 + 2 * i : 5 + 2 * i, 3 + 2 * i : 5 + 2 * i])
    with pytest.raises(AttributeError, match="no attribute 'covariance'"):
        _ = belief.covariance


@pytest.mark.parametrize("name", ["odometry", "truth"])
def test_in_a_team_too_it_has_no_covariance_that_the_backend_has_not(name: str) -> None:
    backend = _backend(name)
    belief = backend.belief.in_team(1, backend.grid, ())
    for it in (backend.belief, belief):
        assert it.whole_cov is None and it.joint_cov is None and not it.has_whole_cov
    assert belief.robot == 1 and len(belief.landmarks) == len(belief.landmark_cov) == 3


def test_copies_of_it_are_the_same() -> None:
    backend = _backend("ekf")
    replaced = dataclasses.replace(backend.belief, health=0.5)
    copied = copy.deepcopy(backend.belief)
    for field in FIELDS:
        np.testing.assert_array_equal(getattr(replaced, field), getattr(backend.belief, field))
        np.testing.assert_array_equal(getattr(copied, field), getattr(backend.belief, field))


def test_nobody_keeps_a_belief_that_was_let_go() -> None:
    backend = _backend("ekf")
    gone = weakref.ref(backend.belief)
    gc.collect()
    assert gone() is None


@pytest.mark.parametrize("name", slam.names())
def test_it_can_be_sent_to_another_process(name: str) -> None:
    backend = slam.make(name)
    backend.reset()
    if backend.observes_landmarks and name not in ("odometry", "truth"):
        _observe(backend)
    sent = pickle.loads(pickle.dumps(backend.belief))
    for field in FIELDS:
        np.testing.assert_array_equal(getattr(sent, field), getattr(backend.belief, field))
