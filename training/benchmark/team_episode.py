"""One episode of a team in a benchmark: what is asked, and its row, with the metrics that one robot's row has."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mecanum_env.team.config import TeamConfig
from mecanum_env.team.picture import draw_maps
from slam.metrics.measures import ate_aligned
from training.benchmark import episode as single
from training.benchmark.episode import EpisodeFailure, EpisodeJob, EpisodeRow, Key, resampled
from training.episodes.team import TeamEpisode, prepare, run
from training.runs.errors import one_line
from training.runs.running import plain

__all__ = ["TeamJob", "run_job"]

Array = NDArray[np.float64]

_THUMBNAIL_PX = 220
# The row's key says where and who.
_IN_KEY = ("agent", "slam", "rooms", "floor_plan", "seed", "interrupted", "robots", "communication")


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


def run_job(job: EpisodeJob) -> EpisodeRow | EpisodeFailure:
    """Run one episode, of one robot or of a team; as :func:`training.benchmark.episode.run_job`."""
    return _run_team(job) if isinstance(job, TeamJob) else single.run_job(job)


def _run_team(job: TeamJob) -> EpisodeRow | EpisodeFailure:
    try:
        # Nothing is written there.
        team_episode = prepare(
            job.team, out=Path(tempfile.gettempdir()), agent=job.agent, rooms=job.rooms, slam=job.slam,
            noise=job.noise, seed=job.seed, floor_plan=job.floor_plan, max_steps=job.max_steps,
        )  # fmt: skip
        run(team_episode, lambda **_: None)
        row = None if team_episode.interrupted else _row(team_episode)
    except Exception as error:
        return EpisodeFailure(message=f"{type(error).__name__}: {one_line(error)}")
    if row is None:
        raise KeyboardInterrupt
    return row


def _row(episode: TeamEpisode) -> EpisodeRow:
    times, coverage = episode.log.times, episode.log.coverage
    records = [member.truth.record for member in episode.team.members]
    path = np.sum([_of_length(_way(record.true_poses), len(times), None) for record in records], axis=0)
    every = round(1.0 / episode.config.step_s)
    nees = np.array([_of_length(record.nees, len(times), np.nan)[every::every] for record in records])
    picture = draw_maps(episode.team, longest_px=2 * _THUMBNAIL_PX)
    small = cv2.resize(picture, (picture.shape[1] // 2, picture.shape[0] // 2), interpolation=cv2.INTER_AREA)
    return EpisodeRow(
        metrics=_metrics(episode),
        coverage_by_time=resampled(coverage, times),
        coverage_by_path=resampled(coverage, path),
        nees=nees.ravel().astype(np.float32),  # the first robot's seconds, then the next one's
        thumbnail=bytes(cv2.imencode(".png", small, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()),
    )


def _way(poses: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])


def _of_length(values: Array, length: int, after: float | None) -> Array:
    """Return values of a robot, which may have ended early, as long as the episode; None: the last one stays."""
    return np.pad(values, (0, length - len(values)), constant_values=values[-1] if after is None else after)


def _metrics(episode: TeamEpisode) -> dict[str, Any]:
    metrics, decisions = episode.metrics(), episode.decisions_ms
    robots = metrics.pop("per_robot")
    records = [member.truth.record for member in episode.team.members]
    aligned = [ate_aligned(record.true_poses, record.estimates) for record in records]
    metrics["map_robots"] = len(metrics["map_robots"])
    metrics = {name: value for name, value in metrics.items() if name not in _IN_KEY}
    return metrics | {
        "first_share_max": max((robot["first_share"] for robot in robots if robot["first_share"]), default=None),
        "path_length_max_m": max(robot["path_length_m"] for robot in robots),
        "ate_aligned_rmse_m": plain(float(np.sqrt(np.mean(np.square(aligned))))),
        "decisions": len(decisions),
        "decision_ms_p95": float(np.percentile(decisions, 95.0)) if decisions else None,
        "limit_s": round(episode.run["max_steps"] * episode.config.step_s, 6),
    }
