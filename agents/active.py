"""Active SLAM at the speed of the fastest: it looks before it goes, and slows down where nothing tells its place.

Where to go a trained policy says, as for :mod:`agents.ppo_frontier`. What care costs is time, so it is taken where
it brings most. What a map gets wrong at its very beginning it never loses. The start pose is known by definition;
a robot that drives off before its landmarks are settled has its wheels alone to tell where it was when it first
saw them, and every later landmark inherits that. So it looks before it goes, for as long as looking pays.

Of what is added on the way most is made on the few metres where nothing in sight tells the place along a corridor.
There the wheels alone count. What they lose is noise of each step in proportion to its length, so that over a way
it grows with the root of the speed: that is where it drives slowly.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from agents.driving.control import ControlConfig
from agents.driving.grip import GentleFollower, SlipConfig, WheelWatch
from agents.ppo_frontier import PpoFrontier, PpoFrontierConfig
from agents.view_points.anchoring import anchoring, marks_of, spread_m
from agents.view_points.sightings import SensorModel, expected_sightings
from slam.belief import Belief
from slam.settings import Config, Count, Duration, Length, NotNegative, Positive, Rate, argument, from_mapping
from slam.types import Array, Floats

__all__ = ["ActiveConfig", "ActiveSlam", "DriftConfig", "LookConfig"]


@dataclass(frozen=True, kw_only=True)
class LookConfig(Config):
    """How long to look before the first drive."""

    at_most_s: Duration = 5.0
    blind_s: Duration = 0.5  # … where nothing is seen that could be a landmark
    step_s: Duration = 0.5  # what looking on for so long would bring is asked
    most: Count = 24  # landmarks that are counted
    lever_m: Length = 4.0  # an error of the heading counts as what it moves at this distance
    worth_s_per_m: NotNegative = 30000.0  # time that a metre less of the spread is worth: 30 s a millimetre
    sensor: SensorModel = field(default_factory=SensorModel)


@dataclass(frozen=True, kw_only=True)
class DriftConfig(Config):
    """How fast the position may grow unsure."""

    rate_m_rt_s: Positive = 0.0018  # 1σ along its least known axis, a random walk: so much in the root of a second
    steps: Count = 3  # over which it is measured
    slowest_m_s: Rate = 0.1


@dataclass(frozen=True, kw_only=True)
class ActiveConfig(PpoFrontierConfig):
    """Which policy, how long to look first, and where to drive slowly."""

    look: LookConfig = field(default_factory=LookConfig)
    drift: DriftConfig = field(default_factory=DriftConfig)
    slip: SlipConfig = field(default_factory=SlipConfig)


class ActiveSlam(PpoFrontier):
    """Explores as ``ppo-frontier`` does, but so that the map becomes good."""

    def __init__(self, config: ActiveConfig | Mapping[str, Any] | None = None, **body: Any) -> None:
        with argument("config"):
            settings = from_mapping(ActiveConfig, config)
        self._look_config, self._drift, self._slip = settings.look, settings.drift, settings.slip
        super().__init__(settings, **body)

    def _forget(self) -> None:
        super()._forget()
        self._follower = self._gentle = GentleFollower(
            self.config.control, robot=self._robot, lidar=self._lidar, step_s=self._step_s
        )
        self._wheels = WheelWatch(self._robot, step_s=self._step_s, share=0.5 * self._slip.firm_share)
        self._looked_s: float | None = 0.0  # at the start; None once it has driven off
        self._lately: deque[tuple[Array, Array]] = deque(maxlen=self._drift.steps + 1)  # poses, covariances

    def act(self, observation: Mapping[str, Any] | None, belief: Belief) -> Floats:
        """Return the next action: looking first, then to the goal, slowly where the place grows unsure."""
        self._wheels.look(observation, belief)
        if self._looked_s is not None:
            if self._looks_on(belief):
                return self._look(belief)
            self._looked_s = None
        self._lately.append((np.array(belief.pose, dtype=np.float64), np.array(belief.pose_cov, dtype=np.float64)))
        self._follower.config = self._control()
        action = super().act(observation, belief)
        if self._goal is not None or self._status == "lost":  # lost, it creeps, whether it has a goal or not
            return action
        return self._to_action(self._gentle.brake(observation, belief))

    # ---- looking first ---------------------------------------------------------------------------------------

    def _look(self, belief: Belief) -> Floats:
        """Stand for a step; a goal is there from the beginning, if the first scan shows one."""
        assert self._looked_s is not None
        self._keep_watch(belief)
        if self._looked_s == 0.0:
            self._goal = self.choose(belief)
        self._looked_s += self._step_s
        self._gentle.stand()
        self._status = "looking"
        return np.zeros(3, dtype=np.float32)

    def _looks_on(self, belief: Belief) -> bool:
        """Whether another look from the known start pays (:func:`agents.view_points.anchoring.anchoring`).

        The landmarks' error relative to the start falls with the root of the number of looks.
        """
        config, looked_s = self._look_config, self._looked_s
        assert looked_s is not None
        if looked_s < config.blind_s - 1e-9:
            return True
        if looked_s >= config.at_most_s - 1e-9:
            return False
        marks = marks_of(belief)
        if not len(marks.kinds):
            return False
        seen, _ = expected_sightings(
            self._cost_maps.of(belief), marks.x[None, :3], marks.x[3:].reshape(-1, 2), marks.kinds, marks.ends,
            lidar=self._lidar, model=config.sensor, most=config.most,
        )  # fmt: skip
        spread = spread_m(anchoring(marks, seen[0], self._lidar.offset_m), config.lever_m)
        further = config.step_s
        drop = spread * (1.0 - math.sqrt(looked_s / (looked_s + further)))
        return not drop * config.worth_s_per_m < further

    # ---- driving ---------------------------------------------------------------------------------------------

    def _control(self) -> ControlConfig:
        """Return how to drive: gently where wheels slip, slowly where the position grows unsure too fast.

        Each step adds a variance in proportion to the square of its length, as long as nothing else tells.
        """
        usual, drift = self._slip.eased(self.config.control, self._wheels.share), self._drift
        if len(self._lately) <= drift.steps:
            return usual
        poses = np.array([pose for pose, _ in self._lately])
        grown = _grown(*self._lately[0], *self._lately[-1])
        squares = float((np.diff(poses[:, :2], axis=0) ** 2).sum())
        if grown <= 0.0 or squares <= 0.0:
            return usual
        speed = max(drift.rate_m_rt_s * math.sqrt(squares / (grown * self._step_s)), drift.slowest_m_s)
        share = max(speed / self._robot.max_speed_m_s, 0.01)  # the least that there is
        return replace(usual, speed_share=min(usual.speed_share, share))


def _grown(before: Array, cov_before: Array, now: Array, cov_now: Array) -> float:
    """Return the variance [m²] that a way has added along the least known axis of the position.

    What an error of the heading makes of the way is not of it: it is the same however slowly it is driven.
    """
    carried = np.eye(3)
    carried[:2, 2] = before[1] - now[1], now[0] - before[0]
    axis = np.linalg.eigh(cov_now[:2, :2])[1][:, -1]
    return float(axis @ (cov_now - carried @ cov_before @ carried.T)[:2, :2] @ axis)
