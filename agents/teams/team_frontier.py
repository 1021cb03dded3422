"""``ppo-frontier`` in a team: each robot's policy chooses among the frontiers that fall to it."""

from __future__ import annotations

from agents.ppo_frontier import PpoFrontier
from agents.teams.shared import Shared

__all__ = ["TeamFrontier"]


class TeamFrontier(Shared, PpoFrontier):
    """Goes where a policy that was trained alone says, shown what is not left to others (as in ``team-tour``)."""
