"""Steps per second of one environment on one core, and where each microsecond goes (``mecanum speed``)."""

from __future__ import annotations

import json
import platform
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

import mecanum_env
from mecanum_env.env import ExploreEnv
from mecanum_env.observation import Observation
from slam.settings import to_mapping
from training.episodes.explore import make_agent
from training.figures.tables import text_table
from training.runs.options import json_alone
from training.runs.processes import memory_mb
from training.studies.costs import peers
from training.studies.exploring import AGENT

__all__ = ["ID", "REPEATS", "make_env", "measure", "run", "settings_of", "unwrapped"]

ID = "mecanum_env:mecanum_env/Explore-v0"

REPEATS = 10
"""How often, at least, each recorded step is driven again."""

# Whose method is which stage, innermost first; a stage's time excludes that of the stages within it.
_STAGES: tuple[tuple[str, str, str], ...] = (
    ("physics", "truth.world", "step"),
    ("odometry", "_encoders", "odometry"),
    ("lidar", "lidar", "scan"),
    ("predict", "backend", "predict"),
    ("features", "backend.extractor", "extract"),
    ("association", "backend", "_associate"),
    ("correction", "backend", "_correct"),
    ("landmarks", "backend", "_manage"),
    ("grid", "backend.grid", "integrate"),
    ("key scans", "backend.key_scans", "redraw_if_moved"),
    ("update, rest", "backend", "update"),
    ("coverage", "_coverage", "update"),
    ("observation", "", "observe"),
    ("info", "", "_info"),
    ("reward", "", "_outcome"),
)


class _Stopwatch:
    """Times the stages of an environment's steps, by standing in for their methods."""

    def __init__(self) -> None:
        self.step: dict[str, float] = {}
        self.steps: dict[str, list[float]] = {name: [] for name, _, _ in _STAGES}
        self.steps["wiring"] = []
        self._open: list[float] = []

    def attach(self, env: ExploreEnv) -> None:
        """Put the watch on an environment that has just been reset."""
        for stage, path, method in _STAGES:
            owner: Any = env
            for part in filter(None, path.split(".")):
                owner = getattr(owner, part, None)
            if owner is not None and hasattr(owner, method):
                inner = getattr(type(owner), method).__get__(owner)
                setattr(owner, method, self._timed(stage, inner))

    def _timed(self, stage: str, inner: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **kwargs: Any) -> Any:
            self._open.append(0.0)
            start = time.perf_counter()
            try:
                return inner(*args, **kwargs)
            finally:
                whole = time.perf_counter() - start
                nested = self._open.pop()
                self.step[stage] = self.step.get(stage, 0.0) + whole - nested
                if self._open:
                    self._open[-1] += whole

        return timed

    def close_step(self, whole: float) -> None:
        """Book one step that took ``whole`` seconds."""
        for name, samples in self.steps.items():
            if name != "wiring":
                samples.append(self.step.get(name, 0.0))
        self.steps["wiring"].append(whole - sum(self.step.values()))
        self.step = {}


def _record(env: gymnasium.Env[Observation, Any], steps: int, seed: int) -> list[tuple[int, list[Any]]]:
    """Explore until there are ``steps`` actions; return them by episode, with its seed."""
    inner = unwrapped(env)
    agent = make_agent(AGENT, inner)
    episodes: list[tuple[int, list[Any]]] = []
    total = 0
    while total < steps:
        observation, _ = env.reset(seed=seed)
        agent.reset(inner.belief, seed=seed)
        actions: list[Any] = []
        done = False
        while not done and total + len(actions) < steps:
            actions.append(agent.act(observation, inner.belief))
            observation, _, terminated, truncated, _ = env.step(actions[-1])
            done = terminated or truncated or agent.ended
        episodes.append((seed, actions))
        total += len(actions)
        seed += 1
    return episodes


def _replay(
    env: gymnasium.Env[Observation, Any], episodes: list[tuple[int, list[Any]]], watch: _Stopwatch | None
) -> tuple[list[float], list[int]]:
    """Drive recorded episodes again; return the time of each step [s] and the landmarks at each."""
    inner = unwrapped(env)
    times: list[float] = []
    landmarks: list[int] = []
    clock = time.perf_counter
    for seed, actions in episodes:
        env.reset(seed=seed)
        if watch is not None:
            watch.attach(inner)
        for action in actions:
            start = clock()
            env.step(action)
            took = clock() - start
            times.append(took)
            landmarks.append(inner.backend.landmark_count)
            if watch is not None:
                watch.close_step(took)
    return times, landmarks


def settings_of(rooms: str, slam: str, beams: int) -> dict[str, Any]:
    """Return the settings of the environment that is measured."""
    return {"rooms": rooms, "slam": slam, "lidar": {"beams": beams}, "config": {"coverage_target": 1.0}}


def make_env(settings: dict[str, Any]) -> gymnasium.Env[Observation, Any]:
    """Return it as Gymnasium wraps it."""
    return gymnasium.make(ID, max_episode_steps=mecanum_env.MAX_EPISODE_STEPS, **settings)


def unwrapped(env: gymnasium.Env[Observation, Any]) -> ExploreEnv:
    """Return the environment within."""
    inner = env.unwrapped
    assert isinstance(inner, ExploreEnv)
    return inner


def measure(*, steps: int, rooms: str, slam: str, beams: int, seed: int) -> dict[str, Any]:
    """Return ``steps_per_second``, ``stages_us``, ``landmarks_mean``, ``rss_mb`` and ``config``.

    An agent explores first, and its actions are driven again: one seed is one episode, so these are the very
    steps of an exploration, with its map and landmarks, but without the agent's own work in between.
    """
    env = make_env(settings_of(rooms, slam, beams))
    episodes = _record(env, min(max(steps // REPEATS, 100), 20_000), seed)
    _replay(env, episodes, None)  # every buffer reaches the size that these rooms ask for
    rss_before = memory_mb()
    times: list[float] = []
    landmarks: list[int] = []
    replays: list[list[float]] = []
    while len(times) < steps:
        more_times, more_landmarks = _replay(env, episodes, None)
        replays.append(more_times)
        times += more_times
        landmarks += more_landmarks
    rss_after = memory_mb()
    watch = _Stopwatch()
    timed, _ = _replay(env, episodes, watch)
    inner = unwrapped(env)
    # Rates of a tenth of the steps each: their median stands up to what else the machine is doing.
    parts = [part for part in np.array_split(np.array(times), 10) if len(part)]
    return {
        "steps_per_second": float(np.median([len(part) / part.sum() for part in parts])),
        # Each replay drives the same steps: the fastest time of each is what it takes undisturbed.
        "steps_per_second_undisturbed": 1.0 / float(np.min(replays, axis=0).mean()),
        "step_us_median": 1e6 * statistics.median(times),
        "step_us_p99": 1e6 * float(np.quantile(times, 0.99)),
        "stages_us": {name: 1e6 * statistics.median(samples) for name, samples in watch.steps.items()},
        "stages_us_mean": {name: 1e6 * statistics.fmean(samples) for name, samples in watch.steps.items()},
        "watched_step_us_median": 1e6 * statistics.median(timed),
        "landmarks_mean": float(np.mean(landmarks)),
        "steps": len(times),
        "replays": len(replays),
        "rss_mb": rss_after,
        "rss_mb_before": rss_before,
        "machine": f"{platform.machine()}, Python {platform.python_version()}, numpy {np.__version__}",
        "config": to_mapping(inner.config),
    }


def _beside(peer: str, *, steps: int, rooms: str, slam: str, beams: int, seed: int) -> dict[str, Any]:
    """Measure ours and a peer in turn, over one exploration's rooms (``training.studies.costs.peers.compare``)."""
    env = make_env(settings_of(rooms, slam, beams))
    inner = unwrapped(env)
    episodes = _record(env, min(max(steps // peers.ROUNDS, 1), 20_000), seed)
    drives = []
    for episode_seed, actions in episodes:
        env.reset(seed=episode_seed)
        drives.append(peers.Drive(seed=episode_seed, steps=len(actions), plan=inner.truth.plan))

    def ours() -> float:
        times, _ = _replay(env, episodes, None)
        return len(times) / sum(times)

    return peers.compare(peer, inner.config, drives=drives, ours=ours)


def run(*, steps: int, rooms: str, slam: str, beams: int, seed: int, as_json: bool, peer: str | None) -> None:
    """Measure, and print a table (or one JSON object) on standard output; ``peer`` adds a comparison."""
    print(f"measuring {rooms}, {slam}, {beams} beams, {steps:,} steps …", file=sys.stderr)
    with json_alone(as_json):
        result = measure(steps=steps, rooms=rooms, slam=slam, beams=beams, seed=seed)
    if peer is not None:
        print(f"measuring {peer} in turn with it …", file=sys.stderr)
        result["peer"] = _beside(peer, steps=steps, rooms=rooms, slam=slam, beams=beams, seed=seed)
    if as_json:
        print(json.dumps(result))
        return
    print(
        f"{result['steps_per_second']:,.0f} complete steps per second ({result['steps']:,} steps; median "
        f"{result['step_us_median']:.0f} µs, 99th percentile {result['step_us_p99']:.0f} µs; undisturbed, the "
        f"fastest of {result['replays']} replays of each step, "
        f"{result['steps_per_second_undisturbed']:,.0f} a second; "
        f"{result['landmarks_mean']:.0f} landmarks on average; {result['rss_mb_before']:.0f} MB before, "
        f"{result['rss_mb']:.0f} MB after)"
    )
    stages = sorted(result["stages_us"].items(), key=lambda item: -item[1])
    rows = [[name, f"{median:.1f}", f"{result['stages_us_mean'][name]:.1f}"] for name, median in stages]
    print(text_table(["stage", "median µs", "mean µs"], rows))
    if peer is not None:
        print(_against(result["peer"]))


def _against(peer: dict[str, Any]) -> str:
    rounds = len(peer["rounds"])
    versions = ", ".join(f"{name} {number}" for name, number in peer["versions"].items())
    return (
        f"in turn with {versions}: ours {peer['ours_steps_per_second']:,.0f}, theirs "
        f"{peer['steps_per_second']:,.0f} steps per second, ratio {peer['ratio']:.2f} (medians of {rounds} rounds "
        f"of {peer['steps']:,} steps; theirs has no dynamics and no SLAM)"
    )
