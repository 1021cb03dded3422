"""What a robot tells the others: a copy of what it found out by itself, in the frame of its own start."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from slam.backend import Backend
from slam.settings import require
from slam.types import Array, Indices

__all__ = ["Account"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Account:
    """One robot's map and pose with their whole covariance, out of its own data only; arrays are read-only.

    A filter is never fed with what others told, so the errors of different robots' accounts are independent, and
    a later account of a robot replaces its earlier ones.

    Raises ``ValueError`` where shapes disagree or something but a direction is not finite.
    """

    robot: int
    stamp: float  # [s] when it was so
    pose: Array  # (3,) x [m], y [m], θ [rad]
    points: Array  # (n, 2) corners [m]
    point_ids: Indices  # (n,) as the backend numbers them
    kinds: NDArray[np.int8]  # (n,) CONVEX, CONCAVE or 0 where not known
    directions: Array  # (n,) of the bisector into free space [rad], nan where not known
    times_seen: Indices  # (n,)
    walls: Array  # (k, 2) α [rad], r [m]: x cos α + y sin α = r, the normal points into the wall, r may be < 0
    wall_ends: Array  # (k, 4) x1, y1, x2, y2 [m]: as far as they were seen
    cov: Array  # (3 + 2n + 2k,) squared: of pose, points, walls (α, r), in ordinary coordinates

    def __post_init__(self) -> None:
        n, k = len(self.points), len(self.walls)
        shapes = {
            "pose": (3,), "points": (n, 2), "point_ids": (n,), "kinds": (n,), "directions": (n,),
            "times_seen": (n,), "walls": (k, 2), "wall_ends": (k, 4), "cov": (3 + 2 * n + 2 * k,) * 2,
        }  # fmt: skip
        for name, shape in shapes.items():
            given = getattr(self, name)
            value = np.array(given)
            require(value.shape == shape, f"Account.{name} must have shape {shape}, got {value.shape}")
            require(name == "directions" or bool(np.isfinite(value).all()), f"Account.{name} must be finite")
            value.flags.writeable = False
            object.__setattr__(self, name, value)

    @property
    def pose_cov(self) -> Array:
        """Covariance ``(3, 3)`` of the pose."""
        return self.cov[:3, :3]

    @property
    def state(self) -> Array:
        """Pose, points and walls as one vector ``(3 + 2n + 2k,)``, as ``cov`` has them."""
        return np.concatenate([self.pose, self.points.ravel(), self.walls.ravel()])

    @classmethod
    def of(cls, robot: int, stamp: float, backend: Backend) -> Self:
        """Return what a backend believes at ``stamp`` [s].

        The invariant filter keeps its covariance in ordinary coordinates, too (docs/reference/invariant.md).

        Raises
        ------
        ValueError
            Where the backend keeps no joint covariance, without which nothing can be merged consistently.
        """
        belief = backend.belief
        cov = belief.whole_cov if belief.whole_cov is not None else belief.joint_cov
        if cov is None:
            raise ValueError(
                f"{type(backend).__name__} keeps no joint covariance of pose and map; "
                "use invariant-ekf, ekf-lines, compressed-ekf or ekf"
            )
        points = belief.landmarks
        times_seen, directions = backend.landmark_details()
        kinds = belief.landmark_kinds if len(belief.landmark_kinds) else np.zeros(len(points), np.int8)
        walls = belief.lines if belief.whole_cov is not None else np.zeros((0, 2))
        return cls(
            robot=robot, stamp=float(stamp), pose=belief.pose, points=points, point_ids=belief.landmark_ids,
            kinds=kinds, directions=directions, times_seen=times_seen, walls=walls,
            wall_ends=belief.line_ends[: len(walls)], cov=cov,
        )  # fmt: skip
