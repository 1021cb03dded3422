from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from slam.accounts.account import Account
from slam.accounts.corners import CornerConfig, settled
from slam.types import CONCAVE, CONVEX, Array

CONFIG = CornerConfig()
WALLS = np.array([[math.pi, -4.0], [1.5 * math.pi, -2.0]])  # x = 4 and y = 2, bodies at x < 4 and y < 2
ENDS = np.array([[4.0, -3.0, 4.0, 2.0], [4.0, 2.0, -1.0, 2.0]])
CROSSING, JAMB, ALONE = (4.012, 1.99), (3.985, -3.02), (6.0, 6.0)
DIRECTIONS = np.radians([45.0, -45.0, 45.0])


def account(cov: Array, kinds: tuple[int, ...] = (CONVEX,) * 3) -> Account:
    return Account(
        robot=0, stamp=0.0, pose=np.zeros(3), points=np.array([CROSSING, JAMB, ALONE]), point_ids=np.arange(3),
        kinds=np.array(kinds, np.int8), directions=DIRECTIONS, times_seen=np.full(3, 9), walls=WALLS,
        wall_ends=ENDS, cov=cov,
    )  # fmt: skip


def some_cov(seed: int, sigma: float = 0.01) -> Array:
    root = np.random.default_rng(seed).normal(size=(13, 13))
    return np.asarray(sigma**2 * (root @ root.T / 13 + 0.1 * np.eye(13)))


def test_corners_are_read_off_their_walls() -> None:
    found = settled(account(some_cov(0)), CONFIG)
    np.testing.assert_allclose(found.points, [(4.0, 2.0), (4.0, JAMB[1]), ALONE], atol=1e-12)


def test_the_covariance_goes_over_as_the_corners_do() -> None:
    told = account(some_cov(1))
    found, step = settled(told, CONFIG), 1e-6
    columns = []
    for k in range(13):
        moved = told.state + step * np.eye(13)[k]
        other = replace(told, pose=moved[:3], points=moved[3:9].reshape(3, 2), walls=moved[9:].reshape(2, 2))
        columns.append((settled(other, CONFIG).state - found.state) / step)
    jacobian = np.column_stack(columns)
    np.testing.assert_allclose(found.cov, jacobian @ told.cov @ jacobian.T, rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("change", [{"directions": DIRECTIONS + np.pi}, {"points": np.full((3, 2), 4.2)}])
def test_a_corner_beside_a_wall_or_behind_it_is_left_alone(change: dict[str, Array]) -> None:
    told = replace(account(some_cov(2)), **change)
    found = settled(told, CONFIG)
    np.testing.assert_array_equal(found.state, told.state)
    np.testing.assert_allclose(found.cov, told.cov, atol=1e-15)


@pytest.mark.parametrize(("kind", "gap_m"), [(CONVEX, 0.1), (CONVEX, 0.03), (CONCAVE, 0.1)])
def test_a_convex_corner_that_a_wall_does_not_reach_is_off_along_it(kind: int, gap_m: float) -> None:
    told = account(some_cov(3), (kind, CONVEX, CONVEX))
    short = replace(told, wall_ends=ENDS - np.array([[0.0, 0.0, 0.0, gap_m], [0.0] * 4]))
    excess = settled(short, CONFIG).cov - settled(told, CONFIG).cov
    wanted = np.zeros((13, 13))
    wanted[4, 4] = gap_m**2 if kind == CONVEX and gap_m > CONFIG.reach_m else 0.0  # x = 4 ends in y
    np.testing.assert_allclose(excess, wanted, atol=1e-12)


@pytest.mark.parametrize("also_short", [False, True])
@pytest.mark.parametrize(("kind", "gap_m"), [(CONVEX, 0.35), (CONVEX, 0.45), (CONCAVE, 0.35)])
def test_so_is_one_whose_wall_ends_far_before_where_no_other_wall_makes_it(
    kind: int, gap_m: float, also_short: bool
) -> None:
    """The wall along y ends before; the other reaches it, or ends still farther from it."""
    told = account(some_cov(4), (kind, CONVEX, CONVEX))
    ends = ENDS - np.array([[0.0, 0.0, 0.0, gap_m], [1.0 if also_short else 0.0, 0.0, 0.0, 0.0]])
    excess = settled(replace(told, wall_ends=ends), CONFIG).cov[4, 4]
    excess -= settled(replace(told, wall_ends=ends), replace(CONFIG, jamb_m=CONFIG.beyond_m)).cov[4, 4]
    at_y = CROSSING[1] if also_short else 2.0  # as it is told, or on the other wall
    wanted = (at_y - (2.0 - gap_m)) ** 2 if kind == CONVEX and gap_m < CONFIG.jamb_m else 0.0
    assert excess == pytest.approx(wanted, abs=1e-9)


def test_an_account_without_corners_is_itself() -> None:
    none = replace(
        account(some_cov(0)), points=np.zeros((0, 2)), point_ids=np.zeros(0, np.int64), kinds=np.zeros(0, np.int8),
        directions=np.zeros(0), times_seen=np.zeros(0, np.int64), cov=np.eye(7),
    )  # fmt: skip
    assert settled(none) is none
