"""What a robot knows: its own belief, and of each other robot the last that it heard or saw.

A robot's filter is fed by its own sensors alone. What robots tell each other is what each saw itself, and who
passes something on passes it on as it was: so no information is counted twice (docs/reference/teams.md).
"""

from __future__ import annotations

import math

import numpy as np

from mecanum_env.team.config import TeamConfig
from mecanum_env.team.frames import Frames
from mecanum_env.team.reports import Report
from slam.accounts.account import Account
from slam.backend import Backend
from slam.belief import Teammate
from slam.geometry import compose, transform_points
from slam.grids.occupancy import OccupancyGrid
from slam.teams.apart import Start
from slam.teams.merged_grid import Chart, MergedGrid
from slam.types import Array, Sighting

__all__ = ["Knowledge"]

_IN_SIGHT_S = 0.5  # where frames are not known exactly, a robot seen so lately is where it was seen


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
    start : Start, optional
        Its own, in the frame of all, where that is known but not for sure.
    """

    def __init__(self, robot: int, backend: Backend, team: TeamConfig, start: Start | None = None) -> None:
        self.robot = robot
        self.goal: Array | None = None  # (2,) [m] where it says that it goes
        self._backend, self._team = backend, team
        self.heard: dict[int, Report] = {}
        self._sightings: tuple[Sighting, ...] = ()  # of this step
        self._seen: dict[int, tuple[float, Array]] = {}  # time [s] and pose ``(3,)`` in the own frame
        self._frames: Frames | None = None  # where they are not all the same
        if team.robots > 1 and team.belief == "own" and not team.starts_exact:
            self._frames = Frames(robot, backend, start, known=team.known_starts)
        self._start = start
        self._chart: tuple[float, Chart | None, Account | None] = (-math.inf, None, None)
        self._grid = None if team.belief == "joint" else MergedGrid(backend.grid)

    # ---- telling -------------------------------------------------------------------------------------------

    def chart_now(self, time_s: float) -> None:
        """Copy the own map, to be told from now on."""
        if self._grid is not None:
            account = None if self._frames is None else Account.of(self.robot, time_s, self._backend)
            self._chart = time_s, Chart.of(self._backend.grid), account

    def report(self, time_s: float, *, ended: bool) -> Report:
        """Return what this robot tells of itself, whose episode may have ended."""
        frames = {} if self._frames is None else dict(self._frames.told)
        goal = None if ended else self.goal
        return Report(
            time_s, self._backend.pose, self._backend.pose_cov, goal, *self._chart, self._start, frames, ended
        )

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
        self._sightings = sightings
        for robot, measured, _ in sightings:
            distance, bearing, turn = measured.tolist()
            seen = distance * math.cos(bearing), distance * math.sin(bearing), turn
            self._seen[robot] = time_s, compose(pose, np.array(seen))

    def merge(self, time_s: float) -> None:
        """Put the charts that were heard into the map, as far as it is known where they lie."""
        assert self._grid is not None  # else nobody has a chart to tell of
        frames = self._frames
        if frames is not None:
            for sighting in self._sightings:
                report = self.heard.get(sighting.robot)
                if report is not None and report.time_s == time_s:
                    frames.take_sighting(sighting, report)
            frames.take_reports(time_s, self.heard, self._chart[2])
        self._grid.take({
            robot: (report.chart, None if frames is None else frames.found[robot])
            for robot, report in self.heard.items()
            if report.chart is not None and (frames is None or robot in frames.found)
        })  # fmt: skip

    # ---- reading -------------------------------------------------------------------------------------------

    @property
    def grid(self) -> OccupancyGrid:
        """The own map and the others', as far as was heard; the one of a joint belief."""
        if self._grid is None:
            return self._backend.grid
        self._grid.follow()
        return self._grid

    def frame_of(self, robot: int) -> Array | None:
        """Return the pose ``(3,)`` of a robot's frame in the own one, None where no map can be placed by it."""
        return np.zeros(3) if self._frames is None else self._frames.found.get(robot)

    def teammates(self, time_s: float) -> tuple[Teammate, ...]:
        """Return the others of whom it is known where they are, or were."""
        found = []
        for robot in range(self._team.robots):
            report, seen = self.heard.get(robot), self._seen.get(robot)
            frame = None if self._frames is None else self._frames.of(robot)
            placed = report is not None and (self._frames is None or frame is not None)
            goal, sigma_m = None, 0.0
            if report is not None and placed:
                pose, when, goal, sigma_m = report.pose, report.time_s, report.goal, self._off_m(report, robot)
                if frame is not None:
                    pose = compose(frame, pose)
                    goal = None if goal is None else transform_points(frame, goal[None])[0]
            # In one frame, known exactly, what a robot tells of itself is better by far (1 mm) than what is
            # measured of it (25 mm): a sighting counts only where it is newer. Where the frame between the two
            # may be off by more than that, what was seen lately counts before what was told.
            if seen is not None and (
                not placed
                or seen[0] > when
                or (not self._team.starts_exact and seen[0] >= min(when, time_s - _IN_SIGHT_S))
            ):
                (when, pose), sigma_m = seen, 0.0
            elif not placed:
                continue
            # Copies: reports are everybody's.
            goal = None if goal is None else goal.copy()
            ended = report is not None and report.ended
            heard_s = math.inf if report is None else time_s - report.time_s
            found.append(Teammate(robot, pose.copy(), time_s - when, goal, ended, heard_s, sigma_m))
        return tuple(found)

    def _off_m(self, report: Report, robot: int) -> float:
        """Return 1σ of where a robot says that it is [m], of what both know of their starts; 0 where maps tell."""
        team, frames = self._team, self._frames
        if not team.known_starts or team.starts_exact or (frames is not None and robot in frames.found):
            return 0.0
        both = (self._backend.pose_cov + report.pose_cov)[:2, :2]
        return math.sqrt(max(float(np.linalg.eigvalsh(both)[-1]), 0.0))
