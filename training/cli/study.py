"""``mecanum study`` on the command line: studies by name, each with its options in a module of its own."""

from __future__ import annotations

from importlib import import_module
from typing import Annotated, Any

import typer

from training.runs.errors import BadInput, needs_extra, suggestion
from training.runs.options import Command

__all__ = ["STUDIES", "study", "study_command"]

STUDIES = {
    "accuracy": ("training.studies.accuracy", "errors of explored maps over seeds, rooms and backends"),
    "belief": ("training.studies.belief", "where a belief stops being true: NEES, NIS, the largest innovations"),
    "calibration": ("training.studies.calibrate", "V of the simulated robot, beside what its estimators are told"),
    "digests": ("training.studies.digests", "same seed, same bits: digests of episodes, to compare commits by"),
    "dp-slam-cost": (
        "training.studies.costs.dp_slam_cost",
        "cost of DP-SLAM's particles: one grid, or one each",
    ),
    "leaderboard": ("training.benchmark.leaderboard", "put a benchmark's figures into a Markdown page"),
    "learned-tour": ("training.dungeons.training", "train learned-tour on plans like the dungeons benchmark's"),
    "merging": (
        "training.studies.teams.merging",
        "maps of two robots that know nothing of each other's start, merged",
    ),
    "moving-picture": ("training.views.moving_picture", "the README's moving picture"),
    "paper-b": ("training.studies.paper_b", "what EKF-SLAM and FastSLAM do to a map's covariance"),
    "paper-c": (
        "training.studies.paper_c.figures",
        "a filter by differential transforms: errors, cost, use",
    ),
    "paper-d": ("training.studies.paper_d", "how far mapped corners are from the true ones, backend by backend"),
    "ratios": ("training.studies.ratios", "one agent's errors and times against the others' in a benchmark"),
    "recording-cost": ("training.studies.costs.recording_cost", "what recording an episode takes"),
    "recovery": (
        "training.studies.recovery.command",
        "faults made mid-episode: is the belief lost, does it know, is it found again?",
    ),
    "reliability": (
        "training.studies.reliability.command",
        "a campaign against the whole: hostile files, steps, kills, full disks, hours",
    ),
    "scale": ("training.studies.costs.scale", "what a step and a decision take, against the area explored"),
    "team-cost": ("training.studies.teams.cost", "what a step takes against the number of robots"),
    "team-filters": (
        "training.studies.teams.filters",
        "robots that map one building: one filter for all, or one each",
    ),
    "worlds": (
        "training.studies.worlds",
        "robots, lidars and noises drawn by lot: what holds where nothing was tuned",
    ),
}
"""Name → the module whose function ``study`` it is, and a line for the list."""


def study(
    context: typer.Context,
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="Which study; none lists them.")] = None,
) -> None:
    """Run a study: a question asked of the estimators, the agents or the code. Without a name, list them.

    \b
    Examples:
      mecanum study
      mecanum study paper-b --help
      mecanum study paper-b --out out/paper_b
    """  # noqa: D301
    if name in (None, "-h", "--help"):
        print("Studies (mecanum study NAME --help shows the options of one):\n")
        print("\n".join(f"  {known:<15} {line}" for known, (_, line) in STUDIES.items()))
        return
    assert name is not None
    code = study_command(name).main(args=context.args, prog_name=f"mecanum study {name}", standalone_mode=False)
    if isinstance(code, int) and code:
        raise typer.Exit(code)


def study_command(name: str) -> Any:
    """Return the click command of a study; its module is imported here and not before."""
    if name not in STUDIES:
        raise BadInput(f"unknown study {name!r}{suggestion(name, STUDIES)}; valid: {', '.join(STUDIES)}")
    app = typer.Typer(
        add_completion=False, rich_markup_mode=None, context_settings={"help_option_names": ["-h", "--help"]}
    )
    with needs_extra("train"):
        app.command(name, cls=Command)(import_module(STUDIES[name][0]).study)
    return typer.main.get_command(app)
