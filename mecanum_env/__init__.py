"""The world: a mecanum robot, its sensors, rooms to explore, and the Gymnasium environments over them.

Importing this package registers the environments (with string entry points, so that nothing heavy is loaded)::

    import gymnasium as gym
    import mecanum_env

    env = gym.make("mecanum_env/Explore-v0", rooms="apartment", slam="ekf")

In a process that has not imported it, ``gym.make("mecanum_env:mecanum_env/Explore-v0")`` does.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

import gymnasium

if TYPE_CHECKING:
    from mecanum_env import rooms
    from mecanum_env.config import EnvConfig, LidarConfig, NoiseConfig, RobotConfig, from_toml, to_toml
    from mecanum_env.env import ExploreEnv
    from mecanum_env.team.parallel_env import ExploreParallelEnv

__all__ = [
    "EnvConfig", "ExploreEnv", "LidarConfig", "NoiseConfig", "RobotConfig", "from_toml", "parallel_env",
    "register_envs", "rooms", "to_toml",
]  # fmt: skip

MAX_EPISODE_STEPS = 3000


def register_envs() -> None:
    """Register the environments with Gymnasium; calling it again changes nothing."""
    for name, action in (("Explore", "twist"), ("ExploreWheels", "wheels")):
        env_id = f"mecanum_env/{name}-v0"
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id,
                entry_point="mecanum_env.env:ExploreEnv",
                vector_entry_point="mecanum_env.vector.vector_env:ExploreVectorEnv",
                kwargs={"action": action},
                max_episode_steps=MAX_EPISODE_STEPS,
            )
    # An environment that needs an agent's machinery lives with the agents; its own time limit is in seconds.
    if "mecanum_env/ExploreFrontier-v0" not in gymnasium.registry:
        gymnasium.register("mecanum_env/ExploreFrontier-v0", entry_point="agents.frontier_env:ExploreFrontierEnv")


def parallel_env(robots: int | None = None, **settings: Any) -> ExploreParallelEnv:
    """Return several robots as a PettingZoo environment (:mod:`mecanum_env.team`); needs the extra ``multi``.

    ``robots`` is how many; left out, what ``team`` says of the settings, else 3.
    """
    from mecanum_env.team.parallel_env import ExploreParallelEnv

    return ExploreParallelEnv(robots=robots, **settings)


def __getattr__(name: str) -> Any:
    """Load what is public here when it is first asked for: registering the environments needs none of it."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name == "rooms":
        return import_module("mecanum_env.rooms")
    return getattr(import_module("mecanum_env.env" if name == "ExploreEnv" else "mecanum_env.config"), name)


register_envs()
