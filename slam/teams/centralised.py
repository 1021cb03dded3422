"""Centralised EKF-SLAM: one joint Gaussian of N robots' poses and one map, with nothing left out.

    x = (x_a | m_1 … m_n),  e = (x_b, x_c, …, β)

The robot a whose turn it is stands where the single-robot filter has its robot, before the landmarks; the others
stand beside the map (:mod:`slam.gaussian.companions`), which no scan of a's shows and every scan corrects, as does
the building's direction β (:mod:`slam.landmarks.right_angles`). So each robot's step is the single-robot filter's,
kernels and all, plus a product that is linear in landmarks and robots. A turn passes by exchanging three rows:
O(n + N). With relative start poses known this is the filter of Fenwick, Newman and Leonard (ICRA 2002), and what
distributed ones are measured against.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from slam.accounts.account import Account
from slam.belief import Belief
from slam.ekf import EkfSlam
from slam.gaussian.companions import Companions
from slam.gaussian.settings import EkfConfig, EkfLinesConfig
from slam.geometry import wrap
from slam.grids.occupancy import OccupancyGrid
from slam.landmarks.book import LAST_SEEN, LandmarkBook, LandmarkPolicy
from slam.metrics.measures import nees_pose
from slam.settings import require
from slam.teams.apart import EXACT_COV, Apart, Start
from slam.teams.turns import correct_by_sighting, swap_robots
from slam.types import LINE, Array, Floats, Indices, Observations, Odometry, Scan

__all__ = ["JointEkf", "JointMember"]

_KNOWN = (0.05, 0.05, 0.01)  # [m, m, rad] 1σ of a start; a robot that knows less of it maps alone at first
_SHARED = ("_x", "_p", "_n", "_h", "_w", "_s", "_beside")  # what a turn hands on: of EkfSlam's attributes these


class JointEkf:
    """The joint filter of a team: reset it, then feed each of its ``members`` as a backend of its own.

    Parameters
    ----------
    robots : int
        How many; at least 1.
    config : EkfConfig, optional
        Every robot's; that of ``ekf-lines`` if left out. Landmarks with known ids have the ids of all robots.

    Attributes
    ----------
    members : tuple[JointMember, ...]
        One backend a robot.

    Notes
    -----
    All of it is in one frame, that of the start poses. A robot but the first whose start is not known to within
    0.05 m and 0.01 rad maps alone (``apart``) until its map and the others' say where it started: its landmarks
    have ids of its own until then (:mod:`slam.teams.apart`). Shared are the landmarks, every covariance and one
    grid, into which all scans are drawn: who follows it by ``take_changes`` must be one for all robots. Each robot
    has its own wheels, extractor, health, key scans and count of updates: what "lately seen" means is its own
    affair.
    """

    def __init__(self, robots: int, config: EkfConfig | None = None) -> None:
        require(robots >= 1, f"a team has at least 1 robot, got {robots}")
        self.config = config or EkfLinesConfig()
        self.members = tuple(JointMember(self, i, self.config) for i in range(robots))
        self.reset(np.zeros((robots, 3)))

    def reset(self, poses: ArrayLike, covs: ArrayLike | None = None, seed: int = 0) -> None:
        """Start over at poses ``(N, 3)``, independent and of covariances ``(N, 3, 3)``, the map empty.

        Without ``covs`` all of them are known as well as a single robot's start. ``ValueError`` for other shapes.
        """
        at, many = np.array(poses, dtype=np.float64), len(self.members)
        if at.shape != (many, 3):
            raise ValueError(f"the start poses of {many} robots are ({many}, 3) numbers, got {at.shape}")
        known = [None] * many if covs is None else list(np.array(covs, dtype=np.float64))
        if len(known) != many:
            raise ValueError(f"{many} robots need as many covariances, got {len(known)}")
        for member, pose, cov in zip(self.members, at, known, strict=True):
            member._begin_at(pose, cov, seed)
        first = self.members[0]
        others = np.zeros((3 * (many - 1), 3 * (many - 1)))
        for i, member in enumerate(self.members[1:]):
            others[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = member._start_cov
            if np.any(np.diag(member._start_cov) > np.square(_KNOWN)):
                apart = Apart(start=Start(at[i + 1], member._start_cov))
                member._begin_at(at[i + 1], EXACT_COV, seed)
                member._apart = apart
            else:
                member.grid = first.grid
        first._beside = Companions(len(first._match), len(first._x), others, direction=first._squares)
        first._beside.mean[: len(others)] = at[1:].ravel()
        self._active = 0
        self._row = [-3, *range(0, 3 * (many - 1), 3)]  # where a robot stands beside the map; -3 is before it

    @property
    def grid(self) -> OccupancyGrid:
        """The map of cells that all members draw into but those who map alone; live."""
        return self.members[0].grid

    @property
    def poses(self) -> Array:
        """Pose means ``(N, 3)``."""
        at = self.members[self._active]
        every: Array = np.concatenate([at._x[:3], at._beside.mean])[self._rows()].reshape(-1, 3)
        every[:, 2] = wrap(every[:, 2])
        for member in self._apart():
            every[member.index] = member.pose
        return every

    def joint_pose_cov(self) -> Array:
        """Return the covariance ``(3N, 3N)`` of all robots' poses, in their order."""
        cov, rows = self._whole_cov(3), self._rows()
        return self._with_apart(cov[np.ix_(rows, rows)])

    def joint_cov(self) -> Array:
        """Return the covariance ``(3N + 2n, 3N + 2n)`` of all robots' poses and all landmarks, walls included."""
        size, rows = self.members[self._active]._n, self._rows()
        cov = self._whole_cov(size)
        order = np.concatenate([np.where(rows < 3, rows, rows + size - 3), np.arange(3, size)])
        return self._with_apart(cov[np.ix_(order, order)])

    def _apart(self) -> list[JointMember]:
        return [member for member in self.members if member.apart]

    def _with_apart(self, cov: Array) -> Array:
        """Put in the poses of robots that map alone; in the joint filter they stand where they started."""
        for member in self._apart():
            rows = slice(3 * member.index, 3 * member.index + 3)
            cov[rows, rows] = member.pose_cov
        return cov

    def _whole_cov(self, n: int) -> Array:
        """Return the covariance of the first ``n`` states of the map's filter and those beside them."""
        at = self.members[self._active]
        p, cross = np.triu(at._p[:n, :n]), at._beside.cross[:, :n]
        return np.block([[p + np.triu(p, 1).T, cross.T], [cross, at._beside.cov]])

    def _rows(self) -> Indices:
        """Return where every pose stands ``(3N,)`` when those beside the map follow the active robot's."""
        return (3 + np.array(self._row)[:, None] + np.arange(3)).ravel()

    def _turn(self, index: int) -> None:
        """Let it be this robot's turn."""
        before, now = self.members[self._active], self.members[index]
        if before is now or now.apart:
            return
        before._settle_beliefs()  # they read the rows that another robot's pose stands in from now on
        for name in _SHARED:
            setattr(now, name, getattr(before, name))
        now._team_book.take_over(before._team_book)
        row, beside = self._row[index], now._beside
        swap_robots(now._x, now._p, now._n, beside.mean, beside.cov, beside.cross, row)
        self._row[self._active], self._row[index] = row, self._row[self._active]
        self._active = index

    def _join(self, member: JointMember, start: Start) -> None:
        """Let a robot that mapped alone be one of all, from a start; what it measured is measured again."""
        kept, at, row = member._apart, self.members[self._active], self._row[member.index]
        assert kept is not None
        member._settle_beliefs()
        at._beside.mean[row : row + 3], at._beside.cov[row : row + 3, row : row + 3] = start
        member._begin_at(start.pose, start.cov, 0)
        member.grid = self.grid
        for measured in kept.measured:
            if isinstance(measured, Scan):
                member.update(measured)
            else:
                member.predict(measured)


class JointMember(EkfSlam):
    """One robot of a :class:`JointEkf`: a backend like ``ekf-lines`` whose map is the team's.

    It tells its health and never gives up (``relocalises`` is False): to put back what was before the first
    doubtful scan, as a single robot does, would undo what all the others have seen since.
    """

    relocalises = False

    def __init__(self, team: JointEkf, index: int, config: EkfConfig) -> None:
        self._team, self.index = team, index
        self._apart: Apart | None = None
        super().__init__(config)

    def reset(self, *args: object, **kwargs: object) -> None:
        """Refuse: the start of one robot is the start of all."""
        raise RuntimeError("one robot of a team cannot start over: call JointEkf.reset with the poses of all")

    @property
    def apart(self) -> bool:
        """Whether this robot still maps alone."""
        return self._apart is not None

    def _begin_at(self, pose: Array, cov: Array | None, seed: int) -> None:
        self._apart = None
        super().reset(pose, pose_cov=cov, seed=seed)

    def _start(self, pose: Array, pose_cov: Array, seed: int) -> None:
        super()._start(pose, pose_cov, seed)
        self._start_cov = pose_cov

    def _companions(self) -> Companions:
        return Companions(len(self._match), len(self._x), direction=self._squares)  # no errors of any wheels

    def _begin(self, policy: LandmarkPolicy) -> None:
        super()._begin(policy)
        self._book = self._team_book = _TeamBook(policy)

    # ---- the filter: each call is a turn -------------------------------------------------------------------

    def predict(self, odometry: Odometry) -> None:
        """Move this robot on by what its wheels measured."""
        self._team._turn(self.index)
        super().predict(odometry)
        if self._apart is not None:
            self._apart.keep(odometry)

    def update(self, scan: Scan) -> None:
        """Correct all robots and the map by a scan of this one's."""
        self._team._turn(self.index)
        super().update(scan)
        if self._apart is not None:
            self._apart.keep(scan)
            if self._apart.due:
                self._look_for_others(self._apart)

    def _look_for_others(self, apart: Apart) -> None:
        team, landmarks = self._team, np.concatenate(self._points_and_walls())
        at = team.members[team._active]
        own = replace(Account.of(self.index, 0.0, self), cov=super()._covariance(landmarks))
        if (start := apart.look(Account.of(at.index, 0.0, at), own, (at.grid, self.grid))) is not None:
            team._join(self, start)

    def observe(self, observations: Observations) -> None:
        """Correct all robots and the map by landmark observations of this robot's.

        Landmarks that are told apart need no search: one that maps alone is one of all from then on.
        """
        if self._apart is not None:
            self._team._join(self, self._apart.start)
        self._team._turn(self.index)
        super().observe(observations)

    def see(self, other: int, z: ArrayLike, cov: ArrayLike, *, gate: float = math.inf) -> float:
        """Correct all by where this robot sees the body of another one; return the NIS (three degrees of freedom).

        Parameters
        ----------
        other : int
            The index of the robot that is seen.
        z : Array
            ``(3,)`` range [m] and bearing [rad] of its body's centre from this one's, and its heading less this
            one's [rad]: :func:`slam.teams.turns.expected_sighting`.
        cov : Array
            ``(3, 3)`` covariance of ``z``.
        gate : float
            Nothing is corrected where the NIS is above it, nor where one of the two maps alone: that is nan.
        """
        team, at, r = self._team, np.array(z, dtype=np.float64), np.array(cov, dtype=np.float64)
        if not 0 <= other < len(team.members) or other == self.index:
            raise ValueError(f"robot {self.index} of {len(team.members)} cannot see a robot {other}")
        if at.shape != (3,) or r.shape != (3, 3) or not (np.all(np.isfinite(at)) and np.all(np.isfinite(r))):
            raise ValueError("a sighting is three finite numbers with a finite (3, 3) covariance")
        for member in (self, team.members[other]):
            if member._apart is not None and member._apart.scans:
                return math.nan
            if member._apart is not None:  # without a map it finds nobody by it
                team._join(member, member._apart.start)
        team._turn(self.index)
        self._settle_beliefs()
        beside = self._beside
        return float(correct_by_sighting(
            self._x, self._p, self._n, beside.mean, beside.cov, beside.cross, team._row[other], at, r, gate,
            self._w, self._s, np.zeros((3, len(beside.mean))),
        ))  # fmt: skip

    def _find(self, pose: Array, pose_cov: Array) -> None:
        self._place(pose, pose_cov)  # what it shared with the map when it was lost, others have corrected since

    def _redraw_if_moved(self) -> bool:
        others = [m.key_scans for m in self._team.members if m is not self and not (m.apart or self.apart)]
        return self.key_scans.redraw_if_moved(self.grid, *self._map_points(), others)

    # ---- the belief: each look is a turn, too --------------------------------------------------------------

    @property
    def pose(self) -> Array:
        """Pose mean ``(3,)`` of this robot."""
        self._team._turn(self.index)
        return super().pose

    @property
    def pose_cov(self) -> Array:
        """Pose covariance ``(3, 3)`` of this robot."""
        self._team._turn(self.index)
        own = super().pose_cov
        none = np.zeros((0, 2))
        return own if self._apart is None else own + self._apart.in_all(self._x[:3], none, none)

    def _drawing_cov(self) -> Array:
        return super().pose_cov

    def _covariance(self, landmarks: Indices) -> Array:
        cov: Array = super()._covariance(landmarks)
        return cov if self._apart is None else cov + self._in_all(landmarks)

    def _own_covariances(self, landmarks: Indices) -> Array:
        own: Array = super()._own_covariances(landmarks)
        if self._apart is not None and len(landmarks):
            added = self._in_all(landmarks)[3:, 3:].reshape(len(landmarks), 2, len(landmarks), 2)
            own = own + np.einsum("iajb,ij->iab", added, np.eye(len(landmarks)))
        return own

    def _in_all(self, landmarks: Indices) -> Array:
        """Return what the start's error adds to the covariance of the robot and some landmarks, in their order."""
        assert self._apart is not None
        walls = self._marks[landmarks, 0] == LINE
        order = np.argsort(np.concatenate([np.flatnonzero(~walls), np.flatnonzero(walls)]))
        at = self._points[landmarks]
        rows = np.concatenate([np.arange(3), (3 + 2 * order[:, None] + np.arange(2)).ravel()])
        added: Array = self._apart.in_all(self._x[:3], at[~walls], at[walls])[np.ix_(rows, rows)]
        return added

    def pose_nees(self, true_pose: Array) -> float:
        """Return the NEES of this robot's pose against the truth ``(3,)``."""
        self._team._turn(self.index)
        return (
            super().pose_nees(true_pose) if self._apart is None else nees_pose(self.pose, self.pose_cov, true_pose)
        )

    @property
    def joint_cov(self) -> Array:
        """Covariance ``(3 + 2n, 3 + 2n)`` of this robot and every landmark, walls included."""
        self._team._turn(self.index)
        return super().joint_cov

    @property
    def belief(self) -> Belief:
        """The pose of this robot, the landmarks, their joint covariance and the grid."""
        self._team._turn(self.index)
        return super().belief

    def near_landmarks(self, out: Floats) -> None:
        """Write the landmarks nearest to this robot in its frame (see the base class)."""
        self._team._turn(self.index)
        super().near_landmarks(out)

    @property
    def landmark_count(self) -> int:
        """Number of the team's landmarks, walls included."""
        self._team._turn(self.index)
        return super().landmark_count

    def landmark_details(self) -> tuple[Indices, Array]:
        """Return per point landmark how often all robots saw it and its direction in the belief's frame [rad]."""
        self._team._turn(self.index)
        return super().landmark_details()


class _TeamBook(LandmarkBook):
    """One robot's look at the team's landmarks.

    They are the team's, and so is how often they were seen or missed. The count of updates, tentative ones and
    when a landmark was seen last are the robot's own: one that only others have seen it never saw, so that meeting
    it is closing a loop (:mod:`slam.landmarks.loop_closing`).
    """

    def __init__(self, policy: LandmarkPolicy) -> None:
        super().__init__(policy)
        self._seen = np.zeros(0)  # (ids,) last sightings of landmarks, while it is another robot's turn

    def take_over(self, other: _TeamBook) -> None:
        """Go on with the landmarks of another robot's book, which is put away."""
        ids, size = other.ids, len(other.row_of_id)
        other._seen = np.full(size, -np.inf)
        other._seen[ids] = other.marks[:, LAST_SEEN]
        self.count, self.next_id, self.row_of_id = other.count, other.next_id, other.row_of_id
        self._ids, self._marks, self._own, self.label_ids = other._ids, other._marks, other._own, other.label_ids
        seen = np.full(size, -np.inf)
        seen[: len(self._seen)] = self._seen
        self.marks[:, LAST_SEEN] = seen[ids]
