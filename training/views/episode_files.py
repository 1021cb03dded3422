"""What an episode leaves behind: maps, trajectories, landmarks, configuration, metrics, and its report."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import tomli_w

from mecanum_env.rooms.files.importers import MAP_SUFFIXES, image_of
from mecanum_env.views.pictures import draw_map, draw_truth, episode_view
from slam.accounts.landmarks import write_landmarks
from slam.files import plain_name
from slam.formats import atomic_write, write_map_server, write_tum
from slam.settings import to_mapping
from training.episodes.explore import EXTRAS, FILES, Course, Episode, meaning
from training.episodes.recording import Recording
from training.episodes.team import FILES as TEAM_FILES
from training.episodes.team import ROBOT_FILE, TeamEpisode
from training.runs.errors import BadInput
from training.runs.running import versions, write_json, written_together
from training.views.film import check_video
from training.views.mcap_file import check_mcap, write_mcap
from training.views.report_page import episode_page
from training.views.rerun_file import check_rerun, write_rerun

__all__ = [
    "Saver", "check_extras", "config_text", "episode_folder", "place_of", "spare_the_plan", "who_of",
    "write_episode",
]  # fmt: skip


def check_extras(extras: Collection[str]) -> None:
    """Raise :class:`training.runs.errors.BadInput` where what one of them needs is not installed."""
    for extra, check in (("video", check_video), ("mcap", check_mcap), ("rerun", check_rerun)):
        if extra in extras:
            check()


def spare_the_plan(episode: Course) -> None:
    """Raise :class:`training.runs.errors.BadInput` where the episode's files would replace the plan it is of.

    ROS names its maps map.yaml and map.pgm, too: a surveyed one was lost for what a robot made of it.
    """
    plan = episode.config.floor_plan
    if plan is None:
        return
    files = [Path(plan)]
    if files[0].suffix.lower() in MAP_SUFFIXES:
        files.append(image_of(files[0]))
    for file in map(Path.resolve, files):
        if file.parent == episode.out.resolve() and _ours(file.name):
            raise BadInput(
                f"{episode.out} holds the floor plan {file.name}, which would be lost; choose another --out"
            )


def _ours(name: str) -> bool:
    """Whether a file is one that episodes write, or take away where it is another's."""
    return name in {*FILES, *EXTRAS.values(), *TEAM_FILES} or ROBOT_FILE.fullmatch(name) is not None


def write_episode(
    episode: Episode, recording: Recording, *, extras: Collection[str] = (), film: Path | None = None
) -> dict[str, Any]:
    """Write every file of an episode and return its metrics.

    Of the extras those are written that need no more than the recording; the film, made while it ran, is moved to
    its place. Extras not asked for are taken away: they would be another episode's.
    """
    with episode_folder(episode.out, FILES, extras, film) as folder:
        return _write_into(folder, episode, recording, extras)


@contextmanager
def episode_folder(
    out: Path, files: Collection[str], extras: Collection[str], film: Path | None
) -> Iterator[Path]:
    """Give a folder whose files, with the film, come into ``out`` together; those of another episode go."""
    kept = {*files, *(EXTRAS[extra] for extra in extras)}
    others = sorted(name for name in {path.name for path in out.glob("*")} - kept if _ours(name))
    with written_together(out, without=others) as folder:
        yield folder
        if film is not None:
            film.replace(folder / EXTRAS["video"])


class Saver:
    """A witness that writes what there is of an episode now and then: what kills the run takes little.

    Parameters
    ----------
    episode : Course
        What is written.
    write : callable
        Writes it; what it is written from has to have seen a step before this witness does.
    every_s
        Time between two writings [s]; more where one takes long, for it to take no more than a twentieth.
    """

    def __init__(self, episode: Course, write: Callable[[], Any], *, every_s: float = 60.0) -> None:
        self._episode, self._write, self._every_s = episode, write, every_s
        self._due = time.monotonic() + every_s

    def take(self, env: Any, goal: Any) -> None:
        """Write it if it is time."""
        began = time.monotonic()
        if began < self._due:
            return
        episode, end = self._episode, self._episode.end
        episode.end = "running"
        try:
            self._write()
        except OSError:  # a full disk, for a moment: it is tried again, and the writing at the end tells of it
            pass
        finally:
            episode.end = end
        took = time.monotonic() - began
        self._due = time.monotonic() + max(self._every_s, 20.0 * took)


def _write_into(folder: Path, episode: Episode, recording: Recording, extras: Collection[str]) -> dict[str, Any]:
    env, record = episode.env, episode.env.truth.record
    belief, times = env.belief, record.times
    true_poses, estimates = record.true_poses, record.estimates
    write_map_server(folder / "map", belief.grid)
    write_tum(folder / "trajectory_true.tum", times, true_poses)
    write_tum(folder / "trajectory_estimate.tum", times, estimates)
    write_landmarks(folder / "landmarks.db", env.backend, name=env.config.slam)
    view = episode_view(env.truth.ground, belief)
    robot, where = episode.config.robot, place_of(episode)
    who = who_of(episode)
    pictures = {
        "map.png": draw_map(
            belief, estimates, view=view, robot=robot,
            title=f"{where}   {episode.config.slam}, {who}",
        ),
        "truth.png": draw_truth(env.truth.ground, true_poses, view=view, robot=robot, title=where),
    }  # fmt: skip
    for name, picture in pictures.items():
        atomic_write(folder / name, cv2.imencode(".png", picture)[1].tobytes())
    config, metrics = config_text(episode), episode.metrics()
    atomic_write(folder / "config.toml", config)
    page = episode_page(
        env, recording, title=f"{where}: {who} on {episode.config.slam}",
        metrics=metrics, ending=f"{episode.end}: {meaning(episode.end)}", config=config,
        target=episode.config.coverage_target,
    )  # fmt: skip
    atomic_write(folder / "report.html", page)
    title = f"{where}, {who} on {episode.config.slam}"
    if "mcap" in extras:
        about = {"title": title, "config.toml": config}
        write_mcap(recording, folder / EXTRAS["mcap"], robot=robot, lidar=episode.config.lidar, about=about)
    if "rerun" in extras:
        write_rerun(recording, folder / EXTRAS["rerun"], robot=robot, lidar=episode.config.lidar, name=title)
    write_json(folder / "metrics.json", metrics)
    return metrics


def config_text(episode: Course) -> str:
    """Return the effective configuration as TOML, with a [run] table that ``--config`` takes up again."""
    run = {key: list(v) if isinstance(v, tuple) else v for key, v in episode.run.items() if v is not None}
    if isinstance(episode, TeamEpisode):
        run["team"] = to_mapping(episode.team.team)
    run["versions"] = versions()
    return tomli_w.dumps(to_mapping(episode.config) | {"run": run})


def place_of(episode: Course) -> str:
    """Return where an episode was, in words."""
    plan = episode.config.floor_plan
    if plan is None:
        return f"{episode.config.rooms}, seed {episode.run['seed']}"
    return plain_name(Path(plan).name)


def who_of(episode: Course) -> str:
    """Return who explored, in words."""
    return plain_name(Path(episode.run["agent"]).name.removesuffix(".safetensors"))
