"""Shares of the environments: who steps them, the caller itself or a process that is told what to do."""

from __future__ import annotations

import contextlib
import multiprocessing
import pickle
import signal
import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import BaseContext
from multiprocessing.reduction import ForkingPickler
from multiprocessing.util import Finalize
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from mecanum_env.env import ExploreEnv
from mecanum_env.vector.board import Board

__all__ = ["CALL", "LISTEN", "RESET", "SET", "STEP", "Answer", "Share", "Worker"]

STEP, RESET, CALL, SET, _QUIT = "step", "reset", "call", "set", "quit"
"""Methods of a :class:`Share`. All but a step go through the pipe, and so do their results."""

LISTEN = -1
"""Instead of a page to step onto: the order is in the pipe."""

_ATTENTIVE_S = 0.5e-3  # one environment's step takes 0.1 ms
_LOOK_S = 0.2  # how often one that sleeps looks whether the other process still lives
_PATIENCE_S = 10.0  # for a worker to quit

Info = dict[str, Any]
Observation = dict[str, NDArray[Any]]
Make = Callable[[], gymnasium.Env[Any, Any]]
Answer = tuple[Exception | None, Any]

_NOTHING: Answer = None, {}


@dataclass
class _Ready:
    """An episode that was begun ahead; what was seen last of the one before, and how the random numbers stood."""

    observation: Observation
    info: Info
    last: Observation
    state: Any


class _Seat:
    """An environment and its row of the board."""

    def __init__(self, row: int, env: gymnasium.Env[Any, Any], board: Board) -> None:
        self.row, self.env = row, env
        self.ended = False
        self.ready: _Ready | None = None
        self.seen: Observation | None = {}  # the last observation; None where it is on the board alone
        # Only where nobody stands between who might keep what is on the board, or show something else.
        inner = env.env if isinstance(env, gymnasium.wrappers.TimeLimit) else env
        self._bare = inner if type(inner) is ExploreEnv else None
        self._places = [{key: array[row] for key, array in page.observations.items()} for page in board.pages]

    def point_at(self, page: int | None) -> Observation | None:
        """Have the environment fill its row of a page, if it can; return that."""
        if self._bare is None:
            return None
        self._bare.canvas = place = None if page is None else self._places[page]
        return place

    def last_seen(self) -> Observation:
        """Return what the environment last showed; what is on the board the caller may have changed."""
        if self.ready is not None:
            return self.ready.last
        if self.seen is not None or self._bare is None:
            return self.seen or {}
        self.point_at(None)
        return self._bare.observe()


class Share:
    """Some of the environments, those from row ``first`` on of the board."""

    def __init__(self, make: Make, board: Board, first: int, count: int, mode: AutoresetMode) -> None:
        self._board, self._mode = board, mode
        self._seats = [_Seat(row, make(), board) for row in range(first, first + count)]

    def step(self, page: int) -> dict[int, Info]:
        """Step every environment; return of each what the page has no place for, where there is anything."""
        into, rest = self._board.pages[page], {}
        for seat in self._seats:
            if seat.ended and self._mode is AutoresetMode.NEXT_STEP:
                more = self._reset(page, seat, None, None)
            else:
                if seat.ended and self._mode is AutoresetMode.DISABLED:
                    raise RuntimeError(
                        f"environment {seat.row} has ended: reset it, with options={{'reset_mask': …}}, before it "
                        "steps"
                    )
                place = seat.point_at(page)
                # A copy: a wrapper may keep it, and the board's row is the next step's as well.
                action = self._board.actions[seat.row].copy()
                observation, paid, terminated, truncated, info = seat.env.step(action)
                reward = float(paid)
                seat.ended = ended = terminated or truncated
                if ended and self._mode is AutoresetMode.SAME_STEP:
                    more = {"final_obs": deepcopy(observation), "final_info": info}
                    more |= self._reset(page, seat, None, None, reward, terminated, truncated)
                else:
                    seat.seen = None if place is not None else observation
                    more = into.write(seat.row, seat.seen, info, reward, terminated, truncated)
            if more:
                rest[seat.row] = more
        return rest

    def prepare(self) -> None:
        """Begin the episodes that the next step will ask for, while the caller is busy."""
        if self._mode is not AutoresetMode.NEXT_STEP:
            return
        for seat in self._seats:
            if seat.ended and seat.ready is None:
                state = seat.env.unwrapped.np_random.bit_generator.state
                seat.seen = last = seat.last_seen()
                seat.point_at(None)
                try:
                    observation, info = seat.env.reset()
                except Exception:  # it will be raised where the caller asks for it
                    seat.env.unwrapped.np_random.bit_generator.state = state
                else:
                    seat.ready = _Ready(observation, info, last, state)

    def _forget_ready(self) -> None:
        """Take back the episodes that were begun ahead: what is about to be done may make them others."""
        for seat in self._seats:
            if seat.ready is not None:
                seat.env.unwrapped.np_random.bit_generator.state = seat.ready.state
                seat.ready = None

    def reset(self, page: int, seeds: dict[int, int | None], options: Info | None) -> dict[int, Info]:
        """Reset some environments; return of each what the page has no place for, where there is anything."""
        rest = {}
        for seat in self._seats:
            if seat.row not in seeds:
                self._board.pages[page].write_nothing(seat.row)
                self._board.pages[page].show(seat.row, seat.last_seen())
            elif more := self._reset(page, seat, seeds[seat.row], options):
                rest[seat.row] = more
        return rest

    def _reset(
        self, page: int, seat: _Seat, seed: int | None, options: Info | None, reward: float = 0.0,
        terminated: bool = False, truncated: bool = False,
    ) -> Info:  # fmt: skip
        """Reset an environment; what the page says of the step before it is how that ended, if it did."""
        ready, seat.ready, seat.ended = seat.ready, None, False
        if ready is not None and seed is None and not options:
            seat.seen, info = ready.observation, ready.info
        else:
            if ready is not None:
                seat.env.unwrapped.np_random.bit_generator.state = ready.state
            place = seat.point_at(page)
            observation, info = seat.env.reset(seed=seed, options=options)
            seat.seen = None if place is not None else observation
        return self._board.pages[page].write(seat.row, seat.seen, info, reward, terminated, truncated)

    def call(self, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> list[Any]:
        """Return an attribute of every environment, or what it returns where it is a method."""
        for seat in self._seats:
            seat.point_at(None)  # whatever is called, it writes on no page
        found = [seat.env.get_wrapper_attr(name) for seat in self._seats]
        if any(callable(value) for value in found):
            self._forget_ready()
        return [value(*args, **kwargs) if callable(value) else value for value in found]

    def set(self, name: str, values: dict[int, Any]) -> None:
        """Set an attribute of every environment."""
        self._forget_ready()
        for seat in self._seats:
            seat.env.set_wrapper_attr(name, values[seat.row])

    def close(self) -> None:
        """Close every environment."""
        for seat in self._seats:
            seat.env.close()


class Worker:
    """A process with a share of the environments, as the caller sees it.

    Parameters
    ----------
    context
        How it is started.
    number
        Which of the workers it is, from 0 on.
    what
        What a :class:`Share` is made of, after the board.
    """

    def __init__(self, context: BaseContext, number: int, make: Make, board: Board, *what: Any) -> None:
        self._number, self._board = number, board
        self._due, self._done = context.Semaphore(0), context.Semaphore(0)
        self._pipe, theirs = context.Pipe()
        self.process = context.Process(  # type: ignore[attr-defined]
            target=_work, args=(number, theirs, self._due, self._done, make, board, *what), daemon=True
        )
        self.process.start()
        theirs.close()
        # Once, and at the latest when Python ends, which else would wait for it.
        self.quit = Finalize(None, self._quit, exitpriority=10)

    def step(self) -> None:
        """Have it step, onto the page that the board's orders name."""
        self._due.release()

    def stepped(self) -> Answer:
        """Wait for a step's end; return what it answers."""
        while not _acquired(self._done):
            if not self.process.is_alive():
                raise EOFError
        return self.told() if self._board.orders[1 + self._number] else _NOTHING

    @staticmethod
    def order(*parts: Any) -> bytes:
        """Return any other order as it goes through the pipe."""
        return bytes(ForkingPickler.dumps(parts))

    def tell(self, order: bytes) -> None:
        """Give it such an order; the board's orders must say that it is in the pipe."""
        self._due.release()
        self._pipe.send_bytes(order)

    def told(self) -> Answer:
        """Wait for the answer to that."""
        answer: Answer = self._pipe.recv()
        return answer

    def _quit(self) -> None:
        """Have it quit, or end it."""
        self._board.orders[0] = LISTEN
        with contextlib.suppress(OSError):
            self.tell(self.order(_QUIT))
        self._pipe.close()
        self.process.join(_PATIENCE_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


def _acquired(semaphore: Any) -> bool:
    """Try again and again for a moment, since being woken takes up to 50 µs a step; then sleep for a while."""
    acquire = semaphore.acquire
    if acquire(False):
        return True
    patience = time.perf_counter() + _ATTENTIVE_S
    while time.perf_counter() < patience:
        if acquire(False):
            return True
    return bool(acquire(True, _LOOK_S))


def _sendable(answer: Answer) -> bytes:
    """Return an answer as it goes through the pipe; of one that cannot, the error that says so."""
    raised, _ = answer
    try:
        sent = bytes(ForkingPickler.dumps(answer))
        if raised is not None:
            pickle.loads(sent)  # not every exception that can be sent can be received
    except Exception as error:
        what = raised or error
        lost = RuntimeError(f"in a worker process, where it cannot be sent from: {type(what).__name__}: {what}")
        sent = bytes(ForkingPickler.dumps((lost, None)))
    return sent


def _work(number: int, pipe: Connection, due: Any, done: Any, make: Make, board: Board, *what: Any) -> None:
    """Do as told until told to quit, or until the caller is no more."""
    for told in (signal.SIGINT, signal.SIGTERM):  # they reach every process of a job: it is the caller's affair
        signal.signal(told, signal.SIG_IGN)
    np.seterr(divide="warn", over="warn", under="ignore", invalid="warn")  # NumPy's own, whatever the caller set
    caller, orders = multiprocessing.parent_process(), board.orders
    share: Share | None = None
    try:
        while True:
            while not _acquired(due):
                if caller is None or not caller.is_alive():
                    return
            page = int(orders[0])
            command, *given = (STEP, page) if page != LISTEN else pipe.recv()
            if command == _QUIT:
                return
            answer: Answer = _NOTHING
            try:
                share = share or Share(make, board, *what)
                answer = None, getattr(share, command)(*given)
            except Exception as error:  # the caller raises it
                answer = error, None
            if page == LISTEN:
                pipe.send_bytes(_sendable(answer))
                continue
            orders[1 + number] = says_more = answer != _NOTHING
            done.release()
            if says_more:
                pipe.send_bytes(_sendable(answer))
            if share is not None:
                share.prepare()
    except (EOFError, BrokenPipeError):
        pass
    finally:
        if share is not None:
            share.close()
        pipe.close()
