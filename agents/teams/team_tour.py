"""The brisk tour of several robots: tours over all that is left, shared out so that all end at about one time.

Several travelling salesmen who begin where the robots are and want the last of them to be done early (min-max
mTSP; of frontiers Faigl, Kulich and Přeučil, "Goal assignment using distance cost in multi-robot exploration",
IROS 2012). Each robot works out the tours of all that it counts on, and drives its own as ``brisk-tour`` would.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from agents.brisk_tour import BriskTour, BriskTourConfig
from agents.teams.shared import Shared, SharingConfig

__all__ = ["TeamTour", "TeamTourConfig"]


@dataclass(frozen=True, kw_only=True)
class TeamTourConfig(BriskTourConfig):
    """The tour's, and how it is shared out."""

    sharing: SharingConfig = field(default_factory=SharingConfig)


class TeamTour(Shared, BriskTour):
    """Goes to the first place of the best tour over its part of all that is left; alone it is ``brisk-tour``."""

    config: TeamTourConfig
    config_type = TeamTourConfig
