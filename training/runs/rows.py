"""Rows of a long run, kept as they come, a line each: what is broken off goes on where it stopped."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from slam.files import check_file, parse_json
from training.runs.campaign import Workers, run_all
from training.runs.errors import bad_input

__all__ = ["resume"]

Job = TypeVar("Job", bound=tuple[Any, ...])  # of strings and numbers
Row = TypeVar("Row")

_LONGEST_LINE = 64 * 2**20


def resume(
    store: Path, jobs: Sequence[Job], work: Callable[[Job], Row], *, workers: Workers, what: str = "runs",
    apart: bool = False,
) -> dict[Job, Row]:  # fmt: skip
    """Do the jobs that a store does not hold yet; return the rows of all of them, in their order.

    Parameters
    ----------
    store
        Lines of JSON, ``[job, row, checksum]``. A line that was cut off or damaged is a job to be done again.
    jobs, work, workers, what, apart
        See :func:`training.runs.campaign.run_all`; rows are what JSON can hold.

    Raises
    ------
    BadInput
        Where the store is no file.
    Interrupted
        On Ctrl-C; running it again goes on.
    """
    store.parent.mkdir(parents=True, exist_ok=True)
    with bad_input():
        if store.exists() or store.is_symlink():
            check_file(store, what="rows")
    wanted = {_text(job): job for job in jobs}
    rows = {wanted[job]: row for job, row in _kept(store) if job in wanted}
    with store.open("a", encoding="utf-8") as file:
        if file.tell():
            file.write("\n")  # ends a line that was cut off

        def keep(job: Job, row: Row) -> None:
            rows[job] = row
            told = json.dumps([job, row])
            file.write(f"{told[:-1]}, {zlib.crc32(told.encode())}]\n")
            file.flush()

        run_all(
            [job for job in dict.fromkeys(jobs) if job not in rows],
            work,
            workers=workers,
            keep=keep,
            what=what,
            apart=apart,
        )
    return {job: rows[job] for job in jobs}


def _text(job: Any) -> str:
    return json.dumps(job)  # tells 0 from 0.0 and from false, which are equal


def _kept(store: Path) -> Iterator[tuple[str, Any]]:
    """Yield the jobs, as JSON, and rows of the lines that are whole."""
    if not store.exists():
        return
    with store.open("rb") as file:
        while line := file.readline(_LONGEST_LINE):
            try:
                found = parse_json(line, what="a row", nan=True)
                job, row, checksum = found
                if checksum == zlib.crc32(json.dumps([job, row]).encode()):
                    yield _text(job), row
            except (ValueError, TypeError):
                continue
