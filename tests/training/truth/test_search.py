"""The search over stops: what is counted is what is seen, and its value is that of the way."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.brisk_tour import BRISK
from agents.driving.control import PathFollower
from mecanum_env.config import LidarConfig, RobotConfig
from mecanum_env.env import ExploreEnv
from mecanum_env.rooms.floor_plan import FloorPlan
from training.truth.rehearsal import Rehearsal
from training.truth.search import MOST_STOPS, annealed, moved
from training.truth.sights import Eye, Sights, look

ROBOT, LIDAR = RobotConfig(), LidarConfig()


@cache
def room() -> ExploreEnv:
    env = ExploreEnv(rooms="rectangular")
    env.reset(seed=3)
    return env


@cache
def sights() -> Sights:
    return Sights(room().truth.ground, robot=ROBOT, lidar=LIDAR)


def test_where_there_is_nowhere_to_go_it_stays() -> None:
    low, high, free = 0.1, 0.9, np.zeros((20, 20), bool)
    free[2:-2, 2:-2] = True
    ends = np.array([[low, low], [high, low], [high, high], [low, high]])
    walls = np.hstack([ends, np.roll(ends, -1, axis=0)])
    closet = FloorPlan(name="closet", walls=walls, free=free, resolution=0.05, start=(0.5, 0.5, 0.0))
    env = ExploreEnv()
    env.reset(seed=0, options={"floor_plan": closet})
    board = Sights(env.truth.ground, robot=ROBOT, lidar=LIDAR).board
    assert board.near.shape == (1, 0)
    order, new, rng = (
        np.zeros(MOST_STOPS, dtype=np.int64),
        np.ones(MOST_STOPS, dtype=np.int64),
        np.random.default_rng(0),
    )
    assert moved(board, order, 1, rng, new) == (1, 1) and not new.any()
    np.testing.assert_array_equal(annealed(board, share=1.0, tries=50, rng=rng), [0])


@given(st.lists(st.integers(0, 2**64 - 1), min_size=2, max_size=4), st.integers(0, 2**64 - 1))
def test_new_bits_are_counted_and_kept(views, before):
    seen = np.array([before, 0], dtype=np.uint64)
    rows = np.array([[view, view ^ 5] for view in views], dtype=np.uint64)
    for k in range(len(rows)):
        expected = sum(int(a & ~b).bit_count() for a, b in zip(rows[k].tolist(), seen.tolist(), strict=True))
        union = rows[k] | seen
        assert look(rows, k, seen) == expected
        np.testing.assert_array_equal(seen, union)


@given(st.integers(1, MOST_STOPS), st.integers(0, 2**32 - 1))
def test_a_change_begins_where_it_says(n, seed):
    rng, board = np.random.default_rng(seed), sights().board
    order = np.zeros(MOST_STOPS, dtype=np.int64)
    order[1:n] = rng.integers(1, len(board.stops), n - 1)
    new = np.zeros_like(order)
    for _ in range(20):
        m, first = moved(board, order, n, rng, new)
        assert 1 <= m <= MOST_STOPS and abs(m - n) <= 3 and min(first, m - 1) >= 0
        np.testing.assert_array_equal(new[: min(first, m)], order[: min(first, m)])
        assert new[0] == 0 and (new[:m] >= 0).all() and (new[:m] < len(board.stops)).all()
        if m == n and (np.sort(new[:m]) != np.sort(order[:n])).any():
            assert (new[:m] != order[:n]).sum() == 1  # another stop, not another order


def test_the_way_found_sees_what_it_is_to_see_and_no_stop_is_for_nothing():
    board = sights().board
    order = annealed(board, share=0.97, tries=4000, rng=np.random.default_rng(0))

    def seen(stops) -> float:
        path = sights().path(np.asarray(stops), spacing_m=0.05)
        cells = sights().map.to_cells(path) @ np.array([board.cols, 1])
        shown = np.bitwise_or.reduce(board.views[board.view_of[cells]], axis=0)
        return sum(int(word).bit_count() for word in shown.tolist()) / board.counted

    assert seen(order) > 0.96
    assert seen(order[:-1]) < 0.97
    again = annealed(board, share=0.97, tries=4000, rng=np.random.default_rng(0))
    np.testing.assert_array_equal(order, again)


def test_a_start_on_the_lattice_of_stops_is_one_stop():
    env = ExploreEnv(rooms="rectangular")
    env.reset(seed=13)
    own = Sights(env.truth.ground, robot=ROBOT, lidar=LIDAR)
    assert (np.array(own.map.start) % 3 == 0).all()
    assert len(np.unique(own.board.stops)) == len(own.board.stops)
    assert len(own.path(np.array([0, 1, 1, 0, 2]))) > 3


def test_a_view_is_what_the_environments_lidar_maps():
    env = room()
    ground, grid = env.truth.ground, env.belief.grid
    seen = Eye(ground, LIDAR).sees(np.array([LIDAR.offset_m, 0.0]))
    share = np.count_nonzero(seen & ground.mappable) / ground.mappable_cells
    assert share == pytest.approx(env.truth.record.coverage[0], abs=0.01)
    assert grid.known_cells > 0


def test_a_rehearsal_takes_as_long_as_the_drive():
    env = ExploreEnv(rooms="apartment")
    observation, _ = env.reset(seed=0)
    own = Sights(env.truth.ground, robot=ROBOT, lidar=LIDAR)
    rehearsal = Rehearsal(BRISK, own, robot=ROBOT, lidar=LIDAR, step_s=0.1)
    order = annealed(own.board, share=0.7, tries=3000, rng=np.random.default_rng(1))
    path = own.path(order)
    poses = rehearsal.poses(path)
    follower = PathFollower(BRISK, robot=ROBOT, lidar=LIDAR, step_s=0.1)
    follower.set_path(path, None)
    steps = 0
    while True:
        twist = follower.follow(observation, env.belief)
        if follower.arrived:
            break
        shares = twist / np.array([ROBOT.max_speed_m_s, ROBOT.max_speed_m_s, ROBOT.max_turn_rate_rad_s])
        observation, _, _, _, info = env.step(shares.astype(np.float32))
        steps += 1
    assert len(poses) - 1 == pytest.approx(steps, rel=0.08)
    assert np.hypot(*(poses[-1, :2] - env.truth.pose[:2])) < 0.25
    assert rehearsal.seen(poses)[-1] == pytest.approx(info["coverage"], abs=0.02)
    # Annealing by time never makes it longer.
    share = 0.65
    before = rehearsal.value(order, share)
    assert rehearsal.refined(order, share=share, tries=30, rng=np.random.default_rng(0))[1] <= before
