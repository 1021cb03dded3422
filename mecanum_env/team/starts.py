"""Where the robots of a team begin."""

from __future__ import annotations

import math

import numpy as np

from mecanum_env.config import RobotConfig
from mecanum_env.rooms.floor_plan import FloorPlan, FloorPlanError
from slam.types import Array

__all__ = ["start_poses"]

_APART_M = 0.4  # between two bodies at least, however they are turned
_CLEAR_M = 0.1  # between a body and whatever is in the plan


def start_poses(
    plan: FloorPlan, robot: RobotConfig, count: int, *, scattered: bool, rng: np.random.Generator
) -> Array:
    """Return the poses ``(count, 3)`` that robots start from in the plan's frame; the first is the plan's own.

    The others look the same way and stand as near to it as they fit, or are ``scattered`` over all places
    that can be reached from there, drawn from ``rng``.

    Raises
    ------
    FloorPlanError
        Where there is not room for so many.
    """
    poses = [np.array(plan.start, dtype=np.float64)]
    if count == 1:
        return np.array(poses)
    radius = robot.circumscribed_radius_m
    places = _reachable(plan, radius + _CLEAR_M)
    away = np.hypot(*(places - poses[0][:2]).T)
    order = rng.permutation(len(places)) if scattered else np.argsort(away, kind="stable")
    for place in places[order]:
        if len(poses) == count:
            break
        if all(math.hypot(*(place - pose[:2])) >= 2.0 * radius + _APART_M for pose in poses):
            heading = rng.uniform(-math.pi, math.pi) if scattered else poses[0][2]
            poses.append(np.array([*place, heading]))
    if len(poses) < count:
        raise FloorPlanError(f"plan {plan.name} has room for {len(poses)} robots, not for {count}")
    return np.array(poses)


def _reachable(plan: FloorPlan, clearance_m: float) -> Array:
    """Return the middles ``(n, 2)`` of the cells with that clearance that hang together with the start's room."""
    cells = np.argwhere(plan.reachable(clearance_m, np.array(plan.start)))
    return np.asarray((cells[:, ::-1] + 0.5) * plan.resolution + np.array(plan.origin), np.float64)
