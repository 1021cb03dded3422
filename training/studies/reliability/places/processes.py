"""Environments after a fork, in processes started in every way, and many of them in one process."""

from __future__ import annotations

import gc
import multiprocessing
import os
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

from mecanum_env.vector.vector_env import ExploreVectorEnv
from training.runs.processes import memory_mb, one_thread_each
from training.studies.reliability.steps.items import Item, items
from training.studies.reliability.steps.runs import handles, run

__all__ = ["PROCESSES"]

_MANY = 200
_STEPS = 5
_STILL = np.zeros((1, 3), np.float32)
_ROUNDS = 8


def started_ways(seed: int) -> list[str]:
    """Run an item here, and in processes that are forked, spawned and served."""
    chosen = [item for item in items(1000, seed) if item.kind in ("single", "team")][:2]
    wrong = []
    for item in chosen:
        here = run(item)
        wrong += [f"{what}: {where}" for what, where in here.wrong.items()]
        for how in multiprocessing.get_all_start_methods():
            with one_thread_each(), multiprocessing.get_context(how).Pool(1) as pool:
                there = pool.apply(_digest, (item,))
            if there != here.digest:
                wrong.append(
                    f"{' '.join(map(str, item))}: {there} where it was started by {how}, here {here.digest}"
                )
    return wrong


def _digest(item: Item) -> str:
    return run(item).digest


def after_a_fork(seed: int) -> list[str]:
    """Step an environment that was made before a fork in both processes: each has its own from then on."""
    if not hasattr(os, "fork"):
        return []
    env = _made(seed)
    whole = _drive(_made(seed), seed)
    reads, writes = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.write(writes, _drive(env, seed))
        finally:
            os._exit(0)
    os.close(writes)
    ours = _drive(env, seed)
    with os.fdopen(reads, "rb") as pipe:
        theirs = pipe.read()
    os.waitpid(child, 0)
    return [] if ours == theirs == whole else ["an environment differs after a fork"]


def _made(seed: int) -> Any:
    env = gymnasium.make("mecanum_env/Explore-v0", disable_env_checker=True)
    env.reset(seed=seed)
    return env


def _drive(env: Any, seed: int, steps: int = 20) -> bytes:
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        observation, *_ = env.step(rng.uniform(-1, 1, 3).astype(np.float32))
    return bytes(
        observation["scan"].tobytes() + observation["pose"].tobytes() + observation["map_local"].tobytes()
    )


def many_in_one(seed: int) -> list[str]:
    """Make 200 environments, step them in turn, and close them; then 200 as a batch: handles are given back."""
    wrong = []
    _drive(_made(seed), seed, 1)
    gc.collect()
    before, memory = handles(), memory_mb()
    envs = [_made(seed + k) for k in range(_MANY)]
    rngs = [np.random.default_rng(seed + k) for k in range(_MANY)]
    for _ in range(_STEPS):
        last = [env.step(rng.uniform(-1, 1, 3).astype(np.float32)) for env, rng in zip(envs, rngs, strict=True)]
    scans = [observation["scan"] for observation, *_ in last]
    each_mb = (memory_mb() - memory) / _MANY
    for env in envs:
        env.close()
    del envs, last
    gc.collect()
    if handles() > before:
        wrong.append(f"{handles() - before} handles are left open by {_MANY} environments")
    if each_mb > 20.0:
        wrong.append(f"an environment takes {each_mb:.1f} MB")
    for k in (0, _MANY // 2, _MANY - 1):
        if not np.array_equal(_scan(seed + k), scans[k]):
            wrong.append(f"environment {k} of {_MANY} is not what it is alone")
    observations, *_ = _batch(_MANY, seed)
    if not np.array_equal(observations["scan"], np.stack([_scan(seed + k, _STILL) for k in range(_MANY)])):
        wrong.append(f"a batch of {_MANY} is not what its environments are alone")
    # multiprocessing keeps shared memory for the next who asks: what it has after two rounds is enough for more.
    kept = []
    for _ in range(_ROUNDS):
        _batch(3, seed)
        gc.collect()
        kept.append(handles())
    if kept[-1] > kept[2]:
        wrong.append(f"batches leave handles open: {kept} after each of {_ROUNDS}")
    return wrong


def _batch(count: int, seed: int) -> Any:
    """Return what a batch shows after a step in which nobody moves."""
    batch = ExploreVectorEnv(count, workers=2)
    try:
        batch.reset(seed=seed)
        return batch.step(np.zeros((count, 3), np.float32))
    finally:
        batch.close()


def _scan(seed: int, moves: Any = None) -> Any:
    """Return the scan of an environment alone after moves ``(n, 3)``, at random where none are given."""
    env, rng = _made(seed), np.random.default_rng(seed)
    for k in range(_STEPS if moves is None else len(moves)):
        action = rng.uniform(-1, 1, 3).astype(np.float32) if moves is None else moves[k]
        observation, *_ = env.step(action)
    return observation["scan"]


PROCESSES: dict[str, Callable[[int], list[str]]] = {
    "started ways": started_ways, "after a fork": after_a_fork, "many in one": many_in_one,
}  # fmt: skip
"""Name → what is wrong there, of a seed."""
