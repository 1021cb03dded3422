"""The team's tour with appointments: robots that do not hear each other meet again, and tell what they have seen.

All agree on it beforehand, so that no message is needed: they meet at the origin of the beliefs' frame, where the
first robot started, and each leaves off in time to be there. The time between two appointments doubles, for what
is left is farther and farther away. Who hears all the others has met them wherever they are.

Where starts are not known, each has a frame of its own, and comes back to where it started itself: that brings
together those that started side by side.
Appointments are the simplest way of exploring together under limited range (Roy and Dudek, "Collaborative robot
exploration and rendezvous", Autonomous Robots 2001).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from agents.base import Goal
from agents.teams.team_tour import TeamTour, TeamTourConfig
from slam.belief import Belief
from slam.settings import Config, Duration, Rate
from slam.types import Array, Floats

__all__ = ["AppointmentsConfig", "Rendezvous", "RendezvousConfig"]

_SPEED_SHARE = 0.5  # of a slow robot's speed, at which it drives to the meeting, about


@dataclass(frozen=True, kw_only=True)
class AppointmentsConfig(Config):
    """When robots meet."""

    every_s: Duration = 60.0  # from the beginning to the first; each interval is twice the one before
    wait_s: Duration = 10.0  # for those that are late
    speed_m_s: Rate = 0.4  # at which the way there is driven, about, and half a slow robot's speed at most


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
        self._place = np.zeros(2)  # where they meet
        self._next = 1  # number of the next appointment
        self._apart = False  # some robot that still explores is not heard now
        self._meeting = False  # on its way there, or waiting

    def choose(self, belief: Belief) -> Goal | None:
        """Return the next view point, or the meeting place when it is time."""
        if self._apart:
            there, cost = self._way_there(belief)
            speed_m_s = min(self.config.appointments.speed_m_s, _SPEED_SHARE * self._robot.max_speed_m_s)
            if self._time + cost / speed_m_s >= self._appointed_s(self._next):
                return self._set_off(there, cost)
        if self._meeting:
            self._target, self._meeting = None, False
        goal = super().choose(belief)
        if goal is None and self._apart:
            return self._set_off(*self._way_there(belief))  # the others may know of more
        return goal

    def _appointed_s(self, number: int) -> float:
        """Return when an appointment is [s]: each interval is twice the one before, to get twice as far."""
        return self.config.appointments.every_s * (2.0**number - 1.0)

    def _keep_book(self, observation: Mapping[str, Any] | None, belief: Belief) -> None:
        """Work out which appointment is the next; to be asked at every step.

        A group that hears each other is the same to all in it: at the step at which it is the whole team all
        know that they have met, and none goes to an appointment that another holds for kept.
        """
        others = 0 if observation is None else len(observation.get("teammates", ()))
        # Who has ended comes to no appointment.
        counted = sum(mate.ended or mate.heard_s < 0.5 * self._step_s for mate in belief.teammates)
        self._apart = counted < others
        last_s, next_s = self._appointed_s(self._next - 1), self._appointed_s(self._next)
        if self._apart:
            kept = self._time > next_s + self.config.appointments.wait_s  # in vain
        else:
            kept = self._time >= 0.5 * (last_s + next_s)  # as good as met
        self._next += kept

    def _way_there(self, belief: Belief) -> tuple[Goal, float]:
        """Return the meeting place, or the place nearest to it that can be reached, as a goal, and its cost."""
        path, cost, _ = self._way_near(self._place, belief)
        return Goal(pose=np.array([*path[-1], float(belief.pose[2])]), path=path), cost

    def _set_off(self, goal: Goal, cost: float) -> Goal:
        if not self._meeting:
            self._allow_time(cost)
        self._target, self._meeting, self._status = self._place, True, "driving"
        return goal

    def act(self, observation: Mapping[str, Any] | None, belief: Belief) -> Floats:
        """Return the next action on the way to the goal, choosing a goal when one is due."""
        self._keep_book(observation, belief)
        action = super().act(observation, belief)
        if self._meeting and self._status == "driving":
            self._status = "meeting"
        return action

    def _is_frontier(self, belief: Belief, point: Array) -> bool:
        return self._meeting or super()._is_frontier(belief, point)

    def _watch(self, belief: Belief) -> None:
        """Take no note of what it sees from the meeting place, nor of standing there."""
        # The others may stand on the very place.
        if self._meeting and self._follower.remaining_m <= self._giving_way.near_m:
            self._anchored_at, self._arrived_for = self._time, 0.0
        else:
            super()._watch(belief)

    def _put_off(self, target: Array, belief: Belief) -> None:
        if not self._meeting:  # an appointment is kept, as often as it does not get there
            super()._put_off(target, belief)
