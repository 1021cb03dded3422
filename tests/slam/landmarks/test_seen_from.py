"""A scan that fits the drawn map says where the robot is among the landmarks, not where they all are."""

from __future__ import annotations

import numpy as np
import pytest

from slam import LINE
from slam.gaussian.stacked_update import NO_LIMITS, stacked_update, work_space
from slam.landmarks.association import predicted
from slam.landmarks.book import KIND, LAST_SEEN, MARKS
from slam.landmarks.seen_from import seen_from, sightings
from slam.types import VIRTUAL, Array

OFFSET = 0.2
POSE = np.array([0.1, -0.05, 0.06])  # where the scan fits; believed is the origin
COV = np.diag(np.square([0.03, 0.03, 0.01])) + 1e-4 * np.array([[0, 1, 0.2], [1, 0, 0.1], [0.2, 0.1, 0]])


def world() -> tuple[Array, Array, Array]:
    """Return state, covariance and marks: all unsure together by a metre, the pose among them by centimetres."""
    x = np.array([0.0, 0.0, 0.0, 2.0, 1.0, 0.3, 2.5, 1.0, -2.0, 4.0, 4.0])
    marks = np.zeros((4, MARKS))
    marks[:, 0], marks[:, LAST_SEEN] = (1, LINE, 1, 1), (9, 10, 8, 2)
    p = np.diag([*np.square([0.1, 0.1, 0.1]), *[1e-6] * 8])
    together = np.zeros((len(x), 2))
    together[0::2, 0] = together[1::2, 1] = 1.0
    together[2] = 0.0
    together[3:] = np.array([[1, 0], [0, 1], [0, 0], [np.cos(0.3), np.sin(0.3)], [1, 0], [0, 1], [1, 0], [0, 1]])
    return x, np.triu(p + together @ together.T), marks


def test_sightings_are_what_is_foreseen_from_there_of_what_was_seen_last() -> None:
    """To first order in the difference."""
    for share in (1e-3, 1e-4):
        x, _, marks = world()
        z, match = seen_from(x, marks, OFFSET, share * POSE, COV)
        assert match.tolist() == [1, 0, 2]
        x[:3] = share * POSE
        for row, landmark in zip(z, match, strict=True):
            assert row[KIND] == marks[landmark, 0]
            seen = predicted(x, landmark, row[KIND], OFFSET, np.zeros((2, 5)))
            np.testing.assert_allclose(row[:2], seen, rtol=0.0, atol=0.02 * share**2)


@pytest.mark.parametrize("angle", np.linspace(0.0, np.pi, 7))
def test_what_is_off_along_a_wall_moves_the_pose_along_it_alone(angle: float) -> None:
    """A scan slides along a wall by 0.3 m, and is known to 0.5 m there, to a millimetre across."""
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    x = np.array([0.0, 0.0, 0.0, 3.0, 0.0, -3.0, 0.0])
    p = np.triu(np.diag(np.square([0.1, 0.1, 0.01, *[1e-4] * 4])))
    marks = np.zeros((2, MARKS))
    marks[:, 0] = VIRTUAL
    cov = np.diag([0.0, 0.0, 1e-6])
    cov[:2, :2] = 0.5**2 * np.outer(along, along) + 0.001**2 * np.outer(across, across)
    match = np.array([0, 1])
    z = sightings(x, marks, match, OFFSET, np.array([*0.3 * along, 0.0]), cov)
    stacked_update(x, p, len(x), z, match, OFFSET, *work_space(8, len(x)), NO_LIMITS)
    assert x[:2] @ along == pytest.approx(0.3 * 0.1**2 / (0.1**2 + 0.5**2), rel=0.05)
    assert abs(x[:2] @ across) < 1e-4 and abs(x[2]) < 1e-4


def test_together_they_say_no_more_than_the_match() -> None:
    x, _, marks = world()
    z, match = seen_from(x, marks, OFFSET, POSE, COV)
    x[:3] = POSE
    information = np.zeros((3, 3))
    for row, landmark in zip(z, match, strict=True):
        h = np.zeros((2, 5))
        predicted(x, landmark, row[KIND], OFFSET, h)
        r = np.array([[row[2], row[3]], [row[3], row[4]]])
        information += h[:, :3].T @ np.linalg.pinv(r) @ h[:, :3]
    left = np.linalg.inv(COV) - information
    assert np.linalg.eigvalsh(left).min() > -1e-6 * np.linalg.eigvalsh(left).max()
    assert np.linalg.det(information) > 0.0, "two points and a wall say all three of the pose"


def test_the_pose_is_surer_among_the_landmarks_alone() -> None:
    x, p, marks = world()
    z, match = seen_from(x, marks, OFFSET, POSE, COV)
    stacked_update(x, p, len(x), z, match, OFFSET, *work_space(8, len(x)), NO_LIMITS)
    assert np.hypot(*(x[:2] - POSE[:2])) < 0.7 * np.hypot(*POSE[:2]) and abs(x[2] - POSE[2]) < 0.01
    whole = np.triu(p) + np.triu(p, 1).T
    assert np.sqrt(whole[0, 0]) > 0.9, "where all of them are is as unsure as before"
    apart = np.zeros(len(x))
    apart[[0, 3]] = 1.0, -1.0
    assert np.sqrt(apart @ whole @ apart) < 0.07
    assert np.sqrt(whole[2, 2]) < 0.03


def test_without_landmarks_there_is_nothing_to_say() -> None:
    z, match = seen_from(np.zeros(3), np.zeros((0, MARKS)), OFFSET, POSE, COV)
    assert z.shape == (0, 12) and match.shape == (0,)


def test_points_that_no_scan_shows_are_no_landmarks() -> None:
    x, _, marks = world()
    marks[1, 0], marks[1, LAST_SEEN] = VIRTUAL, -np.inf
    assert seen_from(x, marks, OFFSET, POSE, COV)[1].tolist() == [0, 2, 3]
