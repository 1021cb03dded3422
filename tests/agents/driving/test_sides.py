"""Robots that drive at each other do not touch, whatever each of them wants."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.brisk_tour import BRISK
from agents.driving import sides
from agents.driving.control import PathFollower
from agents.driving.safety import footprint, local_map
from agents.driving.sides import parting_lines
from mecanum_env.config import LidarConfig, RobotConfig
from mecanum_env.team.team import Team
from slam import geometry
from slam.belief import Belief, Teammate
from tests.agents.grids import belief_of, fill, room
from tests.agents.teams.teams import hall, run, touched

ROBOT = RobotConfig()


def among(belief: Belief, *poses: tuple[float, float, float], age_s: float = 0.0, sigma_m: float = 0.0) -> Belief:
    at = [np.array(pose, np.float64) for pose in poses]
    return replace(
        belief, teammates=tuple(Teammate(k + 1, pose, age_s, sigma_m=sigma_m) for k, pose in enumerate(at))
    )


HALF = 0.5 * np.array([ROBOT.length_m, ROBOT.width_m])


def lines(belief: Belief) -> np.ndarray:
    return parting_lines(belief, local_map(belief, 2.0), HALF, gap_m=0.05, speed_m_s=0.8, stop_m=0.4)


def test_the_line_lies_halfway_between_the_bodies_and_turns_with_the_own_one():
    belief = belief_of(room(6.0, 6.0), (3.0, 3.0, 0.5 * math.pi))
    # Nose to side: 0.29 m and 0.19 m of 1 m are the bodies'.
    np.testing.assert_allclose(lines(among(belief, (3.0, 4.0, 0.0))), [[1.0, 0.0, 0.29 + 0.26 - 0.05]], atol=1e-9)
    np.testing.assert_allclose(lines(among(belief, (4.0, 3.0, 0.0))), [[0.0, -1.0, 0.19 + 0.26 - 0.05]], atol=1e-9)
    # What was seen a while ago may have come nearer.
    np.testing.assert_allclose(lines(among(belief, (3.0, 4.0, 0.0), age_s=0.5)), [[1.0, 0.0, 0.3]], atol=1e-9)
    # Known to 10 cm only, it may stand 20 cm nearer.
    np.testing.assert_allclose(lines(among(belief, (3.0, 4.0, 0.0), sigma_m=0.1)), [[1.0, 0.0, 0.4]], atol=1e-9)
    assert lines(belief).shape == lines(among(belief, (3.0, 5.9, 0.0))).shape == (0, 3)


def gap_between(a: np.ndarray, b: np.ndarray, robot: RobotConfig = ROBOT) -> float:
    """How far [m] the corner or side of one body is from the other, negative where they overlap."""
    half = 0.5 * np.array([robot.length_m, robot.width_m])
    least = np.inf
    for first, second in ((a, b), (b, a)):
        rim = geometry.transform_points(geometry.compose(geometry.inverse(first), second), footprint(robot, 0.01))
        out = np.abs(rim) - half
        least = min(least, float(np.where((out > 0).all(axis=1), np.hypot(*out.T), out.max(axis=1)).min()))
    return least


@settings(max_examples=100, deadline=None)
@given(angle=st.floats(-math.pi, math.pi), away=st.floats(0.75, 1.5), turn=st.floats(-math.pi, math.pi))
def test_the_free_way_is_the_distance_between_the_bodies(angle, away, turn):
    x, y = away * math.cos(angle), away * math.sin(angle)
    nx, ny, own, free = sides._parting(HALF, x, y, turn)
    assert math.hypot(nx, ny) == pytest.approx(1.0) and 0.19 <= own <= ROBOT.circumscribed_radius_m + 1e-9
    assert free == pytest.approx(gap_between(np.zeros(3), np.array([x, y, turn])), abs=1e-3)


def test_both_keep_off_one_line_by_the_gap():
    classes = room(6.0, 6.0)
    a, b = (2.5, 3.0, 0.3), (3.4, 3.2, -2.0)
    (first,), (second,) = (lines(among(belief_of(classes, p), q)) for p, q in ((a, b), (b, a)))
    normal = geometry.rotation(a[2]) @ first[:2]
    np.testing.assert_allclose(geometry.rotation(b[2]) @ second[:2], -normal, atol=1e-9)
    apart = normal @ (np.array(b[:2]) - np.array(a[:2]))
    assert first[2] + second[2] == pytest.approx(apart - 2 * 0.05)


def test_a_wall_parts_them_but_not_its_end():
    classes = room(6.0, 6.0)
    fill(classes, 3.0, 0.0, 3.2, 4.0)
    beside = among(belief_of(classes, (2.6, 1.0, 0.0)), (3.6, 1.0, 0.0))
    assert len(lines(beside)) == 0
    round_the_end = among(belief_of(classes, (2.6, 3.8, 0.0)), (3.6, 3.8, 0.0))
    assert len(lines(round_the_end)) == 1


@settings(max_examples=40, deadline=None)
@given(
    away=st.floats(1.3, 3.5),
    angles=st.tuples(*[st.floats(-math.pi, math.pi)] * 3),
    aims=st.tuples(*[st.floats(-0.9, 0.9)] * 2),
    speeds=st.tuples(*[st.floats(0.1, 0.8)] * 2),
)
def test_bodies_that_brake_as_the_check_counts_on_never_touch(away, angles, aims, speeds):
    """By the lines alone, without a scan: what is sent shows a step later, and changes at 1.5 m/s² at most."""
    classes, step_s = room(8.0, 8.0), 0.1
    across, *headings = angles
    offset = 0.5 * away * np.array([math.cos(across), math.sin(across)])
    poses = [np.array([*(4.0 - offset), headings[0]]), np.array([*(4.0 + offset), headings[1]])]
    each = [PathFollower(BRISK, robot=ROBOT, lidar=LidarConfig(), step_s=step_s) for _ in poses]
    velocity, sent = np.zeros((2, 2)), np.zeros((2, 3))
    for _ in range(80):
        twists = []
        for k in range(2):
            towards = poses[1 - k][:2] - poses[k][:2]
            wanted = speeds[k] * geometry.rotation(aims[k]) @ towards / np.hypot(*towards)
            belief = among(belief_of(classes, tuple(poses[k])), tuple(poses[1 - k]))
            twists.append(each[k].drive(wanted, 0.0, None, belief))
        for k in range(2):
            change = geometry.rotation(poses[k][2]) @ sent[k, :2] - velocity[k]
            velocity[k] += change * min(1.0, 0.15 / max(float(np.hypot(*change)), 1e-9))
            poses[k][:2] += step_s * velocity[k]
        sent = np.array(twists)
        assert gap_between(*poses) > 0.0


def test_large_bodies_that_drive_at_each_other_come_to_a_stand_too():
    """Of 2.0 m by 1.6 m, at full speed: each needs 0.7 m to stop. By the lines alone, as above."""
    large = RobotConfig(
        length_m=2.0, width_m=1.6, wheelbase_m=1.6, track_m=1.28, wheel_radius_m=0.1, mass_kg=100.0,
        motor_torque_nm=40.0, motor_gain=40.0, max_speed_m_s=1.2,
    )  # fmt: skip
    classes, step_s = room(12.0, 6.0), 0.1
    poses = [np.array([2.0, 3.0, 0.0]), np.array([10.0, 3.0, math.pi])]
    each = [PathFollower(BRISK, robot=large, lidar=LidarConfig(), step_s=step_s) for _ in poses]
    velocity, sent, fastest = np.zeros(2), np.zeros(2), 0.0  # each along its body
    for _ in range(80):
        beliefs = [among(belief_of(classes, tuple(poses[k])), tuple(poses[1 - k])) for k in range(2)]
        wanted = [(poses[1 - k] - poses[k])[:2] for k in range(2)]
        twists = [each[k].drive(2.0 * wanted[k], 0.0, None, beliefs[k])[0] for k in range(2)]
        velocity += np.clip(sent - velocity, -0.15, 0.15)
        for k in range(2):
            poses[k][0] += step_s * velocity[k] * math.cos(poses[k][2])
        sent, fastest = np.array(twists), max(fastest, float(velocity.max()))
        assert gap_between(*poses, large) > 0.0
    assert fastest > 1.0 and gap_between(*poses, large) < 0.5  # they did drive at each other


def drivers(team: Team) -> list[PathFollower]:
    config = team.config
    return [
        PathFollower(BRISK, robot=config.robot, lidar=config.lidar, step_s=config.step_s) for _ in team.members
    ]


def act(follower: PathFollower, velocity, turn: float, seen, belief: Belief) -> np.ndarray:
    limits = np.array([ROBOT.max_speed_m_s, ROBOT.max_speed_m_s, ROBOT.max_turn_rate_rad_s])
    return np.clip(follower.drive(np.asarray(velocity), turn, seen, belief) / limits, -1.0, 1.0).astype(np.float32)


@pytest.mark.parametrize("model", ["unlimited", "none"])
@pytest.mark.parametrize("height_m", [1.0, 5.0])
@pytest.mark.parametrize(("turns", "headings"), [((0.0, 0.0), (0.0, math.pi)), ((1.0, -1.0), (0.5, 2.0))])
def test_two_that_are_sent_at_each_other_come_to_a_stand(model, height_m, turns, headings):
    if height_m == 1.0:
        turns, headings = (0.0, 0.0), (0.0, math.pi)  # a corridor is too narrow to turn in
    y = 0.5 * height_m
    starts = np.array([[0.6, y, headings[0]], [7.4, y + (0.0 if height_m == 1.0 else 0.2), headings[1]]])
    team = Team(
        robots=2, floor_plan=hall(8.0, height_m, tuple(starts[0])), team={"communication": {"model": model}},
        config={"coverage_target": 1.0},
    )  # fmt: skip
    observed = team.reset(seed=1, options={"start_poses": starts})
    each = drivers(team)

    def towards(k, seen, belief):
        (mate,) = belief.teammates or (None,)
        # In the believed frame the other is straight ahead until it is seen.
        aim = np.array([math.cos(-headings[0]), math.sin(-headings[0])]) * (1.0 if k == 0 else -1.0)
        if mate is not None:
            aim = mate.pose[:2] - belief.pose[:2]
        return act(each[k], 0.8 * aim / max(np.hypot(*aim), 1e-9), turns[k], seen, belief)

    run(team, towards, observed, 120)
    apart = np.hypot(*(team.members[0].truth.world.pose - team.members[1].truth.world.pose)[:2])
    assert touched(team) == 0
    assert apart < 1.1  # they did drive at each other


@pytest.mark.parametrize(("seed", "model"), [(0, "unlimited"), (1, "none")])
def test_five_that_drive_as_they_please_in_a_small_room_never_touch(seed, model):
    starts = np.array([[0.7, 0.7, 0.0], [3.3, 0.7, 1.5], [0.7, 3.3, -1.0], [3.3, 3.3, 3.0], [2.0, 2.0, 0.7]])
    team = Team(
        robots=5, floor_plan=hall(4.0, 4.0, tuple(starts[0])), team={"communication": {"model": model}},
        config={"coverage_target": 1.0},
    )  # fmt: skip
    observed = team.reset(seed=seed, options={"start_poses": starts})
    each, rng, wanted = drivers(team), np.random.default_rng(seed), np.zeros((5, 3))

    def choose(k, seen, belief):
        return act(each[k], wanted[k, :2], float(wanted[k, 2]), seen, belief)

    driven = 0.0
    for _ in range(15):
        wanted[:] = rng.normal(0.0, [0.6, 0.6, 1.0], (5, 3))
        driven += float(np.abs(run(team, choose, observed, 12)).sum())
        observed = [(member.observe(), {}) for member in team.members]
    assert touched(team) == 0
    assert driven > 30.0
