"""``mecanum play --robots N``: the first robot is the person's, the others are driven by agents."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.base import Agent
from mecanum_env.config import EnvConfig
from mecanum_env.team.config import TeamConfig
from mecanum_env.team.picture import render_team
from mecanum_env.team.team import Team
from training.episodes.team import tell_goal
from training.play.session import Session

__all__ = ["TeamSession"]

_NO_END = 10**9  # steps


class TeamSession(Session):
    """A :class:`Session`, with its options, in which others explore, too."""

    team: Team

    def __init__(self, *, team: TeamConfig, **options: Any) -> None:
        self._setting = team
        super().__init__(**options)

    @property
    def driver(self) -> str:
        """Who drives, in words."""
        return "You drive the blue one" if self.agent is None else f"Agents {self._short_name}"

    def frame(self) -> NDArray[np.uint8]:
        """Return the team as it is now, as an RGB image ``(720, 1280, 3)``."""
        return render_team(self.team)

    def step(self, action: NDArray[np.float32]) -> None:
        """Drive for one step: the first robot by the action, or by its agent where that drives."""
        team, drivers = self.team, [self.agent, *self._others]
        actions = {}
        for k, (driver, member) in enumerate(zip(drivers, team.members, strict=True)):
            actions[k] = action if driver is None else driver.act(self._observations[k], member.belief)
            tell_goal(team, k, None if driver is None else driver.goal)
        team.active = list(actions)  # an episode goes on for as long as it is played
        for k, outcome in team.step(actions).items():
            self._observations[k] = outcome.observation
            if k == 0:
                self._take(outcome.info)

    def _take(self, info: Mapping[str, Any]) -> None:
        self.observation = self._observations[0]
        self.info = {**info, "coverage": info["team_coverage"]}

    def _start(self, config: EnvConfig, seed: int) -> None:
        endless = replace(config, coverage_target=1.0, terminate_on_collision=False)
        team = Team(team=self._setting, config=endless, max_steps=_NO_END)
        found = team.reset(seed=seed)
        first, *rest = team.members
        agent = None if self.agent is None else self._make_agent(first, seed)
        self._others: list[Agent] = [self._make_agent(member, seed + member.number) for member in rest]
        self.team, self.env, self.config, self.seed, self.agent = team, first, config, seed, agent
        self._observations: list[Mapping[str, Any]] = [observation for observation, _ in found]
        self._take(found[0][1])
