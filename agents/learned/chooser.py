"""An explorer whose choices are made by something else: a learned policy, or whoever steps the environment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.driving.control import ControlConfig
from agents.driving.grip import WheelWatch, eased
from agents.explorer import Candidates
from agents.learned.choice import Choice, ChoiceConfig, TourPlan, describe
from agents.tour import Tour, TourConfig
from slam.belief import Belief
from slam.settings import Config, Duration, NotNegative, PositiveShare, Rate, require

__all__ = ["Chooser", "ChooserConfig", "SlipConfig"]

_MANY = 4  # times as many candidates as are shown: to so many the ways are searched for


@dataclass(frozen=True, kw_only=True)
class SlipConfig(Config):
    """How a floor found slippery is driven on: beyond what it grips wheels slide, and odometry tells less."""

    acceleration_m_s2: Rate = 1.0
    lateral_m_s2: Rate = 0.75  # in turns of the path
    firm_share: PositiveShare = 0.012  # of the wheels' speed: no greater error of the odometry is taken for slip …
    slippery_share: PositiveShare = 0.02  # … from here on it is driven as gently as it can be

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.firm_share < self.slippery_share,
            f"SlipConfig.firm_share {self.firm_share} must be below slippery_share {self.slippery_share}",
        )

    def eased(self, usual: ControlConfig, share: float) -> ControlConfig:
        """Return how to drive where odometry errs by ``share`` of the wheels' speed: as usual, or gentler."""
        slippery = float(np.interp(share, [self.firm_share, self.slippery_share], [0.0, 1.0]))
        return eased(usual, slippery, acceleration_m_s2=self.acceleration_m_s2, lateral_m_s2=self.lateral_m_s2)


@dataclass(frozen=True, kw_only=True)
class ChooserConfig(TourConfig):
    """The parts of the explorer, the tour that is shown with the choice, and how a choice is described."""

    choice: ChoiceConfig = field(default_factory=ChoiceConfig)
    slip: SlipConfig = field(default_factory=SlipConfig)
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
        self._wheels = WheelWatch(self._robot, step_s=self._step_s, share=0.5 * self.config.slip.firm_share)

    def act(self, observation: Mapping[str, Any] | None, belief: Belief) -> NDArray[np.float32]:
        """Return the next action on the way to what was chosen, as gentle as the floor was found slippery."""
        self._wheels.look(observation, belief)
        self._follower.config = self._control()
        return super().act(observation, belief)

    def _control(self) -> ControlConfig:
        """Return how to drive next."""
        return self.config.slip.eased(self.config.control, self._wheels.share)

    def _lasts_s(self, belief: Belief) -> float:
        usual = super()._lasts_s(belief)
        large = belief.grid.known_cells * belief.grid.resolution**2 > self.config.large_m2
        # Who has nowhere to go looks again soon.
        return max(usual, self.config.large_replan_s) if large and self._goal is not None else usual

    def due(self, belief: Belief) -> bool:
        """Whether the next :meth:`act` will ask for a choice."""
        return self._due(belief)

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
