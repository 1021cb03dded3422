from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import block_diag

import slam
from slam.accounts.account import Account
from slam.geometry import compose, inverse, wrap
from slam.metrics.measures import nees_band
from slam.teams.alignment import Alignment, align
from slam.teams.frames import ends_into, points_into, pose_into, walls_into
from slam.teams.fusion import MergedMap, fuse
from slam.teams.joint import SameConfig
from tests.slam.teams.worlds import Array, World

EXACT = SameConfig(point_sigma_m=0.0, wall_sigma_m=0.0, wall_sigma_rad=0.0)
FRAMES = np.array([[0.0, 0.0, 0.0], [3.0, -2.0, 2.0], [-4.0, 1.0, -2.9]])
POSES = np.array([[1.0, 1.0, 0.3], [2.0, -3.0, -1.0], [-2.0, 2.0, 3.0]])
SEES = [np.arange(0, 17), np.arange(8, 25), np.r_[np.arange(0, 10), np.arange(20, 25)]]


def tied(i: int, j: int, robots: int = 3) -> Alignment:
    """What is the same in the accounts of two, without a search: by the rows of the world."""
    both = np.intersect1d(SEES[i], SEES[j])
    points = np.column_stack([np.searchsorted(SEES[i], both), np.searchsorted(SEES[j], both)])
    walls = np.column_stack([np.arange(8), np.arange(8)])
    pose = compose(compose(inverse(FRAMES[i]), FRAMES[j]), np.array([0.1, -0.1, 0.03]))  # a first guess
    return Alignment(
        a=i, b=j, pose=pose, cov=np.eye(3), points=points, walls=walls, rival=0.0,
        contradicted=0.0,
    )  # fmt: skip


def run(seed: int, known: bool, robots: int = 3) -> tuple[MergedMap, World, Array]:
    rng = np.random.default_rng(seed)
    world = World(rng)
    accounts = [world.account(k, FRAMES[k], POSES[k], rng, sees=SEES[k]) for k in range(robots)]
    frames = None
    if known:
        cov = np.diag([0.05, 0.05, 0.02]) ** 2
        frames = {k: (FRAMES[k] + rng.multivariate_normal(np.zeros(3), cov), cov) for k in range(robots)}
    alignments = [tied(i, j) for i in range(robots) for j in range(i + 1, robots)]
    return fuse(accounts, alignments, frames=frames, same=EXACT), world, rng


def whole_error(merged: MergedMap, world: World) -> Array:
    pose_errors = merged.poses - POSES
    pose_errors[:, 2] = wrap(pose_errors[:, 2])
    apart = np.linalg.norm(merged.points[:, None] - world.points[None], axis=2)
    points = merged.points - world.points[apart.argmin(axis=1)]
    walls = merged.walls - world.walls
    walls[:, 0] = wrap(walls[:, 0])
    return np.concatenate([pose_errors.ravel(), points.ravel(), walls.ravel()])


@pytest.mark.parametrize("known", [True, False], ids=["known frames", "unknown frames"])
def test_the_merged_map_is_as_good_as_it_says(known: bool) -> None:
    runs, nees, frames, chi = 40, [], [], []
    for seed in range(runs):
        merged, world, _ = run(seed, known)
        assert len(merged.points) == 25 and len(merged.walls) == 8
        error = whole_error(merged, world)
        nees.append(error @ np.linalg.solve(merged.cov, error))
        off = merged.frames[1] - FRAMES[1]
        off[2] = wrap(off[2])
        frames.append(off @ np.linalg.solve(merged.frame_covs[1], off))
        chi.append(merged.chi_square)
    for values, dof in ((nees, len(merged.cov)), (frames, 3), (chi, merged.dof)):
        low, high = nees_band(dof, runs, confidence=0.999)
        assert low < np.mean(values) / dof < high


def test_what_two_saw_is_known_better_and_told_by_whom() -> None:
    merged, world, _ = run(0, known=False, robots=2)
    alone, _, _ = run(0, known=False, robots=1)
    nearest = np.linalg.norm(merged.points[:, None] - world.points[None], axis=2).argmin(axis=1)
    for point, row in enumerate(nearest):
        assert merged.seen_by[point] == tuple(k for k in range(2) if row in SEES[k])
        assert merged.times_seen[point] == len(merged.seen_by[point])
        off = float(wrap(merged.directions[point] - world.directions[row]))
        assert abs(off) < 0.05 and merged.kinds[point] == world.kinds[row]
    assert merged.walls_seen_by == ((0, 1),) * 8
    assert np.trace(merged.pose_covs[0]) <= np.trace(alone.pose_covs[0])
    assert np.trace(merged.points_cov[:34, :34]) < np.trace(alone.points_cov)


def moved(account: Account, by: Array) -> Account:
    """Return the same account, told in a frame in which its own lies at ``by``."""
    n = len(account.points)
    pose, by_pose, _ = pose_into(by, account.pose)
    points, by_points, _ = points_into(by, account.points)
    walls, by_walls, _ = walls_into(by, account.walls)
    jacobian = block_diag(by_pose, *by_points, *by_walls)
    return Account(**{
        **account.__dict__, "pose": pose, "points": points, "walls": walls,
        "wall_ends": ends_into(by, account.wall_ends), "directions": wrap(account.directions + by[2]),
        "cov": jacobian @ account.cov @ jacobian.T, "point_ids": np.arange(n),
    })  # fmt: skip


@settings(max_examples=20, deadline=None)
@given(st.floats(-5, 5), st.floats(-5, 5), st.floats(-3.1, 3.1))
def test_in_which_frame_a_robot_tells_it_does_not_matter(x: float, y: float, theta: float) -> None:
    rng, by = np.random.default_rng(1), np.array([x, y, theta])
    world = World(rng)
    # To first order: a wall's r is not linear in its α, and errors this small leave nothing of that.
    first, second = (world.account(k, FRAMES[k], POSES[k], rng, sees=SEES[k], sigma=1e-4) for k in range(2))
    one = tied(0, 1)
    other = Alignment(**{**one.__dict__, "pose": compose(one.pose, inverse(by))})
    here, there = (fuse([first, b], [ab], same=EXACT) for b, ab in ((second, one), (moved(second, by), other)))
    for name in ("poses", "points", "walls", "wall_ends", "cov", "directions"):
        np.testing.assert_allclose(getattr(here, name), getattr(there, name), atol=1e-7)
    np.testing.assert_allclose(compose(there.frames[1], by)[:2], here.frames[1, :2], atol=1e-6)
    assert here.seen_by == there.seen_by and abs(here.chi_square - there.chi_square) < 1e-2


def test_the_same_account_is_not_taken_twice_nor_an_untied_one() -> None:
    rng = np.random.default_rng(0)
    world = World(rng)
    accounts = [world.account(k, FRAMES[k], POSES[k], rng, sees=SEES[k]) for k in range(2)]
    with pytest.raises(ValueError, match="one account of each"):
        fuse([accounts[0], accounts[0]])
    with pytest.raises(ValueError, match=r"robots \[1\]"):
        fuse(accounts)
    assert len(fuse(accounts, frames={k: (FRAMES[k], np.eye(3) * 1e-4) for k in range(2)}).points) == 34


def test_an_account_is_a_copy_of_the_belief() -> None:
    backend = slam.make("invariant-ekf")
    account = Account.of(3, 0.5, backend)
    assert account.robot == 3 and account.stamp == 0.5 and account.cov.shape == (3, 3)
    with pytest.raises(ValueError, match="read-only"):
        account.pose[0] = 1.0
    with pytest.raises(ValueError, match="joint covariance"):
        Account.of(0, 0.0, slam.make("fastslam2"))


def test_fused_after_a_search() -> None:
    rng = np.random.default_rng(5)
    world = World(rng, points=40)
    accounts = [world.account(k, FRAMES[k], POSES[k], rng) for k in range(2)]
    found = align(*accounts)
    assert found is not None
    merged = fuse(accounts, [found], same=EXACT)
    assert len(merged.points) <= 46
