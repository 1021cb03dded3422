"""One episode of a benchmark: what is asked, and the row that it leaves."""

from __future__ import annotations

import tempfile
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mecanum_env.views.pictures import draw_map, episode_view
from slam.metrics.measures import ate_aligned
from slam.types import Array
from training.episodes.explore import Course, Episode, run_whole
from training.runs.errors import one_line
from training.runs.running import plain

__all__ = [
    "CURVE_POINTS", "THUMBNAIL_PX", "EpisodeFailure", "EpisodeJob", "EpisodeRow", "Key", "resampled",
    "row_metrics", "run_job", "small_png", "way",
]  # fmt: skip

Curve = NDArray[np.float32]
Key = tuple[str, str, int, str, str] | tuple[str, str, int, str, str, int, str]
"""Suite, place, seed, agent, backend; of a team also the number of its robots and its communication."""

CURVE_POINTS = 128
"""Points of a curve: coverage at so many times (or ways), evenly spaced from the episode's start to its end."""

THUMBNAIL_PX = 220
"""Longer side of a thumbnail."""

_IN_KEY = {"agent", "slam", "rooms", "floor_plan", "seed", "interrupted", "robots", "communication"}
_OVERSAMPLED = 2  # drawn this much larger, then reduced: thin lines stay lines
_LEVELS = 16  # of each colour: a thumbnail needs no more, and takes half the room


@dataclass(frozen=True, kw_only=True)
class EpisodeJob:
    """One agent on one backend at one place with one seed."""

    suite: str
    place: str
    seed: int
    agent: str
    slam: str
    noise: str | None  # None: the robot's, or the configuration's
    robot: str | None = None
    config: Path | None = None
    rooms: str | None = None
    floor_plan: Path | None = None
    max_steps: int | None = None  # None: as `mecanum explore` has it, by the place's area

    @property
    def key(self) -> Key:
        """What tells the job's row from every other."""
        return self.suite, self.place, self.seed, self.agent, self.slam

    @property
    def options(self) -> dict[str, Any]:
        """What :func:`training.episodes.explore.prepare` is asked for; nothing is written to ``out``."""
        return {
            "out": Path(tempfile.gettempdir()), "agent": self.agent, "rooms": self.rooms, "slam": self.slam,
            "robot": self.robot, "noise": self.noise, "config": self.config, "seed": self.seed,
            "floor_plan": self.floor_plan, "max_steps": self.max_steps,
        }  # fmt: skip

    def run(self) -> EpisodeRow:
        """Run the episode; return its row."""
        return _row(run_whole(**self.options))


@dataclass(frozen=True, kw_only=True, eq=False)
class EpisodeRow:
    """What an episode left."""

    metrics: dict[str, Any]  # plain numbers and words, as JSON has them; None where not reached or not defined
    coverage_by_time: Curve  # (CURVE_POINTS,) from 0 to metrics["time_s"]
    coverage_by_path: Curve  # (CURVE_POINTS,) from 0 to metrics["path_length_m"]
    nees: Curve  # (seconds,) pose NEES once a simulated second, ideally 3
    thumbnail: bytes  # PNG: the believed map with the believed path


@dataclass(frozen=True, kw_only=True)
class EpisodeFailure:
    """An episode that an error ended; there is no row of it."""

    message: str
    trace: str = ""  # where in the code, for whoever mends it


def run_job(job: EpisodeJob) -> EpisodeRow | EpisodeFailure:
    """Run one episode, of one robot or of a team; an error in it is returned, so that the others go on.

    Raises
    ------
    KeyboardInterrupt
        On Ctrl-C: half an episode is no row.
    """
    try:
        return job.run()
    except (Exception, SystemExit) as error:  # an agent that calls sys.exit() ends its own episode alone
        message = f"{type(error).__name__}: {one_line(error) or 'no message'}"
        return EpisodeFailure(message=message, trace=traceback.format_exc())


def resampled(values: Array, along: Array) -> Curve:
    """Return ``values`` ``(n,)`` at :data:`CURVE_POINTS` even places of ``along`` ``(n,)``, which never falls.

    Between two rows the earlier one holds: a coverage is not had before it was reached.
    """
    places = np.linspace(along[0], along[-1], CURVE_POINTS)
    # The last row that lies no farther than the place; rounding of the places shall not miss one.
    rows = np.searchsorted(along, places + 1e-9 * max(float(along[-1]), 1.0), side="right") - 1
    return np.asarray(values[np.clip(rows, 0, len(values) - 1)], np.float32)


def _row(episode: Episode) -> EpisodeRow:
    record = episode.env.truth.record
    true_poses, coverage = record.true_poses, record.coverage
    every = round(1.0 / episode.config.step_s)
    return EpisodeRow(
        metrics=row_metrics(episode, episode.metrics(), ate_aligned(true_poses, record.estimates)),
        coverage_by_time=resampled(coverage, record.times),
        coverage_by_path=resampled(coverage, way(true_poses)),
        nees=record.nees[every::every].astype(np.float32),
        thumbnail=_thumbnail(episode),
    )


def way(poses: Array) -> Array:
    """Return how far [m] it is along poses ``(n, 3)`` to each of them ``(n,)``."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])


def row_metrics(episode: Course, metrics: dict[str, Any], aligned_m: float) -> dict[str, Any]:
    """Return an episode's metrics as a row has them: with the ATE after alignment, without what its key says."""
    # The limit is what an episode that never got there is counted with.
    return {name: value for name, value in metrics.items() if name not in _IN_KEY} | {
        "ate_aligned_rmse_m": plain(aligned_m),
        "decisions": len(episode.decisions_ms),
        "decision_ms_p95": float(np.percentile(episode.timed_ms, 95.0)) if episode.timed_ms else None,
        "limit_s": round(episode.run["max_steps"] * episode.config.step_s, 6),
    }


def _thumbnail(episode: Episode) -> bytes:
    env = episode.env
    view = episode_view(env.truth.ground, env.belief, longest_px=_OVERSAMPLED * THUMBNAIL_PX)
    picture = draw_map(env.belief, env.truth.record.estimates, view=view, robot=episode.config.robot)
    size = (max(view.width // _OVERSAMPLED, 1), max(view.height // _OVERSAMPLED, 1))
    small = cv2.resize(picture[: view.height], size, interpolation=cv2.INTER_AREA)
    step = 255.0 / (_LEVELS - 1)
    small = np.round(np.round(small / step) * step).astype(np.uint8)
    return small_png(small)


def small_png(picture: NDArray[Any]) -> bytes:
    """Return a picture as a PNG of as few bytes as may be."""
    return bytes(cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes())
