"""The recording of an episode, step by step: what its report replays, and its film and exports are made from.

While the episode runs little more is done than to keep references; see :class:`Recorder`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from slam.grids.occupancy import UNKNOWN, OccupancyGrid
from slam.types import Array, Scan

if TYPE_CHECKING:
    from agents.base import Goal
    from mecanum_env.env import ExploreEnv
    from mecanum_env.team.team import Team

__all__ = ["Recorded", "Recorder", "Recording", "TeamRecorder"]

Ints = NDArray[np.int32]
_Notes = dict[int, NDArray[Any]]  # by the step that they were noted in

_SCAN_EVERY = 2  # steps
_MAP_EVERY = 5
_LANDMARKS_EVERY = 10


@dataclass(frozen=True, eq=False)
class Recorded:
    """Something that was noted now and then: values[i] holds from step ``steps[i]`` on."""

    steps: Ints  # (k,) ascending
    values: tuple[NDArray[np.generic], ...]  # k arrays

    def items(self) -> Iterator[tuple[int, NDArray[Any]]]:
        """Return each step with the value that was noted then."""
        return zip(self.steps.tolist(), self.values, strict=True)


@dataclass(frozen=True, eq=False)
class Recording:
    """An episode of ``n`` rows, the first its start, in the start frame, which is the belief's; SI units."""

    step_s: float
    times: Array  # (n,) [s]
    true_poses: Array  # (n, 3)
    estimates: Array  # (n, 3)
    pose_covs: Array  # (n, 3, 3)
    twists: Array  # (n, 3) the wheels' account of the step: vx, vy [m/s], ω [rad/s] in the body frame
    coverage: Array  # (n,)
    nees: Array  # (n,) of the pose, ideally 3 on average
    health: Array  # (n,) of the belief
    collisions: Ints  # (n,) so far
    resolution: float  # [m] of a cell
    scan: Scan  # the first one: its angles and limits are those of all
    scans: Recorded  # (beams,) float32 [m], as Scan.ranges
    goals: Recorded  # (m, 2) float32: the way that the agent means to go [m]; (0, 2) without a goal
    landmarks: Recorded  # (m, 5) float32: x, y [m], σxx, σxy, σyy [m²]
    map_changes: Recorded  # (c, 3) int32: lattice row and column of cells, and the class that they have now

    def bounds(self) -> tuple[int, int, int, int]:
        """Return the lattice rows and columns that hold every cell ever known: row0, col0, row1, col1."""
        cells = [change for change in self.map_changes.values if len(change)]
        if not cells:
            return 0, 0, 1, 1
        low = np.min([change[:, :2].min(axis=0) for change in cells], axis=0)
        high = np.max([change[:, :2].max(axis=0) for change in cells], axis=0)
        return int(low[0]), int(low[1]), int(high[0]) + 1, int(high[1]) + 1


class Recorder:
    """Notes an episode: :meth:`take` after ``reset`` and after every step, :meth:`recording` at the end."""

    def __init__(self) -> None:
        self._steps = 0
        self._covs: list[Array] = []
        self._twists: list[tuple[float, float, float] | Array] = []
        self._collisions: list[int] = []
        self._scans: _Notes = {}
        self._goals: _Notes = {}
        self._landmarks: _Notes = {}
        self._maps: _Notes = {}
        self._map = _MapFollower()
        self._goal: Goal | None = None

    @property
    def rows(self) -> int:
        """How often something was noted."""
        return self._steps

    def take(self, env: ExploreEnv, goal: Goal | None) -> None:
        """Note the environment as it is now, and where the agent means to go."""
        step, self._steps = self._steps, self._steps + 1
        if step == 0:
            self._env, self._scan = env, env.truth.scan
        backend = env.backend
        self._covs.append(backend.pose_cov)
        self._twists.append(env.odometry.twist)
        self._collisions.append(env.truth.world.collisions)
        self._map.follow(env.map_changes)
        if goal is not self._goal or step == 0:
            self._goal = goal
            self._goals[step] = np.asarray(() if goal is None else goal.path, np.float32).reshape(-1, 2)
        if step % _SCAN_EVERY == 0:
            self._scans[step] = env.truth.scan.ranges.astype(np.float32)
        if step % _MAP_EVERY == 0:
            self._note_map(step, self._map, self._maps)
        if step % _LANDMARKS_EVERY == 0:
            self._note_landmarks(step, self._landmarks)

    def recording(self) -> Recording:
        """Return what was recorded so far, as it is now; what is recorded later does not depend on it."""
        env, last = self._env, self._steps - 1
        maps, landmarks = self._maps.copy(), self._landmarks.copy()
        self._note_map(last, deepcopy(self._map), maps)
        self._note_landmarks(last, landmarks)
        record = env.truth.record
        return Recording(
            step_s=env.config.step_s, times=record.times, true_poses=record.true_poses, estimates=record.estimates,
            pose_covs=np.array(self._covs), twists=np.array(self._twists), coverage=record.coverage,
            nees=record.nees, health=record.health, collisions=np.array(self._collisions, np.int32),
            resolution=env.backend.grid.resolution, scan=self._scan, scans=_recorded(self._scans),
            goals=_recorded(self._goals), landmarks=_recorded(landmarks), map_changes=_recorded(maps),
        )  # fmt: skip

    def _note_map(self, step: int, follower: _MapFollower, notes: _Notes) -> None:
        changes = follower.take(self._env.backend.grid)
        if len(changes):
            notes[step] = changes

    def _note_landmarks(self, step: int, notes: _Notes) -> None:
        belief = self._env.belief
        cov = belief.landmark_cov
        rows = np.column_stack([belief.landmarks, cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]])
        notes[step] = rows.astype(np.float32)


class TeamRecorder:
    """Notes every robot of a team that is still exploring: a witness of :func:`training.episodes.team.run`."""

    def __init__(self) -> None:
        self._recorders: list[Recorder] = []

    def take(self, team: Team, goals: Sequence[Goal | None]) -> None:
        """Note the team as it is now, and where each robot means to go."""
        if not self._recorders:
            self._recorders = [Recorder() for _ in team.members]
        for member, recorder, goal in zip(team.members, self._recorders, goals, strict=True):
            # One that has ended stands still, and its own record has ended, too.
            if len(member.truth.record) > recorder.rows:
                recorder.take(member, goal)

    def recording(self) -> list[Recording]:
        """Return what was recorded so far of each robot; those that ended before have fewer rows."""
        return [recorder.recording() for recorder in self._recorders]


def _recorded(notes: _Notes) -> Recorded:
    return Recorded(np.array(list(notes), np.int32), tuple(notes.values()))


class _MapFollower:
    """A map's classes as last told, and what has changed since: told in few, whatever a redraw does."""

    def __init__(self) -> None:
        self._told = np.full((0, 0), UNKNOWN, np.int8)
        self._origin = (0, 0)
        self._changes: list[Ints] = []
        self._redrawn = False

    def follow(self, changes: Ints | None) -> None:
        """Keep a step's changes; ``None`` where the whole map was redrawn."""
        if changes is None:
            self._redrawn = True
            self._changes.clear()
        elif len(changes) and not self._redrawn:
            self._changes.append(changes)

    def take(self, grid: OccupancyGrid) -> Ints:
        """Return the cells ``(n, 3)`` whose class is another than last told: lattice row, column, class now."""
        if not (self._redrawn or self._changes):
            return np.zeros((0, 3), np.int32)
        self._make_room(grid)
        row0, col0 = self._origin
        told = self._told
        if self._redrawn:
            r, c = grid.lattice_origin[0] - row0, grid.lattice_origin[1] - col0
            now = np.full_like(told, UNKNOWN)
            now[r : r + grid.shape[0], c : c + grid.shape[1]] = grid.classes()
            cells = np.argwhere(now != told)
            classes = now[cells[:, 0], cells[:, 1]]
            self._told = now
        else:
            changes = np.concatenate(self._changes)
            # A cell's last change counts: of several the first found from behind.
            width = told.shape[1]
            index = (changes[:, 0] - row0) * width + (changes[:, 1] - col0)
            index, last = np.unique(index[::-1], return_index=True)
            classes = changes[::-1, 3][last].astype(np.int8)
            differ = told.ravel()[index] != classes
            index, classes = index[differ], classes[differ]
            told.ravel()[index] = classes
            cells = np.column_stack([index // width, index % width])
        self._changes.clear()
        self._redrawn = False
        return np.column_stack([cells + np.array([row0, col0]), classes]).astype(np.int32)

    def _make_room(self, grid: OccupancyGrid) -> None:
        """Let the classes told cover the grid's lattice, whatever it covered before."""
        if grid.lattice_origin == self._origin and grid.shape == self._told.shape:
            return
        before = self._told
        row, col = self._origin if before.size else grid.lattice_origin
        # Another particle's grid may be smaller than the last one's.
        row0, col0 = (min(a, b) for a, b in zip((row, col), grid.lattice_origin, strict=True))
        row1 = max(row + before.shape[0], grid.lattice_origin[0] + grid.shape[0])
        col1 = max(col + before.shape[1], grid.lattice_origin[1] + grid.shape[1])
        self._told = np.full((row1 - row0, col1 - col0), UNKNOWN, np.int8)
        self._told[row - row0 : row - row0 + before.shape[0], col - col0 : col - col0 + before.shape[1]] = before
        self._origin = (row0, col0)
