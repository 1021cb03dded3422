"""What a team's episode amounts to: coverage of all together, who saw what first, contacts, and its metrics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.base import Goal
from mecanum_env.episode import score_map, wall_metrics
from mecanum_env.team.member import Member
from mecanum_env.team.team import Team
from slam.accounts.account import Account
from slam.accounts.corners import settled
from slam.geometry import compose, inverse
from slam.grids.occupancy import OccupancyGrid
from slam.metrics import measures
from slam.teams.alignment import align
from slam.teams.apart import Start, without_start
from slam.teams.fusion import MergedMap, fuse
from slam.teams.merged_grid import Chart, MergedGrid
from slam.types import Array

__all__ = ["TeamLog", "team_landmarks", "team_map", "team_metrics"]

_FIRST_EVERY_S = 1.0  # what several see for the first time within so long is shared between them
_LOOK_NEAR = np.diag([0.1, 0.1, 0.02]) ** 2  # of a frame that is known, when landmarks are compared [m, m, rad]
_EXACT = 1e-8 * np.eye(3)  # never exactly zero
_SUMS = ("path_length_m", "collisions", "relocalisations", "landmarks", "lost_s")
_MEANS = ("corner_mean_m", "final_position_error_m", "final_heading_error_rad", "anees", "health_mean")


class TeamLog:
    """Notes a team's episode: :meth:`take` after ``reset`` and after every step."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._coverage: list[float] = []
        self._groups: list[NDArray[np.int64]] = []
        self._collisions: list[int] = []
        self._robot_collisions: list[int] = []

    def take(self, team: Team, goals: Sequence[Goal | None]) -> None:
        """Note the team as it is now."""
        worlds = team.fleet.worlds
        if not self._times:
            self._team = team
            self._first = np.zeros(len(worlds))
            self._found = np.zeros(team.ground.mappable.shape, np.bool_)
            self._every = max(1, round(_FIRST_EVERY_S / team.config.step_s))
        if len(self._times) % self._every == 0:
            self._found, self._first = self._who_was_first()
        self._times.append(team.time_s)
        self._coverage.append(team.coverage_share)
        self._groups.append(team.groups)
        self._collisions.append(sum(world.collisions for world in worlds))
        self._robot_collisions.append(sum(world.robot_collisions for world in worlds))

    def _who_was_first(self) -> tuple[NDArray[np.bool_], Array]:
        """Return what has been mapped by now ``(rows, cols)``, and how much each robot had first ``(robots,)``."""
        layers = self._team.coverage.layers
        counts = layers.sum(axis=0)
        new = (counts > 0) & ~self._found
        return self._found | new, self._first + (layers[:, new] / counts[new]).sum(axis=1)

    @property
    def times(self) -> Array:
        """Simulated time of each row ``(n,)`` [s]."""
        return np.array(self._times)

    @property
    def coverage(self) -> Array:
        """The team's coverage ``(n,)``."""
        return np.array(self._coverage)

    @property
    def groups(self) -> NDArray[np.int64]:
        """Of each robot the number of the group that it is heard in ``(n, robots)``."""
        return np.array(self._groups)

    @property
    def collisions(self) -> NDArray[np.int32]:
        """Contacts of all robots so far ``(n,)``."""
        return np.array(self._collisions, np.int32)

    @property
    def robot_collisions(self) -> NDArray[np.int32]:
        """Those of the contacts in which robots touched each other ``(n,)``, counted for each of the two."""
        return np.array(self._robot_collisions, np.int32)

    @property
    def first_shares(self) -> Array:
        """Of what the team has mapped, the share that each robot had first ``(robots,)``; they sum up to 1.

        Nobody's where all share one belief, and so one map: nan.
        """
        if self._team.joint is not None:
            return np.full(len(self._first), np.nan)
        _, first = self._who_was_first()
        return np.asarray(first / max(first.sum(), 1.0))


def team_map(team: Team) -> tuple[OccupancyGrid, list[int]]:
    """Return the robots' own maps put together in the first one's frame, and the robots that are in it.

    Left out are those of whom the first does not know where their frame is. A joint belief has one map, of all
    that are not apart.
    """
    first, *others = team.members
    if team.joint is not None:
        together = [k for k, member in enumerate(team.joint.members) if not member.apart]
        return team.members[together[0]].grid, together
    frames = _frames_known(team)
    merged = MergedGrid(first.backend.grid)
    merged.take({
        m.number: (Chart.of(m.backend.grid), frames[m.number] if frames[m.number].any() else None)
        for m in others
        if m.number in frames
    })  # fmt: skip
    merged.follow()
    return merged, list(frames)


def team_landmarks(team: Team) -> MergedMap | None:
    """Return the landmarks of all robots that are in :func:`team_map`, those that are the same as one.

    None where backends keep no joint covariance, and of a joint belief, which has them already.
    """
    frames = _frames_known(team)
    if team.joint is not None:
        return None
    try:
        accounts = [_account(team.members[k], team.time_s) for k in frames]
    except ValueError:
        return None
    alignments = []
    for a, b in combinations(accounts, 2):
        where = compose(inverse(frames[a.robot]), frames[b.robot])
        grids = [team.members[account.robot].backend.grid for account in (a, b)]
        alignments.append(align(a, b, grids=(grids[0], grids[1]), prior=(where, _LOOK_NEAR)))
    found = [one for one in alignments if one is not None]
    accounts = [settled(account) for account in accounts]
    if team.team.starts_exact:
        return fuse(accounts, found, frames={k: (pose, _EXACT) for k, pose in frames.items()})
    tied = {0}
    for one in sorted(found, key=lambda one: (one.a, one.b)) * len(accounts):
        tied |= {one.a, one.b} if {one.a, one.b} & tied else set()
    kept = [one for one in found if one.a in tied]
    return fuse([account for account in accounts if account.robot in tied], kept)


def _account(member: Member, time_s: float) -> Account:
    """Return what a robot tells of its map, less what it does not know of its start: the others tell that."""
    account = Account.of(member.number, time_s, member.backend)
    return account if member.start_cov is None else without_start(account, Start(member.start, member.start_cov))


def _frames_known(team: Team) -> dict[int, Array]:
    """Return the poses of the robots' frames in the first one's, as far as that robot knows them."""
    knowledge = team.members[0].knowledge
    found = {k: knowledge.frame_of(k) for k in range(1, len(team.members))}
    return {0: np.zeros(3)} | {k: pose for k, pose in found.items() if pose is not None}


def team_metrics(team: Team, log: TeamLog) -> dict[str, Any]:
    """Return the metrics of the team under the names that one robot's have, and ``per_robot``.

    Coverage and times are the team's, the map is :func:`team_map`; ways, contacts, landmarks and time lost are
    summed up, ATE is over all robots' poses, and other errors, NEES and health are means over the robots.
    """
    times, coverage = log.times, log.coverage
    merged, together = team_map(team)
    first = team.members[0]
    score = score_map(first.truth.ground, first.backend.belief.in_team(0, merged, ()))
    robots: list[dict[str, Any]] = [dict(member.episode_metrics()) for member in team.members]
    sums = {name: sum(robot[name] for robot in robots) for name in _SUMS}
    if team.joint is not None:  # one map, and those of the robots apart from it
        own = [robot["landmarks"] for k, robot in enumerate(robots) if k not in together]
        sums["landmarks"] = robots[together[0]]["landmarks"] + sum(own)
    means = {name: _mean([robot[name] for robot in robots]) for name in _MEANS}
    corners = [robot["corner_max_m"] for robot in robots if robot["corner_max_m"] is not None]
    weights = [robot["steps"] + 1 for robot in robots]
    squares = [robot["ate_rmse_m"] ** 2 for robot in robots]
    levels = {f"time_to_{100 * level:.0f}_s": level for level in (0.5, 0.9, 0.95, 0.99)}
    found: dict[str, Any] = {
        "coverage": float(coverage[-1]),
        "time_s": round(float(times[-1]), 6),
        "steps": len(times) - 1,
        "path_length_m": sums["path_length_m"],
        "collisions": sums["collisions"],
        "robot_collisions": int(log.robot_collisions[-1]),
        **{name: measures.time_to(coverage, times, level=level) for name, level in levels.items()},
        "map_robots": together,
        **wall_metrics(score),
        "corner_mean_m": means["corner_mean_m"],
        "corner_max_m": max(corners, default=None),
        "ate_rmse_m": math.sqrt(float(np.average(squares, weights=weights))),
        **{name: means[name] for name in _MEANS[1:]},
        **{name: sums[name] for name in _SUMS[2:]},
    }
    extra = zip(team.members, log.first_shares.tolist(), team.frames, strict=True)
    found["per_robot"] = [
        {"robot": k, "first_share": share, "robot_collisions": member.truth.world.robot_collisions,
         "frame": [round(float(v), 9) for v in frame], **robot}
        for k, ((member, share, frame), robot) in enumerate(zip(extra, robots, strict=True))
    ]  # fmt: skip
    return found


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
