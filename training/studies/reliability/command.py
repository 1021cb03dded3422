"""``mecanum study reliability``: a campaign against the whole; each part has a size of its own.

What is found is in ``<part>.json`` and on one page; ``docs/studies/reliability.md`` tells what was mended.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from slam.formats import atomic_write
from slam.settings import check_name
from training.figures.tables import text_table
from training.runs.campaign import keep_settings, made_by
from training.runs.errors import bad_input
from training.runs.options import Out, Ray, Seed, workers_of
from training.runs.rows import resume
from training.runs.running import write_json
from training.runs.typed import parts_of
from training.studies.reliability.files.part import FILES
from training.studies.reliability.kills.part import KILLS
from training.studies.reliability.page import page
from training.studies.reliability.parts import Part, Summary
from training.studies.reliability.places.part import PLACES
from training.studies.reliability.soak.part import SOAK
from training.studies.reliability.steps.part import STEPS

__all__ = ["PARTS", "study"]

PARTS: dict[str, Part] = {"files": FILES, "steps": STEPS, "kills": KILLS, "places": PLACES, "soak": SOAK}
"""Name → part; each has an option of its name, its size."""

PAGE = "report.html"


def study(
    parts: Annotated[str, typer.Option(help=f"Of {', '.join(PARTS)}; separated by commas.")] = ",".join(PARTS),
    files: Annotated[int, typer.Option(min=1, max=10**9, help="Files for each reader.")] = int(FILES.size),
    steps: Annotated[int, typer.Option(min=1, max=10**9, help="Steps of all environments.")] = int(STEPS.size),
    kills: Annotated[int, typer.Option(min=1, max=10**6, help="Kills of running commands.")] = int(KILLS.size),
    places: Annotated[int, typer.Option(min=1, max=1000, help="Rounds of places.")] = int(PLACES.size),
    soak: Annotated[float, typer.Option("--soak", "--hours", min=0.001, max=1000, help="Hours.")] = SOAK.size,
    seed: Seed = 0,
    workers: Annotated[int, typer.Option(min=1, max=1024, help="Processes.")] = 1,
    ray: Ray = None,
    out: Out = Path("out/reliability"),
) -> None:
    """Try to break the whole: files, steps, kills, places, hours. Goes on where it was broken off.

    Without sizes it is the whole campaign, of days.

    \b
    Examples:
      mecanum study reliability --files 60 --steps 3000 --kills 4 --places 1 --hours 0.1
      mecanum study reliability --parts files,steps --files 1000 --steps 1000000 --workers 4
    """  # noqa: D301
    with bad_input():
        chosen = parts_of(parts)
        for name in chosen:
            check_name("part", name, PARTS)
    sizes = {"files": files, "steps": steps, "kills": kills, "places": places, "soak": soak}
    who = workers_of(workers, ray)
    keep_settings(out, made_by() | {"seed": seed}, [PAGE, *(f"{name}.json" for name in PARTS)])
    found: dict[str, Summary] = {}
    for name in chosen:
        part = PARTS[name]
        rows = resume(out / f"{name}.jsonl", part.jobs(sizes[name], seed), part.work, workers=who, what=name)
        found[name] = part.sum_up(rows) | {"size": sizes[name], "seed": seed}
        write_json(out / f"{name}.json", found[name])
    atomic_write(out / PAGE, page({name: (PARTS[name], summary) for name, summary in found.items()}))
    for name, summary in found.items():
        print(text_table(*PARTS[name].table(summary)))
        print(f"{name}: {summary['tried']} tried, {len(summary['failures'])} failed")
        print("\n".join(f"  {line}" for line in summary["failures"][:_SHOWN]))
    if any(summary["failures"] for summary in found.values()):
        raise typer.Exit(1)


_SHOWN = 20  # failures on the terminal
