"""The follower's kernels against the same steps in plain NumPy."""

from __future__ import annotations

import math

import numpy as np
import pytest

import agents.explore_and_return as homing
from agents.driving import follow
from agents.driving.control import ControlConfig, PathFollower
from agents.driving.safety import local_map
from agents.ways.planning import resample
from mecanum_env.config import LIDAR_PRESETS, LidarConfig, RobotConfig
from slam.grids.occupancy import OCCUPIED, UNKNOWN
from tests.agents.driving.follow_oracle import PlainFollower, rims_cover
from tests.agents.grids import belief_of, drive, fill, room, two_rooms

ROBOT, LIDAR = RobotConfig(), LidarConfig()
STEPS = 25


class _PlainHomeFollower(PlainFollower, homing._HomeFollower):
    """The plain steps towards the heading of the start."""


def cluttered(rng):
    """A room, or two with a narrow door, with boxes and unknown patches wherever."""
    classes = room(8.0, 4.0) if rng.random() < 0.5 else two_rooms(rng.uniform(0.6, 1.0))
    for kind in [OCCUPIED] * rng.integers(0, 8) + [UNKNOWN] * rng.integers(0, 3):
        x, y = rng.uniform((0.0, 0.0), (7.5, 3.5))
        fill(classes, x, y, x + rng.uniform(0.05, 0.5), y + rng.uniform(0.05, 0.5), kind)
    return classes


def path_from(rng, start):
    """A path of a few corners; now and then the robot's own place alone, or a point of it twice."""
    corners = np.vstack([start, rng.uniform((0.5, 0.5), (7.5, 3.5), (rng.integers(0, 4), 2))])
    path = resample(corners, 0.1) if len(corners) > 1 else corners
    return np.repeat(path, 1 + (rng.random(len(path)) < 0.05), axis=0)


def scan(rng):
    """No scan, or one with all sorts of returns: near, none, lost, nearer than the lidar sees."""
    if rng.random() < 0.3:
        return None
    share = rng.uniform(0.05, 0.5, LIDAR.beams).astype(np.float32)
    share[rng.random(LIDAR.beams) < 0.5] = 1.0
    share[rng.integers(LIDAR.beams, size=3)] = np.nan, 0.0, 0.001
    return {"scan": share}


def assert_alike(follower, plain):
    assert (follower.arrived, follower.blocked, follower._index) == (plain.arrived, plain.blocked, plain._index)
    assert follower.remaining_m == pytest.approx(plain.remaining_m, abs=1e-12)
    np.testing.assert_allclose(follower._velocity, plain._velocity, rtol=0, atol=1e-9)


@pytest.mark.parametrize("seed", range(30))
def test_every_step_is_that_of_the_plain_one(seed):
    rng = np.random.default_rng(seed)
    kinds = [(PathFollower, PlainFollower), (homing._HomeFollower, _PlainHomeFollower)]
    lidar = LIDAR if rng.random() < 0.8 else LIDAR_PRESETS["cavity"]
    config = ControlConfig(any_side=bool(rng.random() < 0.5))
    follower, plain = (kind(config, robot=ROBOT, lidar=lidar, step_s=0.1) for kind in kinds[rng.integers(2)])
    classes, pose = cluttered(rng), np.append(rng.uniform((0.4, 0.4), (7.0, 3.6)), rng.uniform(-3.1, 3.1))
    path, heading = path_from(rng, pose[:2]), rng.uniform(-3.0, 3.0) if rng.random() < 0.5 else None
    for each in (follower, plain):
        each.set_path(path, heading)
    for _ in range(STEPS):
        belief = belief_of(classes, tuple(pose), sigma=rng.choice([0.0, 0.01, 0.1]))
        seen = scan(rng) if lidar is LIDAR else None
        twist = follower.follow(seen, belief)
        np.testing.assert_allclose(twist, plain.follow(seen, belief), rtol=0, atol=1e-9)
        assert_alike(follower, plain)
        pose = drive(pose, twist / np.array([0.8, 0.8, 1.5]), ROBOT)


@pytest.mark.parametrize("seed", range(20))
def test_no_other_heading_kept_gets_to_the_paths_end_sooner(seed):
    rng = np.random.default_rng(seed)
    path = path_from(rng, rng.uniform((0.5, 0.5), (7.5, 3.5)))
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    heading, spot = rng.uniform(-3.0, 3.0), follow._Spot(0, 0.0, arc[-1], 1.0, np.ones(1))
    pieces = min(max(int(arc[-1] / 0.2), 1), 15)
    along = np.array(
        [math.atan2(*follow._step_between(path, arc, 0.2 * k, 0.2 * k + 0.2)[::-1]) for k in range(pieces)]
    )

    def cost(wanted):
        return rims_cover(along, wanted, 0.2) + ROBOT.lever_m * abs(wanted - heading)

    chosen = follow._soonest_heading(heading, path, arc, spot, ROBOT.lever_m)
    if arc[-1] > 0.2:
        assert cost(chosen) <= min(map(cost, heading + np.linspace(-math.pi, math.pi, 2001))) + 1e-9


def test_whichever_side_leads_it_keeps_its_heading_where_turning_does_not_pay():
    straight = ControlConfig(any_side=True)
    for direction in (0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi):
        follower = PathFollower(straight, robot=ROBOT, lidar=LIDAR, step_s=0.1)
        end = np.array([4.0, 4.0]) + 2.0 * np.array([math.cos(direction), math.sin(direction)])
        follower.set_path(resample(np.vstack([(4.0, 4.0), end]), 0.1), None)
        twist = follower.follow(None, belief_of(room(8.0, 8.0), (4.0, 4.0, 0.0)))
        assert twist[2] == pytest.approx(0.0, abs=1e-9)
        assert math.hypot(*twist[:2]) == pytest.approx(0.12)


@pytest.mark.parametrize("seed", range(10))
def test_so_is_a_velocity_driven_without_a_path(seed):
    rng = np.random.default_rng(100 + seed)
    follower, plain = (
        kind(ControlConfig(), robot=ROBOT, lidar=LIDAR, step_s=0.1) for kind in (PathFollower, PlainFollower)
    )
    classes, pose = cluttered(rng), np.append(rng.uniform((0.4, 0.4), (7.0, 3.6)), rng.uniform(-3.1, 3.1))
    for _ in range(STEPS):
        velocity, turn = rng.uniform(-0.6, 0.6, 2) * (rng.random() < 0.9), rng.uniform(-2.0, 2.0)
        belief, seen = belief_of(classes, tuple(pose)), scan(rng)
        twist = follower.drive(velocity, turn, seen, belief)
        np.testing.assert_allclose(twist, plain.drive(velocity, turn, seen, belief), rtol=0, atol=1e-9)
        assert_alike(follower, plain)
        pose = drive(pose, twist / np.array([0.8, 0.8, 1.5]), ROBOT)


def test_a_new_configuration_takes_effect_at_once():
    follower = PathFollower(ControlConfig(), robot=ROBOT, lidar=LIDAR, step_s=0.1)
    follower.set_path(resample(np.array([(1.0, 2.0), (6.0, 2.0)]), 0.1), None)
    belief = belief_of(room(8.0, 4.0), (1.0, 2.0, 0.0))
    assert follower.follow(None, belief)[0] == pytest.approx(0.12)  # m/s: 1.2 m/s² for a step of 0.1 s
    follower.config = ControlConfig(acceleration_m_s2=0.5)
    assert follower.follow(None, belief)[0] == pytest.approx(0.17)


def test_off_the_map_nothing_is_near():
    belief = belief_of(room(4.0, 4.0), (30.0, -20.0, 0.0))
    near = local_map(belief, 2.0)
    assert near.clearance.shape == (1, 1)
    assert math.isfinite(near.at(belief.pose[None, :2])[0])
