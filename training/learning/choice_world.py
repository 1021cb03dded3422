"""``ExploreFrontier-v0`` and its rehearsal over families of rooms, and the heuristics to begin with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, SupportsInt

import gymnasium
import numpy as np
from numpy.typing import NDArray

import agents
from agents.cost_utility import CostUtility
from agents.explorer import Candidates
from agents.frontier_env import ExploreFrontierEnv
from agents.learned.choice import SIDEWAYS, Choice
from agents.tour import Tour
from mecanum_env import rooms as room_registry
from training.episodes.true_places import TruePlaces
from training.learning.config import RehearsalConfig, WorldConfig
from training.learning.hindsight import Hindsight
from training.learning.jump_world import JumpWorld
from training.runs.campaign import start_worker

__all__ = ["Families", "Teacher", "make_rehearsal", "make_world", "mirrored", "world_of_worker"]


class Families(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Draws a family of rooms and one of its training seeds, for as many episodes as ``world.repeats`` says.

    A seed given to ``reset`` is where the drawing starts; ``options={"rooms": name, "room_seed": n}`` sets both,
    and other options are passed on. With ``mirrors`` every other episode, by chance, is seen in a mirror.
    """

    env: ExploreFrontierEnv | JumpWorld
    _hindsight: Hindsight | None
    _priced: tuple[Choice, NDArray[np.float32]] | None  # the last choice, and what was made of it

    def __init__(self, env: ExploreFrontierEnv | JumpWorld, world: WorldConfig, *, mirrors: bool = False) -> None:
        super().__init__(env)
        self._world, self._mirrors, self._mirrored = world, mirrors, False
        self._rng = np.random.default_rng(0)
        self._room, self._episodes = ("", -1), 0  # the room drawn last, and how many episodes there were in it
        self._places: dict[tuple[str, int], TruePlaces] = {}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode in rooms of the next draw."""
        if seed is not None:
            self._rng, self._episodes = np.random.default_rng(seed), 0
        if self._episodes % self._world.repeats == 0:
            low, high = self._world.seeds
            name = str(self._rng.choice(list(self._world.rooms)))
            room_seed = int(self._rng.integers(low, high + 1))
        else:
            name, room_seed = self._room
        self._episodes += 1
        episode_seed = int(self._rng.integers(2**31))
        self._mirrored = self._mirrors and self._rng.random() < 0.5
        passed_on = dict(options or {})
        if passed_on:
            name, room_seed = passed_on.pop("rooms"), passed_on.pop("room_seed")
            episode_seed, self._mirrored = room_seed, False  # as the benchmark has it
        if self._room != (name, room_seed):
            self._plan = room_registry.make(name, seed=room_seed)
        self._room, self._hindsight, self._priced = (name, room_seed), None, None
        observation, info = self.env.reset(seed=episode_seed, options={"floor_plan": self._plan, **passed_on})
        self._potential = self._worth(observation)
        return self._seen(observation), info

    def _seen(self, observation: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        return mirrored(observation) if self._mirrored else observation

    def step(self, action: SupportsInt) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step; the reward is shaped by what is still to go, by hindsight, if the configuration says so.

        The shaping is the difference of a potential (Ng, Harada and Russell, ICML 1999), 0 at the end: what is
        best to do stays the same, and a choice's part in how long it takes is felt at once.
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        before, self._potential = self._potential, 0.0 if terminated else self._worth(observation)
        shaped = float(reward) + self._potential - before
        return self._seen(observation), shaped, terminated, truncated, info

    def _worth(self, observation: dict[str, NDArray[Any]]) -> float:
        world = self._world
        if world.shaping_s_m == 0.0 or not observation["present"].any():
            return 0.0
        if isinstance(self.env, JumpWorld):  # where all prices would take as long as the choice itself
            price = self._by_truth().price_from_here(self.env.belief)
        else:
            price = float(self.prices().min())
        return world.time_1_s * world.shaping_s_m * price

    @property
    def whole(self) -> ExploreFrontierEnv:
        """The environment, where it is no rehearsal."""
        assert isinstance(self.env, ExploreFrontierEnv)
        return self.env

    def prices(self) -> NDArray[np.float32]:
        """Return what each candidate would cost by the truth ``(m,)`` [weighted m]: for teaching only."""
        env = self.whole
        choice, found = env.agent.described
        if self._priced is not None and self._priced[0] is choice:
            return self._priced[1]
        prices = self._by_truth().prices(choice, found, env.belief)
        self._priced = choice, prices
        return prices

    def _by_truth(self) -> Hindsight:
        """Return what prices this episode's choices."""
        env = self.env
        if self._hindsight is None:
            if self._room not in self._places:
                self._places.clear()  # rooms drawn before hardly ever come again
                ground, kit = (
                    (env.ground, env) if isinstance(env, JumpWorld) else (env.base.truth.ground, env.config)
                )
                self._places[self._room] = TruePlaces(ground, env.driver.planner, robot=kit.robot, lidar=kit.lidar)
            self._hindsight = Hindsight(self._places[self._room])
        return self._hindsight

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


def make_rehearsal(world: WorldConfig, rehearsal: RehearsalConfig) -> Families:
    """Return an environment of a rehearsal: the same families of rooms, explored in jumps."""
    patience = {**world.driver.get("patience", {}), "replan_s": rehearsal.replan_s}
    env = JumpWorld(
        driver={**world.driver, "patience": patience}, time_limit_s=world.time_limit_s, time_1_s=world.time_1_s,
        covered_1=rehearsal.covered_1,
    )  # fmt: skip
    return Families(env, replace(world, shaping_s_m=rehearsal.shaping_s_m), mirrors=True)


def world_of_worker(make: Callable[[], Families]) -> Families:
    """Make an environment in a process of its own."""
    start_worker()
    return make()


def mirrored(
    observation: dict[str, NDArray[Any]], turned: NDArray[np.bool_] | bool = True
) -> dict[str, NDArray[Any]]:
    """Return a choice, or as many as ``turned`` ``(n,)`` says of n, as seen in a mirror: left is right."""
    rows, patches = observation["candidates"].copy(), observation["patches"]
    sign = np.where(turned, np.float32(-1.0), np.float32(1.0))[..., None, None]
    rows[..., SIDEWAYS] *= sign
    patches = np.where(np.asarray(turned)[..., None, None, None, None], np.flip(patches, axis=-2), patches)
    return observation | {"candidates": rows, "patches": patches}


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

    def begin(self) -> None:
        """Forget the last episode."""
        self._agent.reset(self._env.belief)

    def __call__(self) -> SupportsInt:
        """Return the action."""
        env, agent = self._env, self._agent
        choice, found = env.agent.described
        index = self._pick(agent, found)
        # Pieces at one view point are one candidate.
        at = np.flatnonzero((found.cells[choice.index] == found.cells[index]).all(axis=1))
        return int(at[0]) if len(at) else 0

    def _pick(self, agent: CostUtility | Tour, found: Candidates) -> int:
        if isinstance(agent, CostUtility):
            return agent.pick(found, self._env.belief)
        return agent._by_views(found, np.flatnonzero(np.isfinite(found.costs)))


def _shared(env: ExploreFrontierEnv) -> dict[str, Any]:
    return {"frontiers": env.driver.frontiers, "planner": env.driver.planner, "control": env.driver.control}
