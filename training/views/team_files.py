"""What a team's episode leaves behind: the map of all, each robot's trajectories, map, landmarks; its report."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from mecanum_env.team.config import TeamConfig
from mecanum_env.team.picture import render_team
from slam.accounts.landmarks import write_landmarks
from slam.formats import atomic_write, write_map_server, write_tum
from slam.landmarks.database import write_landmark_map
from training.episodes import explore as single
from training.episodes import team as several
from training.episodes.explore import meaning
from training.episodes.recording import Recorder, Recording, TeamRecorder
from training.episodes.team import FILES, LANDMARKS, TeamEpisode, files_of
from training.episodes.team_log import team_landmarks, team_map
from training.runs.running import write_json
from training.views.episode_files import config_text, episode_folder, place_of, who_of, write_episode
from training.views.team_page import team_page

__all__ = ["Kind", "kind_of", "write_team_episode"]


class Kind(NamedTuple):
    """How an episode of one robot, or of several, is prepared, run, recorded and written."""

    prepare: Callable[..., Any]
    run: Callable[..., None]
    recorder: Callable[[], Any]
    write: Callable[..., dict[str, Any]]


def kind_of(team: TeamConfig) -> Kind:
    """Return the kind of episode that a team makes; one robot is none."""
    if team.robots == 1:
        return Kind(single.prepare, single.run, Recorder, write_episode)
    return Kind(partial(several.prepare, team), several.run, TeamRecorder, write_team_episode)


def write_team_episode(
    episode: TeamEpisode,
    recordings: Sequence[Recording],
    *,
    extras: Collection[str] = (),
    film: Path | None = None,
) -> dict[str, Any]:
    """Write every file of a team's episode and return its metrics, as :func:`.episode_files.write_episode`."""
    files = [*FILES, *(name for member in episode.team.members for name in files_of(member.number))]
    with episode_folder(episode.out, files, extras, film) as folder:
        return _write_into(folder, episode, recordings)


def _write_into(folder: Path, episode: TeamEpisode, recordings: Sequence[Recording]) -> dict[str, Any]:
    team = episode.team
    write_map_server(folder / "map", team_map(team)[0])
    merged = team_landmarks(team)
    if merged is not None:
        write_landmark_map(
            folder / LANDMARKS, merged.points, cov=merged.point_covs, ids=np.arange(len(merged.points)),
            joint_cov=merged.points_cov, kinds=merged.kinds,
            angles=merged.directions, times_seen=merged.times_seen, seen_by=merged.seen_by,
            backend=episode.config.slam,
        )  # fmt: skip
    elif team.joint is not None:
        write_landmarks(folder / LANDMARKS, team.members[0].backend, name=episode.config.slam)
    for member in team.members:
        k, record = member.number, member.truth.record
        write_tum(folder / f"trajectory_true_robot_{k}.tum", record.times, record.true_poses)
        write_tum(folder / f"trajectory_estimate_robot_{k}.tum", record.times, record.estimates)
        write_landmarks(folder / f"landmarks_robot_{k}.db", member.backend, name=episode.config.slam)
        write_map_server(folder / f"map_robot_{k}", member.grid)
    picture = cv2.cvtColor(render_team(team), cv2.COLOR_RGB2BGR)
    atomic_write(folder / "team.png", cv2.imencode(".png", picture)[1].tobytes())
    config, metrics = config_text(episode), episode.metrics()
    atomic_write(folder / "config.toml", config)
    who = who_of(episode)
    page = team_page(
        episode, recordings, metrics=metrics, config=config,
        title=f"{place_of(episode)}: {team.team.robots} robots, {who} on {episode.config.slam}",
        ending=f"{episode.end}: {meaning(episode.end)}",
    )  # fmt: skip
    atomic_write(folder / "report.html", page)
    write_json(folder / "metrics.json", metrics)
    return metrics
