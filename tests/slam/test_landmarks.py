from __future__ import annotations

import math

import numpy as np

from slam import Scan
from slam.association import IGNORED, UNMATCHED
from slam.landmarks import LandmarkBook, LandmarkPolicy
from tests.slam.simulated import ANGLE_MIN, INCREMENT

POSE = np.zeros(3)


def corner(x: float, y: float, kind: float = 1.0, direction: float = 0.0) -> np.ndarray:
    return np.array([math.hypot(x, y), math.atan2(y, x), 1e-4, 0.0, 1e-5, kind, direction, 0.0])


def test_a_corner_is_confirmed_after_three_sightings_at_one_place() -> None:
    book = LandmarkBook(LandmarkPolicy(confirm_after=3))
    new = np.array([UNMATCHED])
    assert len(book.review(POSE, 0.0, corner(2, 1)[None], new)) == 0
    assert len(book.review(POSE, 0.0, corner(2.05, 1)[None], new)) == 0
    assert len(book.review(POSE, 0.0, corner(2, 1, kind=-1.0)[None], new)) == 0  # another kind: another corner
    assert len(book.review(POSE, 0.0, corner(4, 1)[None], new)) == 0
    assert len(book.review(POSE, 0.0, corner(2, 1)[None], np.array([IGNORED]))) == 0
    assert book.review(POSE, 0.0, corner(2.02, 1)[None], new).tolist() == [0]
    assert len(book.review(POSE, 0.0, corner(2.02, 1)[None], new)) == 0  # it starts over once confirmed


def test_a_tentative_corner_is_forgotten() -> None:
    book = LandmarkBook(LandmarkPolicy(confirm_after=2, forget_after=5))
    new = np.array([UNMATCHED])
    book.review(POSE, 0.0, corner(2, 1)[None], new)
    for _ in range(6):
        book.review(POSE, 0.0, np.zeros((0, 8)), np.zeros(0, np.int64))
    assert len(book.review(POSE, 0.0, corner(2, 1)[None], new)) == 0


def test_a_landmark_that_beams_pass_through_is_dropped_and_one_on_a_wall_is_not() -> None:
    book = LandmarkBook(LandmarkPolicy(drop_after=3))
    book.add(1.0, 0.0, None)
    book.add(1.0, 0.0, None)
    x = np.array([0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 3.0])
    scan = Scan(np.full(360, 3.0), ANGLE_MIN, INCREMENT, 8.0)  # passes (2, 0), ends at (0, 3)
    for _ in range(4):
        assert book.contradicted(x, 0.0, scan) == []
    assert book.contradicted(x, 0.0, scan) == [0]
    book.drop(0)
    assert book.ids.tolist() == [1]
    assert book.row(1) == 0
    assert book.row(0) == -1
    book.add(0.0, 0.0, None)
    assert book.ids.tolist() == [1, 2]  # ids are never used twice
