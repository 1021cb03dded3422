"""``mecanum benchmark`` on the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from training.runs import options as opt
from training.runs.errors import BadInput, suggestion
from training.runs.typed import parts_of

__all__ = ["benchmark"]


def benchmark(
    suite: Annotated[
        str | None,
        typer.Option(
            help="rooms, apartments, corridors, caves, mazes, each also with -slippery; separated by commas, or "
            "all.  [default: apartments, or floor-plans where --floor-plans is given]"
        ),
    ] = None,
    agents: Annotated[
        str,
        typer.Option(help="Agents or policy files, separated by commas; known-map is a bound."),
    ] = "nearest-frontier",
    slam: Annotated[
        str | None, typer.Option(help="SLAM backends, separated by commas.  [default: invariant-ekf]")
    ] = None,
    split: Annotated[
        str | None,
        typer.Option(help="Seeds: test (10000:10049), validation (1000:1049) or train (0:999).  [default: test]"),
    ] = None,
    seeds: Annotated[
        str | None, typer.Option(help="Other seeds than the split's: 3, 0:9 (both included) or 1,4,7.")
    ] = None,
    floor_plans: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder of ROS maps or images: the suites floor-plans(-slippery)."),
    ] = None,
    robot: opt.Robot = None,
    config: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.toml", help="Configuration of the world, and of a team: another lidar, robot, noise, …"
        ),
    ] = None,
    baseline: Annotated[
        str | None,
        typer.Option(help="Agent to compare the others with.  [default: nearest-frontier, if it is one of them]"),
    ] = None,
    robots: Annotated[
        str | None,
        typer.Option(help="How many robots explore together; several numbers, separated by commas.  [default: 1]"),
    ] = None,
    communication: opt.Communication = None,
    range_m: opt.Range = None,
    starts: opt.Starts = None,
    unknown_starts: opt.UnknownStarts = False,
    protocol: Annotated[
        str | None,
        typer.Option(help="dungeons: the published path-length protocol on --maps, instead of suites."),
    ] = None,
    maps: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder of that protocol's PNG maps.")] = None,
    scan: Annotated[
        str | None,
        typer.Option(help="How that protocol looks around: way-points or continuous.  [default: way-points]"),
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option(
            help="What that protocol's rays show: public (as in its code) or wide (cells beside, too).  "
            "[default: public]"
        ),
    ] = None,
    max_steps: opt.MaxSteps = None,
    workers: opt.Workers = None,
    ray: opt.Ray = None,
    out: opt.Out = Path("out/benchmark"),
    report: Annotated[
        bool, typer.Option("--report", help="Also write report.html, one page of all of it.")
    ] = False,
    parquet: Annotated[
        bool, typer.Option("--parquet", help="Also write episodes.parquet, for pandas, DuckDB and the like.")
    ] = False,
    as_json: opt.Json = False,
) -> None:
    """Let agents explore suites of rooms, and compare them with confidence intervals.

    Writes into --out: results.sqlite with each episode as it comes, so that the same command goes on where it was
    broken off and more agents, backends, suites or seeds are added to those that are there; episodes.csv,
    summary.csv, comparison.csv, tables.md, summary.json, config.toml, settings.json and, with --report,
    report.html, with --parquet, episodes.parquet. docs/how-to/benchmark.md says what is counted, and how.

    \b
    Examples:
      mecanum benchmark
      mecanum benchmark --suite rooms --agents random,nearest-frontier --seeds 10000:10004 --out out/try --report
      mecanum benchmark --suite apartments,apartments-slippery --slam ekf,invariant-ekf --workers 2 --out out/two
      mecanum benchmark --suite all --split validation --out out/validation --json
      mecanum benchmark --floor-plans plans --agents nearest-frontier --out out/plans
      mecanum benchmark --config my_lidar.toml --agents brisk-tour --out out/my_lidar
      mecanum benchmark --suite all --ray 10.0.0.5:6379 --out out/cluster --parquet
      mecanum benchmark --robots 1,2,3,5 --communication range,none --agents brisk-tour --out out/teams --report
      mecanum benchmark --protocol dungeons --maps dungeons --agents tour,learned-tour --out out/dungeons
    """  # noqa: D301
    who = opt.workers_of(workers, ray)
    its_own = [
        name for name, given in (("--maps", maps), ("--scan", scan), ("--sensor", sensor)) if given is not None
    ]
    if protocol is not None or its_own:
        suites_only = {
            "--suite": suite, "--slam": slam, "--split": split, "--seeds": seeds, "--floor-plans": floor_plans,
            "--robot": robot, "--config": config, "--baseline": baseline, "--max-steps": max_steps,
            "--report": report or None, "--parquet": parquet or None,
            "--robots": robots, "--communication": communication, "--range": range_m,
            "--starts": starts, "--unknown-starts": unknown_starts or None,
        }  # fmt: skip
        not_its = [name for name, given in suites_only.items() if given is not None]
        _check_protocol(protocol, its_own, not_its)
        assert maps is not None
        from training.dungeons import protocol as dungeons

        names = [name for name in parts_of(agents) if name]
        if not names:
            raise BadInput("--agents names none; give some, separated by commas")
        with opt.json_alone(as_json):
            summary = dungeons.run_dungeons(
                maps, names, out=out, workers=who, scan="way-points" if scan is None else scan,
                sensor="public" if sensor is None else sensor,
            )  # fmt: skip
        print(json.dumps(summary, ensure_ascii=False) if as_json else dungeons.table(summary))
        return
    if split is not None and seeds is not None:
        raise BadInput("--seeds are others than those of --split; leave out the one or the other")
    from training.benchmark import run as task
    from training.benchmark.output import Report, table
    from training.benchmark.output import as_json as as_mapping
    from training.benchmark.parquet import FILE as PARQUET
    from training.benchmark.parquet import require, write_parquet
    from training.benchmark.report import FILE as PAGE
    from training.benchmark.report import TEAMS, write_report
    from training.benchmark.suites import teams_of

    plan = task.BenchmarkPlan.parse(
        suite=suite, agents=agents, slam=slam, split="test" if split is None else split, seeds=seeds,
        baseline=baseline, floor_plans=floor_plans, max_steps=max_steps, robot=robot, config=config,
        teams=teams_of(
            robots, config=config, communication=communication, range_m=range_m, starts=starts,
            unknown_starts=unknown_starts,
        ),
    )  # fmt: skip
    if parquet:
        require()

    def tell(result: Report) -> None:
        for name in (PAGE, TEAMS, PARQUET):  # of an earlier run: they show other episodes than the tables
            (out / name).unlink(missing_ok=True)
        if report:
            write_report(out, result)
        if parquet:
            write_parquet(out, result)
        if as_json or result.entries:
            print(json.dumps(as_mapping(result), ensure_ascii=False) if as_json else table(result))

    try:
        with opt.json_alone(as_json):
            result = task.benchmark(plan, out=out, workers=who)
    except task.EpisodesFailed as failed:
        tell(failed.report)
        raise
    tell(result)


def _check_protocol(protocol: str | None, its_own: list[str], not_its: list[str]) -> None:
    if protocol is None:
        raise BadInput(f"{its_own[0]} belongs to a protocol; give --protocol dungeons with it")
    if protocol != "dungeons":
        raise BadInput(f"unknown protocol {protocol!r}{suggestion(protocol, ['dungeons'])}; valid: dungeons")
    if "--maps" not in its_own:
        raise BadInput("--protocol dungeons needs its maps; give --maps DIR, a folder of PNG maps")
    if not_its:
        raise BadInput(f"--protocol dungeons has no {not_its[0]}; leave it out")
