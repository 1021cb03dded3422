"""The compressed filter is the full filter, later: state and covariance to rounding, over regions that change."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import agents
import slam
import slam.compressed as compressed_
from mecanum_env.env import ExploreEnv
from slam import Observations, Odometry
from slam.backend import Backend
from slam.compressed import CompressedEkfSlam
from slam.geometry import compose, exp
from slam.invariant import InvariantEkfSlam
from slam.landmarks.book import KIND
from slam.types import VIRTUAL
from tests.slam.simulated import drive, observe_landmarks, room_scan
from training.studies.recovery.faults import FAULTS

OFFSET = 0.2
NOISE = np.diag([1e-3, 1e-4])


def grove(seed: int, count: int = 120) -> np.ndarray:
    """Landmarks along a corridor 40 m long."""
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-4, 36, count), rng.uniform(-3, 3, count)])


def compare(full: slam.Belief, compressed: slam.Belief, *, sigmas: float = 0.0) -> None:
    """The two beliefs agree to 1e-9, or to so many of their own σ's, whatever the order of their landmarks."""
    assert sorted(compressed.landmark_ids) == sorted(full.landmark_ids)
    if not sigmas:
        np.testing.assert_allclose(compressed.pose, full.pose, atol=1e-9)
        np.testing.assert_allclose(compressed.pose_cov, full.pose_cov, atol=1e-9)
    by_id = []
    for belief in (full, compressed):
        order = np.argsort(belief.landmark_ids)
        rows = np.concatenate([np.arange(3), np.column_stack([3 + 2 * order, 4 + 2 * order]).ravel()])
        assert belief.joint_cov is not None
        for i, cov in enumerate(belief.landmark_cov):
            block = belief.joint_cov[3 + 2 * i : 5 + 2 * i, 3 + 2 * i : 5 + 2 * i]
            np.testing.assert_allclose(cov, block, rtol=1e-7, atol=1e-12)
        by_id.append((belief.landmarks[order], belief.landmark_cov[order], belief.joint_cov[np.ix_(rows, rows)]))
    if sigmas:
        (means, _, cov), (same_means, _, same_cov) = by_id
        scale = np.sqrt(np.diag(cov))
        off = np.concatenate([compressed.pose - full.pose, (same_means - means).ravel()])
        assert np.abs(off / scale).max() < sigmas
        assert np.abs((same_cov - cov) / np.outer(scale, scale)).max() < sigmas
        return
    for one, two in zip(*by_id, strict=True):
        np.testing.assert_allclose(two, one, atol=1e-9)


@pytest.mark.parametrize("look_every", [1, 37, 1000])
def test_it_is_the_full_filter(look_every: int) -> None:
    """Down a corridor and back with known ids; the belief, which flushes, is read now and then or at the end."""
    rng = np.random.default_rng(2)
    landmarks = grove(2)
    config = {"odometry": {"speed_share": 0.05, "turn_share_rad_m": 0.05}}
    full, compressed = slam.make("ekf", config=config), slam.make("compressed-ekf", config=config)
    assert isinstance(compressed, CompressedEkfSlam)
    for backend in (full, compressed):
        backend.reset(pose_cov=np.diag([0.01, 0.01, 0.01]))
    pose = np.zeros(3)
    most = 0
    for k in range(240):
        twist = np.array([0.0, 0.0, math.pi / 2]) if 118 < k < 122 else np.array([0.8, 0.0, 0.02 * math.sin(k)])
        pose, odometry = drive(pose, twist, (0.02, 0.02), rng, dt=0.3)
        seen = observe_landmarks(pose, landmarks, OFFSET, NOISE, rng, reach=4.0)
        for backend in (full, compressed):
            backend.predict(odometry)
            backend.observe(seen)
        assert compressed.nis == pytest.approx(full.nis, rel=1e-6)
        np.testing.assert_allclose(compressed.pose, full.pose, atol=1e-9)
        np.testing.assert_allclose(compressed.pose_cov, full.pose_cov, atol=1e-9)
        most = max(most, compressed._book.count)
        if k % look_every == look_every - 1:
            compare(full.belief, compressed.belief)
    compare(full.belief, compressed.belief)
    assert compressed.landmark_count == full.landmark_count > 100
    assert most < 0.6 * full.landmark_count  # it did filter a part only


def through_the_grove(
    landmarks: np.ndarray, backends: tuple[Backend, ...], seed: int, steps: int, turn_at: int | None = None
) -> Iterator[np.ndarray]:
    """Drive straight on, and back where asked for, all told the same; yield the true pose after each step."""
    rng, pose = np.random.default_rng(seed), np.zeros(3)
    for backend in backends:
        backend.reset(pose_cov=np.diag([0.01, 0.01, 0.01]))
    for k in range(steps):
        turning = turn_at is not None and turn_at <= k < turn_at + 3
        twist = np.array([0.0, 0.0, math.pi / 0.9]) if turning else np.array([0.8, 0.0, 0.0])
        pose, odometry = drive(pose, twist, (0.02, 0.02), rng, dt=0.3)
        seen = observe_landmarks(pose, landmarks, OFFSET, NOISE, rng, reach=4.0)
        for backend in backends:
            backend.predict(odometry)
            backend.observe(seen)
        yield pose


def test_a_landmark_from_outside_the_region_is_taken_in() -> None:
    """A known id that was left behind 20 m ago: a loop closed."""
    landmarks = grove(3)
    full, compressed = slam.make("ekf"), slam.make("compressed-ekf")
    *_, pose = through_the_grove(landmarks, (full, compressed), 3, 100)
    assert compressed.landmark_count > compressed._book.count
    first = int(compressed._map_ids[compressed._far[0]])
    d = landmarks[first] - pose[:2] - OFFSET * np.array([math.cos(pose[2]), math.sin(pose[2])])
    far = Observations(
        np.array([[np.hypot(*d), math.atan2(d[1], d[0]) - pose[2]]]), NOISE[None], np.array([first])
    )
    for backend in (full, compressed):
        backend.observe(far)
    compare(full.belief, compressed.belief)


def test_what_is_not_asked_for_has_room_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Virtual points are in the map and in no belief: the newest landmarks may be such (docs/reference/ekf.md)."""
    monkeypatch.setattr(compressed_, "_write_rows", compressed_._write_rows.py_func)  # which looks at bounds
    full, compressed = slam.make("ekf"), slam.make("compressed-ekf")
    *_, _ = through_the_grove(grove(3), (full, compressed), 3, 100)
    assert isinstance(compressed, CompressedEkfSlam) and len(compressed._far)
    point = np.zeros(12)
    point[[0, KIND]], point[[2, 4]] = (2.0, VIRTUAL), 1e-4
    while int(compressed._near.max()) <= len(compressed._map_x) // 2:
        compressed._add(point, None)
    compare(full.belief, compressed.belief)


def test_a_crowded_region_is_smaller() -> None:
    """It has as many landmarks as are a crowd, and is left the sooner."""
    landmarks = grove(5, 240)
    wide = {"leave_share": 1.5, "crowd_share": 0.2}
    full = slam.make("ekf")
    crowds = [slam.make("compressed-ekf", config={**wide, "crowd": crowd}) for crowd in (1000, 90, 10)]
    most, regions = np.zeros(3, int), np.zeros(3, int)
    centres = [(0.0, 0.0)] * 3
    for k, _ in enumerate(through_the_grove(landmarks, (full, *crowds), 5, 200, turn_at=100)):
        for i, backend in enumerate(crowds):
            assert isinstance(backend, CompressedEkfSlam)
            regions[i] += backend._centre != centres[i]
            centres[i] = backend._centre
            if k > 150:  # before that it still grew, by what was new
                most[i] = max(most[i], backend._book.count)
    assert most[0] > most[1] > most[2] and regions[0] < regions[1] < regions[2]
    assert most[1] <= 90
    for backend in crowds:
        compare(full.belief, backend.belief)


LASTING = {
    "odometry": {
        "speed_share": 0.05,
        "turn_share_rad_m": 0.05,
        "lasting": {"radius_sigma": 0.02, "lever_sigma": 0.02},
    }
}
WHOLE, REGIONS = {"whole_up_to": 10**6}, {"whole_up_to": 0, "leave_share": 0.5, "rank_tolerance": 1e-10}


@pytest.mark.parametrize("name", ["ekf", "invariant-ekf"])
def test_the_place_of_a_dropped_landmark_is_taken_again(name: str) -> None:
    """Landmarks are dropped on the way, in both filters, the newest, too; later ones stand where they stood."""
    if name == "ekf":
        full, compressed = slam.make("ekf"), slam.make("compressed-ekf")
    else:
        full, compressed = (slam.make("invariant-ekf", config={**LASTING, **c}) for c in (WHOLE, REGIONS))
    for k, _ in enumerate(through_the_grove(grove(4), (full, compressed), 4, 110)):
        if k % 9 in (4, 8):
            for _ in range(12 if k == 103 else 1):
                row = k % compressed._book.count if k % 9 == 8 else int(np.argmax(compressed._near))
                dropped = int(compressed._book.ids[row])
                for backend in (full, compressed):
                    backend._drop(backend._book.row(dropped))
            compare(full.belief, compressed.belief, sigmas=0.01 if name == "invariant-ekf" else 0.0)
    assert len(np.unique(np.concatenate([compressed._near, compressed._far]))) == compressed.landmark_count
    assert len(compressed._far) > 20


@pytest.mark.parametrize("wheels", [{}, LASTING])
def test_the_invariant_filter_is_the_same_in_regions(wheels: dict[str, Any]) -> None:
    """It moves what is far, and resets its covariance, once a region: to second order that is no difference."""
    whole, regional = (slam.make("invariant-ekf", config={**wheels, **c}) for c in (WHOLE, REGIONS))
    for k, _ in enumerate(through_the_grove(grove(6), (whole, regional), 6, 240, turn_at=120)):
        if k % 60 == 59:
            compare(whole.belief, regional.belief, sigmas=0.01)
    assert regional._book.count < 0.6 * whole._book.count
    if wheels:
        (mean, cov), (same_mean, same_cov) = whole.wheel_errors, regional.wheel_errors
        np.testing.assert_allclose(same_mean, mean, atol=0.01 * np.sqrt(np.diag(cov)).min())
        np.testing.assert_allclose(same_cov, cov, rtol=0.01, atol=1e-8)


@pytest.mark.parametrize("bias", [-0.03, 0.03])
def test_what_is_far_turns_by_its_own_turn(bias: float) -> None:
    """Heading lost on the way out, odometry that turns too far in every step, and a loop closed after 50 m.

    The robot's heading is put right for its odometry's sake all the time; the far map turns once, with the loop.
    """
    odometry = {"speed_share": 0.05, "turn_share_rad_m": 0.1}
    whole, regional = (slam.make("invariant-ekf", config={"odometry": odometry, **c}) for c in (WHOLE, REGIONS))
    landmarks, rng, pose, before = grove(7), np.random.default_rng(7), np.zeros(3), whole.belief
    for k in range(240):
        lost = 10 < k < 45
        twist = np.array([0.0, 0.0, math.pi / 0.9]) if 118 < k < 122 else np.array([0.8, 0.0, 0.0])
        pose = compose(pose, exp(0.3 * twist))
        seen = observe_landmarks(pose, landmarks, OFFSET, NOISE, rng, reach=4.0)
        for backend in (whole, regional):
            if k == 12:
                backend._x[2] += 0.05
                backend._p[2, 2] += 0.035**2
            backend.predict(Odometry(twist + np.array([0.0, 0.0, 0.0 if lost else bias]), 0.3))
            if not lost:
                backend.observe(seen)
        if k == 180:
            before = whole.belief
            before.settle()
    one, two = whole.belief, regional.belief
    assert len(regional._far) > 50
    ids = np.intersect1d(before.landmark_ids, one.landmark_ids)
    shift = one.landmarks[np.isin(one.landmark_ids, ids)] - before.landmarks[np.isin(before.landmark_ids, ids)]
    assert np.hypot(*shift.T).max() > 0.5
    order = np.argsort(two.landmark_ids)
    np.testing.assert_allclose(two.landmarks[order], one.landmarks[np.argsort(one.landmark_ids)], atol=0.03)


@pytest.mark.parametrize("lines", [False, True])
def test_scans_of_rooms_give_the_full_filter_s_map(lines: bool) -> None:
    """A long hall, driven down and back with scans: landmarks come, are left behind and met again."""
    backends = [slam.make(name, config={"lines": lines}) for name in ("ekf", "compressed-ekf")]
    rng = np.random.default_rng(5)
    pose = np.array([1.0, 2.0, 0.1])
    for backend in backends:
        backend.reset(pose)
    for k in range(160):
        twist = np.array([0.7, 0.0, 0.0]) if k < 75 or k > 90 else np.array([0.0, 0.0, 2.0])
        pose, odometry = drive(pose, twist, (0.01, 0.01), rng, dt=0.1)
        sensor = np.array([pose[0] + OFFSET * math.cos(pose[2]), pose[1] + OFFSET * math.sin(pose[2]), pose[2]])
        scan = room_scan(sensor, rng, width=30.0, height=4.0)
        short = slam.Scan(
            np.where(scan.ranges < 2.5, scan.ranges, np.inf), scan.angle_min, scan.angle_increment, 2.5
        )
        for backend in backends:
            backend.predict(odometry)
            backend.update(short)
    one, two = (backend.belief for backend in backends)
    order = np.argsort(two.landmark_ids)
    np.testing.assert_allclose(two.pose, one.pose, atol=1e-9)
    np.testing.assert_allclose(two.landmarks[order], one.landmarks[np.argsort(one.landmark_ids)], atol=1e-9)
    assert len(two.lines) == len(one.lines)
    np.testing.assert_array_equal(two.grid.log_odds, one.grid.log_odds)


@pytest.mark.parametrize("carried_off", [False, True])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_rooms_are_explored_as_by_the_whole_filter_however_unsure_the_start(seed: int, carried_off: bool) -> None:
    """What is off with the pose on entering a region is in all of the rest, and moves walls about their feet.

    The rest is linearised once a region: with a start so unsure that shows, by a hundredth of σ on some seeds.
    """
    unsure = {"name": "invariant-ekf", "start_sigma_m": 0.1, "start_sigma_rad": 0.1}
    slams = [{**unsure, **config} for config in (WHOLE, REGIONS)]
    # Of all coverage: an episode that has ended is summed up at each step.
    config = {"lidar": {"range_max_m": 3.0}, "coverage_target": 1.0}
    whole, regional = (ExploreEnv(slam=each, config=config) for each in slams)
    observation, _ = whole.reset(seed=seed)
    regional.reset(seed=seed)
    agent, far = agents.make("brisk-tour"), 0
    agent.reset(whole.belief, 0)
    for k in range(800):
        if carried_off and k == 250:
            assert all(FAULTS["teleport"]().begin(env, np.random.default_rng(0)) for env in (whole, regional))
        action = agent.act(observation, whole.belief)
        observation, *_ = whole.step(action)
        regional.step(action)
        one, two = whole.backend, regional.backend
        assert isinstance(two, InvariantEkfSlam)
        far = max(far, len(two._far))
        off = (two.pose - one.pose) / np.sqrt(np.diag(one.pose_cov))
        assert np.abs(off).max() < 0.02
    assert far > 30 and one.recovery.relocalisations == two.recovery.relocalisations == int(carried_off)


@pytest.mark.parametrize("name", ["compressed-ekf", "invariant-ekf"])
def test_what_was_kept_of_the_map_stays_what_it_was(name: str) -> None:
    """A doubtful scan: the belief before it is kept, another region is taken, and it comes back."""
    backend = slam.make(name, config=REGIONS if name == "invariant-ekf" else {})
    assert isinstance(backend, CompressedEkfSlam)
    steps = through_the_grove(grove(8), (backend,), 8, 120)
    for _ in range(60):
        next(steps)
    before, regions = backend.belief, backend._centre
    before.settle()
    backend.recovery.kept = backend._copy()
    for _ in range(40):
        next(steps)
    assert backend._centre != regions and backend.landmark_count > len(before.landmarks)
    backend._put_back(backend.recovery.kept)
    after = backend.belief
    assert sorted(after.landmark_ids) == sorted(before.landmark_ids)
    one, two = (np.argsort(belief.landmark_ids) for belief in (before, after))
    np.testing.assert_allclose(after.landmarks[two], before.landmarks[one], atol=1e-9)
    np.testing.assert_allclose(after.landmark_cov[two], before.landmark_cov[one], atol=1e-9)
