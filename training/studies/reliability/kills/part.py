"""The part ``kills`` of the campaign."""

from __future__ import annotations

import shutil
import signal
import tempfile
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from training.runs.signals import TERMINATED
from training.studies.reliability.kills.alone import argv_of, undisturbed
from training.studies.reliability.kills.commands import COMMANDS, installed
from training.studies.reliability.kills.killing import Moment, Run, run
from training.studies.reliability.kills.results import damaged, differences, kept, results, tidy
from training.studies.reliability.parts import Job, Part, Row, Summary, Table

__all__ = ["KILLS"]

_KILLS = 4  # of a work item, then it is let go on to its end
_LATEST = 0.7  # of a run: where it goes on, it has less to do
_SIGNALS = (signal.SIGKILL, signal.SIGTERM)


def _jobs(size: int, seed: int) -> list[Job]:
    names = installed()
    return [(names[k % len(names)], seed, k, min(_KILLS, size - k * _KILLS)) for k in range(-(-size // _KILLS))]


def _work(job: Job) -> Row:
    """Kill a command some times, each time run again, and hold what it ends with against a run left alone."""
    name, seed, index, kills = job
    whole, alone = undisturbed(name)
    rng = np.random.default_rng([seed, index])
    row: Row = {"kills": 0, "codes": [], "wrong": [], "rows_kept": 0, "seconds": 0.0}
    with tempfile.TemporaryDirectory(prefix="kills-") as folder:
        place = Path(folder)
        before: set[str] = set()
        for k in range(kills):
            moment = _moment(rng, alone, k + index)
            done = run(argv_of(name, place / "out"), place / "out", moment)
            row["seconds"] += done.seconds
            row["wrong"] += [f"kill {k} ({moment}): {line}" for line in _judged(done, moment)]
            if done.code == 0:
                break
            row["kills"] += done.killed
            row["codes"].append(done.code)
            before = _left(place, COMMANDS[name].goes_on, before, row["wrong"])
        else:
            done = run(argv_of(name, place / "out"), place / "out")
            row["seconds"] += done.seconds
            row["wrong"] += [f"at last: {line}" for line in _judged(done, None)]
        row["rows_kept"] = len(before)
        row["stale"] = tidy(place / "out")
        row["wrong"] += [f"at last {line}" for line in differences(results(place / "out"), whole)]
    row["seconds"] = round(row["seconds"], 1)
    return row


def _moment(rng: np.random.Generator, alone: Run, k: int) -> Moment:
    """Draw a moment: of the time that a run takes, or of the writing that it does."""
    how = int(_SIGNALS[k % 2])
    if rng.random() < 0.4:
        return Moment(signal=how, after_s=float(rng.uniform(0.02, _LATEST * alone.seconds)))
    return Moment(signal=how, changes=1 + int(rng.uniform() * _LATEST * alone.changes))


def _judged(done: Run, moment: Moment | None) -> list[str]:
    """Return what is wrong with how a run ended."""
    wrong = []
    # Before Python heeds it, SIGTERM ends it as any process.
    allowed = {0} if moment is None else {0, -moment.signal}
    if moment is not None and moment.signal == signal.SIGTERM:
        allowed.add(TERMINATED)
    if done.code not in allowed:
        wrong.append(f"exit code {done.code}: {done.error[-300:]}")
    if "Traceback" in done.error:
        wrong.append(f"a traceback: {done.error[-600:]}")
    # Agents of Ray outlive a driver that was killed: they are not ours to end.
    killed = moment is not None and moment.signal == signal.SIGKILL
    left = [name for name in done.left if not (killed and name.startswith("ray::"))]
    if left:
        wrong.append(f"{len(left)} processes went on: {', '.join(left)}")
    return wrong


def _left(place: Path, goes_on: bool, before: set[str], wrong: list[str]) -> set[str]:
    """Judge what a killed run has left, on a copy; return the rows that it kept."""
    if not (place / "out").exists():
        return before
    copy = place / "copy"
    shutil.copytree(place / "out", copy)
    wrong += [f"left damaged: {line}" for line in damaged(copy)]
    now = kept(copy) if goes_on else set()
    if before - now:
        wrong.append(f"{len(before - now)} rows that were kept are gone")
    shutil.rmtree(copy)
    return now


def _sum_up(rows: Mapping[Job, Row]) -> Summary:
    commands = {}
    for name in dict.fromkeys(job[0] for job in rows):
        own = [row for job, row in rows.items() if job[0] == name]
        codes: Counter[str] = Counter(str(code) for row in own for code in row["codes"])
        commands[name] = {
            "runs": len(own), "kills": sum(row["kills"] for row in own), "codes": dict(codes),
            "rows_kept": sum(row["rows_kept"] for row in own), "stale": sum(row["stale"] for row in own),
            "wrong": sum(len(row["wrong"]) for row in own),
            "seconds": round(sum(row["seconds"] for row in own), 1),
        }  # fmt: skip
    failures = [f"{' '.join(map(str, job))}: {line}" for job, row in rows.items() for line in row["wrong"]]
    missing = sorted(COMMANDS.keys() - commands.keys())
    return {
        "tried": sum(one["kills"] for one in commands.values()), "failures": failures, "commands": commands,
        "not_run": missing,
    }  # fmt: skip


def _table(found: Summary) -> Table:
    rows = []
    for name, one in found["commands"].items():
        told = [one["runs"], one["kills"], one["codes"].get("-9", 0)]
        told += [one["kills"] - told[2], one["rows_kept"], one["stale"], one["wrong"]]
        rows.append([name, *map(str, told)])
    rows += [[name, "not run"] + [""] * 6 for name in found["not_run"]]
    return ["command", "runs", "kills", "SIGKILL", "SIGTERM", "rows kept", "temporary files left", "wrong"], rows


KILLS = Part(
    about=(
        "Commands killed by SIGKILL and SIGTERM at random moments and run again: nothing lost, nothing doubled, "
        "no file half written, no process left, and results equal to a run that was left alone."
    ),
    size=100, jobs=_jobs, work=_work, sum_up=_sum_up, table=_table,
)  # fmt: skip
