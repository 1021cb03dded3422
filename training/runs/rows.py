"""Rows of a long run, kept as they come, a line each: what is broken off goes on where it stopped."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from training.runs.campaign import Workers, run_all

__all__ = ["resume"]

Job = TypeVar("Job", bound=tuple[Any, ...])  # of strings and numbers
Row = TypeVar("Row")


def resume(
    store: Path, jobs: Sequence[Job], work: Callable[[Job], Row], *, workers: Workers, what: str = "runs",
    apart: bool = False,
) -> dict[Job, Row]:  # fmt: skip
    """Do the jobs that a store does not hold yet; return the rows of all of them, in their order.

    Parameters
    ----------
    store
        Lines of JSON, ``[job, row]``. A line that was cut off is a job to be done again.
    jobs, work, workers, what, apart
        See :func:`training.runs.campaign.run_all`; rows are what JSON can hold.

    Raises
    ------
    Interrupted
        On Ctrl-C; running it again goes on.
    """
    store.parent.mkdir(parents=True, exist_ok=True)
    rows: dict[Job, Row] = {}
    for line in store.read_text("utf-8").splitlines() if store.exists() else ():
        try:
            job, row = json.loads(line)
            rows[tuple(job)] = row  # type: ignore[index]
        except (ValueError, TypeError):
            continue
    with store.open("a", encoding="utf-8") as file:
        if file.tell():
            file.write("\n")  # ends a line that was cut off

        def keep(job: Job, row: Row) -> None:
            rows[job] = row
            file.write(json.dumps([job, row]) + "\n")
            file.flush()

        run_all([job for job in jobs if job not in rows], work, workers=workers, keep=keep, what=what, apart=apart)
    return {job: rows[job] for job in jobs}
