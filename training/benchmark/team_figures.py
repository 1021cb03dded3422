"""How the time to 95 % and the rest go with the number of robots: a line of figures a team."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam.metrics.measures import anees
from training.benchmark.figures import Group, Metric, comparisons, figures
from training.benchmark.tables import BY_KEY, Cell, Table, change, figure, shown
from training.figures.statistics import NONE, Interval, ratio_of_sums
from training.runs.running import plain

__all__ = ["Scaling", "scaling_of", "scaling_table", "scalings_as_json"]

_TIME = "time_to_95_s"
_NEES = BY_KEY["anees"]
_TOUCHING = Metric(key="robot_collisions_per_100_m", label="robots touching", unit="/100 m")
_SHOWN = ("reached_95", "ate_rmse_m")


@dataclass(frozen=True, eq=False)
class Scaling:
    """One agent's figures in one suite, by rising number of robots."""

    agent: str  # with its backend where there are several
    communication: str  # where there are several models of it
    robots: tuple[int, ...]
    episodes: tuple[int, ...]
    time: tuple[Interval, ...]  # to 95 % of the team [s]
    ratio: tuple[Interval, ...]  # of that to one robot's, on the same episodes; nan where there is none
    touching: tuple[Interval, ...]  # contacts of robots with each other, each counted for both, a 100 m driven
    others: tuple[dict[str, Interval], ...]  # of _SHOWN, by the metrics' keys
    nees: tuple[float | None, ...]  # NEES / 3 over all robots and seconds
    nees_each: tuple[tuple[float, ...], ...]  # the same of each robot, in their order

    @property
    def name(self) -> str:
        """What it is called."""
        return f"{self.agent}, {self.communication}" if self.communication else self.agent


def scaling_of(groups: Sequence[Group], *, suite: str) -> list[Scaling]:
    """Return the lines of a suite's groups: of each agent, backend and communication; none without a team."""
    own = [group for group in groups if group.suite == suite]
    ways = dict.fromkeys((g.agent, g.slam, g.communication) for g in own if g.robots > 1)
    several = len({slam for _, slam, _ in ways}) > 1, len({how for *_, how in ways}) > 1
    found = []
    for agent, slam, how in ways:
        line = [g for g in own if (g.agent, g.slam) == (agent, slam) and g.communication in ("", how)]
        line.sort(key=lambda group: group.robots)
        found.append(_scaling(f"{agent}@{slam}" if several[0] else agent, how if several[1] else "", line))
    return found


def _scaling(agent: str, communication: str, line: Sequence[Group]) -> Scaling:
    alone = next((group for group in line if group.robots == 1), None)
    every = [figures(group) for group in line]
    return Scaling(
        agent=agent,
        communication=communication,
        robots=tuple(group.robots for group in line),
        episodes=tuple(len(group.rows) for group in line),
        time=tuple(found[_TIME].centre for found in every),
        ratio=tuple(
            NONE if alone is None or group is alone else comparisons(group, alone)[_TIME].ratio for group in line
        ),
        touching=tuple(map(_touching, line)),
        others=tuple({key: found[key].centre for key in _SHOWN} for found in every),
        nees=tuple(group.consistency()["nees_over_3_mean"] for group in line),
        nees_each=tuple(map(_nees_each, line)),
    )


def _nees_each(group: Group) -> tuple[float, ...]:
    every = np.hstack([row.nees.reshape(group.robots, -1) for row in group.rows])
    return tuple(anees(every, axis=1).tolist())


def _touching(group: Group) -> Interval:
    if group.robots == 1:
        return NONE
    rows = [row.metrics for row in group.rows]
    contacts = np.array([row["robot_collisions"] for row in rows], float)
    ways = np.array([row["path_length_m"] for row in rows], float)
    return ratio_of_sums(contacts / 2, ways, group.strata, per=200.0)  # of two robots at a time


# ---- shown -----------------------------------------------------------------------------------------------------


def scaling_table(scalings: Sequence[Scaling]) -> Table:
    """Return the table of a suite's lines."""
    rows = []
    for s in scalings:
        for k, robots in enumerate(s.robots):
            nees = s.nees[k]
            rows.append((f"{s.name} ×{robots}", (
                Cell(str(s.episodes[k])),
                figure(BY_KEY[_TIME], s.time[k]),
                change(BY_KEY[_TIME], s.ratio[k]),
                *(figure(BY_KEY[key], s.others[k][key]) for key in _SHOWN),
                figure(_TOUCHING, s.touching[k]),
                Cell(shown(_NEES, math.nan if nees is None else nees)),
                Cell(", ".join(shown(_NEES, own) for own in s.nees_each[k])),
            )))  # fmt: skip
    head = (
        "agent × robots", "episodes", "time to 95 % [s]", "against one robot", "reached 95 % [%]", "ATE [cm]",
        f"{_TOUCHING.label} [{_TOUCHING.unit}]", "NEES / 3", "each robot's",
    )  # fmt: skip
    return Table(head, tuple(rows))


def scalings_as_json(scalings: Sequence[Scaling]) -> list[dict[str, Any]]:
    """Return a mapping a team, with the limits of each figure."""
    return [
        {
            "name": s.name, "robots": robots, "episodes": s.episodes[k], "time_to_95_s": s.time[k].as_json(),
            "ratio_to_one": s.ratio[k].as_json(), "robot_collisions_per_100_m": s.touching[k].as_json(),
            "nees_over_3": plain(s.nees[k]), "nees_over_3_each": [plain(own) for own in s.nees_each[k]],
            **{key: found.as_json() for key, found in s.others[k].items()},
        }
        for s in scalings
        for k, robots in enumerate(s.robots)
    ]  # fmt: skip
