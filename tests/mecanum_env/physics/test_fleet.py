"""Several robots in one plan."""

from __future__ import annotations

import numpy as np
import pytest

from mecanum_env import rooms
from mecanum_env.config import NoiseConfig, RobotConfig
from mecanum_env.physics.fleet import Fleet, outlines
from mecanum_env.physics.robot import WheelTargets
from mecanum_env.physics.world import World
from mecanum_env.rooms import FloorPlan
from mecanum_env.rooms.floor_plan import FloorPlanError

ROBOT, NOISE = RobotConfig(), NoiseConfig()
TARGETS = WheelTargets(ROBOT)
AHEAD, ASIDE, STILL = (TARGETS.of_twist(np.array(t)) for t in ((1.0, 0, 0), (0, 1.0, 0), (0, 0, 0)))


def _hall(side: float = 8.0) -> FloorPlan:
    corners = np.array([(0, 0), (side, 0), (side, side), (0, side)], float)
    walls = np.hstack([corners, np.roll(corners, -1, axis=0)])
    free = np.ones((round(side / 0.05),) * 2, bool)
    return FloorPlan(name="hall", walls=walls, free=free, resolution=0.05, start=(2.0, 4.0, 0.0))


def _worlds(plan: FloorPlan, starts: list[tuple[float, float, float]]) -> list[World]:
    return [World(plan.with_start(s), ROBOT, NOISE, np.random.default_rng(k)) for k, s in enumerate(starts)]


def _drive(fleet: Fleet, targets: list[np.ndarray], steps: int) -> None:
    for _ in range(steps):
        fleet.step(targets, 0.1, 0.02)


@pytest.mark.parametrize("seed", range(3))
def test_one_robot_alone_and_one_far_from_others_move_as_its_world_does(seed: int) -> None:
    plan = rooms.make("rectangular", seed=seed)
    rng = np.random.default_rng(seed)
    actions = [TARGETS.of_twist(rng.uniform(-1, 1, 3)).copy() for _ in range(60)]
    alone = World(plan, ROBOT, NOISE, np.random.default_rng(7))
    fleet = Fleet([World(plan, ROBOT, NOISE, np.random.default_rng(7))])
    for action in actions:
        alone.step(action, 0.1, 0.02)
        fleet.step([action], 0.1, 0.02)
    assert np.array_equal(alone.pose, fleet.worlds[0].pose)
    assert np.array_equal(alone.wheel_readings, fleet.worlds[0].wheel_readings)
    hall = _hall(20.0)
    far = Fleet(_worlds(hall, [(4.0, 4.0, 0.0), (16.0, 16.0, 1.0)]))
    alone = World(hall.with_start((4.0, 4.0, 0.0)), ROBOT, NOISE, np.random.default_rng(0))
    for action in actions:
        alone.step(action, 0.1, 0.02)
        far.step([action, action], 0.1, 0.02)
    assert np.array_equal(alone.pose, far.worlds[0].pose)


def test_two_that_are_near_move_as_each_alone_while_they_do_not_touch() -> None:
    """In the shared space the path is the one of the kernels, but for rounding."""
    plan = _hall()
    starts = [(3.0, 4.0, 0.0), (3.0, 5.0, 0.0)]
    fleet = Fleet(_worlds(plan, starts))
    _drive(fleet, [AHEAD, AHEAD], 30)
    alone = _worlds(plan, starts)
    for world in alone:
        for _ in range(30):
            world.step(AHEAD, 0.1, 0.02)
    for world, other in zip(fleet.worlds, alone, strict=True):
        assert np.allclose(world.pose, other.pose, atol=1e-6)
        assert world.collisions == 0


def test_head_on_they_stop_each_other_and_it_counts_once_for_each() -> None:
    fleet = Fleet(_worlds(_hall(), [(2.0, 4.0, 0.0), (5.0, 4.0, np.pi)]))
    _drive(fleet, [AHEAD, AHEAD], 40)
    a, b = fleet.worlds
    gap = abs(a.pose[0] - b.pose[0])
    assert gap == pytest.approx(ROBOT.length_m, abs=0.02)  # no deeper into each other than into a wall
    assert [w.collisions for w in fleet.worlds] == [1, 1]
    assert [w.robot_collisions for w in fleet.worlds] == [1, 1]
    assert a.last_impulse > 1.0
    _drive(fleet, [-AHEAD, -AHEAD], 20)
    assert abs(a.pose[0] - b.pose[0]) > 1.0  # nothing sticks
    assert [w.collisions for w in fleet.worlds] == [1, 1]


def test_one_that_stands_is_pushed_and_momentum_is_not_made() -> None:
    fleet = Fleet(_worlds(_hall(), [(2.0, 4.0, 0.0), (4.0, 4.0, 0.0)]))
    _drive(fleet, [AHEAD, STILL], 25)
    a, b = fleet.worlds
    assert a.robot_collisions == b.robot_collisions == 1
    assert b.pose[0] > 4.01
    assert max(a.twist[0], b.twist[0]) <= ROBOT.max_speed_m_s + 1e-6


def test_a_wall_touched_near_another_robot_is_no_robot_touched() -> None:
    fleet = Fleet(_worlds(_hall(), [(3.0, 7.2, 0.0), (4.5, 7.2, 0.0)]))
    _drive(fleet, [ASIDE, ASIDE], 20)
    assert [w.collisions for w in fleet.worlds] == [1, 1]
    assert [w.robot_collisions for w in fleet.worlds] == [0, 0]
    assert all(w.pose[1] < 8.0 - 0.5 * ROBOT.width_m + 0.01 for w in fleet.worlds)


def test_who_slides_along_a_wall_does_so_whoever_stands_by() -> None:
    """A contact lasts from one control step to the next, in the space of several robots as in one's own."""
    plan, slide = _hall(), TARGETS.of_twist(np.array((0.7, 0.5, 0.1)))
    alone = _worlds(plan, [(2.0, 7.7, 0.0)])[0]
    fleet = Fleet(_worlds(plan, [(2.0, 7.7, 0.0), (3.5, 6.6, 0.0)]))
    for _ in range(25):
        alone.step(slide, 0.1, 0.02)
        fleet.step([slide, STILL], 0.1, 0.02)
        assert fleet.worlds[1].collisions == 0
    assert alone.collisions > 0 and alone.pose[0] > 2.3
    np.testing.assert_allclose(fleet.worlds[0].pose, alone.pose, atol=1e-4)
    np.testing.assert_allclose(fleet.worlds[0].twist, alone.twist, atol=1e-3)


def test_the_same_robots_go_the_same_way() -> None:
    def go() -> list[float]:
        fleet = Fleet(_worlds(_hall(), [(2.0, 4.0, 0.0), (5.0, 4.3, np.pi), (3.5, 2.0, 1.0)]))
        rng = np.random.default_rng(3)
        for _ in range(150):
            twists = rng.uniform((0.0, -0.3, -0.2), (1.0, 0.3, 0.2), (3, 3))
            fleet.step([TARGETS.of_twist(twist).copy() for twist in twists], 0.1, 0.02)
        assert sum(w.collisions for w in fleet.worlds) > 0
        return [v for w in fleet.worlds for v in w.pose]

    assert go() == go()


def test_robots_do_not_start_in_each_other() -> None:
    with pytest.raises(FloorPlanError, match="touches something at its start"):
        Fleet(_worlds(_hall(), [(2.0, 4.0, 0.0), (2.3, 4.0, 0.0)]))


def test_an_outline_is_the_body() -> None:
    (sides,) = outlines(np.array([(1.0, 2.0, np.pi / 2)]), np.array([(0.3, 0.2)]))
    assert np.allclose(np.hypot(*(sides[:, 2:] - sides[:, :2]).T), [0.6, 0.4, 0.6, 0.4])
    assert np.allclose(sides[:, :2].mean(axis=0), [1.0, 2.0])
    assert np.ptp(sides[:, 1]) == pytest.approx(0.6)
