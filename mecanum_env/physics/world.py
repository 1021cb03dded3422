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
from typing import TYPE_CHECKING, Any

import numpy as np
import pymunk
from numpy.typing import ArrayLike

from mecanum_env.config import NoiseConfig, RobotConfig
from mecanum_env.physics.clear_driving import (
    CONSTANTS,
    FIXED_SIZE,
    GRIP,
    HALF_X,
    HALF_Y,
    LOST,
    MOTION,
    RADII,
    RASTER,
    SLIP,
    STATE,
    TARGETS,
    WHEELS_X,
    WHEELS_Y,
    WORK_SIZE,
    WRAPPED,
    drive_clear,
    wheel_step,
)
from mecanum_env.physics.collisions import CONTACT_GAP_S, Contacts, Touch, add_robots, build_space
from mecanum_env.physics.floor import Floor, build_floor
from mecanum_env.physics.robot import (
    INCREMENTS,
    POSE,
    REFERENCES,
    SUBSTEP_S,
    TWIST,
    WHEELS,
    dynamics_constants,
    wheel_positions,
)
from mecanum_env.rooms.floor_plan import FloorPlanError
from slam.geometry import wrap_scalar
from slam.types import Array

if TYPE_CHECKING:
    from mecanum_env.rooms.floor_plan import FloorPlan

__all__ = ["CONTACT_GAP_S", "MAX_TRAVEL_M", "World", "divide"]

MAX_TRAVEL_M = 0.005
"""pymunk's steps are cut so that the robot, at its limits, goes no further in one: hence no deeper into a wall."""

_AHEAD = 64  # control steps whose slip is drawn at once: a draw of four numbers takes 1.5 µs, of 256 two
_PERSISTENCE = 4  # steps after which pymunk has forgotten a contact (its collision_persistence is 3)


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
        self.plan, self.robot = plan, robot
        self.floor = build_floor(plan, noise, rng) if floor is None else floor
        self._rng = rng
        self._slips, self._slips_left = np.empty((_AHEAD, 4)), 0
        self._shortcut = shortcut
        self._fixed = fixed = np.zeros(FIXED_SIZE)
        fixed[RADII] = robot.wheel_radius_m if true_radii is None else true_radii
        fixed[CONSTANTS] = dynamics_constants(robot, lever_m=true_lever)
        fixed[RASTER] = self.floor.raster
        fixed[WHEELS_X], fixed[WHEELS_Y] = wheel_positions(robot).T
        fixed[HALF_X], fixed[HALF_Y], fixed[SLIP] = 0.5 * robot.length_m, 0.5 * robot.width_m, noise.slip
        # Speed that no point of the body exceeds on its own.
        self.fastest_m_s = max(robot.max_speed_m_s, robot.max_turn_rate_rad_s * robot.circumscribed_radius_m)
        fixed[GRIP] = 1.0
        self._segments = np.ascontiguousarray(plan.segments, dtype=np.float64).reshape(-1, 4)
        self._circles = np.ascontiguousarray(plan.circles, dtype=np.float64).reshape(-1, 3)
        self._work = np.zeros(WORK_SIZE)
        self._readings = np.zeros((1, 4))
        self._work[POSE] = plan.start
        self._wrap_pose()
        self._contacts = Contacts()
        self._build_space()
        self._forgotten = _PERSISTENCE  # pymunk's steps since it last found a contact
        self._check_start()

    def _build_space(self) -> None:
        self._space = build_space(self.plan)
        ((self._body, self._touch),) = add_robots(self._space, (self.robot,))
        self._body_is_behind = True

    def __getstate__(self) -> dict[str, Any]:
        """Return for a copy or a pickle all but what is pymunk's, which is built anew.

        A space that pymunk copies reports contacts to the original, and its walls have lost their neighbours.
        """
        return {name: value for name, value in vars(self).items() if name not in ("_space", "_body", "_touch")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make a copy whole."""
        vars(self).update(state)
        self._build_space()

    def put(self, pose: ArrayLike) -> bool:
        """Put the robot at rest at another pose ``(3,)`` of the world frame; tell whether it fits there.

        Where it would touch something it stays where it is. For studies of what a belief makes of it.
        """
        before = self._work[STATE].copy()
        work = self._work
        work[POSE], work[TWIST], work[WHEELS], work[REFERENCES] = np.asarray(pose, np.float64), 0.0, 0.0, 0.0
        free = self._touches_nothing()
        if not free:
            self._work[STATE] = before
            self._body_is_behind = True
        self._wrap_pose()
        return free

    @property
    def grip(self) -> Array:
        """Share of the floor's friction that each wheel has ``(4,)``; a view, which studies may write to."""
        return self._fixed[GRIP]

    def _touches_nothing(self) -> bool:
        self.place(self._body)
        self._body_is_behind = False
        (shape,) = self._body.shapes
        shape.cache_bb()
        return not self._space.shape_query(shape)

    def _check_start(self) -> None:
        if not self._touches_nothing():
            at, robot = ", ".join(f"{v:.2f}" for v in self.plan.start), self.robot
            raise FloorPlanError(
                f"the start ({at}) in {self.plan.name!r} has the robot, {robot.length_m:g} m by {robot.width_m:g} "
                "m, touch something; choose another, or see whether the plan's resolution is right"
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
        self._work[TARGETS] = wheel_targets
        if self._slips_left == 0:
            self._rng.random(out=self._slips)  # even where slip is zero: the stream must not depend on it
            self._slips_left = _AHEAD
        self._work[LOST] = self._slips[-self._slips_left]
        self._slips_left -= 1
        if len(self._readings) != steps:
            self._readings = np.zeros((steps, 4))
        floor = self.floor
        done = drive_clear(
            self._work, self._fixed, floor.friction, floor.clearance, self._segments, self._circles, dt, substeps,
            steps if clear else 0, self._readings,
        )  # fmt: skip
        if done:
            self._body_is_behind = True
            self._contacts.pass_clear(done * dt)
        return done

    def push(self, body: pymunk.Body, dt: float, substeps: int) -> int:
        """Give pymunk's body the mean velocity of its next physics step; return in how many parts to step."""
        wheel_step(self._work, self._fixed, self.floor.friction, dt / substeps, substeps)
        dx, dy, turn = self._work[MOTION].tolist()
        body.velocity = dx / dt, dy / dt
        body.angular_velocity = turn / dt
        # Always the same number of parts: pymunk scales the impulses it starts from with the ratio of one step's
        # length to the last one's, and a wall struck in a short step throws the robot back in a long one.
        return max(1, math.ceil(self.fastest_m_s * dt / MAX_TRAVEL_M))

    def settle(self, body: pymunk.Body, touch: Touch, dt: float, step: int) -> bool:
        """Take over where pymunk has brought the body in a physics step; tell whether anything was touched."""
        state, touched = self._work[STATE], touch.now
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
        self._work[WRAPPED] = x, y, wrap_scalar(theta)

    @property
    def pose(self) -> Array:
        """The robot's true pose ``(3,)`` in the world frame: x [m], y [m], θ [rad] in [-π, π)."""
        return self._work[WRAPPED].copy()

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
    def last_impulse(self) -> float:
        """The hardest blow of the last contact [N·s]: the largest impulse of one physics step in it."""
        return self._contacts.peak

    @property
    def last_impulse_total(self) -> float:
        """All of the last contact's impulse so far [N·s], with the pressing and rubbing after the blow."""
        return self._contacts.total
