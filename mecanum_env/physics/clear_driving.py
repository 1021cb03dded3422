"""Driving where nothing can be touched: the kernels of a control step, and how what they carry is laid out."""

from __future__ import annotations

import math

from numba import njit

from mecanum_env.physics.robot import INCREMENTS, STATE_SIZE, motor_constants, turn_wheels
from slam.geometry import wrap_scalar
from slam.types import Array, Floats

__all__ = [
    "CONSTANTS", "FIXED_SIZE", "GRIP", "HALF_X", "HALF_Y", "LOST", "MOTION", "RADII", "RASTER", "SLIP",
    "STATE", "TARGETS", "WHEELS_X", "WHEELS_Y", "WORK_SIZE", "WRAPPED", "drive_clear", "wheel_step",
]  # fmt: skip

_MARGIN_M = 1e-3  # nothing within it: no contact, whatever the rounding


# What the kernels carry beside the state, in one array: each argument of a call takes 80 ns to unpack.
STATE = slice(0, STATE_SIZE)
TARGETS = slice(18, 22)  # commanded wheel speeds [rad/s]
LOST = slice(22, 26)  # this control step's slip of each wheel, as a share of twice the mean
GROUND_RADII = slice(26, 30)  # ``RADII``, each less what is lost to slip [m]
MOTION = slice(30, 33)  # of the last physics step: displacement [m, m], rotation [rad]
MU = slice(33, 37)  # friction under each wheel
MOTOR = slice(37, 44)  # from :func:`mecanum_env.physics.robot.motor_constants`
UNDO = slice(44, 44 + STATE_SIZE)  # the state before the physics step
WRAPPED = slice(62, 65)  # the pose, its heading in [-π, π)
WORK_SIZE = 65
# … and what stays the same for a whole episode.
RADII = slice(0, 4)  # [m]
CONSTANTS = slice(4, 14)  # from :func:`mecanum_env.physics.robot.dynamics_constants`
RASTER = slice(14, 17)  # the floor's: x, y of its corner [m], cells a metre
WHEELS_X, WHEELS_Y = slice(17, 21), slice(21, 25)  # in the body frame [m]
HALF_X, HALF_Y, SLIP = 25, 26, 27
GRIP = slice(28, 32)  # share of the floor's friction that each wheel has
FIXED_SIZE = 32


@njit(cache=True, nogil=True, error_model="numpy")
def wheel_step(work: Array, fixed: Array, friction: Floats, h: float, substeps: int) -> None:
    """Run :func:`turn_wheels` over a physics step with the μ that the wheels stand on at its start."""
    state, raster, mu, grip = work[STATE], fixed[RASTER], work[MU], fixed[GRIP]
    wheels_x, wheels_y = fixed[WHEELS_X], fixed[WHEELS_Y]
    c, s = math.cos(state[2]), math.sin(state[2])
    rows, cols = friction.shape
    for i in range(4):
        x = state[0] + c * wheels_x[i] - s * wheels_y[i]
        y = state[1] + s * wheels_x[i] + c * wheels_y[i]
        col = min(max(int((x - raster[0]) * raster[2]), 0), cols - 1)
        row = min(max(int((y - raster[1]) * raster[2]), 0), rows - 1)
        mu[i] = friction[row, col] * grip[i]
    turn_wheels(
        state, work[TARGETS], work[GROUND_RADII], mu, fixed[CONSTANTS], work[MOTOR], h, substeps, work[MOTION]
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
def drive_clear(
    work: Array, fixed: Array, friction: Floats, clearance: Floats, segments: Array,
    circles: Array, dt: float, substeps: int, steps: int, readings: Array,
) -> int:  # fmt: skip
    """Run up to ``steps`` physics steps for as long as nothing can be touched in them.

    pymunk looks for contacts each time it has moved the body. Where nothing is within a step's travel of the
    body at the step's end, it would have found none. Returns the number of steps taken; the one in which
    something may be touched is undone. What ``work`` holds of the control step is filled for whoever goes on.
    """
    state, undo, motion, wrapped = work[STATE], work[UNDO], work[MOTION], work[WRAPPED]
    state[INCREMENTS] = 0.0
    radii, ground_radii, lost = fixed[RADII], work[GROUND_RADII], work[LOST]
    for i in range(4):
        ground_radii[i] = radii[i] * (1.0 - 2.0 * fixed[SLIP] * lost[i])
    h = dt / substeps
    motor_constants(fixed[CONSTANTS], h, work[MOTOR])
    raster, half_x, half_y = fixed[RASTER], fixed[HALF_X], fixed[HALF_Y]
    rows, cols = clearance.shape
    circumscribed = math.sqrt(half_x * half_x + half_y * half_y)
    for step in range(steps):
        for i in range(len(state)):
            undo[i] = state[i]
        wheel_step(work, fixed, friction, h, substeps)
        # As pymunk does it: mean velocity first, then velocity times time.
        x, y = state[0] + motion[0] / dt * dt, state[1] + motion[1] / dt * dt
        theta = state[2] + motion[2] / dt * dt
        travel = math.sqrt(motion[0] ** 2 + motion[1] ** 2) + abs(motion[2]) * circumscribed + _MARGIN_M
        col = math.floor((x - raster[0]) * raster[2])
        row = math.floor((y - raster[1]) * raster[2])
        far = 0 <= row < rows and 0 <= col < cols and clearance[row, col] > circumscribed + travel
        if not far and not _box_is_clear(x, y, theta, half_x + travel, half_y + travel, segments, circles):
            for i in range(len(state)):
                state[i] = undo[i]
            steps = step
            break
        state[0], state[1], state[2] = x, y, theta
        for i in range(4):
            readings[step, i] = state[INCREMENTS.start + i]
    wrapped[0], wrapped[1], wrapped[2] = state[0], state[1], wrap_scalar(state[2])
    return steps
