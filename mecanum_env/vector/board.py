"""The memory that the caller and its workers share: actions in, everything that is a number out."""

from __future__ import annotations

import struct
import sys
from collections.abc import Mapping
from multiprocessing.context import BaseContext
from operator import itemgetter
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import DTypeLike, NDArray

from mecanum_env.config import RewardConfig
from mecanum_env.reward import StepOutcome, reward_terms

__all__ = ["Board", "Page"]

Observation = Mapping[str, NDArray[Any]]
_LINES, _OBSERVED = "lines", "observation "  # what is shared under which name
_Memory = tuple[Any, tuple[int, ...], DTypeLike | None]  # a RawArray, and how it is read

_PAGES = 4  # a caller that keeps the last observation beside the next needs two, and one is to spare
_NUMBERS = ("coverage", "path_length_m", "time_s", "position_error_m", "heading_error_rad", "nees", "collisions")
_POSE = "true_pose"
_TERMS = tuple(reward_terms(RewardConfig(), StepOutcome(0.0, 0.0, 0.0, 0, 0.0, 0.0)))
_TERM_NAMES, _NO_TERMS = {*_TERMS}, dict[str, float]()
_UNPAID_KEYS = {*_NUMBERS, _POSE}
_PAID_KEYS = {*_UNPAID_KEYS, "reward_terms"}
_numbers_of, _terms_of = itemgetter(*_NUMBERS), itemgetter(*_TERMS)

# An environment's numbers are one line of memory, so that one call writes them.
_LINE = np.dtype(
    [
        ("reward", "f8"), *[(name, "f8") for name in _NUMBERS[:-1]], (_NUMBERS[-1], "i8"), (_POSE, "f8", 3),
        *[(f"term {name}", "f8") for name in _TERMS],
        ("terminated", "?"), ("truncated", "?"), ("told", "?"), ("paid", "?"), ("", "V4"),
    ]
)  # fmt: skip
_PACKED = struct.Struct(f"={len(_NUMBERS)}dq{3 + len(_TERMS)}d4?4x")
assert _PACKED.size == _LINE.itemsize
_pack = _PACKED.pack_into
_UNPAID = (0.0,) * len(_TERMS)
_SILENT = (*(0.0,) * len(_NUMBERS), 0, 0.0, 0.0, 0.0, *_UNPAID, False, False, False, False)


class Page:
    """What one step has to tell of all environments: arrays with a row for each.

    Attributes
    ----------
    observations : dict
        ``(n, …)`` of each key of the observation.
    rewards, terminated, truncated : NDArray
        ``(n,)``.
    """

    def __init__(self, number: int, memory: dict[str, _Memory]) -> None:
        lines, (_, count), _ = memory[_LINES]
        self._raw, self._first = lines, number * count * _LINE.itemsize

        def column(name: str) -> NDArray[Any]:
            assert _LINE.fields is not None
            dtype, offset = _LINE.fields[name][:2]
            inner = np.dtype((dtype.base, dtype.shape))
            strides = (_LINE.itemsize, *(inner.base.itemsize for _ in dtype.shape))
            return np.ndarray((count, *dtype.shape), dtype.base, lines, self._first + offset, strides)

        # Arrays right on the memory: a view that someone takes of one holds that one, and none behind it.
        self.observations: dict[str, NDArray[Any]] = {
            name.removeprefix(_OBSERVED): np.ndarray(
                shape[1:], dtype, raw, number * int(np.prod(shape[1:])) * np.dtype(dtype).itemsize
            )
            for name, (raw, shape, dtype) in memory.items()
            if name.startswith(_OBSERVED)
        }
        self.rewards, self.terminated, self.truncated = map(column, ("reward", "terminated", "truncated"))
        self._infos = {name: column(name) for name in (*_NUMBERS, _POSE)}
        self._terms = {name: column(f"term {name}") for name in _TERMS}
        self._told, self._paid = column("told"), column("paid")
        lent = (*self.observations.values(), *self._infos.values(), *self._terms.values(), self._told, self._paid)
        self._infos |= {f"_{name}": self._told for name in self._infos}
        self._terms |= {f"_{name}": self._paid for name in self._terms}
        self._lent = lent
        self._holders = [*map(sys.getrefcount, lent)]

    @property
    def free(self) -> bool:
        """Whether nobody else holds any of its arrays, nor a view of one, so that it can be written anew."""
        return [*map(sys.getrefcount, self._lent)] == self._holders

    def write(
        self, row: int, observation: Observation | None, info: dict[str, Any], reward: float = 0.0,
        terminated: bool = False, truncated: bool = False,
    ) -> dict[str, Any]:  # fmt: skip
        """Write what an environment returned; return what of the info has no place here.

        The observation is None where it was filled into its row of this page.
        """
        if observation is not None:
            self.show(row, observation)
        terms = info.get("reward_terms", _NO_TERMS)
        paid = terms.keys() == _TERM_NAMES  # a wrapper's own have no place
        _pack(
            self._raw, self._first + row * _LINE.itemsize, reward, *_numbers_of(info), *info[_POSE].tolist(),
            *(_terms_of(terms) if paid else _UNPAID), terminated, truncated, True, paid,
        )  # fmt: skip
        shared = _PAID_KEYS if paid else _UNPAID_KEYS
        if len(info) == len(shared):
            return {}
        return {key: value for key, value in info.items() if key not in shared}

    def show(self, row: int, observation: Observation) -> None:
        """Write an environment's observation."""
        for key, value in observation.items():
            self.observations[key][row] = value

    def write_nothing(self, row: int) -> None:
        """Write that an environment has no info."""
        _pack(self._raw, self._first + row * _LINE.itemsize, *_SILENT)

    def lend(self, *, copy: bool) -> dict[str, NDArray[Any]]:
        """Return the observations: these very arrays, or copies."""
        return _copied(self.observations) if copy else self.observations.copy()

    def infos(self, *, copy: bool) -> dict[str, Any]:
        """Return the infos of all environments that have one, as Gymnasium's vector environments do."""
        infos: dict[str, Any] = _copied(self._infos) if copy else self._infos.copy()
        if True in self._paid.tolist():
            infos["reward_terms"] = _copied(self._terms) if copy else self._terms.copy()
            infos["_reward_terms"] = self._paid.copy() if copy else self._paid
        return infos


class Board:
    """Pages in shared memory; a worker is handed the whole of it.

    The caller is given a page's own arrays, and none is written again while it holds any of them: nothing is
    copied, and yet nothing that it has changes.

    Attributes
    ----------
    actions : NDArray[np.float32]
        ``(n, a)``.
    orders : NDArray[np.int64]
        ``(1 + workers,)``: the page to write, or that the order is in the pipe; then of each worker whether its
        pipe says more.
    pages : list of Page
        One of them, ``spare``, is never lent: it is there for where all the others are held.
    """

    def __init__(
        self, context: BaseContext, count: int, observation: spaces.Dict, action: spaces.Space[Any], workers: int
    ) -> None:
        memory: dict[str, _Memory] = {}

        def share(name: str, shape: tuple[int, ...], dtype: DTypeLike | None) -> None:
            memory[name] = context.RawArray("b", int(np.prod(shape)) * np.dtype(dtype).itemsize), shape, dtype

        share("actions", (count, *(action.shape or ())), action.dtype)
        share("orders", (1 + workers,), np.int64)
        share(_LINES, (_PAGES, count), _LINE)
        for key, box in observation.spaces.items():
            share(f"{_OBSERVED}{key}", (_PAGES, count, *(box.shape or ())), box.dtype)
        self.__setstate__(memory)

    def __getstate__(self) -> dict[str, _Memory]:
        """Return the memory alone: a process that is handed an array gets a copy of it."""
        return self._memory

    def __setstate__(self, memory: dict[str, _Memory]) -> None:
        self._memory = memory
        self.actions, self.orders = (
            np.ndarray(shape, dtype, raw) for raw, shape, dtype in (memory["actions"], memory["orders"])
        )
        self.pages = [Page(number, memory) for number in range(_PAGES)]
        self._turns: list[int] = [*range(self.spare)]

    spare = _PAGES - 1

    def free_page(self) -> int:
        """Return which page can be written; mostly it is the one before the last one."""
        turns = self._turns
        for k, number in enumerate(turns):
            if self.pages[number].free:
                turns.insert(1, turns.pop(k))
                return number
        return self.spare


def _copied(arrays: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    return {name: array.copy() for name, array in arrays.items()}
