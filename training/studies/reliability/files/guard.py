"""The child process seen from outside: what takes too long is ended, and what it died of is noted."""

from __future__ import annotations

import atexit
import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from training.runs.processes import ONE_THREAD

__all__ = ["BOUND_S", "results"]

BOUND_S = 30.0
"""Time of the processor that a file may take."""

_PATIENCE_S = 20.0 * BOUND_S  # of the clock on the wall: others work on the machine, too
_LOOKS_S = 1.0

_START_S = 6000.0  # until it is ready: kernels may have to be compiled

_MODULE = "training.studies.reliability.files.child"


class _Child:
    """A process that answers, started anew where it is gone."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        atexit.register(self.end)

    def end(self) -> None:
        """End it."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def ask(self, *job: Any) -> None:
        """Hand it a job."""
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, "-m", _MODULE], bufsize=0, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL, env=os.environ | ONE_THREAD,
            )  # fmt: skip
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(job).encode() + b"\n")
        self._process.stdin.flush()
        self._line(_START_S)  # it is ready

    def answer(self) -> dict[str, Any] | str:
        """Return the next row, or what the process died of."""
        line = self._line(_PATIENCE_S)
        if line:
            row: dict[str, Any] = json.loads(line)
            return row
        assert self._process is not None
        code = None if line is None else self._process.wait()
        self.end()
        return "time" if line is None else f"died of {code}"

    def _line(self, patience_s: float) -> bytes | None:
        """Return the next line; empty where the process is gone, None where none comes in time."""
        assert self._process is not None and self._process.stdout is not None
        began, used = time.monotonic(), self._used_s()
        while time.monotonic() - began < patience_s and self._used_s() - used < patience_s * BOUND_S / _PATIENCE_S:
            if select.select([self._process.stdout], [], [], _LOOKS_S)[0]:
                return self._process.stdout.readline()
        return None

    def _used_s(self) -> float:
        """Return the processor's time that the process has used; 0 where the system does not tell."""
        assert self._process is not None
        stat = Path(f"/proc/{self._process.pid}/stat")
        try:
            words = stat.read_text().rpartition(")")[2].split()
            return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
        except (OSError, IndexError, ValueError):
            return 0.0


_CHILD = _Child()


def results(reader: str, seed: int, first: int, count: int) -> Iterator[dict[str, Any]]:
    """Yield the rows of so many files of a reader, from one on."""
    index, last = first, first + count
    while index < last:
        _CHILD.ask(reader, seed, index, last - index)
        while index < last:
            row = _CHILD.answer()
            if isinstance(row, str):
                yield {"index": index, "end": row, "seconds": BOUND_S, "mb": 0.0}
                index += 1
                break
            yield row
            index += 1
