"""Worker processes of this machine: single-threaded libraries, and no process that outlives its parent."""

from __future__ import annotations

import multiprocessing
import os
import queue
import re
import signal
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2

__all__ = ["ONE_THREAD", "ProcessPool", "memory_mb", "one_thread_each", "process_pool", "start_worker"]

ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)
"""What a worker's environment says: libraries' own threads only get in each other's way on cores that all work."""


class ProcessPool(ProcessPoolExecutor):
    """Processes of this machine."""

    @contextmanager
    def channel(self) -> Iterator[queue.Queue[Any]]:
        """Give a queue that work may be handed, to say something before it is done."""
        with multiprocessing.get_context("spawn").Manager() as manager:
            yield manager.Queue()


@contextmanager
def process_pool(workers: int) -> Iterator[ProcessPool]:
    """Give spawned processes with single-threaded libraries, which Ctrl-C ends when it ends this one."""
    before = set(multiprocessing.active_children())
    with one_thread_each():
        context = multiprocessing.get_context("spawn")
        pool = ProcessPool(workers, mp_context=context, initializer=start_worker)
        try:
            yield pool
        except BaseException:
            # Do not wait for what is half done: nobody will keep it.
            pool.shutdown(wait=False, cancel_futures=True)
            for child in set(multiprocessing.active_children()) - before:
                child.kill()
            raise
        pool.shutdown()


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Have the processes that are started meanwhile load their libraries with one thread each."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def start_worker() -> None:
    """Set up a worker process: it leaves Ctrl-C and SIGTERM to its parent, and ends with it."""
    # Ctrl-C reaches every process of the terminal's group, a scheduler's SIGTERM every one of its job; the parent
    # alone decides what they mean.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    cv2.setNumThreads(1)
    sys.stdout = sys.stderr  # standard output is the parent's, for its result alone
    threading.Thread(target=_end_with_parent, daemon=True).start()


def memory_mb(what: str = "VmRSS") -> float:
    """Return the memory [MB of 2²⁰ bytes] that this process has resident; 0 where the system does not tell.

    ``VmHWM`` is the most that it ever had, ``VmSize`` all that it has reserved.
    """
    status = Path("/proc/self/status")
    found = re.search(rf"{what}:\s+(\d+) kB", status.read_text()) if status.exists() else None
    return int(found[1]) / 1024.0 if found else 0.0


def _end_with_parent() -> None:
    """End this process when the one that started it is gone: killed, it cannot tell its workers to stop."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
