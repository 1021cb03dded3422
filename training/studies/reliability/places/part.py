"""The part ``places`` of the campaign."""

from __future__ import annotations

import time
from collections.abc import Mapping

from training.studies.reliability.parts import Job, Part, Row, Summary, Table
from training.studies.reliability.places.commands import PLACES as COMMAND_PLACES
from training.studies.reliability.places.commands import Skipped
from training.studies.reliability.places.processes import PROCESSES

__all__ = ["PLACES"]

_ALL = COMMAND_PLACES | PROCESSES


def _jobs(size: int, seed: int) -> list[Job]:
    return [(name, seed + k) for k in range(size) for name in _ALL]


def _work(job: Job) -> Row:
    name, seed = job
    began = time.perf_counter()
    try:
        row: Row = {"wrong": _ALL[name](seed)}
    except Skipped as why:
        row = {"wrong": [], "skipped": str(why)}
    return row | {"seconds": round(time.perf_counter() - began, 1)}


def _sum_up(rows: Mapping[Job, Row]) -> Summary:
    places = {}
    for name in dict.fromkeys(job[0] for job in rows):
        own = [row for job, row in rows.items() if job[0] == name]
        places[name] = {
            "about": (_ALL[name].__doc__ or "").strip(), "rounds": sum("skipped" not in row for row in own),
            "skipped": [row["skipped"] for row in own if "skipped" in row],
            "wrong": sum(len(row["wrong"]) for row in own), "seconds": sum(row["seconds"] for row in own),
        }  # fmt: skip
    failures = [f"{name} (seed {seed}): {line}" for (name, seed), row in rows.items() for line in row["wrong"]]
    return {"tried": sum(one["rounds"] for one in places.values()), "failures": failures, "places": places}


def _table(found: Summary) -> Table:
    rows = [
        [name, str(one["rounds"]), str(one["wrong"]), "; ".join(dict.fromkeys(one["skipped"])), one["about"]]
        for name, one in found["places"].items()
    ]
    return ["place", "rounds", "wrong", "skipped", "what is done there"], rows


PLACES = Part(
    about=(
        "No room on the disk, nowhere to write, a locked store, a busy neighbour, a clock set back; environments "
        "in forked and spawned processes, and 200 in one."
    ),
    size=1, jobs=_jobs, work=_work, sum_up=_sum_up, table=_table,
)  # fmt: skip
