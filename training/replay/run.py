"""``mecanum replay``: a backend on the recorded log of a real robot, from the options to the files."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.backend import Backend
from slam.logs import AnyLog, BagTopics, ObservationNoise, ScanLog, open_log, parse_mount, with_reference
from slam.motion import move
from slam.registry import config_type, make
from slam.settings import Config, check_name, from_mapping, require, to_mapping
from slam.types import Array
from training.runs.config_files import read_config
from training.runs.errors import bad_input, check_writable
from training.runs.signals import interrupt_flag

__all__ = ["FILES", "MAP_FILES", "Replay", "ReplayConfig", "prepare", "run", "sample_times"]

FILES = (
    "trajectory_estimate.tum", "trajectory_true.tum", "landmarks.db", "landmarks.csv", "trajectory.png",
    "config.toml", "metrics.json",
)  # fmt: skip
"""What a replay writes, ``metrics.json`` last: where it is, the others are."""

MAP_FILES = ("map.png", "map.pgm", "map.yaml")
"""What a replay of a log with scans writes beside them."""

ASSOCIATIONS = ("known", "unknown")
SAMPLE_S = 0.1
"""Poses are taken, and compared, at the reference's times no nearer to each other, and as often in its gaps."""

_RUN_KINDS: dict[str, tuple[type, ...]] = {
    "association": (str,), "seed": (int,), "limit_s": (int, float), "reference": (str,),
    "raw": (bool,), "scan_topic": (str,), "odom_topic": (str,), "reference_topic": (str,), "mount": (str,),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class ReplayConfig(Config):
    """A replay's configuration file; the log's own values stand where it says nothing."""

    observation: ObservationNoise | None = None  # of a log of scans there is none
    slam: str = "invariant-ekf"
    slam_config: Mapping[str, Any] = field(default_factory=dict)


@dataclass(eq=False)
class Replay:
    """A replay: prepared, then run, then written. One entry a sample in what it records."""

    log: AnyLog
    config: ReplayConfig
    backend: Backend
    run: dict[str, Any]  # association, seed, … as config.toml's [run] has them
    out: Path
    sample_times: Array  # (s,) [s]
    sample_rows: NDArray[np.int64]  # (s,) row of the reference, -1 in its gaps
    estimates: list[Array] = field(default_factory=list)  # (3,) each
    covs: list[Array] = field(default_factory=list)  # (3, 3) each, of those
    nees: list[float] = field(default_factory=list)  # nan without a reference pose
    health: list[float] = field(default_factory=list)
    time_s: float = 0.0  # how far it came
    steps: int = 0
    observations: int = 0
    scan_times_s: list[float] = field(default_factory=list)  # wall clock of prediction and update, one a scan
    end: str = "end of the log"
    interrupted: bool = False
    wall_time_s: float = 0.0

    def __post_init__(self) -> None:
        self.files = (*MAP_FILES, *FILES) if isinstance(self.log, ScanLog) else FILES

    def trajectories(self) -> tuple[Array, Array, Array]:
        """Return times ``(n,)``, reference ``(n, 3)`` and estimate ``(n, 3)`` where there is a reference."""
        done = len(self.estimates)
        rows = self.sample_rows[:done]
        compared = rows >= 0
        estimates = np.array(self.estimates, np.float64).reshape(-1, 3)
        return self.sample_times[:done][compared], self.log.reference_poses[rows[compared]], estimates[compared]


# ---- before --------------------------------------------------------------------------------------------------


def prepare(
    path: Path, *, out: Path, robot: int | None = None, reference: Path | None = None, slam: str | None = None,
    association: str | None = None, seed: int | None = None, limit_s: float | None = None,
    config: Path | None = None, scan_topic: str | None = None, odom_topic: str | None = None,
    reference_topic: str | None = None, mount: str | None = None,
) -> Replay:  # fmt: skip
    """Read the log, check everything that can be checked, and set the backend at the start; nothing is written.

    Of what is ``None`` the config file, the log or the default decides; ``reference`` is of a log of scans, the
    last four are of a ROS 2 bag.

    Raises
    ------
    BadInput
        In one line: which option, file, line or name is wrong, and what to do.
    """
    with bad_input():
        if slam is not None:
            config_type(slam)  # before a log is read in vain
        check_writable(out, (*MAP_FILES, *FILES))
        values, past = read_config(config, _RUN_KINDS) if config is not None else ({}, {})
        if reference is not None or reference_topic is not None:
            require(reference is None or reference_topic is None,
                    "--reference and --reference-topic are two references; give one of them")  # fmt: skip
            past = {name: v for name, v in past.items() if name not in ("reference", "reference_topic")}
        given = {"association": association, "seed": seed, "limit_s": limit_s, "reference": reference}
        given |= {"scan_topic": scan_topic, "odom_topic": odom_topic, "reference_topic": reference_topic}
        given |= {"mount": mount}
        run = {"seed": 0} | past | {name: value for name, value in given.items() if value is not None}
        log = open_log(path, robot=robot, raw=run.get("raw", False), topics=_topics(run))
        if "reference" in run:
            log = with_reference(log, run["reference"])
            run["reference"] = str(Path(run["reference"]).absolute())
        known = run.setdefault("association", "unknown" if log.ids is None else "known")
        check_name("association", known, ASSOCIATIONS)
        if known == "known" and log.ids is None:
            raise ValueError(f"log {log.name} does not tell landmarks apart; give --association unknown")
        limit, end = run.get("limit_s"), "end of the log"
        if limit is not None:
            require(0 < limit < math.inf, f"--limit-s must be above 0 and finite, got {limit}")
            if limit < log.duration_s:
                end = "the limit, --limit-s"
            log = log.until(float(limit))
        effective = _make_config(log, values, slam)
        backend = make(effective.slam, config=effective.slam_config)
        if hasattr(backend, "give_pose") and not log.has_heading:
            lacks = "none: give --reference" if isinstance(log, ScanLog) else "only positions"
            raise ValueError(f"--slam {effective.slam} needs true poses; log {log.name} has {lacks}")
        if not (backend.observes_landmarks or isinstance(log, ScanLog)):
            raise ValueError(
                f"--slam {effective.slam} takes scans; log {log.name} holds landmark observations only"
            )
        backend.reset(log.start_pose, seed=run["seed"])
    run |= {"log": str(path.absolute()), "clock_start_s": log.clock_start_s}
    if robot is not None:
        run["robot"] = robot
    times, rows = sample_times(log)
    return Replay(log, effective, backend, run, out, times, rows, end=end)


def _topics(run: Mapping[str, Any]) -> BagTopics | None:
    """Return what a bag is asked for; ``None`` where nothing was said of one."""
    names = {name: run[f"{name}_topic"] for name in ("scan", "odom", "reference") if f"{name}_topic" in run}
    mount = parse_mount(run["mount"]) if "mount" in run else None
    return BagTopics(**names, mount=mount) if names or mount else None


def sample_times(log: AnyLog) -> tuple[Array, NDArray[np.int64]]:
    """Return when poses are taken ``(s,)`` [s], and the row of the reference there ``(s,)``, -1 in its gaps.

    Of a log of scans they are taken after each scan, where alone its reference is.
    """
    if isinstance(log, ScanLog):
        scan_rows = np.full(len(log.times), -1, np.int64)
        scan_rows[np.searchsorted(log.times, log.reference_times)] = np.arange(len(log.reference_times))
        return log.times, scan_rows
    times: list[float] = []
    rows: list[int] = []
    reference = [*log.reference_times.tolist(), log.duration_s]
    last = -math.inf
    for row, at in enumerate(reference):
        since = max(last, -SAMPLE_S)
        for k in range(1, math.ceil((at - since) / SAMPLE_S - 0.5)):  # the gap, if there is one
            times.append(since + k * SAMPLE_S)
            rows.append(-1)
        if at - last >= SAMPLE_S - 1e-9 and row < len(log.reference_times):
            times.append(at)
            rows.append(row)
        last = times[-1] if times else last
    return np.array(times), np.array(rows, np.int64)


def _make_config(log: AnyLog, values: Mapping[str, Any], backend: str | None) -> ReplayConfig:
    """Lay a config file over the log's own values; return the effective configuration, complete."""
    if "observation" in values and log.observation_noise is None:
        raise ValueError(f"log {log.name} holds scans, no observations; take [observation] out of the config")
    config = from_mapping(ReplayConfig, values, base=ReplayConfig(observation=log.observation_noise))
    name = backend or config.slam
    kind = config_type(name)
    told = {**log.settings, **log.settings.get(name, {})}
    known = {key: value for key, value in told.items() if key in kind.__dataclass_fields__}
    settings = from_mapping(kind, config.slam_config, base=from_mapping(kind, known))
    return ReplayConfig(observation=config.observation, slam=name, slam_config=to_mapping(settings))


# ---- the replay ------------------------------------------------------------------------------------------------


def run(replay: Replay, progress: Callable[[float], None]) -> None:
    """Feed the log to the backend until its end, or until Ctrl-C is pressed between two steps.

    ``progress`` is told the log's time [s] after every step. Raises ``ArithmeticError`` where the backend's pose
    ceases to be finite.
    """
    log, backend = replay.log, replay.backend
    give_pose = getattr(backend, "give_pose", None)
    known = replay.run["association"] == "known"
    began = time.perf_counter()
    with interrupt_flag() as interrupted:
        for event in log.events(replay.config.observation, known=known):
            _sample(replay, event.time_s, event.odometry.twist)
            at = time.perf_counter()
            if event.odometry.dt > 0:
                backend.predict(event.odometry)
                replay.steps += 1
            if give_pose is not None and (true_pose := log.reference_at(event.time_s)) is not None:
                give_pose(true_pose)
            if event.observations is not None:
                backend.observe(event.observations)
                replay.observations += len(event.observations.range_bearing)
            if event.scan is not None:
                backend.update(event.scan)
                replay.scan_times_s.append(time.perf_counter() - at)
            replay.time_s = event.time_s
            progress(event.time_s)
            if interrupted.is_set():
                replay.end, replay.interrupted = "interrupted", True
                break
            if not math.isfinite(math.fsum(backend.pose)):
                name, when = replay.config.slam, event.time_s
                raise ArithmeticError(
                    f"{name} diverged {when:.1f} s into the log: its pose is not finite any more"
                )
        else:
            _sample(replay, math.inf, (0.0, 0.0, 0.0))
    replay.wall_time_s = time.perf_counter() - began


def _sample(replay: Replay, before: float, twist: Any) -> None:
    """Record the samples that are due before a time, while ``twist`` is held."""
    log, backend, now = replay.log, replay.backend, replay.time_s
    while (k := len(replay.estimates)) < len(replay.sample_times) and replay.sample_times[k] < before:
        # Moved on to the very time, beside the filter: a step of its own would change V's share.
        replay.estimates.append(move(backend.pose, twist, float(replay.sample_times[k]) - now))
        replay.covs.append(backend.pose_cov)
        replay.health.append(backend.health)
        true_pose = log.reference_at(now) if log.has_heading and replay.sample_rows[k] >= 0 else None
        replay.nees.append(math.nan if true_pose is None else backend.pose_nees(true_pose))
