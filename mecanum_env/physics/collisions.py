"""Contacts: the pymunk space with a plan's surfaces and the robot's body, and the events made of its reports."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pymunk

from mecanum_env.config import RobotConfig
from slam.types import Array

if TYPE_CHECKING:
    from mecanum_env.rooms.floor_plan import FloorPlan

__all__ = ["CONTACT_GAP_S", "Contacts", "Touch", "add_robots", "build_space"]

CONTACT_GAP_S = 0.5
"""A contact is a new one when the robot has touched nothing for this long [s]."""

_ROBOT = 1  # collision type
_FRICTION = 0.5  # of robot and of surfaces each; pymunk multiplies the two
_ELASTICITY = 0.2  # likewise
# pymunk lets shapes overlap by this much; its default of 0.1 is 10 cm here. The deeper the robot is in a wall, the
# oftener it catches on the wall's seams: at 2 mm on about one in ten, at 0.2 mm on one in fifty.
_SLOP_M = 0.0002
_OVERLAP_KEPT = 0.3  # share of a deeper overlap that is left after 20 ms
_SNAP_M = 2.0**-20  # about a micrometre; see build_space
_STEEPEST = 2.0  # tangent of the angle, 63°, from the wall's normal beyond which a contact at a seam is dropped


class Touch:
    """What pymunk reports of a body's contacts in a space.

    Apart from :class:`World`, so that the space's callbacks do not tie world and space into a cycle.
    """

    def __init__(self) -> None:
        self.now = False  # within the last physics step
        self.robot = False  # … another robot
        self._pairs = 0  # of shapes that touch now
        self._robots = 0

    def begin(self, robot: bool) -> None:
        """Note that the body begins to touch a shape, that of another robot or not."""
        self.now = True
        self._pairs += 1
        if robot:
            self.robot = True
            self._robots += 1

    def separate(self, robot: bool) -> None:
        """Note that the body no longer touches a shape."""
        self._pairs -= 1
        self._robots -= robot

    def close_step(self) -> None:
        """Go on to the next physics step."""
        self.now, self.robot = self._pairs > 0, self._robots > 0


class Contacts:
    """The events made of what is touched in one physics step after the other."""

    def __init__(self) -> None:
        self.count = 0
        self.with_robots = 0
        self.peak = 0.0
        self.total = 0.0
        self._clear_for_s = math.inf
        self._robot_touched = False  # in the event that lasts, or was the last

    def close_step(self, dt: float, impulse: float, touch: Touch) -> None:
        """Turn what was reported during a physics step of ``dt`` [s] into events.

        The impulse [N·s] is the net one: single shapes' push against each other where a wall has seams.
        """
        if touch.now:
            if self._clear_for_s >= CONTACT_GAP_S:
                self.count += 1
                self.peak = self.total = 0.0
                self._robot_touched = False
            if touch.robot and not self._robot_touched:
                self.with_robots += 1
                self._robot_touched = True
            self._clear_for_s = 0.0
            self.peak = max(self.peak, impulse)
            self.total += impulse
        else:
            self._clear_for_s += dt
        touch.close_step()

    def pass_clear(self, duration: float) -> None:
        """Let time [s] go by in which nothing was touched."""
        self._clear_for_s += duration


def build_space(plan: FloorPlan) -> pymunk.Space:
    """Return a space with every surface of the plan, always inserted in the plan's order."""
    space = pymunk.Space()
    space.collision_slop = _SLOP_M
    space.collision_bias = _OVERLAP_KEPT ** (1.0 / 0.02)
    static = space.static_body
    shapes: list[pymunk.Shape] = []
    # To drop a contact at a seam, pymunk compares the contact's point with the wall's end for equality, after an
    # interpolation that returns the end exactly only if its coordinates have few binary digits.
    walls = np.round(np.asarray(plan.walls, dtype=np.float64).reshape(-1, 4) / _SNAP_M) * _SNAP_M
    for (x1, y1, x2, y2), neighbours in zip(walls.tolist(), _wall_neighbours(plan, walls), strict=True):
        segment = pymunk.Segment(static, (x1, y1), (x2, y2), 0.0)
        if neighbours:
            segment.set_neighbors(*neighbours)
        shapes.append(segment)
    shapes.extend(pymunk.Poly(static, polygon.tolist()) for polygon in plan.polygons)
    shapes.extend(pymunk.Circle(static, r, (x, y)) for x, y, r in plan.circles.tolist())
    for shape in shapes:
        shape.friction, shape.elasticity = _FRICTION, _ELASTICITY
    space.add(*shapes)
    return space


def _wall_neighbours(
    plan: FloorPlan, walls: Array
) -> list[tuple[tuple[float, float], tuple[float, float]] | None]:
    """Return for each wall the points that tell pymunk where the surface goes on beyond its ends.

    Without them a robot that slides along a wall of several pieces catches on each seam. pymunk drops a contact
    at an end whose normal points to the neighbour's side. The neighbour's direction is tilted into the solid where
    need be, so that only normals nearly along the wall are dropped; so the free side must be known.
    """
    ends = walls.reshape(-1, 2, 2)
    along = ends[:, 1] - ends[:, 0]
    along /= np.maximum(np.hypot(along[:, 0], along[:, 1])[:, None], 1e-12)
    left = np.column_stack([-along[:, 1], along[:, 0]])
    middle, off = ends.mean(axis=1), 1.5 * plan.resolution
    side = 1.0 * plan.is_free(middle + off * left) - 1.0 * plan.is_free(middle - off * left)
    meeting: dict[tuple[int, int], list[tuple[int, int]]] = defaultdict(list)
    for i, end in np.ndindex(len(walls), 2):
        meeting[_point_key(ends[i, end])].append((i, end))
    result: list[tuple[tuple[float, float], tuple[float, float]] | None] = []
    for i in range(len(walls)):
        points = ends[i].copy()  # a neighbour at the end itself is none
        for end, outward in ((0, -along[i]), (1, along[i])):
            others = meeting[_point_key(ends[i, end])]
            directions = [along[j] if e == 0 else -along[j] for j, e in others if j != i]
            if directions:
                direction = max(directions, key=lambda d: float(d @ outward))
                normal = side[i] * left[i]
                points[end] += direction - max(float(direction @ normal) + _STEEPEST, 0.0) * normal
        known = side[i] != 0.0
        result.append(((points[0, 0], points[0, 1]), (points[1, 0], points[1, 1])) if known else None)
    return result


def _point_key(point: Array) -> tuple[int, int]:
    return round(point[0] * 1e4), round(point[1] * 1e4)


def add_robots(space: pymunk.Space, robots: Sequence[RobotConfig]) -> list[tuple[pymunk.Body, Touch]]:
    """Add each robot's body, a box with its centre of mass in the middle, at the origin; return them."""
    added: list[tuple[pymunk.Body, Touch]] = []
    touches: dict[pymunk.Shape, Touch] = {}
    for robot in robots:
        body = pymunk.Body(robot.mass_kg, robot.inertia_kg_m2)
        shape = pymunk.Poly.create_box(body, (robot.length_m, robot.width_m))
        shape.friction, shape.elasticity, shape.collision_type = _FRICTION, _ELASTICITY, _ROBOT
        space.add(body, shape)
        touches[shape] = Touch()
        added.append((body, touches[shape]))

    def parties(arbiter: pymunk.Arbiter) -> tuple[Touch, bool]:
        # Where two robots touch, pymunk calls twice, each robot's shape first once; a wall may come first.
        first, other = arbiter.shapes
        return touches[first if first in touches else other], first in touches and other in touches

    def begin(arbiter: pymunk.Arbiter, space: pymunk.Space, data: Any) -> None:
        touch, robot = parties(arbiter)
        touch.begin(robot)

    def separate(arbiter: pymunk.Arbiter, space: pymunk.Space, data: Any) -> None:
        touch, robot = parties(arbiter)
        touch.separate(robot)

    space.on_collision(_ROBOT, None, begin=begin, separate=separate)
    return added
