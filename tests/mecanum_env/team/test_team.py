"""A team: one robot is the single environment, each sees the others, nobody maps them."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

import agents
from mecanum_env.config import EnvConfig
from mecanum_env.env import ExploreEnv
from mecanum_env.rooms import FloorPlan
from mecanum_env.rooms.files.importers import from_raster
from mecanum_env.rooms.floor_plan import FloorPlanError
from mecanum_env.team.config import COMMUNICATION, TeamConfig
from mecanum_env.team.team import Team
from slam.geometry import compose, inverse
from slam.grids.occupancy import OCCUPIED

ALL = {"coverage_target": 1.0}


def _hall(width: float = 12.0, height: float = 6.0) -> FloorPlan:
    corners = np.array([(0, 0), (width, 0), (width, height), (0, height)], float)
    walls = np.hstack([corners, np.roll(corners, -1, axis=0)])
    free = np.ones((round(height / 0.05), round(width / 0.05)), bool)
    return FloorPlan(name="hall", walls=walls, free=free, resolution=0.05, start=(2.0, 3.0, 0.0))


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, dict):
        return all(_same(a[key], b[key]) for key in a)
    return a == b if a is None else bool(np.array_equal(a, b, equal_nan=True))


def _drive(team: Team, steps: int, seed: int = 0) -> list[Any]:
    rng = np.random.default_rng(seed)
    history = []
    for _ in range(steps):
        if not team.active:
            break
        history.append(team.step({k: rng.uniform(-1, 1, 3).astype(np.float32) for k in team.active}))
    return history


@pytest.mark.parametrize("slam", ["invariant-ekf", "odometry"])
@pytest.mark.parametrize("rooms", ["apartment", "maze"])
def test_one_robot_is_the_single_environment_bit_for_bit(slam: str, rooms: str) -> None:
    env = gymnasium.make("mecanum_env:mecanum_env/Explore-v0", rooms=rooms, slam=slam, max_episode_steps=60)
    team = Team(1, rooms=rooms, slam=slam, max_steps=60)
    observation, info = env.reset(seed=5)
    ((own, own_info),) = team.reset(seed=5)
    assert env.observation_space == team.members[0].observation_space
    rng = np.random.default_rng(0)
    ended = False
    while not ended:
        assert _same(observation, own)
        assert _same(info, own_info)
        action = rng.uniform(-1, 1, 3).astype(np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        outcome = team.step({0: action})[0]
        own, own_info = outcome.observation, outcome.info
        assert (reward, terminated, truncated) == (outcome.reward, outcome.terminated, outcome.truncated)
        ended = terminated or truncated
    assert info["episode_metrics"] == own_info["episode_metrics"]
    assert not team.active


def test_one_seed_is_one_episode() -> None:
    def go(seed: int) -> list[Any]:
        team = Team(3, rooms="apartment", max_steps=40)
        return [team.reset(seed=seed), *_drive(team, 40)]

    a, b, c = go(3), go(3), go(4)
    assert all(_same(x[0], y[0]) for x, y in zip(a[0], b[0], strict=True))
    for x, y in zip(a[1:], b[1:], strict=True):
        for k in x:
            assert _same(x[k].observation, y[k].observation)
            assert x[k].reward == y[k].reward
            assert _same(x[k].info, y[k].info)
    assert not _same(a[0][0][0], c[0][0][0])


def test_robots_have_noise_of_their_own_and_one_floor() -> None:
    team = Team(2, floor_plan=_hall(), config=ALL, noise="slippery")
    team.reset(seed=0)
    first, second = team.members
    assert first.truth.world.floor is second.truth.world.floor
    scans = np.array([m.scan.ranges for m in team.members])
    exact = [m.lidar.true_ranges(m._surfaces, np.zeros((0, 3)), m.truth.world.pose) for m in team.members]
    both = np.isfinite(scans).all(axis=0)
    a, b = scans[:, both] - np.array(exact)[:, both]
    assert abs(np.corrcoef(a, b)[0, 1]) < 0.3


def test_others_are_seen_and_not_mapped() -> None:
    team = Team(2, floor_plan=_hall(), config=ALL, slam="invariant-ekf")
    starts = np.array([(2.0, 3.0, 0.0), (5.0, 3.0, 1.0)])
    team.reset(seed=0, options={"start_poses": starts})
    for _ in range(20):
        team.step({k: np.zeros(3, np.float32) for k in team.active})
    first, second = team.members
    ahead = len(first.scan.ranges) // 2
    away = 3.0 - first.config.lidar.offset_m
    assert 0.1 < away - first.scan.ranges[ahead] < 0.5  # the side of the other's body
    grid = first.backend.grid
    walls = grid.to_points(np.argwhere(grid.classes() == OCCUPIED)) + starts[0, :2]
    assert np.hypot(*(walls - starts[1, :2]).T).min() > 1.0
    alone = Team(1, floor_plan=_hall(), config=ALL, slam="invariant-ekf")
    alone.reset(seed=0)
    for _ in range(20):
        alone.step({0: np.zeros(3, np.float32)})
    assert first.backend.landmark_count == alone.members[0].backend.landmark_count > 0  # none of the robot
    mate = first.belief.teammates[0]
    assert mate.robot == 1
    expected = compose(inverse(starts[0]), starts[1])
    assert np.allclose(mate.pose[:2], expected[:2], atol=0.1)
    (sighting,) = first.sightings
    assert sighting.robot == 1
    assert abs(sighting.measured[0] - 3.0) < 0.1
    observed = first.observe()["teammates"]
    assert observed.shape == (1, 6)
    assert observed[0, 0] == 1.0
    assert np.hypot(*(observed[0, 1:3] - expected[:2])) < 0.1
    assert second.observation_space.contains(second.observe())


def test_robots_that_could_never_meet_are_refused() -> None:
    free = np.zeros((60, 160), bool)
    free[5:55, 5:75] = free[5:55, 80:155] = True
    plan = from_raster(free, name="two halls", resolution=0.1, start=(3.0, 3.0, 0.0))
    with pytest.raises(ValueError, match="no robot gets from 1 to 0"):
        Team(2).reset(seed=0, options={"floor_plan": plan, "start_poses": [(3.0, 3.0, 0.0), (11.0, 3.0, 0.0)]})


def test_where_frames_are_one_what_a_robot_tells_counts_before_an_older_sighting_of_it() -> None:
    starts = np.array([(2.0, 3.0, 0.2), (5.0, 4.0, 1.0)])
    errors = {}
    for known in (True, False):
        backend = "truth" if known else "invariant-ekf"
        team = Team(2, floor_plan=_hall(), config=ALL, team={"known_starts": known}, slam=backend)
        team.reset(seed=0, options={"start_poses": starts})
        team.step({k: np.zeros(3, np.float32) for k in team.active})
        first, second = team.members
        assert first.sightings
        true = compose(inverse(first.truth.ground.start), compose(second.truth.ground.start, second.truth.pose))
        mate = first.belief.teammates[0]
        assert mate.age_s == pytest.approx(0.0, abs=0.11)
        errors[known] = np.hypot(*(mate.pose - true)[:2])
        if known:  # of a sighting that is newer nothing better is known
            told = first.knowledge.heard[1]
            first.knowledge.heard[1] = told._replace(time_s=told.time_s - 0.1)
            errors["newer"] = np.hypot(*(first.belief.teammates[0].pose - true)[:2])
    assert errors[True] < 1e-6 < 1e-3 < min(errors["newer"], errors[False])
    assert max(errors.values()) < 0.1


def test_a_sighting_s_noise_is_the_declared_one() -> None:
    team = Team(2, floor_plan=_hall(), config=ALL, slam="truth")
    team.reset(seed=0, options={"start_poses": [(2.0, 3.0, 0.2), (5.0, 4.0, 1.0)]})
    found = []
    for _ in range(400):
        team.step({k: np.zeros(3, np.float32) for k in team.active})
        found.append(team.members[0].sightings[0].measured)
    poses = [m.truth.world.pose for m in team.members]
    x, y, turn = compose(inverse(poses[0]), poses[1])
    errors = np.array(found) - (np.hypot(x, y), np.arctan2(y, x), turn)
    sigmas = team.team.sighting.sigmas
    assert np.all(np.abs(errors.mean(axis=0)) < 4 * sigmas / 20)
    assert np.allclose(errors.std(axis=0), sigmas, rtol=0.15)


@pytest.mark.parametrize("known", [True, False])
def test_maps_are_shared_by_those_that_know_their_frames(known: bool) -> None:
    team = Team(2, floor_plan=_hall(), config=ALL, team={"known_starts": known}, slam="invariant-ekf")
    team.reset(seed=0, options={"start_poses": [(2.0, 3.0, 0.0), (9.0, 3.0, 1.0)]})
    for _ in range(15):
        outcomes = team.step({k: np.zeros(3, np.float32) for k in team.active})
    own = [m.backend.grid.known_area_m2 for m in team.members]
    all_known = [m.belief.grid.known_area_m2 for m in team.members]
    assert all(w >= o for w, o in zip(all_known, own, strict=True))
    assert outcomes[0].info["team_coverage"] >= max(o.info["coverage"] for o in outcomes.values())
    if known:
        assert all(w > o + 1.0 for w, o in zip(all_known, own, strict=True))
        a, b = (compose(m.truth.ground.start, m.belief.pose) for m in team.members)
        assert np.allclose(a[:2], (2, 3), atol=0.05)
        assert np.allclose(b[:2], (9, 3), atol=0.05)


@pytest.mark.parametrize(("sigma", "turn"), [(0.0, 0.0), (0.05, 0.01), (0.15, 0.01), (0.05, 0.04)])
def test_frames_are_found_by_maps_and_are_the_true_ones(sigma: float, turn: float) -> None:
    starts = {"known_starts": sigma > 0.0, "start_sigma_m": sigma, "start_sigma_rad": turn}
    team = Team(3, rooms="apartment", team=starts, config=ALL)
    observations = [o for o, _ in team.reset(seed=4)]
    drivers = [agents.make("nearest-frontier") for _ in team.members]
    for driver, member in zip(drivers, team.members, strict=True):
        driver.reset(member.belief)
    for _ in range(250):
        actions = {k: drivers[k].act(observations[k], team.members[k].belief) for k in team.active}
        for k, outcome in team.step(actions).items():
            observations[k] = outcome.observation
    for member in team.members:
        frames = member.knowledge._frames
        assert frames is not None
        assert len(frames.found) == 2
        for other, pose in frames.found.items():
            mate = team.members[other]
            here, there = (compose(m.truth.ground.start, m.truth.pose) for m in (member, mate))
            # Where it believes the other to be, by the other's belief and the frame, against where it is.
            believed = compose(inverse(member.backend.pose), compose(pose, mate.backend.pose))
            true = compose(inverse(here), there)
            assert np.hypot(*(believed - true)[:2]) < 0.05
        assert member.belief.grid.known_area_m2 > member.backend.grid.known_area_m2 + 1.0


def test_frames_need_a_joint_covariance() -> None:
    with pytest.raises(ValueError, match="invariant-ekf"):
        Team(2, team={"known_starts": False}, slam="dp-slam")


def test_what_a_team_covers_is_the_union_whatever_the_frames() -> None:
    shares = []
    for known in (True, False):
        slam = "truth" if known else "invariant-ekf"
        team = Team(2, floor_plan=_hall(), config=ALL, team={"known_starts": known}, slam=slam)
        team.reset(seed=0, options={"start_poses": [(2.0, 3.0, 0.0), (9.0, 3.0, 1.0)]})
        _drive(team, 10)
        shares.append(team.coverage_share)
        union = np.zeros(team.ground.mappable.shape, bool)
        if known:
            for m in team.members:
                union |= team.coverage.layers[m.number]
            assert team.coverage_share == union.sum() / team.ground.mappable_cells
    assert shares[0] == pytest.approx(shares[1], abs=0.02)


def test_starts_believed_to_be_elsewhere_are_within_what_is_said() -> None:
    errors = []
    for seed in range(40):
        team = Team(2, floor_plan=_hall(), config=ALL, team={"start_sigma_m": 0.1, "start_sigma_rad": 0.02})
        team.reset(seed=seed)
        first, second = team.members
        assert np.array_equal(first.backend.pose, np.zeros(3))
        errors.append((second.backend.pose - second.truth.pose) / (0.1, 0.1, 0.02))
    assert 0.7 < np.std(errors) < 1.3


def test_a_robot_that_touches_something_leaves_and_stands_in_the_way() -> None:
    team = Team(2, floor_plan=_hall(), config={"terminate_on_collision": True, "coverage_target": 1.0})
    team.reset(seed=0, options={"start_poses": [(2.0, 3.0, np.pi), (9.0, 3.0, 0.0)]})
    ahead, still = np.array([1, 0, 0], np.float32), np.zeros(3, np.float32)
    for _ in range(40):
        outcomes = team.step({k: (ahead, still)[k] for k in team.active})
        if outcomes[0].terminated:
            break
    assert team.active == [1]
    assert not outcomes[1].terminated
    there = team.members[0].truth.world.pose
    assert set(team.step({1: still})) == {1}
    assert np.allclose(team.members[0].truth.world.pose[:2], there[:2], atol=0.02)


def test_heuristic_agents_share_the_work() -> None:
    def time_of(robots: int) -> float:
        team = Team(robots, rooms="apartment", max_steps=1500)
        observations = [o for o, _ in team.reset(seed=3)]
        drivers = [agents.make("nearest-frontier") for _ in team.members]
        for driver, member in zip(drivers, team.members, strict=True):
            driver.reset(member.belief)
        while team.active:
            actions = {k: drivers[k].act(observations[k], team.members[k].belief) for k in team.active}
            for k, outcome in team.step(actions).items():
                observations[k] = outcome.observation
        assert team.coverage_share >= 0.95
        return team.time_s

    assert time_of(3) < 0.75 * time_of(1)


@pytest.mark.parametrize("model", COMMUNICATION)
def test_whoever_is_heard_is_known(model: str) -> None:
    team = Team(
        3, floor_plan=_hall(), config=ALL, team={"communication": {"model": model, "range_m": 5.0}}, slam="truth"
    )
    team.reset(seed=0, options={"start_poses": [(1.0, 3.0, 0.0), (5.0, 3.0, 0.0), (9.0, 3.0, 0.0)]})
    _drive(team, 2)
    heard = [set(m.knowledge.heard) for m in team.members]
    if model == "none":
        assert heard == [set(), set(), set()]
    else:  # the first and the last hear each other by the one between
        assert heard == [{1, 2}, {0, 2}, {0, 1}]
    assert [m.belief.teammates for m in team.members] or model == "none"


def test_wrong_settings_are_told_in_one_line() -> None:
    for settings, words in (
        ({"robots": 0}, "robots"), ({"robots": 2, "team": {"starts": "here"}}, "together"),
        ({"robots": 2, "team": {"communication": {"model": "shout"}}}, "unlimited"),
        ({"robots": 2, "max_steps": 0}, "max_steps"), ({"robots": 2, "action": "jump"}, "twist"),
        ({"robots": 2, "team": {"communication": {"range_m": -1.0}}}, "range_m"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=words) as error:
            Team(**settings)
        assert "\n" not in str(error.value)
    team = Team(2, floor_plan=_hall(), config=ALL)
    with pytest.raises(ValueError, match="start_poses"):
        team.reset(options={"start_poses": [(2.0, 3.0, 0.0)]})
    with pytest.raises(ValueError, match="reset option"):
        team.reset(options={"where": 1})
    with pytest.raises(FloorPlanError, match="room for"):
        Team(60, floor_plan=_hall(5.0, 5.0)).reset(seed=0)
    with pytest.raises(RuntimeError, match="reset"):
        Team(2, floor_plan=_hall(), config=ALL).step({})
    assert TeamConfig(robots=2).known_starts


def test_members_are_environments_to_whoever_reads_them() -> None:
    team = Team(2, rooms="apartment")
    team.reset(seed=1)
    assert all(isinstance(m, ExploreEnv) for m in team.members)


def test_a_joint_belief_is_one_map_and_all_poses() -> None:
    errors = []
    for seed in range(4):
        starts = {"belief": "joint", "start_sigma_m": 0.1, "start_sigma_rad": 0.05}
        team = Team(3, rooms="apartment", team=starts, config=ALL)
        team.reset(seed=seed)
        assert team.joint is not None
        assert [member.apart for member in team.joint.members] == [False, True, True]
        assert len({id(m.own_coverage) for m in team.members}) == 3
        shares = [m.own_coverage.update(m.backend.grid) for m in team.members]
        assert max(shares) < team.coverage_share <= sum(shares)  # of what any of them has
        _drive(team, 70)
        assert not any(member.apart for member in team.joint.members)
        assert len({id(m.belief.grid) for m in team.members}) == 1
        assert team.coverage_share == team.members[-1].truth.record.coverage[-1]  # who draws last into it
        truth = np.array([m.truth.pose for m in team.members])
        assert np.allclose(team.joint.poses, [m.belief.pose for m in team.members])
        errors.append(np.abs(team.joint.poses - truth)[:, :2].max())
        assert [[mate.robot for mate in m.belief.teammates] for m in team.members] == [[1, 2], [0, 2], [0, 1]]
    # They see the same walls: their starts are soon known better than they were told.
    assert np.median(errors) < 0.02


def test_a_joint_belief_needs_to_hear_all() -> None:
    for settings, words in (
        ({"team": {"belief": "joint", "communication": {"model": "range"}}}, "unlimited"),
        ({"team": {"belief": "joint", "known_starts": False}}, "known_starts"),
        ({"team": {"belief": "joint"}, "slam": "dp-slam"}, "ekf-lines"), ({"team": {"belief": "ours"}}, "joint"),
        ({"team": {"belief": "joint"}, "slam": EnvConfig().slam}, "slam must be left out"),
        ({"team": {"belief": "joint"}, "slam": {"name": EnvConfig().slam}}, "slam must be left out"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            Team(2, **settings)
