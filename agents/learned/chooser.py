"""An explorer whose choices are made by something else: a learned policy, or whoever steps the environment."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from agents.driving.driver import LOST
from agents.explorer import Candidates
from agents.learned.choice import Choice, ChoiceConfig, TourPlan, describe
from agents.tour import Tour, TourConfig
from slam.belief import Belief
from slam.settings import Duration, NotNegative, require

__all__ = ["Chooser", "ChooserConfig"]

_MANY = 4  # times as many candidates as are shown: to so many the ways are searched for


@dataclass(frozen=True, kw_only=True)
class ChooserConfig(TourConfig):
    """The parts of the explorer, the tour that is shown with the choice, and how a choice is described."""

    choice: ChoiceConfig = field(default_factory=ChoiceConfig)
    large_m2: NotNegative = 400.0  # known: on a larger map ways are long, as is choosing, and a choice lasts …
    large_replan_s: Duration = 2.0  # … so long

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.stations.spacing_m == 0,
            f"ChooserConfig.stations.spacing_m must be 0, as it drives anywhere, got {self.stations.spacing_m}",
        )


class Chooser(Tour):
    """Describes each choice that is due, and drives to what was chosen.

    :meth:`due` says when a choice is due; :meth:`survey` describes it; :meth:`take` makes it.
    """

    config: ChooserConfig
    config_type = ChooserConfig

    def _forget(self) -> None:
        super()._forget()
        self._found: Candidates | None = None
        self._last: tuple[Choice, Candidates] | None = None
        self._taken = -1  # index of the candidate that was chosen

    def _lasts_s(self, belief: Belief) -> float:
        usual = super()._lasts_s(belief)
        large = belief.grid.known_cells * belief.grid.resolution**2 > self.config.large_m2
        # Who has nowhere to go looks again soon.
        return max(usual, self.config.large_replan_s) if large and self._goal is not None else usual

    def due(self, belief: Belief) -> bool:
        """Whether the next :meth:`act` will ask for a choice."""
        return belief.health >= LOST and self._due(belief)

    def survey(self, belief: Belief) -> Choice | None:
        """Return what there is to choose from, or ``None`` where no frontier can be reached."""
        self._keep_watch(belief)
        self._found = super()._candidates(belief)
        if not np.isfinite(self._found.costs).any():
            return None
        choice = describe(
            self._found, belief, self.config.choice, lidar=self._lidar, time_s=self._time, plan=self._plan()
        )
        self._last = choice, self._found
        return choice

    @property
    def described(self) -> tuple[Choice, Candidates]:
        """The last choice that there was, and what it was described from."""
        if self._last is None:
            raise RuntimeError("there was nothing to choose from yet")
        return self._last

    def _plan(self) -> TourPlan:
        """Return what the tour over all that is left makes of the choice."""
        outlook = self._outlook
        assert outlook is not None and self._found is not None
        return TourPlan(self._found.cells[outlook.pieces], self._order[1:] - 1, outlook.losses_m(self._order))

    def take(self, choice: Choice, k: int) -> None:
        """Choose candidate ``k`` of the survey; the next :meth:`act` sets off for it."""
        self._taken = int(choice.index[k])

    def pick(self, candidates: Candidates, belief: Belief) -> int:
        """Return what was chosen."""
        return self._taken

    def _costs_asked(self) -> int | None:
        # In how many places views may be had is among what is shown; so many are many.
        return _MANY * self.config.choice.most

    def _candidates(self, belief: Belief) -> Candidates:
        # Those that were described: the choice was made among them.
        found, self._found = self._found, None
        return super()._candidates(belief) if found is None else found
