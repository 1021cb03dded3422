"""``mecanum explore`` on the command line."""

from __future__ import annotations

import json
import math
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import typer

from training.runs import options as opt
from training.runs.errors import BadInput, Interrupted, one_line
from training.runs.progress import Progress

__all__ = ["explore"]


def explore(
    agent: Annotated[
        str | None, typer.Option(help="Who decides where to go, or a policy file.  [default: nearest-frontier]")
    ] = None,
    rooms: opt.Rooms = None,
    slam: opt.Slam = None,
    seed: opt.RoomSeedOrNone = None,
    out: opt.Out = Path("out/explore"),
    floor_plan: opt.FloorPlanFile = None,
    start: Annotated[
        str | None, typer.Option(metavar="X,Y,THETA", help="Start pose in the plan's frame, m and rad.")
    ] = None,
    robot: opt.Robot = None,
    noise: opt.Noise = None,
    config: opt.ConfigFile = None,
    max_steps: opt.MaxSteps = None,
    coverage_target: Annotated[
        float | None,
        typer.Option(min=1e-6, max=1, help="Coverage that counts as success, in (0, 1].  [default: 0.95]"),
    ] = None,
    video: Annotated[bool, typer.Option("--video", help="Also film it: episode.mp4, at true speed.")] = False,
    video_substeps: Annotated[
        bool, typer.Option("--video-substeps", help="The same, a frame for every substep of the physics.")
    ] = False,
    mcap: Annotated[
        bool, typer.Option("--mcap", help="Also write episode.mcap, ROS 2 messages for Foxglove and RViz.")
    ] = False,
    rerun: Annotated[bool, typer.Option("--rerun", help="Also write episode.rrd, for Rerun.")] = False,
    robots: Annotated[
        int | None, typer.Option(min=1, max=64, help="How many explore together.  [default: 1]")
    ] = None,
    communication: opt.Communication = None,
    range_m: opt.Range = None,
    starts: opt.Starts = None,
    unknown_starts: opt.UnknownStarts = False,
    joint_belief: opt.JointBelief = False,
    as_json: opt.Json = False,
) -> None:
    """Explore rooms for one episode, until the agent has nothing left to explore.

    Writes into --out: map.png, truth.png, map.pgm + map.yaml (ROS map_server), trajectory_true.tum and
    trajectory_estimate.tum, landmarks.db (SQLite), config.toml, metrics.json and report.html, which replays the
    episode in a browser. Ctrl-C ends the episode and keeps it as far as it came. Several robots write
    trajectories, landmarks and a map each, and one map, page and film of all (docs/how-to/teams.md).

    \b
    Examples:
      mecanum explore
      mecanum explore --agent nearest-frontier --rooms apartment --slam ekf --seed 3 --out out/seed3
      mecanum explore --floor-plan office.yaml --start 2.5,1.0,0 --out out/office
      mecanum explore --config out/seed3/config.toml --out out/again
      mecanum explore --rooms rectangular --noise slippery --json
      mecanum explore --agent brisk-tour --video --mcap
      mecanum explore --robots 3 --communication range --range 8 --out out/team
    """  # noqa: D301
    pose = _parse_start(start)
    asked = {"video": video or video_substeps, "mcap": mcap, "rerun": rerun}
    extras = [name for name, wanted in asked.items() if wanted]
    given: dict[str, Any] = {
        "out": out, "agent": agent, "rooms": rooms, "slam": slam, "robot": robot, "noise": noise, "seed": seed,
        "floor_plan": floor_plan, "start": pose, "config": config, "max_steps": max_steps,
        "coverage_target": coverage_target,
    }  # fmt: skip
    from training.episodes import explore as single
    from training.episodes import team as several
    from training.runs.signals import interrupt_flag
    from training.views.episode_files import Saver, check_extras, spare_the_plan
    from training.views.film import filmed
    from training.views.team_files import kind_of

    team = several.read_team(
        config, robots=robots, communication=communication, range_m=range_m, starts=starts,
        unknown_starts=unknown_starts, joint_belief=joint_belief,
    )  # fmt: skip
    alone = team.robots == 1
    only_alone = {"--video-substeps": video_substeps, "--mcap": mcap, "--rerun": rerun}
    for name, wanted in only_alone.items():
        if wanted and not alone:
            raise BadInput(f"{name} is for one robot; leave it out")
    check_extras(extras)
    kind = kind_of(team)
    with opt.json_alone(as_json):
        episode, recorder = kind.prepare(**given), kind.recorder()
    spare_the_plan(episode)
    # Held until all is written: an episode that is over is not lost to a Ctrl-C. A second one ends it all.
    with interrupt_flag() as late, opt.json_alone(as_json), ExitStack() as stack:
        witnesses: list[Any] = [recorder, Saver(episode, lambda: kind.write(episode, recorder.recording()))]
        film = None
        if "video" in extras:
            film = stack.enter_context(filmed(out, episode.config, substeps=video_substeps, team=not alone))
            witnesses.append(film)
        with Progress("exploring", 1.0, eta=False) as shown:

            def progress(*, coverage: float, time_s: float, steps: int, max_steps: int) -> None:
                where = f"step {steps} of at most {max_steps}, {100 * coverage:.1f} % mapped at {time_s:.0f} s"
                shown.show(coverage, where)

            kind.run(episode, progress, witnesses)
        path = film.finish() if film is not None else None
        if path is None and film is not None:
            extras.remove("video")
        metrics = kind.write(episode, recorder.recording(), extras=extras, film=path)
    if as_json:
        print(json.dumps(metrics, ensure_ascii=False))
    else:
        made = [single.EXTRAS[name] for name in extras]
        if alone:
            files = [*single.FILES, *made]
        else:
            of_all = [several.LANDMARKS] if (out / several.LANDMARKS).exists() else []  # not of every backend
            files = [*several.FILES, *of_all, *made, *several.files_of(0)]
        written = f"{out}/: {', '.join(files)}" + ("" if alone else ", … of each robot")
        print(_summary(metrics, written, single.meaning(metrics["end"])))
    if film is not None and film.failure is not None:
        raise OSError(f"{one_line(film.failure)}; all but the film is in {out}")
    if episode.interrupted or late.is_set():
        raise Interrupted(f"interrupted after {metrics['time_s']:.1f} s; the episode so far is in {out}")


def _parse_start(text: str | None) -> tuple[float, float, float] | None:
    if text is None:
        return None
    try:
        x, y, theta = (float(word) for word in text.split(","))
    except ValueError:
        raise BadInput(f"--start {text!r} is not X,Y,THETA in m and rad; give for instance 2.5,1.0,0") from None
    if not all(map(math.isfinite, (x, y, theta))):
        raise BadInput(f"--start {text!r} must be finite; give for instance 2.5,1.0,0")
    return x, y, theta


def _summary(metrics: dict[str, Any], files: str, ending: str) -> str:
    def shown(key: str, unit: str, digits: int, factor: float = 1.0) -> str:
        value = metrics[key]
        return "-" if value is None else f"{factor * value:.{digits}f} {unit}".rstrip()

    from slam.files import plain_name

    robots = metrics.get("per_robot")
    where = metrics["floor_plan"] or f"{metrics['rooms']}, seed {metrics['seed']}"
    who = metrics["agent"] if robots is None else f"{len(robots)} × {metrics['agent']}"
    verdict = "success" if metrics["success"] else "target not reached"
    steps = f", {metrics['steps']} steps" if robots is None else ""
    path, iou = shown("path_length_m", "m", 1), shown("map_iou", "", 3)
    rows = [
        ("explored", f"{where} with {metrics['slam']} and {who}"),
        ("ended", f"{metrics['end']} ({ending}) after {metrics['time_s']:.1f} s{steps}"),
        ("coverage", f"{shown('coverage', '%', 1, 100.0)} ({verdict}); 95 % at {shown('time_to_95_s', 's', 1)}"),
    ]
    if robots is None:
        corners = f", corners {shown('corner_mean_m', 'cm', 1, 100.0)} off on average"
        heading = shown("final_heading_error_rad", "°", 2, 180.0 / math.pi)
        rows += [
            ("path", f"{path}, {metrics['collisions']} collisions"),
            ("map", f"wall IoU {iou}{'' if metrics['corner_mean_m'] is None else corners}"),
            ("final error", f"{shown('final_position_error_m', 'cm', 1, 100.0)}, {heading}"),
        ]
    else:
        touching = f"{metrics['robot_collisions']} of robots with each other"
        rows += [
            ("path", f"{path} in all, {metrics['collisions']} collisions, {touching}"),
            ("map", f"wall IoU {iou}; ATE {shown('ate_rmse_m', 'cm', 1, 100.0)}"),
            *((f"robot {robot['robot']}", _of_robot(robot)) for robot in robots),
        ]
    return "\n".join(f"{name:<12} {plain_name(text, 1000)}" for name, text in [*rows, ("files", files)])


def _of_robot(robot: dict[str, Any]) -> str:
    share = robot["first_share"]
    first = "" if share is None else f", saw {100.0 * share:.1f} % first"
    own = f"own map {100.0 * robot['coverage']:.1f} %"
    return f"{robot['path_length_m']:.1f} m, {robot['collisions']} collisions, {own}{first}"
