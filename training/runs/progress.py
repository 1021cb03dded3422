"""How far a long run is, on standard error: a bar on a terminal, else a line at once and then now and then."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING

from training.runs.compiling import compiled_s

if TYPE_CHECKING:
    from rich.progress import Progress as Bar

__all__ = ["Progress"]

_BAR_EVERY_S, _LOG_EVERY_S = 0.1, 30.0
_SOON_S, _SOON = 1.0, 0.02  # before that time, and that share, nobody knows how long the rest will take


class Progress:
    """Told how far something is; ends with the block that it is opened by.

    Parameters
    ----------
    what : str
        What is done, for instance "replaying".
    total : float
        What ``done`` comes to.
    eta : bool
        Whether to say how long the rest will take: in proportion as long as what is done took, but for the
        kernels that were compiled.
    """

    def __init__(self, what: str, total: float, *, eta: bool = True) -> None:
        self._what, self._total, self._eta = what, total, eta
        self._began = self._next = time.monotonic()
        self._compiled_s = compiled_s()
        self._bar = _bar(what, total) if sys.stderr.isatty() else None

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def show(self, done: float, text: str) -> None:
        """Show it, where it is time to; ``text`` says in words where it is."""
        now = time.monotonic()
        if now < self._next and done < self._total:
            return
        left = self._left(done, now - self._began - (compiled_s() - self._compiled_s))
        if self._bar is not None:
            self._next = now + _BAR_EVERY_S
            self._bar.update(self._bar.task_ids[0], completed=done, text=f"{text}{left}")
        elif now >= self._next:
            self._next = now + _LOG_EVERY_S
            print(f"{self._what}: {text}{left}", file=sys.stderr, flush=True)

    def _left(self, done: float, passed_s: float) -> str:
        if not (self._eta and passed_s >= _SOON_S and _SOON * self._total <= done < self._total):
            return ""
        seconds = passed_s * (self._total / done - 1.0)
        return f", about {seconds:.0f} s left" if seconds < 100 else f", about {seconds / 60:.0f} min left"


def _bar(what: str, total: float) -> Bar:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = TextColumn(what), BarColumn(), TimeElapsedColumn(), TextColumn("{task.fields[text]}")
    bar = Progress(*columns, console=Console(stderr=True), transient=True)
    bar.add_task(what, total=total, text="")
    bar.start()
    return bar
