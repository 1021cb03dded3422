"""``mecanum speed --envs``: steps per second of many environments at once, by each way that there is."""

from __future__ import annotations

import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

import agents
import mecanum_env
from mecanum_env.env import ExploreEnv
from mecanum_env.rooms import FloorPlan
from training.figures.tables import text_table
from training.studies import peers

__all__ = ["WAYS", "measure", "run"]

ID = "mecanum_env:mecanum_env/Explore-v0"
WAYS = ("one", "sync", "async", "vector_entry_point")
"""One environment after the other, Gymnasium's two ways of many at once, and ours."""

_ROUNDS = 5
_LONGEST = 300  # steps of an episode: in apartments nobody is done by then

Actions = NDArray[np.float32]


def _settings(rooms: str, slam: str, beams: int) -> dict[str, Any]:
    return {"rooms": rooms, "slam": slam, "lidar": {"beams": beams}, "config": {"coverage_target": 1.0}}


def _record(settings: dict[str, Any], seeds: Sequence[int], steps: int) -> tuple[Actions, list[FloorPlan]]:
    """Return the actions ``(steps, seeds, 3)`` of an agent that explores with each seed, as long as all do.

    And the rooms that it does so in.
    """
    env = gymnasium.make(ID, max_episode_steps=mecanum_env.MAX_EPISODE_STEPS, **settings)
    inner = env.unwrapped
    assert isinstance(inner, ExploreEnv)
    ways, plans = [], []
    for seed in seeds:
        agent = agents.make("nearest-frontier", robot=inner.config.robot, lidar=inner.config.lidar)
        observation, _ = env.reset(seed=seed)
        agent.reset(inner.belief, seed=seed)
        way: list[Actions] = []
        while len(way) < steps and not agent.ended:
            way.append(np.asarray(agent.act(observation, inner.belief), np.float32))
            observation, *_ = env.step(way[-1])
        ways.append(way)
        plans.append(inner.truth.plan)
    return np.array([[way[k] for way in ways] for k in range(min(map(len, ways)))], np.float32), plans


def _drivers(settings: dict[str, Any], seeds: Sequence[int]) -> dict[str, tuple[Callable[[Actions], float], Any]]:
    """Return for each way what drives recorded actions and tells the seconds it took, and its environments."""
    one = gymnasium.make(ID, max_episode_steps=mecanum_env.MAX_EPISODE_STEPS, **settings)

    def drive_one(actions: Actions) -> float:
        took = 0.0
        for k, seed in enumerate(seeds):
            one.reset(seed=seed)
            begin = time.perf_counter()
            for action in actions[:, k]:
                one.step(action)
            took += time.perf_counter() - begin
        return took

    def driver(envs: Any) -> Callable[[Actions], float]:
        def drive(actions: Actions) -> float:
            envs.reset(seed=list(seeds))
            begin = time.perf_counter()
            for action in actions:
                envs.step(action)
            return time.perf_counter() - begin

        return drive

    ways: dict[str, tuple[Callable[[Actions], float], Any]] = {"one": (drive_one, one)}
    for way in WAYS[1:]:
        envs = gymnasium.make_vec(ID, num_envs=len(seeds), vectorization_mode=way, **settings)
        ways[way] = driver(envs), envs
    return ways


def measure(
    envs: int, *, steps: int, rooms: str, slam: str, beams: int, seed: int, progress: Callable[[int, int], None],
    peer: str | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Return the median ``steps_per_second`` of each way, all environments together, resets left out.

    An agent explores first with each seed, and its actions are driven again by each way in turn, several rounds. A
    peer does as many steps in the same rooms in every round; its ways are named after it.
    """
    settings, seeds = _settings(rooms, slam, beams), range(seed, seed + envs)
    actions, plans = _record(settings, seeds, min(max(steps // (envs * _ROUNDS), 1), _LONGEST))
    ways = _drivers(settings, seeds)
    rates: dict[str, list[float]] = {}
    with ExitStack() as stack:
        for _, made in ways.values():
            stack.callback(made.close)
        theirs: Callable[[], dict[str, float]] = dict
        if peer is not None:
            drives = [peers.Drive(seed=k, steps=len(actions), plan=p) for k, p in zip(seeds, plans, strict=True)]
            config = ways["one"][1].unwrapped.config
            theirs = stack.enter_context(peers.peer_batch(peers.peer_setup(config), drives))
        for drive, _ in ways.values():
            drive(actions[:20])  # every buffer reaches its size
        for done in range(_ROUNDS):
            progress(done, _ROUNDS)
            found = {way: actions.shape[0] * envs / drive(actions) for way, (drive, _) in ways.items()}
            for way, rate in (found | {f"{peer}, {way}": rate for way, rate in theirs().items()}).items():
                rates.setdefault(way, []).append(rate)
    medians = {way: statistics.median(values) for way, values in rates.items()}
    return {
        "envs": envs, "cores": os.cpu_count(), "steps_per_second": medians, "rounds": rates,
        "ratio_to_one": {way: medians[way] / medians["one"] for way in medians}, "steps": int(actions.shape[0]),
        "config": settings,
    }  # fmt: skip


def run(
    envs: int, *, steps: int, rooms: str, slam: str, beams: int, seed: int, as_json: bool, peer: str | None = None
) -> dict[str, Any]:
    """Measure, and print a table (or one JSON object) on standard output."""

    def progress(done: int, rounds: int) -> None:
        print(f"measuring {envs} environments, {rooms}, {slam}: round {done + 1} of {rounds} …", file=sys.stderr)

    result = measure(
        envs, steps=steps, rooms=rooms, slam=slam, beams=beams, seed=seed, progress=progress, peer=peer
    )
    if as_json:
        print(json.dumps(result))
        return result
    rates, ratios = result["steps_per_second"], result["ratio_to_one"]
    print(f"{envs} environments, {result['steps']} steps, {result['cores']} cores; medians of {_ROUNDS} rounds")
    print(text_table(["way", "steps/s", "of one"], [[w, f"{rates[w]:,.0f}", f"{ratios[w]:.2f}"] for w in rates]))
    return result
