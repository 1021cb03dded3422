"""A robot of a joint filter whose start is known too badly to map in the frame of all at once.

Linearised about a heading that is some degrees off, a filter grows sure of what nobody told it, and where it meets
the others' landmarks it takes one for another. So such a robot maps alone, as though its start were exact, and
what is known of its start stands beside: x = T ∘ x̃ with T = I and its covariance Σ. Every few seconds its
landmarks are held against the others' (:mod:`slam.teams.alignment`, with Σ for a prior). Once they say where its
start was, all that it has measured is taken by the joint filter, from there.

The data that told the start are then used once more. So the joint filter is told the start with a covariance a
hundred times as large as that of the alignment: about a hundredth of that information counts twice.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from slam.accounts.account import Account
from slam.geometry import compose, inverse
from slam.grids.occupancy import OccupancyGrid
from slam.teams.alignment import align
from slam.teams.frames import compose_jacobians, points_into, pose_into, walls_into
from slam.types import Array, Odometry, Scan

__all__ = ["EXACT_COV", "Apart", "Start", "without_start"]

EXACT_COV = 1e-8 * np.eye(3)
"""Of the start of a robot that maps alone."""

_LEAST = 1e-10  # eigenvalue of a covariance [m², rad²]
_LOOSER = 100.0  # in covariance
_EVERY, _FIRST = 50, 10  # scans between two looks for the others, and before the first: some start side by side


class Start(NamedTuple):
    """Where a robot started, in the frame of all."""

    pose: Array  # (3,)
    cov: Array  # (3, 3)

    @property
    def frame_cov(self) -> Array:
        """Σ ``(3, 3)`` of the frame that a robot maps in which takes this start for exact, in that of all."""
        by_start, _ = compose_jacobians(self.pose, inverse(self.pose))
        cov: Array = by_start @ self.cov @ by_start.T
        return cov


def without_start(account: Account, start: Start) -> Account:
    """Return an account as it would be had the robot known where it started: less what all in it have in common.

    Where another map says where that is, the start's own covariance tells nothing more, and is as wide as it was
    believed to be, however well the maps agree.
    """
    by_frame = _by_frame(account.pose, account.points, account.walls)
    values, axes = np.linalg.eigh(account.cov - by_frame @ start.frame_cov @ by_frame.T)
    return replace(account, cov=(axes * np.maximum(values, _LEAST)) @ axes.T)  # it is linear but nearly


def _by_frame(pose: Array, points: Array, walls: Array) -> Array:
    """Return the Jacobian ``(3 + 2n + 2k, 3)`` of pose, points and walls by the frame that they are in."""
    none = np.zeros(3)
    return np.vstack([
        pose_into(none, pose)[2], points_into(none, points)[2].reshape(-1, 3),
        walls_into(none, walls)[2].reshape(-1, 3),
    ])  # fmt: skip


@dataclass(kw_only=True)
class Apart:
    """What a robot that maps alone keeps: its start, and all it has measured."""

    start: Start
    measured: list[Odometry | Scan] = field(default_factory=list)
    scans: int = 0

    @property
    def cov(self) -> Array:
        """Σ ``(3, 3)`` of the frame that it maps in, in that of all."""
        return self.start.frame_cov

    def keep(self, measured: Odometry | Scan) -> None:
        """Remember what is told to the filter; arrays may be someone's buffers."""
        if isinstance(measured, Scan):
            self.scans += 1
            measured = measured._replace(ranges=np.array(measured.ranges))
        else:
            measured = measured._replace(twist=measured.numbers)
        self.measured.append(measured)

    def in_all(self, pose: Array, points: Array, walls: Array) -> Array:
        """Return what Σ adds to the covariance ``(3 + 2n + 2k,)`` squared of pose, points and walls."""
        by_frame = _by_frame(pose, points, walls)
        added: Array = by_frame @ self.cov @ by_frame.T
        return added

    @property
    def due(self) -> bool:
        """Whether it is time to look for the others."""
        return self.scans % _EVERY == _FIRST

    def look(self, others: Account, own: Account, grids: tuple[OccupancyGrid, OccupancyGrid]) -> Start | None:
        """Return where the robot started by what its map and the others' have in common, if that can be told."""
        found = align(others, own, grids=grids, prior=(np.zeros(3), self.cov))
        if found is None:
            return None
        by_frame, _ = compose_jacobians(found.pose, self.start.pose)
        return Start(compose(found.pose, self.start.pose), _LOOSER * by_frame @ found.cov @ by_frame.T)
