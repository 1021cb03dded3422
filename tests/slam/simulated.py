"""A small world without physics for testing estimators: landmarks, a rectangular room, noisy twists."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slam import Observations, Odometry, Scan
from slam.geometry import compose, exp, wrap

BEAMS = 360
ANGLE_MIN = -math.pi
INCREMENT = 2 * math.pi / BEAMS
ANGLES = ANGLE_MIN + INCREMENT * np.arange(BEAMS)


def room_scan(
    pose: NDArray[np.float64], rng: np.random.Generator | None = None, *, sigma: float = 0.01,
    width: float = 6.0, height: float = 5.0,
) -> Scan:  # fmt: skip
    """Scan the inside of the rectangle [0, width] × [0, height] from a sensor pose."""
    x, y, theta = pose
    c, s = np.cos(ANGLES + theta), np.sin(ANGLES + theta)
    c, s = (np.where(np.abs(v) < 1e-12, 1e-12, v) for v in (c, s))
    along_x = np.where(c > 0, (width - x) / c, -x / c)
    along_y = np.where(s > 0, (height - y) / s, -y / s)
    ranges = np.minimum(along_x, along_y)
    if rng is not None:
        ranges = ranges + sigma * rng.standard_normal(BEAMS)
    return Scan(ranges, angle_min=ANGLE_MIN, angle_increment=INCREMENT, range_max=20.0)


def observe_landmarks(
    pose: NDArray[np.float64], landmarks: NDArray[np.float64], offset: float, cov: NDArray[np.float64],
    rng: np.random.Generator, *, reach: float = math.inf,
) -> Observations:  # fmt: skip
    """Observe the landmarks within reach, with known ids and Gaussian noise."""
    sensor = compose(pose, np.array([offset, 0.0, 0.0]))
    d = landmarks - sensor[:2]
    rho = np.hypot(d[:, 0], d[:, 1])
    ids = np.flatnonzero(rho < reach)
    rb = np.column_stack([rho[ids], wrap(np.arctan2(d[ids, 1], d[ids, 0]) - sensor[2])])
    rb = rb + rng.multivariate_normal(np.zeros(2), cov, len(ids))
    return Observations(rb, np.repeat(cov[None], len(ids), 0), ids)


def circle_twist(k: int) -> NDArray[np.float64]:
    """Return a holonomic twist that keeps turning and strafing."""
    return np.array([0.4 * math.cos(k / 25), 0.3 * math.sin(k / 20), 0.5 * math.sin(k / 30)])


def drive(
    pose: NDArray[np.float64], twist: NDArray[np.float64], sigmas: tuple[float, float],
    rng: np.random.Generator, dt: float = 0.1,
) -> tuple[NDArray[np.float64], Odometry]:  # fmt: skip
    """Move truly by ``twist``; return the new pose and the noisy odometry of wheels that do not slip."""
    noise = rng.standard_normal(3) * np.array([sigmas[0], sigmas[0], sigmas[1]])
    return compose(pose, exp(twist * dt)), Odometry(twist + noise, dt, (0.0, 0.0))
