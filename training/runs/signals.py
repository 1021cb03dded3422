"""Ctrl-C takes effect between two steps, and so does SIGTERM, by which schedulers and ``timeout`` end a run.

Neither takes effect while a kernel compiles: LLVM calls Python back from C, where an exception is lost or ends the
process. It waits until the kernel is there; the next one ends the process.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Any, NoReturn

__all__ = [
    "INTERRUPTED", "TERMINATED", "UNWRITTEN", "Heard", "forget_interrupt", "heed_signals", "interrupt_flag",
]  # fmt: skip

INTERRUPTED, TERMINATED = 130, 143
"""Exit codes after Ctrl-C and after SIGTERM: 128 and the signal's number."""

UNWRITTEN = "interrupted before the results were written"

_LOCK = "numba:compiler_lock"


class _Flag:
    """Handles Ctrl-C by noting it."""

    def __init__(self) -> None:
        self.pressed = threading.Event()

    def __call__(self, signum: int, frame: FrameType | None) -> None:
        if self.pressed.is_set():
            _break_off(signum, again=True)
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


@dataclass(slots=True)
class Heard:
    """What a command has heard of signals so far."""

    sigterm: bool = False
    broken_off: bool = False  # by a KeyboardInterrupt, now or once a kernel is compiled


@contextmanager
def heed_signals() -> Iterator[Heard]:
    """Take SIGTERM for Ctrl-C, and keep both from kernels that compile; tell what was heard.

    A handler of Ctrl-C that is not Python's own stays as it is.
    """
    heard = Heard()
    if threading.current_thread() is not threading.main_thread():
        yield heard
        return

    def interrupt(signum: int, frame: FrameType | None) -> None:
        heard.broken_off = True
        _break_off(signum)

    def terminate(signum: int, frame: FrameType | None) -> None:
        heard.sigterm = True
        handler = signal.getsignal(signal.SIGINT)
        # Ctrl-C may be ignored, as a shell has it in the background: that is not said of SIGTERM.
        act: Callable[[int, FrameType | None], Any] = handler if callable(handler) else interrupt
        act(signum, frame)

    before = {signal.SIGTERM: signal.signal(signal.SIGTERM, terminate)}
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        before[signal.SIGINT] = signal.signal(signal.SIGINT, interrupt)
    try:
        yield heard
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)


# ---- while kernels compile -------------------------------------------------------------------------------------

_waiting: list[int] = []  # the signal that waits until the kernel is compiled


def _break_off(signum: int, *, again: bool = False) -> None:
    """Raise ``KeyboardInterrupt``, now or once the kernel is there that is compiled; the second then ends it all.

    Signals reach the main thread alone, so the compiler's lock, where it is owned, is owned by that.
    """
    lock = getattr(sys.modules.get("numba.core.compiler_lock"), "global_compiler_lock", None)
    if lock is None or not lock.is_locked():
        raise KeyboardInterrupt
    if again or _waiting:
        _end(signum)
    _waiting.append(signum)
    _raise_when_free(lock)


def _raise_when_free(lock: Any) -> None:
    event: Any = sys.modules["numba.core.event"]

    class Freed(event.Listener):  # type: ignore[misc, unused-ignore]
        def on_start(self, _: Any) -> None:
            pass

        def on_end(self, _: Any) -> None:
            if threading.current_thread() is threading.main_thread() and not lock.is_locked():
                event.unregister(_LOCK, self)
                _waiting.clear()
                raise KeyboardInterrupt

    event.register(_LOCK, Freed())


def _end(signum: int) -> NoReturn:
    """End the process from wherever it is; the workers see that it is gone, and end, too."""
    with contextlib.suppress(OSError):
        os.write(2, f"mecanum: {UNWRITTEN}\n".encode())
    os._exit(128 + signum)


def forget_interrupt() -> None:
    """Have Python end with the exit code that it is given, where a ``KeyboardInterrupt`` was met on the way.

    One that passed an ``exec`` of text, as dataclasses make their methods, counts as unhandled whoever caught it,
    and ``python -m`` would end by sending itself SIGINT. Any other such ``exec`` makes it forget.
    """
    exec("")
