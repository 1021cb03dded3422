"""The part ``files`` of the campaign: so many files for each reader, the hostile ones first."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from training.studies.reliability.files.child import BOUND_MB
from training.studies.reliability.files.guard import BOUND_S, results
from training.studies.reliability.files.readers import READERS
from training.studies.reliability.parts import Job, Part, Row, Summary, Table

__all__ = ["FILES"]

_AT_ONCE = 250  # files of a work item
_GOOD = ("read", "refused")


def _jobs(size: int, seed: int) -> list[Job]:
    return [
        (name, seed, first, min(_AT_ONCE, size - first)) for name in READERS for first in range(0, size, _AT_ONCE)
    ]


def _work(job: Job) -> Row:
    """Have the files of a work item read; ``ends`` counts how it went, ``failed`` are those that went wrong."""
    rows = list(results(*job))
    name, seed, _, _ = job
    for row in rows:
        if row["seconds"] > BOUND_S:
            row["end"] = "time"
        if "case" not in row:  # its process is gone
            row["case"] = READERS[name].case(seed, row["index"]).name
    return {
        "ends": dict(Counter(row["end"] for row in rows)),
        "cli": sum(row.get("by_command", False) for row in rows),
        "seconds": max(row["seconds"] for row in rows),
        "mb": max(row["mb"] for row in rows),
        "failed": [row for row in rows if row["end"] not in _GOOD],
    }


def _sum_up(rows: Mapping[Job, Row]) -> Summary:
    readers = {}
    for name in dict.fromkeys(job[0] for job in rows):
        own = [row for job, row in rows.items() if job[0] == name]
        ends: Counter[str] = sum((Counter(row["ends"]) for row in own), Counter())
        readers[name] = {
            "about": READERS[name].about, "files": ends.total(), "ends": dict(ends),
            "hostile": min(len(READERS[name].hostile), ends.total()), "by_command": sum(row["cli"] for row in own),
            "seconds_max": max(row["seconds"] for row in own), "mb_max": max(row["mb"] for row in own),
        }  # fmt: skip
    failures = [
        f"{job[0]} --seed {job[1]}, file {one['index']} ({one['case']}): {one['end']}: {one.get('said', '')}"
        for job, row in rows.items() for one in row["failed"]
    ]  # fmt: skip
    return {
        "tried": sum(one["files"] for one in readers.values()), "failures": failures, "readers": readers,
        "bound_s": BOUND_S, "bound_mb": BOUND_MB,
    }  # fmt: skip


def _table(found: Summary) -> Table:
    head = ["reader", "files", "hostile", "read", "refused", "failed", "by command", "longest [s]", "most [MB]"]
    rows = []
    for name, one in found["readers"].items():
        failed = sum(count for end, count in one["ends"].items() if end not in _GOOD)
        counts = [
            one["files"],
            one["hostile"],
            *(one["ends"].get(end, 0) for end in _GOOD),
            failed,
            one["by_command"],
        ]
        rows.append([name, *map(str, counts), f"{one['seconds_max']:.2f}", f"{one['mb_max']:.0f}"])
    return head, rows


FILES = Part(
    about="Mutated and hostile files: read as they are, or refused in one line, in bounded time and memory.",
    size=10_000, jobs=_jobs, work=_work, sum_up=_sum_up, table=_table,
)  # fmt: skip
