"""What a backend believes: the value that agents, observations and pictures are made from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from slam.grids.occupancy import OccupancyGrid

__all__ = ["Belief", "point_covs"]

Array = NDArray[np.float64]


def point_covs(cov: Array) -> Array:
    """Return the landmarks' own covariances ``(n, 2, 2)``, of a joint one ``(3 + 2n, 3 + 2n)``."""
    rows = 3 + np.arange(len(cov) - 3).reshape(-1, 2)
    return cov[rows[:, :, None], rows[:, None, :]]


_LANDMARKS = ("landmarks", "landmark_ids", "landmark_kinds", "lines", "line_ends")
_COVARIANCES = ("landmark_cov", "joint_cov", "whole_cov")


@dataclass(frozen=True, slots=True, weakref_slot=True)
class Belief:
    """What a backend believes now, in the frame of its start. Arrays are copies; the grid is live."""

    pose: Array  # (3,) x [m], y [m], θ [rad]
    pose_cov: Array  # (3, 3)
    landmarks: Array  # (n, 2) [m]
    landmark_cov: Array  # (n, 2, 2) [m²]
    landmark_ids: NDArray[np.int64]  # (n,) never reused within an episode
    grid: OccupancyGrid
    joint_cov: Array | None = None  # (3 + 2n, 3 + 2n), robot first, where the backend has one
    landmark_kinds: NDArray[np.int8] = field(  # (n,) CONVEX, CONCAVE or 0 where not known
        default_factory=lambda: np.zeros(0, np.int8)
    )
    lines: Array = field(default_factory=lambda: np.zeros((0, 2)))  # (k, 2) walls: α [rad], r [m]
    line_ends: Array = field(default_factory=lambda: np.zeros((0, 4)))  # (k, 4) x1, y1, x2, y2 [m]
    health: float = 1.0  # probability that the true pose lies within the 99.7 % region of pose and pose_cov
    whole_cov: Array | None = None  # joint_cov with the walls' (α, r) behind the points: (3 + 2n + 2k, …)
    _read: tuple[Callable[[], dict[str, Any]], Callable[[], Array]] | None = field(
        default=None, repr=False, compare=False
    )

    @classmethod
    def postponed(
        cls, landmarks: Callable[[], dict[str, Any]], whole_cov: Callable[[], Array], **known: Any
    ) -> Belief:
        """Return a belief whose landmarks, walls and their covariances are read when first asked for.

        Those of a large map take long to copy, and most who are given a belief never look at them. Whoever gave
        the belief calls :meth:`settle` before the estimate becomes another.
        """
        later: Any = None
        belief = cls(
            landmarks=later, landmark_cov=later, landmark_ids=later, _read=(landmarks, whole_cov), **known
        )
        for name in (*_LANDMARKS, *_COVARIANCES):
            object.__delattr__(belief, name)
        return belief

    def settle(self) -> None:
        """Read what was postponed."""
        if self._read is not None:
            for name in (_LANDMARKS[0], _COVARIANCES[0]):
                getattr(self, name)
            object.__setattr__(self, "_read", None)

    if not TYPE_CHECKING:  # to a type checker it would say that there is any attribute

        def __getattr__(self, name: str) -> Any:
            """Read what was postponed: called where an attribute is not there."""
            if name in _LANDMARKS:
                values = self._read[0]()
            elif name in _COVARIANCES:
                whole, points = self._read[1](), 3 + 2 * len(self.landmarks)
                joint = whole[:points, :points].copy() if len(whole) > points else whole
                values = dict(zip(_COVARIANCES, (point_covs(joint), joint, whole), strict=True))
            else:
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            for key, value in values.items():
                object.__setattr__(self, key, value)
            return values[name]
