"""Ctrl-C takes effect between two steps, and so does SIGTERM, by which schedulers and ``timeout`` end a run."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

__all__ = ["INTERRUPTED", "TERMINATED", "forget_interrupt", "heed_sigterm", "interrupt_flag"]

INTERRUPTED, TERMINATED = 130, 143
"""Exit codes after Ctrl-C and after SIGTERM: 128 and the signal's number."""


class _Flag:
    """Handles Ctrl-C by noting it."""

    def __init__(self) -> None:
        self.pressed = threading.Event()

    def __call__(self, signum: int, frame: FrameType | None) -> None:
        if self.pressed.is_set():
            raise KeyboardInterrupt
        self.pressed.set()


@contextmanager
def interrupt_flag() -> Iterator[threading.Event]:
    """Turn Ctrl-C into a flag, so that it takes effect between two steps; the second one breaks off at once.

    Within another such block, that one is told, too, when this one ends. In a worker, which leaves both signals to
    its parent, it is never pressed.
    """
    flag = _Flag()
    worker = all(signal.getsignal(each) is signal.SIG_IGN for each in (signal.SIGINT, signal.SIGTERM))
    if worker or threading.current_thread() is not threading.main_thread():
        yield flag.pressed  # only the main thread may handle signals
        return
    before = signal.signal(signal.SIGINT, flag)
    try:
        yield flag.pressed
    finally:
        signal.signal(signal.SIGINT, before)
        if flag.pressed.is_set() and isinstance(before, _Flag):
            before.pressed.set()


@contextmanager
def heed_sigterm() -> Iterator[threading.Event]:
    """Take SIGTERM for Ctrl-C; give a flag that tells whether it came."""
    came = threading.Event()

    def interrupt(signum: int, frame: FrameType | None) -> None:
        came.set()
        handler = signal.getsignal(signal.SIGINT)
        if not callable(handler):  # ignored, as a shell has it in the background: that is not said of SIGTERM
            raise KeyboardInterrupt
        handler(signal.SIGINT, frame)

    if threading.current_thread() is not threading.main_thread():
        yield came
        return
    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield came
    finally:
        signal.signal(signal.SIGTERM, before)


def forget_interrupt() -> None:
    """Have Python end with the exit code that it is given, where a ``KeyboardInterrupt`` was met on the way.

    One that passed an ``exec`` of text, as dataclasses make their methods, counts as unhandled whoever caught it,
    and ``python -m`` would end by sending itself SIGINT. Any other such ``exec`` makes it forget.
    """
    exec("")
