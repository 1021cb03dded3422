"""The team's tour with appointments: robots that do not hear each other meet again, and tell what they have seen.

All agree on it beforehand, so that no message is needed: every so often they meet where they stood at the
beginning, and each leaves off in time to be there. Who hears all the others has met them wherever they are.
Appointments are the simplest way of exploring together under limited range (Roy and Dudek, "Collaborative robot
exploration and rendezvous", Autonomous Robots 2001).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.base import Goal
from agents.teams.team_tour import TeamTour, TeamTourConfig
from slam.belief import Belief
from slam.settings import Config, Duration, Rate
from slam.types import Array

__all__ = ["AppointmentsConfig", "Rendezvous", "RendezvousConfig"]


@dataclass(frozen=True, kw_only=True)
class AppointmentsConfig(Config):
    """When robots meet."""

    every_s: Duration = 60.0  # from the beginning on
    wait_s: Duration = 10.0  # for those that are late
    heard_s: Duration = 2.0  # who was heard so lately is there
    speed_m_s: Rate = 0.4  # at which the way there is driven, about


@dataclass(frozen=True, kw_only=True)
class RendezvousConfig(TeamTourConfig):
    """The team's tour, and when it is broken off."""

    appointments: AppointmentsConfig = field(default_factory=AppointmentsConfig)


class Rendezvous(TeamTour):
    """Explores as ``team-tour`` does, and meets the robots that it does not hear; with nothing left to do, too."""

    config: RendezvousConfig
    config_type = RendezvousConfig

    def _forget(self) -> None:
        super()._forget()
        self._place: Array | None = None  # (2,) where they meet
        self._team: set[int] = set()  # numbers of all others that were ever known
        self._next = 1  # number of the next appointment
        self._meeting = False  # on its way there, or waiting

    def choose(self, belief: Belief) -> Goal | None:
        """Return the next view point, or the meeting place when it is time."""
        if self._place is None:
            stood = np.array([belief.pose[:2], *(mate.pose[:2] for mate in belief.teammates)], np.float64)
            self._place = stood.mean(axis=0)
        self._team |= {mate.robot for mate in belief.teammates}
        config = self.config.appointments
        heard = {mate.robot for mate in belief.teammates if mate.age_s <= config.heard_s}
        at_s = self._next * config.every_s
        if heard == self._team:  # as good as met
            self._next = max(self._next, math.floor(self._time / config.every_s + 0.5) + 1)
        elif self._time > at_s + config.wait_s:  # in vain
            self._next = math.floor(self._time / config.every_s) + 1
        else:
            there, cost = self._way_there(belief)
            if self._time + cost / config.speed_m_s >= at_s:
                return self._set_off(there, cost)
        if self._meeting:
            self._target, self._meeting = None, False
        goal = super().choose(belief)
        if goal is None and heard != self._team and self._time < self._next * config.every_s + config.wait_s:
            return self._set_off(*self._way_there(belief))  # the others may know of more
        return goal

    def _way_there(self, belief: Belief) -> tuple[Goal, float]:
        """Return the meeting place, or the place nearest to it that can be reached, as a goal, and its cost."""
        assert self._place is not None
        path, cost, _ = self._way_near(self._place, belief)
        return Goal(pose=np.array([*path[-1], float(belief.pose[2])]), path=path), cost

    def _set_off(self, goal: Goal, cost: float) -> Goal:
        if not self._meeting:
            self._deadline = self._time + 10.0 + cost / self.config.patience.slowest_m_s
            self._arrived_for = 0.0
        self._target, self._meeting, self._status = self._place, True, "driving"
        return goal

    def act(self, observation: Mapping[str, Any] | None, belief: Belief) -> NDArray[np.float32]:
        """Return the next action on the way to the goal, choosing a goal when one is due."""
        action = super().act(observation, belief)
        if self._meeting and self._status == "driving":
            self._status = "meeting"
        return action

    def _is_frontier(self, belief: Belief, point: Array) -> bool:
        return self._meeting or super()._is_frontier(belief, point)

    def _watch(self, belief: Belief) -> None:
        """Take no note of what it sees from the meeting place, nor of standing there."""
        # The others may stand on the very place.
        if self._meeting and self._follower.remaining_m <= self.config.giving_way.near_m:
            self._anchored_at, self._arrived_for = self._time, 0.0
        else:
            super()._watch(belief)

    def _put_off(self, target: Array, belief: Belief) -> None:
        if not self._meeting:  # an appointment is kept, as often as it does not get there
            super()._put_off(target, belief)
