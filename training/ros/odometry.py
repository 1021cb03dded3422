"""Odometry as it comes, out of order, said twice, begun anew or by a clock that is set back; and as it is used."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from mecanum_env.config import RobotConfig
from slam.geometry import compose, inverse, wrap_scalar
from slam.types import Array

__all__ = ["OdometryTrack"]

_KEPT = 1000  # messages: seconds of the fastest
_TOO_FAST = 3.0  # times its limits: no robot's motion, but odometry that began anew
_LEAST_S = 0.1  # in which so much way is no jump: stamps of single messages may lie closer


class OdometryTrack:
    """The base's poses by odometry in the last seconds, as though it had never jumped.

    Parameters
    ----------
    robot : RobotConfig
        Whose limits tell a motion from a jump.
    late_s : float
        For so long messages that are older than the last one are out of order; then their clock was set back [s].
    complain, set_back : callable
        Told in a line what is wrong; and by how much the clock was set back [s], below 0.
    """

    def __init__(
        self, robot: RobotConfig, late_s: float, *, complain: Callable[[str], None],
        set_back: Callable[[float], None],
    ) -> None:  # fmt: skip
        self._robot, self._late_s, self._complain, self._set_back = robot, late_s, complain, set_back
        self._kept: deque[tuple[float, Array]] = deque(maxlen=_KEPT)
        self._came_s = -math.inf  # when the last one that was taken came
        self._older_since = math.inf  # when messages began to be older than that one
        self.since_jumps = np.zeros(3)
        """What recorded poses are moved by, for jumps to be no motion ``(3,)``."""

    @property
    def newest_s(self) -> float:
        """Time of the newest pose [s]; −∞ before the first."""
        return self._kept[-1][0] if self._kept else -math.inf

    @property
    def newest(self) -> Array:
        """The newest pose ``(3,)``."""
        return self._kept[-1][1]

    def add(self, at: float, pose: Array, now_s: float) -> bool:
        """Take a pose ``(3,)`` of a time, which came at one of the caller's clock; tell whether it was news."""
        if at == self.newest_s:  # said twice
            return False
        if at < self.newest_s:  # out of order
            self._older_since = min(self._older_since, now_s)
            if now_s - self._older_since < self._late_s:
                return False
        if math.isfinite(self._older_since):  # the caller's clock says how old what is kept is
            back_s = at - (now_s - self._came_s) - self.newest_s
            if back_s < -_LEAST_S:
                self._kept = deque(((t + back_s, kept) for t, kept in self._kept), maxlen=_KEPT)
                self._set_back(back_s)
        self._older_since, self._came_s = math.inf, now_s
        self._kept.append((at, self._without_jump(at, pose)))
        return True

    def at(self, at: float) -> Array | None:
        """Return the pose ``(3,)`` at a time, between two messages; ``None`` before the first kept."""
        after = next((k for k, (time_s, _) in enumerate(self._kept) if time_s >= at), None)
        if after is None or (after == 0 and self._kept[0][0] > at):
            return None
        (t1, pose), (t0, before) = self._kept[after], self._kept[max(after - 1, 0)]
        if t1 == at:
            return pose
        share = (at - t0) / (t1 - t0)
        x, y, theta = before + share * np.array([*(pose - before)[:2], wrap_scalar(float(pose[2] - before[2]))])
        return np.array([x, y, wrap_scalar(float(theta))])

    def is_motion(self, way_m: float, turn_rad: float, span_s: float) -> bool:
        """Tell whether a robot goes so far in so long; where it does not, say so."""
        most_s, robot = _TOO_FAST * span_s, self._robot
        if way_m <= most_s * robot.max_speed_m_s and abs(turn_rad) <= most_s * robot.max_turn_rate_rad_s:
            return True
        self._complain("odometry jumped; the jump is left out")
        return False

    def _without_jump(self, at: float, pose: Array) -> Array:
        """Return where the odometry would be at a time, had it never jumped; a jump is no motion."""
        if not self._kept:
            return pose
        (before, last), moved = self._kept[-1], compose(self.since_jumps, pose)
        way_m, turn = math.hypot(moved[0] - last[0], moved[1] - last[1]), wrap_scalar(float(moved[2] - last[2]))
        if self.is_motion(way_m, turn, max(at - before, _LEAST_S)):
            return moved
        self.since_jumps = compose(last, inverse(pose))
        return last.copy()
