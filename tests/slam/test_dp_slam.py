from __future__ import annotations

import copy
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import slam
from slam import Observations, Odometry, Scan
from slam.dp_slam import DpSlam, DpSlamConfig
from slam.geometry import compose, exp, inverse, wrap
from slam.motion import OdometryNoise
from slam.particles.ancestry import Ancestry
from slam.particles.grids import PASSES, STOPS, Lattice, ScanCells
from slam.particles.paths import Paths
from slam.particles.resampling import ResamplingPolicy
from slam.particles.shared_grid import CopiedGrids, SharedGrid, _entry
from slam.settings import from_mapping
from tests.slam.simulated import circle_twist, drive, room_scan

OFFSET = 0.2
seeds = st.integers(0, 10_000)
histories = st.tuples(seeds, st.integers(1, 7))


def random_ancestors(rng: np.random.Generator, n: int) -> np.ndarray:
    """Survivors keep their places, the others' go to copies of survivors."""
    survivors = rng.choice(n, int(rng.integers(1, n + 1)), replace=False)
    return np.where(np.isin(np.arange(n), survivors), np.arange(n), rng.choice(survivors, n))


# ---- the tree --------------------------------------------------------------------------------------------------


def check_tree(tree: Ancestry, particles: int) -> None:
    nodes = set(tree.nodes.tolist())
    children = {node: [c for c in nodes if tree.parent[c] == node] for node in nodes}
    assert len(nodes) <= max(2 * particles - 1, 1)
    assert len({int(leaf) for leaf in tree.leaf}) == particles
    for node in nodes:
        assert tree.parent[node] == -1 or int(tree.parent[node]) in nodes
        if node in tree.leaf:
            assert not children[node]
        else:
            assert len(children[node]) >= 2  # the others are merged


@settings(max_examples=60)
@given(histories)
def test_the_tree_stays_minimal_and_tells_who_saw_what(history: tuple[int, int]) -> None:
    """Every leaf notes a mark of its own now and then: a particle has its forefathers' marks, and no others."""
    rng, n = np.random.default_rng(history[0]), history[1]
    tree = Ancestry(n)
    marks: dict[int, set[int]] = {int(node): set() for node in tree.nodes}
    alone: list[set[int]] = [set() for _ in range(n)]

    def merge(parent: int, child: int) -> int:
        kept, gone = (parent, child) if rng.random() < 0.5 else (child, parent)
        marks[kept] |= marks.pop(gone)
        return kept

    for step in range(25):
        for i in range(n):
            marks.setdefault(int(tree.leaf[i]), set()).add(100 * step + i)
            alone[i].add(100 * step + i)
        ancestors = random_ancestors(rng, n)
        tree.resample(ancestors, forget=lambda node: marks.pop(node), merge=merge)  # type: ignore[arg-type]
        alone = [set(alone[a]) for a in ancestors]
        check_tree(tree, n)
        assert set(marks) <= set(tree.nodes.tolist())
        for i in range(n):
            assert set().union(*(marks.get(node, set()) for node in tree.lineage(i))) == alone[i]


@settings(max_examples=30)
@given(histories)
def test_paths_are_what_copies_would_be(history: tuple[int, int]) -> None:
    rng, n = np.random.default_rng(history[0]), history[1]
    paths = Paths(n)
    alone: list[list[np.ndarray]] = [[] for _ in range(n)]
    for _ in range(40):
        poses = rng.normal(size=(n, 3))
        paths.append(poses)
        for i in range(n):
            alone[i].append(poses[i])
        if rng.random() < 0.6:
            ancestors = random_ancestors(rng, n)
            paths.resample(ancestors)
            alone = [list(alone[a]) for a in ancestors]
    for i in range(n):
        np.testing.assert_array_equal(paths.of(i), np.array(alone[i]))


# ---- the grid --------------------------------------------------------------------------------------------------


def check_entries(grid: SharedGrid) -> None:
    """Entries belong to nodes there are, one a tile and node, each in its node's list and found by its hash."""
    entries = grid.entries()
    assert len(entries) == grid.live == int(grid._held.sum())
    assert set(entries[:, 2].tolist()) <= set(grid.ancestry.nodes.tolist())
    assert len(np.unique(entries, axis=0)) == len(entries)
    np.testing.assert_array_equal(np.bincount(entries[:, 2], minlength=len(grid._held)), grid._held)
    for row, col, node in entries.tolist():
        e = _entry(row, col, node, grid._head, grid._entries)
        assert grid._entries[e, :3].tolist() == [row, col, node]


@settings(max_examples=25, deadline=None)
@given(histories)
def test_the_shared_grid_is_what_copies_would_be(history: tuple[int, int]) -> None:
    """A random history of scans, resamplings and growth, bit for bit; nothing of the dead is left."""
    rng, n = np.random.default_rng(history[0]), history[1]
    shared, copied, scan = SharedGrid(n, 0.1), CopiedGrids(n, 0.1), ScanCells()
    for _ in range(12):
        low = rng.uniform(-9, 0, 2)
        shared.enclose(low, low + 6.0)
        copied.enclose(low, low + 6.0)
        for i in range(n):
            if rng.random() < 0.7:
                pose = np.append(low + rng.uniform(2, 4, 2), rng.uniform(-3, 3))
                scan.trace(shared.lattice, pose, OFFSET, rng.uniform(-2, 2, (8, 2)))
                shared.write(i, scan)
                copied.write(i, scan)
        if rng.random() < 0.7:
            ancestors = random_ancestors(rng, n)
            shared.resample(ancestors)
            copied.resample(ancestors)
        check_tree(shared.ancestry, n)
        check_entries(shared)
        for i in range(n):
            np.testing.assert_array_equal(shared.whole(i), copied.whole(i))


def test_a_scan_as_cells() -> None:
    """One beam along a row: passed through three cells, stopped in the fourth, and again by a second beam."""
    lattice, scan = Lattice(0.1), ScanCells()
    scan.trace(lattice, np.array([0.05, 0.05, 0.0]), 0.0, np.array([[0.32, 0.0], [0.34, 0.0]]))
    cells, evidence = scan.cells[: scan.count], scan.evidence[: scan.count]
    assert sorted((cells - cells.min(axis=0)).tolist()) == [[0, 0], [0, 1], [0, 2], [0, 3]]
    last = evidence[np.argmax(cells[:, 1])]
    np.testing.assert_allclose(last, [1.0, 0.8, 0.5, 0.0], atol=1e-5)  # one stop, at the mean place
    others = np.delete(evidence, np.argmax(cells[:, 1]), axis=0)
    assert others[:, PASSES].tolist() == [1.0, 1.0, 1.0] and not others[:, STOPS].any()


@given(seeds)
def test_a_scans_cells_are_listed_once(seed: int) -> None:
    rng = np.random.default_rng(seed)
    lattice, scan = Lattice(0.05), ScanCells()
    points = rng.uniform(-2.5, 2.5, (60, 2))
    lattice.enclose(np.array([-4.0, -4.0]), np.array([4.0, 4.0]))
    pose = np.append(rng.uniform(-0.5, 0.5, 2), rng.uniform(-3, 3))
    scan.trace(lattice, pose, OFFSET, points)
    cells = scan.cells[: scan.count]
    assert len(np.unique(cells, axis=0)) == scan.count
    assert scan.evidence[: scan.count, STOPS].sum() <= len(points)


# ---- the backend -----------------------------------------------------------------------------------------------


def run_in_a_room(backend: DpSlam, steps: int = 120, *, spins: range = range(0), seed: int = 3) -> np.ndarray:
    """Drive about in a room of 6 m × 5 m; return the error ``(steps, 3)`` in the start frame."""
    rng = np.random.default_rng(seed)
    start = pose = np.array([2.0, 2.0, 0.3])
    backend.reset(seed=seed)
    errors = []
    for k in range(steps):
        if k in spins:
            odometry = Odometry((0.4, 0.0, 0.3), 0.1)  # and the robot stands
        else:
            pose, odometry = drive(pose, circle_twist(k), (0.02, 0.03), rng)
        backend.predict(odometry)
        backend.update(room_scan(compose(pose, np.array([OFFSET, 0.0, 0.0])), rng))
        error = backend.pose - compose(inverse(start), pose)
        error[2] = wrap(error[2])
        errors.append(error)
    return np.array(errors)


def small(**settings: object) -> DpSlam:
    return DpSlam(from_mapping(DpSlamConfig, {"particles": 12, "odometry": {"slip_share": 0.0}, **settings}))


def test_pose_and_map_in_a_room() -> None:
    backend = small()
    errors = run_in_a_room(backend)
    assert np.hypot(*errors[:, :2].T).max() < 0.04
    assert np.abs(errors[:, 2]).max() < 0.015
    belief = backend.belief
    assert belief.landmarks.shape == (0, 2) and belief.landmark_cov.shape == (0, 2, 2)
    assert belief.joint_cov is None and backend.landmark_count == 0
    assert np.all(np.linalg.eigvalsh(belief.pose_cov) > 0)
    assert belief.grid.known_area_m2 == pytest.approx(30.0, rel=0.1)
    assert len(backend.path) == len(backend._key)
    np.testing.assert_allclose(backend.path[-1][:2], backend.pose[:2], atol=0.25)


def test_the_covariance_is_true_within_a_factor_of_three() -> None:
    """Where all particles descend from one, so that it is the inherited error's."""
    nees = []
    for seed in range(4):
        backend = small()
        start = pose = np.array([2.0, 2.0, 0.3])
        rng = np.random.default_rng(seed)
        backend.reset(seed=seed)
        backend._origin[:] = 0
        backend.update(room_scan(compose(pose, np.array([OFFSET, 0.0, 0.0])), rng))
        for k in range(80):
            pose, odometry = drive(pose, circle_twist(k), (0.02, 0.03), rng)
            backend.predict(odometry)
            backend.update(room_scan(compose(pose, np.array([OFFSET, 0.0, 0.0])), rng))
            nees.append(backend.pose_nees(compose(inverse(start), pose)) / 3)
    assert 0.2 < np.mean(nees) < 3


def test_a_narrow_view_lags_little_behind_turns() -> None:
    """Walls end where the view did: they would draw the beams beyond back. The wheels are exact."""
    lags = []
    for seed, turn in itertools.product(range(3), (0.3, -0.3)):
        backend, rng = small(), np.random.default_rng(seed)
        start = pose = np.array([3.0, 1.5 if turn > 0.0 else 3.5, 0.0])
        backend.reset(seed=seed)
        for _ in range(100):
            twist = np.array([0.3, 0.0, turn])
            pose = compose(pose, exp(0.1 * twist))
            backend.predict(Odometry(tuple(twist.tolist()), 0.1))
            whole = room_scan(compose(pose, np.array([OFFSET, 0.0, 0.0])), rng)
            bearings = whole.angle_min + whole.angle_increment * np.arange(len(whole.ranges))
            ahead = np.flatnonzero(np.abs(bearings) <= math.radians(45.0))
            first = float(bearings[ahead[0]])
            backend.update(Scan(whole.ranges[ahead], first, whole.angle_increment, whole.range_max))
        lags.append(float(wrap(pose[2] - start[2] - backend.pose[2])) * math.copysign(1.0, turn))
    assert np.mean(lags) < 0.023


def test_shared_and_copied_maps_give_the_same_filter() -> None:
    """Poses, weights and maps bit for bit, with much resampling."""
    often = {"resampling": {"when": "every_k", "every": 2}, "particles": 6}
    one, two = small(**often), small(**often, copies=True)
    for backend in (one, two):
        run_in_a_room(backend, 60)
    np.testing.assert_array_equal(one._poses, two._poses)
    np.testing.assert_array_equal(one._weights, two._weights)
    np.testing.assert_array_equal(one.grid.log_odds, two.grid.log_odds)
    for i in range(6):
        np.testing.assert_array_equal(one.grids.whole(i), two.grids.whole(i))
    assert isinstance(one.grids, SharedGrid)
    check_tree(one.grids.ancestry, 6)
    check_entries(one.grids)


def test_one_seed_is_one_run_and_a_reset_starts_over() -> None:
    backend = small()
    first = run_in_a_room(backend, 40)
    grid = backend.grid.log_odds.copy()
    again = run_in_a_room(backend, 40)  # on the same object
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(backend.grid.log_odds, grid)
    np.testing.assert_array_equal(run_in_a_room(small(), 40), first)
    backend.reset((1.0, 2.0, 0.5), seed=9)
    assert backend.grid.known_cells == 0 and len(backend.path) == 0
    np.testing.assert_allclose(backend.pose, [1.0, 2.0, 0.5], atol=1e-3)


def test_a_copy_goes_its_own_way() -> None:
    backend = small()
    run_in_a_room(backend, 30)
    other, before = copy.deepcopy(backend), backend.pose
    other.predict(Odometry((0.4, 0.0, 0.0), 0.5))
    other.update(Scan(np.full(360, np.nan), -math.pi, 2 * math.pi / 360, 8.0))
    np.testing.assert_array_equal(backend.pose, before)
    assert other.pose[0] != before[0]


def test_spinning_wheels_do_not_lose_the_filter() -> None:
    """For a second the wheels claim to drive and turn while the robot stands: every scan says otherwise."""
    errors = run_in_a_room(small(), 90, spins=range(40, 50))
    assert np.hypot(*errors[-1, :2]) < 0.05
    assert abs(errors[-1, 2]) < 0.02


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_without_any_return_the_wheels_are_believed(value: float) -> None:
    backend = small()
    backend.reset()
    nothing = Scan(np.full(360, value), -math.pi, 2 * math.pi / 360, 8.0)
    twist, pose = np.array([0.3, 0.1, 0.2]), np.zeros(3)
    for _ in range(30):
        backend.predict(Odometry(twist, 0.1))
        backend.update(nothing)
        pose = compose(pose, exp(twist * 0.1))
    assert np.all(np.isfinite(backend.pose))
    np.testing.assert_allclose(backend.pose, pose, atol=0.1)
    assert backend.pose_cov[0, 0] > 1e-5


def test_a_lost_scan_in_between_is_bridged() -> None:
    rng = np.random.default_rng(0)
    backend, pose = small(), np.array([2.0, 2.0, 0.3])
    backend.reset()
    for k in range(40):
        pose, odometry = drive(pose, circle_twist(k), (0.02, 0.03), rng)
        backend.predict(odometry)
        scan = room_scan(compose(pose, np.array([OFFSET, 0.0, 0.0])), rng)
        backend.update(scan if k % 4 else scan._replace(ranges=np.full(360, np.nan)))
    error = backend.pose - compose(inverse(np.array([2.0, 2.0, 0.3])), pose)
    assert np.hypot(*error[:2]) < 0.05


def test_the_grid_follows_the_lead() -> None:
    """Another particle leads, one that took another way: the grid is redrawn from its path, and says so."""
    backend = small(resampling={"when": "every_k", "every": 1000})
    run_in_a_room(backend, 30)
    before = backend.grid.revision
    lead = (backend._lead + 1) % 12
    backend._paths._poses[: backend._paths._count] += np.array([0.3, 0.0, 0.0])
    backend._lead = lead
    assert backend._redraw_if_moved()
    assert backend.grid.revision == before + 1
    assert len(backend.grid.take_changes()) == 0
    np.testing.assert_allclose(backend._shown[:, 0], backend.path[:, 0] + OFFSET * np.cos(backend.path[:, 2]))


def test_landmark_observations_are_refused() -> None:
    backend = slam.make("dp-slam")
    assert not backend.observes_landmarks
    with pytest.raises(ValueError, match="not landmark observations"):
        backend.observe(Observations(np.array([[1.0, 0.0]]), np.eye(2)[None]))
    out = np.ones((4, 6), np.float32)
    backend.near_landmarks(out)
    assert not out.any()


def test_configuration_is_checked() -> None:
    config = from_mapping(
        DpSlamConfig, {"particles": 5, "matching": {"cell_m": 0.1}, "scan_odometry": {"scans": 4}}
    )
    assert config.matching.cell_m == 0.1 and config.scan_odometry.scans == 4
    assert config.resampling == ResamplingPolicy() and config.odometry == OdometryNoise()
    for bad, message in (
        ({"particles": 0}, "particles"),
        ({"update_m": -1.0}, "update_"),
        ({"drift_m": 0.0}, "drift_"),
        ({"free": 0.0}, "free"),
    ):
        with pytest.raises(ValueError, match=message):
            DpSlamConfig(**bad)  # type: ignore[arg-type]
