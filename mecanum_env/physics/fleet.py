"""Several robots in one plan: each alone where it can touch no other, in one pymunk space where two may touch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from mecanum_env.physics.collisions import add_robots, build_space
from mecanum_env.physics.world import World, divide
from mecanum_env.rooms.floor_plan import FloorPlanError
from slam.types import Array, Flags

__all__ = ["Fleet", "outlines"]


class Fleet:
    """The robots of one floor plan, stepped together.

    A robot that is too far from all others to touch one in a step is moved by its own :class:`World`, as though it
    were alone: so one robot's path is the same, bit for bit. Those that are nearer move in lockstep in a space
    that they share.

    Parameters
    ----------
    worlds : sequence of World
        One a robot, all of one plan; at least one.

    Raises
    ------
    FloorPlanError
        Where two robots overlap at their starts.
    """

    def __init__(self, worlds: Sequence[World]) -> None:
        self.worlds = tuple(worlds)
        robots = [world.robot for world in self.worlds]
        self._build_space()
        self._radii = np.array([robot.circumscribed_radius_m for robot in robots])
        self._halves = 0.5 * np.array([(robot.length_m, robot.width_m) for robot in robots])
        self._fastest = np.array([world.fastest_m_s for world in self.worlds])
        self._near = np.zeros(len(robots), np.bool_)  # of others, in the last step
        self._check_starts()

    def _build_space(self) -> None:
        self._space = build_space(self.worlds[0].plan)
        self._bodies = add_robots(self._space, [world.robot for world in self.worlds])

    def __getstate__(self) -> dict[str, Any]:
        """Return for a copy or a pickle all but what is pymunk's; see :class:`World`."""
        return {name: value for name, value in vars(self).items() if name not in ("_space", "_bodies")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make a copy whole."""
        vars(self).update(state)
        self._build_space()

    def _check_starts(self) -> None:
        for world, (body, _) in zip(self.worlds, self._bodies, strict=True):
            world.place(body)
            self._space.reindex_shapes_for_body(body)
        for k, (body, _) in enumerate(self._bodies):
            (shape,) = body.shapes
            if self._space.shape_query(shape):
                at = ", ".join(f"{v:.2f}" for v in self.worlds[k].pose)
                raise FloorPlanError(f"robot {k} touches something at its start ({at}); choose another")

    def near_others(self, duration_s: float) -> Flags:
        """Return which robots ``(n,)`` may touch another within a time [s]."""
        xy = np.array([world.pose[:2] for world in self.worlds])
        apart = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1))
        np.fill_diagonal(apart, np.inf)
        # Twice the way: one that is hit is thrown back.
        reach = self._radii + 2.0 * self._fastest * duration_s
        return np.asarray((apart < reach[:, None] + reach[None]).any(axis=1))

    def step(self, wheel_targets: Sequence[ArrayLike], step_s: float, physics_step_s: float) -> None:
        """Drive every robot for one control step; arguments as in :meth:`World.step`, targets one a robot."""
        near = self.near_others(step_s) if len(self.worlds) > 1 else np.zeros(1, np.bool_)
        before, self._near = self._near, near
        for world, targets, together in zip(self.worlds, wheel_targets, near.tolist(), strict=True):
            if not together:
                world.step(targets, step_s, physics_step_s)
        if near.any():
            self._step_together(np.flatnonzero(near).tolist(), before, wheel_targets, step_s, physics_step_s)

    def _step_together(
        self, near: list[int], before: Flags, wheel_targets: Sequence[ArrayLike], step_s: float,
        physics_step_s: float,
    ) -> None:  # fmt: skip
        """Step those that are near others; what they touched lasts of those that were so ``before``."""
        steps, dt, substeps = division = divide(step_s, physics_step_s)
        for world, (body, touch), lasts in zip(self.worlds, self._bodies, before.tolist(), strict=True):
            world.place(body)
            if not lasts:
                touch.now = touch.robot = False
        for k in near:
            self.worlds[k].begin(wheel_targets[k], division, clear=False)
        for step in range(steps):
            parts = max(self.worlds[k].push(self._bodies[k][0], dt, substeps) for k in near)
            for _ in range(parts):
                self._space.step(dt / parts)
            for k in near:
                self.worlds[k].settle(*self._bodies[k], dt, step)
        for k in near:
            self.worlds[k].leave_space()

    def outlines(self) -> Array:
        """Return the sides of every body ``(n, 4, 4)``: x1, y1, x2, y2 in the world frame [m]."""
        return outlines(np.array([world.pose for world in self.worlds]), self._halves)


@njit(cache=True, nogil=True)
def outlines(poses: Array, halves: Array) -> Array:
    """Return the sides of bodies at poses ``(n, 3)`` as segments ``(n, 4, 4)`` [m], counter-clockwise.

    ``halves`` ``(n, 2)`` [m] are half their lengths and widths.
    """
    out = np.empty((len(poses), 4, 4))
    for k in range(len(poses)):
        x, y, c, s = poses[k, 0], poses[k, 1], math.cos(poses[k, 2]), math.sin(poses[k, 2])
        for i, (along, across) in enumerate(((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))):
            ahead, aside = along * halves[k, 0], across * halves[k, 1]
            out[k, i, 0], out[k, i, 1] = x + c * ahead - s * aside, y + s * ahead + c * aside
        for i in range(4):
            out[k, i, 2], out[k, i, 3] = out[k, (i + 1) % 4, 0], out[k, (i + 1) % 4, 1]
    return out
