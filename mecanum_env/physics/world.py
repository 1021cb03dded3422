"""The world: static walls and obstacles, the robot's body, the floor under its wheels, and collisions.

Wheels, motors and traction are integrated by :func:`mecanum_env.physics.robot.turn_wheels`; contacts are
pymunk's. In each physics step the kernel advances the body's velocity, and pymunk moves the body at its mean
velocity over that step, so that where nothing is touched the path is the kernel's own. For as long as nothing
*can* be touched, which a distance field and then the exact geometry tell, pymunk is left out: the result is the
same.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import pymunk
from numba import njit
from numpy.typing import ArrayLike, NDArray

from mecanum_env.config import NoiseConfig, RobotConfig
from mecanum_env.physics.collisions import CONTACT_GAP_S, Contacts, Touch, add_robots, build_space
from mecanum_env.physics.floor import Floor, build_floor
from mecanum_env.physics.robot import (
    INCREMENTS,
    POSE,
    STATE_SIZE,
    SUBSTEP_S,
    TWIST,
    WHEELS,
    dynamics_constants,
    motor_constants,
    turn_wheels,
    wheel_positions,
)
from mecanum_env.rooms.floor_plan import FloorPlanError
from slam.geometry import wrap_scalar

if TYPE_CHECKING:
    from mecanum_env.rooms.floor_plan import FloorPlan

__all__ = ["CONTACT_GAP_S", "MAX_TRAVEL_M", "World", "divide"]

Array = NDArray[np.float64]

MAX_TRAVEL_M = 0.005
"""pymunk's steps are cut so that the robot, at its limits, goes no further in one: hence no deeper into a wall."""

_MARGIN_M = 1e-3  # nothing within it: no contact, whatever the rounding
_AHEAD = 64  # control steps whose slip is drawn at once: a draw of four numbers takes 1.5 µs, of 256 two
_PERSISTENCE = 4  # steps after which pymunk has forgotten a contact (its collision_persistence is 3)


# What the kernels carry beside the state, in one array: each argument of a call takes 80 ns to unpack.
_STATE = slice(0, STATE_SIZE)
_TARGETS = slice(18, 22)  # commanded wheel speeds [rad/s]
_LOST = slice(22, 26)  # this control step's slip of each wheel, as a share of twice the mean
_GROUND_RADII = slice(26, 30)  # ``_RADII``, each less what is lost to slip [m]
_MOTION = slice(30, 33)  # of the last physics step: displacement [m, m], rotation [rad]
_MU = slice(33, 37)  # friction under each wheel
_MOTOR = slice(37, 44)  # from :func:`mecanum_env.physics.robot.motor_constants`
_UNDO = slice(44, 44 + STATE_SIZE)  # the state before the physics step
_WRAPPED = slice(62, 65)  # the pose, its heading in [-π, π)
_WORK_SIZE = 65
# … and what stays the same for a whole episode.
_RADII = slice(0, 4)  # [m]
_CONSTANTS = slice(4, 14)  # from :func:`mecanum_env.physics.robot.dynamics_constants`
_RASTER = slice(14, 17)  # the floor's: x, y of its corner [m], cells a metre
_WHEELS_X, _WHEELS_Y = slice(17, 21), slice(21, 25)  # in the body frame [m]
_HALF_X, _HALF_Y, _SLIP = 25, 26, 27
_GRIP = slice(28, 32)  # share of the floor's friction that each wheel has
_FIXED_SIZE = 32


@njit(cache=True, nogil=True, error_model="numpy")
def _wheel_step(work: Array, fixed: Array, friction: NDArray[np.float32], h: float, substeps: int) -> None:
    """Run :func:`turn_wheels` over a physics step with the μ that the wheels stand on at its start."""
    state, raster, mu, grip = work[_STATE], fixed[_RASTER], work[_MU], fixed[_GRIP]
    wheels_x, wheels_y = fixed[_WHEELS_X], fixed[_WHEELS_Y]
    c, s = math.cos(state[2]), math.sin(state[2])
    rows, cols = friction.shape
    for i in range(4):
        x = state[0] + c * wheels_x[i] - s * wheels_y[i]
        y = state[1] + s * wheels_x[i] + c * wheels_y[i]
        col = min(max(int((x - raster[0]) * raster[2]), 0), cols - 1)
        row = min(max(int((y - raster[1]) * raster[2]), 0), rows - 1)
        mu[i] = friction[row, col] * grip[i]
    turn_wheels(
        state, work[_TARGETS], work[_GROUND_RADII], mu, fixed[_CONSTANTS], work[_MOTOR], h, substeps, work[_MOTION]
    )


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


@njit(cache=True, nogil=True, error_model="numpy")
def _drive_clear(
    work: Array, fixed: Array, friction: NDArray[np.float32], clearance: NDArray[np.float32], segments: Array,
    circles: Array, dt: float, substeps: int, steps: int, readings: Array,
) -> int:  # fmt: skip
    """Run up to ``steps`` physics steps for as long as nothing can be touched in them.

    pymunk looks for contacts each time it has moved the body. Where nothing is within a step's travel of the
    body at the step's end, it would have found none. Returns the number of steps taken; the one in which
    something may be touched is undone. What ``work`` holds of the control step is filled for whoever goes on.
    """
    state, undo, motion, wrapped = work[_STATE], work[_UNDO], work[_MOTION], work[_WRAPPED]
    state[INCREMENTS] = 0.0
    radii, ground_radii, lost = fixed[_RADII], work[_GROUND_RADII], work[_LOST]
    for i in range(4):
        ground_radii[i] = radii[i] * (1.0 - 2.0 * fixed[_SLIP] * lost[i])
    h = dt / substeps
    motor_constants(fixed[_CONSTANTS], h, work[_MOTOR])
    raster, half_x, half_y = fixed[_RASTER], fixed[_HALF_X], fixed[_HALF_Y]
    rows, cols = clearance.shape
    circumscribed = math.sqrt(half_x * half_x + half_y * half_y)
    for step in range(steps):
        undo[:] = state
        _wheel_step(work, fixed, friction, h, substeps)
        # As pymunk does it: mean velocity first, then velocity times time.
        x, y = state[0] + motion[0] / dt * dt, state[1] + motion[1] / dt * dt
        theta = state[2] + motion[2] / dt * dt
        travel = math.sqrt(motion[0] ** 2 + motion[1] ** 2) + abs(motion[2]) * circumscribed + _MARGIN_M
        col = math.floor((x - raster[0]) * raster[2])
        row = math.floor((y - raster[1]) * raster[2])
        far = 0 <= row < rows and 0 <= col < cols and clearance[row, col] > circumscribed + travel
        if not far and not _box_is_clear(x, y, theta, half_x + travel, half_y + travel, segments, circles):
            state[:] = undo
            steps = step
            break
        state[0], state[1], state[2] = x, y, theta
        readings[step] = state[INCREMENTS]
    wrapped[0], wrapped[1], wrapped[2] = state[0], state[1], wrap_scalar(state[2])
    return steps


@lru_cache(maxsize=16)
def divide(step_s: float, physics_step_s: float) -> tuple[int, float, int]:
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
        Draws the patches now and four numbers per control step: the wheels' slip, 64 steps ahead. The same
        generator state and the same actions give the same path to the last bit, in any process.
    true_radii, true_lever
        The robot's true wheel radii ``(4,)`` [m] and lever [m], where they differ from the nominal ones
        (:class:`mecanum_env.sensing.sensors.WheelEncoders` draws them).
    floor
        The one that another robot of the same plan stands on; else it is drawn.
    shortcut
        Leave pymunk out while nothing can be touched. The path is the same without, only slower.

    Raises
    ------
    FloorPlanError
        Where the robot would touch something at the plan's start.
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
        floor: Floor | None = None,
        shortcut: bool = True,
    ) -> None:
        self.plan, self.robot, self.noise = plan, robot, noise
        self.floor = build_floor(plan, noise, rng) if floor is None else floor
        self._rng = rng
        self._slips, self._slips_left = np.empty((_AHEAD, 4)), 0
        self._shortcut = shortcut
        self._fixed = fixed = np.zeros(_FIXED_SIZE)
        fixed[_RADII] = robot.wheel_radius_m if true_radii is None else true_radii
        fixed[_CONSTANTS] = dynamics_constants(robot, lever_m=true_lever)
        fixed[_RASTER] = self.floor.raster
        fixed[_WHEELS_X], fixed[_WHEELS_Y] = wheel_positions(robot).T
        fixed[_HALF_X], fixed[_HALF_Y], fixed[_SLIP] = 0.5 * robot.length_m, 0.5 * robot.width_m, noise.slip
        self._fastest = max(
            robot.max_speed_m_s, robot.max_turn_rate_rad_s * robot.circumscribed_radius_m
        )  # [m/s] of any point of the body
        fixed[_GRIP] = 1.0
        self._segments = np.ascontiguousarray(plan.segments, dtype=np.float64).reshape(-1, 4)
        self._circles = np.ascontiguousarray(plan.circles, dtype=np.float64).reshape(-1, 3)
        self._work = np.zeros(_WORK_SIZE)
        self._readings = np.zeros((1, 4))
        self._work[POSE] = plan.start
        self._wrap_pose()
        self._contacts = Contacts()
        self._space = build_space(plan)
        ((self._body, self._touch),) = add_robots(self._space, (robot,))
        self._body_is_behind = True
        self._forgotten = _PERSISTENCE  # pymunk's steps since it last found a contact
        self._check_start()

    def put(self, pose: ArrayLike) -> bool:
        """Put the robot at rest at another pose ``(3,)`` of the world frame; tell whether it fits there.

        Where it would touch something it stays where it is. For studies of what a belief makes of it.
        """
        before = self._work[_STATE].copy()
        self._work[POSE], self._work[TWIST], self._work[WHEELS] = np.asarray(pose, np.float64), 0.0, 0.0
        free = self._touches_nothing()
        if not free:
            self._work[_STATE] = before
            self._body_is_behind = True
        self._wrap_pose()
        return free

    @property
    def grip(self) -> Array:
        """Share of the floor's friction that each wheel has ``(4,)``; a view, which studies may write to."""
        return self._fixed[_GRIP]

    def _touches_nothing(self) -> bool:
        self.place(self._body)
        self._body_is_behind = False
        (shape,) = self._body.shapes
        shape.cache_bb()
        return not self._space.shape_query(shape)

    def _check_start(self) -> None:
        if not self._touches_nothing():
            at = ", ".join(f"{v:.2f}" for v in self.plan.start)
            raise FloorPlanError(
                f"the start ({at}) in {self.plan.name!r} has the robot touch something; choose another"
            )

    def step(self, wheel_targets: ArrayLike, step_s: float, physics_step_s: float) -> None:
        """Drive for one control step.

        Parameters
        ----------
        wheel_targets
            Commanded wheel speeds ``(4,)`` [rad/s], held.
        step_s, physics_step_s
            Length of the control step and of the physics steps it consists of [s].
        """
        steps, dt, substeps = divide(step_s, physics_step_s)
        clear = self._shortcut and self._forgotten >= _PERSISTENCE
        done = self.begin(wheel_targets, (steps, dt, substeps), clear=clear)
        if done < steps:
            if self._body_is_behind:
                self.place(self._body)
                self._body_is_behind = False
            for step in range(done, steps):
                parts = self.push(self._body, dt, substeps)
                for _ in range(parts):
                    self._space.step(dt / parts)
                self._forgotten = 0 if self.settle(self._body, self._touch, dt, step) else self._forgotten + parts
            self._wrap_pose()

    # ---- parts of a step, for many robots in one space -----------------------------------------------------

    def begin(self, wheel_targets: ArrayLike, division: tuple[int, float, int], *, clear: bool) -> int:
        """Begin a control step; return how many of its physics steps are done, as nothing can be touched in them.

        ``division`` is what :func:`divide` returns; where it is not ``clear``, none is done.
        """
        steps, dt, substeps = division
        self._work[_TARGETS] = wheel_targets
        if self._slips_left == 0:
            self._rng.random(out=self._slips)  # even where slip is zero: the stream must not depend on it
            self._slips_left = _AHEAD
        self._work[_LOST] = self._slips[-self._slips_left]
        self._slips_left -= 1
        if len(self._readings) != steps:
            self._readings = np.zeros((steps, 4))
        floor = self.floor
        done = _drive_clear(
            self._work, self._fixed, floor.friction, floor.clearance, self._segments, self._circles, dt, substeps,
            steps if clear else 0, self._readings,
        )  # fmt: skip
        if done:
            self._body_is_behind = True
            self._contacts.pass_clear(done * dt)
        return done

    def push(self, body: pymunk.Body, dt: float, substeps: int) -> int:
        """Give pymunk's body the mean velocity of its next physics step; return in how many parts to step."""
        _wheel_step(self._work, self._fixed, self.floor.friction, dt / substeps, substeps)
        dx, dy, turn = self._work[_MOTION].tolist()
        body.velocity = dx / dt, dy / dt
        body.angular_velocity = turn / dt
        # Always the same number of parts: pymunk scales the impulses it starts from with the ratio of one step's
        # length to the last one's, and a wall struck in a short step throws the robot back in a long one.
        return max(1, math.ceil(self._fastest * dt / MAX_TRAVEL_M))

    def settle(self, body: pymunk.Body, touch: Touch, dt: float, step: int) -> bool:
        """Take over where pymunk has brought the body in a physics step; tell whether anything was touched."""
        state, touched = self._work[_STATE], touch.now
        x, y = body.position
        angle = body.angle
        state[0], state[1], state[2] = x, y, angle
        impulse = 0.0
        if touched:
            # The contact has the last word on the velocity; elsewhere it is the kernel's, at the step's end.
            vx, vy = body.velocity
            c, s = math.cos(angle), math.sin(angle)
            ahead, aside = c * vx + s * vy, c * vy - s * vx
            impulse = self.robot.mass_kg * math.hypot(ahead - state[3], aside - state[4])
            state[3], state[4], state[5] = ahead, aside, body.angular_velocity
        self._contacts.close_step(dt, impulse, touch)
        self._readings[step] = self._work[INCREMENTS]
        return touched

    def leave_space(self) -> None:
        """Take note that the robot was moved in another space than its own."""
        self._body_is_behind = True
        self._touch.now = self._touch.robot = False
        self._forgotten = 0  # what its own space remembers is old
        self._wrap_pose()

    def place(self, body: pymunk.Body) -> None:
        """Put a body of pymunk's where the robot is, at rest."""
        x, y, theta = self._work[POSE].tolist()
        body.position, body.angle = (x, y), theta
        body.velocity, body.angular_velocity = (0.0, 0.0), 0.0

    def _wrap_pose(self) -> None:
        x, y, theta = self._work[POSE].tolist()
        self._work[_WRAPPED] = x, y, wrap_scalar(theta)

    @property
    def pose(self) -> Array:
        """The robot's true pose ``(3,)`` in the world frame: x [m], y [m], θ [rad] in [-π, π)."""
        return self._work[_WRAPPED].copy()

    @property
    def twist(self) -> Array:
        """The true body twist ``(3,)``: vx, vy [m/s], ω [rad/s]."""
        return self._work[TWIST].copy()

    @property
    def wheel_speeds(self) -> Array:
        """The wheels' speeds ``(4,)`` [rad/s]."""
        return self._work[WHEELS].copy()

    @property
    def wheel_readings(self) -> Array:
        """How far each wheel had turned ``(steps, 4)`` [rad], with whatever slipped, in the last control step.

        A row for the end of each physics step; the last one is the whole step's.
        """
        return self._readings.copy()

    @property
    def collisions(self) -> int:
        """Contacts so far: touching again within :data:`CONTACT_GAP_S`, or several things at once, is one."""
        return self._contacts.count

    @property
    def robot_collisions(self) -> int:
        """Those of the contacts in which another robot was touched."""
        return self._contacts.with_robots

    @property
    def fastest_m_s(self) -> float:
        """Speed that no point of the body exceeds on its own [m/s]."""
        return self._fastest

    @property
    def last_impulse(self) -> float:
        """The hardest blow of the last contact [N·s]: the largest impulse of one physics step in it."""
        return self._contacts.peak

    @property
    def last_impulse_total(self) -> float:
        """All of the last contact's impulse so far [N·s], with the pressing and rubbing after the blow."""
        return self._contacts.total
