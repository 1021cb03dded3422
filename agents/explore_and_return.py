"""Explore, then drive back to the start (Newman's experiment).

The robot has nothing but its own belief to find the start with: how far from the true one it stops is what its
whole journey has cost it in certainty.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from agents.base import Goal
from agents.driving.control import ControlConfig, PathFollower
from agents.nearest_frontier import NearestFrontier, NearestFrontierConfig
from slam import geometry
from slam.belief import Belief
from slam.settings import Angle, Config, Length, Positive
from slam.types import Array, Floats

__all__ = ["ExploreAndReturn", "ExploreAndReturnConfig", "HomingConfig"]


@dataclass(frozen=True, kw_only=True)
class HomingConfig(Config):
    """How near to the start, by the belief, is there."""

    arrived_m: Length = 0.05
    arrived_rad: Angle = 0.1
    arrival_m_s: Positive = 0.06  # speed at which the start is reached
    last_leg_m: Length = 0.25  # so far it goes straight: the start may lie too near to a wall to be planned to


@dataclass(frozen=True, kw_only=True)
class ExploreAndReturnConfig(NearestFrontierConfig):
    """The parts of the explorer, and the way back."""

    homing: HomingConfig = field(default_factory=HomingConfig)


class ExploreAndReturn(NearestFrontier):
    """Explores as the nearest-frontier agent does; with nothing left to explore, goes back to where it began.

    It ends with status ``returned`` where it believes to stand on its start pose again, and ``stuck`` where as
    many attempts as a frontier gets have not brought it there.
    """

    outlives_coverage = True
    """An episode ends when this agent has ended, not when all is mapped."""

    config: ExploreAndReturnConfig
    config_type = ExploreAndReturnConfig

    def reset(self, belief: Belief, seed: int = 0) -> None:
        """Start an episode, at the pose that is to be returned to: in a team each robot's own."""
        super().reset(belief, seed)
        self._home = np.array(belief.pose, dtype=np.float64)

    def _forget(self) -> None:
        super()._forget()
        self._returning = False
        self._end = ""  # the status it has ended with

    # ---- choosing ------------------------------------------------------------------------------------------

    def choose(self, belief: Belief) -> Goal | None:
        """Return the next view point; with none left, the start; at the start, or given up, ``None``."""
        if not self._returning:
            goal = super().choose(belief)
            if goal is not None:
                return goal
            self._turn_back()
        return self._choose_home(belief)

    def _turn_back(self) -> None:
        homing = self.config.homing
        self._returning = True
        self._troubles.clear()  # what could not be seen has no bearing on the way back
        self._target = None
        # Aimed at more exactly than what counts as there: the last of the speed is still to be braked away.
        control = replace(
            self.config.control,
            arrived_m=0.6 * homing.arrived_m,
            arrived_rad=0.6 * homing.arrived_rad,
            arrival_m_s=homing.arrival_m_s,
        )
        body: dict[str, Any] = {"robot": self._robot, "lidar": self._lidar, "step_s": self._step_s}
        self._follower = _HomeFollower(control, home_rad=float(self._home[2]), **body)

    def _choose_home(self, belief: Belief) -> Goal | None:
        """Return the start as the goal: the way to it, or as near to it as the map allows."""
        patience = self.config.patience
        trouble = self._troubles.note(self._home[:2])
        if trouble.looks and not self._end:
            if self._is_home(belief):
                self._end = "returned"
            else:
                # The map lets it no nearer: that was an attempt, and what stands in the way is looked at anew.
                trouble.looks = 0
                trouble.failures += 1
                self._target = None
                self._recover_until = self._time + patience.recover_s
        if trouble.failures >= patience.attempts:
            self._end = "stuck"
        if self._end:
            self._target = None
            self._status = self._end
            return None
        path, cost = self._way_home(belief)
        if self._target is None:
            self._allow_time(cost)
        self._target = self._home[:2].copy()
        self._status = "returning"
        return Goal(pose=np.array([*path[-1], self._home[2]]), path=path)

    def _way_home(self, belief: Belief) -> tuple[Array, float]:
        """Return the path ``(n, 2)`` [m] to the start, or to the reachable place nearest to it, and its cost."""
        path, cost, away = self._way_near(self._home[:2], belief)
        if away <= max(self.config.homing.last_leg_m, self._cost_maps.of(belief).resolution):
            # The start itself for the centre of the cell. Where that cell is not the start's own, the robot has
            # stood there all the same, and the follower's safety check keeps it off the walls.
            path = np.vstack([path[: max(len(path) - 1, 1)], self._home[:2]])
        return path, cost

    def _is_home(self, belief: Belief) -> bool:
        pose = np.asarray(belief.pose, dtype=np.float64)
        near = float(np.hypot(*(pose[:2] - self._home[:2]))) <= self.config.homing.arrived_m
        return near and abs(geometry.wrap_scalar(pose[2] - self._home[2])) <= self.config.homing.arrived_rad

    def _makes_way(self, belief: Belief) -> bool:
        makes_way = super()._makes_way(belief)
        if makes_way and self._end == "returned":  # it goes back there
            self._end, self._troubles.note(self._home[:2]).looks = "", 0
        return makes_way

    # ---- driving -------------------------------------------------------------------------------------------

    def act(self, observation: Mapping[str, Any] | None, belief: Belief) -> Floats:
        """Return the next action on the way to the goal, choosing a goal when one is due."""
        action = super().act(observation, belief)
        if self._returning and self._status == "driving":
            self._status = "returning"
        return action

    def _is_frontier(self, belief: Belief, point: Array) -> bool:
        # On the way back the goal is no frontier, and stays what it is whatever is seen.
        return self._returning or super()._is_frontier(belief, point)


class _HomeFollower(PathFollower):
    """Ends with the start's heading, also where the sensor sees all round and would not need to turn."""

    # Beside a wall it fits with the heading it had there, hardly with the nose to the wall.
    _turn_within_m = 0.5  # of the start

    def __init__(self, config: ControlConfig, *, home_rad: float = 0.0, **body: Any) -> None:
        super().__init__(config, **body)
        self._home_rad = home_rad

    def set_path(self, path: Array, heading: float | None) -> None:
        super().set_path(path, self._home_rad)
