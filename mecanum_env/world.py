"""The world: static walls and obstacles, the robot's body, the floor under its wheels, and collisions.

Wheels, motors and traction are integrated by :func:`mecanum_env.robot.wheel_dynamics`; contacts are pymunk's.
In each physics step the kernel advances the body's velocity, and pymunk moves the body at its mean velocity over
that step, so that where nothing is touched the path is the kernel's own. For as long as nothing *can* be touched,
which a distance field and then the exact geometry tell, pymunk is left out: the result is the same.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from mecanum_env.collisions import CONTACT_GAP_S, Contacts, add_robot, build_space
from mecanum_env.config import NoiseConfig, RobotConfig
from mecanum_env.floor import build_floor
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

__all__ = ["CONTACT_GAP_S", "MAX_TRAVEL_M", "World"]

Array = NDArray[np.float64]

MAX_TRAVEL_M = 0.005
"""pymunk's steps are cut so that the robot, at its limits, goes no further in one: hence no deeper into a wall."""

_MARGIN_M = 1e-3  # nothing within it: no contact, whatever the rounding
_PERSISTENCE = 4  # steps after which pymunk has forgotten a contact (its collision_persistence is 3)


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
def _box_is_clear(
    x: float, y: float, theta: float, half_x: float, half_y: float, segments: Array, circles: Array
) -> bool:
    """Tell whether no surface comes into a rectangle [m] about a pose (separating axes; exact)."""
    c, s = math.cos(theta), math.sin(theta)
    reach = half_x + half_y
    for i in range(segments.shape[0]):
        ax, ay, bx, by = segments[i, 0] - x, segments[i, 1] - y, segments[i, 2] - x, segments[i, 3] - y
        if min(ax, bx) > reach or max(ax, bx) < -reach or min(ay, by) > reach or max(ay, by) < -reach:
            continue
        ax, ay = c * ax + s * ay, c * ay - s * ax
        bx, by = c * bx + s * by, c * by - s * bx
        if min(ax, bx) > half_x or max(ax, bx) < -half_x or min(ay, by) > half_y or max(ay, by) < -half_y:
            continue
        ex, ey = bx - ax, by - ay
        if abs(ax * ey - ay * ex) <= half_x * abs(ey) + half_y * abs(ex):
            return False
    for i in range(circles.shape[0]):
        dx, dy = circles[i, 0] - x, circles[i, 1] - y
        outside_x = max(abs(c * dx + s * dy) - half_x, 0.0)
        outside_y = max(abs(c * dy - s * dx) - half_y, 0.0)
        if outside_x * outside_x + outside_y * outside_y <= circles[i, 2] * circles[i, 2]:
            return False
    return True


@njit(cache=True, nogil=True)
def _drive_clear(
    state: Array,
    targets: Array,
    radii: Array,
    lost: Array,
    slip: float,
    ground_radii: Array,
    wheels_body: Array,
    friction: NDArray[np.float32],
    clearance: NDArray[np.float32],
    raster: Array,
    segments: Array,
    circles: Array,
    constants: Array,
    half_size: Array,
    dt: float,
    substeps: int,
    steps: int,
    motion: Array,
) -> int:
    """Run up to ``steps`` physics steps for as long as nothing can be touched in them.

    pymunk looks for contacts each time it has moved the body. Where nothing is within a step's travel of the
    body at the step's end, it would have found none. Returns the number of steps taken; the one in which
    something may be touched is undone. ``ground_radii`` is filled for whoever goes on: ``radii``, each less
    what is lost to slip.
    """
    state[INCREMENTS] = 0.0
    for i in range(4):
        ground_radii[i] = radii[i] * (1.0 - 2.0 * slip * lost[i])
    rows, cols = clearance.shape
    before = np.empty(state.shape[0])
    half_x, half_y = half_size[0], half_size[1]
    circumscribed = math.sqrt(half_x * half_x + half_y * half_y)
    for step in range(steps):
        before[:] = state
        _wheel_step(state, targets, ground_radii, wheels_body, friction, raster, constants, dt, substeps, motion)
        # As pymunk does it: mean velocity first, then velocity times time.
        x, y = state[0] + motion[0] / dt * dt, state[1] + motion[1] / dt * dt
        theta = state[2] + motion[2] / dt * dt
        travel = math.sqrt(motion[0] ** 2 + motion[1] ** 2) + abs(motion[2]) * circumscribed + _MARGIN_M
        col = math.floor((x - raster[0]) * raster[2])
        row = math.floor((y - raster[1]) * raster[2])
        far = 0 <= row < rows and 0 <= col < cols and clearance[row, col] > circumscribed + travel
        if not far and not _box_is_clear(x, y, theta, half_x + travel, half_y + travel, segments, circles):
            state[:] = before
            return step
        state[0], state[1], state[2] = x, y, theta
    return steps


@lru_cache(maxsize=16)
def _divide(step_s: float, physics_step_s: float) -> tuple[int, float, int]:
    """Return how many physics steps a control step has, their length [s], and the substeps of each."""
    steps = max(1, round(step_s / physics_step_s))
    dt = step_s / steps
    return steps, dt, max(1, math.ceil(dt / SUBSTEP_S - 1e-9))


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
        Leave pymunk out while nothing can be touched. The path is the same without, only slower.

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
        self._half_size = np.array([0.5 * robot.length_m, 0.5 * robot.width_m])
        self._fastest = max(
            robot.max_speed_m_s, robot.max_turn_rate_rad_s * robot.circumscribed_radius_m
        )  # [m/s] of any point of the body
        self._segments = np.ascontiguousarray(plan.segments, dtype=np.float64).reshape(-1, 4)
        self._circles = np.ascontiguousarray(plan.circles, dtype=np.float64).reshape(-1, 3)
        self._targets = np.zeros(4)
        self._motion = np.zeros(3)
        self._state = np.zeros(STATE_SIZE)
        self._state[POSE] = plan.start if start is None else start
        self._contacts = Contacts()
        self._space = build_space(plan, self._contacts)
        self._body = add_robot(self._space, robot)
        self._body_is_behind = True
        self._forgotten = _PERSISTENCE  # pymunk's steps since it last found a contact
        self._check_start()

    def _check_start(self) -> None:
        x, y, theta = (float(v) for v in self._state[POSE])
        at = f"the start ({x:.2f}, {y:.2f}, {theta:.2f})"
        if not self.plan.is_free(np.array([[x, y]]))[0]:
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
        steps, dt, substeps = _divide(step_s, physics_step_s)
        self._targets[:] = wheel_targets
        lost = self._rng.random(4)  # drawn even where slip is zero: the stream must not depend on it
        clear = self._shortcut and self._forgotten >= _PERSISTENCE
        done = self._drive_clear(lost, dt, substeps, steps if clear else 0)
        if done:
            self._body_is_behind = True
            self._contacts.pass_clear(done * dt)
        for _ in range(steps - done):
            self._drive_near(dt, substeps)

    def _drive_clear(self, lost: Array, dt: float, substeps: int, steps: int) -> int:
        floor = self.floor
        return int(
            _drive_clear(
                self._state,
                self._targets,
                self._radii,
                lost,
                self.noise.slip,
                self._ground_radii,
                self._wheels_body,
                floor.friction,
                floor.clearance,
                floor.raster,
                self._segments,
                self._circles,
                self._constants,
                self._half_size,
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
        # Always the same number of parts: pymunk scales the impulses it starts from with the ratio of one step's
        # length to the last one's, and a wall struck in a short step throws the robot back in a long one.
        parts = max(1, math.ceil(self._fastest * dt / MAX_TRAVEL_M))
        dx, dy, turn = motion.tolist()
        body.velocity = dx / dt, dy / dt
        body.angular_velocity = turn / dt
        for _ in range(parts):
            self._space.step(dt / parts)
        x, y = body.position
        angle = body.angle
        state[0], state[1], state[2] = x, y, angle
        self._forgotten += parts
        impulse = 0.0
        if contacts.touched:
            self._forgotten = 0
            # The contact has the last word on the velocity; elsewhere it is the kernel's, at the step's end.
            vx, vy = body.velocity
            c, s = math.cos(angle), math.sin(angle)
            ahead, aside = c * vx + s * vy, c * vy - s * vx
            impulse = self.robot.mass_kg * math.hypot(ahead - state[3], aside - state[4])
            state[3], state[4], state[5] = ahead, aside, body.angular_velocity
        contacts.close_step(dt, impulse)

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
