"""Accounts of made-up robots in a made-up world, with errors drawn from the covariance that they state."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.accounts.account import Account
from slam.geometry import compose, inverse, transform_points, wrap
from slam.teams.frames import ends_into, walls_into
from slam.types import CONCAVE, CONVEX

Array = NDArray[np.float64]


class World:
    """Corners and walls at random, or the given ones."""

    def __init__(self, rng: np.random.Generator, *, points: int = 25, walls: int = 8, size_m: float = 8.0) -> None:
        self.points = rng.uniform(-size_m, size_m, (points, 2))
        self.kinds = rng.choice([CONVEX, CONCAVE], points).astype(np.int8)
        self.directions = rng.uniform(-np.pi, np.pi, points)
        alpha, middle = rng.uniform(-np.pi, np.pi, walls), rng.uniform(-size_m, size_m, (walls, 2))
        normal = np.column_stack([np.cos(alpha), np.sin(alpha)])
        along = np.column_stack([-normal[:, 1], normal[:, 0]])
        self.walls = np.column_stack([alpha, np.einsum("ki,ki->k", normal, middle)])
        self.ends = np.hstack([middle - along, middle + along])

    def account(
        self, robot: int, frame: Array, pose: Array, rng: np.random.Generator, *, sees: Array | None = None,
        sigma: float = 0.03,
    ) -> Account:  # fmt: skip
        """Return what a robot at a pose in the world has found, in its frame ``(3,)``, and ``sees`` by row."""
        rows = np.arange(len(self.points)) if sees is None else sees
        back = inverse(frame)
        points = transform_points(back, self.points[rows])
        walls, ends = walls_into(back, self.walls)[0], ends_into(back, self.ends)
        state = np.concatenate([compose(back, pose), points.ravel(), walls.ravel()])
        # Errors as of a filter: all together, by a turn and a shift, and each by itself.
        size, n = len(state), len(points)
        common, own = np.zeros((size, 3)), np.full(size, sigma)
        common[:3] = np.eye(3)
        common[3 : 3 + 2 * n : 2, 0] = common[4 : 4 + 2 * n : 2, 1] = 1.0
        common[3 : 3 + 2 * n : 2, 2], common[4 : 4 + 2 * n : 2, 2] = -points[:, 1], points[:, 0]
        common[3 + 2 * n :: 2, 2] = 1.0
        common[4 + 2 * n :: 2, :2] = np.column_stack([np.cos(walls[:, 0]), np.sin(walls[:, 0])])
        own[2], own[3 + 2 * n :: 2] = 0.2 * sigma, 0.2 * sigma
        factor = np.hstack([common * sigma * [0.7, 0.7, 0.14], np.diag(own)])
        state = state + factor @ rng.normal(size=factor.shape[1])
        return Account(
            robot=robot, stamp=1.0, pose=np.array([state[0], state[1], float(wrap(state[2]))]),
            points=state[3 : 3 + 2 * n].reshape(-1, 2), point_ids=np.arange(n), kinds=self.kinds[rows],
            directions=wrap(self.directions[rows] - frame[2]), times_seen=np.ones(n, np.int64),
            walls=state[3 + 2 * n :].reshape(-1, 2), wall_ends=ends, cov=factor @ factor.T,
        )  # fmt: skip
