"""From the goal that was chosen to actions: choose when it is due, drive there, notice what does not work out."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from agents.base import Agent, Goal
from agents.driving.control import ControlConfig, PathFollower
from agents.view_points.troubles import PatienceConfig, Troubles
from agents.ways.cost_map import CostMap, CostMaps, PlannerConfig
from agents.ways.giving_way import GivingWay, GivingWayConfig
from agents.ways.planning import TravelCosts, shortest_path
from slam import geometry
from slam.belief import Belief
from slam.settings import Config
from slam.types import Array, Floats

__all__ = ["LOST", "Driver", "DriverConfig"]

LOST = 0.1  # health of a belief below which it is no good for driving
_SAME_SHARE = 0.2  # of the lidar's reach, within which pieces of frontier may be the same
_NARROW_DEG = 90.0  # field of view below which a robot without a way turns round before it gives up
# Shares of a slow robot's speed: what it moves at least unless it is stuck; what a goal is given time by.
_STUCK_SHARE, _SLOWEST_SHARE = 0.075, 0.3
_LEAST_TURN = 0.1  # share of the turn asked for that counts as turned though the robot cannot: it ends then
_LOOK_S = 1.0  # for so long a robot without a way looks again: a few scans may have lost the beams that show one


@dataclass(frozen=True, kw_only=True)
class DriverConfig(Config):
    """The parts of an agent that drives on the map."""

    planner: PlannerConfig = field(default_factory=PlannerConfig)
    control: ControlConfig = field(default_factory=ControlConfig)
    patience: PatienceConfig = field(default_factory=PatienceConfig)
    giving_way: GivingWayConfig = field(default_factory=GivingWayConfig)  # in a team


class Driver(Agent):
    """Drives to what :meth:`choose` says, on the map, and asks again when it is due."""

    config: DriverConfig

    def reset(self, belief: Belief, seed: int = 0) -> None:
        """Start an episode; the strategy draws nothing at random unless it says so."""
        super().reset(belief, seed)
        self._forget()

    def _forget(self) -> None:
        self._follower = PathFollower(
            self.config.control, robot=self._robot, lidar=self._lidar, step_s=self._step_s
        )
        self._cost_maps = CostMaps(self.config.planner, self._robot)
        self._time = 0.0
        self._chosen_at = -math.inf
        self._chosen_on = 0  # known cells
        self._had_one_at = 0.0  # when there was a goal to give up, or the start
        self._target: Array | None = None  # the frontier point behind the goal
        self._deadline = math.inf
        self._arrived_for = 0.0
        self._recover_until = -math.inf
        self._anchor = (0.0, 0.0, 0.0)  # pose [m, m, rad] from which it has to get away in time
        self._anchored_at = 0.0
        self._lost_for = 0.0
        # Of a wedge of free space no cell may be far enough from the unknown to be driven to.
        self._circle_rad = 2.0 * math.pi if self._lidar.field_of_view_deg < _NARROW_DEG else 0.0
        self._to_turn_rad, self._turning = self._circle_rad, False
        self._turned_to: float | None = None  # heading [rad] at the last step of turning
        # What a short-sighted robot sees beside the piece that it has looked at is another.
        same_m = min(self.config.patience.same_m, _SAME_SHARE * self._lidar.range_max_m)
        self._troubles = Troubles(0.6 * same_m)
        self._giving_way = GivingWay(self.config.giving_way, self._robot)

    @abstractmethod
    def _keep_watch(self, belief: Belief) -> None:
        """Remember from where the sensor has looked."""

    @abstractmethod
    def _is_frontier(self, belief: Belief, point: Array) -> bool:
        """Whether there is anything left to see around the point."""

    def act(self, observation: Mapping[str, Any] | None, belief: Belief) -> Floats:
        """Return the next action on the way to the goal, choosing a goal when one is due."""
        if belief.health < LOST:
            return self._wait(observation, belief)
        self._lost_for = 0.0
        self._keep_watch(belief)
        if belief.teammates and self._makes_way(belief):
            self._time += self._step_s
            self._anchored_at = self._time
            self._status = "giving way"
            return self._to_action(self._follower.follow(observation, belief))
        if self._due(belief):
            had_one = self._goal is not None and not self._turning
            self._turning = False
            self._goal = self.choose(belief)
            if had_one:
                self._had_one_at = self._time
            self._chosen_at, self._chosen_on = self._time, belief.grid.known_cells
            if self._goal is not None:
                # Who sees all round need not turn to look.
                all_round = self._lidar.field_of_view_deg >= 360.0
                self._follower.set_path(self._goal.path, None if all_round else float(self._goal.pose[2]))
        self._time += self._step_s
        if self._goal is None and self._status == "unreachable" and self._to_turn_rad > 0.0:
            self._turning = True
        if self._turning:
            return self._turn(observation, belief)
        self._turned_to = None
        if self._goal is None:
            if self._status == "unreachable" and self._time < self._had_one_at + _LOOK_S:
                self._status = "looking"
            self._follower.reset()
            self._anchored_at = self._time
            return np.zeros(3, dtype=np.float32)
        self._to_turn_rad = self._circle_rad
        if self._time < self._recover_until:
            self._status = "recovering"
            twist = self._back_off(observation, belief)
        else:
            self._status = "driving"
            twist = self._follower.follow(observation, belief)
        self._watch(belief)
        return self._to_action(twist)

    def _makes_way(self, belief: Belief) -> bool:
        """Whether the robot is out of its own way for another; sets off, where it is to begin."""
        giving, now = self._giving_way, self._time
        if now < giving.until_s:
            return True
        speed = None if self._goal is None else self._follower.speed_m_s
        mate = giving.asked(belief, speed, self._step_s)
        if mate is None:
            return False
        if self._target is not None:  # what the other stands before is put last for a while
            self._troubles.note(self._target).avoid_until_s = now + giving.config.avoid_s
        self._target, self._chosen_at = None, -math.inf
        cost_map = self._cost_maps.of(belief)
        found = giving.refuge(cost_map, belief, mate)
        if found is None:
            return False
        travel, cell = found
        path = self._path(cost_map, travel, cell, belief)
        giving.until_s = now + giving.config.pass_s + float(travel.cost[cell]) / giving.speed_m_s
        self._goal = Goal(pose=np.array([*path[-1], float(belief.pose[2])]), path=path)
        self._follower.set_path(path, None)
        return True

    def _wait(self, observation: Mapping[str, Any] | None, belief: Belief) -> Floats:
        """Stand still while the belief is lost; after a while creep to where the scan has most room.

        From where it stands, two places may look alike.
        """
        self._status = "lost"
        self._time += self._step_s
        self._lost_for += self._step_s
        self._anchored_at = self._time
        self._deadline += self._step_s
        if self._lost_for < self.config.patience.lost_s:
            self._follower.stand()
            return np.zeros(3, dtype=np.float32)
        return self._to_action(self._follower.creep(observation, belief))

    def _turn(self, observation: Mapping[str, Any] | None, belief: Belief) -> Floats:
        """Turn on the spot, for a robot that sees little at a time to see what is around it."""
        self._status = "looking"
        self._anchored_at = self._time
        robot, pose = self._robot, np.array(belief.pose, dtype=np.float64)
        turn = min(0.5 * robot.max_turn_rate_rad_s, robot.max_speed_m_s / robot.lever_m)
        heading = float(pose[2])
        turned = 0.0 if self._turned_to is None else geometry.wrap_scalar(heading - self._turned_to)
        self._turned_to = heading
        self._to_turn_rad -= max(turned, _LEAST_TURN * turn * self._step_s)
        self._turning = self._to_turn_rad > 0.0
        self._goal = Goal(pose=pose, path=pose[None, :2]) if self._turning else None
        return self._to_action(self._follower.drive(np.zeros(2), turn, observation, belief))

    def _due(self, belief: Belief) -> bool:
        patience = self.config.patience
        waited = self._time - self._chosen_at + 1e-9
        if self._chosen_at == -math.inf:
            return True
        if waited >= self._lasts_s(belief) and (waited >= patience.stale_s or not self._as_chosen(belief)):
            return True
        if waited < patience.min_replan_s or self._goal is None:
            return False
        return self._follower.blocked or self._target is None or not self._is_frontier(belief, self._target)

    def _lasts_s(self, belief: Belief) -> float:
        """Return how long a choice lasts where nothing ends it sooner [s]."""
        return self.config.patience.replan_s

    def _as_chosen(self, belief: Belief) -> bool:
        """Whether the robot is far from its goal yet, and the map shows what it showed when that was chosen."""
        if self._goal is None:
            return False
        away = math.hypot(*(self._goal.pose[:2] - belief.pose[:2]).tolist())
        news_m2 = (belief.grid.known_cells - self._chosen_on) * belief.grid.resolution**2
        return away > self.config.patience.far_m and abs(news_m2) < self.config.patience.news_m2

    def _allow_time(self, cost: float) -> None:
        """Give a new target as long as a way of so much [weighted m] may take."""
        slowest_m_s = min(self.config.patience.slowest_m_s, _SLOWEST_SHARE * self._robot.max_speed_m_s)
        self._deadline = self._time + 10.0 + cost / slowest_m_s
        self._arrived_for = 0.0

    def _watch(self, belief: Belief) -> None:
        """Count looks taken, and notice when nothing moves or a goal takes too long."""
        patience, now = self.config.patience, self._time
        x, y, heading = belief.pose.tolist()
        assert self._target is not None
        self._arrived_for = self._arrived_for + self._step_s if self._follower.arrived else 0.0
        if self._arrived_for >= patience.settle_s - 1e-9:
            self._troubles.note(self._target).looks += 1
            self._chosen_at = -math.inf
            self._arrived_for = 0.0
            self._anchored_at = now
            return
        anchor_x, anchor_y, anchor_heading = self._anchor
        moved = math.hypot(x - anchor_x, y - anchor_y)
        turned = abs(geometry.wrap_scalar(heading - anchor_heading))
        time_s, robot = patience.stuck_s, self._robot
        if (
            moved > min(0.15, _STUCK_SHARE * time_s * robot.max_speed_m_s)
            or turned > min(0.4, _STUCK_SHARE * time_s * robot.max_turn_rate_rad_s)
            or self._follower.arrived
        ):
            self._anchor, self._anchored_at = (x, y, heading), now
        stuck = now - self._anchored_at > patience.stuck_s
        if (stuck or now > self._deadline) and now >= self._recover_until:
            self._put_off(self._target, belief)
            self._anchored_at = now
            self._deadline = math.inf
            self._target = None
            self._recover_until = now + patience.recover_s if stuck else -math.inf
            self._chosen_at = -math.inf

    def _put_off(self, target: Array, belief: Belief) -> None:
        """Put last for a while what could not be driven to: the longer, the oftener."""
        trouble = self._troubles.note(target)
        trouble.avoid_until_s = self._time + self.config.patience.avoid_s * 2.0**trouble.failures
        if self._giving_way.nearest(belief, self._giving_way.near_m) is None:
            trouble.failures += 1  # else it was another robot that stood in the way

    def _back_off(self, observation: Mapping[str, Any] | None, belief: Belief) -> Array:
        """Move to where there is more room, turning a little: what stood in the way is then seen anew.

        Where that does not go, any other way: askew in a door a body may have no other than the one it came.
        """
        pose = np.asarray(belief.pose, dtype=np.float64)
        angles = np.arange(16) * (math.pi / 8.0)
        away = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        room = self._follower.room(belief, pose[:2] + 0.3 * away)
        twist = self._follower.drive(0.15 * away[int(np.argmax(room))], 0.4, observation, belief)
        return twist if twist.any() else self._follower.escape(observation, belief)

    def _path(self, cost_map: CostMap, travel: TravelCosts, cell: tuple[int, int], belief: Belief) -> Array:
        spacing = self.config.planner.path_spacing_m
        return shortest_path(cost_map, travel, cell, start=belief.pose, spacing_m=spacing)
