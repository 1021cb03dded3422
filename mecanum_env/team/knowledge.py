"""What a robot knows: its own belief, and of each other robot the last that it heard or saw.

A robot's filter is fed by its own sensors alone. What robots tell each other is what each saw itself, and who
passes something on passes it on as it was: so no information is counted twice (docs/reference/teams.md).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mecanum_env.team.config import TeamConfig
from slam.backend import Backend
from slam.belief import Teammate
from slam.geometry import compose, transform_points
from slam.grids.occupancy import OccupancyGrid
from slam.teams.merged_grid import Chart, MergedGrid
from slam.types import Sighting

__all__ = ["Knowledge", "Report"]

Array = NDArray[np.float64]

_IN_SIGHT_S = 0.5  # a robot seen so lately is where it was seen, whatever it told before


class Report(NamedTuple):
    """What a robot tells of itself, in the frame of its own belief."""

    time_s: float
    pose: Array  # (3,)
    goal: Array | None  # (2,) [m]
    chart_s: float  # when the chart was made
    chart: Chart | None


class Knowledge:
    """One robot's knowledge of its team.

    Parameters
    ----------
    robot : int
        Whose.
    backend : Backend
        Its own estimator.
    team : TeamConfig
        How many there are, and what is known of their starts.
    frame_known : bool
        Whether its frame is the team's.
    """

    def __init__(self, robot: int, backend: Backend, team: TeamConfig, *, frame_known: bool) -> None:
        self.robot = robot
        self.goal: Array | None = None  # (2,) [m] where it says that it goes
        self._backend, self._team = backend, team
        self.heard: dict[int, Report] = {}
        self._seen: dict[int, tuple[float, Array]] = {}  # time [s] and pose ``(3,)`` in the own frame
        self.frames: dict[int, Array | None] = {}  # pose (3,) of others' frames in the own one, None: the same
        if frame_known and team.known_starts:
            self.frames = {k: None for k in range(team.robots) if k != robot}
        self._chart: tuple[float, Chart | None] = (-math.inf, None)
        self._grid = None if team.belief == "joint" else MergedGrid(backend.grid)

    # ---- telling -------------------------------------------------------------------------------------------

    def chart_now(self, time_s: float) -> None:
        """Copy the own map, to be told from now on."""
        if self._grid is not None:
            self._chart = time_s, Chart.of(self._backend.grid)

    def report(self, time_s: float) -> Report:
        """Return what this robot tells of itself."""
        return Report(time_s, self._backend.pose, self.goal, *self._chart)

    # ---- hearing and seeing --------------------------------------------------------------------------------

    def hear(self, reports: dict[int, Report]) -> bool:
        """Take over what is newer than what was heard; tell whether there is another chart."""
        charted = False
        for robot, report in reports.items():
            known = self.heard.get(robot)
            if robot != self.robot and (known is None or report.time_s > known.time_s):
                self.heard[robot] = report
                charted |= report.chart is not None and (known is None or report.chart_s > known.chart_s)
        return charted

    def see(self, sightings: tuple[Sighting, ...], time_s: float) -> None:
        """Take note of where the others were measured to be."""
        pose = self._backend.pose
        for robot, (distance, bearing, turn), _ in sightings:
            seen = np.array([distance * math.cos(bearing), distance * math.sin(bearing), turn])
            self._seen[robot] = time_s, compose(pose, seen)

    def merge(self) -> None:
        """Put the charts that were heard into the map."""
        assert self._grid is not None  # else nobody has a chart to tell of
        self._grid.take({
            robot: (report.chart, self.frames[robot])
            for robot, report in self.heard.items()
            if report.chart is not None and robot in self.frames
        })  # fmt: skip

    # ---- reading -------------------------------------------------------------------------------------------

    @property
    def grid(self) -> OccupancyGrid:
        """The own map and the others', as far as was heard; the one of a joint belief."""
        if self._grid is None:
            return self._backend.grid
        self._grid.follow()
        return self._grid

    def teammates(self, time_s: float) -> tuple[Teammate, ...]:
        """Return the others of whom it is known where they are, or were."""
        found = []
        for robot in range(self._team.robots):
            report, seen = self.heard.get(robot), self._seen.get(robot)
            frame = self.frames.get(robot)
            placed = report is not None and robot in self.frames
            goal = None
            if placed and report is not None:
                pose, when, goal = report.pose, report.time_s, report.goal
                if frame is not None:
                    pose = compose(frame, pose)
                    goal = None if goal is None else transform_points(frame, goal[None])[0]
            if seen is not None and (not placed or seen[0] >= when or time_s - seen[0] <= _IN_SIGHT_S):
                when, pose = seen
            elif not placed:
                continue
            found.append(Teammate(robot, pose, time_s - when, goal))
        return tuple(found)
