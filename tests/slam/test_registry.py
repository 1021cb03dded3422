"""What holds for every backend that has a name."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import slam
from slam.dead_reckoning import OdometrySlam
from slam.gaussian.settings import EkfConfig
from slam.geometry import compose, exp
from slam.types import Observations, Odometry, Scan
from tests.slam.simulated import circle_twist, observe_landmarks, room_scan

BLIND = ("odometry", "truth")
OBSERVERS = [name for name in slam.names() if slam.make(name).observes_landmarks and name not in BLIND]
TWO = Observations(np.array([[2.0, 0.3], [3.0, -1.0]]), np.tile(np.diag([1e-3, 1e-3]), (2, 1, 1)), np.arange(2))


@pytest.mark.parametrize("name", slam.names())
def test_no_backend_minds_what_a_broken_lidar_says(name: str) -> None:
    """A sixth of the beams are anything, scan after scan: the pose stays where the others have it."""
    rng, backend = np.random.default_rng(0), slam.make(name)
    backend.reset()
    for k in range(30):
        ranges = 2.0 + rng.normal(0.0, 0.01, 360)
        if k > 3:
            broken = rng.integers(0, 360, 60)
            ranges[broken] = rng.choice([-48.0, -math.inf, -1e-300, 0.0, 1e9, 1e300, math.inf, math.nan], 60)
        backend.predict(Odometry((0.0, 0.0, 0.0), 0.1))
        backend.update(Scan(ranges, -math.pi, 2.0 * math.pi / 360, 8.0))
    assert np.hypot(*backend.pose[:2]) < 0.05 and np.all(np.isfinite(backend.pose_cov))


@pytest.mark.parametrize("name", slam.names())
@pytest.mark.parametrize(
    ("wrong", "what"),
    [
        ({"ranges": np.zeros(0)}, r"one at least, got float64 \(0,\)"),
        ({"ranges": np.ones((2, 180))}, r"got float64 \(2, 180\)"),
        ({"ranges": [2.0] * 360}, "got list"),
        ({"range_max": math.inf}, "range_max inf"),
        ({"range_max": math.nan}, "range_max nan"),
        ({"angle_increment": math.nan}, "angle_increment nan"),
        ({"angle_increment": -2.0 * math.pi / 360}, "counter-clockwise"),
        ({"angle_increment": 0.0}, "counter-clockwise"),
        ({"ranges": np.full(360, 2.0, ">f8")}, "give them as float64"),
        ({"ranges": np.full(360, 2.0, np.float16)}, "give them as float64"),
    ],
)
def test_what_is_no_scan_is_refused_in_a_sentence(name: str, wrong: dict[str, Any], what: str) -> None:
    scan = Scan(np.full(360, 2.0), -math.pi, 2.0 * math.pi / 360, 8.0)
    backend = slam.make(name)
    with pytest.raises(ValueError, match=what):
        backend.update(scan._replace(**wrong))
    backend.update(scan)
    assert backend.grid.known_cells > 0
    with pytest.raises(ValueError, match=what):  # as it is after a scan of as many beams that was one
        backend.update(scan._replace(**wrong))


@pytest.mark.parametrize("name", [name for name in slam.names() if name != "truth"])  # which is told the pose
@pytest.mark.parametrize("twist", [(math.nan, 0.0, 0.0), (0.0, math.inf, 0.0), np.array([0.0, 0.0, math.nan])])
def test_odometry_that_is_no_number_changes_nothing(name: str, twist: Any) -> None:
    backend = slam.make(name)
    backend.predict(Odometry((0.2, 0.0, 0.1), 0.1))
    pose, cov = backend.pose, backend.pose_cov
    straight = (0.1, 0.0, 0.0)
    for odometry in (Odometry(twist, 0.1), Odometry(straight, -0.1), Odometry(straight, 0.1, (0.0, math.nan))):
        with pytest.raises(ValueError, match="of an odometry are finite, and no time goes back"):
            backend.predict(odometry)
    assert np.array_equal(backend.pose, pose) and np.array_equal(backend.pose_cov, cov)


@pytest.mark.parametrize("name", ["ekf", "graph-slam"])
@pytest.mark.parametrize("twist", [(0.1, 0.0), (0.1, 0.0, 0.0, 0.0), np.zeros(4), 0.1, np.zeros((3, 1))])
def test_a_twist_that_is_not_three_numbers_is_refused_in_a_sentence(name: str, twist: Any) -> None:
    with pytest.raises(ValueError, match="the twist of an odometry is three numbers vx, vy, ω, got"):
        slam.make(name).predict(Odometry(twist, 0.1))


def test_a_cell_that_is_run_again_registers_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slam.registry, "_BACKENDS", dict(slam.registry._BACKENDS))

    def cell() -> tuple[Any, Any]:
        class MineConfig(EkfConfig): ...

        class Mine(OdometrySlam): ...

        return Mine, MineConfig

    for _ in range(2):
        backend, config = cell()
        slam.register("mine", backend, config)
    assert type(slam.make("mine")) is backend and slam.config_type("mine") is config
    with pytest.raises(ValueError, match="'mine' is registered already; choose another name"):
        slam.register("mine", backend, EkfConfig)


@pytest.mark.parametrize("name", slam.names())
@pytest.mark.parametrize("cov", [np.diag([1.0, 1.0, -1.0]), [[1.0, 0.9, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]])
def test_what_is_no_covariance_is_no_start(name: str, cov: Any) -> None:
    with pytest.raises(ValueError, match="no negative eigenvalue"):
        slam.make(name).reset(pose_cov=np.array(cov))


@pytest.mark.parametrize("name", slam.names())
def test_a_start_may_be_known_exactly(name: str) -> None:
    backend = slam.make(name)
    backend.reset(pose_cov=np.zeros((3, 3)))
    backend.predict(Odometry((0.2, 0.0, 0.1), 0.1))
    assert np.all(np.isfinite(backend.pose_cov))


@pytest.mark.parametrize("name", [name for name in slam.names() if name != "truth"])
def test_a_robot_that_has_moved_before_its_first_scan_is_where_it_moved_to(name: str) -> None:
    backend, true, rng = slam.make(name), np.array([2.0, 2.0, 0.3]), np.random.default_rng(0)
    backend.reset(true)
    twist = circle_twist(0)
    for k in range(25):
        backend.predict(Odometry(twist, 0.1))
        true = compose(true, exp(twist * 0.1))
        if k >= 15:
            backend.update(room_scan(compose(true, np.array([0.2, 0.0, 0.0])), rng))
    assert np.hypot(*(backend.pose - true)[:2]) < 0.03 and backend.pose_nees(true) < 20.0


@pytest.mark.parametrize("name", slam.names())
def test_the_map_takes_no_more_memory_where_it_begins_far_from_the_origin(name: str) -> None:
    shapes, known = [], []
    for start in ((0.0, 0.0, 0.3), (499_999.0, 5_000_001.0, 0.3)):
        backend = slam.make(name)
        backend.reset(start)
        backend.predict(Odometry((0.0, 0.0, 0.0), 0.1))
        backend.update(Scan(np.full(360, 2.0), -math.pi, 2.0 * math.pi / 360, 8.0))
        shapes.append(max(backend.grid.shape))
        known.append(backend.grid.known_cells)
        assert np.hypot(*(backend.pose[:2] - start[:2])) < 0.05
    assert shapes[1] <= 2 * shapes[0] and known[1] == pytest.approx(known[0], rel=0.02)


@pytest.mark.parametrize("name", slam.names())
def test_scans_may_come_in_one_buffer_each_after_the_other(name: str) -> None:
    """What is kept of a scan, to draw it again, is a copy."""
    rng, buffer, pose = np.random.default_rng(0), np.zeros(360), np.zeros(3)
    fresh, reused = slam.make(name), slam.make(name)
    for backend in (fresh, reused):
        backend.reset()
    for k in range(60):
        twist = circle_twist(k)
        pose = compose(pose, exp(twist * 0.1))
        scan = room_scan(pose, rng)
        buffer[:] = scan.ranges
        for backend, ranges in ((fresh, scan.ranges), (reused, buffer)):
            backend.predict(Odometry(tuple(twist), 0.1))
            backend.update(scan._replace(ranges=ranges))
    buffer[:] = 0.3
    for backend in (fresh, reused):
        backend._redraw_kept(backend.key_scans.poses)
    assert np.array_equal(fresh.pose, reused.pose)
    assert np.array_equal(fresh.grid.log_odds, reused.grid.log_odds)


@pytest.mark.parametrize("name", slam.names())
def test_what_drivers_say_instead_is_what_the_standard_says(name: str) -> None:
    """No return is ``inf`` by REP 117, a lost beam ``nan``; some say ``range_max``, 0, or less than they see."""
    rng, pose = np.random.default_rng(0), np.array([2.5, 2.0, 0.0])
    backends = [slam.make(name), slam.make(name)]
    for backend in backends:
        backend.reset()
    for k in range(12):
        twist = circle_twist(k)
        pose = compose(pose, exp(twist * 0.1))
        scan = room_scan(pose, rng)._replace(range_min=0.3, range_max=3.0)
        gone, lost = scan.ranges >= 3.0, rng.random(360) < 0.1
        said = np.where(gone, 3.0, scan.ranges)
        said[lost] = rng.choice([0.0, 0.1, -1.0, 3.5, 65.5], np.count_nonzero(lost))
        meant = np.where(lost, np.nan, np.where(gone, np.inf, scan.ranges))
        for backend, ranges in zip(backends, (said, meant), strict=True):
            backend.predict(Odometry(tuple(twist), 0.1))
            backend.update(scan._replace(ranges=ranges))
    one, other = backends
    assert np.array_equal(one.pose, other.pose) and np.array_equal(one.grid.log_odds, other.grid.log_odds)


@pytest.mark.parametrize("name", ["invariant-ekf", "graph-slam"])
def test_a_lidar_said_to_see_without_end_takes_no_more_memory(name: str) -> None:
    backend = slam.make(name)
    backend.reset()
    backend.update(Scan(np.where(np.arange(360) < 90, np.inf, 3.0), -math.pi, 2.0 * math.pi / 360, 1e30))
    assert backend.grid.known_area_m2 < 1.1 * 0.25 * math.pi * 100.0**2 + 4.0 * math.pi * 9.0


@pytest.mark.parametrize("name", OBSERVERS)
def test_labels_and_what_scans_show_are_kept_apart(name: str) -> None:
    """Labels are numbers of their own, and what has one need not be seen by a lidar."""
    rng, start, backend = np.random.default_rng(0), np.array([1.0, 1.0, 0.0]), slam.make(name)
    backend.reset(start)
    tags, pose = np.array([[2.0, 2.5], [4.0, 1.0], [3.0, 4.5], [5.5, 3.0], [0.5, 4.0]]), start
    for k in range(240):
        twist = np.array([0.25 * math.cos(k / 20), 0.25 * math.sin(k / 20), 0.0])
        pose = compose(pose, exp(twist * 0.1))
        backend.predict(Odometry(tuple(twist + 0.01 * rng.standard_normal(3)), 0.1))
        backend.update(room_scan(compose(pose, np.array([0.2, 0.0, 0.0])), rng))
        tag = (k - 40) // 5  # each is seen for half a second, one after the other
        if 0 <= tag < len(tags):
            seen = observe_landmarks(pose, tags[[tag]], 0.2, np.diag([1e-4, 1e-5]), rng)
            backend.observe(replace(seen, ids=np.array([tag])))
    belief = backend.belief
    assert np.hypot(*(belief.pose - pose)[:2]) < 0.05
    rows = [belief.landmark_ids.tolist().index(backend.label_ids[tag]) for tag in range(len(tags))]
    assert np.abs(belief.landmarks[rows] - tags).max() < 0.2


@pytest.mark.parametrize("name", OBSERVERS)
@pytest.mark.parametrize(
    ("wrong", "what"),
    [
        ({"ids": np.array([0])}, "ids of 2 observations must be as many whole numbers"),
        ({"ids": np.array([0.0, 1.0])}, "as many whole numbers"),
        ({"ids": np.array([0, -1])}, r"must be in \[0, 1000000\], got -1 to 0"),
        ({"ids": np.array([0, 2_000_000_000])}, r"must be in \[0, 1000000\]"),
        ({"range_bearing": np.ones((2, 3))}, r"need range_bearing \(m, 2\) and cov"),
        ({"range_bearing": np.ones(4)}, r"need range_bearing \(m, 2\) and cov"),
        ({"cov": np.tile(np.diag([1e-3, 0.0]), (2, 1, 1))}, "positive definite"),
        ({"cov": np.tile([[1e-3, 2e-3], [2e-3, 1e-3]], (2, 1, 1))}, "positive definite"),
    ],
)
def test_observations_that_are_none_change_nothing(name: str, wrong: dict[str, Any], what: str) -> None:
    backend = slam.make(name)
    backend.reset()
    backend.observe(TWO)
    before = backend.belief
    before.settle()
    with pytest.raises(ValueError, match=what):
        backend.observe(replace(TWO, **wrong))
    after = backend.belief
    assert np.array_equal(after.pose, before.pose) and np.array_equal(after.landmarks, before.landmarks)
    assert np.array_equal(after.landmark_ids, before.landmark_ids)


@pytest.mark.parametrize("name", OBSERVERS)
def test_a_landmark_on_the_sensor_itself_does_no_harm(name: str) -> None:
    backend = slam.make(name)
    backend.reset()
    for _ in range(3):
        backend.observe(Observations(np.array([[0.0, 0.3]]), np.diag([1e-3, 1e-3])[None], np.array([0])))
    assert np.all(np.isfinite(backend.pose)) and np.all(np.isfinite(backend.pose_cov))


@pytest.mark.parametrize("name", OBSERVERS)
def test_sightings_of_known_landmarks_are_counted(name: str) -> None:
    backend = slam.make(name)
    backend.reset()
    for _ in range(4):
        backend.observe(TWO)
    assert backend.landmark_details()[0].tolist() == [4, 4]
