"""A square room, worlds in it, and drives."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mecanum_env.config import ROBOT_PRESETS, NoiseConfig, RobotConfig
from mecanum_env.physics.robot import WheelTargets
from mecanum_env.physics.world import World
from mecanum_env.rooms.floor_plan import FloorPlan

Array = NDArray[np.float64]

ROBOT = ROBOT_PRESETS["youbot"]
EXACT = NoiseConfig(encoder=0, radius_error=0, base_error=0, range_sigma_m=0, dropout=0)
STEP = 0.1


def room(
    size: float = 6.0,
    start: tuple[float, float, float] = (3.0, 3.0, 0.0),
    *,
    pieces: int = 1,
    polygons: tuple[Array, ...] = (),
    circles: Array | None = None,
) -> FloorPlan:
    """Return a square room, each wall in so many pieces; the obstacles are cut out of its free cells."""
    edge = np.linspace(0.0, size, pieces + 1)
    a, b = edge[:-1], edge[1:]
    zero, far = np.zeros(pieces), np.full(pieces, size)
    walls = np.vstack(
        [
            np.column_stack([a, zero, b, zero]),
            np.column_stack([far, a, far, b]),
            np.column_stack([size - a, far, size - b, far]),
            np.column_stack([zero, size - a, zero, size - b]),
        ]
    )
    resolution = 0.05
    cells = round(size / resolution)
    x, y = np.meshgrid(*[(np.arange(cells) + 0.5) * resolution] * 2)
    free = np.ones((cells, cells), bool)
    circles = np.zeros((0, 3)) if circles is None else circles
    for cx, cy, radius in circles:
        free &= np.hypot(x - cx, y - cy) > radius
    for polygon in polygons:
        sides = np.roll(polygon, -1, axis=0) - polygon
        inside = [
            side[0] * (y - corner[1]) - side[1] * (x - corner[0]) > 0
            for corner, side in zip(polygon, sides, strict=True)
        ]
        free &= ~np.all(inside, axis=0)
    return FloorPlan(
        name="room", walls=walls, polygons=polygons, circles=circles, free=free, resolution=resolution, start=start
    )


def world(plan: FloorPlan, *, noise: NoiseConfig = EXACT, robot: RobotConfig = ROBOT, **kwargs: object) -> World:
    return World(plan, robot, noise, np.random.default_rng(7), **kwargs)  # type: ignore[arg-type]


def drive(w: World, action: tuple[float, float, float], seconds: float) -> None:
    wheels = WheelTargets(w.robot).of_twist(action)
    for _ in range(round(seconds / STEP)):
        w.step(wheels, STEP, 0.02)


def random_drive(w: World, steps: int, *, seed: int = 3, scale: float = 1.0, hold: int = 5) -> Array:
    rng = np.random.default_rng(seed)
    path = []
    for step in range(steps):
        if step % hold == 0:
            wheels = WheelTargets(w.robot).of_twist(scale * rng.uniform(-1, 1, 3))
        w.step(wheels, STEP, 0.02)
        path.append(np.concatenate([w.pose, w.twist, w.wheel_speeds, w.wheel_readings[-1]]))
    return np.array(path)
