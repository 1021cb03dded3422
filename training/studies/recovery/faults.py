"""What goes wrong: the robot is put elsewhere, a wheel loses its grip, the lidar sees nothing.

They reach into the environment's truth, which its public contract has no option for: no robot asks for them.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mecanum_env.env import ExploreEnv
from mecanum_env.team.communication import walls_between
from slam.types import Scan

__all__ = ["FAULTS", "Fault"]

_AWAY_M, _TURN_RAD = 1.0, math.radians(20.0)
_TRIES = 400  # at a place that the robot fits in, with a clear line to it


class Fault:
    """One that does nothing; the others begin and end something."""

    duration_s = 0.0

    def begin(self, env: ExploreEnv, rng: np.random.Generator) -> bool:
        """Begin; tell whether that was possible."""
        del env, rng
        return True

    def end(self, env: ExploreEnv) -> None:
        """Set right what was wrong."""


class _Teleport(Fault):
    """The robot is put down 1 m away, turned by 20°."""

    def begin(self, env: ExploreEnv, rng: np.random.Generator) -> bool:
        world, plan = env.truth.world, env.truth.ground.plan
        x, y, theta = world.pose.tolist()
        for _ in range(_TRIES):
            way = rng.uniform(-math.pi, math.pi)
            to = np.array([x + _AWAY_M * math.cos(way), y + _AWAY_M * math.sin(way)])
            turned = theta + _TURN_RAD * (1.0 if rng.random() < 0.5 else -1.0)
            if not walls_between(np.array([x, y]), to, plan.segments) and world.put([to[0], to[1], turned]):
                return True
        return False


class _Wheel(Fault):
    """The floor under one wheel has no friction for 3 s."""

    duration_s = 3.0

    def begin(self, env: ExploreEnv, rng: np.random.Generator) -> bool:
        env.truth.world.grip[int(rng.integers(4))] = 0.0
        return True

    def end(self, env: ExploreEnv) -> None:
        env.truth.world.grip[:] = 1.0


class _BlindLidar:
    """A lidar whose beams are all lost; the noise is drawn as ever."""

    def __init__(self, lidar: Any) -> None:
        self._lidar = lidar

    def __getattr__(self, name: str) -> Any:
        return getattr(self._lidar, name)

    def scan(self, *world: Any) -> Scan:
        """Return a sweep of nothing."""
        scan: Scan = self._lidar.scan(*world)
        return scan._replace(ranges=np.full_like(scan.ranges, np.nan))


class _Blind(Fault):
    """The lidar loses every beam for 10 s."""

    duration_s = 10.0

    def begin(self, env: ExploreEnv, rng: np.random.Generator) -> bool:
        del rng
        self._seeing = env.lidar
        env.lidar = _BlindLidar(env.lidar)  # type: ignore[assignment]
        return True

    def end(self, env: ExploreEnv) -> None:
        env.lidar = self._seeing


FAULTS: dict[str, type[Fault]] = {"none": Fault, "teleport": _Teleport, "wheel": _Wheel, "blind": _Blind}
