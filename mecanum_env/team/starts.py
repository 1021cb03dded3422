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
_DRAWS = 20  # of scattered places, of which the first may leave no room for the last


def start_poses(
    plan: FloorPlan, robot: RobotConfig, count: int, *, scattered: bool, rng: np.random.Generator
) -> Array:
    """Return the poses ``(count, 3)`` that robots start from in the plan's frame; the first is the plan's own.

    The others look the same way and stand as near to it as they fit, or are ``scattered`` over all places
    that can be reached from there, drawn from ``rng``; where draw after draw leaves no room for the last, near it.

    Raises
    ------
    FloorPlanError
        Where there is not room for so many.
    """
    start = np.array(plan.start, dtype=np.float64)
    if count == 1:
        return start[None]
    radius = robot.circumscribed_radius_m
    places = _reachable(plan, radius + _CLEAR_M)
    apart_m = 2.0 * radius + _APART_M
    for _ in range(_DRAWS if scattered else 0):
        chosen = _choose(places[rng.permutation(len(places))], start, count, apart_m, rng)
        if len(chosen) == count:
            return chosen
    away = np.hypot(*(places - start[:2]).T)
    chosen = _choose(places[np.argsort(away, kind="stable")], start, count, apart_m, rng if scattered else None)
    if len(chosen) < count:
        raise FloorPlanError(f"plan {plan.name} has room for {len(chosen)} robots, not for {count}")
    return chosen


def _choose(places: Array, start: Array, count: int, apart_m: float, rng: np.random.Generator | None) -> Array:
    """Return ``start`` ``(3,)`` and the first of the places ``(n, 2)`` that are apart, as poses ``(≤ count, 3)``.

    Headings are drawn from ``rng``; without it they are that of the start.
    """
    poses = [start]
    for place in places:
        if len(poses) == count:
            break
        if all(math.hypot(*(place - pose[:2])) >= apart_m for pose in poses):
            heading = start[2] if rng is None else rng.uniform(-math.pi, math.pi)
            poses.append(np.array([*place, heading]))
    return np.array(poses)


def _reachable(plan: FloorPlan, clearance_m: float) -> Array:
    """Return the middles ``(n, 2)`` of the cells with that clearance that hang together with the start's room."""
    cells = np.argwhere(plan.reachable(clearance_m, np.array(plan.start)))
    return np.asarray((cells[:, ::-1] + 0.5) * plan.resolution + np.array(plan.origin), np.float64)
