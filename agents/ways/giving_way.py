"""Who gives way where two robots hold each other up, and where to.

The lower number has right of way: the other drives to the nearest place beside the way that the first one takes,
and waits there. Both work it out by themselves. One that has nothing to do gives way to all that have.
One with right of way does so, too, if it is held up for longer: the other may have no place to go. Of one that is
not heard nobody knows where it goes: it is taken to want to get past, as long as it moves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from agents.ways.cost_map import CostMap
from agents.ways.planning import TravelCosts, travel_costs, way_cells
from mecanum_env.config import RobotConfig
from slam.belief import Belief, Teammate
from slam.settings import Config, Duration, Length, Rate
from slam.types import Array, Indices

__all__ = ["GivingWay", "GivingWayConfig", "costs_from"]

_SLOW_M_S, _SLOW_SHARE = 0.06, 0.12  # that is held up, of a slow robot as a share of its speed
_SPEED_SHARE = 0.5  # of a slow robot's speed, at which it drives out of the way, about
_APART_M = 0.6  # between two bodies that hold each other up, at most
_HEARD_S = 1.0  # ago, at most, that another was heard of whom it is known whether it has a goal
_STIRRED_M, _STANDS_S = 0.3, 8.0  # one that has moved no farther in so long wants nothing
_PAST_M = (3.0, 1.5)  # beyond this robot that another wants to get, where there is room …
_ASIDE_M = 0.6  # … no farther from the line through both


@dataclass(frozen=True, kw_only=True)
class GivingWayConfig(Config):
    """When a robot gives way, and for how long."""

    # Between centres, of large robots more, see GivingWay: nearer than this they can hold each other up.
    near_m: Length = 1.3
    patience_s: Duration = 0.8  # with one that has right of way
    firm_s: Duration = 4.0  # with one that has not
    idle_near_m: Length = 2.0  # one without a goal looks out for others as far as this
    pass_s: Duration = 3.0  # to wait beside the way
    speed_m_s: Rate = 0.4  # at which it drives there, about, and half a slow robot's speed at most
    beside_m: Length = 0.1  # between the bodies when one passes, both turned as it likes
    far_m: Length = 15.0  # [weighted m] that a place may be off
    avoid_s: Duration = 10.0  # how long what lies beyond the other is put last


class GivingWay:
    """One robot's patience with the others.

    Attributes
    ----------
    until_s : float
        Until when it is giving way [s].
    near_m : float
        Between centres [m]: nearer than this robots of its size can hold each other up.
    speed_m_s : float
        At which it drives out of the way, about [m/s].
    """

    def __init__(self, config: GivingWayConfig, robot: RobotConfig) -> None:
        self.config, self._radius_m = config, robot.circumscribed_radius_m
        self.speed_m_s = min(config.speed_m_s, _SPEED_SHARE * robot.max_speed_m_s)
        # The centres of two bodies of 1.4 m that stand nose to nose are 1.4 m apart.
        self.near_m = max(config.near_m, 2.0 * self._radius_m + _APART_M)
        self._idle_near_m = max(config.idle_near_m, self.near_m + config.idle_near_m - config.near_m)
        self._slow_m_s = min(_SLOW_M_S, _SLOW_SHARE * robot.max_speed_m_s)
        self.until_s = -math.inf
        self._held_s = 0.0
        self._watched: tuple[int, float, float] = (-1, 0.0, 0.0)  # a robot that is not heard, and where it was …
        self._stood_s = 0.0  # … since when

    def nearest(self, belief: Belief, within_m: float) -> Teammate | None:
        """Return the nearest of the other robots within a distance [m]."""
        x, y = float(belief.pose[0]), float(belief.pose[1])
        found, least = None, within_m
        for mate in belief.teammates:
            away = math.hypot(float(mate.pose[0]) - x, float(mate.pose[1]) - y)
            if not mate.ended and mate.age_s <= 1.0 and away < least:
                found, least = mate, away
        return found

    def asked(self, belief: Belief, speed_m_s: float | None, step_s: float) -> Teammate | None:
        """Return the robot to give way to now, if any: asked once a step.

        ``speed_m_s`` is at what speed it drives to its goal, ``None`` where it has none.
        """
        config = self.config
        idle = speed_m_s is None
        mate = self.nearest(belief, self._idle_near_m if idle else self.near_m)
        silent = mate is not None and self._watch(mate, step_s)
        if mate is None or (idle and mate.goal is None and not silent):
            self._held_s = 0.0
            return None
        if speed_m_s is not None and speed_m_s > self._slow_m_s:
            # Two that stand before each other get a little way on now and then.
            self._held_s = max(self._held_s - step_s, 0.0)
            return None
        self._held_s += step_s
        behind = idle or (mate.robot < belief.robot and (silent or mate.goal is not None))
        if self._held_s + 1e-9 < (config.patience_s if behind else config.firm_s):
            return None
        self._held_s = 0.0
        return mate

    def _watch(self, mate: Teammate, step_s: float) -> bool:
        """Tell whether another is not heard, and moves."""
        if not _unheard(mate):
            return False
        robot, x, y = self._watched
        if robot != mate.robot or math.hypot(float(mate.pose[0]) - x, float(mate.pose[1]) - y) > _STIRRED_M:
            self._watched, self._stood_s = (mate.robot, float(mate.pose[0]), float(mate.pose[1])), 0.0
        self._stood_s += step_s
        return self._stood_s < _STANDS_S

    def refuge(
        self, cost_map: CostMap, belief: Belief, mate: Teammate
    ) -> tuple[TravelCosts, tuple[int, int]] | None:
        """Return travel costs, and the nearest place beside another's way; ``None``: it stands there, or none is.

        Where the other's goal is not known, beside the other; of one that is not heard, beside the way past here.
        """
        if _unheard(mate):
            mate = mate._replace(goal=_past(cost_map, mate, belief.pose))
        reach = (2.0 * self._radius_m + self.config.beside_m) / cost_map.resolution  # a team's robots are alike
        open_ = np.ones(cost_map.weight.shape, np.uint8)
        open_[tuple(_way(cost_map, mate).T)] = 0
        beside = cv2.distanceTransform(open_, cv2.DIST_L2, cv2.DIST_MASK_5) >= reach
        if beside[cost_map.start]:
            return None
        # Not through the others: they stand there.
        weight = cost_map.weight.copy()
        rows, cols = np.ogrid[: weight.shape[0], : weight.shape[1]]
        for other in belief.teammates:
            row, col = (int(v) for v in cost_map.to_cells(np.asarray(other.pose)[None, :2])[0])
            weight[(rows - row) ** 2 + (cols - col) ** 2 <= (0.7 * reach) ** 2] = 0.0
        here = cost_map.start
        weight[here] = max(float(weight[here]), 1.0)
        travel = travel_costs(replace(cost_map, weight=weight))
        costs = np.where(beside & (weight > 0.0), travel.cost, np.inf)
        best = np.unravel_index(int(np.argmin(costs)), costs.shape)
        if not costs[best] <= self.config.far_m:
            return None
        return travel, (int(best[0]), int(best[1]))


def _unheard(mate: Teammate) -> bool:
    return mate.goal is None and mate.heard_s > _HEARD_S and not mate.ended


def _past(cost_map: CostMap, mate: Teammate, pose: Array) -> Array:
    """Return where another comes to that goes straight on past a pose ``(≥ 2,)``, as far as there is room."""
    here = np.asarray(pose, np.float64)[:2]
    ahead = here - np.asarray(mate.pose)[:2]
    ahead /= max(float(np.hypot(*ahead)), 1e-9)
    for beyond in _PAST_M:
        # Two abreast in a corridor are not in line with it.
        cell = _nearest(cost_map, here + beyond * ahead, _ASIDE_M)
        if cell is not None:
            return np.asarray(cost_map.to_points(np.array([cell]))[0])
    return here


def _way(cost_map: CostMap, mate: Teammate) -> Indices:
    """Return the cells ``(n, 2)`` that another's centre will pass over, as far as is known."""
    here = cost_map.to_cells(np.asarray(mate.pose)[None, :2])
    if mate.goal is None:
        return here
    travel = costs_from(cost_map, np.asarray(mate.pose)[:2])
    goal = cost_map.to_cells(np.asarray(mate.goal)[None])[0]
    if travel is None or not np.isfinite(travel.cost[tuple(goal)]):
        return here
    return np.vstack([here, way_cells(travel, (int(goal[0]), int(goal[1])))])


def costs_from(cost_map: CostMap, point: Array, *, within_m: float = 0.6) -> TravelCosts | None:
    """Return the travel costs from elsewhere ``(2,)`` [m], of a robot that is alone there.

    From the nearest cell to it where a robot may be; ``None`` where there is none so near.
    """
    start = _nearest(cost_map, np.asarray(point, np.float64), within_m)
    return None if start is None else travel_costs(replace(cost_map, weight=cost_map.plain, start=start))


def _nearest(cost_map: CostMap, point: Array, within_m: float) -> tuple[int, int] | None:
    """Return the nearest cell to a point ``(2,)`` [m] where a robot may be; ``None``: there is none so near."""
    span = math.ceil(within_m / cost_map.resolution)
    row, col = (int(v) for v in cost_map.to_cells(point[None])[0])
    low_r, low_c = max(row - span, 0), max(col - span, 0)
    cells = np.argwhere(cost_map.plain[low_r : max(row + span + 1, 0), low_c : max(col + span + 1, 0)] > 0.0)
    if not len(cells):
        return None
    cells += np.array([low_r, low_c])
    found = cells[int(np.argmin(((cells - (row, col)) ** 2).sum(axis=1)))]
    return int(found[0]), int(found[1])
