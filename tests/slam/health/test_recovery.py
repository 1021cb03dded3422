"""Every backend notices that it was carried elsewhere, undoes what it made of that, and is found again."""

from __future__ import annotations

import math

import numpy as np
import pytest

import slam
from mecanum_env.env import ExploreEnv
from slam.ekf import EkfSlam
from slam.geometry import compose, transform_points
from slam.grids.occupancy import OccupancyGrid
from slam.health.monitor import HealthConfig
from slam.health.recovery import Recovery
from slam.health.relocalisation import RelocalisationConfig, Relocaliser
from slam.landmarks.book import LAST_SEEN
from slam.types import Odometry, Scan
from training.studies.recovery.faults import FAULTS

ESTIMATORS = [name for name in slam.names() if name not in ("odometry", "truth")]


def driven(
    name: str, steps: int, *, seed: int = 3, rooms: str = "apartment", settings: dict[str, object] | None = None
) -> ExploreEnv:
    env = ExploreEnv(rooms=rooms, slam={"name": name, **(settings or {})})
    env.reset(seed=seed)
    for k in range(steps):
        env.step(np.array([0.4 * math.cos(k / 15), 0.3 * math.sin(k / 9), 0.3], np.float32))
    return env


@pytest.mark.parametrize("name", ESTIMATORS)
def test_carried_off_and_found(name: str) -> None:
    env = driven(name, 60)
    walls = env.episode_metrics()["map_precision"]
    backend, still = env.backend, np.zeros(3, np.float32)
    assert backend.recovery.monitor.fine > 0.99
    assert FAULTS["teleport"]().begin(env, np.random.default_rng(0))
    lowest = 1.0
    for _ in range(60):
        observation, *_ = env.step(still)
        lowest = min(lowest, float(observation["health"][0]))
        assert observation["health"].dtype == np.float32
    assert lowest < 0.1
    assert backend.recovery.times_lost == backend.recovery.relocalisations == 1
    assert not backend.recovery.lost
    assert backend.recovery.monitor.fine > 0.95
    assert np.hypot(*(backend.pose - env.truth.pose)[:2]) < 0.08
    metrics = env.episode_metrics()
    assert metrics["relocalisations"] == 1
    assert 0.0 < metrics["lost_s"] < 4.0
    assert 0.2 < metrics["health_mean"] < 1.0
    assert metrics["map_precision"] > walls - 0.02  # no wall stands twice


@pytest.mark.parametrize("name", ["ekf", "invariant-ekf", "compressed-ekf"])
def test_found_after_long_its_covariance_is_one(name: str) -> None:
    """Lasting errors of wheels, which landmarks tell of, have the lost robot share ever more with these."""
    backend = driven(name, 150).backend
    backend._carry_on(backend.pose, backend.pose_cov)
    for _ in range(2000):
        backend.predict(Odometry((0.4, 0.3, -0.1), 0.1))
    backend._find(backend.pose, np.diag([1e-2, 1e-2, 1e-3]))
    eigenvalues = np.linalg.eigvalsh(backend.belief.joint_cov)
    assert eigenvalues[0] > -1e-12 * eigenvalues[-1]


def test_carried_off_and_turning() -> None:
    """So its particles follow the scan, and the map is redrawn: not with what contradicts it."""
    env = driven("dp-slam", 60, seed=2)
    assert FAULTS["teleport"]().begin(env, np.random.default_rng(0))
    for _ in range(60):
        env.step(np.array([0.0, 0.0, 0.5], np.float32))
    assert env.backend.recovery.times_lost == env.backend.recovery.relocalisations == 1
    assert np.hypot(*(env.backend.pose - env.truth.pose)[:2]) < 0.08


@pytest.mark.parametrize("sigma_rad", [0.05, 0.15])
@pytest.mark.parametrize("name", ["invariant-ekf", "fastslam2", "graph-slam"])
def test_who_is_unsure_of_the_start_is_found_as_well(name: str, sigma_rad: float) -> None:
    """What the start was off by is in all that was drawn: it explains no scan that contradicts the map."""
    env = driven(name, 60, settings={"start_sigma_rad": sigma_rad})
    backend = env.backend
    assert 9.0 * backend.pose_cov[2, 2] > backend.recovery.config.blur_m**2
    assert FAULTS["teleport"]().begin(env, np.random.default_rng(0))
    for _ in range(60):
        env.step(np.zeros(3, np.float32))
    assert backend.recovery.times_lost == backend.recovery.relocalisations == 1
    assert np.hypot(*(backend.pose - env.truth.pose)[:2]) < 0.1


@pytest.mark.parametrize("rooms", ["apartment", "maze"])
def test_being_found_tells_nothing_of_where_the_map_lies(rooms: str) -> None:
    """Twice carried off, with a start that is known and with one that is not: the same but for the covariance."""
    poses, covs = [], []
    for sigma in (1e-4, 0.1):
        env = driven("invariant-ekf", 60, rooms=rooms, settings={"start_sigma_m": sigma, "start_sigma_rad": sigma})
        for _ in range(2):
            assert FAULTS["teleport"]().begin(env, np.random.default_rng(0))
            for _ in range(40):
                env.step(np.zeros(3, np.float32))
        assert env.backend.recovery.relocalisations == 2
        poses.append(env.backend.pose)
        covs.append(env.backend.pose_cov)
    np.testing.assert_allclose(poses[1], poses[0], atol=1e-3)
    assert 0.0999**2 < covs[1][2, 2] < 0.11**2 and covs[0][2, 2] < 0.02**2


@pytest.mark.parametrize("redraws", [True, False])
def test_a_closed_loop_is_no_reason_to_be_lost(redraws: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """All that is believed moves at once, long before the drawing is looked at again: it is brought up to date."""
    env = driven("ekf", 60, settings={"key_scans": {"check_every": 10**6}})
    backend, shift = env.backend, np.array([0.3, 0.2, 0.05])
    assert isinstance(backend, EkfSlam)
    if not redraws:
        monkeypatch.setattr(backend, "_redraw_if_moved", lambda: False)
    backend._x[:3] = compose(shift, backend._x[:3])
    backend._points[:] = transform_points(shift, backend._points)
    for _ in range(40):
        env.step(np.zeros(3, np.float32))
    assert (backend.recovery.times_lost == 0) == redraws
    if redraws:
        assert backend.health > 0.9
        assert np.hypot(*(backend.pose - compose(shift, env.truth.pose))[:2]) < 0.05


@pytest.mark.parametrize("variance", [0.0, 1.0])
def test_a_drawing_from_unsure_poses_says_nothing_against_a_sure_one(
    variance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a hall the start is drawn half a metre off, and nothing says so before the robot is back."""
    env = driven("invariant-ekf", 60)
    backend = env.backend
    monkeypatch.setattr(backend, "_redraw_if_moved", lambda: False)
    monkeypatch.setattr(backend.key_scans, "old_variance", lambda x, y, radius_m: variance)
    backend.key_scans.put_back(backend.grid, backend.key_scans.poses + np.array([0.5, 0.3, 0.1]))
    pose = backend.pose
    for _ in range(40):
        env.step(np.zeros(3, np.float32))
    assert (backend.recovery.times_lost == 0) == (variance > 0.0)
    if variance:
        assert np.hypot(*(backend.pose - pose)[:2]) < 0.03
        assert not backend._doubtful  # it is drawn anew meanwhile


def test_a_belief_that_is_wrong_sure_and_corrected_by_nothing_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scans fit the map right beside it, but its covariance lets nothing move it there."""
    env = driven("invariant-ekf", 60)
    backend = env.backend
    assert isinstance(backend, EkfSlam)
    monkeypatch.setattr(backend, "_features", lambda scan: np.zeros((0, 12)))
    backend._x[:3] = compose(backend._x[:3], np.array([0.1, 0.08, 0.12]))
    for _ in range(40):
        env.step(np.zeros(3, np.float32))
    assert backend.recovery.times_lost == 1 and backend.health > 0.9
    off = backend.pose - env.truth.pose
    assert np.hypot(*off[:2]) < 0.04 and abs(off[2]) < 0.02


@pytest.mark.parametrize("name", ["ekf", "invariant-ekf"])
def test_where_no_landmark_is_in_sight_the_drawn_map_puts_the_pose_right(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is off by what its covariance allows for, and the scans contradict the map from there."""
    env = driven(name, 60)
    backend = env.backend
    assert isinstance(backend, EkfSlam)
    monkeypatch.setattr(backend, "_features", lambda scan: np.zeros((0, 12)))
    backend._x[:3] = compose(backend._x[:3], np.array([0.03, 0.02, 0.09]))
    backend._p[[0, 1, 2], [0, 1, 2]] += np.square([0.03, 0.03, 0.08])
    for _ in range(20):
        env.step(np.zeros(3, np.float32))
    assert backend.recovery.times_lost == 0 and backend.recovery.monitor.fine > 0.9
    off = backend.pose - env.truth.pose
    assert np.hypot(*off[:2]) < 0.04 and abs(off[2]) < 0.02
    assert backend.pose_nees(env.truth.pose) < 14.0


@pytest.mark.parametrize(("lately", "corrected"), [(100, True), (2, True), (1, False), (0, False)])
def test_the_drawn_map_says_nothing_where_landmarks_were_seen_long_ago(*, lately: int, corrected: bool) -> None:
    """What is drawn since then has drifted with the pose, and would make it sure of where it is."""
    env = driven("invariant-ekf", 60)
    backend = env.backend
    assert isinstance(backend, EkfSlam)
    backend._x[:3] = compose(backend._x[:3], np.array([0.03, 0.02, 0.09]))
    backend._p[[0, 1, 2], [0, 1, 2]] += np.square([0.03, 0.03, 0.08])
    seen = backend._book.marks[:, LAST_SEEN]
    seen[np.argsort(-seen)[lately:]] -= 100.0
    backend._doubtful = True
    sigma = math.sqrt(backend.pose_cov[2, 2])
    backend._hold_by_map(env.scan)
    assert (math.sqrt(backend.pose_cov[2, 2]) < 0.3 * sigma) == corrected


@pytest.mark.parametrize("needed", [True, False])
def test_where_landmarks_are_few_the_drawn_map_hangs_on_the_place_that_the_robot_is_at(*, needed: bool) -> None:
    env = driven("invariant-ekf", 60)
    backend = env.backend
    assert isinstance(backend, EkfSlam)
    places, book = backend._places, backend._book
    for z in places.make(book.next_id, places.ends(env.scan, backend.extractor)):
        backend._add(z, None)
    backend._x[:3] = compose(backend._x[:3], np.array([0.03, 0.02, 0.09]))
    backend._p[[0, 1, 2], [0, 1, 2]] += np.square([0.03, 0.03, 0.08])
    book.marks[:, LAST_SEEN] -= 100.0
    places._few, backend._doubtful = 10 * needed, True
    sigma = math.sqrt(backend.pose_cov[2, 2])
    backend._hold_by_map(env.scan)
    assert (math.sqrt(backend.pose_cov[2, 2]) < 0.3 * sigma) == needed
    off = backend.pose - env.truth.pose
    assert (np.hypot(*off[:2]) < 0.03 and abs(off[2]) < 0.02) == needed


def test_a_scan_that_fits_right_beside_the_belief_does_not_give_it_up() -> None:
    env = driven("invariant-ekf", 60)
    recovery, grid, pose = env.backend.recovery, env.backend.grid, env.backend.pose
    recovery.monitor.restart(0.01)
    assert not recovery.gone(grid, compose(pose, np.array([0.1, 0.0, 0.03])), env.scan)
    assert recovery.gone(grid, compose(pose, np.array([1.0, 0.3, 0.4])), env.scan)
    recovery.monitor.restart(0.5)
    assert not recovery.gone(grid, compose(pose, np.array([1.0, 0.3, 0.4])), env.scan)


@pytest.mark.parametrize("name", ["invariant-ekf", "fastslam2", "dp-slam"])
def test_where_nothing_is_wrong_nothing_changes(name: str) -> None:
    watched, alone = driven(name, 40), driven(name, 40, settings={"health": {"recover": False}})
    assert watched.backend.recovery.times_lost == 0
    assert np.array_equal(watched.backend.pose, alone.backend.pose)
    assert np.array_equal(watched.backend.pose_cov, alone.backend.pose_cov)
    assert np.array_equal(watched.backend.grid.log_odds, alone.backend.grid.log_odds)


def test_the_landmarks_decide_where_a_found_robot_is() -> None:
    """The robot is correlated with the landmarks again, and as sure as they let it be."""
    env = driven("invariant-ekf", 60)
    backend = env.backend
    before = backend.belief
    backend._relocate(env.truth.pose, np.eye(3) * 1e-6, env.scan)
    after = backend.belief
    assert after.whole_cov is not None and before.whole_cov is not None
    assert np.linalg.eigvalsh(after.whole_cov).min() > -1e-12
    assert np.abs(after.whole_cov[:3, 3:]).max() > 0.1 * np.abs(before.whole_cov[:3, 3:]).max()
    assert np.sqrt(after.pose_cov[0, 0]) < 0.02
    # What the pose was said to be known to, beforehand, has made no landmark surer than it can be.
    assert np.diag(after.whole_cov)[3:].min() > 0.2 * np.diag(before.whole_cov)[3:].min()


@pytest.mark.parametrize(
    ("unsure", "sigma", "found"), [(True, 0.3, True), (True, 0.02, False), (False, 0.02, True)]
)
def test_one_that_was_unsure_before_is_looked_for_where_it_may_be(
    *, unsure: bool, sigma: float, found: bool
) -> None:
    """Columns and rooms are alike; it has hardly been carried away, on top of that."""
    env = driven("invariant-ekf", 60)
    backend = env.backend
    assert isinstance(backend, EkfSlam)
    backend._place(compose(backend.pose, np.array([0.5, 0.3, 0.2])), np.diag(np.square([sigma, sigma, 0.1])))
    backend.recovery.give_up()
    backend.recovery.unsure = unsure
    for _ in range(8):
        env.step(np.zeros(3, np.float32))
    assert (backend.recovery.relocalisations == 1) == found
    assert (np.hypot(*(backend.pose - env.truth.pose)[:2]) < 0.05) == found


def test_where_nothing_is_known_a_lost_robot_goes_on_from_where_the_wheels_have_it() -> None:
    """It comes to where there is no map: nothing speaks against the wheels, and nowhere else is looked for."""
    env = driven("invariant-ekf", 60)
    backend = env.backend
    known, backend.grid = backend.grid, OccupancyGrid(backend.grid.resolution)
    backend.recovery.give_up()
    for k in range(backend.config.relocalisation.unopposed + 1):
        assert backend.recovery.lost == (k < backend.config.relocalisation.unopposed)
        env.step(np.zeros(3, np.float32))
    assert not backend.recovery.lost
    assert (backend.recovery.times_lost, backend.recovery.relocalisations) == (1, 0)
    assert np.hypot(*(backend.pose - env.truth.pose)[:2]) < 0.05
    assert backend.pose_nees(env.truth.pose) < 16.0
    assert known.known_cells > backend.grid.known_cells > 0  # and it draws again


def test_where_hardly_a_beam_returns_a_lost_robot_goes_on_in_the_end() -> None:
    """In a wide hall no scan says where it is, nor that the wheels are wrong: it was lost for good."""
    env = driven("invariant-ekf", 60, settings={"relocalisation": {"silent": 20}})
    backend = env.backend
    few = np.full(360, np.inf)
    few[:20] = 3.0
    backend.recovery.give_up()
    for k in range(21):
        assert backend.recovery.lost == (k < 20)
        backend.update(Scan(few, -math.pi, 2.0 * math.pi / 360, 8.0))


def test_so_few_beams_as_cannot_find_it_again_do_not_give_it_up() -> None:
    assert HealthConfig().fewest_beams >= RelocalisationConfig().fewest_beams


def test_dead_reckoning_is_never_found_anew() -> None:
    env = driven("odometry", 40)
    assert FAULTS["teleport"]().begin(env, np.random.default_rng(0))
    for _ in range(30):
        env.step(np.zeros(3, np.float32))
    assert env.backend.recovery.times_lost == 0
    assert np.hypot(*(env.backend.pose - env.truth.pose)[:2]) > 0.8


def test_a_blind_lidar_is_no_loss() -> None:
    env = driven("invariant-ekf", 40)
    fault = FAULTS["blind"]()
    fault.begin(env, np.random.default_rng(0))
    for _ in range(20):
        env.step(np.array([0.1, 0.0, 0.1], np.float32))
    assert env.backend.health > 0.9
    fault.end(env)
    for _ in range(5):
        env.step(np.zeros(3, np.float32))
    assert env.backend.recovery.times_lost == 0
    assert np.hypot(*(env.backend.pose - env.truth.pose)[:2]) < 0.02


def test_a_large_map_is_searched_more_rarely_and_so_is_one_from_where_nothing_is_new(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    env = driven("ekf", 60)
    seen = env.scan
    nowhere = Scan(np.full_like(seen.ranges, 0.7), seen.angle_min, seen.angle_increment, seen.range_max)
    searched = []
    for places_each, turn in ((10**6, 0.4), (200, 0.4), (10**6, 0.0)):
        count = [0]
        monkeypatch.setattr(Relocaliser, "find", lambda *_, count=count: count.__setitem__(0, count[0] + 1))
        config = RelocalisationConfig(places_each=places_each, radii_m=(math.inf,), scans_each=(), every=(2,))
        recovery = Recovery(HealthConfig(), config, 0.2)
        recovery.give_up()
        for k in range(60):
            believed = env.backend.pose + np.array([0.0, 0.0, k * turn])
            assert recovery.search(env.backend.grid, nowhere, believed, np.eye(3)) is None
        searched.append(count[0])
    places = Relocaliser(config, env.backend.grid, 0.2).places
    assert searched == [30, math.ceil(60 / (2 * (1 + places // 200))), math.ceil(60 / (2 * config.standing))]
    assert searched[1] < 30
