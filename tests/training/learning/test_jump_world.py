"""Rehearsals: never through walls, time and reward that add up, and mirrors that tell the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from agents.learned.choice import CANDIDATE
from mecanum_env import rooms
from mecanum_env.config import RobotConfig
from mecanum_env.rooms.floor_plan import FloorPlan
from slam.geometry import transform_points
from training.learning import jump_world
from training.learning.choice_world import make_rehearsal, make_world, mirrored
from training.learning.config import RehearsalConfig, WorldConfig
from training.learning.jump_world import COVERED, JumpWorld, discounted_s

FAMILIES = ["rectangular", "apartment", "corridors", "cave", "maze"]
WHERE = [CANDIDATE.index(name) for name in ("distance", "ahead", "left", "target_ahead", "target_left")]


GAMMA = 0.9


def play(world: JumpWorld, plan: FloorPlan, seed: int, **options: object) -> list[tuple]:
    """Go through an episode, choosing the nearest and now and then by chance."""
    rng = np.random.default_rng(seed)
    observation, info = world.reset(seed=seed, options={"floor_plan": plan, **options})
    trace = [(observation, 0.0, False, False, info, world._pose.copy())]
    while not (trace[-1][2] or trace[-1][3]):
        k = int(rng.choice(np.flatnonzero(world.action_masks()))) if rng.random() < 0.2 else 0
        trace.append((*world.step(k), world._pose.copy()))
    return trace


@pytest.mark.parametrize("family", FAMILIES)
def test_an_episode_adds_up_and_keeps_off_the_walls(family):
    plan = rooms.make(family, seed=4)
    world = JumpWorld(time_1_s=-0.5)
    trace = play(world, plan, 1)
    infos = [step[4] for step in trace]
    assert sum(info["duration_s"] for info in infos) == pytest.approx(infos[-1]["time_s"])
    covered = [info["coverage"] for info in infos]
    assert min(np.diff(covered)) > -0.01  # an edge may be taken back, no more
    assert infos[-1]["is_success"] and covered[-1] >= COVERED and trace[-1][2]
    assert sum(step[1] for step in trace) == pytest.approx(-0.5 * infos[-1]["time_s"])
    for observation, *_ in trace:
        assert world.observation_space.contains(observation)
    places = transform_points(np.array(plan.start), np.array([step[5][:2] for step in trace]))
    assert plan.distance_to_surfaces(places).min() >= RobotConfig().inscribed_radius_m
    # No faster than it drives.
    ways = np.hypot(*np.diff(places, axis=0).T)
    assert (ways <= 0.7 * np.array([info["duration_s"] for info in infos[1:]]) + 1e-6).all()


def test_an_episode_follows_from_its_seed():
    plan = rooms.make("apartment", seed=7)
    one, other = (play(JumpWorld(), plan, 3) for _ in range(2))
    different = play(JumpWorld(), plan, 4)
    assert not np.array_equal(one[0][5], different[0][5]), "it may begin anywhere"
    assert len(one) == len(other)
    for (a, *rest), (b, *same) in zip(one, other, strict=True):
        assert rest[:3] == same[:3]
        for key, value in a.items():
            np.testing.assert_array_equal(value, b[key])


def test_it_begins_where_a_robot_fits_and_where_it_is_told_to():
    plan = rooms.make("cave", seed=2)
    world = JumpWorld()
    starts = []
    for seed in range(20):
        world.reset(seed=seed, options={"floor_plan": plan})
        starts.append(world._pose.copy())
    places = transform_points(np.array(plan.start), np.array(starts)[:, :2])
    assert plan.distance_to_surfaces(places).min() >= RobotConfig().circumscribed_radius_m - 0.05
    assert len({round(float(start[2]), 6) for start in starts}) == 4
    world.reset(seed=0, options={"floor_plan": plan, "anywhere": False})
    np.testing.assert_array_equal(world._pose, np.zeros(3))


def test_without_a_floor_plan_it_says_what_it_needs():
    with pytest.raises(ValueError, match="floor_plan"):
        JumpWorld().reset()


def test_out_of_time_is_cut_off_with_a_choice_before_it():
    trace = play(JumpWorld(time_limit_s=4.0), rooms.make("apartment", seed=1), 0)
    observation, _, terminated, truncated, info, _ = trace[-1]
    assert truncated and not terminated and not info["is_success"]
    assert info["time_s"] >= 4.0 and observation["present"].any()


def test_the_reward_is_discounted_by_time_within_a_step_as_after_it():
    plan = rooms.make("apartment", seed=4)
    whole, less = (play(JumpWorld(time_1_s=-0.5, gamma=gamma), plan, 1) for gamma in (1.0, GAMMA))
    for (_, alike, *_), (_, reward, _, _, info, _) in list(zip(whole, less, strict=True))[1:]:
        times = np.arange(0.0, info["duration_s"], 1e-4)
        assert reward == pytest.approx(-0.5 * (GAMMA**times).sum() * 1e-4, rel=1e-3)
        assert alike == -0.5 * info["duration_s"]


@pytest.mark.parametrize("gamma", [1.0, GAMMA])
def test_to_give_up_is_worth_as_much_as_to_stay_until_the_limit(monkeypatch, gamma):
    monkeypatch.setattr(jump_world, "COVERED", 1.1)  # which nobody comes to
    trace = play(JumpWorld(time_1_s=-0.5, gamma=gamma), rooms.make("rectangular", seed=4), 1)
    total, weight = 0.0, 1.0
    for _, reward, _, _, info, _ in trace:
        total += weight * reward
        weight *= gamma ** info["duration_s"]
    assert trace[-1][2] and info["time_s"] < 200.0
    assert total == pytest.approx(-0.5 * discounted_s(300.0, gamma))


def test_the_first_choice_is_the_environments():
    """As good as the same: there the scan and the pose are noisy, and one scan was taken instead of two."""
    config = WorldConfig(rooms=("apartment",), driver={"choice": {"uncertainty": False}})
    for seed in range(3):
        options = {"rooms": "apartment", "room_seed": seed}
        there, _ = make_world(config).reset(options=options)
        here, _ = make_rehearsal(config, RehearsalConfig()).reset(options=options | {"anywhere": False})
        matched, of, patches, _ = compared(here, there)
        assert matched >= 0.5 * of and patches < 12.0


def compared(a: dict, b: dict) -> tuple[int, int, float, float]:
    """Return how many candidates of ``a`` are in ``b``, of how many, and how far their patches are apart, 0 … 255.

    The last as they are, and with one of the two flipped.
    """
    of, others = int(a["present"].sum()), int(b["present"].sum())
    rows, there = a["candidates"][:of, WHERE], b["candidates"][:others, WHERE]
    apart = np.abs(rows[:, None] - there[None]).max(axis=-1)
    nearest = apart.argmin(axis=1)
    found = np.flatnonzero(apart.min(axis=1) < 0.1)
    one, other = (a["patches"][found].astype(float), b["patches"][nearest[found]].astype(float))
    return len(found), of, float(np.abs(one - other).mean()), float(np.abs(one - other[:, :, ::-1]).mean())


def reflected(plan: FloorPlan) -> FloorPlan:
    """Return the plan with y for −y."""
    height = plan.free.shape[0] * plan.resolution
    return replace(
        plan, walls=(plan.walls * [1.0, -1.0, 1.0, -1.0])[:, [2, 3, 0, 1]],
        polygons=tuple((p * [1.0, -1.0])[::-1] for p in plan.polygons), circles=plan.circles * [1.0, -1.0, 1.0],
        free=plan.free[::-1], origin=(plan.origin[0], -plan.origin[1] - height),
        start=(plan.start[0], -plan.start[1], -plan.start[2]),
    )  # fmt: skip


@pytest.mark.parametrize("family", FAMILIES)
def test_a_mirrored_choice_is_that_in_the_mirrored_room(family):
    """But for candidates that are cut out of a long frontier at other places."""
    total, candidates = 0, 0
    for seed in range(3):
        plan = rooms.make(family, seed=seed)
        options = [{"floor_plan": p, "anywhere": False} for p in (plan, reflected(plan))]
        seen, other = (JumpWorld().reset(seed=0, options=o)[0] for o in options)
        matched, of, as_they_are, flipped = compared(seen, mirrored(other))
        total, candidates = total + matched, candidates + of
        assert as_they_are < 0.5 * flipped
        twice = mirrored(mirrored(other))
        for key, value in other.items():
            np.testing.assert_array_equal(twice[key], value)
    assert total >= 0.5 * candidates


def test_half_of_the_episodes_are_seen_in_a_mirror_and_those_asked_for_are_not():
    world = make_rehearsal(WorldConfig(rooms=("rectangular",)), RehearsalConfig())
    seen = []
    for k in range(30):
        world.reset(seed=0 if k == 0 else None)
        seen.append(world._mirrored)
    assert 6 < sum(seen) < 24
    world.reset(options={"rooms": "rectangular", "room_seed": 1000})
    assert not world._mirrored


def test_rooms_that_are_asked_for_in_between_are_not_those_that_are_repeated():
    config = WorldConfig(rooms=("rectangular", "cave"), repeats=3)
    drawn, disturbed = (make_rehearsal(config, RehearsalConfig()) for _ in range(2))
    for k in range(4):
        drawn.reset()
        if k != 1:
            disturbed.reset()
            assert disturbed._room == drawn._room
        else:
            disturbed.reset(options={"rooms": "rectangular", "room_seed": 1000})
            assert disturbed._room == ("rectangular", 1000)
