"""One episode of a team in a benchmark: what is asked, and its row, with the metrics that one robot's row has."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from mecanum_env.team.config import TeamConfig
from mecanum_env.team.picture import draw_maps
from slam.metrics.measures import ate_aligned
from slam.types import Array
from training.benchmark import episode as single
from training.benchmark.episode import EpisodeJob, EpisodeRow, Key
from training.episodes.team import TeamEpisode, prepare, run

__all__ = ["TeamJob"]


@dataclass(frozen=True, kw_only=True)
class TeamJob(EpisodeJob):
    """A team of like agents on one backend at one place with one seed."""

    team: TeamConfig

    @property
    def key(self) -> Key:
        """What tells the job's row from every other."""
        return (
            self.suite, self.place, self.seed, self.agent, self.slam, self.team.robots,
            self.team.communication.model,
        )  # fmt: skip

    def run(self) -> EpisodeRow:
        """Run the episode; return its row."""
        episode = prepare(self.team, **self.options)
        run(episode, lambda **_: None)
        if episode.interrupted:
            raise KeyboardInterrupt
        return _row(episode)


def _row(episode: TeamEpisode) -> EpisodeRow:
    times, coverage = episode.log.times, episode.log.coverage
    records = [member.truth.record for member in episode.team.members]
    path = np.sum([_of_length(single.way(record.true_poses), len(times), None) for record in records], axis=0)
    every = round(1.0 / episode.config.step_s)
    nees = np.array([_of_length(record.nees, len(times), np.nan)[every::every] for record in records])
    picture = draw_maps(episode.team, longest_px=2 * single.THUMBNAIL_PX)
    small = cv2.resize(picture, (picture.shape[1] // 2, picture.shape[0] // 2), interpolation=cv2.INTER_AREA)
    return EpisodeRow(
        metrics=_metrics(episode),
        coverage_by_time=single.resampled(coverage, times),
        coverage_by_path=single.resampled(coverage, path),
        nees=nees.ravel().astype(np.float32),  # the first robot's seconds, then the next one's
        thumbnail=single.small_png(small),
    )


def _of_length(values: Array, length: int, after: float | None) -> Array:
    """Return values of a robot, which may have ended early, as long as the episode; None: the last one stays."""
    return np.pad(values, (0, length - len(values)), constant_values=values[-1] if after is None else after)


def _metrics(episode: TeamEpisode) -> dict[str, Any]:
    metrics = episode.metrics()
    robots = metrics.pop("per_robot")
    records = [member.truth.record for member in episode.team.members]
    aligned = [ate_aligned(record.true_poses, record.estimates) for record in records]
    metrics |= {
        "map_robots": len(metrics["map_robots"]),
        "first_share_max": max((robot["first_share"] for robot in robots if robot["first_share"]), default=None),
        "path_length_max_m": max(robot["path_length_m"] for robot in robots),
    }
    # Over all robots' poses, as the ATE; each robot's path is aligned by a motion of its own.
    poses = [len(record.estimates) for record in records]
    return single.row_metrics(episode, metrics, float(np.sqrt(np.average(np.square(aligned), weights=poses))))
