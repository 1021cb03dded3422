"""Frozen dataclasses as configuration: each field says beside it what it may be, and is held to it when built."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, cached_property
from types import UnionType
from typing import Annotated, Any, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

from slam.files import quoted

__all__ = [
    "Angle",
    "Config",
    "Count",
    "Duration",
    "Few",
    "Finite",
    "Gap",
    "Length",
    "NotNegative",
    "OneOf",
    "Positive",
    "PositiveShare",
    "Rate",
    "Seed",
    "SettingError",
    "Share",
    "Sigma",
    "Span",
    "Within",
    "allowed",
    "argument",
    "check_name",
    "checked",
    "from_mapping",
    "overlaid",
    "require",
    "same_definitions",
    "to_mapping",
    "unknown_name",
]  # fmt: skip

T = TypeVar("T")

_LONGEST = 1000  # of a list


@dataclass(frozen=True)
class Within:
    """What a number, or each of a tuple, may be, as an interval: ``Annotated[float, Within("(0, 1]")]``."""

    interval: str

    @cached_property
    def ends(self) -> tuple[float, float]:
        """The interval's ends, whether or not they belong to it."""
        low, high = map(_number_of, self.interval[1:-1].split(","))
        return low, high

    def __contains__(self, value: float) -> bool:
        low, high = self.ends
        closed_low, closed_high = self.interval[0] == "[", self.interval[-1] == "]"
        return (low < value or (closed_low and value == low)) and (value < high or (closed_high and value == high))


@dataclass(frozen=True)
class Span(Within):
    """The same of a tuple of two, of which the first is not above the second."""


@dataclass(frozen=True)
class OneOf:
    """The names that a string may be."""

    names: tuple[str, ...]


# Bounds of what a robot in a building deals with: beyond them lies nothing but a slip of the pen.
Positive = Annotated[float, Within("[1e-6, 1e6]")]
NotNegative = Annotated[float, Within("[0, 1e6]")]
Finite = Annotated[float, Within("[-1e6, 1e6]")]
Share = Annotated[float, Within("[0, 1]")]
PositiveShare = Annotated[float, Within("[1e-6, 1]")]
Length = Annotated[float, Within("[0.001, 1000]")]  # m
Gap = Annotated[float, Within("[0, 1000]")]  # m, rad
Angle = Annotated[float, Within("[0.001, 6.3]")]  # rad
Duration = Annotated[float, Within("[0.001, 1e6]")]  # s
Rate = Annotated[float, Within("[0.001, 100]")]  # m/s, m/s², rad/s, 1/s
Sigma = Annotated[float, Within("[1e-6, 10]")]  # m, rad
Few = Annotated[int, Within("[1, 1000]")]
Count = Annotated[int, Within("[1, 10000]")]
Seed = Annotated[int, Within("[0, 2147483647]")]


_ANY_NUMBER = Within("[-inf, inf]")


class SettingError(ValueError):
    """A setting that is not allowed: the class or argument it is of, its path in there, what is wrong with it."""

    def __init__(self, owner: str, path: str, problem: str) -> None:
        super().__init__(owner, path, problem)
        self.owner, self.path, self.problem = owner, path, problem

    def __str__(self) -> str:
        return f"{self.owner}.{self.path} {self.problem}"


class _NotAllowed(ValueError):
    """A value is none of its kind: the message says what is."""

    def __init__(self, kind: _Kind, value: object) -> None:
        super().__init__(f"must be {kind.text}, got {quoted(value)}{_suggestion(value, kind.names)}")


class _Kind(NamedTuple):
    """What a field may be, in words, and what makes a Python value of one that is that, or None of another."""

    text: str
    convert: Callable[[Any], Any]
    optional: bool = False  # None stands for itself
    names: tuple[str, ...] = ()

    def take(self, value: Any) -> Any:
        """Return the value as it is kept; ``_NotAllowed`` where it is not of the kind."""
        if value is None and self.optional:
            return None
        kept = self.convert(value)
        if kept is None:
            raise _NotAllowed(self, value)
        return kept


@dataclass(frozen=True, kw_only=True)
class Config:
    """Base of all configurations.

    A field holds a number, a string, a switch, a tuple of these, a mapping or another configuration. Its
    annotation says what it may be, bounds and names by ``Annotated``. NumPy's scalars are taken for Python's
    numbers, whole numbers for fractions, lists for tuples and mappings for the configurations they describe.

    Raises
    ------
    SettingError
        In one line: the field, what was given, and what is allowed.
    """

    def __post_init__(self) -> None:
        for name, kind in _kinds(type(self)).items():  # type: ignore[arg-type]
            given = getattr(self, name)
            try:
                value = kind.take(given)
            except ValueError as error:
                raise _located(error, type(self).__name__, name) from None
            if value is not given:
                object.__setattr__(self, name, value)


def _number_of(text: str) -> float:
    """Return a number, one without a point as Python's whole one: no float has all digits of a large one."""
    try:
        return int(text)
    except ValueError:
        return float(text)


def unknown_name(what: str, name: object, valid: Iterable[str]) -> ValueError:
    """Return the error for a name that is not registered: one line that lists the valid ones."""
    names = sorted(valid)
    return ValueError(f"unknown {what} {quoted(name)}{_suggestion(name, names)}; valid: {', '.join(names)}")


def _suggestion(name: object, valid: Sequence[str]) -> str:
    close = difflib.get_close_matches(name, valid, n=1) if isinstance(name, str) else []
    return f" (did you mean {close[0]!r}?)" if close else ""


def check_name(what: str, name: object, valid: Iterable[str]) -> None:
    """Raise the error of :func:`unknown_name` unless the name is a valid one."""
    if not isinstance(name, str) or name not in valid:
        raise unknown_name(what, name, valid)


def same_definitions(some: Iterable[object], others: Iterable[object]) -> bool:
    """Tell whether functions and classes are the same, or made by the same code run again, as in a notebook."""
    one, other = ([(x.__module__, getattr(x, "__qualname__", x)) for x in those] for those in (some, others))
    return one == other


def require(condition: bool, message: str) -> None:
    """Raise ``ValueError(message)`` unless the condition holds; for ``__post_init__``."""
    if not condition:
        raise ValueError(message)


def checked(name: str, annotation: Any, value: Any) -> Any:
    """Return a function's argument as its annotation has it; ``ValueError`` as of a configuration's field."""
    try:
        return _kind(annotation).take(value)
    except _NotAllowed as error:
        raise ValueError(f"{name} {error}") from None


@contextmanager
def argument(name: str) -> Iterator[None]:
    """Have errors that are raised inside say of which argument, or key of a file, they speak."""
    try:
        yield
    except SettingError as error:
        raise SettingError(name, error.path, error.problem) from error
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def allowed(cls: type[Config]) -> dict[str, str]:
    """Return what each setting of a configuration may be, in words, by its path: ``{"landmarks.gate": …}``."""
    found: dict[str, str] = {}
    for name, hint in get_type_hints(cls, include_extras=True).items():
        inner = _config_of(hint)
        if inner is None:
            found[name] = _kind(hint).text
        else:
            found |= {f"{name}.{path}": text for path, text in allowed(inner).items()}
    return found


def from_mapping(cls: type[T], values: Mapping[str, Any] | T | None, *, base: T | None = None) -> T:
    """Build a config dataclass from a mapping, laid over ``base`` (or over the defaults).

    An instance passes through, ``None`` gives the base; of a field that may be None it is None. Nested dataclasses
    take nested mappings. Unknown keys raise ``ValueError``.
    """
    if isinstance(values, cls):
        return values
    if values is None:
        return cls() if base is None else base
    if not isinstance(values, Mapping):
        raise ValueError(f"{cls.__name__} takes a mapping or a {cls.__name__}, not {quoted(values)}")
    fields = dataclasses.fields(cls)  # type: ignore[arg-type]
    names = [f.name for f in fields]
    hints = get_type_hints(cls) if base is not None else {}
    changes: dict[str, Any] = {}
    for key, value in values.items():
        if key not in names:
            raise unknown_name(f"key of {cls.__name__}", key, names)
        inner = _config_of(hints.get(key))
        try:
            if inner is not None and isinstance(value, Mapping):
                value = from_mapping(inner, value, base=getattr(base, key))
            if not issubclass(cls, Config):  # a dataclass of somebody's own, which does not look itself
                value = _kinds(cls)[key].take(value)  # type: ignore[arg-type]
        except ValueError as error:
            raise _located(error, cls.__name__, key) from None
        changes[key] = value
    lacking = [f.name for f in fields if f.default is dataclasses.MISSING is f.default_factory]
    missing = [name for name in lacking if base is None and name not in changes]
    require(not missing, f"{cls.__name__} needs {', '.join(missing)}")
    return cls(**changes) if base is None else dataclasses.replace(base, **changes)  # type: ignore[type-var]


def overlaid(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings laid over others: a mapping within changes what it names, and leaves the rest."""
    out = dict(base)
    for key, value in over.items():
        inner = out.get(key)
        out[key] = overlaid(inner, value) if isinstance(inner, Mapping) and isinstance(value, Mapping) else value
    return out


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


# ---- kinds of fields -------------------------------------------------------------------------------------------


def _located(error: ValueError, owner: str, name: str) -> ValueError:
    """Return the error of a field as one of its owner."""
    if isinstance(error, _NotAllowed):
        return SettingError(owner, name, str(error))
    if isinstance(error, SettingError):
        return SettingError(owner, f"{name}.{error.path}", error.problem)
    return ValueError(f"{owner}.{name}: {error}")


@cache
def _kinds(cls: Any) -> dict[str, _Kind]:
    hints = get_type_hints(cls, include_extras=True)
    return {f.name: _kind(hints[f.name]) for f in dataclasses.fields(cls)}


def _config_of(hint: Any) -> type[Any] | None:
    """Return the configuration that a field of this annotation holds, if any."""
    options = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    return next((o for o in options if isinstance(o, type) and dataclasses.is_dataclass(o)), None)


@cache
def _kind(hint: Any, mark: Within | OneOf | None = None) -> _Kind:
    """Return the kind of an annotation; ``mark`` is what ``Annotated`` adds to it."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _kind(parts[0], parts[1])
    if origin in (Union, UnionType) and len(parts) == 2 and type(None) in parts:
        kind = _kind(parts[0] if parts[1] is type(None) else parts[1], mark)
        return _Kind(f"{kind.text}, or None", kind.convert, optional=True)
    if origin is tuple:
        return _tuple(_kind(parts[0], mark), None if parts[-1] is Ellipsis else len(parts), isinstance(mark, Span))
    if hint in (int, float):
        return _number(hint, mark if isinstance(mark, Within) else _ANY_NUMBER)
    if hint is str:
        return _name(mark) if isinstance(mark, OneOf) else _instance("a string", str)
    if hint is bool:
        return _instance("True or False", bool)
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return _config(hint)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return _instance("a mapping", Mapping)
    return _Kind("anything", lambda value: value, optional=True)


def _plain(value: Any) -> Any:
    """Return NumPy's scalars and arrays as Python's numbers and lists."""
    return value.tolist() if hasattr(value, "tolist") else value


def _instance(text: str, cls: type[Any]) -> _Kind:
    def convert(value: Any) -> Any:
        value = _plain(value)
        return value if isinstance(value, cls) else None

    return _Kind(text, convert)


def _name(mark: OneOf) -> _Kind:
    return _Kind(
        f"one of {', '.join(mark.names)}",
        lambda value: value if isinstance(value, str) and value in mark.names else None,
        names=mark.names,
    )


def _number(cls: type[int | float], bounds: Within) -> _Kind:
    def convert(value: Any) -> Any:
        value = _plain(value)
        if not isinstance(value, (int, cls)) or isinstance(value, bool):
            return None
        try:
            number = cls(value)
        except OverflowError:  # a whole number that no float holds
            return None
        return number if number in bounds else None

    if bounds == _ANY_NUMBER:
        return _Kind("a number" if cls is float else "a whole number", convert)
    return _Kind(f"{'' if cls is float else 'a whole number '}in {bounds.interval}", convert)


def _tuple(each: _Kind, length: int | None, rising: bool) -> _Kind:
    def convert(value: Any) -> Any:
        value = _plain(value)
        if not isinstance(value, (list, tuple)) or len(value) > _LONGEST or length not in (None, len(value)):
            return None
        kept = tuple(map(each.convert, value))
        return None if None in kept or (rising and kept[0] > kept[1]) else kept

    text = f"a list{'' if length is None else f' of {length}'}, each {each.text}"
    return _Kind(f"{text}, the least first" if rising else text, convert)


def _config(cls: type[Any]) -> _Kind:
    return _Kind(
        f"a mapping or a {cls.__name__}",
        lambda value: from_mapping(cls, value) if isinstance(value, (Mapping, cls, type(None))) else None,
    )
