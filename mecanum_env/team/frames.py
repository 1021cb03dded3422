"""Where the frames of the other robots' beliefs lie in a robot's own, where starts are not known for sure."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from mecanum_env.team.reports import Report
from slam.accounts.account import Account
from slam.backend import Backend
from slam.geometry import compose, inverse
from slam.grids.occupancy import OccupancyGrid
from slam.teams.alignment import Alignment, AlignmentConfig, align, same_place
from slam.teams.apart import Start, without_start
from slam.teams.contradiction import contradiction
from slam.teams.sighting import combine, relative_pose
from slam.types import Array, Sighting

__all__ = ["Frames"]

_EXACT = 1e-8 * np.eye(3)
_TRY_AGAIN_S = 10.0  # maps have to grow before another look finds what one did not
_LOOK_AGAIN_S = 60.0  # at a frame that is known, for a better one
_CONFIG = AlignmentConfig()


class Frames:
    """What a robot knows of the others' frames.

    Maps are laid on each other by their landmarks (:func:`slam.teams.alignment.align`), by the robot with the
    lower number of two, who tells the others. A sighting, or starts that are known roughly, say where to look; by
    themselves they place a robot, but no map. Where nothing says where to look, rooms that repeat may fit where
    they are not: a first match is not used before a later look, with more landmarks matched, finds the same.
    What a later look contradicts is given up.

    Parameters
    ----------
    robot : int
        Whose.
    backend : Backend
        Its estimator, which has to keep a joint covariance.
    start : Start, optional
        Its own, in the frame of all, where that is not known for sure.
    known : bool
        Whether starts are known, as well as each says, and so the frames are about one.
    """

    def __init__(self, robot: int, backend: Backend, start: Start | None = None, *, known: bool = False) -> None:
        self.found: dict[int, Array] = {}
        """Pose ``(3,)`` of a robot's frame in the own one, as far as maps tell."""
        self.told: dict[int, Array] = {}
        """Those of them that this robot found by itself, and tells the others."""
        self._held: dict[int, Alignment] = {}  # first matches that nothing has confirmed yet
        self._robot, self._backend, self._start, self._known = robot, backend, start, known
        self._rough: dict[int, tuple[Array, Array]] = {}  # pose and covariance, by sightings
        self._looked_s: dict[int, float] = {}

    def of(self, robot: int) -> Array | None:
        """Return the pose ``(3,)`` of a robot's frame, the best that is known; None where nothing is."""
        if robot in self.found:
            return self.found[robot]
        if robot in self._rough:
            return self._rough[robot][0]
        return np.zeros(3) if self._known else None

    def take_sighting(self, sighting: Sighting, report: Report) -> None:
        """Take in that a robot was seen, and what it told at the same instant."""
        seen = relative_pose(
            sighting.measured,
            sighting.cov,
            self._backend.pose,
            self._backend.pose_cov,
            report.pose,
            report.pose_cov,
        )
        before = self._rough.get(sighting.robot)
        self._rough[sighting.robot] = seen if before is None else combine([before, seen])

    def take_reports(self, time_s: float, heard: Mapping[int, Report], account: Account | None) -> None:
        """Take over what others found of the frames, and look for those that are not known yet.

        ``account`` is the own one, as the others have it.
        """
        for robot, report in heard.items():
            if robot > self._robot and account is not None and report.account is not None:
                self._look(time_s, account, report)
        # From scratch each time: what one has given up nobody goes on to tell.
        links = [(self._robot, other, pose) for other, pose in self.told.items()]
        links += [(robot, *link) for robot, report in heard.items() for link in report.frames.items()]
        placed = {self._robot: np.zeros(3)}
        while True:  # by way of as few others as can be
            further: dict[int, Array] = {}
            for one, other, pose in links:
                if one in placed and other not in placed:
                    further.setdefault(other, compose(placed[one], pose))
                elif other in placed and one not in placed:
                    further.setdefault(one, compose(placed[other], inverse(pose)))
            if not further:
                break
            placed |= further
        del placed[self._robot]
        self.found = placed

    def _look(self, time_s: float, account: Account, report: Report) -> None:
        assert report.account is not None
        robot = report.account.robot
        patience = _LOOK_AGAIN_S if robot in self.found else _TRY_AGAIN_S
        if time_s - self._looked_s.get(robot, -math.inf) < patience:
            return
        self._looked_s[robot] = time_s
        prior = self._rough.get(robot)
        other, starts = report.account, (self._start, report.start)
        if prior is None and self._known:
            prior = np.zeros(3), sum((start.frame_cov for start in starts if start is not None), _EXACT)
        if self._start is not None:
            account = without_start(account, self._start)
        if report.start is not None:
            other = without_start(other, report.start)
        chart = report.chart
        grids = None if chart is None else (self._backend.grid, chart.grid(self._backend.grid.resolution))
        self._weigh(robot, align(account, other, _CONFIG, grids=grids, prior=prior), grids, sure=prior is not None)

    def _weigh(
        self, robot: int, found: Alignment | None, grids: tuple[OccupancyGrid, OccupancyGrid] | None, *, sure: bool
    ) -> None:
        """Take over what a look has found, hold it till it is confirmed, or give up what it contradicts."""
        before = self.told.get(robot)
        if before is not None and (
            (found is not None and not same_place(before, found.pose, _CONFIG))
            or (grids is not None and contradiction(*grids, before) > _CONFIG.most_contradicted)
        ):
            del self.told[robot]
        if found is None:
            return
        first = self._held.get(robot)
        if first is not None and not same_place(first.pose, found.pose, _CONFIG):
            first = None
        if sure or robot in self.told or (first is not None and found.matches > first.matches):
            self.told[robot] = found.pose
            self._held.pop(robot, None)
        elif first is None:
            self._held[robot] = found
