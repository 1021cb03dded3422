"""The part ``steps`` of the campaign."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from training.studies.reliability.parts import Job, Part, Row, Summary, Table
from training.studies.reliability.steps.again import digest_elsewhere
from training.studies.reliability.steps.items import Item, items
from training.studies.reliability.steps.runs import work
from training.studies.reliability.steps.watch import DEEPEST_M

__all__ = ["STEPS"]

_GROWTH = {"mb": 300.0, "handles": 8}
"""What a process may grow by from its tenth item on: rooms and maps differ, and so does what lies between them."""

_WARM = 10  # items, in which kernels are loaded and libraries take what they keep


def _jobs(size: int, seed: int) -> list[Job]:
    return [tuple(item) for item in items(size, seed)]


def _work(job: Job) -> Row:
    item = Item(*job)
    row = work(item)
    if item.again:
        row["elsewhere"] = elsewhere = digest_elsewhere(item)
        if elsewhere != row["digest"]:
            row["wrong"]["another process gives other bits"] = f"{row['digest']} here, {elsewhere} there"
    return row


def _sum_up(rows: Mapping[Job, Row]) -> Summary:
    done = [(Item(*job), row) for job, row in rows.items()]
    factors = {
        name: _counts([(getattr(item, name), row) for item, row in done])
        for name in ("kind", "rooms", "slam", "noise", "robot", "driver", "team")
    }
    growth = _growth([row for _, row in done])
    failures = [
        f"{' '.join(map(str, item))}: {what}: {where}"
        for item, row in done for what, where in row["wrong"].items()
    ]  # fmt: skip
    failures += [
        f"{growth[name]} {name} more after {growth['items']} items of one process, at most {most} are allowed"
        for name, most in _GROWTH.items() if growth[name] > most
    ]  # fmt: skip
    return {
        "tried": sum(row["steps"] for _, row in done), "failures": failures, "items": len(done),
        **{name: sum(row[name] for _, row in done) for name in ("episodes", "collisions", "refused")},
        "again": sum("elsewhere" in row for _, row in done),
        "deepest_mm": max(row["deepest_mm"] for _, row in done), "deepest_allowed_mm": 1e3 * DEEPEST_M,
        "seconds": round(sum(row["seconds"] for _, row in done), 1), "growth": growth, "factors": factors,
    }  # fmt: skip


def _counts(rows: list[tuple[str, Row]]) -> dict[str, Any]:
    steps: Counter[str] = Counter()
    wrong: Counter[str] = Counter()
    for name, row in rows:
        steps[name] += row["steps"]
        wrong[name] += len(row["wrong"])
    return {name: {"steps": steps[name], "wrong": wrong[name]} for name in sorted(steps)}


def _growth(rows: list[Row]) -> dict[str, Any]:
    """Return by how much the process with most items grew, by its medians over the first and last fifth."""
    pid = Counter(row["pid"] for row in rows).most_common(1)[0][0]
    own = [row for row in rows if row["pid"] == pid][_WARM:]
    share = max(len(own) // 5, 1)
    grown: dict[str, float] = {"items": len(own)}
    for name in _GROWTH:
        values = [row[name] for row in own] or [0.0]
        grown[name] = round(float(np.median(values[-share:]) - np.median(values[:share])), 1)
        grown[f"{name}_most"] = max(values)
    return grown


def _table(found: Summary) -> Table:
    rows = [
        ["all", f"{found['items']} items", f"{found['tried']:,}", str(len(found["failures"]))],
        ["", "episodes; contacts", f"{found['episodes']:,}; {found['collisions']:,}", ""],
        ["", "nonsense refused", f"{found['refused']:,}", ""],
        ["", "items repeated in another process", str(found["again"]), ""],
        ["", "deepest in a body [mm]", f"{found['deepest_mm']:.2f}", ""],
        ["", "memory [MB], handles", f"{found['growth']['mb']:+.1f}, {found['growth']['handles']:+.0f}", ""],
    ]
    for factor, names in found["factors"].items():
        for k, (name, one) in enumerate(names.items()):
            rows.append(["" if k else factor, name, f"{one['steps']:,}", str(one["wrong"])])
    return ["factor", "", "steps", "wrong"], rows


STEPS = Part(
    about=(
        "Every environment, room, backend, agent and noise, driven by agents and by whoever means no good: what "
        "is seen, paid and believed, walls, contacts, memory, handles, and the same bits in another process."
    ),
    size=10**7, jobs=_jobs, work=_work, sum_up=_sum_up, table=_table,
)  # fmt: skip
