"""Room generators by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, TypeVar

from mecanum_env.rooms.floor_plan import FloorPlan
from slam.settings import argument, check_name, from_mapping, require, same_definitions

__all__ = ["Generator", "config_type", "make", "names", "register"]

C = TypeVar("C", contravariant=True)


class Generator(Protocol[C]):
    """Draws the plan of a seed; the same seed and config give the same plan, bit for bit."""

    def __call__(self, config: C, /, *, seed: int) -> FloorPlan:
        """Return the plan."""


_GENERATORS: dict[str, tuple[Generator[Any], type[Any]]] = {}


def register(name: str, generator: Generator[C], config_type: type[C]) -> None:
    """Make a generator known under a name, with the frozen dataclass that configures it.

    A notebook's cell that is run again replaces what it registered.

    Raises
    ------
    ValueError
        If another generator has the name.
    """
    require(
        name not in _GENERATORS or same_definitions(_GENERATORS[name], (generator, config_type)),
        f"rooms {name!r} is registered already; choose another name",
    )
    _GENERATORS[name] = (generator, config_type)


def names() -> tuple[str, ...]:
    """Return the registered names, in order."""
    return tuple(sorted(_GENERATORS))


def config_type(name: str) -> type[Any]:
    """Return the config dataclass of a generator; ``ValueError`` lists the valid names."""
    check_name("rooms", name, _GENERATORS)
    return _GENERATORS[name][1]


def check(name: str, config: Mapping[str, Any] | Any | None = None) -> Any:
    """Return a generator's whole config, or raise the ``ValueError`` for an unknown name or key."""
    return from_mapping(config_type(name), config)


def make(name: str, *, seed: int, config: Mapping[str, Any] | Any | None = None) -> FloorPlan:
    """Return the plan that a generator draws for a seed.

    Parameters
    ----------
    name
        One of :func:`names`.
    seed
        Integer ≥ 0.
    config
        The generator's config dataclass, or a mapping of its fields; None for the defaults.

    Raises
    ------
    ValueError
        For an unknown name or key, a value out of its limits, or a seed that is no integer ≥ 0.
    """
    check_name("rooms", name, _GENERATORS)
    with argument("config"):
        settings = check(name, config)
    return _GENERATORS[name][0](settings, seed=seed)
