"""Active SLAM: where to go, when to look first and how gently to drive, by the uncertainty it would leave.

A frontier's price is how late all that is left would be seen, on the best tour that begins with it
(:mod:`agents.tour`), plus what the way there would leave of the pose's uncertainty
(:mod:`agents.view_points.foresight`; D-optimality, Carrillo et al., 2012). Where a detour past well known
landmarks leaves so much less that it pays, the robot goes back there first.

What a map gets wrong at its very beginning it never loses. The start pose is known by definition; a robot that
drives off before its landmarks are settled has its wheels alone to tell where it was when it first saw them, and
every later landmark inherits that. So it looks before it goes, for as long as looking pays.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from agents.base import Goal
from agents.driving.grip import GentleFollower, WheelWatch, eased
from agents.explorer import Candidates
from agents.tour import Outlook, Tour, TourConfig
from agents.view_points.foresight import Foresight, ForesightConfig, Marks, anchoring, marks_of, spread_m
from agents.view_points.sightings import expected_sightings
from slam.belief import Belief
from slam.settings import (
    Config,
    Count,
    Duration,
    Few,
    Length,
    NotNegative,
    Positive,
    PositiveShare,
    Within,
    require,
)
from slam.types import Array

__all__ = ["ActiveConfig", "ActiveSlam", "LookConfig", "RevisitConfig"]


@dataclass(frozen=True, kw_only=True)
class LookConfig(Config):
    """How long to look before the first drive."""

    at_most_s: Duration = 6.0
    blind_s: Duration = 0.5  # … where nothing is seen that could be a landmark
    step_s: Duration = 0.5  # what looking on for so long would bring is asked
    most: Count = 24  # landmarks that are counted
    worth: Positive = 4.0  # times what the spread is worth on the way: this error is that of everything seen later


@dataclass(frozen=True, kw_only=True)
class RevisitConfig(Config):
    """When going back is thought of at all."""

    above_m: Length = 0.01  # the pose's spread from which on it is …
    times: Positive = 2.0  # … and how much better it must have been known at the place to go back to
    again_s: Duration = 30.0  # between two such ways
    spacing_m: Length = 1.0  # between the places that are remembered


@dataclass(frozen=True, kw_only=True)
class ActiveConfig(TourConfig):
    """The parts of the agent, and what it weighs against time."""

    foresight: ForesightConfig = field(default_factory=ForesightConfig)
    look: LookConfig = field(default_factory=LookConfig)
    revisit: RevisitConfig = field(default_factory=RevisitConfig)
    worth_s_per_m: NotNegative = 5000.0  # time that a metre less of the pose's spread is worth: 5 s a millimetre
    delay: NotNegative = 8.0  # what a second's delay of what is left to see costs [s]
    switch_s: NotNegative = 1.5  # another frontier must be better by this …
    switch_share: NotNegative = 0.15  # … and by this share of the way to the present one
    most: Few = 5  # candidates that are thought through: the cheapest to reach, and where the best tour begins
    thought_tries: Few = 2  # choices of view points that the best tour from each is taken from
    gentle_m_s2: Positive = 0.6  # acceleration on a floor found slippery …
    # … and speed, as a share of the robot's limit: more looks at what it passes
    gentle_speed_share: Annotated[float, Within("[0.01, 1]")] = 0.7
    firm_share: PositiveShare = 0.02  # of the wheels' speed: no greater error of the odometry is taken for slip …
    slippery_share: PositiveShare = 0.04  # … from here on it is driven as gently as it can be

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.firm_share < self.slippery_share,
            f"ActiveConfig.firm_share {self.firm_share} must be below slippery_share {self.slippery_share}",
        )


class ActiveSlam(Tour):
    """Explores so that the map becomes good: every way is priced by the uncertainty that it would leave, too."""

    config: ActiveConfig
    config_type = ActiveConfig

    def _forget(self) -> None:
        super()._forget()
        config = self.config
        self._follower = self._gentle = GentleFollower(
            config.control, robot=self._robot, lidar=self._lidar, step_s=self._step_s
        )
        self._wheels = WheelWatch(self._robot, step_s=self._step_s, share=0.5 * config.firm_share)
        self._looked_s: float | None = 0.0  # at the start; None once it has driven off
        self._places: list[Array] = []  # (3,) x, y [m] and the pose's spread [m] there
        self._detour: Array | None = None  # (n, 2) [m] the way back to one of them, while it is taken
        self._back_before_s = self._no_detour_before_s = 0.0

    # ---- choosing ------------------------------------------------------------------------------------------

    def pick(self, candidates: Candidates, belief: Belief) -> int:
        """Return the frontier of the least price; note down a detour to make first, if one pays."""
        config = self.config
        if self._outlook is None:  # on stations: noise-free sensing leaves nothing to weigh
            return super().pick(candidates, belief)
        prices, paths, chosen = self._price(candidates, self._outlook, belief)
        best = chosen[int(np.argmin(prices))]
        current = candidates.current
        if current is not None and current in chosen:
            price = prices[chosen.index(current)]
            way_s = float(candidates.costs[current]) / config.foresight.speed_m_s
            worth = max(config.switch_s, config.switch_share * way_s)
            best = best if prices[chosen.index(best)] < price - worth else current
        index = chosen.index(best)
        self._weigh_detour(candidates, belief, paths[index], prices[index])
        return best

    def _costs_asked(self) -> int | None:
        return None  # the way back to where the pose was well known may be a long one

    def _price(
        self, candidates: Candidates, outlook: Outlook, belief: Belief
    ) -> tuple[list[float], list[Array], list[int]]:
        """Return prices [s] and paths of the candidates that are thought through, and which they are."""
        config = self.config
        views = outlook.pieces
        places = np.arange(min(config.most, len(views)))
        kept = np.flatnonzero((views == self._index) | (views == candidates.current))
        foresight, marks = self._foresight(), marks_of(belief)
        prices, paths, chosen = [], [], []
        for k in np.union1d(places, kept).tolist():
            piece = int(views[k])
            row, column = candidates.cells[piece].tolist()
            path = self._path(candidates.cost_map, candidates.travel, (row, column), belief)
            delay_s = outlook.delay_m(k + 1, config.thought_tries) / config.foresight.speed_m_s
            spread = self._spread_after(foresight, marks, candidates, path)
            prices.append(config.delay * delay_s + config.worth_s_per_m * spread)
            paths.append(path)
            chosen.append(piece)
        return prices, paths, chosen

    def _foresight(self) -> Foresight:
        return Foresight(
            self.config.foresight, lidar=self._lidar, odometry=self._wheels.noise(), step_s=self._step_s
        )

    def _spread_after(self, foresight: Foresight, marks: Marks, candidates: Candidates, path: Array) -> float:
        foreseen = foresight.along(marks, candidates.cost_map, path)
        return spread_m(foreseen.pose_cov, self.config.foresight.lever_m)

    def _weigh_detour(self, candidates: Candidates, belief: Belief, path: Array, price: float) -> None:
        """Set the detour, if going back to where the pose was well known and then on to the goal costs less."""
        config, revisit = self.config, self.config.revisit
        self._detour = None
        spread = self._spread(belief)
        if spread < revisit.above_m or self._time < self._no_detour_before_s:
            return
        good = [place for place in self._places if place[2] * revisit.times < spread]
        if not good:
            return
        cells = candidates.cost_map.to_cells(np.array([place[:2] for place in good]))
        costs = candidates.travel.cost[tuple(cells.T)]
        nearest = int(np.argmin(costs))
        if not np.isfinite(costs[nearest]):
            return
        row, column = cells[nearest].tolist()
        there = self._path(candidates.cost_map, candidates.travel, (row, column), belief)
        foresight, marks = self._foresight(), marks_of(belief)
        direct = self._spread_after(foresight, marks, candidates, path)
        around = self._spread_after(foresight, marks, candidates, np.vstack([there, there[-2::-1], path[1:]]))
        extra_s = 2.0 * float(costs[nearest]) / config.foresight.speed_m_s
        if config.worth_s_per_m * (direct - around) > extra_s:
            self._detour = there

    def choose(self, belief: Belief) -> Goal | None:
        """Return the next view point, or the place to go back to first; ``None`` when no frontier is left."""
        going_back = self._detour is not None
        goal = super().choose(belief)  # which asks pick, and that notes down a detour
        if goal is None:
            self._detour = None
        elif self._detour is not None and not going_back:
            self._back_before_s = self._time + 10.0 + _length(self._detour) / self.config.patience.slowest_m_s
        if self._detour is None or self._time > self._back_before_s:
            self._detour = None
            if going_back:
                self._no_detour_before_s = self._time + self.config.revisit.again_s
            return goal
        self._target = self._detour[-1].copy()
        self._status = "revisiting"
        return Goal(pose=np.array([*self._target, float(belief.pose[2])]), path=self._detour)

    # ---- driving -------------------------------------------------------------------------------------------

    def act(self, observation: Mapping[str, Any] | None, belief: Belief) -> NDArray[np.float32]:
        """Return the next action: looking first, then on the way to the goal, gently where the wheels slip."""
        self._wheels.look(observation, belief)
        if self._looked_s is not None:
            if self._looks_on(belief):
                return self._look(belief)
            self._looked_s = None
        config = self.config
        slippery = float(np.interp(self._wheels.share, [config.firm_share, config.slippery_share], [0.0, 1.0]))
        self._gentle.config = eased(
            config.control, slippery, speed_share=config.gentle_speed_share,
            acceleration_m_s2=config.gentle_m_s2, deceleration_m_s2=config.gentle_m_s2,
        )  # fmt: skip
        self._remember(belief)
        action = super().act(observation, belief)
        return self._to_action(self._gentle.brake(observation, belief)) if self._goal is None else action

    def _look(self, belief: Belief) -> NDArray[np.float32]:
        """Stand for a step; a goal is there from the beginning, if there is one at all."""
        assert self._looked_s is not None
        self._keep_watch(belief)
        if self._looked_s == 0.0:
            self._goal = self.choose(belief)
        self._looked_s += self._step_s
        self._gentle.stand()
        if self._goal is not None:
            self._status = "looking"
        return np.zeros(3, dtype=np.float32)

    def _looks_on(self, belief: Belief) -> bool:
        """Whether another look from the known start pays (:func:`agents.view_points.foresight.anchoring`).

        The landmarks' error relative to the start falls with the root of the number of looks.
        """
        config, looked_s = self.config, self._looked_s
        assert looked_s is not None
        if looked_s < config.look.blind_s - 1e-9:
            return True
        if looked_s >= config.look.at_most_s - 1e-9:
            return False
        marks = marks_of(belief)
        if not len(marks.kinds):
            return False
        cost_map = self._cost_maps.of(belief)
        seen, _ = expected_sightings(
            cost_map, marks.x[None, :3], marks.x[3:].reshape(-1, 2), marks.kinds, marks.ends,
            lidar=self._lidar, model=config.foresight.sensor, most=config.look.most,
        )  # fmt: skip
        spread = spread_m(anchoring(marks, seen[0], self._lidar.offset_m), config.foresight.lever_m)
        further = config.look.step_s
        drop = spread * (1.0 - math.sqrt(looked_s / (looked_s + further)))
        return not drop * config.look.worth * config.worth_s_per_m < further

    def _remember(self, belief: Belief) -> None:
        """Note down every little way how well the pose is known there."""
        here, spread = np.asarray(belief.pose)[:2], self._spread(belief)
        if not self._places or np.hypot(*(here - self._places[-1][:2])) >= self.config.revisit.spacing_m:
            self._places.append(np.array([*here, spread]))

    def _spread(self, belief: Belief) -> float:
        return spread_m(np.asarray(belief.pose_cov), self.config.foresight.lever_m)

    def _is_frontier(self, belief: Belief, point: Array) -> bool:
        return self._detour is not None or super()._is_frontier(belief, point)


def _length(path: Array) -> float:
    return float(np.hypot(*np.diff(path, axis=0).T).sum()) if len(path) > 1 else 0.0
