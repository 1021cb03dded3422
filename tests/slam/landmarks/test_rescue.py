"""What left its gate is matched again where the others have put the pose right, and only that."""

from __future__ import annotations

import math

import numpy as np

from slam import LINE
from slam.gaussian.stacked_update import NO_LIMITS, stacked_update, work_space
from slam.landmarks.association import nearest_neighbour
from slam.landmarks.rescue import match_missed
from slam.metrics.chi_square import chi2_quantile
from tests.slam.landmarks.test_loop_closing import wall_row

GATE = chi2_quantile(0.997, 2)
SLIPPED = 0.02  # rad that the robot has turned more than is believed
NOW = 10


def corridor() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return state, covariance and marks of a robot in a corridor: a wall on either side, and the end ahead."""
    x = np.array([0.0, 0.0, 0.0, math.pi / 2, 0.7, -math.pi / 2, 0.7, 0.0, 2.5])
    p = np.diag([1.6e-5, 1e-6, 4e-5, *[1e-8, 1e-6] * 3])
    marks = np.array([
        [LINE, math.pi / 2, 30.0, 0.0, 0.0, NOW - 1, -5.0, 5.0],
        [LINE, -math.pi / 2, 30.0, 0.0, 0.0, NOW - 1, -5.0, 5.0],
        [LINE, 0.0, 30.0, 0.0, 0.0, NOW - 1, -0.7, 0.7],
    ])  # fmt: skip
    return x, np.triu(p), marks


def scan() -> np.ndarray:
    """Return what it sees, its heading ``SLIPPED`` from what is believed."""
    beside = [wall_row(0.7, side * math.pi / 2 - SLIPPED, -3.0, 3.0) for side in (1, -1)]
    return np.array([*beside, wall_row(2.49, -SLIPPED, -0.7, 0.7)])


def associated() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return state and covariance corrected by the walls beside the robot, marks, scan and their match."""
    x, p, marks = corridor()
    z, match = scan(), np.zeros(3, np.int64)
    nearest_neighbour(x, p, 0.0, z, marks, GATE, 0.2, 0.6, True, match, np.zeros(3))
    stacked_update(x, p, len(x), z, match, 0.0, *work_space(8, len(x)), NO_LIMITS)
    return x, p, marks, z, match


def test_the_end_of_a_corridor_is_matched_once_its_walls_have_put_the_heading_right() -> None:
    x, p, marks, z, match = associated()
    assert match[:2].tolist() == [0, 1] and match[2] < 0
    more = np.zeros(3, np.int64)
    assert match_missed(x, p, 0.0, z, marks, NOW, np.array([GATE, 0.2, 0.6]), match, more) == 1
    assert more[2] == 2 and (more[:2] < 0).all()
    stacked_update(x, p, len(x), z, more, 0.0, *work_space(8, len(x)), NO_LIMITS)
    assert abs(x[0] - 0.01) < 2e-3, "it says how far along the corridor the robot is"


def test_what_was_not_seen_lately_is_left_to_the_closing_of_loops() -> None:
    x, p, marks, z, match = associated()
    marks[2, 5] = NOW - 3
    more = np.zeros(3, np.int64)
    assert match_missed(x, p, 0.0, z, marks, NOW, np.array([GATE, 0.2, 0.6]), match, more) == 0
    assert (more < 0).all()
