"""Wheels held against landmarks that are seen twice."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slam.geometry import compose, inverse, transform_points, wrap
from slam.landmarks.wheel_check import WheelCheck
from slam.motion import jacobians, move
from slam.types import LINE, Array

OFFSET_M, DT = 0.2, 0.1
VAR_V, VAR_W = 0.01**2, 0.01**2
HEADING = 0.7
POINTS = np.array([[3.0, 1.0], [2.0, -2.0], [-1.5, 2.5], [-2.0, -1.0]])  # in the frame of the first scan
WALLS = np.array([[0.3, 3.5], [1.9, 2.0]])  # α, r
IDS = np.arange(10, 16)
WHITE, LASTING = 0.003, 0.012  # σ [m, rad] of an observation: new in each scan; the same in all


def observed(pose: Array, lasting: Array, rng: np.random.Generator) -> Array:
    """Return rows ``(6, 12)`` of points and walls from a pose in the first scan's frame."""
    seen = transform_points(inverse(pose), POINTS) - [OFFSET_M, 0.0]
    rho, phi = np.hypot(*seen.T), np.arctan2(seen[:, 1], seen[:, 0])
    alpha = WALLS[:, 0] - pose[2]
    r = WALLS[:, 1] - pose[0] * np.cos(WALLS[:, 0]) - pose[1] * np.sin(WALLS[:, 0]) - OFFSET_M * np.cos(alpha)
    z = np.zeros((6, 12))
    z[:, 0], z[:, 1] = np.concatenate([rho, r]), wrap(np.concatenate([phi, alpha]))
    z[:, :2] += lasting + WHITE * rng.standard_normal((6, 2))
    z[:, 2] = z[:, 4] = WHITE**2 + LASTING**2
    z[4:, 5] = LINE
    return z


def drive(
    check: WheelCheck, rng: np.random.Generator, *, slip: Array, scans: int = 20, honest: bool = True
) -> tuple[Array | None, Array, Array]:
    """Drive on; return what is doubted at the end, and the true and the claimed motion since the first scan."""
    lasting, match = LASTING * rng.standard_normal((6, 2)), np.arange(6)
    true, claimed = np.zeros(3), np.zeros(3)
    check.note(observed(true, lasting, rng), match, IDS, HEADING)
    doubted = None
    for _ in range(scans):
        twist = np.array([0.5, 0.1, 0.2])
        noise = np.array([math.sqrt(VAR_V), math.sqrt(VAR_V), math.sqrt(VAR_W)]) * rng.standard_normal(3)
        true = move(true, twist + slip + honest * noise, DT)
        claimed = move(claimed, twist, DT)
        check.predict(DT, (0.5, 0.1, 0.2), VAR_V, VAR_W)
        z = observed(true, lasting, rng)
        doubted = check.doubt(z, match, IDS)
        if doubted is not None:
            break
        check.note(z, match, IDS, HEADING)
    return doubted, true, claimed


def made(**changes: float) -> WheelCheck:
    return WheelCheck(OFFSET_M, **{"scans": 20, "gate": 16.27, "white_share": 1.0 / 16.0} | changes)  # type: ignore[arg-type]


def test_wheels_that_err_as_they_declare_are_believed() -> None:
    rng = np.random.default_rng(3)
    doubted = [drive(made(), rng, slip=np.zeros(3))[0] is not None for _ in range(200)]
    assert sum(doubted) <= 4  # ten comparisons each, at 1 in 1000


@pytest.mark.parametrize("slip", [(0.06, 0.0, 0.0), (0.0, -0.05, 0.1), (-0.2, 0.1, -0.2)])
def test_what_slipped_is_within_the_covariance_that_is_added(slip: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(5)
    squares = []
    for _ in range(50):
        doubted, true, claimed = drive(made(), rng, slip=np.array(slip))
        assert doubted is not None
        np.testing.assert_allclose(doubted, doubted.T, atol=1e-15)
        assert np.linalg.eigvalsh(doubted)[0] > 0.0
        c, s = math.cos(HEADING), math.sin(HEADING)
        off = true - claimed
        off = np.array([c * off[0] - s * off[1], s * off[0] + c * off[1], off[2]])  # in the belief's frame
        squares.append(off @ np.linalg.solve(doubted, off))
    assert np.mean(squares) < 6.0
    assert max(squares) < 16.27


def test_the_motion_compared_with_is_the_filters() -> None:
    check, x, cov = made(), np.zeros(3), np.zeros((3, 3))
    check.note(observed(np.zeros(3), np.zeros((6, 2)), np.random.default_rng(0)), np.arange(6), IDS, 0.0)
    for twist in ((0.5, 0.1, 0.3), (0.2, -0.4, -0.5), (0.0, 0.3, 0.0)):
        fx, fu = jacobians(x, np.array(twist), DT)
        cov = fx @ cov @ fx.T + fu @ np.diag([VAR_V, VAR_V, VAR_W]) @ fu.T
        x = move(x, np.array(twist), DT)
        check.predict(DT, twist, VAR_V, VAR_W)
    np.testing.assert_allclose(check._x, x, atol=1e-12)
    np.testing.assert_allclose(np.triu(check._p), np.triu(cov), atol=1e-12)


def test_a_landmark_taken_for_another_is_no_slip() -> None:
    check, rng = made(), np.random.default_rng(1)
    still = np.zeros((6, 2))
    check.note(observed(np.zeros(3), still, rng), np.arange(6), IDS, 0.0)
    check.predict(DT, (0.0, 0.0, 0.0), VAR_V, VAR_W)
    z = observed(np.zeros(3), still, rng)
    assert check.doubt(z, np.array([1, 0, 2, 3, 4, 5]), IDS) is None
    assert check.doubt(z, np.array([0, 1, -1, -1, -1, -1]), IDS) is None  # two alone say nothing
    pushed = compose(np.array([0.2, 0.0, 0.1]), np.zeros(3))
    assert check.doubt(observed(pushed, still, rng), np.arange(6), IDS) is None  # standing wheels are not doubted
