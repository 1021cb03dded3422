"""The active agent: looks first, goes the policy's way, slows down where it loses its place, brakes gently."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import agents
from agents.active import ActiveSlam, _grown
from agents.brisk_tour import BRISK
from agents.driving.control import ControlConfig
from agents.driving.grip import GentleFollower, SlipConfig, WheelWatch
from mecanum_env.config import LidarConfig, RobotConfig
from slam.belief import Belief
from tests.agents.grids import belief_of, drive, half_known, room

ROBOT, LIDAR = RobotConfig(), LidarConfig()
SHORT = {"view_range_m": 0.8}
GO = {"look": {"at_most_s": 0.1, "blind_s": 0.1}}  # hardly any looking before the first drive


def ready(belief: Belief, **config) -> ActiveSlam:
    agent = agents.make("active", config={"driver": {"frontiers": SHORT}} | config)
    assert isinstance(agent, ActiveSlam)
    agent.reset(belief)
    return agent


def marked(belief: Belief, points, *, sigma: float = 0.003) -> Belief:
    """The belief with corners at these points, each known for itself."""
    points = np.array(points, dtype=np.float64).reshape(-1, 2)
    size = 3 + 2 * len(points)
    joint = sigma**2 * np.eye(size)
    joint[:3, :3] = belief.pose_cov
    return replace(
        belief, landmarks=points, landmark_cov=np.tile(sigma**2 * np.eye(2), (len(points), 1, 1)),
        landmark_ids=np.arange(len(points)), joint_cov=joint,
    )  # fmt: skip


def test_it_goes_where_the_policy_says():
    belief = belief_of(half_known(), (1.5, 2.0, 0.0))
    goals = []
    for name in ("active", "ppo-frontier"):
        agent = agents.make(name, config={"driver": {"frontiers": SHORT}})
        agent.reset(belief)
        goals.append(agent.choose(belief))
    np.testing.assert_array_equal(goals[0].path, goals[1].path)


def test_it_looks_before_it_goes_and_the_better_the_landmarks_the_shorter():
    belief = belief_of(half_known(), (1.5, 2.0, 0.4))
    corners = [[0.1, 0.1], [0.1, 3.9], [3.5, 0.1], [3.5, 3.9]]
    stood = []
    for sigma in (0.00001, 0.0005, 0.1):
        now = replace(marked(belief, corners, sigma=sigma), pose_cov=1e-10 * np.eye(3))
        now.joint_cov[:3, :3] = 1e-10 * np.eye(3)
        agent = ready(now)
        steps = 0
        while not agent.act(None, now).any() and steps < 100:
            steps += 1
            assert agent.status == "looking" and agent.goal is not None
        stood.append(0.1 * steps)
    assert stood[0] < stood[1] < stood[2]
    assert stood[0] == pytest.approx(0.5, abs=0.11) and stood[2] == pytest.approx(5.0, abs=0.11)


def test_where_nothing_could_be_a_landmark_it_does_not_wait_for_one():
    belief = belief_of(half_known(), (1.5, 2.0, 0.4))
    agent = ready(belief)
    stood = [not agent.act(None, belief).any() for _ in range(10)]
    assert stood == [True] * 5 + [False] * 5


HALL = half_known(40.0, 4.0, 39.0)


def run_blind(drift: float, *, share: float, grows: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Drive along a hall where the wheels lose a share of each step; return way [m] and variance [m²] by step."""
    pose, variance = np.array([1.5, 2.0, 0.0]), 1e-6
    agent = ready(belief_of(HALL, (1.5, 2.0, 0.0)), drift={"rate_m_rt_s": drift}, **GO)
    ways, variances = [], []
    for _ in range(150):
        cov = np.diag([variance if grows else 1e-6, 1e-6, 1e-8])
        action = agent.act(None, replace(belief_of(HALL, tuple(pose)), pose_cov=cov))
        after = drive(pose, action, ROBOT)
        ways.append(float(np.hypot(*(after - pose)[:2])))
        variance += (share * ways[-1]) ** 2
        variances.append(variance)
        pose = after
    return np.array(ways), np.array(variances)


@pytest.mark.parametrize("rate", [0.0015, 0.0025])
def test_where_it_loses_its_place_it_loses_no_more_than_it_may(rate):
    ways, variances = run_blind(rate, share=0.035)
    assert (variances[-1] - variances[50]) / 10.0 == pytest.approx(rate**2, rel=0.1)
    assert ways[50:].mean() / 0.1 == pytest.approx(rate / (0.035 * np.sqrt(0.1)), rel=0.05)


def test_where_it_keeps_its_place_or_the_wheels_hold_it_loses_no_time():
    for case in ({"share": 0.035, "grows": False}, {"share": 0.005}):
        usual, _ = run_blind(1.0, **case)
        np.testing.assert_array_equal(run_blind(0.0017, **case)[0], usual)


def test_an_unsure_heading_makes_it_no_slower():
    pose, cov = np.array([1.5, 2.0, 0.0]), np.diag([1e-4, 1e-4, 1e-4])
    agent, usual = (ready(belief_of(HALL, (1.5, 2.0, 0.0)), drift={"rate_m_rt_s": r}, **GO) for r in (0.0017, 1.0))
    for _ in range(80):
        belief = replace(belief_of(HALL, tuple(pose)), pose_cov=cov)
        action = agent.act(None, belief)
        np.testing.assert_array_equal(action, usual.act(None, belief))
        after = drive(pose, action, ROBOT)
        carried = np.eye(3)
        carried[:2, 2] = pose[1] - after[1], after[0] - pose[0]
        pose, cov = after, carried @ cov @ carried.T
    assert cov[1, 1] > 30 * 1e-4  # across the hall, by the heading alone


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_what_a_way_adds_is_told_from_what_the_heading_makes_of_it(seed):
    rng = np.random.default_rng(seed)
    root, added = rng.normal(size=(3, 3)), rng.uniform(0.0, 0.1)
    before, now = rng.normal(size=3), rng.normal(size=3)
    carried = np.eye(3)
    carried[:2, 2] = before[1] - now[1], now[0] - before[0]  # of (x, y) by θ: a quarter turn of the way
    cov = root @ root.T
    after = carried @ cov @ carried.T + np.diag([added, added, 0.0])
    assert _grown(before, cov, now, after) == pytest.approx(added, abs=1e-9 * np.abs(after).max())


def test_it_never_creeps():
    ways, _ = run_blind(1e-5, share=0.035)
    assert ways[50:].min() / 0.1 == pytest.approx(0.1, rel=0.05)


def test_it_rolls_out_when_all_is_explored():
    """Wheels that stop at once slide on: speed is shed as on the way."""
    half, done = belief_of(half_known(), (1.5, 2.0, 0.0)), belief_of(room(8.0, 4.0), (1.5, 2.0, 0.0))
    agent = ready(half, **GO)
    for _ in range(12):
        action = agent.act(None, half)
    speeds = [float(np.hypot(*action[:2])) * ROBOT.max_speed_m_s]
    assert speeds[0] > 0.3
    agent._chosen_at = -np.inf
    for _ in range(12):
        speeds.append(float(np.hypot(*agent.act(None, done)[:2])) * ROBOT.max_speed_m_s)
    assert agent.goal is None and agent.status == "covered"
    assert speeds[-1] == 0.0 and np.diff(speeds).min() > -2.05 * 0.1


def test_lost_on_its_way_it_keeps_the_way():
    half = belief_of(half_known(), (1.5, 2.0, 0.0))
    agent = ready(half, **GO)
    for _ in range(12):
        agent.act(None, half)
    path = agent._follower._path.copy()
    assert len(path) > 1
    for _ in range(10):
        assert not agent.act(None, replace(half, health=0.0)).any()
    np.testing.assert_array_equal(agent._follower._path, path)
    assert agent._follower.speed_m_s == 0.0


def test_lost_with_nothing_to_go_to_it_creeps():
    done = belief_of(room(8.0, 4.0), (1.5, 2.0, 0.0))
    agent = ready(done, **GO)
    scan = {"scan": np.full(LIDAR.beams, 0.5, np.float32)}
    for _ in range(5):
        agent.act(scan, done)
    assert agent.goal is None
    sent = [agent.act(scan, replace(done, health=0.0)) for _ in range(40)]
    assert agent.status == "lost" and np.any(sent[-1] != 0.0)


def test_the_slowest_that_may_be_asked_for_is_the_least_share_of_the_top_speed():
    agent = ready(belief_of(half_known(), (1.5, 2.0, 0.0)), drift={"slowest_m_s": 0.001, "rate_m_rt_s": 1e-6})
    for k in range(40):
        agent._lately.append((np.array([0.01 * k, 0.0, 0.0]), 1e-4 * (k + 1) * np.eye(3)))
    assert agent._control().speed_share == 0.01


def test_wheels_that_slip_are_found_out_and_driven_gently():
    rng = np.random.default_rng(1)
    limits = np.array([ROBOT.max_speed_m_s, ROBOT.max_speed_m_s, ROBOT.max_turn_rate_rad_s])
    for share in (0.01, 0.06):
        watch = WheelWatch(ROBOT, step_s=0.1, share=0.01)
        pose, belief = np.array([1.5, 2.0, 0.0]), belief_of(half_known(), (1.5, 2.0, 0.0))
        for k in range(1500):
            action = np.array([0.5, 0.1 * (-1) ** k, 0.3], np.float32)
            pose = drive(pose, action, ROBOT)
            wheels = np.linalg.norm(action * limits * [1, 1, ROBOT.lever_m])
            noise = share * wheels * rng.standard_normal(3) / np.array([1.0, 1.0, ROBOT.lever_m])
            watch.look({"twist": (action * limits + noise) / limits}, replace(belief, pose=pose))
        assert watch.share == pytest.approx(share, rel=0.2)
    watch.look(None, belief)
    watch.look({}, belief)


def test_it_drives_gently_where_its_wheels_have_told_of_slip():
    def driven(noise: str, **slip: float) -> tuple[float, float]:
        env = gymnasium.make("mecanum_env:mecanum_env/Explore-v0", rooms="apartment", noise=noise).unwrapped
        observation, _ = env.reset(seed=1)
        agent = ready(env.belief, **GO, slip=slip)
        for _ in range(200):
            observation = env.step(agent.act(observation, env.belief))[0]
        control = agent._follower.config
        return control.acceleration_m_s2, control.lateral_m_s2

    brisk = BRISK.acceleration_m_s2, BRISK.lateral_m_s2
    assert driven("nominal") == brisk
    assert driven("slippery", acceleration_m_s2=1.0, lateral_m_s2=0.7) == pytest.approx((1.0, 0.7))
    assert driven("slippery", acceleration_m_s2=9.0, lateral_m_s2=9.0) == brisk  # gentle never is rougher
    with pytest.raises(ValueError, match=r"slip: SlipConfig\.firm_share 0.03 must be below slippery_share 0.02"):
        agents.make("active", config={"slip": {"firm_share": 0.03}})


def test_a_gentle_follower_keeps_to_its_acceleration():
    follower = GentleFollower(ControlConfig(), robot=ROBOT, lidar=LIDAR, step_s=0.1)
    belief = belief_of(room(20.0, 8.0), (4.0, 4.0, 0.0))
    for share, limit in ((0.01, 1.2), (0.016, 0.85), (0.03, 0.5)):
        follower.stand()
        follower.config = SlipConfig(acceleration_m_s2=0.5).eased(ControlConfig(), share)
        speeds = [follower.drive(np.array([0.7, 0.0]), 0.0, None, belief)[0] for _ in range(20)]
        assert max(np.diff(speeds)) == pytest.approx(0.1 * limit, rel=1e-6)


@settings(max_examples=15, deadline=None)
@given(
    classes=arrays(
        np.int8, st.tuples(st.integers(2, 40), st.integers(2, 40)), elements=st.sampled_from([-1, 0, 0, 100])
    ),
    points=st.lists(st.tuples(st.floats(-2.0, 4.0), st.floats(-2.0, 4.0)), max_size=6),
    x=st.floats(-1.0, 3.0),
    y=st.floats(-1.0, 3.0),
    joint=st.booleans(),
)
def test_any_raster_and_any_landmarks(classes, points, x, y, joint):
    belief = marked(belief_of(classes, (x, y, 0.3)), points)
    belief = belief if joint else replace(belief, joint_cov=None)
    agent = ready(belief, **GO)
    goal = agent.choose(belief)
    assert goal is None or np.isfinite(goal.path).all()
    for _ in range(4):
        action = agent.act(None, belief)
        assert action.shape == (3,) and np.isfinite(action).all()
