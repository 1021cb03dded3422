"""Worlds of landmarks without physics, in which every assumption of a filter but linearity holds exactly.

A robot drives round and round; its odometry is the true twist plus white noise of the covariance that the filter
is told, and it sees the landmarks within reach, with known ids, in range and bearing with noise of the covariance
that comes with them. Whatever inconsistency a filter shows here is its own (``docs/studies/consistency.md``).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import slam
from slam.backend import Backend
from slam.geometry import wrap
from slam.motion import move, twist_between
from slam.types import Array, Observations, Odometry

__all__ = ["WORLDS", "LandmarkWorld", "Step", "drive", "not_observing", "observed", "simulate"]


@dataclass(frozen=True, kw_only=True, eq=False)
class LandmarkWorld:
    """Landmarks, the ellipse that a robot drives among them, and what its sensors make of it."""

    name: str
    landmarks: Array  # (n, 2) [m]
    centre_m: tuple[float, float]  # of the ellipse, driven counter-clockwise from its lowest point
    semi_axes_m: tuple[float, float]
    steps: int
    dt: float  # [s]
    speed_m_s: float
    speed_sigma_m_s: float  # of odometry's vx and vy
    turn_sigma_rad_s: float  # of odometry's ω
    range_sigma_m: float
    bearing_sigma_rad: float
    reach_m: float  # landmarks within it are seen, all around
    start_sigma_m: float = 1e-4  # of the start pose, which is drawn from it
    start_sigma_rad: float = 1e-4

    def scaled(self, noise: float) -> LandmarkWorld:
        """Return the same world with every σ of odometry and observations times ``noise``."""
        names = ("speed_sigma_m_s", "turn_sigma_rad_s", "range_sigma_m", "bearing_sigma_rad")
        return dataclasses.replace(self, **{name: noise * getattr(self, name) for name in names})

    @property
    def start_cov(self) -> Array:
        """Covariance ``(3, 3)`` of the start pose."""
        return np.diag([self.start_sigma_m**2, self.start_sigma_m**2, self.start_sigma_rad**2])

    @property
    def observation_cov(self) -> Array:
        """Covariance ``(2, 2)`` of an observation: range [m²], bearing [rad²]."""
        return np.diag([self.range_sigma_m**2, self.bearing_sigma_rad**2])

    def backend_settings(self) -> dict[str, Any]:
        """Return what a backend is told: V is all floor and no share, so it is the same at every speed."""
        return {
            "lidar_offset_m": 0.0,
            "odometry": {
                "speed_floor_m_s": self.speed_sigma_m_s,
                "speed_share": 0.0,
                "turn_floor_rad_s": self.turn_sigma_rad_s,
                "turn_share_rad_m": 0.0,
                "slip_share": 0.0,
            },
        }

    def settings(self) -> dict[str, Any]:
        """Return everything that defines the world, as JSON has it."""
        return dataclasses.asdict(self) | {"landmarks": np.round(self.landmarks, 9).tolist()}

    def path(self, steps: int) -> Array:
        """Return the poses ``(steps + 1, 3)`` at constant speed along the ellipse, heading along it."""
        (cx, cy), (a, b) = self.centre_m, self.semi_axes_m
        phase = np.linspace(0.0, 2.0 * math.pi, 4001)
        pace = np.hypot(a * np.cos(phase), b * np.sin(phase))  # [m/rad]
        length = np.concatenate([[0.0], np.cumsum(0.5 * (pace[1:] + pace[:-1]) * np.diff(phase))])
        way = self.speed_m_s * self.dt * np.arange(steps + 1)
        at = np.interp(way % length[-1], length, phase)
        heading = wrap(np.arctan2(b * np.sin(at), a * np.cos(at)))
        return np.column_stack([cx + a * np.sin(at), cy - b * np.cos(at), heading])


class Step(NamedTuple):
    """What happens in one step."""

    odometry: Odometry
    observations: Observations  # none in some steps
    true_pose: Array  # (3,) after it


def simulate(world: LandmarkWorld, seed: int, steps: int) -> Iterator[Step]:
    """Drive; the noise depends on the seed alone.

    The true motion is :func:`slam.motion.move` along the path, so that the filter's motion model is exact.
    """
    rng = np.random.default_rng(seed)
    path = world.path(steps)
    pose = path[0] + np.sqrt(np.diag(world.start_cov)) * rng.standard_normal(3)
    sigmas = np.array([world.speed_sigma_m_s, world.speed_sigma_m_s, world.turn_sigma_rad_s])
    dt = world.dt
    for k in range(steps):
        twist = twist_between(path[k], path[k + 1], dt)
        pose = move(pose, twist, dt)
        odometry = Odometry(twist + sigmas * rng.standard_normal(3), dt)
        away = world.landmarks - pose[:2]
        ids = np.flatnonzero(np.hypot(away[:, 0], away[:, 1]) < world.reach_m)
        yield Step(odometry, observed(world.landmarks, ids, pose, world.observation_cov, rng), pose)


def observed(
    landmarks: Array, ids: NDArray[np.int64], pose: Array, cov: Array, rng: np.random.Generator
) -> Observations:
    """Return what is seen of some landmarks ``(n, 2)`` from a pose, with noise of a covariance ``(2, 2)``."""
    dx, dy = (landmarks[ids] - pose[:2]).T
    seen = np.column_stack([np.hypot(dx, dy), np.arctan2(dy, dx) - pose[2]])
    seen += np.sqrt(np.diag(cov)) * rng.standard_normal(seen.shape)
    seen[:, 1] = wrap(seen[:, 1])
    return Observations(seen, np.repeat(cov[None], len(ids), axis=0), ids)


def drive(world: LandmarkWorld, backend: Backend, seed: int, steps: int) -> Iterator[Step]:
    """Let a backend made with the world's settings take part in :func:`simulate`; yield after each step."""
    backend.reset(world.path(0)[0], pose_cov=world.start_cov, seed=seed)
    for step in simulate(world, seed, steps):
        backend.predict(step.odometry)
        if len(step.observations.range_bearing):
            backend.observe(step.observations)
        yield step


def _ring(count: int, centre: tuple[float, float], radii: tuple[float, float]) -> Array:
    """Return points around a centre, in turn on the one and on the other radius."""
    angles = 2.0 * math.pi * np.arange(count) / count
    radius = np.where(np.arange(count) % 2 == 0, *radii)
    return np.column_stack([centre[0] + radius * np.cos(angles), centre[1] + radius * np.sin(angles)])


def _along_walls(width: float, height: float, spacing: float) -> Array:
    """Return points all along the walls of the room [0, width] × [0, height], its corners among them."""
    xs, ys = np.arange(0.0, width + 1e-9, spacing), np.arange(spacing, height - 1e-9, spacing)
    sides = [(x, y) for y in (0.0, height) for x in xs] + [(x, y) for x in (0.0, width) for y in ys]
    return np.array(sides)


# The classical setting (Huang, Mourikis, Roumeliotis 2010): 0.25 m/s, odometry 10 % of it, many loops. The heading
# comes to be uncertain by 2.6°, which is what it takes for the standard filter to show its inconsistency.
_CIRCLE = LandmarkWorld(
    name="circle",
    landmarks=_ring(20, (0.0, 6.0), (4.5, 7.5)),
    centre_m=(0.0, 6.0),
    semi_axes_m=(6.0, 6.0),
    steps=2500,
    dt=1.0,
    speed_m_s=0.25,
    speed_sigma_m_s=0.025,
    turn_sigma_rad_s=0.025,
    range_sigma_m=0.05,
    bearing_sigma_rad=math.radians(1.0),
    reach_m=3.0,
)
# A room whose features are 1 m apart, seen from 2 m at most, with three times an ordinary robot's noise:
# 1 cm/s, 0.03 rad/s, 2 cm, 1°.
_ROOM = LandmarkWorld(
    name="room",
    landmarks=_along_walls(8.0, 6.0, 1.0),
    centre_m=(4.0, 3.0),
    semi_axes_m=(3.5, 2.5),
    steps=1500,
    dt=0.2,
    speed_m_s=0.3,
    speed_sigma_m_s=3 * 0.01,
    turn_sigma_rad_s=3 * 0.03,
    range_sigma_m=3 * 0.02,
    bearing_sigma_rad=3 * math.radians(1.0),
    reach_m=2.0,
)

WORLDS: dict[str, LandmarkWorld] = {world.name: world for world in (_CIRCLE, _ROOM)}
"""Fixed: their figures are compared from one version to the next."""


def not_observing() -> dict[str, str]:
    """Return the backends that take scans only, of which there are none here: name → why it cannot be used."""
    return {
        name: "takes no landmark observations" for name in slam.names() if not slam.make(name).observes_landmarks
    }
