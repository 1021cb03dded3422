"""One episode with a fault in it: when the belief was right again, and what its health said all along."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mecanum_env.env import ExploreEnv
from training.episodes.explore import make_agent
from training.studies.recovery.faults import FAULTS

__all__ = ["BINS", "REGION", "Job", "Row", "run_job", "within"]

Job = tuple[str, str, str, str, str, int, int]
"""Fault, backend, agent, rooms or file of a plan, noise, seed, steps at most."""
Row = dict[str, Any]

REGION = 14.16
"""NEES of a pose at the rim of the 99.7 % region: χ² with 3 degrees of freedom, 3σ of a normal variable."""
BINS = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 1.0)
"""Edges of the bins of health that a reliability diagram counts in."""

_FIRST_S, _LAST_S = 20.0, 40.0  # when the fault begins: drawn from between these
_AFTER_S = 25.0  # how long it is watched after the fault's end
_SMALL_M, _SMALL_RAD = 0.1, math.radians(2.0)  # errors of a belief that is right again …
_HOLDS_S = 2.0  # … and stays so for as long
_IDLE_STEPS = 20  # an agent without a goal for so long has nothing left to do


def within(nees: float) -> bool:
    """Tell whether the true pose lies in the 99.7 % region of a belief."""
    return bool(nees <= REGION)


def run_job(job: Job) -> Row:
    """Do one episode.

    Of one with a fault the row has ``possible`` (False: no place to be put to), ``begun_s``, ``recovered_s``
    (after the fault's end; None: never), ``worst_m``, ``contacts``, walls' ``precision`` before and at the end.
    Every row has
    ``seconds``, ``lost`` and ``found`` (how often), ``lost_s``, and per bin of :data:`BINS` how many seconds' ends
    fell into it, ``count``, at how many of those the true pose was within the region, ``true``, and the sum of the
    health there, ``sum``.
    """
    fault_name, slam, agent, where, noise, seed, steps = job
    place: dict[str, Any] = {"floor_plan": where} if Path(where).suffix else {"rooms": where}
    env = ExploreEnv(slam=slam, noise=noise, config={"coverage_target": 1.0}, **place)
    episode = _Episode(env, agent, seed)
    if fault_name == "none":
        episode.drive(steps, until_done=True)
        return episode.row()
    rng, fault, step_s = np.random.default_rng(seed), FAULTS[fault_name](), env.config.step_s
    episode.drive(round(rng.uniform(_FIRST_S, _LAST_S) / step_s))
    before = env.episode_metrics()
    row: Row = {"begun_s": before["time_s"], "possible": fault.begin(env, rng)}
    if not row["possible"]:
        return row
    first = len(episode.errors)
    episode.drive(round(fault.duration_s / step_s))
    fault.end(env)
    last = len(episode.errors)
    episode.drive(round(_AFTER_S / step_s))
    after = env.episode_metrics()
    back = _right_again(episode.errors[last:], round(_HOLDS_S / step_s))
    return episode.row() | row | {
        "recovered_s": None if back is None else round(back * step_s, 6),
        "worst_m": max(error for error, _, _ in episode.errors[first:]),
        "contacts": int(after["collisions"] or 0) - int(before["collisions"] or 0),
        "precision_before": before["map_precision"],
        "precision": after["map_precision"],
        "iou": after["map_iou"],
    }  # fmt: skip


class _Episode:
    """An agent that explores, with what was seen of its belief."""

    def __init__(self, env: ExploreEnv, agent: str, seed: int) -> None:
        self.env = env
        self._agent = make_agent(agent, env)
        self._observation, _ = env.reset(seed=seed)
        self._agent.reset(env.belief, seed=seed)
        self.errors: list[tuple[float, float, float]] = []  # of a step: [m], [rad], NEES
        bins = len(BINS) - 1
        self._count, self._true, self._sum = np.zeros(bins, int), np.zeros(bins, int), np.zeros(bins)

    def drive(self, steps: int, *, until_done: bool = False) -> None:
        """Go on for so many steps; or until nothing is left to do."""
        idle, every = 0, round(1.0 / self.env.config.step_s)
        for _ in range(steps):
            action = self._agent.act(self._observation, self.env.belief)
            self._observation, _, _, _, info = self.env.step(action)
            self.errors.append((info["position_error_m"], info["heading_error_rad"], info["nees"]))
            if len(self.errors) % every == 0:
                self._note(self.env.backend.health, within(info["nees"]))
            idle = idle + 1 if self._agent.goal is None else 0
            if until_done and idle >= _IDLE_STEPS:
                break

    def _note(self, health: float, true: bool) -> None:
        k = min(int(np.searchsorted(BINS, health, side="right")) - 1, len(BINS) - 2)
        self._count[k] += 1
        self._true[k] += true
        self._sum[k] += health

    def row(self) -> Row:
        """Return what every row has."""
        recovery, step_s = self.env.backend.recovery, self.env.config.step_s
        return {
            "seconds": len(self.errors) * step_s, "lost": recovery.times_lost, "found": recovery.relocalisations,
            "lost_s": recovery.scans_lost * step_s, "count": self._count.tolist(), "true": self._true.tolist(),
            "sum": self._sum.round(9).tolist(),
        }  # fmt: skip


def _right_again(errors: Sequence[tuple[float, float, float]], hold: int) -> int | None:
    """Return from which step on the belief was right for ``hold`` steps: small errors, within its covariance."""
    right = 0
    for k, (error, heading, nees) in enumerate(errors):
        right = right + 1 if error <= _SMALL_M and heading <= _SMALL_RAD and within(nees) else 0
        if right == hold:
            return k - hold + 1
    return None
