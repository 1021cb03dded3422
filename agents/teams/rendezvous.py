"""The team's tour with appointments: robots that do not hear each other come together and tell what they know.

At fixed times, all begin to leave off in time to be at the meeting place, where the robots stood at the beginning;
whoever hears all others need not come. After Hourani, Hauck and Jennings, "Serial rendezvous of robots", and
de Hoog, Cameron and Visser, "Autonomous multi-robot exploration in communication-limited environments", TAROS 2010.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from agents.base import Goal
from agents.teams.team_tour import TeamTour, TeamTourConfig
from agents.ways.planning import travel_costs
from slam.belief import Belief
from slam.settings import positive

__all__ = ["AppointmentConfig", "Rendezvous", "RendezvousConfig"]

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class AppointmentConfig:
    """When robots meet."""

    every_s: float = 90.0  # between two appointments
    wait_s: float = 15.0  # for those that are late
    heard_s: float = 2.0  # robots heard so lately need not meet
    speed_m_s: float = 0.5  # at which the way there is driven, about

    def __post_init__(self) -> None:
        positive(self)


@dataclass(frozen=True, kw_only=True)
class RendezvousConfig(TeamTourConfig):
    """The team's tour, and when it is broken off."""

    appointments: AppointmentConfig = field(default_factory=AppointmentConfig)


class Rendezvous(TeamTour):
    """Explores as ``team-tour`` does, and keeps appointments with the robots that it does not hear."""

    config: RendezvousConfig
    config_type = RendezvousConfig

    def _forget(self) -> None:
        super()._forget()
        self._place: Array | None = None  # (2,) where to meet
        self._team: set[int] = set()  # numbers of all others that were ever known
        self._kept = 0  # the last appointment that is done with
        self._meeting = False

    def choose(self, belief: Belief) -> Goal | None:
        """Return the meeting place, where it is time; else the next view point."""
        if self._place is None:
            known = [belief.pose[:2], *(mate.pose[:2] for mate in belief.teammates)]
            self._place = np.mean(known, axis=0)
        self._team |= {mate.robot for mate in belief.teammates}
        goal = self._appointment(belief)
        self._meeting = goal is not None
        return super().choose(belief) if goal is None else goal

    def _appointment(self, belief: Belief) -> Goal | None:
        """Return the way to the next appointment, or ``None`` while there is time left or none is needed."""
        config, now = self.config.appointments, self._time
        heard = {mate.robot for mate in belief.teammates if mate.age_s <= config.heard_s}
        number = self._kept + 1
        if heard >= self._team or now > number * config.every_s + config.wait_s:
            # Met, or waited in vain: the next one is the next that is still to come.
            if now >= number * config.every_s - self._lead_s(belief):
                self._kept = max(number, math.floor(now / config.every_s))
            return None
        return None
