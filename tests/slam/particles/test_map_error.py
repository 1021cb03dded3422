"""The error that a matched pose inherits from the map: against errors drawn one by one, and out and back."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slam.geometry import compose
from slam.grids.scan_matching import MatchConfig
from slam.particles.grids import ScanCells
from slam.particles.map_error import MapError, transport
from slam.particles.match import ParticleMatcher
from slam.particles.shared_grid import SharedGrid
from tests.slam.numerics import numerical_jacobian, random_covariance

Array = np.ndarray
MOTION, START = np.diag([4e-6, 4e-6, 1e-6]), np.diag([1e-8, 1e-8, 1e-8])


def test_transport_is_the_derivative_of_moving_a_rigid_piece() -> None:
    here, there = np.array([1.0, -2.0]), np.array([4.0, 3.0])

    def moved(error: Array) -> Array:
        """Return where what stands at ``there`` stands when the piece at ``here`` is off by ``error``."""
        apart = compose(np.array([0.0, 0.0, error[2]]), np.array([*(there - here), 0.0]))
        return apart + np.array([*(here + error[:2]), 0.0])

    np.testing.assert_allclose(numerical_jacobian(moved, np.zeros(3)), transport(here, there), atol=1e-9)


def test_covariance_of_errors_drawn_one_by_one() -> None:
    """The recursion says of 20 000 errors what their mean squares are; some tiles are seen again and again."""
    rng, runs = np.random.default_rng(1), 20_000
    error = MapError(START, 2.0)
    drawn = rng.multivariate_normal(np.zeros(3), START, runs)
    pieces: dict[int, tuple[Array, float, Array]] = {}  # tile: its centre, beams so far, errors
    pose = np.zeros(3)
    for step in range(12):
        before, pose = pose, np.array([1.5 * math.sin(step / 3), 0.4 * step % 3, 0.3 * step])
        ends = pose[:2] + rng.uniform(-3, 3, (40, 2))
        groups, tiles = error.tiles(ends)
        old = [k for k, t in enumerate(tiles) if int(t) in pieces]
        infos = np.zeros((len(tiles), 3, 3))
        for k in old:
            infos[k] = np.linalg.inv(random_covariance(3, rng, 1e-4))
        prior, motion, draw = np.linalg.inv(1e-3 * np.eye(3)), random_covariance(3, rng, 1e-5), 1e-6 * np.eye(3)
        error.match(before, pose, motion, prior, tiles, infos, 0.7, draw)
        # A match is the minimum of the squares of what the motion and every tile say of the pose.
        gain = np.linalg.inv(prior + infos.sum(axis=0))
        says = (
            drawn @ transport(before[:2], pose[:2]).T + rng.multivariate_normal(np.zeros(3), motion, runs)
        ) @ prior
        for k in old:
            centre, _, off = pieces[int(tiles[k])]
            noise = 0.7 * np.linalg.inv(infos[k])
            says += (
                off @ transport(centre, pose[:2]).T + rng.multivariate_normal(np.zeros(3), noise, runs)
            ) @ infos[k]
        drawn = says @ gain + rng.multivariate_normal(np.zeros(3), draw, runs)
        counts = np.bincount(groups, minlength=len(tiles)).astype(float)
        error.draw(pose, tiles, counts)
        for t, count, centre in zip(tiles, counts, _centres(ends, groups, len(tiles)), strict=True):
            moved = drawn @ transport(pose[:2], centre).T
            _, so_far, off = pieces.get(int(t), (centre, 0.0, moved))
            pieces[int(t)] = centre, so_far + count, (so_far * off + count * moved) / (so_far + count)
    for block, errors in [(error.cov[:3, :3], drawn), *((_own(error, t), p[2]) for t, p in pieces.items())]:
        scale = np.sqrt(np.outer(np.diag(block), np.diag(block)))
        np.testing.assert_allclose(errors.T @ errors / runs / scale, block / scale, atol=0.04)
    across = drawn.T @ pieces[0][2] / runs
    scale = np.sqrt(np.outer(np.diag(error.pose_cov), np.diag(_own(error, 0))))
    np.testing.assert_allclose(across / scale, error.cov[:3, 3:6] / scale, atol=0.04)
    assert len(pieces) > 10


def _centres(ends: Array, groups: Array, tiles: int) -> Array:
    return np.array([(np.floor(ends[groups == k][0] / 2.0) + 0.5) * 2.0 for k in range(tiles)])


def _own(error: MapError, tile: int) -> Array:
    return error.cov[3 + 3 * tile : 6 + 3 * tile, 3 + 3 * tile : 6 + 3 * tile]


def walk(error: MapError, places: list[float]) -> list[float]:
    """Go along x in a corridor, matched to what is seen of it up to 4 m away; return σ of y at each place [m]."""
    known: set[int] = set()
    sigmas, before = [], np.array([places[0], 0.0, 0.0])
    for x in places:
        pose = np.array([x, 0.0, 0.0])
        ahead = np.arange(x - 4.0, x + 4.0, 0.2)
        groups, tiles = error.tiles(np.column_stack([np.r_[ahead, ahead], np.repeat([-1.0, 1.0], len(ahead))]))
        infos = np.zeros((len(tiles), 3, 3))
        for k, t in enumerate(tiles.tolist()):
            if t in known:
                infos[k] = np.diag([1e3, 1e4, 1e4])
        error.match(before, pose, MOTION, np.diag([1e3, 1e3, 1e4]), tiles, infos, 1.0, np.zeros((3, 3)))
        error.draw(pose, tiles, np.bincount(groups).astype(float))
        known |= set(tiles.tolist())
        before = pose
        sigmas.append(math.sqrt(error.pose_cov[1, 1]))
    return sigmas


def test_grows_on_new_ground_and_is_bounded_where_the_first_map_is_seen_again() -> None:
    there = np.arange(0.0, 60.0, 0.5).tolist()
    error = MapError(START, 2.0)
    out = walk(error, there)
    assert out[-1] > 5 * out[10]  # the heading's drift has a lever
    back = walk(error, there[::-1])
    assert back[-1] < 0.5 * out[-1]
    staying = walk(error, [0.0] * 200)
    assert staying[-1] < 1.5 * back[-1]
    assert np.linalg.eigvalsh(error.cov).min() > -1e-12


def test_a_tile_in_which_nothing_was_drawn_errs_as_the_last_pose() -> None:
    """A surface across its border may well fit; that is no news of where the world is."""
    error, pose = MapError(np.diag([1e-2, 1e-2, 1e-4]), 2.0), np.array([0.1, 0.2, 0.0])
    _, tiles = error.tiles(np.array([[1.0, 1.0]]))
    error.match(np.zeros(3), pose, MOTION, np.eye(3), tiles, 1e6 * np.eye(3)[None], 1.0, np.zeros((3, 3)))
    f = transport(np.zeros(2), pose[:2])
    np.testing.assert_allclose(error.pose_cov, f @ np.diag([1e-2, 1e-2, 1e-4]) @ f.T, atol=1e-5)


def test_without_a_map_it_is_the_motion_s() -> None:
    error, cov = MapError(START, 2.0), START
    before = np.zeros(3)
    for k in range(1, 20):
        pose = np.array([0.5 * k, 0.1 * k, 0.0])
        none = np.zeros(0, np.int64), np.zeros((0, 3, 3))
        error.match(before, pose, MOTION, np.eye(3), *none, 1.0, np.zeros((3, 3)))
        f = transport(before[:2], pose[:2])
        cov, before = f @ cov @ f.T + MOTION, pose
    np.testing.assert_allclose(error.pose_cov, cov, rtol=1e-9)


def test_tiles_are_found_again_and_there_is_room_for_many() -> None:
    error, rng = MapError(START, 2.0), np.random.default_rng(0)
    ends = rng.uniform(-20, 20, (500, 2))
    groups, tiles = error.tiles(ends)
    assert np.all(np.bincount(groups) > 0) and len(set(tiles.tolist())) == len(tiles) > 200
    again, same = error.tiles(ends[::-1])
    np.testing.assert_array_equal(same[again[::-1]], tiles[groups])
    assert error.cov.shape == (3 + 3 * len(tiles),) * 2
    error.draw(np.zeros(3), tiles, np.bincount(groups).astype(float))
    np.testing.assert_allclose(error.cov[3:6, :3], transport(np.zeros(2), error._centres[0]) @ START)


def test_informations_of_parts_of_a_map_are_that_of_the_fit() -> None:
    config, angle = MatchConfig(), np.linspace(-3, 3, 150)
    box = 2.0 / np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle)))[:, None]
    points = box * np.column_stack([np.cos(angle), np.sin(angle)])
    grids, cells = SharedGrid(1, config.cell_m), ScanCells()
    grids.enclose(np.full(2, -4.0), np.full(2, 4.0))
    cells.trace(grids.lattice, np.zeros(3), 0.0, points)
    grids.write(0, cells)
    matcher, info = ParticleMatcher(config), np.diag([1e3, 1e3, 1e3])
    pose, curvature, _ = matcher.fit(grids, 0, points, np.array([0.02, 0.01, 0.005]), info, unknown=0.3, free=0.1)
    groups = np.arange(len(points)) % 3
    infos, distance2 = matcher.informations(grids, 0, points, pose, groups, 3)
    np.testing.assert_allclose(infos.sum(axis=0) + info, curvature, rtol=1e-3, atol=1.0)
    assert distance2 < config.cell_m**2 / 3  # the very scan that was drawn
    _, farther = matcher.informations(grids, 0, 1.04 * points, pose, groups, 3)
    assert math.sqrt(farther - distance2) == pytest.approx(0.08, rel=0.3)


def test_a_fit_that_looks_beyond_the_map_leaves_nothing_behind() -> None:
    config, angle = MatchConfig(), np.linspace(-3, 3, 150)
    points = 1.5 * np.column_stack([np.cos(angle), np.sin(angle)])
    grids = SharedGrid(1, config.cell_m)
    grids.enclose(np.full(2, -1.0), np.full(2, 1.0))
    matcher, (rows, cols) = ParticleMatcher(config), grids.lattice.shape
    edge = config.cell_m * np.array([grids.lattice.col + cols, grids.lattice.row + rows])
    matcher.fit(grids, 0, points, np.array([*edge, 0.0]), np.eye(3), unknown=0.3, free=0.1)
    assert not matcher._plane.any() and not matcher._values.any()
