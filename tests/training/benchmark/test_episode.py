"""An episode of a benchmark, and the row that it leaves in the store."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mecanum_env.config import EnvConfig
from tests.training.benchmark.small import STEPS, without_clock
from training.benchmark.episode import EpisodeFailure, EpisodeJob, EpisodeRow, resampled, row_metrics, run_job
from training.benchmark.store import FILE, Store
from training.episodes.explore import Course


def test_ctrl_c_in_an_episode_leaves_no_row(monkeypatch: pytest.MonkeyPatch) -> None:
    from training.episodes import explore

    def pressed(found: Any, *_: Any) -> None:
        found.end, found.interrupted = "interrupted", True

    monkeypatch.setattr(explore, "run", pressed)
    with pytest.raises(KeyboardInterrupt):
        run_job(EpisodeJob(
            suite="rooms", place="rectangular", rooms="rectangular", seed=0, agent="random", slam="odometry",
            noise="nominal",
        ))  # fmt: skip


def test_an_agent_that_exits_fails_its_episode_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    def leaves(self: EpisodeJob) -> EpisodeRow:
        sys.exit()

    monkeypatch.setattr(EpisodeJob, "run", leaves)
    job = EpisodeJob(suite="s", place="p", rooms="cave", seed=0, agent="a", slam="ekf", noise=None)
    failed = run_job(job)
    assert isinstance(failed, EpisodeFailure) and failed.message == "SystemExit: no message"
    assert "sys.exit()" in failed.trace


def test_the_first_decision_in_which_code_may_be_compiled_is_not_timed() -> None:
    course = Course(config=EnvConfig(), run={"max_steps": 100}, out=Path("nowhere"))
    for times, median, p95 in (([], None, None), ([9000.0], None, None), ([9000.0, 1.0, 3.0], 2.0, 2.9)):
        course.decisions_ms = times
        metrics = row_metrics(course, {}, 0.0)
        assert (metrics["decisions"], course.decision_ms) == (len(times), median)
        assert metrics["decision_ms_p95"] == pytest.approx(p95)


def test_a_curve_holds_until_the_next_row() -> None:
    curve = resampled(np.array([0.1, 0.5, 0.9]), np.array([0.0, 0.0, 127.0]))
    np.testing.assert_array_equal(curve, np.array([0.5] * 127 + [0.9], np.float32))
    np.testing.assert_array_equal(resampled(np.array([0.3]), np.array([0.0])), np.full(128, 0.3, np.float32))


def test_a_row_is_what_an_episode_left(tmp_path: Path) -> None:
    """The store takes what an episode of each noise leaves, and gives it back."""
    make = partial(
        EpisodeJob, place="rectangular", rooms="rectangular", seed=3, agent="nearest-frontier", slam="ekf"
    )
    rows = {}
    with Store(tmp_path / FILE) as store:
        for name, noise in (("rooms", "nominal"), ("rooms-slippery", "slippery")):
            job = make(suite=name, noise=noise, max_steps=STEPS)
            row = run_job(job)
            assert isinstance(row, EpisodeRow), row
            store.add(job, row, made_by="x")
            ((_, back),) = store.rows([job.key])
            assert without_clock(back) == without_clock(row) and back.metrics == row.metrics
            rows[noise] = row
    row = rows["nominal"]
    assert row.metrics["limit_s"] == 2.5 and len(row.nees) == 2
    assert row.metrics["decisions"] > 0
    assert row.metrics["ate_aligned_rmse_m"] <= row.metrics["ate_rmse_m"]
    assert row.coverage_by_time[-1] == pytest.approx(row.metrics["coverage"])
    assert np.all(np.diff(row.coverage_by_path) > -0.01)
    picture = cv2.imdecode(np.frombuffer(row.thumbnail, np.uint8), cv2.IMREAD_COLOR)
    assert max(picture.shape) <= 220
    # The noise has reached the episode: the wheels alone tell far less.
    alone = [
        run_job(make(suite=name, noise=noise, max_steps=STEPS, slam="odometry")).metrics["ate_rmse_m"]
        for name, noise in (("rooms", "nominal"), ("rooms-slippery", "slippery"))
    ]
    assert alone[1] > 2.0 * alone[0]
