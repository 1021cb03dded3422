"""The part ``steps`` in short, and that it finds what is wrong."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

import agents
import slam
from mecanum_env.env import ExploreEnv
from training.studies.reliability.steps import team
from training.studies.reliability.steps.items import NOISES, ROOMS, TEAMS, Item, items
from training.studies.reliability.steps.nonsense import no_actions, refuse
from training.studies.reliability.steps.part import STEPS
from training.studies.reliability.steps.quick import QuickSpace, surely_covariance
from training.studies.reliability.steps.runs import run, work
from training.studies.reliability.steps.watch import Findings, Watch, _check_cov

ITEMS = items(1000, 0)


@pytest.mark.parametrize("item", ITEMS[::4], ids=lambda item: f"{item.kind}-{item.slam}-{item.driver}")
def test_items_in_short(item: Item) -> None:
    row = work(item)
    assert row["wrong"] == {} and row["steps"] >= item.steps > 0


def test_every_value_of_every_factor_is_drawn_and_more_steps_are_more_of_the_same() -> None:
    drawn = items(250_000, 3)
    assert sum(item.steps for item in drawn) == 250_000
    many = items(1_500_000, 3)
    assert many[: len(drawn) - 1] == drawn[:-1]
    assert {item.driver for item in many} >= set(agents.names())
    assert {item.rooms for item in many} == set(ROOMS) and {item.slam for item in many} == set(slam.names())
    assert {item.noise for item in many} == set(NOISES) and {item.team for item in many} == {*TEAMS, "-"}
    assert len({item.seed for item in many}) == len(many) and min(item.seed for item in many) >= 10_000
    assert sum(item.again for item in many) == len(range(5, len(many), 20))


def test_items_have_fewer_steps_where_one_is_dear() -> None:
    singles = [item for item in items(3_000_000, 0) if item.kind == "single"]
    dear = [item.steps for item in singles if item.driver == "next-best-view"]
    easy = ("ekf", "flip", 3000)
    cheap = [item.steps for item in singles if (item.slam, item.driver, item.limit) == easy]
    assert 20 <= max(dear) < 1000 < 4000 < min(cheap)


def test_every_kind_of_nonsense_comes_to_a_team(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def refuse(step: Any, nonsense: Any, k: int, found: Findings) -> None:
        seen.append(k % len(nonsense))

    monkeypatch.setattr(team, "refuse", refuse)
    run(Item("team", "rectangular", "odometry", "nominal", "youbot", "nonsense", "silent", 3000, 10_000, 180))
    assert set(seen) == set(range(len(no_actions(3))))


def test_other_seeds_give_other_digests_and_the_same_gives_the_same() -> None:
    item = next(item for item in ITEMS if item.kind == "single" and item.driver == "uniform")
    first = run(item).digest
    assert run(item).digest == first != run(item._replace(seed=item.seed + 1)).digest


def test_a_sample_is_repeated_in_another_process() -> None:
    item = next(item for item in ITEMS if item.kind == "single")
    row = STEPS.work(tuple(item._replace(again=1, steps=10)))
    assert row["elsewhere"] == row["digest"] and row["wrong"] == {}
    found = STEPS.sum_up({tuple(item): row | {"wrong": {"a wall was passed": "step 3"}}})
    assert found["tried"] == 10 and "a wall was passed: step 3" in found["failures"][0]
    assert found["factors"]["slam"] == {item.slam: {"steps": 10, "wrong": 1}}


@pytest.fixture
def watched() -> tuple[ExploreEnv, Findings, Callable[[Any], tuple[Any, float, dict[str, Any]]], Watch]:
    made = gymnasium.make("mecanum_env/Explore-v0", rooms="rectangular", slam="truth")
    env: Any = made.unwrapped
    observation, info = made.reset(seed=0)
    found = Findings()
    watch = Watch(env, found, env.observation_space)
    watch.first(observation, info)

    def step(action: Any) -> tuple[Any, float, dict[str, Any]]:
        observation, reward, _, _, info = env.step(np.array(action, np.float32))
        return observation, reward, info

    return env, found, step, watch


def test_what_is_seen_and_paid_is_judged(watched: Any) -> None:
    _, found, step, watch = watched
    observation, _, info = step([0, 0, 0])
    watch.step(observation | {"scan": observation["scan"] + np.float32(2)}, math.nan, info)
    assert set(found.wrong) == {"an observation is not in its space", "reward or info is not finite"}
    assert "scan float32" in found.wrong["an observation is not in its space"]


def test_a_contact_is_counted_or_missed(watched: Any) -> None:
    _, found, step, watch = watched
    for _ in range(200):
        observation, reward, info = step([1, 0, 0])
        watch.step(observation, reward, info)
    assert found.collisions == 1 and 0.0 < found.deepest_m < 0.01 and found.wrong == {}


def test_a_contact_that_is_not_counted_is_found(watched: Any) -> None:
    _, found, step, watch = watched
    for _ in range(200):
        observation, reward, info = step([1, 0, 0])
        watch.step(observation, reward, info | {"collisions": 0})
    assert set(found.wrong) == {"a contact was not counted"}


def test_a_contact_with_nothing_is_found(watched: Any) -> None:
    _, found, step, watch = watched
    observation, reward, info = step([0, 0, 0])
    watch.step(observation, reward, info | {"collisions": 1})
    assert set(found.wrong) == {"a contact with nothing"}


def test_a_wall_that_is_passed_is_found(watched: Any) -> None:
    env, found, step, watch = watched
    x0, y0, x1, y1 = env.truth.plan.bounds
    state = env.truth.world._work
    state[:2] = x1 + 1.0, y1 + 1.0
    watch.step(*step([0, 0, 0]))
    state[:2] = x0, 0.5 * (y0 + y1)
    watch.step(*step([0, 0, 0]))
    assert {"a wall was passed", "a surface is deep in the body"} <= set(found.wrong)


def test_what_is_quickly_told_to_be_seen_as_it_should_be_is_so(watched: Any) -> None:
    env, _, step, _ = watched
    space, (seen, _, _) = env.observation_space, step([0, 0, 0])
    quick = QuickSpace(space)
    assert quick.surely_contains(seen) and space.contains(seen)
    for key, value in seen.items():
        without = {name: other for name, other in seen.items() if name != key}
        for bad in (value.astype(np.float64), value[..., :-1], value.tolist(), None):
            assert not quick.surely_contains(without | {key: bad})
        assert not quick.surely_contains(without) and not quick.surely_contains(seen | {"more": value})
        for number in (np.nan, np.inf, 1e7, -1e7) if value.dtype == np.float32 else ():
            one = value.copy()
            one.flat[-1] = number
            assert not quick.surely_contains(seen | {key: one}) and not space.contains(seen | {key: one})
    box = spaces.Dict({"few": spaces.Box(0, 3, (2,), np.uint8)})
    assert not QuickSpace(box).surely_contains({"few": np.array([0, 4], np.uint8)})


def test_what_is_quickly_told_to_be_a_covariance_is_one() -> None:
    rng, told = np.random.default_rng(0), 0
    for size in (1, 3, 3, 3, 20, 60):
        for _ in range(50):
            root = rng.normal(size=(size, int(rng.integers(1, 2 * size + 1))))
            cov = root @ root.T * 10.0 ** rng.integers(-12, 12)
            cov = 0.5 * (cov + cov.T) - 10.0 ** rng.integers(-14, 0) * np.abs(cov).max() * np.eye(size)
            if surely_covariance(cov):
                told += 1
                assert np.linalg.eigvalsh(cov)[0] >= -1e-12 * np.abs(cov).max()
            for bad in (np.nan, np.inf, np.nextafter(cov[-1, 0], np.inf) if size > 1 else -1.0):
                broken = cov.copy()
                broken[-1, 0] = bad
                assert not surely_covariance(broken)
    assert told > 50


def test_covariances_are_judged() -> None:
    for cov, what in (
        (np.diag([1.0, -1e-6, 1.0]), "positive"), (np.diag([1.0, np.nan, 1.0]), "finite"),
        (np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), "symmetric"),
    ):  # fmt: skip
        found = Findings()
        _check_cov(cov, "the pose's", "step 1", found)
        assert any(what in wrong for wrong in found.wrong)


def test_nonsense_that_is_taken_or_refused_badly_is_found() -> None:
    def raising(error: Exception) -> Callable[[Any], None]:
        def step(action: Any) -> None:
            raise error

        return step

    for step, wrong in (
        (lambda action: None, "was taken"), (raising(KeyError("x")), "KeyError"),
        (raising(ValueError("two\nlines")), "more than a line"), (raising(ValueError("no")), None),
    ):  # fmt: skip
        found = Findings()
        refuse(step, no_actions(3), 5, found)
        assert [wrong in what for what in found.wrong] == ([True] if wrong else [])
