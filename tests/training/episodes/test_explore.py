"""An episode ends where its agent does, whatever happens on the way there."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from agents.base import Agent, Goal
from slam.belief import Belief
from training.episodes import explore


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
