"""One map out of the accounts of several robots.

It is made from scratch each time and never fed back: a robot's filter goes on with its own data alone. So nothing
is counted twice, however often and to whomever accounts are told (the trouble with decentralised fusion), and the
map is as good as one filter given the same accounts could make it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.accounts.account import Account
from slam.geometry import compose, inverse
from slam.teams.alignment import Alignment
from slam.teams.frames import ends_into, points_into, pose_into, walls_into
from slam.teams.joint import Frame, Joint, Link, SameConfig, joint_of
from slam.types import Array, Indices

__all__ = ["MergedMap", "fuse"]

Member = tuple[int, int]  # account, row of the landmark: points, then walls


@dataclass(frozen=True, kw_only=True, eq=False)
class MergedMap:
    """What several robots know together, in one frame: the first account's, or that in which frames were given."""

    robots: tuple[int, ...]  # N
    frames: Array  # (N, 3) poses of the robots' own frames
    frame_covs: Array  # (N, 3, 3)
    poses: Array  # (N, 3) of the robots
    pose_covs: Array  # (N, 3, 3)
    points: Array  # (m, 2) corners [m]
    point_covs: Array  # (m, 2, 2) [m²]
    kinds: NDArray[np.int8]  # (m,)
    directions: Array  # (m,) [rad], nan where not known
    times_seen: Indices  # (m,) by all together
    seen_by: tuple[tuple[int, ...], ...]  # (m,) robots that have the corner in their maps
    walls: Array  # (k, 2) α [rad], r [m], as accounts have them
    wall_ends: Array  # (k, 4) [m] as far as they were seen by all together
    walls_seen_by: tuple[tuple[int, ...], ...]  # (k,)
    cov: Array  # (3N + 2m + 2k,) squared: of poses, points, walls
    chi_square: float  # of what was taken for the same …
    dof: int  # … and its degrees of freedom

    @property
    def points_cov(self) -> Array:
        """Joint covariance ``(2m, 2m)`` [m²] of the corners."""
        first = 3 * len(self.robots)
        return self.cov[first : first + 2 * len(self.points), first : first + 2 * len(self.points)]


def fuse(
    accounts: Sequence[Account], alignments: Sequence[Alignment] = (), *,
    frames: Mapping[int, tuple[Array, Array]] | None = None, same: SameConfig | None = None,
) -> MergedMap:  # fmt: skip
    """Merge accounts of different robots into one map; see :mod:`slam.teams.joint` for the equations.

    Parameters
    ----------
    accounts
        One a robot, the latest.
    alignments
        Which of their landmarks are the same, as :func:`slam.teams.alignment.align` found for pairs of these very
        accounts. Poses in them are first guesses only: what matches say is counted once.
    frames
        Robot → pose ``(3,)`` and covariance ``(3, 3)`` of its frame in a common one, errors independent of each
        other and of the accounts: known starts. By default the first account's frame is the common one, and the
        others' are found by the landmarks that are the same.
    same
        See :class:`slam.teams.joint.SameConfig`.

    Raises
    ------
    ValueError
        Where a robot has two accounts, or its frame is neither given nor tied to one that is.
    """
    robots = tuple(account.robot for account in accounts)
    if not robots or len(set(robots)) != len(robots):
        raise ValueError(f"needs one account of each robot, got {robots}")
    if frames is None:
        frames = {robots[0]: (np.zeros(3), np.zeros((3, 3)))}
    clusters = _clusters(accounts, robots, alignments)
    links: list[Link] = [(*c[0], *other) for c in clusters for other in c[1:]]
    joint = joint_of(accounts, _first_frames(robots, frames, alignments), links, same)
    return _merged(accounts, joint, clusters)


def _first_frames(
    robots: Sequence[int], known: Mapping[int, tuple[Array, Array]], alignments: Sequence[Alignment]
) -> list[Frame]:
    """Return the frame of each robot: given, or guessed along alignments."""
    found: dict[int, Frame] = {r: (np.asarray(p, np.float64), np.asarray(c)) for r, (p, c) in known.items()}
    for _ in robots:
        for one in alignments:
            if one.a in found and one.b not in found:
                found[one.b] = compose(found[one.a][0], one.pose), None
            elif one.b in found and one.a not in found:
                found[one.a] = compose(found[one.b][0], inverse(one.pose)), None
    if missing := [r for r in robots if r not in found]:
        raise ValueError(f"nothing ties the frames of robots {missing} to the others'; give alignments or frames")
    return [found[r] for r in robots]


def _clusters(
    accounts: Sequence[Account], robots: Sequence[int], alignments: Sequence[Alignment]
) -> list[list[Member]]:
    """Return which landmarks are one and the same, points first; two of one robot never are."""
    sizes = [len(account.points) for account in accounts]
    cluster = {(i, row): [(i, row)] for i, a in enumerate(accounts) for row in range(len(a.points) + len(a.walls))}
    for one in alignments:
        i, j = robots.index(one.a), robots.index(one.b)
        pairs = [(u, v) for u, v in one.points.tolist()]
        pairs += [(sizes[i] + u, sizes[j] + v) for u, v in one.walls.tolist()]
        for u, v in pairs:
            first, second = cluster[i, u], cluster[j, v]
            if first is second or {k for k, _ in first} & {k for k, _ in second}:
                continue
            first += second
            cluster.update(dict.fromkeys(second, first))
    distinct = list({id(members): sorted(members) for members in cluster.values()}.values())
    return sorted(distinct, key=lambda members: (members[0][1] >= sizes[members[0][0]], members[0]))


def _merged(accounts: Sequence[Account], joint: Joint, clusters: Sequence[list[Member]]) -> MergedMap:
    """Read the merged map off the joint Gaussian; of landmarks that are the same, any one says it all."""
    count, s = len(accounts), len(joint.x)
    size = 3 * count + 2 * len(clusters)
    mean, by_all = np.zeros(size), np.zeros((size, s + 3 * count))
    placed = []
    for i, account in enumerate(accounts):
        start, frame, n = joint.starts[i], joint.frames[i], len(account.points)
        state = joint.x[start : start + len(account.cov)]
        rows, columns = slice(3 * i, 3 * i + 3), slice(s + 3 * i, s + 3 * i + 3)
        mean[rows], by_all[rows, start : start + 3], by_all[rows, columns] = pose_into(frame, state[:3])
        features = state[3:].reshape(-1, 2)
        both = zip(points_into(frame, features[:n]), walls_into(frame, features[n:]), strict=True)
        placed.append([np.concatenate(pair) for pair in both])
    for k, ((i, row), *_) in enumerate(clusters):
        rows, at = slice(3 * count + 2 * k, 3 * count + 2 * k + 2), joint.starts[i] + 3 + 2 * row
        mean[rows] = placed[i][0][row]
        by_all[rows, at : at + 2] = placed[i][1][row]
        by_all[rows, s + 3 * i : s + 3 * i + 3] = placed[i][2][row]
    cov = by_all @ joint.cov @ by_all.T
    points = [c for c in clusters if c[0][1] < len(accounts[c[0][0]].points)]
    walls = clusters[len(points) :]
    values = mean[3 * count :].reshape(-1, 2)
    blocks = [cov[a : a + 2, a : a + 2] for a in range(3 * count, 3 * count + 2 * len(points), 2)]
    return MergedMap(
        robots=tuple(a.robot for a in accounts), frames=joint.frames,
        frame_covs=np.array([joint.cov[a : a + 3, a : a + 3] for a in range(s, s + 3 * count, 3)]),
        poses=mean[: 3 * count].reshape(-1, 3),
        pose_covs=np.array([cov[a : a + 3, a : a + 3] for a in range(0, 3 * count, 3)]),
        points=values[: len(points)], point_covs=np.array(blocks).reshape(-1, 2, 2),
        kinds=np.array([_kind(accounts, c) for c in points], np.int8),
        directions=np.array([_direction(accounts, joint, c) for c in points]),
        times_seen=np.array([sum(int(accounts[i].times_seen[u]) for i, u in c) for c in points], np.int64),
        seen_by=tuple(tuple(accounts[i].robot for i, _ in c) for c in points),
        walls=values[len(points) :],
        wall_ends=np.array([
            _ends(accounts, joint, c, wall) for c, wall in zip(walls, values[len(points) :], strict=True)
        ]).reshape(-1, 4),
        walls_seen_by=tuple(tuple(accounts[i].robot for i, _ in c) for c in walls),
        cov=0.5 * (cov + cov.T), chi_square=joint.chi_square, dof=joint.dof,
    )  # fmt: skip


def _kind(accounts: Sequence[Account], members: Sequence[Member]) -> int:
    return next((int(k) for i, u in members if (k := accounts[i].kinds[u])), 0)


def _direction(accounts: Sequence[Account], joint: Joint, members: Sequence[Member]) -> float:
    """Return the mean direction in the common frame, each counted as often as it was seen."""
    known = [(i, u) for i, u in members if np.isfinite(accounts[i].directions[u])]
    if not known:
        return float("nan")
    turns = np.array([accounts[i].directions[u] + joint.frames[i, 2] for i, u in known])
    often = np.array([max(int(accounts[i].times_seen[u]), 1) for i, u in known])
    return float(np.arctan2(often @ np.sin(turns), often @ np.cos(turns)))


def _ends(accounts: Sequence[Account], joint: Joint, members: Sequence[Member], wall: Array) -> Array:
    """Return the ends ``(4,)`` of all pieces together, on the merged wall."""
    ends = np.concatenate([
        ends_into(joint.frames[i], accounts[i].wall_ends[[row - len(accounts[i].points)]]) for i, row in members
    ]).reshape(-1, 2)  # fmt: skip
    normal = np.array([np.cos(wall[0]), np.sin(wall[0])])
    along = np.array([-normal[1], normal[0]])
    reach = ends @ along
    return np.concatenate([wall[1] * normal + t * along for t in (reach.min(), reach.max())])
