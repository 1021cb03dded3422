"""Many runs over several processes, each kept as it comes: what is broken off goes on where it stopped."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, closing
from pathlib import Path
from typing import Any, TypeVar

import slam
from mecanum_env.rooms.files.importers import MAP_SUFFIXES, image_of
from slam.files import quoted, read_json
from slam.settings import check_name
from training.runs.cluster import Cluster, RayPool, ray_pool
from training.runs.errors import BadInput, Interrupted, bad_input, check_writable
from training.runs.processes import ProcessPool, process_pool
from training.runs.progress import Progress
from training.runs.provenance import own_code, policy_digest, project_digest, short_digest
from training.runs.running import versions, write_json
from training.runs.typed import parts_of

__all__ = ["Pool", "Workers", "backend_names", "keep_settings", "made_by", "run_all", "worker_pool"]

Job = TypeVar("Job")
Result = TypeVar("Result")

Workers = int | Cluster | None
"""Who does the work: so many processes of this machine (None: one a core), or those of a Ray cluster."""

Pool = ProcessPool | RayPool
"""An executor of work, with a ``channel`` for what is said meanwhile."""

SETTINGS = "settings.json"
_OWN = "own code"


# ---- what was asked for ----------------------------------------------------------------------------------------


def backend_names(text: str, *, without: Mapping[str, str] | None = None) -> list[str]:
    """Return the backends of ``a,b``, each once, in that order; ``ValueError`` lists the valid names.

    ``without`` has names of backends that cannot be used here, and why.
    """
    without = without or {}
    valid = [name for name in slam.names() if name not in without]
    chosen = parts_of(text)
    for name in chosen:
        if name in without:
            raise ValueError(f"--slam {name} {without[name]}; valid: {', '.join(sorted(valid))}")
        check_name("SLAM backend", name, valid)
    return chosen


def made_by(*files: str | Path, agents: Iterable[str] = (), backends: Iterable[str] = ()) -> dict[str, Any]:
    """Return what results depend on besides what is asked for: the code, and what files of these names hold.

    Names of no file, such as those of generators of rooms, are the code's. A ROS map counts with its image, a
    policy with the JSON beside it that says how its driver is set, an agent or a backend of one's own with its
    source.
    """
    agents = list(agents)
    found = {str(name): _digest(Path(name)) for name in (*files, *agents) if Path(name).is_file()}
    own = own_code(agents, backends)
    return {
        "version": versions().get("mecanum-slam", "not installed"),
        "code": project_digest(),
        **({"files": found} if found else {}),
        **({_OWN: own} if own else {}),
    }


def _digest(path: Path) -> str:
    if path.suffix == ".safetensors":
        return policy_digest(path)
    files = [path]
    with bad_input():
        if path.suffix.lower() in MAP_SUFFIXES:
            files.append(image_of(path))
    return short_digest(each.read_bytes() for each in files)


def _holds_anything(out: Path) -> bool:
    """Whether a folder has more than its settings and stores without a row."""
    files = (path for path in out.iterdir() if path.name != SETTINGS)
    return any(not path.is_file() or path.stat().st_size for path in files)


def keep_settings(
    out: Path, settings: Mapping[str, Any], files: Iterable[str], *,
    holds_runs: Callable[[Path], bool] = _holds_anything,
) -> None:  # fmt: skip
    """Make a folder, and note in it what its runs are made with.

    Refused, with nothing written, is one that is not to be written to, or holds runs of other settings. One that
    was begun in, and has no run yet, takes the new ones.

    Raises
    ------
    BadInput
        In one line: what is in the way or differs, and what to do.
    """
    check_writable(out, [SETTINGS, *files])
    path = out / SETTINGS
    now = json.loads(json.dumps(settings))
    try:
        before = read_json(path, nan=True) if path.exists() else now
    except ValueError as error:
        raise BadInput(f"{error}; choose another --out, or remove that one") from error
    if before != now and not holds_runs(out):
        before = now
    if isinstance(before, dict) and isinstance(kept := before.get(_OWN, {}), dict) and (kept or _OWN in now):
        # Agents and backends may be added to those that are there.
        asked = now.get(_OWN, {})
        before[_OWN], now[_OWN] = asked | kept, kept | asked
    if before != now:
        old = before if isinstance(before, dict) else {}
        keys = [key for key in (*now, *old) if now.get(key) != old.get(key)]
        key = keys[0] if keys else "other settings"
        if key in ("code", _OWN):
            raise BadInput(f"{out} holds runs of other code; go back to it, or choose another --out")
        raise BadInput(
            f"{out} holds runs with {quoted(key)[1:-1]} = {_told(old.get(key))}, not {_told(now.get(key))}; "
            "choose another --out, or give the same to go on"
        )
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / SETTINGS, now)


def _told(value: Any) -> str:
    return json.dumps(value)[:200]


# ---- running it ------------------------------------------------------------------------------------------------


def run_all(
    jobs: Sequence[Job], work: Callable[[Job], Result], *, workers: Workers,
    keep: Callable[[Job, Result], None], what: str = "runs", apart: bool = False,
) -> None:  # fmt: skip
    """Do every job, and keep each result as it comes.

    Parameters
    ----------
    jobs, work
        ``work(job)`` is called in another process with single-threaded libraries, or in this one where one
        worker of this machine is enough. Both have to be picklable.
    workers
        See :data:`Workers`.
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
    RuntimeError
        Where a worker process dies; the same holds.
    """
    done, total = 0, len(jobs)
    if not total:
        return
    try:
        with Progress(what, total) as progress, closing(_results(jobs, work, workers, apart)) as results:
            progress.show(0, f"0/{total}")
            for job, result in results:
                keep(job, result)
                done += 1
                progress.show(done, f"{done}/{total}")
    except KeyboardInterrupt:
        raise Interrupted(
            f"interrupted after {done} of {total} {what}; run the same command again to go on"
        ) from None
    except BrokenProcessPool as error:
        raise RuntimeError(
            f"a worker process died (out of memory?) after {done} of {total} {what}, which are kept; "
            "run the same command again to go on"
        ) from error


def _results(
    jobs: Sequence[Job], work: Callable[[Job], Result], workers: Workers, apart: bool
) -> Generator[tuple[Job, Result], None, None]:
    if not isinstance(workers, Cluster):
        workers = min(workers or os.cpu_count() or 1, len(jobs))
        if workers == 1 and not apart:
            for job in jobs:
                yield job, work(job)
            return
    with worker_pool(workers) as pool:
        futures = {pool.submit(work, job): job for job in jobs}
        for future in as_completed(futures):
            yield futures.pop(future), future.result()  # what is kept is held here no longer


def worker_pool(workers: Workers) -> AbstractContextManager[Pool]:
    """Give processes with single-threaded libraries, which Ctrl-C ends when it ends this one."""
    if isinstance(workers, Cluster):
        return ray_pool(workers)
    return process_pool(workers or os.cpu_count() or 1)
