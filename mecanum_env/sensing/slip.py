"""What encoders tell of slip: the body follows its wheels no faster than the floor passes on.

The wheels' readings, of every few milliseconds, drive a body of the robot's mass over a floor of the declared
friction, by the traction of :func:`mecanum_env.physics.robot.turn_wheels`. By how much the wheels outrun that body
is what they may have slipped. No more than that: patches, and the walls that hold the robot, are not known.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from mecanum_env.config import NoiseConfig, RobotConfig
from mecanum_env.physics.robot import GRAVITY_M_S2, pull
from slam.types import Array

__all__ = ["expected_share", "follow", "grip_m_s2", "traction_constants"]

_PARTS = 2  # of the time between two readings


def grip_m_s2(noise: NoiseConfig) -> float:
    """Return the acceleration that the floor passes on along x or y.

    Rollers at 45° pass on 1/√2 of what it holds. Where there are patches, any step may be on one.
    """
    friction = sum(noise.patch_friction) / 2.0 if noise.patch_share > 0.0 else noise.friction
    return friction * GRAVITY_M_S2 / math.sqrt(2.0)


def traction_constants(robot: RobotConfig, noise: NoiseConfig) -> Array:
    """Return what :func:`follow` needs to know of robot and floor, in its order."""
    lever_inertia = robot.inertia_kg_m2 / (robot.mass_kg * robot.lever_m**2)
    return np.array([grip_m_s2(noise), lever_inertia, robot.slip_speed_m_s, robot.lever_m])


def expected_share(noise: NoiseConfig) -> float:
    """Return the share of what :func:`follow` finds that is lost in the root mean square over the floor.

    It takes the robot to stand on a patch. Elsewhere wheels that jerk slip about half as much.
    """
    return math.sqrt(noise.patch_share + 0.25 * (1.0 - noise.patch_share)) if noise.patch_share > 0.0 else 1.0


@njit(nogil=True, error_model="numpy", forceinline=True)
def follow(body: Array, last: Array, now: Array, dt: float, constants: Array, lost: Array) -> None:
    """Let the body follow its wheels from one reading to the next.

    Parameters
    ----------
    body
        vx, vy, l ω ``(3,)`` [m/s], advanced in place.
    last, now
        Ground speeds ``(4,)`` [m/s] of the wheels, means over the times before this reading and the last one.
    dt
        Time between two readings [s].
    constants
        From :func:`traction_constants`.
    lost
        ``(3,)`` [m]; by how far the wheels outran the body is added: along x, along y, and of the turn times l.
    """
    grip, inertia, s0, lever = constants[0], constants[1], constants[2], constants[3]
    x = 0.25 * ((now[0] + now[1]) + (now[2] + now[3]))
    y = 0.25 * ((now[1] - now[0]) + (now[2] - now[3]))
    turn = 0.25 * ((now[1] - now[0]) + (now[3] - now[2]))
    vx, vy, vl = body[0], body[1], body[2]
    # Which wheel has to pull the hardest for the body to keep up, by the least forces that do.
    ahead, aside = abs(x - vx), abs(y - vy) + inertia * abs(turn - vl)
    if ahead + aside > grip * dt:
        h = dt / _PARTS
        load = math.sqrt(0.125) * grip * h
        for part in range(_PARTS):
            # Speeds of the wheels half way through the part, on the line through the two means.
            f = 0.5 + (part + 0.5) / _PARTS
            q0 = vx - vy - vl - (last[0] + f * (now[0] - last[0]))
            q1 = vx + vy + vl - (last[1] + f * (now[1] - last[1]))
            q2 = vx + vy - vl - (last[2] + f * (now[2] - last[2]))
            q3 = vx - vy + vl - (last[3] + f * (now[3] - last[3]))
            g0, g1 = load / math.sqrt(0.5 * q0 * q0 + s0 * s0), load / math.sqrt(0.5 * q1 * q1 + s0 * s0)
            g2, g3 = load / math.sqrt(0.5 * q2 * q2 + s0 * s0), load / math.sqrt(0.5 * q3 * q3 + s0 * s0)
            dvx, dvy, dvl = pull(q0, q1, q2, q3, g0, g1, g2, g3, 1.0, inertia)
            lost[0] += h * (x - vx - 0.5 * dvx)
            lost[1] += h * (y - vy - 0.5 * dvy)
            lost[2] += h * (turn - vl - 0.5 * dvl)
            vx, vy, vl = vx + dvx, vy + dvy, vl + dvl
            angle = h / lever * vl  # by which the body's axes turn under its velocity
            vx, vy = vx + angle * vy, vy - angle * vx
        x, y, turn = vx, vy, vl
    body[0], body[1], body[2] = x, y, turn
