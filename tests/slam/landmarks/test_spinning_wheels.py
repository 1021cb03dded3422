"""Wheels that turn in vain: when they are suspected, what acquits them, and robots pushed into walls."""

from __future__ import annotations

import math

import gymnasium
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import agents
from mecanum_env.env import ExploreEnv
from slam.grids.occupancy import OccupancyGrid
from slam.landmarks.spinning_wheels import SpinningWheels, seen_again, touches, walls_cross
from slam.metrics.chi_square import chi2_quantile
from slam.types import Scan
from tests.slam.landmarks.test_loop_closing import wall_row

STEPS_EACH = 15  # 1.5 s of one twist: long enough to reach a wall and to be pressed to it


def mapped_wall() -> tuple[OccupancyGrid, Scan]:
    """Return a map of a round wall 2 m around the origin, and the scan that drew it."""
    grid, scan = OccupancyGrid(0.05), Scan(np.full(360, 2.0), -np.pi, np.radians(1.0), 8.0)
    for _ in range(5):
        grid.integrate(np.zeros(3), scan, np.full(360, -1, np.int16))
    return grid, scan


def matched(count: int, unmatched: int) -> np.ndarray:
    return np.array([*range(count), *[-1] * unmatched])


def test_they_are_suspected_where_landmarks_and_the_fit_go_at_once() -> None:
    grid, scan = mapped_wall()
    here, off = np.zeros(3), np.array([0.3, 0.0, 0.0])
    wheels = SpinningWheels()

    def suspected(believed: np.ndarray, still: int, unmatched: int, recent: int = 5) -> bool:
        match = matched(still, unmatched)
        return wheels.suspected(grid, lambda body: believed if body is None else body, scan, recent, still, match)

    assert suspected(here, 1, 4)  # nothing to compare with yet
    wheels.note(scan, here, 5, 5)
    assert not suspected(here, 1, 4)  # as good a fit as the last
    assert suspected(off, 1, 4)
    assert not suspected(off, 4, 4)  # one landmark may well go out of sight
    assert not suspected(off, 1, 1)  # and what is not seen explains nothing
    assert not suspected(off, 1, 4, recent=2)
    assert suspected(off, 0, 4, recent=2)  # both that were in sight
    wheels.untold = True
    assert suspected(off, 4, 1)  # the end of a corridor, of which the walls beside the robot are left
    assert not suspected(here, 4, 1)
    wheels.untold = False
    wheels.note(scan, off, 5, 1)  # nothing to compare with: the fit there is bad
    assert suspected(off, 3, 2)
    assert not wheels.explain(530.0, 500.0)
    assert suspected(off, 2, 3)
    assert not wheels.explain(530.0, 500.0)  # most landmarks are missed, but nothing holds the robot back
    wheels.touching = True
    assert wheels.explain(530.0, 500.0)  # less will do
    assert suspected(here, 5, 0)  # they did, lately


def test_walls_of_one_direction_do_not_tell_the_place() -> None:
    beside = [wall_row(0.7, side * np.pi / 2, -3.0, 3.0) for side in (1, -1)]
    end, corner = wall_row(2.5, 0.05, -0.7, 0.7), np.zeros(10)
    for rows, match, tells, cross in [
        (beside, [0, 1], False, False), ([*beside, end], [0, 1, 2], True, True),
        ([*beside, end], [0, 1, -1], False, False), ([*beside, corner], [0, 1, 2], True, False),
        ([end, corner], [0, 1], True, False), (beside, [-1, -2], False, False),
    ]:  # fmt: skip
        assert seen_again(np.array(rows), np.array(match)) == (sum(i >= 0 for i in match), tells)
        assert walls_cross(np.array(rows), np.array(match)) is cross


@given(st.floats(-math.pi, math.pi), st.floats(0.0, 0.3), st.floats(-0.2, 0.2))
def test_what_stands_at_the_body_is_touched(bearing: float, clear: float, offset: float) -> None:
    """One beam of a body of 0.6 × 0.4 m meets something ``clear`` beyond the outline, straight out from it."""
    ahead, aside = math.cos(bearing), math.sin(bearing)
    edge = min(0.3 / max(abs(ahead), 1e-9), 0.2 / max(abs(aside), 1e-9))
    x, y = edge * ahead, edge * aside
    if abs(abs(x) - 0.3) < 1e-9:
        x += math.copysign(clear, x)
    else:
        y += math.copysign(clear, y)
    at = math.atan2(y, x - offset)
    ranges = np.array([math.inf, math.hypot(x - offset, y), math.nan])
    scan = Scan(ranges, at - 0.1, 0.1, 8.0)
    if abs(clear - 0.04) > 1e-6:
        assert touches(scan, offset, 0.6, 0.4, 0.01) is (clear < 0.04)
    assert not touches(scan, offset, 0.0, 0.0, 0.01)  # of a body that nobody has told of


def test_a_robot_stays_behind_by_what_its_wheels_claim_at_most() -> None:
    wheels = SpinningWheels()
    wheels.claim(0.2, 0.3)
    assert wheels.claims(0.2, 0.3)
    assert wheels.claims(0.24, 0.34)  # a map of cells does not tell it better
    assert not wheels.claims(0.3, 0.3)
    assert not wheels.claims(0.2, 0.4)


def test_the_scan_decides_and_is_believed_for_a_while() -> None:
    wheels, scan = SpinningWheels(), mapped_wall()[1]
    wheels.claim(0.3, 0.1)
    wheels.claim(0.1, 0.1)
    assert wheels.variances == pytest.approx((0.16, 0.16, 0.04))
    wheels.untold = True
    wheels.forget_motion()
    assert wheels.variances == pytest.approx((0.09, 0.09, 0.0))  # how far along the corridor is to be told
    assert wheels.enough(matched(3, 0), matched(2, 1))
    wheels.allowed_for()
    assert wheels.variances == (0.0, 0.0, 0.0)  # once
    wheels.claim(0.3, 0.1)
    wheels.untold = False
    wheels.forget_motion()
    assert wheels.variances == (0.0, 0.0, 0.0)
    assert wheels.enough(matched(3, 0), matched(1, 2))
    assert not wheels.enough(matched(2, 1), matched(1, 2))
    assert not wheels.enough(matched(1, 2), matched(0, 3))
    assert not wheels.explain(575.0, 500.0)
    assert wheels.explain(2.0, 0.9)  # twice as well
    assert wheels.lately
    assert wheels.enough(matched(2, 0), matched(2, 0))
    assert wheels.explain(501.0, 500.0)
    for _ in range(10):
        wheels.note(scan, np.zeros(3), 3, 3)
    assert not wheels.lately
    assert not wheels.explain(501.0, 500.0)


@pytest.mark.parametrize("room", ["apartment", "corridors", "maze", "cave"])
@pytest.mark.parametrize("backend", ["ekf-lines", "invariant-ekf"])
def test_a_robot_that_is_driven_into_walls_knows_where_it_is(room: str, backend: str) -> None:
    """Twists at random press it to walls for a good part of the time, and its wheels go on turning."""
    env = gymnasium.make("mecanum_env/Explore-v0", rooms=room, slam=backend, max_episode_steps=450)
    inner = env.unwrapped
    assert isinstance(inner, ExploreEnv)
    nees, touched = [], 0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        _, info = env.reset(seed=seed)
        truncated = False
        step = 0
        while not truncated:
            if step % STEPS_EACH == 0:
                action = rng.uniform(-1.0, 1.0, 3).astype(np.float32)
            _, _, _, truncated, info = env.step(action)
            nees.append(info["nees"])
            step += 1
        touched += info["collisions"]
    assert touched > 5
    assert np.mean(nees) < 3 * 2.5
    assert np.mean(np.array(nees) > chi2_quantile(0.997, 3)) < 0.06


@pytest.mark.parametrize("seed", [18, 44])
def test_the_end_of_a_corridor_is_not_lost(seed: int) -> None:
    """Where little but two walls is in sight, one slip along them was never noticed (training seeds)."""
    env = gymnasium.make("mecanum_env/Explore-v0", rooms="corridors", noise="slippery", max_episode_steps=400)
    inner = env.unwrapped
    assert isinstance(inner, ExploreEnv)
    observation, _ = env.reset(seed=seed)
    driver = agents.make("random")
    driver.reset(inner.belief, seed)
    off = []
    for _ in range(400):
        observation, *_ = env.step(driver.act(observation, inner.belief))
        off.append(math.hypot(*(inner.belief.pose - inner.truth.pose)[:2]))
    assert off[-1] < 0.02
    assert np.mean(np.array(off) > 0.05) < 0.02


def test_a_robot_pressed_to_the_wall_of_a_cave_is_placed_by_the_scan() -> None:
    """Four landmarks in sight, and none that answers: without the scan it is lost for good after 25 s."""
    env = gymnasium.make("mecanum_env/Explore-v0", rooms="cave", max_episode_steps=400)
    inner = env.unwrapped
    assert isinstance(inner, ExploreEnv)
    agent = agents.make("random")
    observation, info = env.reset(seed=8)
    agent.reset(inner.belief, seed=8)
    nees, truncated = [], False
    while not truncated:
        observation, _, _, truncated, info = env.step(agent.act(observation, inner.belief))
        nees.append(info["nees"])
    assert info["collisions"] > 3
    assert np.mean(nees) < 3 * 3.0
    assert info["position_error_m"] < 0.05
