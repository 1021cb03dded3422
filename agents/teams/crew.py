"""Who is counted on, and what it costs each of them to look at each piece of frontier.

Nobody coordinates: robots that hear each other know the same, and so each works out the same for all and takes its
own part. Ties go to the lower number.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from agents.explorer import Candidates
from agents.view_points.sight import view_points
from agents.ways.giving_way import costs_from
from agents.ways.planning import TravelCosts
from slam.belief import Belief, Teammate
from slam.types import Array, Cells, Flags

__all__ = ["Crew", "muster"]


@dataclass(frozen=True, eq=False)
class Crew:
    """Robots by rising number, this one among them, and the pieces of frontier that are shared out."""

    robots: Cells  # (k,) their numbers
    own: int  # row of this robot
    pieces: Cells  # (n,) among the candidates' m
    costs: Array  # (k, n) [weighted m] from each robot to where it would look at each piece from; inf: no way
    bound: Cells  # (k,) the column that each is on its way to, −1 where none is known
    cells: Cells  # (n, 2) where each piece is looked at from by the robot that is nearest to it
    travels: tuple[TravelCosts, ...]  # of each: from the same trees all work out the same

    def of(self, kept: Flags) -> Crew:
        """Return the crew with some of the pieces ``(n,)`` alone."""
        column = np.where(kept, np.cumsum(kept) - 1, -1)
        bound = np.where(self.bound >= 0, np.append(column, -1)[self.bound], -1)
        return replace(
            self, pieces=self.pieces[kept], costs=self.costs[:, kept], cells=self.cells[kept], bound=bound
        )

    def held(self, hold_m: float) -> Array:
        """Return the costs ``(k, n)`` with what each robot is on its way to nearer by so much [weighted m]."""
        costs = self.costs.copy()
        rows = np.flatnonzero(self.bound >= 0)
        costs[rows, self.bound[rows]] = np.maximum(costs[rows, self.bound[rows]] - hold_m, 0.0)
        return costs


def muster(
    belief: Belief, found: Candidates, goal: Array | None, left: Flags, *, trust_s: float,
    range_m: float, beyond_m: float, short_m: float, same_m: float,
) -> Crew | None:  # fmt: skip
    """Return who is counted on, or ``None`` where this robot is alone or has nowhere to go.

    Of itself it reckons as the others do of it: from the same costs all come to the same.

    Parameters
    ----------
    belief, found
        What this robot knows, and its candidates.
    goal
        ``(2,)`` where it has told the others that it goes [m].
    left
        ``(m,)`` which candidates there is something to see at.
    trust_s
        How long after it was last heard or seen another robot is counted on [s], unless it has ended.
    range_m, beyond_m, short_m
        As in :func:`agents.view_points.sight.view_points`.
    same_m
        A goal nearer than this [m] to the place where a piece is looked at from is that place.
    """
    pieces = np.flatnonzero(left)
    own = Teammate(belief.robot, np.asarray(belief.pose), 0.0, goal)
    counted_on = [mate for mate in belief.teammates if mate.age_s <= trust_s and not mate.ended]
    mates = sorted([own, *counted_on], key=lambda mate: mate.robot)
    if len(mates) == 1 or not len(pieces):
        return None
    targets, normals = found.frontiers.targets[pieces], found.frontiers.normals[pieces]
    rows = []
    for mate in mates:
        travel = costs_from(found.cost_map, np.asarray(mate.pose)[:2])
        if travel is None:
            continue
        cells, costs = view_points(
            found.cost_map, travel, targets, normals, range_m=range_m, beyond_m=beyond_m, short_m=short_m
        )
        ahead = -1
        if mate.goal is not None and np.isfinite(costs).any():
            away = np.hypot(*(found.cost_map.to_points(cells) - mate.goal).T)
            away[~np.isfinite(costs)] = np.inf
            ahead = int(np.argmin(away)) if away.min() <= same_m else -1
        rows.append((mate.robot, costs, cells, ahead, travel))
    robots = [row[0] for row in rows]
    if belief.robot not in robots or len(robots) == 1:
        return None
    all_costs = np.array([row[1] for row in rows])
    return Crew(
        robots=np.array(robots), own=robots.index(belief.robot), pieces=pieces, costs=all_costs,
        bound=np.array([row[3] for row in rows]),
        cells=np.array([row[2] for row in rows])[np.argmin(all_costs, axis=0), np.arange(len(pieces))],
        travels=tuple(row[4] for row in rows),
    )  # fmt: skip
