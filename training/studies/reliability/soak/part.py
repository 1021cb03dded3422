"""The part ``soak`` of the campaign."""

from __future__ import annotations

import gc
import math
import os
import threading
import time
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

import gymnasium
import numpy as np
from scipy import stats

import agents
from mecanum_env import rooms
from mecanum_env.rooms import FloorPlanError
from training.runs.processes import memory_mb
from training.studies.reliability.parts import Job, Part, Row, Summary, Table
from training.studies.reliability.steps.runs import handles

__all__ = ["SOAK", "slope"]

_ITEM_S = 30.0
_WARM_S = 120.0  # in which kernels are loaded and libraries take what they keep
_SAMPLES = 10  # of an item
_BACKENDS = ("invariant-ekf", "graph-slam", "fastslam2", "ekf-lines", "dp-slam", "compressed-ekf")
_EPISODE = 300  # steps at most

_GROWTH_MB = 10.0
"""Memory that a soak may take more at its end than at its beginning, by the lower end of the interval."""


def _jobs(hours: float, seed: int) -> list[Job]:
    seconds = 3600.0 * hours
    count = max(1, math.ceil(seconds / _ITEM_S - 1e-9))
    return [(seed, k, round(min(_ITEM_S, seconds - k * _ITEM_S), 3)) for k in range(count)]


@cache
def _life(seed: int) -> Iterator[bool]:
    """Return the steps of environments that live as long as this process: whether each was sound."""
    return _steps(seed)


def _steps(seed: int) -> Iterator[bool]:
    envs = [
        gymnasium.make("mecanum_env/Explore-v0", slam=slam, max_episode_steps=_EPISODE, disable_env_checker=True)
        for slam in _BACKENDS
    ]
    drivers = [agents.make(name) for name in ("nearest-frontier", "brisk-tour", "next-best-view", "random")]
    kinds, rng = sorted(rooms.names()), np.random.default_rng(seed)
    while True:
        k = int(rng.integers(10_000, 2**31))
        wrapped: Any = envs[k % len(envs)]
        agent, env = drivers[k // 7 % len(drivers)], wrapped.unwrapped
        try:
            plan = rooms.make(kinds[k // 31 % len(kinds)], seed=k)
        except FloorPlanError:
            continue
        observation, _ = wrapped.reset(seed=k, options={"floor_plan": plan})
        agent.reset(env.belief, seed=k)
        ended = False
        while not ended:
            observation, reward, terminated, truncated, _ = wrapped.step(agent.act(observation, env.belief))
            ended = terminated or truncated
            yield math.isfinite(reward)


def _work(job: Job) -> Row:
    """Go on with the life of this process' environments for a while; sample memory, handles and threads."""
    seed, _, seconds = job
    life = _life(seed)
    samples: list[list[float]] = []
    began = time.monotonic()
    steps = unsound = 0
    while (elapsed := time.monotonic() - began) < seconds:
        unsound += not next(life)
        steps += 1
        if elapsed >= len(samples) * seconds / _SAMPLES:
            gc.collect()
            samples.append(
                [round(time.monotonic(), 2), round(memory_mb(), 2), handles(), threading.active_count()]
            )
    return {"pid": os.getpid(), "steps": steps, "unsound": unsound, "samples": samples}


def slope(hours: Any, values: Any) -> tuple[float, float, float]:
    """Return the slope of values over time (Theil and Sen's: the median of all pairs'), and its 95 % interval."""
    found = stats.theilslopes(values, hours, 0.95)
    return float(found.slope), float(found.low_slope), float(found.high_slope)


def _sum_up(rows: Mapping[Job, Row]) -> Summary:
    lives = []
    for pid in dict.fromkeys(row["pid"] for row in rows.values()):
        samples = np.array([sample for row in rows.values() if row["pid"] == pid for sample in row["samples"]])
        lives.append(_told(samples[np.argsort(samples[:, 0])]))
    steps = sum(row["steps"] for row in rows.values())
    unsound = sum(row["unsound"] for row in rows.values())
    failures = [f"{unsound} rewards are not finite"] if unsound else []
    for life in lives:
        if life["slope"] is not None and life["slope"][1] * life["hours"] > _GROWTH_MB:
            failures.append(
                f"memory grows by {life['slope'][0]:.1f} MB/h {life['slope'][1:]} over {life['hours']} h"
            )
        if life["handles"][1] > life["handles"][0] or life["threads"][1] > life["threads"][0]:
            failures.append(
                f"handles {life['handles']}, threads {life['threads']} at the beginning and at the end"
            )
    return {"tried": steps, "failures": failures, "lives": lives, "warm_s": _WARM_S}


def _told(samples: Any) -> dict[str, Any]:
    """Return of a life's samples (time [s], MB, handles, threads) what they amount to, after its first minutes."""
    hours = (samples[:, 0] - samples[0, 0]) / 3600.0
    warm = samples[hours >= _WARM_S / 3600.0]
    measured = warm if len(warm) >= _SAMPLES else samples
    hours = measured[:, 0] / 3600.0
    enough = len(measured) >= _SAMPLES and len(warm) == len(measured)
    ends = measured[[0, -1]]
    return {
        "hours": round(float(hours[-1] - hours[0]), 4), "samples": len(samples),
        "slope": [round(v, 3) for v in slope(hours, measured[:, 1])] if enough else None,
        "mb": ends[:, 1].tolist(), "mb_most": float(samples[:, 1].max()),
        "handles": ends[:, 2].astype(int).tolist(), "threads": ends[:, 3].astype(int).tolist(),
    }  # fmt: skip


def _table(found: Summary) -> Table:
    rows = []
    for k, life in enumerate(found["lives"]):
        told = "–" if life["slope"] is None else "{:+.2f} [{:+.2f}, {:+.2f}]".format(*life["slope"])
        ends = ["{} → {}".format(*life[name]) for name in ("mb", "handles", "threads")]
        rows.append([f"process {k + 1}", f"{life['hours']:.3f}", told, *ends])
    return ["", "hours", "memory [MB/h]", "memory [MB]", "handles", "threads"], rows


SOAK = Part(
    about=(
        "Environments of six backends that live for hours, reset over mixed rooms and driven by agents: what "
        "memory, handles and threads do after the first two minutes."
    ),
    size=2.0, jobs=_jobs, work=_work, sum_up=_sum_up, table=_table,
)  # fmt: skip
