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

from mecanum_env.rooms import FloorPlan
from training.episodes.explore import make_agent
from training.figures.tables import text_table
from training.studies.costs import peers
from training.studies.costs.speed import ID, make_env, settings_of, unwrapped
from training.studies.exploring import AGENT

__all__ = ["WAYS", "measure", "run"]

WAYS = ("one", "sync", "async", "vector_entry_point")
"""One environment after the other, Gymnasium's two ways of many at once, and ours."""

_LONGEST = 300  # steps of an episode: in apartments nobody is done by then

Actions = NDArray[np.float32]
Times = NDArray[np.float64]


def _record(settings: dict[str, Any], seeds: Sequence[int], steps: int) -> tuple[Actions, list[FloorPlan]]:
    """Return the actions ``(steps, seeds, 3)`` of an agent that explores with each seed, as long as all do.

    And the rooms that it does so in.
    """
    env = make_env(settings)
    inner = unwrapped(env)
    ways, plans = [], []
    for seed in seeds:
        agent = make_agent(AGENT, inner)
        observation, _ = env.reset(seed=seed)
        agent.reset(inner.belief, seed=seed)
        way: list[Actions] = []
        while len(way) < steps and not agent.ended:
            way.append(np.asarray(agent.act(observation, inner.belief), np.float32))
            observation, *_ = env.step(way[-1])
        ways.append(way)
        plans.append(inner.truth.plan)
    return np.array([[way[k] for way in ways] for k in range(min(map(len, ways)))], np.float32), plans


def _drivers(settings: dict[str, Any], seeds: Sequence[int]) -> dict[str, tuple[Callable[[Actions], Times], Any]]:
    """Return for each way what drives recorded actions and tells how long each step of all took, and its envs."""
    one = make_env(settings)
    clock = time.perf_counter

    def drive_one(actions: Actions) -> Times:
        took = np.empty(actions.shape[:2])
        for k, seed in enumerate(seeds):
            one.reset(seed=seed)
            for step, action in enumerate(actions[:, k]):
                begin = clock()
                one.step(action)
                took[step, k] = clock() - begin
        times: Times = took.sum(axis=1)
        return times

    def driver(envs: Any) -> Callable[[Actions], Times]:
        def drive(actions: Actions) -> Times:
            envs.reset(seed=list(seeds))
            moments = [clock()]
            for action in actions:
                envs.step(action)
                moments.append(clock())
            return np.diff(moments)

        return drive

    ways: dict[str, tuple[Callable[[Actions], Times], Any]] = {"one": (drive_one, one)}
    for way in WAYS[1:]:
        envs = gymnasium.make_vec(ID, num_envs=len(seeds), vectorization_mode=way, **settings)
        ways[way] = driver(envs), envs
    return ways


def measure(
    envs: int, *, steps: int, rooms: str, slam: str, beams: int, seed: int, progress: Callable[[int, int], None],
    peer: str | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Return the median ``steps_per_second`` of each way, all environments together, resets left out.

    An agent explores first with each seed, and its actions are driven again by each way in turn, several rounds;
    in ``steps_per_second_undisturbed`` the fastest time of each step counts. A peer does as many steps in the same
    rooms in every round; its ways are named after it.
    """
    settings, seeds = settings_of(rooms, slam, beams), range(seed, seed + envs)
    actions, plans = _record(settings, seeds, min(max(steps // (envs * peers.ROUNDS), 1), _LONGEST))
    ways, done_each = _drivers(settings, seeds), actions.shape[0] * envs
    rates: dict[str, list[float]] = {}
    times: dict[str, list[Times]] = {way: [] for way in ways}
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
        for done in range(peers.ROUNDS):
            progress(done, peers.ROUNDS)
            for way, (drive, _) in ways.items():
                times[way].append(drive(actions))
            found = {way: done_each / float(taken[-1].sum()) for way, taken in times.items()}
            for way, rate in (found | {f"{peer}, {way}": rate for way, rate in theirs().items()}).items():
                rates.setdefault(way, []).append(rate)
    medians = {way: statistics.median(values) for way, values in rates.items()}
    best = {way: done_each / float(np.min(taken, axis=0).sum()) for way, taken in times.items()}
    return {
        "envs": envs, "cores": os.cpu_count(), "steps_per_second": medians, "rounds": rates,
        "steps_per_second_undisturbed": best,
        "ratio_to_one": {way: medians[way] / medians["one"] for way in medians}, "steps": int(actions.shape[0]),
        "config": settings,
    }  # fmt: skip


def run(
    envs: int, *, steps: int, rooms: str, slam: str, beams: int, seed: int, as_json: bool, peer: str | None
) -> None:
    """Measure, and print a table (or one JSON object) on standard output."""

    def progress(done: int, rounds: int) -> None:
        print(f"measuring {envs} environments, {rooms}, {slam}: round {done + 1} of {rounds} …", file=sys.stderr)

    result = measure(
        envs, steps=steps, rooms=rooms, slam=slam, beams=beams, seed=seed, progress=progress, peer=peer
    )
    if as_json:
        print(json.dumps(result))
        return
    print(
        f"{envs} environments, {result['steps']} steps, {result['cores']} cores; medians of {peers.ROUNDS} rounds"
    )
    best = result["steps_per_second_undisturbed"]
    rows = []
    for way, rate in result["steps_per_second"].items():
        undisturbed = [f"{best[way]:,.0f}", f"{best[way] / best['one']:.2f}"] if way in best else ["–", "–"]
        rows.append([way, f"{rate:,.0f}", f"{result['ratio_to_one'][way]:.2f}", *undisturbed])
    print(text_table(["way", "steps/s", "of one", "undisturbed", "of one"], rows))
