"""``ExploreFrontier-v0`` over families of rooms, and the heuristics that a policy may begin with."""

from __future__ import annotations

from typing import Any, SupportsInt

import gymnasium
import numpy as np
from numpy.typing import NDArray

import agents
from agents.cost_utility import CostUtility
from agents.explorer import Candidates
from agents.frontier_env import ExploreFrontierEnv
from agents.tour import Tour
from mecanum_env import rooms as room_registry
from training.train_config import WorldConfig

__all__ = ["Families", "Teacher", "make_world"]


class Families(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Draws a family of rooms and one of its training seeds for each episode.

    A seed given to ``reset`` is where the drawing starts; ``options={"rooms": name, "room_seed": n}`` sets both.
    """

    env: ExploreFrontierEnv

    def __init__(self, env: ExploreFrontierEnv, world: WorldConfig) -> None:
        super().__init__(env)
        self._world = world
        self._rng = np.random.default_rng(0)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode in rooms of the next draw."""
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        low, high = self._world.seeds
        name = str(self._rng.choice(list(self._world.rooms)))
        room_seed = int(self._rng.integers(low, high + 1))
        episode_seed = int(self._rng.integers(2**31))
        if options:
            name, room_seed = options["rooms"], options["room_seed"]
            episode_seed = room_seed  # as the benchmark has it
        plan = room_registry.make(name, seed=room_seed)
        self.family = name
        observation, info = self.env.reset(seed=episode_seed, options={"floor_plan": plan})
        return observation, info

    def action_masks(self) -> NDArray[np.bool_]:
        """Return which actions stand for a candidate."""
        return self.env.action_masks()


def make_world(world: WorldConfig, index: int = 0, *, discount: float = 1.0) -> Families:
    """Return environment number ``index`` of a training run."""
    env = ExploreFrontierEnv(
        rooms=world.rooms[0], slam=world.slam, noise=world.noises[index % len(world.noises)],
        driver=dict(world.driver), discount=discount,
        reward={
            "area": world.area_1_m2, "pose_entropy": 0.0, "map_entropy": 0.0, "collision": world.collision,
            "effort": 0.0, "time": world.time_1_s,
        },
        config={"time_limit_s": world.time_limit_s},
    )  # fmt: skip
    return Families(env, world)


class Teacher:
    """A heuristic, asked what it would choose of what the environment offers."""

    def __init__(self, name: str, env: ExploreFrontierEnv) -> None:
        base = env.config
        made = agents.make(
            name, config={key: value for key, value in _shared(env).items()}, robot=base.robot, lidar=base.lidar,
            step_s=base.step_s,
        )  # fmt: skip
        assert isinstance(made, CostUtility | Tour)
        self._agent, self._env = made, env

    def __call__(self) -> SupportsInt:
        """Return the action."""
        env, agent = self._env, self._agent
        choice, found = env.agent.described
        index = self._pick(agent, found)
        at = np.flatnonzero(choice.index == index)
        return int(at[0]) if len(at) else 0

    def _pick(self, agent: CostUtility | Tour, found: Candidates) -> int:
        if isinstance(agent, CostUtility):
            return agent.pick(found, self._env.belief)
        return agent._by_views(found, np.flatnonzero(np.isfinite(found.costs)))


def _shared(env: ExploreFrontierEnv) -> dict[str, Any]:
    return {"frontiers": env.driver.frontiers, "planner": env.driver.planner, "control": env.driver.control}
