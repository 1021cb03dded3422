"""The world: static walls and obstacles, the robot's body, the floor under its wheels, and collisions.

Wheels, motors and traction are integrated by :func:`mecanum_env.robot.wheel_dynamics`; contacts are pymunk's.
In each physics step the kernel advances the body's velocity, and pymunk moves the body at its mean velocity over
that step, so that where nothing is touched the path is the kernel's own. Where nothing *can* be touched, which a
conservative distance field tells, pymunk is left out altogether: the result is the same.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pymunk
from numba import njit
from numpy.typing import ArrayLike, NDArray

from mecanum_env.config import NoiseConfig, RobotConfig
from mecanum_env.robot import (
    INCREMENTS,
    POSE,
    STATE_SIZE,
    SUBSTEP_S,
    TWIST,
    WHEELS,
    dynamics_constants,
    wheel_dynamics,
    wheel_positions,
)
from mecanum_env.rooms.floor_plan import FloorPlanError
from slam.geometry import wrap_scalar

if TYPE_CHECKING:
    from mecanum_env.rooms.floor_plan import FloorPlan

__all__ = ["CONTACT_GAP_S", "Floor", "World", "build_floor"]

Array = NDArray[np.float64]

CONTACT_GAP_S = 0.5
"""A contact is a new one when the robot has touched nothing for this long [s]."""
MAX_TRAVEL_M = 0.005
"""Near a surface pymunk's steps are cut so that no point of the robot goes further in one: hence no deeper in."""

_ROBOT = 1  # collision type
_FRICTION = 0.5  # of robot and of surfaces each; pymunk multiplies the two
_ELASTICITY = 0.2  # likewise
_SLOP_M = 0.002  # pymunk lets shapes overlap by this much; its default of 0.1 is 10 cm here
_OVERLAP_KEPT = 0.3  # share of a deeper overlap that is left after 20 ms
_PATCH_RADIUS_M = (0.25, 0.8)


@dataclass(frozen=True, eq=False)
class Floor:
    """What a raster over the plan knows of the places a robot may come to."""

    friction: NDArray[np.float32]  # (rows, cols) μ
    clearance: NDArray[np.float32]  # (rows, cols) [m]: no surface is nearer to any point of the cell
    patches: Array  # (p, 4) slippery discs: x, y, radius [m], μ
    raster: Array  # (3,) world x, y of the lower-left corner, cells per metre


def build_floor(plan: FloorPlan, noise: NoiseConfig, rng: np.random.Generator) -> Floor:
    """Return the floor of a plan: its distance field, and slippery patches drawn until they cover their share.

    Parameters
    ----------
    plan
        The geometry; the raster is that of ``plan.free``, widened to hold every surface.
    noise
        ``friction``, ``patch_share``, ``patch_friction``.
    rng
        Four numbers are drawn a patch, none where the share is zero.
    """
    resolution = plan.resolution
    samples = _surface_samples(plan, 0.5 * resolution)
    origin = np.asarray(plan.origin, dtype=np.float64)
    rows, cols = plan.free.shape
    cells = np.floor((samples - origin) / resolution).astype(np.int64)  # (n, 2) column, row
    pad = 1
    if len(cells):
        pad += max(0, -int(cells.min()), int((cells - (cols - 1, rows - 1)).max()))
    empty = np.ones((rows + 2 * pad, cols + 2 * pad), np.uint8)
    empty[cells[:, 1] + pad, cells[:, 0] + pad] = 0
    if len(cells):
        distance = cv2.distanceTransform(empty, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    else:
        distance = np.full(empty.shape, 1e6, np.float32)
    # A surface point is within a quarter cell of a sample, a sample within half a diagonal of its cell's centre,
    # and so is the asking point: 0.25 + 2 · 0.7072 = 1.664 cells, and a bit for float32.
    clearance = np.maximum((distance - 1.68) * resolution, 0.0).astype(np.float32)
    raster = np.array([origin[0] - pad * resolution, origin[1] - pad * resolution, 1.0 / resolution])
    friction = np.full(empty.shape, noise.friction, np.float32)
    patches = _draw_patches(plan, noise, rng, friction[pad : pad + rows, pad : pad + cols])
    return Floor(friction, clearance, patches, raster)


def _surface_samples(plan: FloorPlan, spacing: float) -> Array:
    """Return points on every surface ``(n, 2)``, no further than ``spacing`` from the next."""
    parts = [np.zeros((0, 2))]
    for x1, y1, x2, y2 in plan.segments:
        count = max(2, math.ceil(math.hypot(x2 - x1, y2 - y1) / spacing) + 1)
        parts.append(np.column_stack([np.linspace(x1, x2, count), np.linspace(y1, y2, count)]))
    for x, y, radius in plan.circles:
        angles = np.linspace(0.0, 2.0 * math.pi, max(8, math.ceil(2.0 * math.pi * radius / spacing) + 1))
        parts.append(np.column_stack([x + radius * np.cos(angles), y + radius * np.sin(angles)]))
    return np.vstack(parts)


def _draw_patches(
    plan: FloorPlan, noise: NoiseConfig, rng: np.random.Generator, friction: NDArray[np.float32]
) -> Array:
    """Draw slippery discs into ``friction`` until they cover their share of the free cells; return them."""
    rows, cols = plan.free.shape
    x0, y0 = plan.origin
    wanted = noise.patch_share * np.count_nonzero(plan.free)
    covered = np.zeros_like(plan.free)
    patches: list[tuple[float, float, float, float]] = []
    done = 0
    while done < wanted and len(patches) < 100_000:
        u = rng.random(4)
        x, y = x0 + u[0] * cols * plan.resolution, y0 + u[1] * rows * plan.resolution
        radius = _PATCH_RADIUS_M[0] + u[2] * (_PATCH_RADIUS_M[1] - _PATCH_RADIUS_M[0])
        mu = noise.patch_friction[0] + u[3] * (noise.patch_friction[1] - noise.patch_friction[0])
        patches.append((x, y, radius, mu))
        j0, j1 = (int(np.clip((x - x0 + d) / plan.resolution, 0, cols)) for d in (-radius, radius))
        i0, i1 = (int(np.clip((y - y0 + d) / plan.resolution, 0, rows)) for d in (-radius, radius))
        cx = x0 + (np.arange(j0, j1) + 0.5) * plan.resolution - x
        cy = y0 + (np.arange(i0, i1) + 0.5) * plan.resolution - y
        disc = cx**2 + cy[:, None] ** 2 <= radius**2
        window = friction[i0:i1, j0:j1]
        window[disc] = np.minimum(window[disc], np.float32(mu))
        fresh = disc & plan.free[i0:i1, j0:j1] & ~covered[i0:i1, j0:j1]
        covered[i0:i1, j0:j1] |= disc
        done += int(np.count_nonzero(fresh))
    return np.array(patches).reshape(-1, 4)


@njit(cache=True, nogil=True)
def _wheel_step(
    state: Array,
    targets: Array,
    radii: Array,
    wheels_body: Array,
    friction: NDArray[np.float32],
    raster: Array,
    constants: Array,
    dt: float,
    substeps: int,
    motion: Array,
) -> None:
    """Run :func:`wheel_dynamics` over a physics step with the μ that the wheels stand on at its start."""
    mu = np.empty(4)
    c, s = math.cos(state[2]), math.sin(state[2])
    rows, cols = friction.shape
    for i in range(4):
        x = state[0] + c * wheels_body[i, 0] - s * wheels_body[i, 1]
        y = state[1] + s * wheels_body[i, 0] + c * wheels_body[i, 1]
        col = min(max(int((x - raster[0]) * raster[2]), 0), cols - 1)
        row = min(max(int((y - raster[1]) * raster[2]), 0), rows - 1)
        mu[i] = friction[row, col]
    wheel_dynamics(state, targets, radii, mu, constants, dt, substeps, motion)


@njit(cache=True, nogil=True)
def _drive_clear(
    state: Array,
    targets: Array,
    radii: Array,
    wheels_body: Array,
    friction: NDArray[np.float32],
    clearance: NDArray[np.float32],
    raster: Array,
    constants: Array,
    reach: float,
    dt: float,
    substeps: int,
    steps: int,
    motion: Array,
) -> int:
    """Run up to ``steps`` physics steps for as long as each ends with nothing within ``reach`` [m].

    pymunk looks for contacts once a step, after it has moved the body; so a step that ends clear is one in
    which it would have found none. Returns the number of steps taken; the one that did not end clear is undone.
    """
    rows, cols = clearance.shape
    before = np.empty(state.shape[0])
    for step in range(steps):
        before[:] = state
        _wheel_step(state, targets, radii, wheels_body, friction, raster, constants, dt, substeps, motion)
        # As pymunk does it: mean velocity first, then velocity times time.
        x = state[0] + motion[0] / dt * dt
        y = state[1] + motion[1] / dt * dt
        col = int(math.floor((x - raster[0]) * raster[2]))
        row = int(math.floor((y - raster[1]) * raster[2]))
        if not (0 <= row < rows and 0 <= col < cols) or clearance[row, col] <= reach:
            state[:] = before
            return step
        state[0], state[1], state[2] = x, y, state[2] + motion[2] / dt * dt
    return steps


class _Contacts:
    """What pymunk reports of contacts within one physics step, and the events made of it.

    Apart from :class:`World`, so that the space's callbacks do not tie world and space into a cycle.
    """

    def __init__(self) -> None:
        self.touched = False
        self.impulse = 0.0  # [N·s], all shapes together, in this physics step
        self.count = 0
        self.peak = 0.0
        self.total = 0.0
        self._clear_for_s = math.inf

    def post_solve(self, arbiter: pymunk.Arbiter, space: pymunk.Space, data: Any) -> None:
        """Note one touching pair of shapes; pymunk calls this for each, each step."""
        self.touched = True
        self.impulse += abs(arbiter.total_impulse)

    def close_step(self, dt: float) -> None:
        """Turn what was reported during a physics step of ``dt`` [s] into events."""
        if self.touched:
            if self._clear_for_s >= CONTACT_GAP_S:
                self.count += 1
                self.peak = self.total = 0.0
            self._clear_for_s = 0.0
            self.peak = max(self.peak, self.impulse)
            self.total += self.impulse
        else:
            self._clear_for_s += dt
        self.touched, self.impulse = False, 0.0

    def pass_clear(self, duration: float) -> None:
        """Let time [s] go by in which nothing was touched."""
        self._clear_for_s += duration


class World:
    """A robot in a floor plan, moved by its wheels, stopped by walls and obstacles.

    Parameters
    ----------
    plan
        Walls, polygons, circles, the raster of free space, and the start.
    robot, noise
        The nominal robot; of ``noise`` the slip, the floor's friction and its patches.
    rng
        Draws the patches now and four numbers per control step: the wheels' slip. The same generator state and
        the same actions give the same path to the last bit, in any process.
    true_radii, true_lever
        The robot's true wheel radii ``(4,)`` [m] and lever [m], where they differ from the nominal ones
        (:class:`mecanum_env.sensors.WheelEncoders` draws them).
    start
        Pose ``(3,)`` instead of the plan's own.
    shortcut
        Leave pymunk out where nothing can be touched. The path is the same without, only slower.

    Raises
    ------
    FloorPlanError
        Where the start is not in free space or the robot would touch something there.
    """

    def __init__(
        self,
        plan: FloorPlan,
        robot: RobotConfig,
        noise: NoiseConfig,
        rng: np.random.Generator,
        *,
        true_radii: ArrayLike | None = None,
        true_lever: float | None = None,
        start: ArrayLike | None = None,
        shortcut: bool = True,
    ) -> None:
        self.plan, self.robot, self.noise = plan, robot, noise
        self.floor = build_floor(plan, noise, rng)
        self._rng = rng
        self._shortcut = shortcut
        nominal = np.full(4, robot.wheel_radius_m)
        self._radii = nominal if true_radii is None else np.array(true_radii, dtype=np.float64)
        self._ground_radii = self._radii.copy()
        self._constants = dynamics_constants(robot, lever_m=true_lever)
        self._wheels_body = wheel_positions(robot)
        self._reach = robot.circumscribed_radius_m
        self._targets = np.zeros(4)
        self._motion = np.zeros(3)
        self._state = np.zeros(STATE_SIZE)
        self._state[POSE] = plan.start if start is None else start
        self._contacts = _Contacts()
        self._space = _build_space(plan, self._contacts)
        self._body = _add_robot(self._space, robot)
        self._body_is_behind = True
        self._check_start()

    def _check_start(self) -> None:
        x, y, theta = (float(v) for v in self._state[POSE])
        at = f"the start ({x:.2f}, {y:.2f}, {theta:.2f})"
        col = math.floor((x - self.plan.origin[0]) / self.plan.resolution)
        row = math.floor((y - self.plan.origin[1]) / self.plan.resolution)
        rows, cols = self.plan.free.shape
        if not (0 <= row < rows and 0 <= col < cols and self.plan.free[row, col]):
            raise FloorPlanError(f"{at} is not in the free space of {self.plan.name!r}; choose another")
        self._place_body()
        (shape,) = self._body.shapes
        shape.cache_bb()
        if self._space.shape_query(shape):
            raise FloorPlanError(f"{at} in {self.plan.name!r} has the robot touch something; choose another")

    def step(self, wheel_targets: ArrayLike, step_s: float, physics_step_s: float) -> None:
        """Drive for one control step.

        Parameters
        ----------
        wheel_targets
            Commanded wheel speeds ``(4,)`` [rad/s], held.
        step_s, physics_step_s
            Length of the control step and of the physics steps it consists of [s].
        """
        steps = max(1, round(step_s / physics_step_s))
        dt = step_s / steps
        substeps = max(1, math.ceil(dt / SUBSTEP_S - 1e-9))
        self._targets[:] = wheel_targets
        self._state[INCREMENTS] = 0.0
        lost = self._rng.random(4)  # drawn even where slip is zero: the stream must not depend on it
        np.multiply(self._radii, 1.0 - (2.0 * self.noise.slip) * lost, out=self._ground_radii)
        done = self._drive_clear(dt, substeps, steps) if self._shortcut else 0
        if done:
            self._body_is_behind = True
            self._contacts.pass_clear(done * dt)
        # Once near a surface, stay with pymunk to the end of the control step.
        for _ in range(steps - done):
            self._drive_near(dt, substeps)

    def _drive_clear(self, dt: float, substeps: int, steps: int) -> int:
        floor = self.floor
        return int(
            _drive_clear(
                self._state,
                self._targets,
                self._ground_radii,
                self._wheels_body,
                floor.friction,
                floor.clearance,
                floor.raster,
                self._constants,
                self._reach,
                dt,
                substeps,
                steps,
                self._motion,
            )
        )

    def _drive_near(self, dt: float, substeps: int) -> None:
        """Take one physics step through pymunk."""
        if self._body_is_behind:
            self._place_body()
        state, motion, body, contacts = self._state, self._motion, self._body, self._contacts
        _wheel_step(
            state,
            self._targets,
            self._ground_radii,
            self._wheels_body,
            self.floor.friction,
            self.floor.raster,
            self._constants,
            dt,
            substeps,
            motion,
        )
        dx, dy, turn = motion.tolist()
        body.velocity = dx / dt, dy / dt
        body.angular_velocity = turn / dt
        parts = max(1, math.ceil((math.hypot(dx, dy) + abs(turn) * self._reach) / MAX_TRAVEL_M))
        for _ in range(parts):
            self._space.step(dt / parts)
        x, y = body.position
        angle = body.angle
        state[0], state[1], state[2] = x, y, angle
        if contacts.touched:
            # The contact has the last word on the velocity; elsewhere it is the kernel's, at the step's end.
            vx, vy = body.velocity
            c, s = math.cos(angle), math.sin(angle)
            state[3], state[4], state[5] = c * vx + s * vy, c * vy - s * vx, body.angular_velocity
        contacts.close_step(dt)

    def _place_body(self) -> None:
        x, y, theta = self._state[POSE].tolist()
        self._body.position = x, y
        self._body.angle = theta
        self._body_is_behind = False

    @property
    def pose(self) -> Array:
        """The robot's true pose ``(3,)`` in the world frame: x [m], y [m], θ [rad] in [-π, π)."""
        x, y, theta = self._state[POSE].tolist()
        return np.array([x, y, wrap_scalar(theta)])

    @property
    def twist(self) -> Array:
        """The true body twist ``(3,)``: vx, vy [m/s], ω [rad/s]."""
        return self._state[TWIST].copy()

    @property
    def wheel_speeds(self) -> Array:
        """The wheels' speeds ``(4,)`` [rad/s]."""
        return self._state[WHEELS].copy()

    @property
    def wheel_increments(self) -> Array:
        """How far each wheel turned in the last control step ``(4,)`` [rad], with whatever slipped."""
        return self._state[INCREMENTS].copy()

    @property
    def collisions(self) -> int:
        """Contacts so far: touching again within :data:`CONTACT_GAP_S`, or several things at once, is one."""
        return self._contacts.count

    @property
    def last_impulse(self) -> float:
        """The hardest blow of the last contact [N·s]: the largest impulse of one physics step in it."""
        return self._contacts.peak

    @property
    def last_impulse_total(self) -> float:
        """All of the last contact's impulse so far [N·s], with the pressing and rubbing after the blow."""
        return self._contacts.total


def _build_space(plan: FloorPlan, contacts: _Contacts) -> pymunk.Space:
    """Return a space with every surface of the plan, always inserted in the plan's order."""
    space = pymunk.Space()
    space.collision_slop = _SLOP_M
    space.collision_bias = _OVERLAP_KEPT ** (1.0 / 0.02)
    static = space.static_body
    shapes: list[pymunk.Shape] = []
    for x1, y1, x2, y2 in plan.walls.tolist():
        shapes.append(pymunk.Segment(static, (x1, y1), (x2, y2), 0.0))
    shapes.extend(pymunk.Poly(static, polygon.tolist()) for polygon in plan.polygons)
    shapes.extend(pymunk.Circle(static, r, (x, y)) for x, y, r in plan.circles.tolist())
    for shape in shapes:
        shape.friction, shape.elasticity = _FRICTION, _ELASTICITY
    space.add(*shapes)
    space.on_collision(_ROBOT, None, post_solve=contacts.post_solve)
    return space


def _add_robot(space: pymunk.Space, robot: RobotConfig) -> pymunk.Body:
    body = pymunk.Body(robot.mass_kg, robot.inertia_kg_m2)
    shape = pymunk.Poly.create_box(body, (robot.length_m, robot.width_m))
    shape.friction, shape.elasticity, shape.collision_type = _FRICTION, _ELASTICITY, _ROBOT
    space.add(body, shape)
    return body
