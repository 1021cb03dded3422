"""Exploration without driving, for rehearsals: the robot is carried along the ways that it would drive.

Nothing is noisy, no filter runs and no controller: the pose is the true one, the lidar looks every 0.2 m of the
way, and time passes as it would at an even speed. Choices are found, described and planned by the agent's own
parts, on the map that the scans make, so that what is learned here serves in ``ExploreFrontier-v0``.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, SupportsIndex

import cv2
import numpy as np

from agents.frontier_env import ChoiceEnv, Observation
from agents.learned.chooser import Chooser, ChooserConfig
from mecanum_env.config import LidarConfig, NoiseConfig, RobotConfig
from mecanum_env.ground_truth import Coverage, GroundTruth
from mecanum_env.rooms.floor_plan import FloorPlan
from mecanum_env.sensing.sensors import Lidar
from slam.belief import Belief
from slam.features.extraction import FeatureExtractor
from slam.geometry import inverse, transform_points
from slam.grids.occupancy import OccupancyGrid
from slam.settings import from_mapping
from slam.types import Array, Scan

__all__ = ["COVERED", "JumpWorld", "discounted_s"]

COVERED = 0.95
"""Coverage that an episode ends at."""

_SPEED_M_S = 0.7  # along the way: what brisk driving comes to, beside walls and in the open
_JUMP_M = 0.2  # between two looks
_TURN_S = 0.25  # to start from rest, or to turn off at a right angle; twice that to turn round
_AHEAD_M = 0.3  # of the way, where it sets off to
_LOOK_S = 0.2  # at a way's end
_LEAST_S = 0.3  # that a choice lasts
_ROOM_M = 0.4  # around a place to begin at
_POSE_COV = np.diag([2.5e-5, 2.5e-5, 1e-6])  # that the planner keeps off walls by; a filter's is about that


def discounted_s(time_s: float, gamma: float) -> float:
    """Return how much a time from now on weighs, discounted by ``gamma`` a second: ∫ γᵗ dt [s]."""
    return time_s if gamma == 1.0 else (gamma**time_s - 1.0) / math.log(gamma)


class JumpWorld(ChoiceEnv):
    """The choices of ``ExploreFrontier-v0``, with jumps from look to look in between.

    Parameters
    ----------
    driver : ChooserConfig or mapping, optional
        As there. Covariance and landmarks there are none of: their columns are 0.
    time_limit_s : float
        Of an episode.
    time_1_s : float
        Reward of a second. An episode that ends with nothing left to choose before 95 % are mapped is charged with
        the time until the limit.
    gamma : float
        Discount of the reward, a second: of what a step adds up, that charge included, as seen from its start.

    Notes
    -----
    ``reset`` needs ``options={"floor_plan": plan}``. The robot begins anywhere in it, its heading along one of the
    plan's axes; with ``"anywhere": False`` at the plan's start. It keeps its heading, as a mecanum base can.
    """

    def __init__(
        self,
        *,
        driver: ChooserConfig | Mapping[str, Any] | None = None,
        time_limit_s: float = 300.0,
        time_1_s: float = -1.0 / 30.0,
        gamma: float = 1.0,
    ) -> None:
        config = from_mapping(ChooserConfig, driver)
        super().__init__(replace(config, choice=replace(config.choice, uncertainty=False)))
        self.time_limit_s, self._time_1_s, self.gamma = time_limit_s, time_1_s, gamma
        self.robot, self.lidar = RobotConfig(), LidarConfig()
        self.agent: _Passenger = _Passenger(self.driver, robot=self.robot, lidar=self.lidar)
        self._eye, self._extractor = Lidar(self.lidar, NoiseConfig()), FeatureExtractor()
        self._place: _Place | None = None

    @property
    def belief(self) -> Belief:
        """The true pose, and the map as the scans drew it."""
        return Belief.without_landmarks(self._pose, _POSE_COV, self._grid)

    @property
    def ground(self) -> GroundTruth:
        """The truth of the episode."""
        assert self._place is not None
        return self._place.truth

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin in a floor plan."""
        super().reset(seed=seed)
        if options is None or "floor_plan" not in options:
            raise ValueError("JumpWorld.reset needs options={'floor_plan': plan}")
        plan: FloorPlan = options["floor_plan"]
        if self._place is None or self._place.truth.plan is not plan:
            self._place = _Place(plan)
        self._pose = self._place.draw(self.np_random) if options.get("anywhere", True) else np.zeros(3)
        self._grid, self._coverage = OccupancyGrid(self._place.truth.resolution), Coverage(self._place.truth)
        self._going = np.zeros(2)  # unit vector, or 0 at rest
        self.time_s = self.covered = 0.0
        self.agent.reset(self.belief, 0)
        self._look()
        self._look()
        self._choice = self.agent.survey(self.belief)
        return self._observed(), self._info(0.0)

    def step(self, action: SupportsIndex) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Go to a view point until the next choice of more than one is due."""
        k, began = operator.index(action), self.time_s
        while not self._over:
            self._take(k)
            self._choice, k = None, 0
            if not self._go() or self.covered >= COVERED:
                break
            self._choice = self.agent.survey(self.belief)
            if self._choice is not None and len(self._choice.index) > 1:
                break
        lasted = self.time_s - began
        reward = self._time_1_s * discounted_s(lasted, self.gamma)
        truncated = self.time_s >= self.time_limit_s and self.covered < COVERED
        terminated = not truncated and (self.covered >= COVERED or self._choice is None)
        if terminated and self.covered < COVERED:
            left = discounted_s(self.time_limit_s - self.time_s, self.gamma)
            reward += self.gamma**lasted * self._time_1_s * left
        return self._observed(), reward, terminated, truncated, self._info(lasted)

    @property
    def _over(self) -> bool:
        return self.covered >= COVERED or self.time_s >= self.time_limit_s

    def _info(self, duration_s: float) -> dict[str, Any]:
        return {
            "time_s": self.time_s, "duration_s": duration_s, "coverage": self.covered,
            "is_success": self.covered >= COVERED, "collisions": 0,
        }  # fmt: skip

    def _look(self) -> None:
        """Draw into the grid what is seen, without noise."""
        assert self._place is not None
        lidar, (x, y, heading) = self.lidar, self._pose.tolist()
        scan = Scan(
            self._eye.true_ranges(self._place.segments, self._place.circles, self._pose),
            angle_min=lidar.angle_min, angle_increment=lidar.angle_increment, range_max=lidar.range_max_m,
        )  # fmt: skip
        self._extractor.extract(scan)
        eye = (x + lidar.offset_m * math.cos(heading), y + lidar.offset_m * math.sin(heading), heading)
        self._grid.integrate(eye, scan, self._extractor.surface, body=(x, y, self.robot.inscribed_radius_m))
        self.covered = self._coverage.update(self._grid)

    def _go(self) -> bool:
        """Go until a choice is due; return whether there was anywhere to go."""
        began = self.time_s
        belief = self.belief
        self.agent.pass_by(belief, self.time_s)
        goal = self.agent.choose(belief)
        if goal is None:
            return False
        path = goal.path
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
        self.time_s += _TURN_S * (1.0 - self._kept(path, along))
        gone, length = 0.0, float(along[-1])
        while gone < length - 1e-6:
            jump = min(_JUMP_M, length - gone)
            gone += jump
            place = _at(path, along, gone)
            step = place - self._pose[:2]
            self._going = step / max(float(np.hypot(*step)), 1e-9)
            self._pose = np.array([*place, self._pose[2]])
            self.time_s += jump / _SPEED_M_S
            self._look()
            self.agent.pass_by(self.belief, self.time_s)
            lasted = self.time_s - began
            seen = lasted >= _LEAST_S and not self.agent.still_to_see(self.belief)
            if self._over or seen or lasted >= self.driver.patience.replan_s:
                return True
        self.time_s += _LOOK_S
        self._look()
        self._going = np.zeros(2)
        self.agent.arrive(self.time_s)
        return True

    def _kept(self, path: Array, along: Array) -> float:
        """Return the share of its speed that the robot keeps when it sets off, −1 … 1."""
        if along[-1] <= 0.05:
            return 1.0
        first = _at(path, along, _AHEAD_M) - self._pose[:2]
        length = float(np.hypot(*first))
        return float(self._going @ first) / length if length > 0.02 else 1.0


def _at(path: Array, along: Array, s: float) -> Array:
    """Return the point of a path ``(n, 2)`` at the arc length ``s``."""
    return np.array([np.interp(s, along, path[:, 0]), np.interp(s, along, path[:, 1])])


class _Passenger(Chooser):
    """A chooser that is carried: it is told where it is."""

    def pass_by(self, belief: Belief, time_s: float) -> None:
        """Take note of the time, and of where the sensor is."""
        self.looked(belief)
        self._time = time_s

    def still_to_see(self, belief: Belief) -> bool:
        """Whether there is anything left to see where it is going."""
        assert self._target is not None
        return self._is_frontier(belief, self._target)

    def arrive(self, time_s: float) -> None:
        """Take note that what is there was looked at."""
        self._time = time_s
        assert self._target is not None
        self._troubles.note(self._target).looks += 1


class _Place:
    """A floor plan in the frame of its start, and where in it a robot may begin."""

    def __init__(self, plan: FloorPlan) -> None:
        start = np.array(plan.start, dtype=np.float64)
        self.truth = GroundTruth(plan, start, robot=RobotConfig(), lidar=LidarConfig(), resolution=0.05)
        to_start = inverse(start)
        ends = transform_points(to_start, plan.segments.reshape(-1, 2))
        self.segments = np.ascontiguousarray(ends.reshape(-1, 4))
        self.circles = np.array(plan.circles, dtype=np.float64)
        self.circles[:, :2] = transform_points(to_start, plan.circles[:, :2])
        self._starts = self._clear()

    def draw(self, rng: np.random.Generator) -> Array:
        """Return a pose ``(3,)`` to begin at."""
        x, y = self._starts[rng.integers(len(self._starts))]
        return np.array([x, y, int(rng.integers(4)) * 0.5 * math.pi])

    def _clear(self) -> Array:
        """Return the places ``(n, 2)`` with room around them that hang together with the start."""
        truth = self.truth
        across = 2 * round(_ROOM_M / truth.resolution) + 1
        near_wall = cv2.dilate(truth.walls.astype(np.uint8), np.ones((across, across), np.uint8)) > 0
        _, labels = cv2.connectedComponents((truth.mappable & ~near_wall).astype(np.uint8), connectivity=4)
        row, col = -truth.lattice_origin[0], -truth.lattice_origin[1]
        inside = 0 <= row < labels.shape[0] and 0 <= col < labels.shape[1]
        if not inside or labels[row, col] == 0:
            return np.zeros((1, 2))
        cells = np.argwhere(labels == labels[row, col])
        return np.asarray((cells + np.array(truth.lattice_origin) + 0.5)[:, ::-1] * truth.resolution)
