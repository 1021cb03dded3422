"""``mecanum explore --robots N``: what the command does of a team."""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from mecanum_env.team.config import TeamConfig
from slam.files import plain_name
from training.episodes import team as task
from training.episodes.explore import ENDINGS, EXTRAS
from training.episodes.team_recording import TeamRecorder
from training.runs.errors import Interrupted, one_line
from training.runs.progress import Progress
from training.runs.signals import interrupt_flag
from training.views.episode_files import check_extras
from training.views.film import filmed_team
from training.views.team_files import TeamSaver, write_team_episode

__all__ = ["explore_team"]


def explore_team(team: TeamConfig, given: dict[str, Any], *, video: bool, as_json: bool) -> None:
    """Explore with several robots; ``given`` are the options of :func:`training.episodes.team.prepare`."""
    check_extras(["video"] if video else [])
    out: Path = given["out"]
    episode, recorder = task.prepare(team, **given), TeamRecorder()
    # Held until all is written, as with one robot.
    with interrupt_flag() as late, ExitStack() as stack:
        witnesses: list[task.TeamWitness] = [recorder, TeamSaver(episode, recorder)]
        film = stack.enter_context(filmed_team(out, episode.config)) if video else None
        witnesses += [film] if film is not None else []
        with Progress("exploring", 1.0, eta=False) as shown:

            def progress(*, coverage: float, time_s: float, steps: int, max_steps: int) -> None:
                where = f"step {steps} of at most {max_steps}, {100 * coverage:.1f} % mapped at {time_s:.0f} s"
                shown.show(coverage, where)

            task.run(episode, progress, witnesses)
        path = film.finish() if film is not None else None
        metrics = write_team_episode(episode, recorder.recordings(), film=path)
    if as_json:
        print(json.dumps(metrics, ensure_ascii=False))
    else:
        files = [*task.FILES, *([EXTRAS["video"]] if path is not None else []), *task.files_of(0)]
        print(_summary(metrics, f"{out}/: {', '.join(files)}, … of each robot"))
    if film is not None and film.failure is not None:
        raise OSError(f"{one_line(film.failure)}; all but the film is in {out}")
    if episode.interrupted or late.is_set():
        raise Interrupted(f"interrupted after {metrics['time_s']:.1f} s; the episode so far is in {out}")


def _summary(metrics: dict[str, Any], files: str) -> str:
    where = metrics["floor_plan"] or f"{metrics['rooms']}, seed {metrics['seed']}"
    verdict = "success" if metrics["success"] else "target not reached"
    at = "-" if metrics["time_to_95_s"] is None else f"{metrics['time_to_95_s']:.1f} s"
    touching = f"{metrics['robot_collisions']} of robots with each other"
    iou, ate = metrics["map_iou"], 100.0 * metrics["ate_rmse_m"]
    rows = [
        ("explored", f"{where} with {metrics['slam']} and {metrics['robots']} × {metrics['agent']}"),
        ("ended", f"{metrics['end']} ({ENDINGS[metrics['end']]}) after {metrics['time_s']:.1f} s"),
        ("coverage", f"{100.0 * metrics['coverage']:.1f} % ({verdict}); 95 % at {at}"),
        ("path", f"{metrics['path_length_m']:.1f} m in all, {metrics['collisions']} collisions, {touching}"),
        ("map", f"wall IoU {'-' if iou is None else f'{iou:.3f}'}; ATE {ate:.1f} cm"),
        *((f"robot {robot['robot']}", _of_robot(robot)) for robot in metrics["per_robot"]),
        ("files", files),
    ]  # fmt: skip
    return "\n".join(f"{name:<12} {plain_name(text, 1000)}" for name, text in rows)


def _of_robot(robot: dict[str, Any]) -> str:
    share = robot["first_share"]
    first = "" if share is None else f", saw {100.0 * share:.1f} % first"
    own = f"own map {100.0 * robot['coverage']:.1f} %"
    return f"{robot['path_length_m']:.1f} m, {robot['collisions']} collisions, {own}{first}"
