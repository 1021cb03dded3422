"""A command started, killed at a moment, and what it leaves running."""

from __future__ import annotations

import contextlib
import os
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from training.runs.processes import ONE_THREAD

__all__ = ["Moment", "Run", "run"]

PATIENCE_S = 900.0
"""A run takes no longer, on a machine that others use, too."""

_LEAVE_S = 60.0  # for what a killed run has started to end by itself
_MARK = "MECANUM_KILLS"
_LOOK_S = 0.001


@dataclass(frozen=True, kw_only=True)
class Moment:
    """When to kill: so long after the start, or when the folder has changed so many times."""

    signal: int
    after_s: float | None = None
    changes: int = 0


@dataclass(frozen=True, kw_only=True)
class Run:
    """How a run ended."""

    code: int
    killed: bool  # it had not ended before
    seconds: float
    changes: int  # of its folder
    error: str  # what it said
    left: tuple[str, ...]  # processes that it started and that did not end
    command: str = ""


def run(argv: Sequence[str], folder: Path, moment: Moment | None = None) -> Run:
    """Run ``mecanum`` with arguments that write to a folder, kill it at a moment; wait for all its processes."""
    mark = secrets.token_hex(8)
    environment = os.environ | ONE_THREAD | {_MARK: mark, "MECANUM_COMPILING": "0", "RAY_DEDUP_LOGS": "0"}
    said = folder.with_name(f"{folder.name}.stderr")
    began = time.monotonic()
    with said.open("wb") as stderr:
        process = subprocess.Popen(
            [sys.executable, "-m", "training.cli", *argv], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
            stderr=stderr, env=environment, start_new_session=True,
        )  # fmt: skip
    killed, changes, seen = False, 0, _look(folder)
    while process.poll() is None:
        elapsed = time.monotonic() - began
        if (now := _look(folder)) != seen:
            seen, changes = now, changes + 1
        due = elapsed > PATIENCE_S
        if moment is not None and not killed:
            due = due or (elapsed >= moment.after_s if moment.after_s is not None else changes >= moment.changes)
        if due and not killed:
            process.send_signal(moment.signal if moment is not None else signal.SIGKILL)
            killed = True
        time.sleep(_LOOK_S)
    seconds = time.monotonic() - began
    left = _wait_for(mark)
    error = said.read_text("utf-8", "replace")
    said.unlink()
    return Run(
        code=process.returncode, killed=killed and process.returncode != 0, seconds=seconds, changes=changes,
        error=error, left=left, command=" ".join(argv),
    )  # fmt: skip


def _look(folder: Path) -> tuple[tuple[str, int, int], ...]:
    """Return names, sizes and times of what is in a folder."""
    found = []
    with contextlib.suppress(OSError):  # not there yet, or one has gone meanwhile
        for entry in os.scandir(folder):
            stat = entry.stat()
            found.append((entry.name, stat.st_size, stat.st_mtime_ns))
    return tuple(sorted(found))


def _wait_for(mark: str) -> tuple[str, ...]:
    """Wait for the processes that bear a mark in their environment; end and name those that stay."""
    began = time.monotonic()
    while (pids := _marked(mark)) and time.monotonic() - began < _LEAVE_S:
        time.sleep(0.05)
    names = []
    for pid in pids:
        with contextlib.suppress(OSError):
            names.append(Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()[:80])
            os.kill(pid, signal.SIGKILL)
    return tuple(names)


def _marked(mark: str) -> list[int]:
    wanted, found = f"{_MARK}={mark}".encode(), []
    for entry in Path("/proc").iterdir() if Path("/proc/self/environ").exists() else ():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                if wanted in (entry / "environ").read_bytes():
                    found.append(int(entry.name))
    return found
