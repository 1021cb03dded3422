"""What all map-driven agents share: which frontiers there are, and from where to look at them.

A strategy is one method, :meth:`Explorer.pick`: which of the reachable view points comes next.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from agents.base import Goal
from agents.driving.driver import Driver, DriverConfig
from agents.view_points.frontiers import FrontierConfig, Frontiers, find, frontier_cells
from agents.view_points.gain import expected_area
from agents.view_points.sight import Track, Watch, view_points
from agents.ways.cost_map import CostMap, belief_classes
from agents.ways.planning import TravelCosts, travel_costs
from slam import geometry
from slam.belief import Belief
from slam.types import Array, Cells, Flags, Indices

__all__ = ["Candidates", "Explorer", "ExplorerConfig"]

_WITHIN_M = 20.0  # [weighted m] that ways are searched for at least
_REMOTE_RAYS = 60


@dataclass(frozen=True, kw_only=True)
class ExplorerConfig(DriverConfig):
    """The parts of a map-driven agent."""

    frontiers: FrontierConfig = field(default_factory=FrontierConfig)


@dataclass(frozen=True, eq=False)
class Candidates:
    """What a strategy picks from: pieces of frontier and, for each, the place to look at it from."""

    cost_map: CostMap
    travel: TravelCosts
    frontiers: Frontiers
    cells: Cells  # (m, 2) row, column of the view points
    # See Explorer._costs_asked for those that are far away.
    costs: Array  # (m,) travel cost [weighted m], inf where out of reach or given up
    current: int | None  # the piece it is driving to now, if it is still there


class Explorer(Driver):
    """Drives from view point to view point until no frontier is left that it can reach."""

    config: ExplorerConfig
    config_type = ExplorerConfig

    def __init__(self, config: Any = None, **body: Any) -> None:
        super().__init__(config, **body)
        self._frontier_config = self.config.frontiers.for_body(self._robot.width_m)
        # Beams fall no farther apart than a cell of the planning grid up to here [m].
        self._dense_m = max(self.config.planner.resolution_m / self._lidar.angle_increment, 1.0)
        self._sparse = self._dense_m < self.config.frontiers.view_range_m
        # Beyond far_m all costs ask the same extent of a frontier.
        self._least_within_m = max(_WITHIN_M, self.config.frontiers.far_m)
        self._forget()

    def _forget(self) -> None:
        super()._forget()
        self._within_m = self._least_within_m  # [weighted m] that the next choice is likely to ask ways for
        self._ending = "covered"  # why there is nothing left to choose, once there is nothing
        self._track = Track()  # sensor poses that frontiers were seen from
        self._doubts = 0  # how often it has changed its mind …
        self._doubts_on = 0  # … since so many cells were known
        self._cost = 0.0  # [weighted m] of the way to the target when it was last chosen
        self._detours = 0  # how often that way has turned out to be closed

    @abstractmethod
    def pick(self, candidates: Candidates, belief: Belief) -> int:
        """Return the index of the candidate to go to; at least one has a finite cost."""

    def choose(self, belief: Belief) -> Goal | None:
        """Return the next view point and the way there, or ``None`` when no frontier can be reached."""
        candidates = self._candidates(belief)
        self._frontiers = candidates.frontiers.points
        if not np.isfinite(candidates.costs).any():
            self._target = None
            self._status = self._ending
            return None
        index = self._kept(self.pick(candidates, belief), candidates, belief)
        target = candidates.frontiers.targets[index]
        row, column = candidates.cells[index].tolist()
        path = self._path(candidates.cost_map, candidates.travel, (row, column), belief)
        look = target + self.config.frontiers.beyond_m * candidates.frontiers.normals[index] - path[-1]
        heading = math.atan2(look[1], look[0]) if np.hypot(*look) > 0.05 else float(belief.pose[2])
        cost = float(candidates.costs[index])
        if self._target is None or np.hypot(*(target - self._target)) > self.config.patience.same_m:
            if self._target is not None and candidates.current is None:
                # Seen, and gone: should it come back, in the noise at an edge, that look has been had.
                trouble = self._troubles.note(self._target)
                trouble.looks += 1
                away = math.hypot(*(self._target - belief.pose[:2]).tolist())
                trouble.afar += away > self._watch_kept().range_m and trouble.afar < self.config.patience.attempts
            self._detours = 0
            self._allow_time(cost)
        elif cost > self._cost + self.config.patience.detour_m:
            self._detours += 1
            if self._detours > self.config.patience.doubts:
                self._deadline = -math.inf  # open from afar and closed from near by, now one way, now the other
        self._target, self._cost = target, cost
        self._status = "driving"
        return Goal(pose=np.array([*path[-1], geometry.wrap_scalar(heading)]), path=path)

    def _kept(self, picked: int, candidates: Candidates, belief: Belief) -> int:
        """Return the candidate to go to: the one picked, or the current one after too many changes of mind.

        What is picked depends on where the robot stands, and far beams let frontiers come and go: between two
        goals it may go to and fro for ever.
        """
        current, known = candidates.current, belief.grid.known_cells
        if (known - self._doubts_on) * belief.grid.resolution**2 >= self.config.patience.progress_m2:
            self._doubts, self._doubts_on = 0, known
        if current is None:
            self._doubts += self._target is not None  # it is gone, and nothing has been found by it
            return picked
        if picked == current:
            return picked
        targets = candidates.frontiers.targets
        if math.hypot(*(targets[picked] - targets[current]).tolist()) <= self.config.patience.same_m:
            return picked
        if self._doubts >= self.config.patience.doubts and candidates.costs[current] < candidates.travel.beyond_m:
            return current  # the way there is known
        self._doubts += 1
        return picked

    def _way_near(self, point: Array, belief: Belief) -> tuple[Array, float, float]:
        """Return the path ``(n, 2)`` [m] to the reachable place nearest to a point, its cost and that distance."""
        cost_map = self._cost_maps.of(belief)
        travel = travel_costs(cost_map)
        reached = np.argwhere(np.isfinite(travel.cost))
        away = np.hypot(*(cost_map.to_points(reached) - point).T)
        nearest = int(np.argmin(away))
        row, column = reached[nearest].tolist()
        path = self._path(cost_map, travel, (row, column), belief)
        return path, float(travel.cost[row, column]), float(away[nearest])

    def _candidates(self, belief: Belief) -> Candidates:
        found = self._candidates_on(self._cost_maps.of(belief))
        # A door may be closed by nothing but the margin for a position that is unsure.
        if self._ending == "unreachable" and not np.isfinite(found.costs).any():
            sure = self._cost_maps.of(belief, sigma_m=0.0)
            found = self._candidates_on(sure)
        if self._ending in ("covered", "unreachable") and not np.isfinite(found.costs).any():
            found = self._candidates_on(found.cost_map, at_last=True)
        return self._own_part(found, belief) if belief.teammates else found

    def _candidates_on(self, cost_map: CostMap, *, at_last: bool = False) -> Candidates:
        """Return what there is to go to; ``at_last``, when nothing is left, what single beams may have hidden.

        Where beams are sparse, a door may be between two of them, or the way to what is left: however small it
        is, and though it was passed by. Dense ones, too, are single at last, far away. They cut a frontier in
        crumbs; and one that was gone, as they met it, and has come back is looked at again.
        """
        watch, config = self._watch_kept(), self._frontier_config
        if at_last and self._sparse:
            frontiers = find(cost_map, config.finest(cost_map.resolution), None)
        else:
            frontiers = find(cost_map, replace(config, joined_cells=3) if at_last else config, watch)
        # Ways are searched for as far as they are asked for: on a large map most frontiers are far away.
        asked = self._costs_asked()
        within_m = math.inf if asked is None else self._within_m
        while True:
            travel = travel_costs(cost_map, within_m=within_m)
            cells, costs = self._views(cost_map, travel, frontiers, watch, at_last)
            known = costs[costs < travel.beyond_m]
            if asked is None or len(known) >= asked or not (np.isfinite(costs) & (costs >= travel.beyond_m)).any():
                break
            within_m *= 4.0
        if asked is not None and len(known):
            farthest = float(np.sort(known)[min(asked, len(known)) - 1])
            self._within_m = max(1.2 * farthest, self._least_within_m)
        return Candidates(cost_map, travel, frontiers, cells, costs, self._current(frontiers, costs))

    def _own_part(self, found: Candidates, belief: Belief) -> Candidates:
        """Return the candidates with infinite costs of those that are left to other robots: of none here."""
        return found

    def _costs_asked(self) -> int | None:
        """Return of how many of the candidates, the cheapest, the strategy asks costs and cells; None: of all.

        The others cost at least ``travel.beyond_m``, and that is what stands there.
        """
        return None

    def _views(
        self, cost_map: CostMap, travel: TravelCosts, frontiers: Frontiers, watch: Watch, at_last: bool
    ) -> tuple[Indices, Array]:
        """Return cells ``(m, 2)`` and costs ``(m,)`` of :class:`Candidates`; take note of why none may be left."""
        config = self.config
        troubles = self._troubles.near(frontiers.targets)
        looks = np.array([t.looks - at_last * t.afar if t else 0 for t in troubles], dtype=np.float64)
        cells, costs = view_points(
            cost_map, travel, frontiers.targets, frontiers.normals, range_m=watch.range_m,
            beyond_m=config.frontiers.beyond_m, short_m=self._short_m(),
        )  # fmt: skip
        # The farther the way, the more there must be to see.
        worth = frontiers.extents[frontiers.target_labels] >= self._frontier_config.wanted_extent(costs) - 1e-9
        failures = np.array([t.failures if t else 0 for t in troubles], dtype=np.int64)
        given_up = failures >= config.patience.attempts
        if not (worth & np.isfinite(costs) & ~given_up & (looks < config.patience.looks)).any():
            worth |= self._may_open(cost_map, frontiers)
        worth &= ~self._too_far(cost_map, frontiers, costs, worth & ~given_up)
        costs[~worth] = np.inf
        left = worth & (looks < config.patience.looks)
        self._ending = "stuck" if (left & given_up).any() else "unreachable" if left.any() else "covered"
        costs[(looks >= config.patience.looks) | given_up] = np.inf
        # What did not work out lately comes last, but comes before giving up.
        avoided = np.array([t is not None and t.avoid_until_s > self._time for t in troubles], dtype=bool)
        if np.isfinite(costs[~avoided]).any():
            costs[avoided] = np.inf
        return cells, costs

    def _may_open(self, cost_map: CostMap, frontiers: Frontiers) -> Flags:
        """Return which pieces ``(m,)`` may show a room, narrow as they are: asked when no others are left."""
        config = self.config.frontiers
        cells = cost_map.to_cells(frontiers.targets)
        return expected_area(cost_map, cells, range_m=0.5 * config.view_range_m) >= config.opening_m2

    def _too_far(self, cost_map: CostMap, frontiers: Frontiers, costs: Array, asked: Flags) -> Flags:
        """Return which of the pieces asked about ``(m,)`` show too little for so long a way."""
        config = self.config.frontiers
        remote = np.flatnonzero(asked & np.isfinite(costs) & (costs > config.remote_m))
        cells = cost_map.to_cells(frontiers.targets[remote])
        shown = expected_area(cost_map, cells, range_m=config.view_range_m, rays=_REMOTE_RAYS)
        out = np.zeros(len(costs), dtype=np.bool_)
        out[remote] = shown < config.remote_m2_m * (costs[remote] - config.remote_m)
        return out

    def _watch_kept(self) -> Watch:
        return Watch(
            poses=self._track.poses,
            range_m=min(self.config.frontiers.view_range_m, 0.8 * self._lidar.range_max_m, self._dense_m),
            half_view_rad=math.radians(0.5 * self._lidar.field_of_view_deg),
        )

    def _short_m(self) -> float:
        """Return how far beside a view point the sensor may be when the robot has arrived [m]."""
        # Who does not see all round faces the target: there the sensor's place ahead brings it nearer.
        all_round = self._lidar.field_of_view_deg >= 360.0
        return self.config.control.arrived_m + (abs(self._lidar.offset_m) if all_round else 0.0)

    def looked(self, belief: Belief) -> None:
        """Take note that the sensor looked from the belief's pose."""
        self._keep_watch(belief)

    def _keep_watch(self, belief: Belief) -> None:
        """Remember from where the sensor has looked, every little way and turn."""
        x, y, heading = belief.pose.tolist()
        x, y = x + self._lidar.offset_m * math.cos(heading), y + self._lidar.offset_m * math.sin(heading)
        if len(self._track.poses):
            last_x, last_y, last_heading = self._track.poses[-1].tolist()
            moved = math.hypot(x - last_x, y - last_y)
            turned = abs(geometry.wrap_scalar(heading - last_heading))
            if moved < 0.2 and (self._lidar.field_of_view_deg >= 360.0 or turned < 0.3):
                return
        self._track.append((x, y, geometry.wrap_scalar(heading)))

    def _current(self, frontiers: Frontiers, costs: Array) -> int | None:
        if self._target is None or not len(costs):
            return None
        away = np.hypot(*(frontiers.targets - self._target).T)
        away[~np.isfinite(costs)] = np.inf
        nearest = int(np.argmin(away))
        return nearest if away[nearest] <= self.config.patience.same_m else None

    def _is_frontier(self, belief: Belief, point: Array) -> bool:
        """Whether any real stretch of frontier is left around the point, on the fine grid."""
        grid = belief.grid
        span = math.ceil(0.35 / grid.resolution)
        row, col = grid.to_cells(point)
        rows = slice(max(int(row) - span - 1, 0), max(int(row) + span + 2, 0))
        cols = slice(max(int(col) - span - 1, 0), max(int(col) + span + 2, 0))
        window = belief_classes(belief, rows, cols)
        if window.shape[0] < 3 or window.shape[1] < 3:
            return True
        return frontier_cells(window) * grid.resolution >= 0.5 * self._frontier_config.min_extent_m
