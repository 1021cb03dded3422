"""Hand-made beliefs and a kinematic robot for the agents' tests."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agents.driving.safety import footprint
from mecanum_env.config import RobotConfig
from slam import geometry
from slam.belief import Belief
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slam.types import Scan

RESOLUTION = 0.05
_BEAMS = 180


def belief_of(
    classes: NDArray[np.int8],
    pose: tuple[float, float, float],
    *,
    resolution: float = RESOLUTION,
    origin: tuple[float, float] = (0.0, 0.0),
    sigma: float = 0.01,
) -> Belief:
    grid = OccupancyGrid.from_classes(classes, resolution, origin)
    return Belief(
        pose=np.array(pose, dtype=np.float64),
        pose_cov=np.diag([sigma**2, sigma**2, 1e-4]),
        landmarks=np.zeros((0, 2)),
        landmark_cov=np.zeros((0, 2, 2)),
        landmark_ids=np.zeros(0, np.int64),
        grid=grid,
    )


def room(width_m: float, height_m: float) -> NDArray[np.int8]:
    """A known, closed, empty room: free cells within a wall of one cell, its corner at the origin."""
    classes = np.full((round(height_m / RESOLUTION), round(width_m / RESOLUTION)), FREE, np.int8)
    classes[[0, -1], :] = OCCUPIED
    classes[:, [0, -1]] = OCCUPIED
    return classes


def fill(classes: NDArray[np.int8], x0: float, y0: float, x1: float, y1: float, value: int = OCCUPIED) -> None:
    """Set the rectangle [x0, x1) × [y0, y1) [m]."""
    c = [round(v / RESOLUTION) for v in (x0, y0, x1, y1)]
    classes[c[1] : c[3], c[0] : c[2]] = value


def half_known(width_m: float = 8.0, height_m: float = 4.0, known_m: float = 4.0) -> NDArray[np.int8]:
    """A room known up to x = ``known_m``: one straight frontier across it."""
    classes = room(width_m, height_m)
    fill(classes, known_m, 0.0, width_m, height_m, UNKNOWN)
    return classes


def two_rooms(door_m: float) -> NDArray[np.int8]:
    """Two rooms with a wall 0.2 m thick between them and a door in it; unknown beyond x = 7 m."""
    classes = room(8.0, 4.0)
    fill(classes, 3.9, 0.0, 4.1, 4.0)
    fill(classes, 3.9, 2.0 - door_m / 2, 4.1, 2.0 + door_m / 2, FREE)
    fill(classes, 7.0, 0.0, 8.0, 4.0, UNKNOWN)
    return classes


def body_gap(classes: NDArray[np.int8], pose: NDArray[np.float64], robot: RobotConfig) -> float:
    """Smallest distance [m] from the body's rim to an occupied square: exact, by brute force."""
    occupied = np.argwhere(classes == OCCUPIED)
    low = occupied[:, ::-1] * RESOLUTION
    points = geometry.transform_points(pose, footprint(robot, 0.02))
    low = low[np.all(np.abs(low - pose[:2]) < 1.5, axis=1)]
    if not len(low):
        return 1.0
    out = np.maximum(np.maximum(low[None] - points[:, None], points[:, None] - low[None] - RESOLUTION), 0.0)
    return float(np.hypot(out[..., 0], out[..., 1]).min())


def drive(pose: NDArray[np.float64], action: NDArray[np.float32], robot: RobotConfig, dt: float = 0.1):
    """Move a robot that does at once what it is told."""
    limits = np.array([robot.max_speed_m_s, robot.max_speed_m_s, robot.max_turn_rate_rad_s])
    return geometry.compose(pose, geometry.exp(action.astype(np.float64) * limits * dt))


def scan_of(rng: np.random.Generator, reach_m: float = 3.0) -> Scan:
    """A scan of walls that come and go."""
    angles = np.linspace(0.0, 2.0 * np.pi, _BEAMS, endpoint=False)
    waves = rng.uniform(0.0, 1.0, 4) @ np.cos(np.outer(np.arange(1, 5), angles) + rng.uniform(0, 6, (4, 1)))
    ranges = np.clip(reach_m * (0.6 + 0.2 * waves), 0.2, None)
    ranges[rng.random(_BEAMS) < 0.05] = math.inf
    return Scan(ranges, 0.0, 2.0 * np.pi / _BEAMS, reach_m + 1.0, 0.02)


class Walk:
    """A belief whose robot walks about and draws what it sees, off the grid again and again."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.pose = np.zeros(3)
        self.grid = OccupancyGrid()
        self.kept: list[tuple[np.ndarray, Scan]] = []

    def go(self, steps: int) -> Belief:
        for _ in range(steps):
            self.pose += self.rng.normal(0.0, [0.5, 0.5, 1.0])
            scan = scan_of(self.rng)
            self.kept.append((self.pose.copy(), scan))
            self.grid.integrate(self.pose, scan, body=(self.pose[0], self.pose[1], 0.25))
        return self.belief()

    def redraw(self) -> Belief:
        """The whole map, from poses that are a little different."""
        poses = np.array([pose for pose, _ in self.kept]) + self.rng.normal(0.0, 0.03, (len(self.kept), 3))
        self.grid.redraw(poses, [(scan, np.zeros(0, np.int16)) for _, scan in self.kept])
        return self.belief()

    def belief(self) -> Belief:
        known = belief_of(room(1.0, 1.0), tuple(self.pose), sigma=float(self.rng.choice([0.01, 0.03, 0.1])))
        return replace(known, grid=self.grid)
