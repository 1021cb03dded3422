"""Other simulators under the same load, for ``mecanum speed --peer``: the same walls, beams and step, in turn.

The peer runs in a process of its own, which waits while our environment is timed and is timed while ours waits:
whatever else the machine does slows both alike.

navground (https://idsia-robotics.github.io/navground) has mecanum kinematics, walls, noisy lidar and odometry,
and a local grid map; it has neither the dynamics of wheels and motors nor SLAM, and its robot is a disc.
"""

from __future__ import annotations

import atexit
import importlib
import multiprocessing
import os
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from slam.settings import check_name
from training.runs.errors import one_line
from training.runs.processes import start_worker

if TYPE_CHECKING:
    from mecanum_env.config import EnvConfig
    from mecanum_env.rooms import FloorPlan

__all__ = ["BATCHES", "PEERS", "ROUNDS", "Drive", "compare", "peer_batch", "peer_process", "peer_setup", "require"]

PEERS: dict[str, tuple[str, ...]] = {"navground": ("navground", "navground-learning")}
"""Peers by name: the distributions that must be installed."""

ROUNDS = 5
"""How often each side is measured; odd, so that the median is a round that took place."""

BATCHES = ("sync", "async")
"""Gymnasium's ways of stepping many environments at once."""

_MAP_CELLS = 200  # the peer's map is a square around the robot, of this many cells a side
_WARM_UP_STEPS = 50


@dataclass(frozen=True, kw_only=True)
class Drive:
    """One episode to measure: a room, and how many steps in it."""

    seed: int
    steps: int
    plan: FloorPlan


def require(peer: str) -> dict[str, str]:
    """Return the versions of a peer's distributions; ``ValueError`` tells how to install what is missing."""
    check_name("peer", peer, PEERS)
    try:
        return {name: version(name) for name in PEERS[peer]}
    except PackageNotFoundError as error:
        raise ValueError(
            f'{peer} is not installed ({error.name} is missing); run `pip install "mecanum-slam[peers]"`'
        ) from error


def peer_setup(config: EnvConfig) -> dict[str, Any]:
    """Return, ready for JSON, what the peer is told of our environment; SI units.

    Left to our side alone, for want of a counterpart: lost beams, the least range, errors of the wheels' radii
    and lever, slip, and friction. The disc is the one around our footprint.
    """
    robot, lidar, noise = config.robot, config.lidar, config.noise
    return {
        "step_s": config.step_s,
        "radius_m": robot.circumscribed_radius_m,
        "lever_m": robot.lever_m,
        "max_speed_m_s": robot.max_speed_m_s,
        "max_turn_rate_rad_s": robot.max_turn_rate_rad_s,
        "beams": lidar.beams,
        "angle_min_rad": lidar.angle_min,
        # navground's first and last beam lie at the ends of the field of view, on a full circle too.
        "field_of_view_rad": lidar.angle_increment * (lidar.beams - 1),
        "range_max_m": lidar.range_max_m,
        "lidar_offset_m": lidar.offset_m,
        "range_sigma_m": noise.range_sigma_m,
        # Our encoders err by a share of the motion; theirs by a constant: the same at full speed.
        "speed_sigma_m_s": noise.encoder * robot.max_speed_m_s,
        "turn_rate_sigma_rad_s": noise.encoder * robot.max_turn_rate_rad_s,
        "map_cells": _MAP_CELLS,
        "map_resolution_m": config.grid_resolution_m,
    }


def compare(peer: str, config: EnvConfig, *, drives: Sequence[Drive], ours: Callable[[], float]) -> dict[str, Any]:
    """Measure ours and the peer in turn, :data:`ROUNDS` times; every round drives all of ``drives``, ours first.

    ``ours`` drives them once in our environment and returns its complete steps per second.

    Returns
    -------
    dict
        ``name``, ``versions``, the medians ``ours_steps_per_second`` and ``steps_per_second`` (the peer's),
        ``ratio`` (ours over theirs), ``rounds`` (the same by round), ``steps`` a round and side, ``setup``.

    Raises
    ------
    ValueError
        If the peer is unknown or not installed.
    RuntimeError
        If the peer's process breaks down.
    """
    versions, setup = require(peer), peer_setup(config)
    measured: list[dict[str, float]] = []
    with peer_process(setup, drives) as (ready, their_rate):
        for _ in range(ROUNDS):
            our_rate = ours()
            measured.append({"ours": our_rate, "theirs": their_rate()})
    our_median, their_median = (statistics.median(r[side] for r in measured) for side in ("ours", "theirs"))
    return {
        "name": peer,
        "versions": versions,
        "ours_steps_per_second": our_median,
        "steps_per_second": their_median,
        "ratio": our_median / their_median,
        "rounds": measured,
        "steps": sum(drive.steps for drive in drives),
        "setup": setup | {"walls": ready["walls"], "discs": ready["discs"], "actions": "random"},
    }


@contextmanager
def peer_process(
    setup: dict[str, Any], drives: Sequence[Drive]
) -> Iterator[tuple[dict[str, Any], Callable[[], float]]]:
    """Give what the peer makes of it, in a process of its own, and what drives one round there.

    The former: ``walls`` and ``discs`` (in the first room), and ``scan``, the ranges [m] that its lidar measures
    at the first start. The latter returns the peer's complete steps per second.
    """
    with _own_process() as ask:
        yield ask(_get_ready, setup, drives), lambda: float(ask(_drive_round))


@contextmanager
def peer_batch(setup: dict[str, Any], drives: Sequence[Drive]) -> Iterator[Callable[[], dict[str, float]]]:
    """Give what steps one of the peer's environments a drive, all at once, by each of Gymnasium's two ways.

    It returns the complete steps per second of all together, by way; the peer has no other way of its own that
    goes without more packages.
    """
    with _own_process() as ask:
        ask(_get_batch_ready, setup, drives)
        yield lambda: {way: float(ask(_drive_batch, way)) for way in BATCHES}
        ask(_close_batch)


@contextmanager
def _own_process() -> Iterator[Callable[..., Any]]:
    """Give what calls a function in the peer's process."""

    def ask(what: Callable[..., Any], *load: Any) -> Any:
        try:
            return pool.submit(what, *load).result()
        except Exception as error:
            raise RuntimeError(f"the peer broke down: {type(error).__name__}: {one_line(error)}") from error

    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context, initializer=_become_peer) as pool:
        yield ask


# ---- in the peer's process ---------------------------------------------------------------------------------


def _become_peer() -> None:
    start_worker()
    os.dup2(2, 1)  # what libraries print goes to standard error
    atexit.register(os._exit, 0)  # navground's library may crash while the interpreter takes itself down


def _navground_env(setup: dict[str, Any], drives: Sequence[Drive]) -> Any:
    """Return navground_learning's Gymnasium environment: the rooms by seed, one mecanum robot, its sensors."""
    import gymnasium

    core, sim = (importlib.import_module(f"navground.{name}") for name in ("core", "sim"))
    importlib.import_module("navground.learning.env")
    learning = importlib.import_module("navground.learning.config")
    rooms = {drive.seed: drive.plan for drive in drives}

    def build(world: Any, seed: int | None) -> None:
        plan = rooms.get(drives[0].seed if seed is None else seed, drives[0].plan)
        for x1, y1, x2, y2 in plan.segments.tolist():
            world.add_wall(sim.Wall((x1, y1), (x2, y2)))
        for x, y, radius in plan.circles.tolist():
            world.add_obstacle(sim.Obstacle((x, y), radius))
        kinematics = core.kinematics.FourWheelsOmniDriveKinematics(setup["max_speed_m_s"], setup["lever_m"])
        behavior = core.behaviors.DummyBehavior(kinematics, setup["radius_m"])
        agent = sim.Agent(setup["radius_m"], behavior, kinematics, control_period=setup["step_s"])
        agent.position, agent.orientation = plan.start[:2], plan.start[2]
        world.add_agent(agent)

    scenario = sim.Scenario()
    scenario.add_init(build)
    return gymnasium.make(
        "navground",
        scenario=scenario,
        sensors=_navground_sensors(setup),
        # As ours: a body twist, as fractions of the robot's limits.
        action=learning.ControlActionConfig(
            max_speed=setup["max_speed_m_s"], max_angular_speed=setup["max_turn_rate_rad_s"]
        ),
        observation=learning.DefaultObservationConfig(include_target_direction=False),
        time_step=setup["step_s"],
        terminate_if_idle=False,  # with no target to go to, the robot always counts as idle
        include_action=False,  # the action of navground's own controller, which ours has no like of
        max_episode_steps=max(drive.steps for drive in drives) + 1,
    )


def _navground_sensors(setup: dict[str, Any]) -> list[dict[str, Any]]:
    lidar = {
        "type": "Lidar",
        "name": "lidar",
        "range": setup["range_max_m"],
        "start_angle": setup["angle_min_rad"],
        "field_of_view": setup["field_of_view_rad"],
        "resolution": setup["beams"],
        "error_std_dev": setup["range_sigma_m"],
        "position": [setup["lidar_offset_m"], 0.0],
    }
    odometry = {
        "type": "Odometry",
        "name": "odometry",
        "longitudinal_speed_std_dev": setup["speed_sigma_m_s"],
        "transversal_speed_std_dev": setup["speed_sigma_m_s"],
        "angular_speed_std_dev": setup["turn_rate_sigma_rad_s"],
    }
    grid_map = {
        "type": "LocalGridMap",
        "name": "map",
        "external_lidars": ["lidar"],
        "external_odometry": "odometry",
        "width": setup["map_cells"],
        "height": setup["map_cells"],
        "resolution": setup["map_resolution_m"],
        "footprint": "none",
    }
    return [lidar, odometry, grid_map]  # in the order in which each feeds on those before


def _drive(env: Any, drives: Sequence[Drive]) -> float:
    """Drive every episode with random actions; return the steps per second, of the time spent within them."""
    clock = time.perf_counter
    steps, seconds = 0, 0.0
    for drive in drives:
        env.reset(seed=drive.seed)
        env.action_space.seed(drive.seed)
        for action in [env.action_space.sample() for _ in range(drive.steps)]:
            start = clock()
            _, _, terminated, truncated, _ = env.step(action)
            seconds += clock() - start
            steps += 1
            if terminated or truncated:  # a robot that has ended is not simulated: its steps would cost nothing
                raise RuntimeError(f"navground ended the episode at step {steps}")
    return steps / seconds


_load: list[Any] = []  # of this process: the environment, and what every round drives


def _get_ready(setup: dict[str, Any], drives: Sequence[Drive]) -> dict[str, Any]:
    """Make the environment and warm it up; return what stands in the first room."""
    env, first = _navground_env(setup, drives), drives[0]
    observation, _ = env.reset(seed=first.seed)
    world = env.unwrapped._world  # no public way to look at what stands in it
    scan = observation["lidar/range"].tolist()
    answer = {"walls": len(world.walls), "discs": len(world.obstacles), "scan": scan}
    _drive(env, [replace(first, steps=min(_WARM_UP_STEPS, first.steps))])
    _load[:] = env, drives
    return answer


def _drive_round() -> float:
    return _drive(*_load)


_batch: dict[str, Any] = {}  # of this process: vector environments, and what they drive


def _get_batch_ready(setup: dict[str, Any], drives: Sequence[Drive]) -> None:
    from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

    make = partial(_navground_env, setup, drives)
    _batch.update(sync=SyncVectorEnv([make] * len(drives)), drives=drives)
    _batch["async"] = AsyncVectorEnv([make] * len(drives))
    for way in BATCHES:
        _drive_batch(way, steps=_WARM_UP_STEPS)


def _drive_batch(way: str, steps: int | None = None) -> float:
    """Return the steps per second of all environments together, with random actions."""
    envs, drives = _batch[way], _batch["drives"]
    steps = min(drive.steps for drive in drives) if steps is None else steps
    envs.reset(seed=[drive.seed for drive in drives])
    envs.action_space.seed(drives[0].seed)
    actions = [envs.action_space.sample() for _ in range(steps)]
    start = time.perf_counter()
    for action in actions:
        _, _, terminated, truncated, _ = envs.step(action)
        if terminated.any() or truncated.any():
            raise RuntimeError("navground ended an episode")
    return steps * len(drives) / (time.perf_counter() - start)


def _close_batch() -> None:
    for way in BATCHES:
        _batch.pop(way).close()
