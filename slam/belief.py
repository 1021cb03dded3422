"""What a backend believes: the value that agents, observations and pictures are made from."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam.grids.occupancy import OccupancyGrid
from slam.types import Array, Indices

__all__ = ["Belief", "Teammate"]


_POSTPONED = (
    "landmarks", "landmark_ids", "landmark_kinds", "lines", "line_ends", "landmark_cov", "joint_cov", "whole_cov",
)  # fmt: skip


class Teammate(NamedTuple):
    """Another robot, as the last that was heard or seen of it says."""

    robot: int
    pose: Array  # (3,) in the belief's frame
    age_s: float  # since it was there
    goal: Array | None = None  # (2,) where it said to go [m], in the belief's frame
    ended: bool = False  # it has told that it stands where it is for good
    heard_s: float = math.inf  # since it was last heard
    sigma_m: float = 0.0  # of where it told that it is, while starts are known but roughly: 1σ, the worst way


@dataclass(frozen=True, slots=True, weakref_slot=True)
class Belief:
    """What a backend believes now, in the frame of its start. Arrays are copies; the grid is live.

    In a team the grid is of all that the robot knows, its own observations and what others told.
    """

    pose: Array  # (3,) x [m], y [m], θ [rad]
    pose_cov: Array  # (3, 3)
    landmarks: Array  # (n, 2) [m]
    landmark_cov: Array  # (n, 2, 2) [m²]
    landmark_ids: Indices  # (n,) never reused within an episode
    grid: OccupancyGrid
    joint_cov: Array | None = None  # (3 + 2n, 3 + 2n), robot first, where the backend has one
    landmark_kinds: NDArray[np.int8] = field(  # (n,) CONVEX, CONCAVE or 0 where not known
        default_factory=lambda: np.zeros(0, np.int8)
    )
    lines: Array = field(default_factory=lambda: np.zeros((0, 2)))  # (k, 2) walls: α [rad], r [m]
    line_ends: Array = field(default_factory=lambda: np.zeros((0, 4)))  # (k, 4) x1, y1, x2, y2 [m]
    health: float = 1.0  # probability that the true pose lies within the 99.7 % region of pose and pose_cov
    whole_cov: Array | None = None  # joint_cov with the walls' (α, r) behind the points: (3 + 2n + 2k, …)
    teammates: tuple[Teammate, ...] = ()  # those of whom it knows where they are, by rising number
    robot: int = 0  # its own number in the team
    _read: tuple[Callable[[], dict[str, Any]], Callable[[], Array], Callable[[], Array]] | None = field(
        default=None, repr=False, compare=False
    )  # see postponed

    @classmethod
    def without_landmarks(cls, pose: Array, pose_cov: Array, grid: OccupancyGrid, health: float = 1.0) -> Belief:
        """Return a belief of a pose and a map alone."""
        return cls(
            pose=pose, pose_cov=pose_cov, landmarks=np.zeros((0, 2)), landmark_cov=np.zeros((0, 2, 2)),
            landmark_ids=np.zeros(0, np.int64), grid=grid, health=health,
        )  # fmt: skip

    @classmethod
    def postponed(
        cls, landmarks: Callable[[], dict[str, Any]], landmark_cov: Callable[[], Array],
        whole_cov: Callable[[], Array], **known: Any,
    ) -> Belief:  # fmt: skip
        """Return a belief whose landmarks, walls and their covariances are read when first asked for.

        Those of a large map take long to copy, and most who are given a belief never look at them. Whoever gave
        the belief calls :meth:`settle` before the estimate becomes another.
        """
        later: Any = None
        belief = cls(
            landmarks=later, landmark_cov=later, landmark_ids=later, _read=(landmarks, landmark_cov, whole_cov),
            **known,
        )  # fmt: skip
        for name in _POSTPONED:
            object.__delattr__(belief, name)
        return belief

    def in_team(self, robot: int, grid: OccupancyGrid, teammates: tuple[Teammate, ...]) -> Belief:
        """Return the belief of a team's robot of this number: with the team's map, and the others."""
        if self._read is None:
            return replace(self, grid=grid, teammates=teammates, robot=robot)
        names = _POSTPONED[:5]
        return Belief.postponed(
            lambda: {name: getattr(self, name) for name in names}, lambda: self.landmark_cov,
            lambda: np.asarray(self.whole_cov), pose=self.pose, pose_cov=self.pose_cov, grid=grid,
            health=self.health, teammates=teammates, robot=robot,
        )  # fmt: skip

    @property
    def has_whole_cov(self) -> bool:
        """Whether there is a ``whole_cov``; asking for that itself may take long."""
        return self._read is not None or self.whole_cov is not None

    def settle(self) -> None:
        """Read what was postponed."""
        if self._read is not None:
            for name in _POSTPONED:
                getattr(self, name)
            object.__setattr__(self, "_read", None)

    def __getstate__(self) -> list[Any]:
        """Return all values, read: how to read them stays here."""
        self.settle()
        return [getattr(self, each.name) for each in fields(self)]

    def _repr_png_(self) -> bytes:
        """Return the picture that a notebook shows."""
        import cv2

        from slam.grids.picture import draw_known

        return bytes(cv2.imencode(".png", draw_known(self.grid, self.landmarks, self.pose))[1])

    if not TYPE_CHECKING:  # to a type checker it would say that there is any attribute

        def __getattr__(self, name: str) -> Any:
            """Read what was postponed: called where an attribute is not there."""
            if name not in _POSTPONED:
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            landmarks, landmark_cov, whole_cov = self._read
            if name == "landmark_cov":
                values = {name: landmark_cov()}
            elif name == "joint_cov":
                whole, points = self.whole_cov, 3 + 2 * len(self.landmarks)
                values = {name: whole[:points, :points].copy() if len(whole) > points else whole}
            elif name == "whole_cov":
                values = {name: whole_cov()}
            else:
                values = landmarks()
            for key, value in values.items():
                object.__setattr__(self, key, value)
            return values[name]
