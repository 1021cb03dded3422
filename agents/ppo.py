"""``ppo``: a trained policy that drives, from the map and the observation straight to the body twist.

It was trained for the youBot and its lidar; another body's twists are fractions of another's limits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.base import Agent, Goal
from agents.driving.safety import scan_shares
from agents.learned.drive_memory import Plan, PlanSettings
from agents.learned.drive_network import BEAMS, RANGE_M, DriveNetwork
from agents.learned.policy_files import read_policy
from slam import geometry
from slam.belief import Belief
from slam.grids.occupancy import FREE
from slam.settings import Config, Duration, Gap, Length, Positive, checked, require
from slam.types import Array, Floats

__all__ = ["FORMAT", "SHIPPED", "Ppo", "PpoConfig", "load_drive_policy"]

FORMAT = "mecanum-slam drive policy 2"
SHIPPED = Path(__file__).parent / "policies" / "ppo.safetensors"

_PLANNING = {"goal_m": Length, "keep_m": Gap, "stall_m": Gap}  # what each of PlanSettings may be


@dataclass(frozen=True, kw_only=True)
class PpoConfig(Config):
    """Which policy."""

    policy: str = ""  # path of a .safetensors file, the .json file beside it; the package's own by default
    # With nothing new in sight, and on the way to nothing that is rather a goal than none, until the place is held
    # for explored …
    patience_s: Duration = 20.0
    hopeful_s: Duration = 60.0  # … and with nothing new in sight, whatever it is on the way to,
    hopeful_s_per_m: Positive = 2.0  # and so much longer for each metre of the longest way since something was new
    new_m2: Positive = 0.3  # what counts for new


def load_drive_policy(path: Path) -> tuple[DriveNetwork, dict[str, Any]]:
    """Read a policy: the network, and what the JSON file says of its training; see :func:`read_policy`."""
    return read_policy(path, FORMAT, _made)


def _made(weights: Mapping[str, Floats], described: Mapping[str, Any]) -> DriveNetwork:
    told = described["planning"]
    require(set(told) == set(_PLANNING), f"planning must have {', '.join(_PLANNING)} and nothing else")
    settings = {name: checked(f"planning.{name}", kind, told[name]) for name, kind in _PLANNING.items()}
    uncertainty = checked("uncertainty", bool, described["uncertainty"])
    return DriveNetwork(weights, PlanSettings(**settings), uncertainty=uncertainty)


class Ppo(Agent):
    """Sends what the policy's network says, until nothing new has come in sight and nothing more is likely to."""

    config_type = PpoConfig

    def __init__(self, config: PpoConfig | Mapping[str, Any] | None = None, **body: Any) -> None:
        super().__init__(config, **body)
        self.policy_path = Path(self.config.policy or SHIPPED)
        self._network, self.about = load_drive_policy(self.policy_path)
        self._forget()

    def _forget(self) -> None:
        self._memory = self._network.memory(step_s=self._step_s)
        self._sent = np.zeros(3, np.float32)
        self._time = self._news_at = self._hoped_at = 0.0
        self._known_m2 = self._longest_m = 0.0

    def reset(self, belief: Belief, seed: int = 0) -> None:
        """Start an episode with nothing remembered; nothing is drawn at random."""
        super().reset(belief, seed)
        self._forget()
        self._status = "driving"

    def choose(self, belief: Belief) -> Goal:
        """Return the way that the network's planning layer sees on the belief's maps."""
        return _goal(self._memory.way(belief), belief)

    def act(self, observation: Mapping[str, Any] | None, belief: Belief) -> Floats:
        """Return the network's action; what the observation lacks is drawn from the belief."""
        if self._done(belief):
            self._sent, self._goal = np.zeros(3, np.float32), None
            return self._sent.copy()
        seen = self._complete(observation, belief)
        way = self._memory.way(belief)
        self._goal = _goal(way, belief)
        self._longest_m = max(self._longest_m, way.length)
        if way.likely:
            self._hoped_at = self._time
        self._sent = self._network.twist(self._network.inputs(seen, way))
        return self._sent.copy()

    def _done(self, belief: Belief) -> bool:
        """Whether nothing new has been seen for long, and nothing is hoped for; looked after once a second."""
        step = round(self._time / self._step_s)
        self._time += self._step_s
        if step % max(round(1.0 / self._step_s), 1) == 0:
            known = float(np.count_nonzero(belief.grid.classes() == FREE)) * belief.grid.resolution**2
            if known >= self._known_m2 + self.config.new_m2:
                self._known_m2, self._news_at, self._longest_m = known, self._time, 0.0
            without_news = self._time - self._news_at
            without_hope = min(without_news, self._time - self._hoped_at)
            hopeful_s = self.config.hopeful_s + self.config.hopeful_s_per_m * self._longest_m
            given_up = without_hope > self.config.patience_s or without_news > hopeful_s
            self._status = "covered" if given_up else "driving"
        return self.ended

    def _complete(self, observation: Mapping[str, Any] | None, belief: Belief) -> dict[str, Any]:
        """Return an observation in which all is there, and the scan is one of the lidar that was trained with."""
        given = dict(observation or {})
        seen: dict[str, Any] = {
            "scan": np.ones(BEAMS, np.float32), "landmarks": np.zeros((1, 6), np.float32),
            "pose_cov": np.asarray(belief.pose_cov)[np.triu_indices(3)].astype(np.float32), "twist": self._sent,
            "progress": np.zeros(2, np.float32),
        }  # fmt: skip
        scan = scan_shares(given, self._lidar)
        if scan is not None:
            given["scan"] = self._scan(scan.astype(np.float32))
        return seen | given

    def _scan(self, scan: Floats) -> Floats:
        lidar = self._lidar
        if lidar.beams == BEAMS and lidar.field_of_view_deg == 360.0 and lidar.range_max_m == RANGE_M:
            return scan
        angles = -math.pi + np.arange(BEAMS) * (2.0 * math.pi / BEAMS)
        nearest = np.round((angles - lidar.angle_min) / lidar.angle_increment).astype(np.int64)
        if lidar.field_of_view_deg == 360.0:
            nearest %= lidar.beams  # behind the last beam comes the first
        inside = (nearest >= 0) & (nearest < lidar.beams)
        out = np.ones(BEAMS, np.float32)
        hit = scan[np.where(inside, nearest, 0)]
        out[inside & (hit < 1.0)] = np.minimum(hit * lidar.range_max_m / RANGE_M, 1.0)[inside & (hit < 1.0)]
        return out


def _goal(way: Plan, belief: Belief) -> Goal:
    pose = np.asarray(belief.pose, dtype=np.float64)
    path: Array = pose[:2] + way.path @ geometry.rotation(float(pose[2])).T
    along = path[-1] - path[-2]
    return Goal(pose=np.array([*path[-1], math.atan2(along[1], along[0])]), path=path)
