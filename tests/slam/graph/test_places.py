"""Places: scans that the EKF family holds on to where landmarks are few."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator

import numpy as np
import pytest

import slam
from mecanum_env.sensing.raycast import beam_directions, cast_rays
from slam import LINE, Observations, Odometry, Scan
from slam.ekf import EkfSlam
from slam.features.extraction import FeatureConfig, FeatureExtractor
from slam.geometry import compose, exp, inverse, wrap
from slam.graph.places import Places
from slam.landmarks.association import predicted
from slam.landmarks.book import EDGE, FROM_MARK, KIND, MARKS
from slam.types import VIRTUAL

Array = np.ndarray
OFFSET, SIGMA, BEAMS, REACH = 0.2, 0.01, 120, 8.0


def hollow() -> Array:
    """A hollow with walls that wind: nothing straight, no corner."""
    angles = np.linspace(0.0, 2.0 * math.pi, 241)
    radius = 3.0 + 0.5 * np.sin(3.0 * angles) + 0.25 * np.cos(7.0 * angles)
    points = np.column_stack([1.6 * radius * np.cos(angles), radius * np.sin(angles)])
    return np.ascontiguousarray(np.column_stack([points[:-1], points[1:]]))


def corridor(heading: float) -> Array:
    """Two walls along a heading, a metre to the left and to the right of the origin: nothing else."""
    along, left = (
        np.array([math.cos(heading), math.sin(heading)]),
        np.array([-math.sin(heading), math.cos(heading)]),
    )
    return np.array([[*(side * left - 40.0 * along), *(side * left + 40.0 * along)] for side in (-1.0, 1.0)])


def scan_from(
    body: Array, rng: np.random.Generator, walls: Array | None = None, *, beams: int = BEAMS,
    view: float = 2.0 * math.pi,
) -> Scan:  # fmt: skip
    increment, first, out = view / beams, -0.5 * view, np.empty(beams)
    walls = hollow() if walls is None else walls
    x, y, theta = compose(body, np.array([OFFSET, 0.0, 0.0]))
    directions = beam_directions(beams, first, increment)
    cast_rays(walls, np.zeros((0, 3)), x, y, theta, directions, first, increment, REACH, out)
    out += SIGMA * rng.standard_normal(beams)
    return Scan(np.where(out > REACH, np.inf, out), first, increment, REACH)


IDS = np.array([4, 5])  # of the two points of a place


def one_place(scan: Scan, x: Array) -> tuple[Places, Array, Array, Array]:
    """Return places with one at the robot's pose, the rows of its points, the state with them and their marks."""
    extractor, places = FeatureExtractor(FeatureConfig()), Places(OFFSET, SIGMA)
    extractor.extract(scan)
    rows = places.make(4, places.ends(scan, extractor))
    points = []
    for row in rows:
        bearing = x[2] + row[1]
        points += [x[0] + OFFSET * math.cos(x[2]) + row[0] * math.cos(bearing)]
        points += [x[1] + OFFSET * math.sin(x[2]) + row[0] * math.sin(bearing)]
    marks = np.zeros((len(rows), MARKS))
    marks[:, 0], marks[:, FROM_MARK] = VIRTUAL, 4
    return places, rows, np.concatenate([x, points]), marks


def information(rows: Array, state: Array) -> Array:
    """Return what rows of a place's points say of the pose ``(3, 3)``."""
    total, h = np.zeros((3, 3)), np.zeros((2, 5))
    for k, row in enumerate(rows):
        predicted(state, k, VIRTUAL, OFFSET, h)
        r = np.array([[row[2], row[3]], [row[3], row[4]]])
        total += h[:, :3].T @ np.linalg.inv(r) @ h[:, :3]
    return total


def test_a_place_s_points_are_three_metres_ahead_and_behind() -> None:
    pose = np.array([0.4, -0.3, 0.7])
    _, rows, state, _ = one_place(scan_from(pose, np.random.default_rng(0)), pose)
    assert rows.shape == (2, 12) and (rows[:, KIND] == VIRTUAL).all() and (rows[:, EDGE] == 4).all()
    ahead = np.array([math.cos(0.7), math.sin(0.7)])
    np.testing.assert_allclose(state[3:5], pose[:2] + 3.0 * ahead, atol=1e-9)
    np.testing.assert_allclose(state[5:7], pose[:2] - 3.0 * ahead, atol=1e-9)
    covs = [np.array([[row[2], row[3]], [row[3], row[4]]]) for row in rows]
    assert all(np.linalg.eigvalsh(cov).min() > 0.0 for cov in covs)


def test_a_sensor_three_metres_ahead_sees_both_points_from_afar() -> None:
    extractor, places = FeatureExtractor(FeatureConfig()), Places(3.0, SIGMA)
    scan = scan_from(np.zeros(3), np.random.default_rng(0))
    extractor.extract(scan)
    rows = places.make(0, places.ends(scan, extractor))
    assert rows.shape == (2, 12) and np.isfinite(rows).all() and (rows[:, 0] >= 3.0).all()


def test_a_scan_tells_where_the_place_is_as_surely_as_it_says() -> None:
    """Its error, held against twice the covariance that the two points get, and never surer than the truth."""
    nees, errors = [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        here = np.array([rng.uniform(-2.0, 2.0), rng.uniform(-1.0, 1.0), rng.uniform(-3.0, 3.0)])
        places, made, state, marks = one_place(scan_from(here, rng), here)
        there = compose(here, np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(-0.5, 0.5)]))
        believed = there + np.array([0.05, 0.05, 0.02]) * rng.standard_normal(3)
        state[:3] = believed
        scan, extractor = scan_from(there, rng), FeatureExtractor(FeatureConfig())
        extractor.extract(scan)
        seen, away = places.seen(state, marks, IDS, places.ends(scan, extractor))
        assert seen is not None and away < 1.0
        (rows, match), h = seen, np.zeros((2, 5))
        assert match.tolist() == [0, 1]
        for k in range(2):
            truth = np.array(predicted(np.concatenate([there, state[3:]]), k, VIRTUAL, OFFSET, h))
            off = rows[k, :2] - truth
            off[1] = wrap(off[1])
            r = np.array([[rows[k, 2], rows[k, 3]], [rows[k, 3], rows[k, 4]]])
            r += np.array([[made[k, 2], made[k, 3]], [made[k, 3], made[k, 4]]])  # the place errs, too
            nees.append(off @ np.linalg.solve(r, off) / 2.0)
            errors.append(float(np.abs(off[0])))
    assert 0.1 < np.mean(nees) < 1.2
    assert np.median(errors) < 0.01


def test_the_points_say_no_more_than_the_scan() -> None:
    rng = np.random.default_rng(3)
    here = np.array([0.2, 0.1, 0.3])
    places, _, state, marks = one_place(scan_from(here, rng), here)
    extractor, scan = FeatureExtractor(FeatureConfig()), scan_from(here, rng)
    extractor.extract(scan)
    seen, _ = places.seen(state, marks, IDS, places.ends(scan, extractor))
    assert seen is not None
    for part in (seen[0][:1], seen[0][1:]):
        assert np.linalg.matrix_rank(information(part, state), tol=1e-6) == 2
    both = information(seen[0], state)
    assert np.linalg.eigvalsh(both).min() > 0.0, "two points say all three of the pose"


@pytest.mark.parametrize("name", ["ekf-lines", "invariant-ekf"])
def test_a_corridor_does_not_tell_how_far_along_it_one_is(name: str) -> None:
    """Wheels have spun by 0.3 m, as the filter knows. Then the robot stands: no scan says by how much they did."""
    heading, rng = 0.5, np.random.default_rng(6)
    walls, pose, ahead = corridor(heading), np.array([0.0, 0.0, heading]), np.array([math.cos(0.5), math.sin(0.5)])
    backend = slam.make(name, config={"lidar_offset_m": OFFSET})
    assert isinstance(backend, EkfSlam)
    backend.reset(pose)
    for speed in [0.02] * 30 + [0.0] * 100:
        if speed == 0.0 and pose[0] < 0.1:  # 6 cm driven
            pose[:2] += 0.3 * ahead
            backend._p[:2, :2] += np.triu(0.3**2 * np.outer(ahead, ahead))
        backend.predict(Odometry((speed, 0.0, 0.0), 0.1, (0.0, 0.0)))
        pose = compose(pose, exp(np.array([speed * 0.1, 0.0, 0.0])))
        backend.update(scan_from(pose, rng, walls))
    cov, across = backend.pose_cov[:2, :2], np.array([-ahead[1], ahead[0]])
    assert np.count_nonzero(backend._book.marks[:, 0] == VIRTUAL), "it holds on to places"
    assert math.sqrt(ahead @ cov @ ahead) > 0.29
    assert abs(across @ (backend.pose - pose)[:2]) < 0.02 and math.sqrt(across @ cov @ across) < 0.01


def test_a_scan_of_elsewhere_does_not_fit() -> None:
    rng = np.random.default_rng(5)
    places, _, state, marks = one_place(scan_from(np.array([2.0, 0.0, 0.0]), rng), np.zeros(3))
    scan, extractor = scan_from(np.array([-2.5, 0.5, 2.0]), rng), FeatureExtractor(FeatureConfig())
    extractor.extract(scan)
    seen, away = places.seen(state, marks, IDS, places.ends(scan, extractor))
    assert seen is None and away == pytest.approx(0.0, abs=1e-9)


def test_places_are_asked_where_landmarks_are_few_and_made_where_none_is_near() -> None:
    places, around = Places(OFFSET, SIGMA), scan_from(np.zeros(3), np.random.default_rng(0))
    assert [places.due(2, around) for _ in range(12)] == [k in (4, 9) for k in range(12)]
    assert places.needed and not places.due(3, around) and not places.needed
    ahead = scan_from(np.zeros(3), np.random.default_rng(0), view=math.radians(120.0))
    assert [places.due(4, ahead) for _ in range(6)] == [k == 4 for k in range(6)], "all of them to one side"
    assert not places.due(5, ahead)
    assert places.wanted(math.inf, fits=False) and places.wanted(1.1, fits=True)
    assert places.wanted(0.5, fits=False) and not places.wanted(0.5, fits=True)


def test_one_that_looks_ahead_only_is_far_from_a_place_it_has_its_back_to() -> None:
    rng, pose = np.random.default_rng(7), np.array([0.3, 0.2, 0.1])
    places, _, state, marks = one_place(scan_from(pose, rng, view=math.radians(120.0)), pose)
    extractor, scan = FeatureExtractor(FeatureConfig()), scan_from(pose, rng, view=math.radians(120.0))
    extractor.extract(scan)
    places.due(0, scan)
    ends = places.ends(scan, extractor)
    assert places.seen(state, marks, IDS, ends)[0] is not None
    state[2] = wrap(pose[2] + 3.0)
    seen, away = places.seen(state, marks, IDS, ends)
    assert seen is None and away == pytest.approx(2.0, abs=0.01)


def test_a_place_of_which_one_point_is_in_another_region_serves_nobody() -> None:
    rng, pose = np.random.default_rng(7), np.zeros(3)
    places, _, state, marks = one_place(scan_from(pose, rng), pose)
    extractor, scan = FeatureExtractor(FeatureConfig()), scan_from(pose, rng)
    extractor.extract(scan)
    assert places.seen(state[:5], marks[:1], IDS[:1], places.ends(scan, extractor)) == (None, math.inf)
    for _ in range(5):
        places.due(0, scan)
    assert len(places.beside(state[:5], marks[:1], IDS[:1])) == 0
    assert places.beside(state, marks, IDS).tolist() == [0, 1]


def test_the_point_ahead_is_that_with_the_lower_id_whatever_their_rows() -> None:
    """A region's rows are in the order of places that landmarks have left, and so may the two points be."""
    rng, pose = np.random.default_rng(7), np.array([0.3, 0.2, 0.1])
    places, _, state, marks = one_place(scan_from(pose, rng), pose)
    extractor, scan = FeatureExtractor(FeatureConfig()), scan_from(pose, rng)
    extractor.extract(scan)
    ends = places.ends(scan, extractor)
    (seen, match), _ = places.seen(state, marks, IDS, ends)
    swapped = np.concatenate([state[:3], state[5:7], state[3:5]])
    (seen_too, match_too), _ = places.seen(swapped, marks, IDS[::-1], ends)
    assert match.tolist() == [0, 1] and match_too.tolist() == [1, 0]
    np.testing.assert_allclose(seen_too, seen, rtol=1e-2, atol=1e-3)


# ---- in a filter -----------------------------------------------------------------------------------------------


def rounds(seed: int, *, share: float = 0.2, steps: int = 420) -> Iterator[tuple[Odometry, Scan, Array]]:
    """Yield two rounds of the hollow: what wheels claim that are off by a share, the scan and the true pose."""
    rng, pose = np.random.default_rng(seed), np.array([0.0, -1.4, 0.0])
    for k in range(steps):
        angle = 2.0 * math.pi * k / 200.0
        ahead = np.array([2.6 * math.sin(angle), -1.4 * math.cos(angle)])
        back = inverse(pose)
        way = compose(back, np.array([*ahead, 0.0]))[:2]
        twist = np.array([*np.clip(way / 0.1, -0.6, 0.6), 0.4])
        pose = compose(pose, exp(0.1 * twist))
        claimed = twist * (1.0 + share * rng.standard_normal(3))
        yield Odometry(tuple(claimed.tolist()), 0.1), scan_from(pose, rng), pose


@pytest.mark.parametrize("name", ["ekf-lines", "invariant-ekf"])
def test_where_nothing_else_holds_the_pose_places_do(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = {"odometry": {"speed_share": 0.2, "turn_share_rad_m": 0.4}, "lidar_offset_m": OFFSET}
    off: dict[bool, list[float]] = {True: [], False: []}
    nees = []
    for held in (True, False):
        if not held:
            monkeypatch.setattr(Places, "due", lambda *_: False)
        for seed in range(4):
            backend = slam.make(name, config=settings)
            backend.reset((0.0, -1.4, 0.0), seed=seed)
            for k, (odometry, scan, true) in enumerate(rounds(seed)):
                backend.predict(odometry)
                backend.update(scan)
                if k % 10 == 9:
                    off[held].append(float(np.hypot(*(backend.pose - true)[:2])))
                    if held:
                        nees.append(backend.pose_nees(true) / 3.0)
            if held:
                _is_what_it_was_without(backend)
    assert np.sqrt(np.mean(np.square(off[True]))) < 0.75 * np.sqrt(np.mean(np.square(off[False])))
    assert 0.1 < np.mean(nees) < 2.0


def _is_what_it_was_without(backend: slam.Backend) -> None:
    """Virtual points are in the filter, and in nothing that it tells."""
    assert isinstance(backend, EkfSlam)
    marks = backend._marks
    virtual = int(np.count_nonzero(marks[:, 0] == VIRTUAL))
    assert virtual >= 4 and virtual % 2 == 0
    belief = backend.belief
    points, walls = np.count_nonzero(marks[:, 0] < LINE), np.count_nonzero(marks[:, 0] == LINE)
    assert backend.landmark_count == points + walls
    assert belief.landmarks.shape == (points, 2) and belief.lines.shape == (walls, 2)
    assert backend.joint_cov.shape == (3 + 2 * (points + walls),) * 2
    assert len(backend.landmark_details()[0]) == points
    near = np.zeros((32, 6), np.float32)
    backend.near_landmarks(near)
    assert np.count_nonzero(near[:, 5]) == min(points, 32)
    assert np.isin(backend.key_scans._anchor_ids, backend._ids[marks[:, 0] == VIRTUAL]).any(), "scans hang on them"


def test_a_copy_has_places_of_its_own_and_observations_with_labels_are_none_of_them() -> None:
    backend = slam.make("ekf-lines")
    assert isinstance(backend, EkfSlam)
    for k, (odometry, scan, _) in enumerate(rounds(1, steps=60)):
        backend.predict(odometry)
        backend.update(scan)
        if k == 20:
            kept = copy.deepcopy(backend._places)
    assert len(kept._places) <= len(backend._places._places)
    ids = np.flatnonzero(backend._marks[:, 0] == VIRTUAL)
    before = backend._x[: backend._n].copy()
    at = before[3 + 2 * ids[0] : 5 + 2 * ids[0]]
    dx, dy = at - backend.sensor_pose()[:2]
    seen = [[math.hypot(dx, dy), wrap(math.atan2(dy, dx) - before[2])]]
    backend.observe(Observations(np.array(seen), np.array([np.diag([1e-4, 1e-4])])))
    assert np.count_nonzero(backend._marks[:, 0] == VIRTUAL) == len(ids)
    np.testing.assert_allclose(backend.pose, before[:3], atol=1e-9)
