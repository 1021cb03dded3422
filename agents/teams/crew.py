"""Who is counted on, and what it costs each of them to look at each piece of frontier.

Nobody coordinates: robots that hear each other know the same, and so each works out the same for all and takes its
own part. Ties go to the lower number.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agents.explorer import Candidates
from agents.view_points.sight import view_points
from agents.ways.giving_way import costs_from
from agents.ways.planning import TravelCosts
from slam.belief import Belief

__all__ = ["Crew", "muster"]

Array = NDArray[np.float64]
Cells = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Crew:
    """Robots by rising number, this one among them, and the pieces of frontier that are shared out."""

    robots: Cells  # (k,) their numbers
    own: int  # row of this robot
    pieces: Cells  # (n,) among the candidates' m
    costs: Array  # (k, n) [weighted m] from each robot to where it would look at each piece from; inf: no way
    bound: Cells  # (k,) the column that each is on its way to, −1 where none is known
    cells: Cells  # (n, 2) where each piece is looked at from by the robot that is nearest to it
    travel: TravelCosts  # of the first robot: from the same tree all work out the same

    def held(self, hold_m: float) -> Array:
        """Return the costs ``(k, n)`` with what each robot is on its way to nearer by so much [weighted m]."""
        costs = self.costs.copy()
        rows = np.flatnonzero(self.bound >= 0)
        costs[rows, self.bound[rows]] = np.maximum(costs[rows, self.bound[rows]] - hold_m, 0.0)
        return costs


def muster(
    belief: Belief, found: Candidates, *, trust_s: float, range_m: float, beyond_m: float, same_m: float
) -> Crew | None:
    """Return who is counted on, or ``None`` where this robot is alone or has nowhere to go.

    Parameters
    ----------
    belief
        What this robot knows.
    found
        Its candidates; those with an infinite cost are not shared out.
    trust_s
        How long after it was last heard or seen another robot is counted on [s].
    range_m, beyond_m
        As in :func:`agents.view_points.sight.view_points`.
    same_m
        A goal nearer than this [m] to the place where a piece is looked at from is that place.
    """
    pieces = np.flatnonzero(np.isfinite(found.costs))
    mates = [mate for mate in belief.teammates if mate.age_s <= trust_s]
    if not mates or not len(pieces):
        return None
    cost_map = found.cost_map
    targets, normals = found.frontiers.targets[pieces], found.frontiers.normals[pieces]
    ahead = -1 if found.current is None else int(np.searchsorted(pieces, found.current))
    rows = {belief.robot: (found.costs[pieces], found.cells[pieces], ahead, found.travel)}
    for mate in mates:
        travel = costs_from(cost_map, np.asarray(mate.pose)[:2])
        if travel is None:
            continue
        cells, costs = view_points(cost_map, travel, targets, normals, range_m=range_m, beyond_m=beyond_m)
        if np.isfinite(costs).any():
            bound = -1
            if mate.goal is not None:
                away = np.where(np.isfinite(costs), np.hypot(*(cost_map.to_points(cells) - mate.goal).T), np.inf)
                bound = int(np.argmin(away)) if away.min() <= same_m else -1
            rows[mate.robot] = costs, cells, bound, travel
    robots = sorted(rows)
    if len(robots) == 1:
        return None
    costs = np.array([rows[k][0] for k in robots])
    cells = np.array([rows[k][1] for k in robots])[np.argmin(costs, axis=0), np.arange(len(pieces))]
    bound = np.array([rows[k][2] for k in robots])
    return Crew(np.array(robots), robots.index(belief.robot), pieces, costs, bound, cells, rows[robots[0]][3])
