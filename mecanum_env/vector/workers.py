"""Shares of the environments: who steps them, the caller itself or a process that is told what to do by a pipe."""

from __future__ import annotations

import select
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from mecanum_env.vector.board import Board

__all__ = ["CALL", "QUIT", "RESET", "SET", "STEP", "Share", "attend", "work"]

STEP, RESET, CALL, SET, QUIT = "step", "reset", "call", "set", "quit"
"""Commands, first of the tuples in the pipe; a worker answers each with (error or None, result)."""

_ATTENTIVE_S = 0.5e-3  # one environment's step takes 0.1 ms

Info = dict[str, Any]


@dataclass
class _Ready:
    """An episode that was begun ahead, and how the random numbers stood before that."""

    observation: dict[str, NDArray[Any]]
    info: Info
    state: Any


class Share:
    """Some of the environments, those from row ``first`` on of the board."""

    def __init__(
        self, make: Callable[[], gymnasium.Env[Any, Any]], board: Board, first: int, count: int,
        mode: AutoresetMode,
    ) -> None:  # fmt: skip
        self._board, self._mode = board, mode
        self._envs = {row: make() for row in range(first, first + count)}
        self._ended = dict.fromkeys(self._envs, False)
        self._ready: dict[int, _Ready] = {}

    def step(self) -> dict[int, Info]:
        """Step every environment; return of each what the board has no place for, where there is anything."""
        board, rest = self._board, {}
        for row, env in self._envs.items():
            if self._ended[row] and self._mode is AutoresetMode.NEXT_STEP:
                more = self._reset(row, None, None)
                board.rewards[row] = 0.0
            else:
                if self._ended[row] and self._mode is AutoresetMode.DISABLED:
                    raise RuntimeError(
                        f"environment {row} has ended: reset it, with options={{'reset_mask': …}}, before it steps"
                    )
                observation, reward, terminated, truncated, info = env.step(board.actions[row])
                board.rewards[row], board.terminated[row], board.truncated[row] = reward, terminated, truncated
                self._ended[row] = ended = bool(terminated or truncated)
                if ended and self._mode is AutoresetMode.SAME_STEP:
                    observation_after, info_after = env.reset()
                    final = {"final_obs": observation, "final_info": info}
                    more = final | board.write(row, observation_after, info_after)
                    self._ended[row] = False
                else:
                    more = board.write(row, observation, info)
            if more:
                rest[row] = more
        return rest

    def prepare(self) -> None:
        """Begin the episodes that the next step will ask for, while the caller is busy."""
        if self._mode is AutoresetMode.NEXT_STEP:
            for row, env in self._envs.items():
                if self._ended[row] and row not in self._ready:
                    state = env.unwrapped.np_random.bit_generator.state
                    observation, info = env.reset()
                    self._ready[row] = _Ready(observation, info, state)

    def reset(self, seeds: dict[int, int | None], options: dict[str, Any] | None) -> dict[int, Info]:
        """Reset some environments; return of each what the board has no place for, where there is anything."""
        for row in self._envs:
            self._board.told[row] = False
        rest = {row: self._reset(row, seed, options) for row, seed in seeds.items()}
        return {row: more for row, more in rest.items() if more}

    def _reset(self, row: int, seed: int | None, options: dict[str, Any] | None) -> Info:
        board, env, ready = self._board, self._envs[row], self._ready.pop(row, None)
        board.terminated[row] = board.truncated[row] = self._ended[row] = False
        if ready is not None and seed is None and not options:
            return board.write(row, ready.observation, ready.info)
        if ready is not None:
            env.unwrapped.np_random.bit_generator.state = ready.state
        return board.write(row, *env.reset(seed=seed, options=options))

    def call(self, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> list[Any]:
        """Return an attribute of every environment, or what it returns where it is a method."""
        found = [env.get_wrapper_attr(name) for env in self._envs.values()]
        return [value(*args, **kwargs) if callable(value) else value for value in found]

    def set(self, name: str, values: dict[int, Any]) -> None:
        """Set an attribute of every environment."""
        for row, env in self._envs.items():
            env.set_wrapper_attr(name, values[row])

    def close(self) -> None:
        """Close every environment."""
        for env in self._envs.values():
            env.close()


def attend(pipe: Connection) -> None:
    """Look at the pipe again and again for a moment, instead of sleeping: being woken takes up to 50 µs a step."""
    if not hasattr(select, "poll"):  # Windows
        return
    look = select.poll()
    look.register(pipe.fileno(), select.POLLIN)
    patience = time.perf_counter() + _ATTENTIVE_S
    while not look.poll(0) and time.perf_counter() < patience:
        pass


def work(
    pipe: Connection, make: Callable[[], gymnasium.Env[Any, Any]], board: Board, first: int, count: int,
    mode: AutoresetMode,
) -> None:  # fmt: skip
    """Do what the pipe says until it says to quit, or until nobody is at its other end any more."""
    for told in (signal.SIGINT, signal.SIGTERM):  # they reach every process of a job: it is the caller's affair
        signal.signal(told, signal.SIG_IGN)
    np.seterr(all="warn")
    share: Share | None = None
    try:
        while True:
            attend(pipe)
            command, *given = pipe.recv()
            if command == QUIT:
                break
            try:
                share = share or Share(make, board, first, count, mode)
                result = getattr(share, command)(*given)
            except Exception as error:  # the caller raises it
                pipe.send((error, None))
                continue
            pipe.send((None, result))
            if command == STEP:
                share.prepare()
    except (EOFError, BrokenPipeError):
        pass
    finally:
        if share is not None:
            share.close()
        pipe.close()
