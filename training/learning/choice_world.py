"""``ExploreFrontier-v0`` and its rehearsal over families of rooms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, SupportsIndex

import gymnasium
import numpy as np
from numpy.typing import NDArray

from agents.frontier_env import ExploreFrontierEnv
from agents.learned.choice import SIDEWAYS
from mecanum_env import rooms as room_registry
from mecanum_env.config import EnvConfig
from training.learning.config import RehearsalConfig, RoomsConfig, WorldConfig
from training.learning.hindsight import Hindsight
from training.learning.jump_world import JumpWorld, discounted_s
from training.runs.processes import start_worker
from training.truth.places import TruePlaces

__all__ = ["Families", "Rehearsal", "Whole", "make_rehearsal", "make_world", "mirrored", "world_of_worker"]


class Families(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Draws a family of rooms and one of its training seeds, for as many episodes as ``world.repeats`` says.

    A seed given to ``reset`` is where the drawing starts; ``options={"rooms": name, "room_seed": n}`` sets both,
    and other options are passed on.
    """

    env: Any

    def __init__(self, env: gymnasium.Env[Any, Any], world: RoomsConfig) -> None:
        super().__init__(env)
        self._world = world
        self._rng = np.random.default_rng(0)
        self._drawn, self._episodes = ("", -1), 0  # the room drawn last, and how many episodes there were in all
        self._room = self._drawn  # the one whose plan is at hand

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode in rooms of the next draw."""
        if seed is not None:
            self._rng, self._episodes = np.random.default_rng(seed), 0
        if self._episodes % self._world.repeats == 0:
            low, high = self._world.seeds
            name = str(self._rng.choice(list(self._world.rooms)))
            self._drawn = name, int(self._rng.integers(low, high + 1))
        name, room_seed = self._drawn
        self._episodes += 1
        episode_seed = int(self._rng.integers(2**31))
        passed_on = dict(options or {})
        if passed_on:
            name, room_seed = passed_on.pop("rooms", name), passed_on.pop("room_seed", room_seed)
            episode_seed = room_seed  # as the benchmark has it
        if self._room != (name, room_seed):
            self._plan = room_registry.make(name, seed=room_seed)
        self._room = (name, room_seed)
        observation, info = self.env.reset(seed=episode_seed, options={"floor_plan": self._plan, **passed_on})
        return observation, info

    def action_masks(self) -> NDArray[np.bool_]:
        """Return which actions stand for a candidate."""
        masks: NDArray[np.bool_] = self.env.action_masks()
        return masks


class Whole(Families):
    """Families of rooms explored in ``ExploreFrontier-v0``.

    An episode that ends with nothing left to choose before 95 % are mapped is charged with the time until the
    limit, as in rehearsals and trials: else to give up would pay. That time is discounted by ``gamma`` a second,
    as the environment's own reward is.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], world: RoomsConfig, *, gamma: float = 1.0) -> None:
        super().__init__(env, world)
        self._gamma = gamma

    def step(self, action: SupportsIndex) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        if terminated and not info["is_success"]:
            left = discounted_s(self._world.time_limit_s - info["time_s"], self._gamma)
            reward += self._gamma ** info["duration_s"] * self._world.time_1_s * left
        return observation, reward, terminated, truncated, info


class Rehearsal(Families):
    """Families of rooms explored in jumps: every other episode, by chance, in a mirror, and the reward shaped.

    The shaping is the difference of a potential (Ng, Harada and Russell, ICML 1999), what is still to go by
    hindsight, 0 at the end, discounted as what follows is: what is best to do stays the same, and a choice's part
    in how long it takes is felt at once.
    """

    env: JumpWorld

    def __init__(self, env: JumpWorld, world: WorldConfig, *, shaping_s_m: float) -> None:
        super().__init__(env, world)
        self._shaping, self._mirrored = world.time_1_s * shaping_s_m, False
        self._places: dict[tuple[str, int], TruePlaces] = {}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode in rooms of the next draw; where they are set, it is seen as it is."""
        observation, info = super().reset(seed=seed, options=options)
        self._mirrored = self._rng.random() < 0.5 and not options
        self._hindsight: Hindsight | None = None
        self._potential = self._worth(observation)
        return self._seen(observation), info

    def step(self, action: SupportsIndex) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step; the reward is shaped by what is still to go."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        before, self._potential = self._potential, 0.0 if terminated else self._worth(observation)
        shaped = float(reward) + self.env.gamma ** info["duration_s"] * self._potential - before
        return self._seen(observation), shaped, terminated, truncated, info

    def _seen(self, observation: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        return mirrored(observation) if self._mirrored else observation

    def _worth(self, observation: dict[str, NDArray[Any]]) -> float:
        if self._shaping == 0.0 or not observation["present"].any():
            return 0.0
        return self._shaping * self.price_from_here()

    def price_from_here(self) -> float:
        """Return what all that is left costs from where the robot is, by the truth [weighted m]."""
        env = self.env
        if self._hindsight is None:
            if self._room not in self._places:
                # Rooms drawn before hardly ever come again.
                places = TruePlaces(env.ground, env.driver.planner, robot=env.robot, lidar=env.lidar)
                self._places = {self._room: places}
            self._hindsight = Hindsight(self._places[self._room])
        return self._hindsight.price_from_here(env.belief)


def make_world(world: WorldConfig, index: int = 0, *, gamma: float = 1.0) -> Families:
    """Return environment number ``index`` of a training run; its reward is discounted by ``gamma`` a second."""
    config = EnvConfig(time_limit_s=world.time_limit_s)
    env = ExploreFrontierEnv(
        rooms=world.rooms[0], slam=world.slam, noise=world.noises[index % len(world.noises)],
        driver=dict(world.driver), reward=world.reward, config=config, discount=gamma**config.step_s,
    )  # fmt: skip
    return Whole(env, world, gamma=gamma)


def make_rehearsal(world: WorldConfig, rehearsal: RehearsalConfig) -> Rehearsal:
    """Return an environment of a rehearsal: the same families of rooms, explored in jumps."""
    patience = {**world.driver.get("patience", {}), "replan_s": rehearsal.replan_s}
    env = JumpWorld(
        driver={**world.driver, "patience": patience}, time_limit_s=world.time_limit_s, time_1_s=world.time_1_s,
        gamma=rehearsal.gamma,
    )  # fmt: skip
    return Rehearsal(env, world, shaping_s_m=rehearsal.shaping_s_m)


def world_of_worker(make: Callable[[], Families]) -> Families:
    """Make an environment in a process of its own."""
    start_worker()
    return make()


def mirrored(observation: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return a choice as seen in a mirror: left is right."""
    rows = observation["candidates"].copy()
    rows[..., SIDEWAYS] *= -1.0
    return observation | {"candidates": rows, "patches": np.flip(observation["patches"], axis=-2)}
