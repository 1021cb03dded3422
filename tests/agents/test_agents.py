"""The suite that every registered agent passes, and what the frontier agent owes beside it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import agents
from agents.base import Agent, Goal
from agents.brisk_tour import BRISK
from agents.ppo_frontier import SHIPPED, load_choice_policy
from mecanum_env.config import LIDAR_PRESETS, ROBOT_PRESETS, LidarConfig, NoiseConfig, RobotConfig
from mecanum_env.env import ExploreEnv
from slam.belief import Belief
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN
from slam.types import Scan
from tests.agents.grids import RESOLUTION, belief_of, body_gap, drive, fill, half_known, room, two_rooms

ROBOT, LIDAR = RobotConfig(), LidarConfig()
NAMES = agents.names()
# These maps stand still: with the usual range their frontiers would count as seen from where the robot stands.
SHORT = {"view_range_m": 0.8}
BLANK = {"scan": np.zeros(360, np.float32), "pose": np.zeros(4, np.float32)}


def is_action(action) -> bool:
    return (
        isinstance(action, np.ndarray)
        and action.shape == (3,)
        and action.dtype == np.float32
        and bool(np.isfinite(action).all())
        and bool((np.abs(action) <= 1.0).all())
    )


def ready(name: str, belief: Belief, seed: int = 0, **kwargs) -> Agent:
    agent = agents.make(name, **kwargs)
    agent.reset(belief, seed)
    return agent


def test_registry():
    assert set(NAMES) >= {"random", "nearest-frontier", "explore-and-return", "tour"}
    with pytest.raises(ValueError, match="nearest-frontier"):
        agents.make("nearest-frontierr")
    with pytest.raises(ValueError, match="switch_m"):
        agents.make("nearest-frontier", config={"swich_m": 1.0})
    with pytest.raises(ValueError, match="youbot"):
        agents.make("random", robot="youbott")
    with pytest.raises(ValueError, match="step_s"):
        agents.make("random", step_s=0.0)
    agent = agents.make("nearest-frontier", config={"control": {"turn_gain": 1.0}, "switch_m": 1})
    assert agent.config.control.turn_gain == 1.0


def test_another_package_adds_an_agent(tmp_path, monkeypatch):
    info = tmp_path / "somebodys_agents-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: somebodys-agents\nVersion: 1.0\n")
    points = "[mecanum_slam.agents]\ntheirs = somebodys_agents:Theirs\nrandom = somebodys_agents:Theirs\n"
    (info / "entry_points.txt").write_text(points)
    (tmp_path / "somebodys_agents.py").write_text(
        "from agents.nearest_frontier import NearestFrontier\n\n\nclass Theirs(NearestFrontier):\n    pass\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    agents._installed.cache_clear()
    try:
        assert set(agents.names()) == {*NAMES, "theirs"}
        assert type(agents.make("theirs")).__name__ == "Theirs"
        assert type(agents.make("random")).__name__ == "RandomAgent"  # ours stay ours
    finally:
        agents._installed.cache_clear()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("preset", ["youbot", "cavity"])
def test_suite_actions(name, preset):
    belief = belief_of(half_known(), (1.5, 2.0, 0.4))
    lidar = LIDAR_PRESETS[preset]
    config = {"frontiers": SHORT} if name not in ("ppo", "random") else None
    if name in ("active", "ppo-frontier", "team-frontier"):
        config = {"driver": config}
    agent = ready(name, belief, robot=preset, lidar=preset, config=config)
    blank = {"scan": np.zeros(lidar.beams, np.float32)}
    for observation in (None, {}, blank, {"scan": np.ones(lidar.beams, np.float32)}):
        for _ in range(3):
            assert is_action(agent.act(observation, belief))
    assert isinstance(agent.goal, Goal)
    assert agent.goal.pose.shape == (3,) and agent.goal.path.shape[1] == 2
    assert agent.frontiers.ndim == 2 and agent.frontiers.shape[1] == 2
    assert isinstance(agent.status, str)
    for name_of in ("goal", "frontiers", "status"):
        with pytest.raises(AttributeError):
            setattr(agent, name_of, None)


@pytest.mark.parametrize("name", NAMES)
def test_suite_determinism_and_reset(name):
    def run(agent: Agent, seed: int) -> np.ndarray:
        pose = np.array([1.5, 2.0, 0.4])
        agent.reset(belief_of(half_known(), tuple(pose)), seed)
        actions = []
        for _ in range(25):
            actions.append(agent.act(BLANK, belief_of(half_known(), tuple(pose))))
            pose = drive(pose, actions[-1], ROBOT)
        return np.array(actions)

    agent = agents.make(name)
    first = run(agent, 3)
    np.testing.assert_array_equal(first, run(agent, 3))
    np.testing.assert_array_equal(first, run(agents.make(name), 3))
    if name == "random":
        assert np.abs(first - run(agent, 4)).max() > 0.1


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=15, deadline=None)
@given(
    classes=arrays(
        np.int8, st.tuples(st.integers(2, 40), st.integers(2, 40)), elements=st.sampled_from([-1, 0, 0, 100])
    ),
    x=st.floats(-1.0, 3.0),
    y=st.floats(-1.0, 3.0),
    theta=st.floats(-3.2, 3.1),
)
def test_suite_any_raster(name, classes, x, y, theta):
    belief = belief_of(classes, (x, y, theta))
    agent = ready(name, belief)
    goal = agent.choose(belief)
    assert goal is None or (np.isfinite(goal.pose).all() and np.isfinite(goal.path).all())
    for _ in range(3):
        assert is_action(agent.act(BLANK, belief))


@pytest.mark.parametrize("name", NAMES)
def test_suite_leaves_the_belief_alone(name):
    belief = belief_of(half_known(), (1.5, 2.0, 0.4))
    before = [a.copy() for a in (belief.pose, belief.pose_cov, belief.grid.log_odds, belief.grid.visited)]
    agent = ready(name, belief)
    for _ in range(5):
        agent.act(BLANK, belief)
    after = (belief.pose, belief.pose_cov, belief.grid.log_odds, belief.grid.visited)
    for a, b in zip(before, after, strict=True):
        np.testing.assert_array_equal(a, b)


def test_random_walk_has_the_spread_and_memory_it_says():
    belief = belief_of(room(4.0, 4.0), (2.0, 2.0, 0.0))
    agent = ready("random", belief, config={"spread": 0.2, "correlation_s": 0.5})
    walk = np.array([agent.act(None, belief) for _ in range(6000)], dtype=np.float64)
    assert walk.std() == pytest.approx(0.2, rel=0.1)
    lag = np.mean(walk[5:] * walk[:-5]) / walk.var()
    assert lag == pytest.approx(math.exp(-1.0), abs=0.06)


# ---- nearest frontier --------------------------------------------------------------------------------------


def test_goes_to_the_frontier():
    belief = belief_of(half_known(), (1.5, 2.0, 0.0))
    agent = ready("nearest-frontier", belief, config={"frontiers": SHORT})
    goal = agent.choose(belief)
    assert goal is not None and agent.status == "driving"
    np.testing.assert_allclose(goal.path[0], belief.pose[:2])
    np.testing.assert_allclose(goal.path[-1], goal.pose[:2])
    assert 2.8 < goal.pose[0] < 3.9  # before the frontier at 4 m, within the view range
    assert abs(goal.pose[2]) < 1.0  # looking across it
    assert agent.act(None, belief)[0] > 0.05


def test_of_two_frontiers_the_nearer_by_travel_and_it_is_kept():
    classes = room(10.0, 4.0)
    fill(classes, 0.0, 0.0, 1.0, 4.0, UNKNOWN)
    fill(classes, 9.0, 0.0, 10.0, 4.0, UNKNOWN)
    agent = agents.make("nearest-frontier", config={"frontiers": SHORT})
    for x, side in ((4.5, -1), (5.5, 1)):
        belief = belief_of(classes, (x, 2.0, 0.0))
        agent.reset(belief)
        assert np.sign(agent.choose(belief).pose[0] - x) == side
    # Half way and a little more towards the other: not worth turning round.
    agent.reset(belief_of(classes, (4.9, 2.0, 0.0)))
    assert agent.choose(belief_of(classes, (4.9, 2.0, 0.0))).pose[0] < 4.9
    assert agent.choose(belief_of(classes, (5.1, 2.0, 0.0))).pose[0] < 4.9
    assert agent.choose(belief_of(classes, (6.5, 2.0, 0.0))).pose[0] > 6.5


def test_nothing_left_to_explore():
    belief = belief_of(room(6.0, 4.0), (2.0, 2.0, 0.0))
    agent = ready("nearest-frontier", belief)
    assert agent.choose(belief) is None
    assert agent.ended and agent.status == "covered"
    np.testing.assert_array_equal(agent.act(BLANK, belief), np.zeros(3, np.float32))
    assert agent.goal is None and len(agent.frontiers) == 0


def test_enclosed_robot_stays():
    classes = np.full((160, 160), FREE, np.int8)  # free all round, its rim a frontier
    fill(classes, 3.0, 3.0, 5.0, 5.0)
    fill(classes, 3.1, 3.1, 4.9, 4.9, FREE)
    belief = belief_of(classes, (4.0, 4.0, 0.0))
    agent = ready("nearest-frontier", belief)
    assert agent.choose(belief) is None
    assert len(agent.frontiers) > 0
    assert agent.ended and agent.status == "unreachable"
    np.testing.assert_array_equal(agent.act(None, belief), np.zeros(3, np.float32))
    assert not agent.ended and agent.status == "looking"  # the first scans may have lost the beams that show a way
    for _ in range(15):
        agent.act(None, belief)
    assert agent.ended
    # One door, and it leaves.
    fill(classes, 4.8, 3.5, 5.1, 4.5, FREE)
    assert ready("nearest-frontier", belief).choose(belief_of(classes, (4.0, 4.0, 0.0))) is not None


@pytest.mark.parametrize("name", ["nearest-frontier", "brisk-tour"])
def test_a_goal_whose_way_opens_and_closes_again_and_again_is_let_be(name: str) -> None:
    classes = np.full((170, 160), OCCUPIED, np.int8)
    fill(classes, 0.5, 0.5, 7.5, 7.5, FREE)
    fill(classes, 1.8, 1.8, 6.2, 6.2, OCCUPIED)  # a ring
    fill(classes, 4.6, 7.5, 5.6, 8.5, UNKNOWN)
    closed = classes.copy()
    fill(closed, 6.2, 4.0, 7.5, 4.2, OCCUPIED)
    seen = belief_of(classes, (5.2, 1.1, 0.0)), belief_of(closed, (5.7, 1.1, 0.0))
    agent = ready(name, seen[0])
    for k in range(900):  # at 0.15 m/s alone it would have 80 s for the way, three times
        agent.act(None, seen[k // 11 % 2])
        if agent.ended:
            break
    assert agent.status == "stuck"


@pytest.mark.parametrize("name", ["nearest-frontier", "brisk-tour", "active", "ppo-frontier"])
def test_a_first_scan_that_lost_many_beams_is_no_reason_to_stop(name: str) -> None:
    env = ExploreEnv(rooms="cave", noise=NoiseConfig(dropout=0.3))
    observation, _ = env.reset(seed=313)
    agent = agents.make(name, lidar=env.config.lidar, step_s=env.config.step_s)
    agent.reset(env.belief, 313)
    for _ in range(60):  # `active` looks for up to five seconds
        observation, *_ = env.step(agent.act(observation, env.belief))
        assert not agent.ended
    assert agent.goal is not None


def test_a_robot_that_sees_a_dead_end_ahead_looks_behind() -> None:
    """What borders on the unknown behind it falls in three where its own body was drawn; each is too small."""
    env = ExploreEnv(
        config={"grid_resolution_m": 0.04}, rooms="corridors",
        robot={"length_m": 0.4191, "width_m": 0.3319, "wheelbase_m": 0.355, "track_m": 0.2374},
        lidar={"beams": 270, "field_of_view_deg": 240.0, "range_max_m": 12.3581, "offset_m": 0.1297},
        noise={"range_sigma_m": 0.0268, "dropout": 0.1},
    )  # fmt: skip
    observation, _ = env.reset(seed=329)
    agent = agents.make(
        "nearest-frontier", robot=env.config.robot, lidar=env.config.lidar, step_s=env.config.step_s
    )
    agent.reset(env.belief, 329)
    for _ in range(60):
        observation, *_ = env.step(agent.act(observation, env.belief))
        assert not agent.ended


@pytest.mark.parametrize(("depth_m", "chosen"), [(4.0, True), (0.3, False)])
def test_a_narrow_opening_far_away_is_gone_to_at_last(depth_m, chosen):
    """0.7 m wide, less the walls' nearness, and 9 m away: too far for a niche, but there may be a room behind."""
    classes = room(16.0, 4.0)
    fill(classes, 11.0, 0.0, 16.0, 4.0)
    fill(classes, 11.0, 1.65, 11.1, 2.35, FREE)
    low, high = (0.5, 3.5) if depth_m > 1.0 else (1.65, 2.35)
    fill(classes, 11.1, low, 11.1 + depth_m, high, UNKNOWN)
    belief = belief_of(classes, (1.5, 2.0, 0.0))
    agent = ready("nearest-frontier", belief)
    goal = agent.choose(belief)
    assert (goal is not None) == chosen
    assert chosen or agent.status == "covered"


def test_a_frontier_that_never_yields_is_let_be():
    """The map stands still whatever is looked at: the agent looks, from nearer, and ends."""
    classes = room(5.0, 4.0)
    fill(classes, 4.5, 1.5, 5.0, 2.5, UNKNOWN)
    pose = np.array([1.0, 2.0, 0.0])
    agent = ready("nearest-frontier", belief_of(classes, tuple(pose)), config={"frontiers": SHORT})
    for _ in range(400):
        belief = belief_of(classes, tuple(pose))
        pose = drive(pose, agent.act(None, belief), ROBOT)
        if agent.goal is None:
            break
    assert agent.goal is None
    assert pose[0] > 2.5  # it did go there


def test_a_goal_out_of_reach_in_fact_is_given_up():
    """Free on the map, but the robot does not move: recover, try again, give up."""
    belief = belief_of(half_known(), (1.5, 2.0, 0.0))
    patience = {"stuck_s": 1.0, "recover_s": 0.5, "attempts": 2}
    agent = ready("nearest-frontier", belief, config={"patience": patience, "frontiers": SHORT})
    seen = set()
    for _ in range(600):
        agent.act(None, belief)
        seen.add(agent.status)
        if agent.goal is None:
            break
    assert seen == {"driving", "recovering", "stuck"}


def cast(classes, pose, lidar: LidarConfig) -> np.ndarray:
    """Ranges (beams,) [m] in a raster, by small steps."""
    origin = pose[:2] + lidar.offset_m * np.array([math.cos(pose[2]), math.sin(pose[2])])
    angles = pose[2] + lidar.angle_min + lidar.angle_increment * np.arange(lidar.beams)
    steps = np.arange(0.0, lidar.range_max_m, 0.01)
    points = origin + steps[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    cells = np.clip(np.floor(points / RESOLUTION).astype(int), 0, np.array(classes.shape)[::-1] - 1)
    hit = classes[cells[..., 1], cells[..., 0]] == OCCUPIED
    return np.where(hit.any(axis=0), steps[hit.argmax(axis=0)], np.inf)


@pytest.mark.parametrize("preset", ["youbot", "cavity"])
def test_explores_two_rooms_without_touching(preset):
    robot, lidar = ROBOT_PRESETS[preset], LIDAR_PRESETS[preset]
    world = two_rooms(0.9)
    world[world == UNKNOWN] = FREE
    world[[0, -1], :] = OCCUPIED
    world[:, [0, -1]] = OCCUPIED
    fill(world, 5.2, 1.0, 6.0, 1.6)
    belief = belief_of(np.zeros((0, 0), np.int8), (1.2, 1.0, 0.3))
    agent = agents.make("nearest-frontier", robot=preset, lidar=preset)
    pose, gaps = belief.pose.copy(), []
    agent.reset(belief)
    for _ in range(1200):
        ranges = cast(world, pose, lidar)
        sensor = pose + np.array([lidar.offset_m * math.cos(pose[2]), lidar.offset_m * math.sin(pose[2]), 0.0])
        belief.grid.mark_visited(pose[0], pose[1], robot.inscribed_radius_m)
        belief.grid.integrate(
            sensor, Scan(ranges, lidar.angle_min, lidar.angle_increment, lidar.range_max_m, lidar.range_min_m)
        )
        belief = Belief(
            pose, belief.pose_cov, belief.landmarks, belief.landmark_cov, belief.landmark_ids, belief.grid
        )
        scan = np.minimum(ranges / lidar.range_max_m, 1.0).astype(np.float32)
        action = agent.act({"scan": scan}, belief)
        if agent.goal is None:
            break
        pose = drive(pose, action, robot)
        gaps.append(body_gap(world, pose, robot))
    free = np.argwhere(world == FREE)
    cells = belief.grid.to_cells(free[:, ::-1] * RESOLUTION + 0.5 * RESOLUTION)
    inside = np.all((cells >= 0) & (cells < belief.grid.shape), axis=1)
    mapped = belief.grid.classes()[tuple(cells[inside].T)] == FREE
    assert mapped.sum() / len(free) >= 0.97
    assert min(gaps) > 0.0


def test_the_policy_over_view_points_is_driven_as_the_tour_that_it_is_compared_with():
    _, driver, _ = load_choice_policy(SHIPPED)
    assert driver.control == BRISK


@pytest.mark.parametrize(
    ("seed", "lidar", "dropout"),
    [
        (1, LidarConfig(beams=90), 0.005),
        (4, LidarConfig(beams=90), 0.005),  # once, for a moment, there is no way out
        (5, LidarConfig(beams=90), 0.005),
        (11, LidarConfig(beams=90), 0.005),  # frontiers that come and go
        (12, LidarConfig(beams=90), 0.005),  # the way to what is left is a gap between beams
        (5, LidarConfig(), 0.3),
    ],
)
def test_a_sensor_that_shows_little_is_no_reason_to_stop(seed: int, lidar: LidarConfig, dropout: float) -> None:
    """Beams 4° apart miss a door, or show a frontier that is gone from elsewhere; lost ones hide the way out."""
    noise = NoiseConfig(dropout=dropout)
    env = ExploreEnv(rooms="corridors", lidar=lidar, noise=noise)
    observation, info = env.reset(seed=seed)
    agent = agents.make("nearest-frontier", lidar=env.config.lidar, step_s=env.config.step_s)
    agent.reset(env.belief, seed)
    ended, steps = False, 0
    while not (ended or agent.ended) and steps < 2000:
        steps += 1
        observation, _, terminated, truncated, info = env.step(agent.act(observation, env.belief))
        ended = terminated or truncated
    assert info["coverage"] >= 0.95
    assert info["collisions"] == 0
