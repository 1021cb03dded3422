"""An episode ends where its agent does, whatever happens on the way there."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from agents.base import Agent, Goal
from slam.belief import Belief
from training.episodes import explore
from training.episodes.recording import Recorder
from training.views.episode_files import Saver, write_episode


class LostAtTheEnd(Agent):
    """Has seen all at once; its belief is lost from the tenth to the fiftieth step."""

    steps = 0

    def choose(self, belief: Belief) -> Goal | None:
        return None

    def act(self, observation: Mapping[str, Any] | None, belief: Belief) -> NDArray[np.float32]:
        self.steps += 1
        self._status = "lost" if 10 <= self.steps < 50 else "covered"
        return np.zeros(3, np.float32)


def test_an_agent_that_is_lost_has_not_ended(tmp_path: Path) -> None:
    episode = explore.prepare(out=tmp_path, rooms="rectangular", seed=5, max_steps=100)
    episode.agent = LostAtTheEnd()
    explore.run(episode, lambda **_: None)
    assert episode.end == "covered"
    assert episode.metrics()["time_s"] == pytest.approx(4.9 + explore.AGENT_DONE_AFTER_S)


@pytest.mark.parametrize(("step_s", "steps"), [(0.02, 15_000), (0.1, 3000), (1.0, 300)])
def test_an_episode_may_take_as_long_whatever_a_step_is(step_s: float, steps: int, tmp_path: Path) -> None:
    config = tmp_path / "c.toml"
    config.write_text(f"step_s = {step_s}", "utf-8")
    assert explore.prepare(out=tmp_path, config=config, rooms="rectangular", seed=5).run["max_steps"] == steps


class Word(Enum):
    DONE = "covered"


@pytest.mark.parametrize("status", [None, Word.DONE, 3])
def test_a_status_that_is_no_word_is_told_with_the_agent(status: Any, tmp_path: Path) -> None:
    episode = explore.prepare(out=tmp_path, rooms="rectangular", seed=5, max_steps=100)
    episode.agent = LostAtTheEnd()
    episode.agent.__class__ = type("Mine", (LostAtTheEnd,), {"status": status})
    with pytest.raises(TypeError, match="status of agent Mine must be a word"):
        explore.run(episode, lambda **_: None)


class WithoutGoals(Agent):
    """Drives by its observation alone, and never says that it has ended."""

    def choose(self, belief: Belief) -> Goal | None:
        return None

    def act(self, observation: Mapping[str, Any] | None, belief: Belief) -> NDArray[np.float32]:
        return np.array([0.1, 0.0, 0.3], np.float32)


def test_an_agent_without_goals_explores_until_time_is_up(tmp_path: Path) -> None:
    episode, recorder = explore.prepare(out=tmp_path, rooms="rectangular", seed=5, max_steps=60), Recorder()
    episode.agent = WithoutGoals()
    explore.run(episode, lambda **_: None, [recorder])
    assert episode.end == "time" and episode.metrics()["steps"] == 60
    write_episode(episode, recorder.recording())
    assert "the step limit was reached first" in (tmp_path / "report.html").read_text()


def test_a_writing_that_fails_on_the_way_ends_no_episode(tmp_path: Path) -> None:
    episode, recorder = explore.prepare(out=tmp_path, rooms="rectangular", seed=5, max_steps=20), Recorder()
    ends: list[str | None] = []

    def write() -> None:
        ends.append(episode.end)
        if len(ends) < 5:
            raise OSError(28, "No space left on device")

    explore.run(episode, lambda **_: None, [recorder, Saver(episode, write, every_s=0.0)])
    assert episode.end == "time" and len(ends) >= 5 and set(ends) == {"running"}


def test_what_is_written_on_the_way_changes_nothing_of_the_end(tmp_path: Path) -> None:
    pages = []
    for every_s in (math.inf, 0.0):
        episode, recorder = explore.prepare(out=tmp_path, rooms="rectangular", seed=5, max_steps=63), Recorder()
        saver = Saver(episode, recorder.recording, every_s=every_s)
        explore.run(episode, lambda **_: None, [recorder, saver] if every_s == 0.0 else [recorder])
        write_episode(episode, recorder.recording())
        pages.append((tmp_path / "report.html").read_text())
    strip = [re.sub(r"wall_time_s.{0,40}|decision_ms.{0,60}", "", page) for page in pages]
    assert strip[0] == strip[1]
