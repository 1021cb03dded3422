from __future__ import annotations

import math

import numpy as np
import pytest

from slam import LINE, Scan
from slam.landmarks.association import IGNORED, UNMATCHED
from slam.landmarks.book import LandmarkBook, LandmarkPolicy
from tests.slam.simulated import ANGLE_MIN, INCREMENT

POSE = np.zeros(3)


def corner(x: float, y: float, kind: float = 1.0, edge: bool = True) -> np.ndarray:
    return np.array([math.hypot(x, y), math.atan2(y, x), 1e-4, 0.0, 1e-5, kind, 0.0, float(edge)])


def test_a_meeting_of_two_surfaces_is_confirmed_after_three_sightings() -> None:
    book = LandmarkBook(LandmarkPolicy(confirm_after=3))
    for expected in ([], [], [0]):
        assert book.review(POSE, 0.0, corner(2, 1, edge=False)[None], np.array([UNMATCHED]))[0] == expected


def wall(y: float, begin: float, end: float) -> np.ndarray:
    """A piece of the wall at ``y``, as it is seen from the origin; along it is towards -x."""
    return np.array([y, math.pi / 2, 1e-6, 0.0, 1e-6, LINE, math.pi / 2, 0.0, begin, end])


def test_a_wall_is_confirmed_as_soon_as_any_whatever_was_confirmed_before_it() -> None:
    """The list of tentative ones is used again, and what is new must not look like one that became a landmark."""
    book = LandmarkBook(LandmarkPolicy(confirm_after=2))
    new = np.array([UNMATCHED])
    for y in (2.0, 3.0, 4.0):
        assert book.review(POSE, 0.0, wall(y, -1.0, 1.0)[None], new)[0] == []
        assert book.review(POSE, 0.0, wall(y, -1.0, 1.0)[None], new)[0] == [0]


def test_a_far_piece_of_a_wall_is_no_second_one_once_the_gap_is_closed() -> None:
    book = LandmarkBook(LandmarkPolicy(confirm_after=2))
    book.add(LINE, math.pi / 2, None, extent=(0.5, 2.0))
    x = np.array([0.0, 0.0, 0.0, math.pi / 2, 2.0])
    far = wall(2.0, -3.0, -1.5)
    assert book.review(x, 0.0, far[None], np.array([UNMATCHED]))[0] == []
    rows = np.array([far, wall(2.0, -1.6, 0.6)])  # the piece between, seen at last, is the wall's
    assert book.review(x, 0.0, rows, np.array([UNMATCHED, 0]))[0] == []
    assert book.marks[0, 6:8].tolist() == [-1.6, 2.0]


def test_what_the_first_scan_shows_is_a_landmark_at_once() -> None:
    """The start pose is known, and only then: what had to wait would be placed from where the wheels say it is."""
    book = LandmarkBook(LandmarkPolicy(confirm_after=3))
    scan = Scan(np.full(360, 5.0), angle_min=ANGLE_MIN, angle_increment=INCREMENT, range_max=20.0)
    rows = np.array([corner(2, 1, edge=False), corner(1, -2, edge=True), corner(-3, 1, edge=False)])
    assert book.review(POSE, 0.0, rows, np.full(3, UNMATCHED), scan, at_once=True)[0] == [
        0,
        2,
    ]  # a visible end has to wait
    later = corner(-2, -2, edge=False)[None]
    assert book.review(POSE, 0.0, later, np.array([UNMATCHED]), scan)[0] == []


def test_the_end_of_a_surface_is_confirmed_after_three_sightings_from_two_places() -> None:
    book = LandmarkBook(LandmarkPolicy(edge_confirm_after=3, edge_baseline_m=0.2))
    new = np.array([UNMATCHED])

    def see(x: float, y: float, from_x: float = 0.0, kind: float = 1.0, match: np.ndarray = new) -> list[int]:
        pose = np.array([from_x, 0.0, 0.0])
        return book.review(pose, 0.0, corner(x - from_x, y, kind)[None], match)[0]

    assert see(2, 1) == []
    assert see(2.05, 1) == []
    assert see(2, 1, kind=-1.0) == []  # another kind: another corner
    assert see(4, 1) == []
    assert see(2.02, 1) == []  # three sightings, but all from one place
    assert see(2, 1, from_x=0.3, match=np.array([IGNORED])) == []
    assert see(2.02, 1, from_x=0.3) == [0]
    assert see(2.02, 1, from_x=0.3) == []  # it starts over once confirmed


def test_what_wanders_with_the_robot_is_never_confirmed() -> None:
    book = LandmarkBook(LandmarkPolicy(edge_confirm_after=3))
    for k in range(20):
        x = 0.04 * k
        assert book.review(np.array([x, 0.0, 0.0]), 0.0, corner(2, 1)[None], np.array([UNMATCHED]))[0] == []


def test_a_tentative_corner_is_forgotten() -> None:
    book = LandmarkBook(LandmarkPolicy(edge_confirm_after=2, edge_baseline_m=0.0, forget_after=5))
    new = np.array([UNMATCHED])
    book.review(POSE, 0.0, corner(2, 1)[None], new)
    for _ in range(6):
        book.review(POSE, 0.0, np.zeros((0, 8)), np.zeros(0, np.int64))
    assert book.review(POSE, 0.0, corner(2, 1)[None], new)[0] == []


def test_a_landmark_in_plain_view_that_never_shows_again_is_dropped() -> None:
    book = LandmarkBook(LandmarkPolicy(overlook_after=10, overlook_ratio=2.0))
    book.add(1.0, 0.0, None)
    book.add(1.0, 0.0, None)
    x = np.array([0.0, 0.0, 0.0, 3.0, 0.0, 0.0, 3.0])
    scan = Scan(np.full(360, 3.0), ANGLE_MIN, INCREMENT, 8.0)  # beams end at both, but only one is recognised
    dropped: list[int] = []
    for _ in range(14):
        dropped += book.review(x, 0.0, corner(0.0, 3.0)[None], np.array([1]), scan)[1]
        if dropped:
            break
    assert dropped == [0]


def test_a_landmark_that_beams_pass_through_is_dropped_and_one_on_a_wall_is_not() -> None:
    book = LandmarkBook(LandmarkPolicy(drop_after=3))
    book.add(1.0, 0.0, None)
    book.add(1.0, 0.0, None)
    x = np.array([0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 3.0])
    scan = Scan(np.full(360, 3.0), ANGLE_MIN, INCREMENT, 8.0)  # passes (2, 0), ends at (0, 3)
    nothing = (np.zeros((0, 8)), np.zeros(0, np.int64))
    for k in range(5):
        assert book.review(x, 0.0, *nothing, scan) == ([], [] if k < 4 else [0])
    book.drop(0)
    assert book.ids.tolist() == [1]
    assert book.row(1) == 0
    assert book.row(0) == -1
    book.add(0.0, 0.0, None)
    assert book.ids.tolist() == [1, 2]  # ids are never used twice


def test_beams_that_see_less_far_pass_no_landmark_and_what_no_scan_found_is_not_looked_for() -> None:
    book = LandmarkBook(LandmarkPolicy(drop_after=3))
    book.add(1.0, 0.0, None)
    book.add(0.0, 0.0, 7)
    x = np.array([0.0, 0.0, 0.0, 4.0, 0.0, 1.0, 0.0])
    scan = Scan(np.full(360, np.inf), ANGLE_MIN, INCREMENT, 3.0)
    for _ in range(9):
        assert book.review(x, 0.0, np.zeros((0, 12)), np.zeros(0, np.int64), scan) == ([], [])


@pytest.mark.parametrize("beams, increment", [(1, 0.0), (1, 5.0), (2, 3.0)])
def test_a_beam_or_two_do_not_look_all_round(beams: int, increment: float) -> None:
    """Of one beam the increment says nothing; it passed for three on every landmark near by."""
    book = LandmarkBook(LandmarkPolicy(drop_after=3))
    book.add(1.0, 0.0, None)
    x = np.array([0.0, 0.0, 0.0, -2.0, 0.5])  # the beam looks the other way
    scan = Scan(np.full(beams, 7.0), 0.0, increment, 8.0)
    for _ in range(9):
        assert book.review(x, 0.0, np.zeros((0, 12)), np.zeros(0, np.int64), scan) == ([], [])


def test_the_landmarks_just_seen_are_those_of_the_last_update() -> None:
    rng, book = np.random.default_rng(0), LandmarkBook(LandmarkPolicy())
    for k in range(40):
        book.add(LINE if k % 5 == 0 else 1.0, 0.0, 3 * k)
    points = rng.uniform(-5, 5, (40, 2))
    for _ in range(20):
        match = rng.choice(50, 9, replace=False) - 10
        book.count_sightings(match)
        rows = np.array([r for r in sorted(match.tolist()) if r >= 0], np.int64)
        _, ids, seen = book.just_seen(points)
        np.testing.assert_array_equal(ids, 3 * rows)
        np.testing.assert_array_equal(seen[:, :2], points[rows])
        np.testing.assert_array_equal(seen[:, 2], rows % 5 == 0)
