"""A short episode of a team, for the tests of what is made from it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from training.episodes.recording import Recording, TeamRecorder
from training.episodes.team import TeamEpisode, prepare, read_team, run

STEPS = 50


@dataclass(frozen=True)
class Explored:
    episode: TeamEpisode
    recordings: list[Recording]


def explore_together(
    out: Path, *, robots: int = 3, steps: int = STEPS, slam: str | None = None, **team: Any
) -> Explored:
    """Let robots with the nearest-frontier agent explore an apartment for so many steps."""
    setting = read_team(robots=robots, **team)
    episode = prepare(setting, out=out, rooms="apartment", seed=3, max_steps=steps, slam=slam)
    recorder = TeamRecorder()
    run(episode, lambda **_: None, [recorder])
    return Explored(episode, recorder.recording())
