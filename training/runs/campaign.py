"""Many runs over several processes, each kept as it comes: what is broken off goes on where it stopped."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, TypeVar

import cv2

import slam
from slam.formats import atomic_write
from slam.settings import unknown_name
from training.runs.errors import BadInput, Interrupted, check_writable
from training.runs.progress import Progress
from training.runs.running import versions

__all__ = [
    "backend_names",
    "installed_version",
    "keep_settings",
    "one_thread_each",
    "run_all",
    "start_worker",
    "worker_pool",
]

Job = TypeVar("Job")
Result = TypeVar("Result")

SETTINGS = "settings.json"
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
    return versions().get("mecanum-slam", "not installed")


def keep_settings(out: Path, settings: Mapping[str, Any], files: Iterable[str]) -> None:
    """Make a folder, and note in it what its runs are made with.

    Refused, with nothing written, is one that is not to be written to, or holds runs of other settings.

    Raises
    ------
    BadInput
        In one line: what is in the way or differs, and what to do.
    """
    check_writable(out, [SETTINGS, *files])
    path = out / SETTINGS
    now = json.loads(json.dumps(settings))
    try:
        before = json.loads(path.read_text("utf-8")) if path.exists() else now
    except (OSError, ValueError) as error:
        raise BadInput(f"cannot read {path} ({error}); choose another --out, or remove that one") from error
    if before != now:
        old = before if isinstance(before, dict) else {}
        keys = [key for key in (*now, *old) if now.get(key) != old.get(key)]
        key = keys[0] if keys else "other settings"
        raise BadInput(
            f"{out} holds runs with {key} = {json.dumps(old.get(key))}, not {json.dumps(now.get(key))}; "
            "choose another --out, or give the same to go on"
        )
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
    done, total = 0, len(jobs)
    if not total:
        return
    try:
        at_most = min(workers or os.cpu_count() or 1, total)
        with Progress(what, total) as progress, closing(_results(jobs, work, at_most, apart)) as results:
            progress.show(0, f"0/{total}")
            for job, result in results:
                keep(job, result)
                done += 1
                progress.show(done, f"{done}/{total}")
    except KeyboardInterrupt:
        raise Interrupted(
            f"interrupted after {done} of {total} {what}; run the same command again to go on"
        ) from None


def _results(
    jobs: Sequence[Job], work: Callable[[Job], Result], workers: int, apart: bool
) -> Generator[tuple[Job, Result], None, None]:
    if workers == 1 and not apart:
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
                child.kill()
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
    """Set up a worker process: it leaves Ctrl-C and SIGTERM to its parent, and ends with it."""
    # Ctrl-C reaches every process of the terminal's group, a scheduler's SIGTERM every one of its job; the parent
    # alone decides what they mean.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    cv2.setNumThreads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when the one that started it is gone: killed, it cannot tell its workers to stop."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
