"""The fastest way over the true map that was found, driven: the bound that reports set beside the agents.

It is no agent. Before it starts it searches the true map for the sequence of stops past which the agents' driver,
with the agents' lidar, has mapped enough soonest; it drives the best sequences in the very episode (same rooms,
same noise), and then drives the one that was fastest. So its time is one that was achieved, and that of the
fastest path lies at or below it; :mod:`training.truth.lower_bound` says how far at most.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.base import Agent, Goal
from agents.brisk_tour import BRISK
from agents.driving.control import PathFollower
from mecanum_env.env import ExploreEnv
from slam.belief import Belief
from slam.types import Array
from training.truth.lower_bound import lower_bound
from training.truth.rehearsal import Rehearsal
from training.truth.search import annealed
from training.truth.sights import Sights

__all__ = ["KNOWN_MAPS", "KnownMap"]

KNOWN_MAPS = {"known-map": 0.95, "known-map-99": 0.99}
"""What reports call it → the coverage that it is to reach soonest."""

_STARTS = 6  # annealings by length …
_TRIES = 25_000  # … of so many sequences
# … that see so much more of the map than is asked for, and each more than the one before: the driver cuts corners.
_SPARE, _MORE = 0.006, 0.002
_REFINED = 2  # of these are gone on with, by time …
_TIMED = 300  # … over so many sequences
# Shares seen more than are asked for, in rehearsals before drives: noise takes some of what is seen.
_MARGINS = (0.001, 0.003, 0.006, 0.010)
_WIDER = (0.02, 0.03, 0.045)  # where none of these is enough


class KnownMap(Agent):
    """Drives the fastest way found to a coverage, and stops; the environment is the episode's, after its reset."""

    def __init__(self, env: ExploreEnv, coverage: float) -> None:
        config = env.config
        super().__init__(robot=config.robot, lidar=config.lidar, step_s=config.step_s)
        self._plan, self._env_config = env.truth.plan, replace(config, coverage_target=1.0)
        self._ground = env.truth.ground
        self._coverage = coverage
        self._steps_left = 0
        self.lower_bound_s = 0.0  # nobody can have reached the coverage before

    def reset(self, belief: Belief, seed: int = 0) -> None:
        """Search, and drive what was found in an episode of the same seed; the belief must be at its start."""
        super().reset(belief, seed)
        self.lower_bound_s = lower_bound(
            self._ground, self._coverage, robot=self._robot, lidar=self._lidar, noise=self._env_config.noise
        )
        sights = Sights(self._ground, robot=self._robot, lidar=self._lidar)
        rehearsal = Rehearsal(BRISK, sights, robot=self._robot, lidar=self._lidar, step_s=self._step_s)
        trial, paths, steps = ExploreEnv(config=self._env_config), list[Array](), list[float]()
        for order in self._orders(sights, rehearsal):
            if len(paths) >= len(_MARGINS) and min(steps) < math.inf:
                break
            paths.append(sights.path(order))
            steps.append(self._drive(trial, paths[-1], seed))
        best = int(np.argmin(steps))
        self._steps_left = int(min(steps[best], 10**9))
        self._goal = Goal(pose=np.array([*paths[best][-1], 0.0]), path=paths[best])
        self._follower = self._follower_of(paths[best])
        self._status = "driving"

    def _orders(self, sights: Sights, rehearsal: Rehearsal) -> Iterator[NDArray[np.int64]]:
        """Give sequences of stops: what is likely to be fastest of those that see a little more than needed."""
        rng, share = np.random.default_rng(0), self._coverage
        starts = [
            annealed(sights.board, share=min(share + _SPARE + _MORE * k, 0.9985), tries=_TRIES, rng=rng)
            for k in range(_STARTS)
        ]
        starts.sort(key=lambda order: rehearsal.value(order, share + _MARGINS[1]))
        tried = [
            rehearsal.refined(order, share=share + _MARGINS[1], tries=_TIMED, rng=rng)
            for order in starts[:_REFINED]
        ]
        order = min(tried, key=lambda found: found[1])[0]
        for margin in (*_MARGINS[::-1], *_WIDER):
            order, _ = rehearsal.refined(order, share=min(share + margin, 0.9985), tries=_TIMED // 2, rng=rng)
            yield order

    def _drive(self, trial: ExploreEnv, path: Array, seed: int) -> float:
        """Return after how many steps of the episode the coverage is reached on a path; inf if it is not."""
        observation, info = trial.reset(seed=seed, options={"floor_plan": self._plan})
        follower, steps = self._follower_of(path), 0
        while info["coverage"] < self._coverage:
            if follower.arrived or steps > 20 * len(path) + 100:
                return math.inf
            twist = follower.follow(observation, trial.belief)
            observation, _, _, _, info = trial.step(self._to_action(twist))
            steps += 1
        return steps

    def _follower_of(self, path: Array) -> PathFollower:
        follower = PathFollower(BRISK, robot=self._robot, lidar=self._lidar, step_s=self._step_s)
        follower.set_path(path, None)
        return follower

    def choose(self, belief: Belief) -> Goal | None:
        """Return the way that is being driven, ``None`` at its end."""
        return self._goal

    def act(self, observation: Mapping[str, Any] | None, belief: Belief) -> NDArray[np.float32]:
        """Return the next action on the way."""
        if self._steps_left <= 0 or self._follower.arrived:
            self._goal, self._status = None, "covered"
            return np.zeros(3, dtype=np.float32)
        self._steps_left -= 1
        return self._to_action(self._follower.follow(observation, belief))
