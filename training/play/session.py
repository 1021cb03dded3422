"""``mecanum play``: what is played. The rooms, the backend, and who drives; no window is needed for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

import agents
import slam
from agents.base import Agent
from mecanum_env import rooms as room_registry
from mecanum_env.arguments import make_config
from mecanum_env.config import EnvConfig
from mecanum_env.env import ExploreEnv
from mecanum_env.views.render import render_frame
from slam.files import plain_name
from training.episodes.explore import make_agent, meaning
from training.play.controls import Command
from training.runs.errors import bad_input, one_line
from training.runs.typed import LAST_SEED

__all__ = ["Session", "checked_config"]

T = TypeVar("T")


def checked_config(agent: str, **where: Any) -> EnvConfig:
    """Return where it is played, after :func:`mecanum_env.arguments.make_config`; nothing is made yet.

    Raises
    ------
    BadInput
        In one line: which option, file or name is wrong, the agent's among them, and what to do.
    """
    with bad_input():
        agents.check(agent)
        return make_config(**where)


class Session:
    """Episodes one after the other, each with its rooms and its backend, and whoever drives.

    An episode goes on for as long as somebody drives: all may be mapped, and no limit of time ends it. Where the
    first one is, is said as to :func:`mecanum_env.arguments.make_config`; the agent drives when asked to.

    Raises
    ------
    BadInput
        In one line: which option, file or name is wrong, and what to do.
    """

    env: ExploreEnv
    config: EnvConfig
    seed: int
    observation: Mapping[str, Any]
    info: Mapping[str, Any]
    agent: Agent | None = None
    """Who drives instead of a person."""
    trouble: str = ""
    """Why the last command could not be followed, or nothing."""

    def __init__(self, *, agent: str = "nearest-frontier", seed: int = 0, **where: Any) -> None:
        self.agent_name = agent
        config = checked_config(agent, **where)
        with bad_input():
            # A plan from a file is a kind of rooms of its own.
            self._kinds: list[tuple[str, str | None]] = [(name, None) for name in room_registry.names()]
            if config.floor_plan is not None:
                self._kinds.insert(0, (config.rooms, config.floor_plan))
            self._start(config, seed)
            self._make_agent(self.env, seed)  # its settings and policy are looked at now, not at the wheel

    # ---- what is there -------------------------------------------------------------------------------------

    @property
    def place(self) -> str:
        """The rooms and their seed, in words."""
        return _place(self.config, self.seed)

    @property
    def driver(self) -> str:
        """Who drives, in words."""
        return "You drive" if self.agent is None else f"Agent {self._short_name}"

    @property
    def driver_note(self) -> str:
        """What the driver is about, or how to change the driver, in words."""
        if self.trouble:
            return self.trouble
        if self.agent is None:
            return f"Space: let {self._short_name} drive"
        status = self.agent.status
        return f"{status}: {meaning(status)}" if self.agent.ended else f"{status} (Space: take the wheel)"

    @property
    def planned_path(self) -> NDArray[np.float64] | None:
        """The way ``(n, 2)`` that the agent means to go [m], where one drives."""
        return None if self.agent is None or self.agent.goal is None else self.agent.goal.path

    def frame(self) -> NDArray[np.uint8]:
        """Return the episode as it is now, as an RGB image ``(720, 1280, 3)``."""
        return render_frame(self.env, planned_path=self.planned_path)

    def summary(self) -> str:
        """Return how the episode stands, in one line."""
        info = self.info
        return (
            f"{self.place}, {self.config.slam}: {info['time_s']:.1f} s, coverage {100 * info['coverage']:.1f} %, "
            f"path {info['path_length_m']:.1f} m, collisions {info['collisions']}"
        )

    # ---- what happens --------------------------------------------------------------------------------------

    def step(self, action: NDArray[np.float32]) -> None:
        """Drive for one step: as the agent says where one drives, else by the action."""
        if self.agent is not None:
            action = self.agent.act(self.observation, self.env.belief)
        self.observation, _, _, _, self.info = self.env.step(action)

    def obey(self, command: Command) -> None:
        """Do what a key asks for; the episode stays as it is where that cannot be done (``trouble`` says why)."""
        self.trouble = ""
        if command is Command.HAND_OVER:
            self.agent = self._make_agent(self.env, self.seed) if self.agent is None else None
        elif (wanted := self._wanted(command)) is not None:
            try:
                self._start(*wanted)
            except ValueError as error:
                self.trouble = one_line(error)

    def preview(self, command: Command) -> str:
        """Return what a command starts, in words, or nothing."""
        wanted = self._wanted(command)
        return "" if wanted is None else f"{_place(*wanted)}, {wanted[0].slam}"

    def _wanted(self, command: Command) -> tuple[EnvConfig, int] | None:
        """Return the configuration and seed of the episode that a command asks for."""
        config, seed = self.config, self.seed
        match command:
            case Command.NEXT_BACKEND:
                config = replace(config, slam=_after(config.slam, slam.names()), slam_config={})
            case Command.NEXT_KIND:
                rooms, floor_plan = _after((config.rooms, config.floor_plan), self._kinds)
                config = replace(config, rooms=rooms, rooms_config={}, floor_plan=floor_plan)
            case Command.NEXT_ROOM:
                seed = min(seed + 1, LAST_SEED)
            case Command.PREVIOUS_ROOM:
                seed = max(seed - 1, 0)
            case Command.RESTART:
                pass
            case _:
                return None
        return config, seed

    def _start(self, config: EnvConfig, seed: int) -> None:
        env = ExploreEnv(config=config)
        observation, info = env.reset(seed=seed)
        agent = None if self.agent is None else self._make_agent(env, seed)
        self.env, self.config, self.seed, self.agent = env, config, seed, agent
        self.observation, self.info = observation, info

    def _make_agent(self, env: ExploreEnv, seed: int) -> Agent:
        """Return the agent, told of the belief as it is now: it may take over anywhere."""
        agent = make_agent(self.agent_name, env)
        agent.reset(env.belief, seed)
        return agent

    @property
    def _short_name(self) -> str:
        return Path(self.agent_name).stem if self.agent_name.endswith(".safetensors") else self.agent_name


def _place(config: EnvConfig, seed: int) -> str:
    rooms = config.rooms if config.floor_plan is None else Path(config.floor_plan).name
    return f"{plain_name(rooms)}, seed {seed}"


def _after(item: T, items: Sequence[T]) -> T:
    """Return what follows an item, the first after the last."""
    return items[(items.index(item) + 1) % len(items)]
