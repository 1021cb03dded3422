"""The memory that the caller and its workers share: actions in, everything that is a number out."""

from __future__ import annotations

from collections.abc import Mapping
from multiprocessing.context import BaseContext
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import DTypeLike, NDArray

from mecanum_env.config import RewardConfig
from mecanum_env.reward import StepOutcome, reward_terms

__all__ = ["Board"]

Array = NDArray[np.float64]

_NUMBERS = ("coverage", "path_length_m", "time_s", "position_error_m", "heading_error_rad", "nees")
_WHOLE = "collisions"
_POSE = "true_pose"
_TERMS = tuple(reward_terms(RewardConfig(), StepOutcome(0.0, 0.0, 0.0, 0, 0.0, 0.0)))
_COLUMNS = len(_NUMBERS) + 1 + 3 + len(_TERMS)
_Memory = tuple[Any, tuple[int, ...], DTypeLike | None]  # a RawArray, and how it is read
_SHARED = {*_NUMBERS, _WHOLE, _POSE, "reward_terms"}


class Board:
    """Arrays with a row for each environment, in shared memory; a worker is handed the whole of it.

    Attributes
    ----------
    actions : NDArray[np.float32]
        ``(n, a)``.
    observations : dict
        ``(n, …)`` of each key of the observation.
    rewards : NDArray[np.float64]
        ``(n,)``.
    terminated, truncated, told, paid : NDArray[np.bool_]
        ``(n,)``; ``told``: the last command left an info, ``paid``: with its reward's terms.
    """

    def __init__(self, context: BaseContext, count: int, observation: spaces.Dict, action: spaces.Box) -> None:
        self._memory: dict[str, _Memory] = {}

        def share(name: str, shape: tuple[int, ...], dtype: DTypeLike | None) -> None:
            size = count * int(np.prod(shape)) * np.dtype(dtype).itemsize
            self._memory[name] = context.RawArray("b", size), (count, *shape), dtype

        share("actions", action.shape, action.dtype)
        for key, box in observation.spaces.items():
            share(f"observation {key}", box.shape or (), box.dtype)
        share("rewards", (), np.float64)
        for name in ("terminated", "truncated", "told", "paid"):
            share(name, (), np.bool_)
        share("numbers", (_COLUMNS,), np.float64)
        self.__setstate__(self.__getstate__())

    def __getstate__(self) -> dict[str, _Memory]:
        """Return the memory alone: a process that is handed an array gets a copy of it."""
        return self._memory

    def __setstate__(self, memory: dict[str, _Memory]) -> None:
        self._memory = memory
        arrays = {name: np.frombuffer(raw, dtype).reshape(shape) for name, (raw, shape, dtype) in memory.items()}
        self.actions, self.rewards, self._numbers = arrays["actions"], arrays["rewards"], arrays["numbers"]
        self.terminated, self.truncated = arrays["terminated"], arrays["truncated"]
        self.told, self.paid = arrays["told"], arrays["paid"]
        prefix = "observation "
        self.observations = {n.removeprefix(prefix): a for n, a in arrays.items() if n.startswith(prefix)}

    def write(self, row: int, observation: Mapping[str, NDArray[Any]], info: dict[str, Any]) -> dict[str, Any]:
        """Write an environment's observation and info; return what of the info has no place here."""
        for key, value in observation.items():
            self.observations[key][row] = value
        terms = info.get("reward_terms")
        self.told[row], self.paid[row] = True, terms is not None
        x, y, theta = info[_POSE].tolist()
        paid = (0.0,) * len(_TERMS) if terms is None else terms.values()
        self._numbers[row] = (*[info[name] for name in _NUMBERS], info[_WHOLE], x, y, theta, *paid)
        return {} if info.keys() <= _SHARED else {k: value for k, value in info.items() if k not in _SHARED}

    def infos(self) -> dict[str, Any]:
        """Return the infos of all environments that have one, as Gymnasium's vector environments do."""
        told, numbers = self.told.copy(), np.where(self.told[:, None], self._numbers, 0.0)
        if not told.any():
            return {}
        infos: dict[str, Any] = {}
        for column, name in enumerate(_NUMBERS):
            infos[name] = numbers[:, column]
        first = len(_NUMBERS)
        infos[_WHOLE] = numbers[:, first].astype(np.int64)
        infos[_POSE] = numbers[:, first + 1 : first + 4]
        infos |= {f"_{key}": told for key in tuple(infos)}
        paid = self.told & self.paid
        if paid.any():
            terms: dict[str, Any] = {name: numbers[:, first + 4 + k] for k, name in enumerate(_TERMS)}
            infos["reward_terms"] = terms | {f"_{name}": paid for name in _TERMS}
            infos["_reward_terms"] = paid
        return infos
