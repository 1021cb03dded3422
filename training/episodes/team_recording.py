"""The recordings of a team's episode: one of each robot, as :class:`Recorder` makes them of one."""

from __future__ import annotations

from collections.abc import Sequence

from agents.base import Goal
from mecanum_env.team.team import Team
from training.episodes.recording import Recorder, Recording

__all__ = ["TeamRecorder"]


class TeamRecorder:
    """Notes every robot that is still exploring: a witness of :func:`training.episodes.team.run`."""

    def __init__(self) -> None:
        self._recorders: list[Recorder] = []

    def take(self, team: Team, goals: Sequence[Goal | None]) -> None:
        """Note the team as it is now, and where each robot means to go."""
        if not self._recorders:
            self._recorders = [Recorder() for _ in team.members]
        for member, recorder, goal in zip(team.members, self._recorders, goals, strict=True):
            # One that has ended stands still, and its own record has ended, too.
            if len(member.truth.record) > recorder.rows:
                recorder.take(member, goal)

    def recordings(self) -> list[Recording]:
        """Return what was recorded so far of each robot; those that ended before have fewer rows."""
        return [recorder.recording() for recorder in self._recorders]
