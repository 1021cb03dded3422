"""What the settings of a class may be and may not be, from its annotations alone; and what runs with them."""

from __future__ import annotations

import importlib
import math
import pkgutil
from collections.abc import Iterator
from functools import cache
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import gymnasium
import numpy as np

import agents
import mecanum_env
import slam
from slam.settings import Config, OneOf, Span, Within

ABSURD = (
    "a word", "", 1j, [], {}, [[1.0]], {"a": 1}, object(), b"x", np.zeros((2, 3)), np.array("x"), math.nan,
    math.inf, -math.inf, -1, -1.5, 1e308, -1e308, 10**30, 10**400, True, None,
)  # fmt: skip
"""What hardly any setting may be."""


def configs() -> list[type[Config]]:
    """Return every configuration of the four packages."""
    for package in (slam, mecanum_env, agents, importlib.import_module("training")):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not module.name.endswith("__main__"):
                importlib.import_module(module.name)

    def below(cls: type[Config]) -> Iterator[type[Config]]:
        for sub in cls.__subclasses__():
            yield sub
            yield from below(sub)

    return sorted({c for c in below(Config) if c.__module__.split(".")[0] != "tests"}, key=lambda c: c.__name__)


def parts(hint: Any) -> tuple[Any, Any, bool]:
    """Return the type that an annotation names, its bounds or names, and whether it may be None."""
    mark, optional = None, False
    while True:
        if get_origin(hint) is Annotated:
            hint, mark = get_args(hint)[:2]
        elif get_origin(hint) in (Union, UnionType):
            hint, optional = next(o for o in get_args(hint) if o is not type(None)), True
        else:
            return hint, mark, optional


def ends(hint: Any) -> list[Any]:
    """Return allowed values: the least and the largest, what lies just inside, every name."""
    kind, mark, optional = parts(hint)
    out: list[Any] = [None] if optional else []
    if isinstance(mark, OneOf):
        return out + list(mark.names)
    if kind is bool:
        return [*out, True, False, np.bool_(True)]
    if not isinstance(mark, Within):
        return out
    low, high = mark.ends
    whole = kind is int or get_args(kind)[:1] == (int,)
    if not whole:
        low = low if mark.interval[0] == "[" else math.nextafter(low, math.inf)
        high = high if mark.interval[-1] == "]" else math.nextafter(high, -math.inf)
    numbers = [int(low), int(high)] if whole else [low, high]
    if get_origin(kind) is not tuple:
        return out + numbers
    count = 2 if Ellipsis in get_args(kind) else len(get_args(kind))
    out += [(n,) * count for n in numbers]
    return [*out, tuple(numbers)] if isinstance(mark, Span) else out


def leaves(cls: type[Config]) -> Iterator[tuple[tuple[str, ...], type[Config], Any]]:
    """Yield the path of every setting of a configuration, the class that has it, and its annotation."""
    for name, hint in get_type_hints(cls, include_extras=True).items():
        kind = parts(hint)[0]
        if isinstance(kind, type) and issubclass(kind, Config):
            for path, owner, inner in leaves(kind):
                yield (name, *path), owner, inner
        else:
            yield (name,), cls, hint


def nested(path: tuple[str, ...], value: Any) -> dict[str, Any]:
    """Return the mapping that sets one setting."""
    return {path[0]: value if len(path) == 1 else nested(path[1:], value)}


def refused(error: BaseException, name: str) -> None:
    """Assert that an error is one a user can act on: one line that names the argument."""
    message = str(error)
    assert isinstance(error, ValueError), repr(error)
    assert name in message and "\n" not in message and len(message) < 600, message


# ---- what runs with them ---------------------------------------------------------------------------------------


@cache
def sensed() -> list[Any]:
    """Return odometry and scan of a robot's steps, which midway is put into another room: it gets lost there."""
    out: list[Any] = []
    for seed in (3, 4):
        env: Any = gymnasium.make("mecanum_env/Explore-v0", rooms="rectangular", slam="odometry").unwrapped
        env.reset(seed=seed)
        for action in ([0.5, 0.2, 0.0], [0.5, 0.0, 0.8], [0.0, 0.0, 1.0], [0.6, 0.0, 0.0]) * 4:
            env.step(np.array(action, np.float32))
            out.append((env.odometry, env.scan))
    return out


def use_backend(backend: Any) -> None:
    """Have a backend believe what was sensed."""
    backend.reset((0.0, 0.0, 0.0), seed=0)
    for odometry, scan in sensed():
        backend.predict(odometry)
        if hasattr(backend, "give_pose"):
            backend.give_pose(np.zeros(3))
        backend.update(scan)
    belief = backend.belief
    assert np.isfinite(belief.pose).all() and np.isfinite(belief.pose_cov).all()


def use_agent(agent: Any) -> None:
    """Have an agent drive a few steps, one of them in doubt of where it is."""
    env: Any = gymnasium.make("mecanum_env/Explore-v0", rooms="rectangular", slam="ekf").unwrapped
    observation, _ = env.reset(seed=3)
    agent.reset(env.belief, seed=0)
    for _ in range(6):
        action = agent.act(observation, env.belief)
        assert env.action_space.contains(action), action
        observation, *_ = env.step(action)


def use_env(env: Any, steps: int = 4) -> None:
    """Take a few steps in an environment."""
    observation, _ = env.reset(seed=3)
    for _ in range(steps):
        assert env.observation_space.contains(observation)
        observation, reward, terminated, _, _ = env.step(env.action_space.sample())
        assert math.isfinite(reward)
        if terminated:
            break
    env.close()
