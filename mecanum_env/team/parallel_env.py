"""A team as a PettingZoo environment, in which all robots act at once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import numpy as np
from gymnasium import spaces

from mecanum_env.arguments import check_arguments
from mecanum_env.observation import Observation
from mecanum_env.team.member import Member
from mecanum_env.team.picture import render_team
from mecanum_env.team.team import Team
from slam.belief import Belief
from slam.files import quoted
from slam.settings import check_name, require
from slam.types import Array, Bytes, Floats

try:
    from pettingzoo import ParallelEnv
except ImportError as error:
    raise ImportError(
        "several robots as a PettingZoo environment need: pip install 'mecanum-slam[multi]'"
    ) from error

__all__ = ["ExploreParallelEnv"]

Action = Floats


class ExploreParallelEnv(ParallelEnv[str, Observation, Action]):  # type: ignore[misc]
    """Mecanum robots that explore one building together; ``mecanum_env.parallel_env(robots=3, …)`` makes it.

    Agents are called ``robot_0``, ``robot_1`` …; each is given the observation of a single robot's environment,
    its maps those of all that it knows, and ``teammates``. All are done when the team has covered its target.

    Parameters
    ----------
    render_mode : str, optional
        ``"rgb_array"``.
    **settings
        Of :class:`mecanum_env.team.team.Team`: ``robots``, ``team``, ``max_steps``, ``rooms``, ``slam`` ….
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - declared so by PettingZoo
        "name": "mecanum_explore_v0", "render_modes": ["rgb_array"], "render_fps": 10, "is_parallelizable": True,
    }  # fmt: skip

    def __init__(self, *, render_mode: str | None = None, **settings: Any) -> None:
        check_arguments(settings, ExploreParallelEnv, Team)
        if render_mode is not None:
            check_name("render_mode", render_mode, self.metadata["render_modes"])
        self.render_mode = render_mode
        self.team = Team(**settings)
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self.team.config.step_s)}
        self.possible_agents = [f"robot_{k}" for k in range(len(self.team.members))]
        self.agents: list[str] = []
        self._numbers = {name: k for k, name in enumerate(self.possible_agents)}

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return an agent's observation space, the same object each time."""
        return cast("spaces.Space[Any]", self.member(agent).observation_space)

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Return an agent's action space, the same object each time."""
        return self.member(agent).action_space

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Start an episode; see :meth:`mecanum_env.team.team.Team.reset`."""
        # PettingZoo's own test of the interface sends an option of this name.
        self.agents = []
        if isinstance(options, Mapping):
            options = {key: value for key, value in options.items() if key != "options"}
        found = self.team.reset(seed=seed, options=options)
        self.agents = self.possible_agents[:]
        return (
            {name: observation for name, (observation, _) in zip(self.agents, found, strict=True)},
            {name: info for name, (_, info) in zip(self.agents, found, strict=True)},
        )

    def step(
        self, actions: dict[str, Action]
    ) -> tuple[
        dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]
    ]:
        """Act for one control step; robots that are done leave ``agents``, and stand where they are."""
        names = self.possible_agents
        require(isinstance(actions, Mapping), f"actions must be a mapping by agent, got {quoted(actions)}")
        for name in actions:
            check_name("agent", name, names)
        for name in self.agents:
            require(name in actions, f"actions must have one of each of {self.agents}; that of {name} is missing")
        outcomes = self.team.step({self._numbers[name]: actions[name] for name in self.agents})
        for outcome in outcomes.values():
            # By this stable-baselines3 tells an end from a cut, where it adds the value of what would follow.
            outcome.info["TimeLimit.truncated"] = outcome.truncated and not outcome.terminated
        self.agents = [names[k] for k in self.team.active]
        return (
            {names[k]: outcome.observation for k, outcome in outcomes.items()},
            {names[k]: outcome.reward for k, outcome in outcomes.items()},
            {names[k]: outcome.terminated for k, outcome in outcomes.items()},
            {names[k]: outcome.truncated for k, outcome in outcomes.items()},
            {names[k]: outcome.info for k, outcome in outcomes.items()},
        )

    @property
    def np_random(self) -> np.random.Generator:
        """What draws the seeds of episodes; wrappers of SuperSuit draw from it, too."""
        return self.team.np_random

    def member(self, agent: str) -> Member:
        """Return the environment of one robot: its belief, truth and metrics."""
        check_name("agent", agent, self.possible_agents)
        return self.team.members[self._numbers[agent]]

    def belief(self, agent: str) -> Belief:
        """Return what a robot believes, its map that of all that it knows."""
        self._check_begun()
        return self.member(agent).belief

    def announce(self, agent: str, goal: Array | None) -> None:
        """Have a robot tell the others where it goes: a point ``(2,)`` [m] in its belief's frame, or nowhere."""
        self._check_begun()
        try:
            place = None if goal is None else np.array(goal, np.float64)
        except (TypeError, ValueError):
            place = np.full(2, np.nan)
        require(
            place is None or (place.shape == (2,) and bool(np.isfinite(place).all())),
            f"a goal must be two finite numbers x, y, got {quoted(goal)}",
        )
        self.member(agent).knowledge.goal = place

    def render(self) -> Bytes | None:
        """Return the true plan with all robots beside what they have mapped together, as an RGB image."""
        self._check_begun()
        return render_team(self.team) if self.render_mode == "rgb_array" else None

    def _check_begun(self) -> None:
        if not hasattr(self.team, "ground"):
            raise RuntimeError("call reset() first")

    def close(self) -> None:
        """Nothing is held open."""
