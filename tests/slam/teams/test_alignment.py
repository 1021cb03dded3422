from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slam.geometry import compose, inverse, wrap
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slam.metrics.measures import nees_band
from slam.teams.alignment import AlignmentConfig, _believable, _Fit, align
from slam.teams.contradiction import contradiction
from slam.teams.joint import Joint, SameConfig
from slam.types import CONVEX
from tests.slam.teams.worlds import World

EXACT = AlignmentConfig(same=SameConfig(point_sigma_m=0.0, wall_sigma_m=0.0, wall_sigma_rad=0.0))
HERE = np.zeros(3)


@settings(max_examples=25, deadline=None)
@given(st.floats(-20, 20), st.floats(-20, 20), st.floats(-3.1, 3.1), st.integers(0, 1000))
def test_any_frame_is_found(x: float, y: float, theta: float, seed: int) -> None:
    rng, frame = np.random.default_rng(seed), np.array([x, y, theta])
    world = World(rng, points=40)
    a = world.account(0, HERE, HERE, rng, sees=np.arange(0, 28), sigma=0.01)
    b = world.account(1, frame, HERE, rng, sees=np.arange(12, 40), sigma=0.01)
    found = align(a, b, EXACT)
    if found is None:
        return  # allowed; how often is tested below
    off = compose(inverse(frame), found.pose)
    assert np.hypot(*off[:2]) < 0.5 and abs(off[2]) < 0.05


def test_most_are_found_and_as_well_as_is_said() -> None:
    nees, runs = [], 60
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        world, frame = World(rng, points=40), np.array([3.0, -2.0, 2.0])
        a = world.account(0, HERE, HERE, rng, sees=np.arange(0, 28), sigma=0.01)
        b = world.account(1, frame, HERE, rng, sees=np.arange(12, 40), sigma=0.01)
        if (found := align(a, b, EXACT)) is not None:
            off = found.pose - frame
            off[2] = wrap(off[2])
            nees.append(off @ np.linalg.solve(found.cov, off))
    assert len(nees) > 0.9 * runs
    low, high = nees_band(3, len(nees), confidence=0.999)
    assert low < np.mean(nees) / 3 < high


def repeated(rng: np.random.Generator) -> World:
    """Two rooms alike, side by side, each of 16 corners."""
    world = World(rng, points=32, walls=0)
    room = rng.uniform(-3, 3, (16, 2))
    world.points = np.vstack([room, room + np.array([9.0, 0.0])])
    world.kinds, world.directions = np.tile(world.kinds[:16], 2), np.tile(world.directions[:16], 2)
    return world


def test_a_room_that_repeats_is_refused_but_not_with_a_prior() -> None:
    rng, frame = np.random.default_rng(3), np.array([2.0, 1.0, 0.5])
    world = repeated(rng)
    a = world.account(0, HERE, HERE, rng, sigma=0.01)
    b = world.account(1, frame, HERE, rng, sees=np.arange(16), sigma=0.01)  # it saw but one of the two
    assert align(a, b, EXACT) is None
    found = align(a, b, EXACT, prior=(frame + np.array([0.3, -0.2, 0.05]), np.diag([0.3, 0.3, 0.1]) ** 2))
    assert found is not None and np.hypot(*(found.pose - frame)[:2]) < 0.1


@pytest.mark.parametrize("seed", range(4))
def test_walls_alone_fix_a_frame_where_it_is_known_where_to_look(seed: int) -> None:
    rng, frame = np.random.default_rng(seed), np.array([2.0, 1.0, 0.5])
    world = World(rng, points=0, walls=8)
    a, b = (world.account(k, pose, HERE, rng, sigma=0.01) for k, pose in enumerate((HERE, frame)))
    rough = np.diag([0.1, 0.1, 0.035]) ** 2
    found = align(a, b, EXACT, prior=(frame + np.array([0.1, -0.05, 0.03]), rough))
    assert found is not None and len(found.points) == 0 and found.matches >= 4
    off = found.pose - frame
    assert np.hypot(*off[:2]) < 0.1 and off @ np.linalg.solve(found.cov, off) < 16.3  # 99.9 %
    assert align(a, b, EXACT) is None
    parallel = World(rng, points=0, walls=8)
    parallel.walls[:, 0], parallel.walls[:, 1] = 0.3, np.arange(8.0)
    middle = np.outer(parallel.walls[:, 1], [np.cos(0.3), np.sin(0.3)])
    along = np.array([-np.sin(0.3), np.cos(0.3)])
    parallel.ends = np.hstack([middle - along, middle + along])
    a, b = (parallel.account(k, pose, HERE, rng, sigma=0.01) for k, pose in enumerate((HERE, frame)))
    assert align(a, b, EXACT, prior=(frame, rough)) is None  # where along them nothing says


def test_a_corridor_that_is_the_same_from_both_ends_is_refused() -> None:
    rng = np.random.default_rng(4)
    world = World(rng, points=24, walls=0)
    half, turns = rng.uniform(-8, 8, (12, 2)), world.directions[:12]
    world.points, world.kinds = np.vstack([half, -half]), np.full(24, CONVEX, np.int8)
    world.directions = np.concatenate([turns, wrap(turns + np.pi)])
    a, b = (world.account(k, HERE, HERE, rng, sigma=0.01) for k in range(2))
    assert align(a, b, EXACT) is None


def test_maps_of_different_buildings_are_not_joined() -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        a, b = (World(rng).account(k, HERE, HERE, rng) for k in range(2))
        assert align(a, b) is None


def test_a_prior_that_is_wrong_is_not_obeyed() -> None:
    rng, frame = np.random.default_rng(6), np.array([2.0, 1.0, 0.5])
    world = World(rng, points=40)
    a = world.account(0, HERE, HERE, rng, sigma=0.01)
    b = world.account(1, frame, HERE, rng, sigma=0.01)
    assert align(a, b, EXACT) is not None
    assert align(a, b, EXACT, prior=(frame + np.array([4.0, 0.0, 0.0]), np.diag([0.1, 0.1, 0.05]) ** 2)) is None


def test_walls_in_free_space_contradict() -> None:
    room = np.full((60, 60), FREE, np.int8)
    room[[0, -1]] = room[:, [0, -1]] = OCCUPIED
    known = np.full((80, 80), UNKNOWN, np.int8)
    known[10:70, 10:70] = room
    a, b = (OccupancyGrid.from_classes(known, 0.05, (0.0, 0.0)) for _ in range(2))
    assert contradiction(a, b, HERE) == 0.0
    assert contradiction(a, b, np.array([1.0, 0.0, 0.0])) > 0.3
    assert contradiction(a, b, np.array([50.0, 0.0, 0.0])) == 0.0


def test_settings_are_checked() -> None:
    with pytest.raises(ValueError, match="gate"):
        AlignmentConfig(gate=1.0)
    with pytest.raises(ValueError, match="fewest_with_prior"):
        AlignmentConfig(fewest_with_prior=(-1, 4))


def test_a_variance_that_rounds_below_zero_is_not_believed_and_warns_of_nothing() -> None:
    pairs = np.zeros((9, 2), np.int64)
    for least, believed in ((1e-9, True), (-1e-18, False)):
        joint = Joint(
            x=np.zeros(0), frames=np.zeros((2, 3)), cov=np.diag([1e-6, 1e-6, least]), starts=np.zeros(2, np.int64),
            chi_square=0.0, dof=1, outlying=np.zeros(1),
        )  # fmt: skip
        with np.errstate(all="raise"):
            assert _believable(_Fit(joint, pairs, pairs, 0.0, 0.0), (2, 2), AlignmentConfig()) is believed
