"""Old landmarks seen again after a long way: walls beside walls, and loops that close only in company."""

from __future__ import annotations

import math

import numpy as np
import pytest

import slam
from slam import LINE, Observations, Odometry
from slam.landmarks.association import IGNORED, UNMATCHED, nearest_neighbour
from slam.landmarks.loop_closing import agreeing, put_off
from slam.metrics.chi_square import chi2_quantile
from tests.slam.simulated import observe_landmarks

OFFSET = 0.2
GATE = chi2_quantile(0.997, 2)
SIGMA = 0.1


def wall_row(distance: float, bearing: float, start: float, end: float) -> np.ndarray:
    """Return the observation row of a piece of wall, from ``start`` to ``end`` along it from its foot."""
    z = np.zeros(10)
    z[:5] = distance, bearing, 1e-6, 0.0, 1e-7
    z[5], z[6], z[8], z[9] = LINE, bearing, start, end
    return z


def lone_wall(pose_sigma: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return state, covariance and marks of a robot at the origin and one wall, 2 m to its left.

    Both are uncertain in common, as after a long way: how they stand to each other is known to a millimetre.
    """
    x = np.array([0.0, 0.0, 0.0, math.pi / 2, 2.0])
    shift = np.array([0.0, 1.0, 0.0, 0.0, 1.0])
    p = pose_sigma**2 * np.outer(shift, shift) + np.diag([1e-6, 1e-6, 1e-8, 1e-8, 1e-6])
    marks = np.array([[LINE, math.pi / 2, 30.0, 0.0, 0.0, 0.0, -4.0, 4.0]])
    return x, np.triu(p), marks


@pytest.mark.parametrize("pose_sigma", [0.001, 0.3])
def test_a_wall_beside_a_known_one_is_new_however_far_the_start_is(pose_sigma: float) -> None:
    """On a large floor a corridor's long wall was left out for the sake of a niche half a metre behind it."""
    x, p, marks = lone_wall(pose_sigma)
    z = np.array([wall_row(2.0, math.pi / 2, -1.0, 1.0), wall_row(1.5, math.pi / 2, -3.0, 4.0)])
    match = np.zeros(2, np.int64)
    nearest_neighbour(x, p, OFFSET, z, marks, GATE, 0.2, 0.6, True, match, np.zeros(2))
    assert match.tolist() == [0, UNMATCHED]


def test_what_may_be_a_known_wall_badly_seen_is_not_new() -> None:
    x, p, marks = lone_wall(0.3)
    z = np.array([wall_row(1.9, math.pi / 2, -1.0, 1.0)])  # beyond the gate, yet too near to be another
    match = np.zeros(1, np.int64)
    nearest_neighbour(x, p, OFFSET, z, marks, GATE, 0.2, 0.6, True, match, np.zeros(1))
    assert match.tolist() == [IGNORED]


def test_a_surface_that_lies_on_two_pieces_of_wall_is_the_one_seen_last() -> None:
    """In a corridor that shows one wall only, mapped in two pieces, a robot that takes neither goes blind."""
    x, p, marks = lone_wall(0.3)
    x, marks = np.append(x, x[3:5]), np.vstack([marks, marks])
    p = np.pad(p, (0, 2))
    p[5, 5], p[6, 6] = 1e-8, 1e-6
    marks[1, 5:] = 90.0, 5.0, 9.0  # the other piece goes on farther along, and was seen lately
    z = np.array([wall_row(2.0, math.pi / 2, start, end) for start, end in ((0.0, 7.0), (-3.0, 3.0))])
    p[4, 4] = p[1, 1] = p[1, 4] = 1e-6  # so that both are within the gate
    match = np.zeros(2, np.int64)
    nearest_neighbour(x, p, OFFSET, z, marks, GATE, 0.2, 0.6, True, match, np.zeros(2))
    assert match.tolist() == [1, 0]  # on both, and on the first alone


def test_old_landmarks_that_are_not_expected_narrowly_wait_while_others_hold_the_pose() -> None:
    x, p, marks = lone_wall(0.3)
    x, marks = np.append(x, [0.0, 4.0]), np.vstack([marks, marks])
    p = np.pad(p, (0, 2))
    p[5, 5], p[6, 6], marks[1, 5] = 1e-8, 1e-6, 990.0  # another wall, followed from scan to scan
    z = np.array([wall_row(3.8, 0.0, start, start + 1.0) for start in (-4.0, -2.0, 1.0)])
    z = np.vstack([z, wall_row(2.0, math.pi / 2, -1.0, 1.0)])
    match = np.array([1, 1, 1, 0])
    assert put_off(x, p, OFFSET, z, marks, 1000, SIGMA, match) == 0  # old, and known where it should be seen
    p[1, 1] += 0.15**2  # now the robot alone is uncertain
    assert put_off(x, p, OFFSET, z, marks, 40, SIGMA, match) == 0  # seen 40 updates ago
    assert put_off(x, p, OFFSET, z[1:], marks, 1000, SIGMA, match[1:]) == 0  # there is too little else
    lone, wide = match[1:].copy(), p.copy()
    wide[1, 1] += 0.15**2
    assert put_off(x, wide, OFFSET, z[1:], marks, 1000, SIGMA, lone) == 1  # too uncertain to be taken all the same
    assert lone.tolist() == [1, 1, IGNORED]
    assert put_off(x, p, OFFSET, z, marks, 1000, SIGMA, match) == 1
    assert match.tolist() == [1, 1, 1, IGNORED]


def test_a_lone_old_wall_must_be_well_within_its_gate() -> None:
    x, p, marks = lone_wall(0.3)
    p[1, 1] += 0.15**2
    for sigmas, taken in ((2.5, True), (3.3, False)):  # 3.3 σ are within the gate of 99.7 %, not in that of 99 %
        z = np.array([wall_row(x[4] + sigmas * 0.15, math.pi / 2, -1.0, 1.0)])
        match = np.zeros(1, np.int64)
        assert put_off(x, p, OFFSET, z, marks, 1000, SIGMA, match) == (not taken)
        assert match[0] == (0 if taken else IGNORED)


def test_one_old_wall_closes_no_loop_and_four_that_agree_do() -> None:
    """The robot is 0.3 m off; of two parallel walls, 0.4 m apart, only one is in the map."""
    x = np.array([0.0, 0.0, 0.0, math.pi / 2, 2.0, -math.pi / 2, 1.5, 0.0, 3.0, math.pi, 4.0, math.pi / 2, 2.6])
    p = np.diag([0.16**2, 0.16**2, 1e-6] + [1e-6] * 10)
    marks = np.array([[LINE, a, 30.0, 0, 0, 0, -4.0, 4.0] for a in x[3::2]])

    def seen(i: int, sensor: tuple[float, float]) -> np.ndarray:
        alpha, r = x[3 + 2 * i : 5 + 2 * i]
        return wall_row(r - math.cos(alpha) * sensor[0] - math.sin(alpha) * sensor[1], alpha, -1.0, 1.0)

    sensor = (OFFSET + 0.1, 0.28)
    stranger = wall_row(2.2 - sensor[1], math.pi / 2, 0.0, 1.0)
    z = np.array([stranger])
    match = np.zeros(1, np.int64)
    nearest_neighbour(x, p, OFFSET, z, marks, GATE, 0.2, 0.6, True, match, np.zeros(1))
    assert match[0] == 0  # the only one within the gate, 8 cm from where it is expected: 28 cm wrong
    arguments = (marks, 1000, SIGMA, 0.2, 0.6)
    assert agreeing(x, p, OFFSET, z, *arguments, match) == 0
    assert match.tolist() == [IGNORED]
    z = np.array([stranger] + [seen(i, sensor) for i in range(5)])
    match = np.zeros(6, np.int64)
    assert agreeing(x, p, OFFSET, z, *arguments, match) == 5
    assert match.tolist() == [IGNORED, 0, 1, 2, 3, 4]


def test_a_lone_neighbour_does_not_pull_a_returning_robot_away() -> None:
    noise = np.diag([0.005**2, 0.002**2])
    rng = np.random.default_rng(4)
    posts = np.array([[2.0, -1.9], [2.6, 1.2], [0.9, 1.7], [1.4, -0.3], [3.8, -0.4], [1.4, -0.75]])
    wheels = {"speed_share": 0.12, "turn_share_rad_m": 0.003, "slip_share": 0.0}
    backend = slam.make("invariant-ekf", config={"odometry": wheels})
    backend.reset()
    for _ in range(10):
        backend.observe(observe_landmarks(np.zeros(3), posts[:5], OFFSET, noise, rng))
    # A square of 4 m a side, back to the start; the odometry says a little too much on the way home.
    for twist in ((-1.0, 0, 0), (0, -1.0, 0), (1.0, 0, 0), (0, 1.045, 0)):
        for _ in range(40):
            backend.predict(Odometry(twist, 0.1))
            backend.observe(Observations(rng.uniform((10, -3), (20, 3), (1, 2)), noise[None]))  # clutter
    before = float(np.hypot(*backend.pose[:2]))
    assert before > 0.15
    assert backend.pose_nees(np.zeros(3)) < 8
    fresh = np.array([[6.0, 5.0], [7.0, -5.0], [-3.0, 3.0]])  # seen here for the first time; they hold the pose
    for _ in range(5):
        seen = observe_landmarks(np.zeros(3), fresh, OFFSET, noise, rng)
        backend.observe(Observations(seen.range_bearing, seen.cov))
    # The sixth post, which is not in the map, half a metre beside the fourth and expected nearer to it.
    for _ in range(5):
        seen = observe_landmarks(np.zeros(3), np.vstack([fresh, posts[5:]]), OFFSET, noise, rng)
        backend.observe(Observations(seen.range_bearing, seen.cov))
    assert backend.pose_nees(np.zeros(3)) < 8
    seen = observe_landmarks(np.zeros(3), np.vstack([fresh, posts]), OFFSET, noise, rng)
    backend.observe(Observations(seen.range_bearing, seen.cov))
    assert float(np.hypot(*backend.pose[:2])) < 0.02
