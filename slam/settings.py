"""Frozen dataclasses as configuration: built from mappings, unknown keys rejected."""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Callable, Iterable, Mapping
from types import UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from slam.files import quoted

__all__ = ["from_mapping", "not_negative", "positive", "require", "shares", "to_mapping", "unknown_name"]

T = TypeVar("T")

_LONGEST = 80  # characters of a name in an error


def unknown_name(what: str, name: object, valid: Iterable[str]) -> ValueError:
    """Return the error for a name that is not registered: one line that lists the valid ones."""
    names = sorted(valid)
    close = difflib.get_close_matches(str(name)[:_LONGEST], names, n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    return ValueError(f"unknown {what} {quoted(name, _LONGEST)}{hint}; valid: {', '.join(names)}")


def require(condition: bool, message: str) -> None:
    """Raise ``ValueError(message)`` unless the condition holds; for ``__post_init__``."""
    if not condition:
        raise ValueError(message)


def positive(config: Any, *names: str) -> None:
    """Raise ``ValueError`` unless these fields of a config, all where none is named, are finite and > 0."""
    _check(config, names, lambda value: value > 0, "> 0")


def not_negative(config: Any, *names: str) -> None:
    """Raise ``ValueError`` unless these fields of a config, all where none is named, are finite and ≥ 0."""
    _check(config, names, lambda value: value >= 0, "≥ 0")


def shares(config: Any, *names: str) -> None:
    """Raise ``ValueError`` unless these fields of a config, all where none is named, are in [0, 1]."""
    _check(config, names, lambda value: 0 <= value <= 1, "in [0, 1]")


def _check(config: Any, names: Iterable[str], holds: Callable[[float], bool], what: str) -> None:
    for name in names or [f.name for f in dataclasses.fields(config)]:
        value = getattr(config, name)
        good = math.isfinite(value) and holds(value)
        require(good, f"{type(config).__name__}.{name} must be {what}, got {value}")


def from_mapping(cls: type[T], values: Mapping[str, Any] | T | None, *, base: T | None = None) -> T:
    """Build a config dataclass from a mapping, laid over ``base`` (or over the defaults).

    An instance passes through, ``None`` gives the base; of a field that may be None it is None. Nested dataclasses
    take nested mappings; lists become tuples and integers floats where the field says so. Unknown keys raise
    ``ValueError``.
    """
    if isinstance(values, cls):
        return values
    if values is None:
        return cls() if base is None else base
    if not isinstance(values, Mapping):
        raise ValueError(f"{cls.__name__} takes a mapping or a {cls.__name__}, not {type(values).__name__}")
    hints = get_type_hints(cls)
    names = [f.name for f in dataclasses.fields(cls)]  # type: ignore[arg-type]
    changes: dict[str, Any] = {}
    for key, value in values.items():
        if key not in names:
            raise unknown_name(f"key of {cls.__name__}", key, names)
        changes[key] = _coerce(cls, key, hints[key], value, getattr(base, key, None))
    return cls(**changes) if base is None else dataclasses.replace(base, **changes)  # type: ignore[type-var]


def to_mapping(config: Any) -> dict[str, Any]:
    """Return a config dataclass as plain nested dictionaries that TOML can hold (``None`` left out)."""
    out: dict[str, Any] = {}
    for f in dataclasses.fields(config):
        value = getattr(config, f.name)
        if value is None:
            continue
        if dataclasses.is_dataclass(value):
            out[f.name] = to_mapping(value)
        elif isinstance(value, Mapping):
            out[f.name] = dict(value)
        else:
            out[f.name] = list(value) if isinstance(value, tuple) else value
    return out


def _coerce(cls: type[Any], key: str, hint: Any, value: Any, base: Any) -> Any:
    options = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    if value is None and type(None) in options:
        return None
    for option in options:
        if dataclasses.is_dataclass(option) and isinstance(option, type):
            return from_mapping(option, value, base=base)
    if isinstance(value, list):
        value = tuple(value)
    if get_origin(hint) is tuple:
        parts = get_args(hint)
        if not isinstance(value, tuple):
            raise ValueError(f"{cls.__name__}.{key} takes a list, got {quoted(value)}")
        if Ellipsis not in parts and len(value) != len(parts):
            raise ValueError(f"{cls.__name__}.{key} takes a list of {len(parts)}, got {quoted(value)}")
    kinds = [o for o in options if isinstance(o, type)]
    if isinstance(value, bool) and bool not in kinds and kinds:
        raise ValueError(f"{cls.__name__}.{key} is a {kinds[0].__name__}, not a boolean")
    if float in kinds and isinstance(value, int) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            raise ValueError(f"{cls.__name__}.{key} is too large") from None
    simple = {bool, int, float, str}
    if kinds and set(kinds) <= simple | {type(None)} and not isinstance(value, tuple(kinds)):
        raise ValueError(f"{cls.__name__}.{key} takes {kinds[0].__name__}, got {quoted(value)}")
    return value
