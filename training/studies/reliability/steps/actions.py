"""Who drives: at random, at the limits, always alike, into the nearest wall, to and fro, or with nonsense."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mecanum_env.env import ExploreEnv
from mecanum_env.physics.robot import inverse_kinematics
from training.studies.reliability.steps.geometry import towards

__all__ = ["POLICIES", "Policy", "policy"]

Action = NDArray[np.float32]

Policy = Callable[[int], Action]
"""From a step's number to an action."""

POLICIES = ("uniform", "extreme", "constant", "adversarial", "flip", "nonsense")

_BEYOND = (-3e38, -5.0, -1.0, -1e-40, 0.0, 1.0, 5.0, 3e38)  # what a float32 holds


def policy(name: str, size: int, rng: np.random.Generator, env: ExploreEnv | None = None) -> Policy:
    """Return a policy of :data:`POLICIES`, for actions of so many numbers.

    ``adversarial`` has to see the environment: it drives at full speed towards the true wall that is nearest.
    ``nonsense`` acts at random: what is refused comes beside it.
    """

    def uniform(k: int) -> Action:
        return rng.uniform(-1.0, 1.0, size).astype(np.float32)

    def extreme(k: int) -> Action:
        return rng.choice(_BEYOND if k % 3 == 0 else (-1.0, 1.0), size).astype(np.float32)

    fixed = rng.uniform(-1.0, 1.0, size).astype(np.float32)

    def constant(k: int) -> Action:
        return fixed.copy()

    def flip(k: int) -> Action:
        return np.full(size, 1.0 if k % 2 else -1.0, np.float32)

    def adversarial(k: int) -> Action:
        assert env is not None
        plan, robot = env.truth.plan, env.config.robot
        x, y = towards(env.truth.world.pose, plan.segments, plan.circles)
        twist = np.array([x, y, 0.3 * math.sin(0.05 * k)])  # not always with the same corner ahead
        if size == 4:
            speeds = inverse_kinematics(robot, twist * robot.max_speed_m_s) / robot.max_wheel_speed_rad_s
            return np.asarray(speeds / max(1.0, float(np.abs(speeds).max())), np.float32)
        return np.asarray(twist / max(abs(x), abs(y), 1e-9), np.float32)

    return {
        "uniform": uniform, "extreme": extreme, "constant": constant, "adversarial": adversarial, "flip": flip,
        "nonsense": uniform,
    }[name]  # fmt: skip
