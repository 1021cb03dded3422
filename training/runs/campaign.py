"""Many runs over several processes, each kept as it comes: what is broken off goes on where it stopped."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import closing, contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import cv2

import slam
from slam.formats import atomic_write
from slam.settings import unknown_name
from training.runs.errors import BadInput, Interrupted, check_writable

if TYPE_CHECKING:
    from rich.progress import Progress

__all__ = [
    "backend_names",
    "check_settings",
    "installed_version",
    "one_thread_each",
    "run_all",
    "start_worker",
    "worker_pool",
    "write_settings",
]

Job = TypeVar("Job")
Result = TypeVar("Result")

SETTINGS = "settings.json"
_LOG_EVERY_S = 30.0  # between two lines of progress where standard error is no terminal
# The libraries' own threads only get in each other's way where every core has its worker.
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


# ---- what was asked for ----------------------------------------------------------------------------------------


def backend_names(text: str, *, without: Mapping[str, str] | None = None) -> list[str]:
    """Return the backends of ``a,b``, each once, in that order.

    Parameters
    ----------
    text
        As typed: registered names, separated by commas.
    without
        Registered names that cannot be used here → why.

    Raises
    ------
    ValueError
        That lists the valid names.
    """
    without = without or {}
    valid = [name for name in slam.names() if name not in without]
    chosen = list(dict.fromkeys(part.strip() for part in text.split(",")))
    for name in chosen:
        if name in without:
            raise ValueError(f"--slam {name} {without[name]}; valid: {', '.join(sorted(valid))}")
        if name not in valid:
            raise unknown_name("SLAM backend", name, valid)
    return chosen


def installed_version() -> str:
    """Return this project's version, part of what a result depends on."""
    try:
        return version("mecanum-slam")
    except PackageNotFoundError:
        return "not installed"


def check_settings(out: Path, settings: Mapping[str, Any], files: Iterable[str]) -> None:
    """Refuse a folder that cannot be written to, or whose runs were made with other settings; write nothing.

    Raises
    ------
    BadInput
        In one line: what is in the way or differs, and what to do.
    """
    check_writable(out, [SETTINGS, *files])
    path = out / SETTINGS
    if not path.exists():
        return
    try:
        before = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise BadInput(f"cannot read {path} ({error}); choose another --out, or remove that one") from error
    now = json.loads(json.dumps(settings))
    if before == now:
        return
    old = before if isinstance(before, dict) else {}
    keys = [key for key in (*now, *old) if now.get(key) != old.get(key)]
    key = keys[0] if keys else "other settings"
    raise BadInput(
        f"{out} holds runs with {key} = {json.dumps(old.get(key))}, not {json.dumps(now.get(key))}; "
        "choose another --out, or give the same to go on"
    )


def write_settings(out: Path, settings: Mapping[str, Any]) -> None:
    """Make the folder, and note in it what its runs are made with."""
    out.mkdir(parents=True, exist_ok=True)
    atomic_write(out / SETTINGS, json.dumps(settings, indent=1) + "\n")


# ---- running it ------------------------------------------------------------------------------------------------


def run_all(
    jobs: Sequence[Job], work: Callable[[Job], Result], *, workers: int | None,
    keep: Callable[[Job, Result], None], what: str = "runs", apart: bool = False,
) -> None:  # fmt: skip
    """Do every job, in ``workers`` processes (None: one a core), and keep each result as it comes.

    Parameters
    ----------
    jobs, work
        ``work(job)`` is called in a spawned process with single-threaded libraries, or in this one where one
        worker is enough. Both have to be picklable.
    keep
        Called here with a job and its result.
    what
        Name of the jobs, for the progress on standard error.
    apart
        Spawn a process even for one worker: what is timed shall have its libraries single-threaded, too.

    Raises
    ------
    Interrupted
        On Ctrl-C; what was kept until then stays.
    """
    progress = _Progress(len(jobs), what)
    try:
        with closing(_results(jobs, work, min(workers or os.cpu_count() or 1, len(jobs)), apart)) as results:
            for job, result in results:
                keep(job, result)
                progress.step()
    except KeyboardInterrupt:
        raise Interrupted(
            f"interrupted after {progress.done} of {len(jobs)} {what}; run the same command again to go on"
        ) from None
    finally:
        progress.close()


def _results(
    jobs: Sequence[Job], work: Callable[[Job], Result], workers: int, apart: bool
) -> Generator[tuple[Job, Result], None, None]:
    if workers < 1 or (workers == 1 and not apart):
        for job in jobs:
            yield job, work(job)
        return
    with worker_pool(workers) as pool:
        futures = {pool.submit(work, job): job for job in jobs}
        for future in as_completed(futures):
            yield futures[future], future.result()


@contextmanager
def worker_pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Give spawned processes with single-threaded libraries, which Ctrl-C ends when it ends this one."""
    before = set(multiprocessing.active_children())
    with one_thread_each():
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(workers, mp_context=context, initializer=start_worker)
        try:
            yield pool
        except BaseException:
            # Do not wait for what is half done: nobody will keep it.
            pool.shutdown(wait=False, cancel_futures=True)
            for child in set(multiprocessing.active_children()) - before:
                child.terminate()
            raise
        pool.shutdown()


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Have the processes that are started meanwhile load their libraries with one thread each."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def start_worker() -> None:
    """Set up a worker process: it leaves Ctrl-C to its parent, and ends with it."""
    # Ctrl-C reaches every process of the terminal's group; the parent alone decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when the one that started it is gone: killed, it cannot tell its workers to stop."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


class _Progress:
    """How many are done, and how long the rest will take: a bar on a terminal, else a line now and then."""

    def __init__(self, total: int, what: str) -> None:
        self.total, self.what, self.done = total, what, 0
        self._began = self._next = time.monotonic()
        self._bar: Progress | None = _bar(total, what) if total and sys.stderr.isatty() else None
        if total:
            self._show()

    def step(self) -> None:
        self.done += 1
        self._show()

    def close(self) -> None:
        if self._bar is not None:
            self._bar.stop()

    def _show(self) -> None:
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], completed=self.done)
        elif time.monotonic() >= self._next:
            self._next = time.monotonic() + _LOG_EVERY_S
            print(f"{self.done}/{self.total} {self.what}{self._left()}", file=sys.stderr, flush=True)

    def _left(self) -> str:
        if not 0 < self.done < self.total:
            return ""
        seconds = (time.monotonic() - self._began) / self.done * (self.total - self.done)
        return f", about {seconds:.0f} s left" if seconds < 100 else f", about {seconds / 60:.0f} min left"


def _bar(total: int, what: str) -> Progress:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    bar = Progress(
        BarColumn(), MofNCompleteColumn(), TextColumn(what), TimeRemainingColumn(), TextColumn("left"),
        console=Console(stderr=True), speed_estimate_period=300.0,
    )  # fmt: skip
    bar.add_task(what, total=total)
    bar.start()
    return bar
