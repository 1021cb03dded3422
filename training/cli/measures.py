"""``mecanum speed``, ``consistency`` and ``complexity`` on the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from training.runs.errors import bad_input
from training.runs.options import Backends, Json, Out, Ray, RoomSeed, Workers, json_alone, workers_of

__all__ = ["complexity", "consistency", "speed"]


def speed(
    steps: Annotated[int, typer.Option(min=100, max=10_000_000, help="Steps to measure.")] = 10_000,
    rooms: Annotated[str, typer.Option(help="Generator of the rooms.")] = "apartment",
    slam: Annotated[str, typer.Option(help="SLAM backend.")] = "ekf",
    beams: Annotated[int, typer.Option(min=8, max=10_000, help="Beams of the lidar.")] = 360,
    seed: RoomSeed = 0,
    peer: Annotated[
        str | None, typer.Option(help="Another simulator to measure in turn, in the same rooms: navground.")
    ] = None,
    envs: Annotated[
        int | None,
        typer.Option(min=1, max=1024, help="Measure so many environments at once, by each way."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Measure the steps per second of one environment, and where the time goes.

    \b
    Examples:
      mecanum speed
      mecanum speed --slam odometry --beams 180 --steps 3000 --json
      mecanum speed --peer navground
      mecanum speed --envs 8 --peer navground
    """  # noqa: D301
    from mecanum_env.arguments import make_config
    from training.studies.costs.peers import require
    from training.studies.costs.speed import run
    from training.studies.costs.speed_batch import run as run_batch

    with bad_input():
        make_config(rooms=rooms, slam=slam, lidar={"beams": beams})
        if peer is not None:
            require(peer)
    if envs is not None:
        run_batch(envs, steps=steps, rooms=rooms, slam=slam, beams=beams, seed=seed, as_json=as_json, peer=peer)
        return
    run(steps=steps, rooms=rooms, slam=slam, beams=beams, seed=seed, as_json=as_json, peer=peer)


def consistency(
    slam: Backends = "ekf",
    rooms: Annotated[
        str, typer.Option(help="A world of landmarks (circle, room), or a generator of rooms.")
    ] = "circle",
    runs: Annotated[int, typer.Option(min=1, max=10_000, help="Monte-Carlo runs of each backend.")] = 50,
    steps: Annotated[
        int | None, typer.Option(min=1, max=1_000_000, help="Of a run.  [default: the world's, or at most 3000]")
    ] = None,
    noise: Annotated[float, typer.Option(min=0, max=100, help="Times the noise, told to the backends.")] = 1.0,
    seed0: Annotated[int, typer.Option(min=0, max=2**30, help="Seed of the first run.")] = 0,
    workers: Workers = None,
    ray: Ray = None,
    out: Out = Path("out/consistency"),
    as_json: Json = False,
) -> None:
    """Ask whether errors are as large as the covariances say: NEES and NIS over Monte-Carlo runs.

    Writes into --out: consistency.json, consistency.png and each run as it comes, so that the same command goes
    on where it was broken off, and more runs or backends are added to those that are there.

    \b
    Examples:
      mecanum consistency
      mecanum consistency --slam ekf,odometry --rooms circle --runs 50 --out out/circle
      mecanum consistency --rooms rectangular --noise 3 --runs 20 --workers 2 --out out/rectangular --json
    """  # noqa: D301
    from training.studies import consistency as study

    who = workers_of(workers, ray)
    with json_alone(as_json):
        result = study.consistency(
            backends=slam, rooms=rooms, runs=runs, steps=steps, noise=noise, seed0=seed0, out=out, workers=who
        )
    print(json.dumps(result) if as_json else study.table(result))


def complexity(
    slam: Backends = "ekf",
    landmarks: Annotated[
        str, typer.Option(help="Sizes of the map, separated by commas.")
    ] = "25,50,100,200,400,800",
    steps: Annotated[int, typer.Option(min=10, max=100_000, help="Steps that a median is taken of.")] = 100,
    out: Out = Path("out/complexity"),
    as_json: Json = False,
) -> None:
    """Measure the time per step against the number of landmarks in the map.

    A step is a prediction and ten observations of known landmarks. Writes into --out: complexity.json,
    complexity.png and each point as it comes, so that the same command goes on where it was broken off.

    \b
    Examples:
      mecanum complexity
      mecanum complexity --slam ekf,odometry --landmarks 25,50,100 --out out/complexity --json
    """  # noqa: D301
    from training.studies.costs import complexity as study

    with json_alone(as_json):
        result = study.complexity(backends=slam, landmarks=landmarks, steps=steps, out=out)
    print(json.dumps(result) if as_json else study.table(result))
