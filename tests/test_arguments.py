"""Whatever a constructor is given: an error in one line that says what is allowed, or what is made works.

Everything is found in the packages and their registries, and derived from annotations and signatures: a new
backend, agent or setting is covered without a line here.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, get_args, get_origin, get_type_hints

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import agents
import slam
from agents.active import ActiveConfig
from agents.ppo_frontier import PpoFrontierConfig
from mecanum_env import parallel_env, rooms
from mecanum_env.arguments import make_config
from mecanum_env.config import EnvConfig, LidarConfig, NoiseConfig, RewardConfig, RobotConfig
from mecanum_env.rooms.registry import check as check_rooms
from mecanum_env.rooms.registry import config_type as config_of_rooms
from mecanum_env.team.config import TeamConfig
from mecanum_env.vector.vector_env import ExploreVectorEnv
from slam.odometry.filters import OdometryFilterConfig, make_odometry_filter
from slam.settings import Config, Within, allowed, from_mapping
from tests.arguments import ABSURD, configs, ends, leaves, nested, parts, refused, use_agent, use_backend, use_env

CONFIGS = configs()
REQUIRED = {"ObservationNoise": {"range_m": 0.1, "bearing_deg": 1.0}}
"""What a class has no default for."""


# ---- configurations --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cls", CONFIGS, ids=lambda cls: cls.__name__)
def test_every_number_has_bounds_and_keeps_its_parents(cls: type[Config]) -> None:
    for name, hint in get_type_hints(cls, include_extras=True).items():
        kind, mark, _ = parts(hint)
        if kind in (int, float) or set(get_args(kind)) & {int, float}:
            assert isinstance(mark, Within), f"{cls.__name__}.{name} has no bounds"
        for parent in cls.__mro__[1:]:
            if name in getattr(parent, "__annotations__", {}):
                before = parts(get_type_hints(parent, include_extras=True)[name])
                assert before == (kind, mark, parts(hint)[2]), (
                    f"{cls.__name__}.{name} has other bounds than {parent}"
                )


@pytest.mark.parametrize("cls", CONFIGS, ids=lambda cls: cls.__name__)
def test_what_is_not_allowed_is_refused(cls: type[Config]) -> None:
    base = REQUIRED.get(cls.__name__, {})
    for name, hint in get_type_hints(cls, include_extras=True).items():
        kind, mark, optional = parts(hint)
        for value in (*ABSURD, *beyond(hint)):
            try:
                made = getattr(cls(**{**base, name: value}), name)
            except ValueError as error:
                refused(error, name)
                assert cls.__name__ in str(error), error
                continue
            assert (made is None) if (optional and value is None) else is_of(made, kind), (name, value, made)
            if isinstance(mark, Within) and made is not None:
                low, high = mark.ends
                assert all(low <= x <= high for x in np.atleast_1d(made)), (name, value)


def beyond(hint: Any) -> list[Any]:
    """Return numbers just outside of what a setting may be, or on an end that does not belong to it."""
    kind, mark, _ = parts(hint)
    if kind not in (int, float) or not isinstance(mark, Within):
        return []
    step = 1 if kind is int else 1e-9
    low, high = mark.ends
    shut = (mark.interval[0] == "[", mark.interval[-1] == "]")
    below, above = (low - step if shut[0] else low), (high + step * abs(high) if shut[1] else high)
    return [x for x in (below, above) if math.isfinite(x)] if kind is float else [int(low) - 1, int(high) + 1]


def is_of(value: Any, kind: Any) -> bool:
    """Tell whether a value is a Python value of the kind, and no number a truth value."""
    if get_origin(kind) is tuple:
        return isinstance(value, tuple) and all(is_of(v, get_args(kind)[0]) for v in value)
    return isinstance(value, get_origin(kind) or kind) and (kind is bool or not isinstance(value, bool))


@pytest.mark.parametrize("cls", CONFIGS, ids=lambda cls: cls.__name__)
def test_numpys_scalars_are_numbers(cls: type[Config]) -> None:
    made = cls(**REQUIRED.get(cls.__name__, {}))
    for f in dataclasses.fields(cls):
        value = getattr(made, f.name)
        others: list[Any] = []
        if isinstance(value, bool):
            others = [np.bool_(value)]
        elif isinstance(value, int):
            others = [np.int64(value), np.int32(value)]
        elif isinstance(value, float):
            others = [np.float64(value)]
        elif isinstance(value, tuple) and value and isinstance(value[0], (int, float)):
            others = [np.array(value), list(value)]
        for other in others:
            kept = getattr(dataclasses.replace(made, **{f.name: other}), f.name)
            assert type(kept) is type(value) and kept == value
            assert not isinstance(kept, tuple) or type(kept[0]) is type(value[0])


def test_a_whole_number_is_a_fraction_and_a_single_precision_one_too() -> None:
    assert repr(LidarConfig(range_max_m=5).range_max_m) == "5.0"  # type: ignore[arg-type]
    assert LidarConfig(range_max_m=np.float32(0.5)).range_max_m == 0.5  # type: ignore[arg-type]


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20) | st.complex_numbers()
    | st.binary(max_size=5) | st.floats(width=32).map(np.float32) | st.just(np.zeros((2, 2))),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=2),
    max_leaves=4,
)  # fmt: skip


@given(cls=st.sampled_from(CONFIGS), data=st.data())
@settings(max_examples=100)
def test_anything_may_be_given(cls: type[Config], data: st.DataObject) -> None:
    name = data.draw(st.sampled_from([f.name for f in dataclasses.fields(cls)] or ["none"]))
    value = data.draw(ANYTHING)
    try:
        from_mapping(cls, {**REQUIRED.get(cls.__name__, {}), name: value})
    except ValueError as error:
        refused(error, name)


def test_what_is_allowed_can_be_shown() -> None:
    found = allowed(EnvConfig)
    assert found["robot.length_m"] == "in [0.05, 2]"
    assert found["lidar.beams"] == "a whole number in [8, 10000]"
    assert found["noise.patch_friction"] == "a list of 2, each in [0.01, 2], the least first"
    assert all(found.values())


# ---- what is made works ----------------------------------------------------------------------------------------

Make = Callable[[dict[str, Any]], Any]


WITH_POLICY: dict[str, type[Config]] = {"active": ActiveConfig, "ppo-frontier": PpoFrontierConfig}
"""What agents take that read settings of a policy beside; their ``config_type`` is the driver's."""


def makers() -> Iterator[tuple[str, type[Config], Make, Callable[[Any], None]]]:
    """Yield everything that a configuration makes: its name, the class, how it is made, and used."""
    for name in slam.names():
        yield f"slam {name}", slam.config_type(name), partial(_slam, name), use_backend
    for name in agents.names():
        cls = WITH_POLICY.get(name) or agents.make(name).config_type
        if cls is not None:
            yield f"agent {name}", cls, partial(_agent, name), use_agent
    for part, cls in (
        ("robot", RobotConfig),
        ("lidar", LidarConfig),
        ("noise", NoiseConfig),
        ("reward", RewardConfig),
    ):
        yield f"env {part}", cls, partial(_env, part), use_env
    yield "env config", EnvConfig, partial(_env, "config"), use_env
    yield "filter", OdometryFilterConfig, _filter, use_env
    for name in rooms.names():
        yield f"rooms {name}", config_of_rooms(name), partial(check_rooms, name), partial(_draw, name)
    yield "team", TeamConfig, lambda config: parallel_env(robots=2, team=config, rooms="rectangular"), _use_team


def _slam(name: str, config: dict[str, Any]) -> Any:
    return slam.make(name, config=config)


def _agent(name: str, config: dict[str, Any]) -> Any:
    return agents.make(name, config=config)


def _env(part: str, config: dict[str, Any]) -> Any:
    chosen: dict[str, Any] = {"rooms": "rectangular"} if part != "config" else {}
    return gymnasium.make("mecanum_env/Explore-v0", **{part: config, **chosen})


def _filter(config: dict[str, Any]) -> Any:
    return _env("odometry_filter", {"name": "differential-transform", **config})


def _draw(name: str, config: Any) -> None:
    assert rooms.make(name, seed=1, config=config).free.any()


def _use_team(env: Any) -> None:
    env.reset(seed=3)
    for _ in range(3):
        env.step({name: env.action_space(name).sample() for name in env.agents})


MAKERS = {name: rest for name, *rest in makers()}
SETTINGS = [(name, path, hint) for name, (cls, *_) in MAKERS.items() for path, _, hint in leaves(cls)]


def check(name: str, path: tuple[str, ...], value: Any) -> None:
    """Make something with one setting, and use it; or see it refused in one line."""
    _, make, use = MAKERS[name]
    try:
        made = make(nested(path, value))
    except ValueError as error:
        refused(error, path[-1].partition("_")[0])
        return
    try:
        use(made)
    except rooms.FloorPlanError as error:  # a body too large for the room it is put into
        assert path[-1] in ("length_m", "width_m", "start_pose") and "\n" not in str(error)


def values(hint: Any) -> st.SearchStrategy[Any]:
    """Return what a setting may be: its ends often, and what lies between."""
    kind, mark, _ = parts(hint)
    known = ends(hint)
    if kind not in (int, float) or not isinstance(mark, Within):
        return st.sampled_from(known or [{}])
    low, high = mark.ends
    if kind is int:
        return st.sampled_from(known) | st.integers(int(low), int(high))
    return st.sampled_from(known) | st.floats(known[-2], known[-1])


SLOW = {"relocalisation", "particles", "update_m", "update_rad", "spacing_m", "step_rad", "cell_m", "samples"}
"""What makes a step take seconds."""


@pytest.mark.parametrize("kind", ["slam", "agent", "env", "filter", "rooms", "team"])
@given(data=st.data())
@settings(max_examples=12)
def test_what_is_allowed_works(kind: str, data: st.DataObject) -> None:
    those = [
        s for s in SETTINGS if s[0].split()[0] == kind and s[1][-1] not in SLOW and "relocalisation" not in s[1]
    ]
    name, path, hint = data.draw(st.sampled_from(those))
    check(name, path, data.draw(values(hint)))


@pytest.mark.monte_carlo
@pytest.mark.parametrize("name", MAKERS)
def test_every_setting_works_at_both_ends(name: str) -> None:
    for path, _, hint in leaves(MAKERS[name][0]):
        for value in ends(hint):
            check(name, path, value)


# ---- functions -------------------------------------------------------------------------------------------------


def functions() -> dict[str, tuple[Callable[..., Any], Any, dict[str, Any]]]:
    """Return what is called by keywords, whose signature has them, and what else it is given."""
    make = partial(gymnasium.make, disable_env_checker=True)
    env, frontier = "mecanum_env/Explore-v0", "mecanum_env/ExploreFrontier-v0"
    found: dict[str, tuple[Callable[..., Any], Any, dict[str, Any]]] = {
        "make": (partial(make, env), make_config, {}),
        "make: of ExploreEnv": (partial(make, env), gymnasium.spec(env).entry_point, {}),
        "make: of ExploreFrontierEnv": (partial(make, frontier), gymnasium.spec(frontier).entry_point, {}),
        "make_vec": (ExploreVectorEnv, ExploreVectorEnv, {"workers": 1}),
        "parallel_env": (parallel_env, "mecanum_env.team.team:Team", {}),
        "slam.make": (slam.make, slam.make, {"name": "ekf"}),
        "rooms.make": (rooms.make, rooms.make, {"name": "cave", "seed": 0}),
        "make_odometry_filter": (make_odometry_filter, make_odometry_filter, {"name": "differential-transform"}),
    }
    for name in agents.names():
        found[f"agents.make {name}"] = (agents.make, agents.make, {"name": name})
    return found


FUNCTIONS = functions()


@pytest.mark.parametrize("function", FUNCTIONS)
def test_wrong_arguments_are_refused(function: str) -> None:
    call, signed, others = FUNCTIONS[function]
    if isinstance(signed, str):
        module, _, attribute = signed.partition(":")
        signed = getattr(__import__(module, fromlist=[attribute]), attribute)
    for name, parameter in inspect.signature(signed).parameters.items():
        if parameter.kind is parameter.VAR_KEYWORD or parameter.kind is parameter.VAR_POSITIONAL:
            continue
        for value in ABSURD:
            if value is None and parameter.default is None:
                continue
            if name == "render_mode" and not isinstance(value, str | None):
                continue  # gym.make looks at it itself, and for a word only
            try:
                made = call(**{**others, name: value})
            except (ValueError, TypeError) as error:
                assert isinstance(error, ValueError), (name, value, repr(error))
                refused(error, name if name != "name" else "")
            else:
                plain = inspect.signature(signed).parameters[name].annotation
                assert value in ({}, True, None) or isinstance(value, int), (name, value, made, plain)
                if hasattr(made, "close"):
                    made.close()


def test_numpys_scalars_are_arguments() -> None:
    envs = ExploreVectorEnv(np.int64(2), workers=np.int32(1), max_episode_steps=np.int64(5), rooms="rectangular")
    envs.reset(seed=0)
    envs.close()
    assert len(parallel_env(robots=np.int64(2), max_steps=np.int16(9)).possible_agents) == 2
    agents.make("random", step_s=np.float32(0.1))


@dataclasses.dataclass(frozen=True)
class Plain:
    """A configuration of somebody else's, without bounds."""

    speed: float = 1.0
    name: int | str = "a"
    seeds: tuple[int, ...] = ()


def test_a_dataclass_of_ones_own_is_held_to_its_types() -> None:
    assert repr(from_mapping(Plain, {"speed": 2, "seeds": [1, 2]})) == "Plain(speed=2.0, name='a', seeds=(1, 2))"
    for key, value in (("speed", True), ("speed", "2"), ("speed", math.nan), ("seeds", [1.5]), ("seeds", 3)):
        with pytest.raises(ValueError, match=f"^Plain.{key} must be "):
            from_mapping(Plain, {key: value})
