"""``mecanum study recovery``: faults are made mid-episode, and it is seen whether the belief survives them.

Every fault, backend and seed is one episode; episodes without a fault give false alarms, and how reliable the
health is. ``docs/studies/recovery.md`` has what was measured.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

import agents
from mecanum_env.arguments import make_config
from mecanum_env.rooms import load
from slam.formats import atomic_write
from slam.settings import check_name
from training.episodes.room_pictures import parse_seeds
from training.figures.charts import png
from training.figures.tables import number, text_table
from training.runs.campaign import backend_names, keep_settings, made_by
from training.runs.errors import bad_input
from training.runs.options import Backends, Out, Ray, Seeds, Workers, workers_of
from training.runs.rows import resume
from training.runs.running import write_json
from training.runs.typed import parts_of
from training.studies.recovery.faults import FAULTS
from training.studies.recovery.figures import draw_recovery, draw_reliability, false_alarms, reliability, sum_up
from training.studies.recovery.runs import Job, Row, run_job

__all__ = ["study"]

FILES = ("recovery.json", "recovery.png", "reliability.png")
STORE = "episodes.jsonl"  # what each episode left
_MOST_SEEDS = 10_000


def study(
    faults: Annotated[str, typer.Option(help=f"Of {', '.join(FAULTS)}; separated by commas.")] = ",".join(FAULTS),
    slam: Backends = "invariant-ekf",
    agent: Annotated[str, typer.Option(help="Who explores.")] = "nearest-frontier",
    rooms: Annotated[
        str, typer.Option(help="Generators of rooms, files of plans, separated by commas.")
    ] = "apartment",
    noise: Annotated[str, typer.Option(help="Noise preset.")] = "nominal",
    seeds: Seeds = "10000:10049",
    max_steps: Annotated[
        int, typer.Option(min=1, max=1_000_000, help="Step limit of episodes without a fault.")
    ] = 3000,
    workers: Workers = None,
    ray: Ray = None,
    out: Out = Path("out/recovery"),
) -> None:
    """Make faults mid-episode: whether a belief is lost, knows it, and is right again; how true its health is."""
    with bad_input():
        agents.check(agent)
        names = backend_names(slam)
        chosen = parts_of(faults)
        for name in chosen:
            check_name("fault", name, FAULTS)
        places = parts_of(rooms)
        for place in places:
            if Path(place).suffix:
                load(place)
            where: dict[str, Any] = {"floor_plan" if Path(place).suffix else "rooms": place}
            make_config(noise=noise, **where)
        numbers = parse_seeds(seeds, most=_MOST_SEEDS)
        made = made_by(*places, agents=[agent], backends=names)
        settings = {**made, "agent": agent, "noise": noise, "max_steps": max_steps}
    who = workers_of(workers, ray)
    keep_settings(out, settings, FILES)
    jobs: list[Job] = [
        (fault, name, agent, place, noise, seed, max_steps)
        for seed in numbers for fault in chosen for place in places for name in names
    ]  # fmt: skip
    rows = resume(out / STORE, jobs, run_job, workers=who, what="episodes")
    found = _figures(rows, names, chosen)
    found["config"] = settings | {"rooms": [Path(p).name for p in places], "seeds": seeds}
    write_json(out / "recovery.json", found)
    groups = {f"{fault}, {name}": _of(rows, fault, name) for fault in chosen if fault != "none" for name in names}
    if groups:
        atomic_write(out / "recovery.png", png(draw_recovery(groups)))
    diagrams = {name: found[name]["reliability"] for name in names if found[name]["reliability"]}
    if diagrams:
        atomic_write(out / "reliability.png", png(draw_reliability(diagrams)))
    print(_told(found, names))


def _of(rows: dict[Job, Row], fault: str, name: str) -> list[Row]:
    return [row for job, row in rows.items() if job[:2] == (fault, name)]


def _figures(rows: dict[Job, Row], names: list[str], chosen: list[str]) -> dict[str, Any]:
    """Return what ``recovery.json`` holds: per backend its faults, false alarms and reliability."""
    found: dict[str, Any] = {}
    for name in names:
        every = [row for job, row in rows.items() if job[1] == name and "count" in row and sum(row["count"])]
        found[name] = {
            "faults": {fault: sum_up(_of(rows, fault, name)) for fault in chosen if fault != "none"},
            "false_alarms": false_alarms(_of(rows, "none", name)) if "none" in chosen else None,
            "reliability": reliability(every) if every else None,
        }
    return found


def _told(found: dict[str, Any], names: list[str]) -> str:
    table, lines = [], []
    for name in names:
        one = found[name]
        for fault, f in one["faults"].items():
            table.append([
                name, fault, f"{f['recovered']} of {f['episodes']}", number(f["recovered_s_median"], 1, "-"),
                number(f["recovered_s_max"], 1, "-"), str(f["doubled_walls"]), str(f["contacts"]),
            ])  # fmt: skip
        if one["false_alarms"]:
            a = one["false_alarms"]
            lines.append(f"{name}: given up {a['times_lost']} times in {a['hours']:.2f} h without a fault")
        if one["reliability"]:
            r = one["reliability"]
            lines.append(
                f"{name}: health {r['health_mean']:.4f} on average, true {r['true_mean']:.4f}; "
                f"expected calibration error {r['expected_error']:.4f}"
            )
    head = ["backend", "fault", "recovered", "median [s]", "longest [s]", "doubled walls", "contacts"]
    return "\n".join([*([text_table(head, table)] if table else []), *lines])
