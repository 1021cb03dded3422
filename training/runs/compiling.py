"""Says that Numba compiles: after an installation or an update the first run does, for about a minute."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

__all__ = ["VARIABLE", "compiled_s", "compiling_shown"]

VARIABLE = "MECANUM_COMPILING"
"""The environment variable that keeps it quiet where it is 0."""

_EPISODE = 260  # kernels of ours that an episode of `mecanum explore` runs
_OURS = ("slam.", "mecanum_env.", "agents.", "training.")

_total_s = 0.0


def compiled_s() -> float:
    """Return how long this process has compiled so far [s], in blocks of :func:`compiling_shown`."""
    return _total_s


@contextmanager
def compiling_shown(silent_s: float = 2.0, every_s: float = 10.0) -> Iterator[None]:
    """Print a line on standard error every so often [s], once ``silent_s`` have been spent compiling."""
    from numba.core import event

    class Listener(event.Listener):
        depth = kernels = 0
        began = spent_s = 0.0
        next_s = silent_s if os.environ.get(VARIABLE) != "0" else float("inf")

        def on_start(self, _: Any) -> None:
            if self.depth == 0:
                self.began = time.monotonic()
            self.depth += 1

        def on_end(self, done: Any) -> None:
            global _total_s
            self.depth -= 1
            kernel = getattr(done.data["dispatcher"], "py_func", None)
            self.kernels += getattr(kernel, "__module__", "").startswith(_OURS)
            spent_s = self.spent_s + time.monotonic() - self.began
            if self.depth == 0:
                _total_s += spent_s - self.spent_s
                self.spent_s = spent_s
            if spent_s >= self.next_s:
                self.next_s = spent_s + every_s
                of = f" of about {_EPISODE}" if self.kernels <= _EPISODE else ""
                what = f"compiling kernels, once after an installation: {self.kernels}{of}"
                print(f"{what}, {spent_s:.0f} s", file=sys.stderr, flush=True)

    with event.install_listener("numba:compile", Listener()):
        yield
