"""What encoders tell of slip: the body follows its wheels no faster than the floor passes on.

The wheels' readings, of every few milliseconds, drive a body of the robot's mass over a floor of the declared
friction, by the traction of :func:`mecanum_env.physics.robot.turn_wheels`; where there are slippery patches, a
second body over the slipperiest of them, so that no slide ends unseen. By how much the wheels outrun these bodies
is what they slip, here or at most there. Walls that hold the robot are not known.
"""

from __future__ import annotations

import math

from numba import njit

from mecanum_env.config import NoiseConfig, RobotConfig
from mecanum_env.physics.robot import GRAVITY_M_S2, pull
from slam.types import Array

__all__ = [
    "add_up", "follow", "grip_m_s2", "mean_of_slipperiest", "patch_friction", "slipperiest", "spread",
    "traction_constants",
]  # fmt: skip

_PARTS = 2  # of the time between two readings
_ROUNDS = 2  # of finding how much a wheel slips at the end of a part, and so how it grips
_SMALL_RAD = 0.04  # turn of a part up to which a rotation to first order stretches less than friction takes back
_STICKS = 0.5  # share of the grip up to which wheels creep by as much as they pull

# σ of what slips, as a share of what is expected to, on a floor that is the same everywhere; found in jerks.
_KNOWN = 0.1
# The same of what patches make of it: their friction differs, and not every wheel stands on one.
_PATCHES_DIFFER = 0.5
_LASTS_S = 1.0  # how long a robot that slips stays on one patch, or beside it


def patch_friction(noise: NoiseConfig) -> float:
    """Return the mean friction of what patches cover, or the floor's where there are none.

    A patch that would grip better than the floor does not: the world takes the lesser friction of both.
    """
    if noise.patch_share == 0.0 or slipperiest(noise) == noise.friction:
        return noise.friction
    least, most = noise.patch_friction
    over = max(most - noise.friction, 0.0)
    return (least + most) / 2.0 - (over**2 / (2.0 * (most - least)) if over > 0.0 else 0.0)


def slipperiest(noise: NoiseConfig) -> float:
    """Return the least friction that there may be, that of patches or the floor's."""
    return min(noise.patch_friction[0], noise.friction) if noise.patch_share > 0.0 else noise.friction


def mean_of_slipperiest(noise: NoiseConfig) -> float:
    """Return how far and how long a robot slides on patches in the mean, as a share of the slipperiest one's.

    Both go by 1/μ, and μ is uniform, but cut at the floor's F: the mean of a/μ over [a, b] is a ln(b/a) / (b - a)
    where b ≤ F, a (ln(F/a) + (b - F)/F) / (b - a) where a < F < b, and 1 where patches are as the floor.
    """
    least, most = noise.patch_friction
    cut = min(most, noise.friction)
    return least * (math.log(cut / least) + (most - cut) / cut) / (most - least) if cut > least else 1.0


def grip_m_s2(friction: float) -> float:
    """Return what acceleration a floor passes on along x or y: rollers at 45° pass on 1/√2 of what it holds."""
    return friction * GRAVITY_M_S2 / math.sqrt(2.0)


def traction_constants(robot: RobotConfig, friction: float) -> list[float]:
    """Return what :func:`follow` needs to know of robot and floor, in its order."""
    lever_inertia = robot.inertia_kg_m2 / (robot.mass_kg * robot.lever_m**2)
    return [grip_m_s2(friction), lever_inertia, robot.slip_speed_m_s, robot.lever_m]


def spread(noise: NoiseConfig) -> float:
    """Return the σ of what slips by either coordinate, beside its mean, as a share of what may: :func:`add_up`.

    What may is what slips on the floor, or by how much more does on the slipperiest patch.
    """
    q = noise.patch_share
    if q == 0.0:
        return _KNOWN
    return mean_of_slipperiest(noise) * math.sqrt(0.5 * q * (1.0 - q + _PATCHES_DIFFER**2))


@njit(nogil=True, error_model="numpy", forceinline=True)
def follow(body: Array, last: Array, now: Array, dt: float, constants: Array, lost: Array) -> bool:
    """Let the body follow its wheels from one reading to the next; tell whether they slip.

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
    # How fast the body is now if the wheels grip: as they, half a reading after their mean, less what they creep.
    creep = math.sqrt(2.0) * s0 / (grip * dt)
    on, on_turning = 0.5 - creep, 0.5 - creep * inertia
    end_x = x + on * (x - 0.25 * ((last[0] + last[1]) + (last[2] + last[3])))
    end_y = y + on * (y - 0.25 * ((last[1] - last[0]) + (last[2] - last[3])))
    end_turn = turn + on_turning * (turn - 0.25 * ((last[1] - last[0]) + (last[3] - last[2])))
    vx, vy, vl = body[0], body[1], body[2]
    # Which wheel has to pull the hardest for the body to keep up, by the least forces that do.
    ahead, aside = abs(end_x - vx), abs(end_y - vy) + inertia * abs(end_turn - vl)
    slips: bool = ahead + aside > _STICKS * grip * dt
    if slips:
        h = dt / _PARTS
        load = math.sqrt(0.125) * grip * h
        for part in range(_PARTS):
            # Speeds of the wheels at the end of the part, on the line through the two means.
            f = 0.5 + (part + 1.0) / _PARTS
            q0 = vx - vy - vl - (last[0] + f * (now[0] - last[0]))
            q1 = vx + vy + vl - (last[1] + f * (now[1] - last[1]))
            q2 = vx + vy - vl - (last[2] + f * (now[2] - last[2]))
            q3 = vx - vy + vl - (last[3] + f * (now[3] - last[3]))
            dvx = dvy = dvl = 0.0
            for _ in range(_ROUNDS):
                e0, e1 = q0 + dvx - dvy - dvl, q1 + dvx + dvy + dvl
                e2, e3 = q2 + dvx + dvy - dvl, q3 + dvx - dvy + dvl
                g0, g1 = load / math.sqrt(0.5 * e0 * e0 + s0 * s0), load / math.sqrt(0.5 * e1 * e1 + s0 * s0)
                g2, g3 = load / math.sqrt(0.5 * e2 * e2 + s0 * s0), load / math.sqrt(0.5 * e3 * e3 + s0 * s0)
                dvx, dvy, dvl = pull(q0, q1, q2, q3, g0, g1, g2, g3, 1.0, inertia)
            lost[0] += h * (x - vx - 0.5 * dvx)
            lost[1] += h * (y - vy - 0.5 * dvy)
            lost[2] += h * (turn - vl - 0.5 * dvl)
            vx, vy, vl = vx + dvx, vy + dvy, vl + dvl
            angle = h / lever * vl  # by which the body's axes turn under its velocity
            c, s = 1.0, angle
            if abs(angle) > _SMALL_RAD:
                c, s = math.cos(angle), math.sin(angle)
            vx, vy = c * vx + s * vy, c * vy - s * vx
        end_x, end_y, end_turn = vx, vy, vl
    body[0], body[1], body[2] = end_x, end_y, end_turn
    return slips


@njit(nogil=True, error_model="numpy", forceinline=True)
def add_up(slid: Array, may: Array, dt: float, slips: bool) -> tuple[float, float]:
    """Return the σ of a step's slip, along and in turning, for a filter that takes steps for independent.

    Whether the robot stands on a patch, and on which, stays the same while it slips. So the errors of its steps
    add up, and a step's variance is what the square of their sum grows by.

    Parameters
    ----------
    slid
        ``(3,)`` σ of the sum so far [m, m, rad], advanced in place: it fades, and ends where nothing slips.
    may
        ``(3,)`` σ of this step alone, with its sign [m, m, rad].
    dt
        Length of the step [s].
    slips
        Whether anything does.
    """
    along = math.sqrt(may[0] ** 2 + may[1] ** 2 + 2.0 * max(slid[0] * may[0] + slid[1] * may[1], 0.0))
    turned = math.sqrt(may[2] ** 2 + 2.0 * max(slid[2] * may[2], 0.0))
    keeps = max(1.0 - dt / _LASTS_S, 0.0) if slips else 0.0
    for i in range(3):
        slid[i] = keeps * (slid[i] + may[i])
    return along, turned
