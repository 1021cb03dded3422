"""Each step judged from outside: what is seen, paid and believed, walls, contacts; and a digest of it all."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from mecanum_env.env import ExploreEnv
from mecanum_env.physics.world import CONTACT_GAP_S, MAX_TRAVEL_M
from slam.belief import Belief
from slam.types import Array
from training.studies.reliability.steps.geometry import gap, went_through
from training.studies.reliability.steps.quick import QuickSpace, surely_covariance

__all__ = ["Findings", "Watch", "check_belief", "check_metrics"]

DEEPEST_M = 2.0 * MAX_TRAVEL_M
"""A surface may reach as deep into the body: a physics step's way into it from each side."""

_LANDMARKS_EVERY, _WHOLE_EVERY = 25, 200  # steps: copying them takes as long as a step, or many
_SOON = 1.5  # times its fastest: no point of a body moves faster than that, thrown back or not
_TOUCHED_M = 2e-5  # what pymunk's rounding of walls may hide
_NO_SIDES = np.zeros((0, 4))


class Findings:
    """What was found wrong in an item, the digest of all that came out of it, and what was counted on the way."""

    def __init__(self) -> None:
        self.wrong: dict[str, str] = {}
        self.steps = self.episodes = self.collisions = self.refused = 0
        self.deepest_m = 0.0
        self._digest = hashlib.blake2b(digest_size=16)

    def note(self, what: str, where: str) -> None:
        """Note that something is wrong; of each kind the first is kept."""
        self.wrong.setdefault(what, where)

    def feed(self, observation: Mapping[str, Any], *numbers: float) -> None:
        """Take an observation and numbers into the digest."""
        for key in sorted(observation):
            self._digest.update(np.ascontiguousarray(observation[key]).data)
        self._digest.update(np.array(numbers, np.float64).tobytes())

    @property
    def digest(self) -> str:
        """The digest so far."""
        return self._digest.hexdigest()


class Watch:
    """Judges an environment after its reset; ``others`` gives the sides ``(n, 4)`` [m] of other bodies."""

    def __init__(
        self, env: ExploreEnv, found: Findings, space: spaces.Dict, others: Callable[[], Array] = lambda: _NO_SIDES
    ) -> None:
        self._env, self._found, self._space, self._others = env, found, space, others
        self._quick = QuickSpace(space)
        robot, plan = env.config.robot, env.truth.plan
        self._segments, self._circles = plan.segments, plan.circles
        self._half = 0.5 * robot.length_m, 0.5 * robot.width_m
        self._k = 0
        self._at, self._gap = env.truth.world.pose, self._gap_now()
        # What moves towards the body moves as fast.
        self._reach = _SOON * env.truth.world.fastest_m_s * env.config.step_s * (1 + bool(len(others())))
        self._clear_s = math.inf
        self._owed_above: int | None = None
        self._count = 0

    def first(self, observation: Mapping[str, Any], info: Mapping[str, Any]) -> None:
        """Judge what a reset returned."""
        self._see(observation, 0.0, info)

    def step(self, observation: Mapping[str, Any], reward: float, info: Mapping[str, Any]) -> None:
        """Judge what a step returned, and where it has led."""
        self._k += 1
        self._found.steps += 1
        self._walls()
        self._contacts(info["collisions"])
        self._see(observation, reward, info)

    def _see(self, observation: Mapping[str, Any], reward: float, info: Mapping[str, Any]) -> None:
        found, where = self._found, f"step {self._k}"
        if not (self._quick.surely_contains(observation) or self._space.contains(observation)):
            found.note("an observation is not in its space", f"{where}: {_outside(self._space, observation)}")
        numbers = [float(v) for key, v in sorted(info.items()) if isinstance(v, int | float) and key != "nees"]
        numbers += [float(v) for v in info.get("reward_terms", {}).values()] + info["true_pose"].tolist()
        if not all(map(math.isfinite, (reward, *numbers))):
            found.note("reward or info is not finite", f"{where}: {reward}, {dict(info)}"[:300])
        found.feed(observation, reward, *numbers)
        check_belief(self._env, self._k, found)

    def _gap_now(self) -> float:
        pose, others = self._env.truth.world.pose, self._others()
        nearest = gap(pose, *self._half, self._segments, self._circles)
        return min(nearest, gap(pose, *self._half, others, self._circles[:0])) if len(others) else nearest

    def _walls(self) -> None:
        pose, found = self._env.truth.world.pose, self._found
        if not all(map(math.isfinite, pose.tolist())):
            found.note("the true pose is not finite", f"step {self._k}: {pose}")
        elif went_through(self._at, pose, self._segments, self._circles):
            found.note("a wall was passed", f"step {self._k}: from {self._at} to {pose}")
        now = self._gap_now()
        self._was, self._gap, self._at = self._gap, now, pose
        found.deepest_m = max(found.deepest_m, -now)
        if now < -DEEPEST_M:
            found.note("a surface is deep in the body", f"step {self._k}: {-1e3 * now:.1f} mm at {pose}")

    def _contacts(self, count: int) -> None:
        """Hold the count of contacts against what is seen of the gap at the steps' ends.

        Where the gaps at both ends of a step are wider than any way there and back, nothing was touched in it.
        After so much of that that the next contact is a new one, a touch has to be counted.
        """
        found, step_s = self._found, self._env.config.step_s
        if self._gap + self._was > self._reach:
            if count > self._count:
                found.note("a contact with nothing", f"step {self._k}: nothing within {self._gap:.3f} m")
            self._clear_s += step_s
            if self._clear_s > CONTACT_GAP_S + 1e-6:
                self._owed_above = None
        else:
            if self._clear_s > CONTACT_GAP_S + 1e-6:
                self._owed_above = self._count
            self._clear_s = 0.0
        if self._gap < -_TOUCHED_M and self._owed_above is not None and count <= self._owed_above:
            found.note(
                "a contact was not counted", f"step {self._k}: {-1e3 * self._gap:.2f} mm deep, {count} so far"
            )
        found.collisions += count - self._count
        if count < self._count:
            found.note("contacts were counted back", f"step {self._k}: {self._count} → {count}")
        self._count = count


def check_belief(env: ExploreEnv, k: int, found: Findings) -> None:
    """Judge a belief: finite, covariances symmetric and positive; landmarks and all of it at some steps only."""
    belief, where = env.belief, f"step {k}"
    if not all(map(math.isfinite, belief.pose.tolist())):
        found.note("the believed pose is not finite", f"{where}: {belief.pose}")
    if not 0.0 <= belief.health <= 1.0:
        found.note("health is no probability", f"{where}: {belief.health}")
    _check_cov(belief.pose_cov, "the pose's", where, found)
    if k % _LANDMARKS_EVERY == 0:
        _check_landmarks(belief, where, found)
    if k % _WHOLE_EVERY == 0 and belief.whole_cov is not None:
        _check_cov(belief.whole_cov, "the whole", where, found)
    if k % _WHOLE_EVERY == 0 and belief.joint_cov is not None:
        _check_cov(belief.joint_cov, "the joint", where, found)


def check_metrics(info: Mapping[str, Any], found: Findings) -> None:
    """Judge what an episode's last info says of it."""
    metrics = info.get("episode_metrics")
    if metrics is None or "is_success" not in info:
        found.note("an episode ended without metrics", f"episode {found.episodes}")
    elif bad := [key for key, value in metrics.items() if value is not None and not math.isfinite(value)]:
        found.note("metrics are not finite", f"episode {found.episodes}: {bad}")


def _check_landmarks(belief: Belief, where: str, found: Findings) -> None:
    for name in ("landmarks", "lines", "line_ends"):
        if not np.isfinite(getattr(belief, name)).all():
            found.note(f"{name} are not finite", where)
    if len(set(belief.landmark_ids.tolist())) < len(belief.landmarks):
        found.note("two landmarks have one number", where)
    for cov in belief.landmark_cov:
        _check_cov(cov, "a landmark's", where, found)


def _check_cov(cov: Array, what: str, where: str, found: Findings) -> None:
    if surely_covariance(cov) or not cov.any():  # nothing at all is a covariance, too
        return
    if not np.isfinite(cov).all():
        found.note(f"{what} covariance is not finite", where)
        return
    scale = float(np.abs(cov).max())
    if np.abs(cov - cov.T).max() > 1e-9 * scale:
        found.note(f"{what} covariance is not symmetric", f"{where}: by {np.abs(cov - cov.T).max() / scale:.1e}")
    least = float(np.linalg.eigvalsh(cov)[0])
    if least < -1e-9 * scale:
        found.note(f"{what} covariance is not positive", f"{where}: least eigenvalue {least:.1e} of {scale:.1e}")


def _outside(space: spaces.Dict, observation: Mapping[str, Any]) -> str:
    if not isinstance(observation, Mapping) or set(observation) != set(space.spaces):
        return f"its keys are {sorted(observation)}"
    told = []
    for key, box in space.items():
        value = observation[key]
        if not box.contains(value):
            told.append(f"{key} {value.dtype} {value.shape} in [{np.min(value):.4g}, {np.max(value):.4g}]")
    return ", ".join(told)
