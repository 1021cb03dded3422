"""What every agent is: it chooses a goal from the belief, and acts to get there."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mecanum_env.config import LIDAR_PRESETS, ROBOT_PRESETS, LidarConfig, RobotConfig, StepTime, resolve
from slam.belief import Belief
from slam.settings import argument, checked, from_mapping
from slam.types import Array, Floats

__all__ = ["ENDINGS", "Agent", "Goal"]

ENDINGS = {
    "covered": "nothing is left that it holds worth a visit",
    "unreachable": "frontiers are left, and no way to a place to see them from",
    "stuck": "frontiers are left that could not be driven to, though there seemed to be a way",
    "returned": "all explored, and back at the start",
}
"""Why an agent has nothing left to do: the word of its status, and what it means."""


@dataclass(frozen=True, eq=False)
class Goal:
    """Where to drive, and the way there, in the belief's frame."""

    pose: Array  # (3,) x [m], y [m], θ [rad]
    path: Array  # (n, 2) [m], n ≥ 1: from the robot's position when it was planned to the goal's


class Agent(ABC):
    """A strategy of exploration. It sees the belief and the observation, never the truth.

    Parameters
    ----------
    config : dataclass or mapping, optional
        The strategy's own configuration, a ``config_type``.
    robot, lidar : config, mapping or preset name, optional
        The body it drives and the sensor it looks with; the youBot's by default.
    step_s : float
        Time between two calls of :meth:`act` [s].
    """

    config_type: type[Any] | None = None
    """The dataclass of ``config``; none of an agent that has no settings, or reads them itself."""

    def __init__(
        self,
        config: Any = None,
        *,
        robot: RobotConfig | Mapping[str, Any] | str | None = None,
        lidar: LidarConfig | Mapping[str, Any] | str | None = None,
        step_s: float = 0.1,
    ) -> None:
        self._robot = resolve(RobotConfig, robot, ROBOT_PRESETS, "robot preset")
        self._lidar = resolve(LidarConfig, lidar, LIDAR_PRESETS, "lidar preset")
        self._step_s: float = checked("step_s", StepTime, step_s)
        with argument("config"):
            self.config = config if self.config_type is None else from_mapping(self.config_type, config)
        self._rng = np.random.default_rng(0)
        self._goal: Goal | None = None
        self._frontiers: Array = np.zeros((0, 2))
        self._status = "idle"

    outlives_coverage = False
    """Whether an episode goes on when all is mapped: this agent has something left to do."""

    @property
    def goal(self) -> Goal | None:
        """The goal it is driving to, if any."""
        return self._goal

    @property
    def frontiers(self) -> Array:
        """Frontier points ``(n, 2)`` [m] of the last choice, in the belief's frame."""
        return self._frontiers.copy()

    @property
    def status(self) -> str:
        """A word for what it is doing, such as ``driving`` or ``recovering``, or one of :data:`ENDINGS`."""
        return self._status

    @property
    def ended(self) -> bool:
        """Whether it has nothing left to do; ``status`` says why. What is seen later may set it off again."""
        return self._status in ENDINGS

    def reset(self, belief: Belief, seed: int = 0) -> None:
        """Forget everything and start an episode; the same seed and beliefs give the same actions."""
        self._rng = np.random.default_rng(seed)
        self._goal = None
        self._frontiers = np.zeros((0, 2))
        self._status = "idle"

    def looked(self, belief: Belief) -> None:  # noqa: B027 (most agents need not know)
        """Take note that the sensor looked from the belief's pose, where it is driven by :meth:`choose` alone.

        :meth:`act` takes note by itself.
        """

    @abstractmethod
    def choose(self, belief: Belief) -> Goal | None:
        """Return where to go next, or ``None`` when nothing is left to explore."""

    @abstractmethod
    def act(self, observation: Mapping[str, Any] | None, belief: Belief) -> Floats:
        """Return the action ``(3,)`` in [-1, 1]: the body twist vx, vy, ω as fractions of the robot's limits.

        Parameters
        ----------
        observation : mapping or None
            The environment's observation. Where it holds ``scan`` (range / maximum range, 1 where nothing
            returned), an agent may use it to brake for what the map does not show yet.
        belief : Belief
            What the robot believes now.
        """

    def _to_action(self, twist: Array) -> Floats:
        speed, turn_rate = self._robot.max_speed_m_s, self._robot.max_turn_rate_rad_s
        # Three numbers: plain arithmetic takes a fraction of what array calls do.
        shares = (twist[0] / speed, twist[1] / speed, twist[2] / turn_rate)
        return np.array([min(max(share, -1.0), 1.0) for share in shares], dtype=np.float32)
