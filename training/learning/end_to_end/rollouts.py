"""Episodes of the end-to-end policy: to learn from, driven by student and teacher in turn, or to judge it by."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.learned.drive_network import DriveNetwork
from mecanum_env.env import ExploreEnv
from training.episodes.explore import make_agent
from training.learning.end_to_end.config import DriveConfig
from training.learning.end_to_end.lessons import FollowingTeacher, map_lessons

__all__ = ["Episode", "Outcome", "give_lessons", "guided_lessons", "judge"]

Weights = Mapping[str, NDArray[np.float32]]

_SEGMENT_S = (1.0, 5.0)  # how long one of the two drives
_SHAKE = (0.4, 0.4, 1.0)  # how far a disturbance goes, of the limits
_PAUSE_S = 10.0  # before the first disturbance, on average
_MAPS_S = 1.0  # between two lessons on the maps


@dataclass(frozen=True)
class Episode:
    """One episode: who drives, where, and how long."""

    config: DriveConfig
    weights: Weights
    rooms: str
    room_seed: int
    seed: int
    time_limit_s: float
    teacher_share: float = 0.0  # of the time, that the teacher drives

    @property
    def network(self) -> DriveNetwork:
        """The student."""
        config = self.config
        return DriveNetwork(self.weights, config.planning, uncertainty=config.uncertainty)


class Outcome(NamedTuple):
    """How an episode went."""

    time_to_90_s: float | None
    collisions: int


Rows = dict[str, NDArray[Any]]


def guided_lessons(episode: Episode) -> tuple[Rows, Rows, Outcome]:
    """Have the teacher explore in its own way; return the lessons on maps, no others, and how it went."""
    scene = _Scene(episode)
    while not scene.over:
        scene.note_maps()
        scene.step(scene.guide.act(scene.observation, scene.env.belief))
    return _stacked(scene.maps), {}, scene.outcome


def give_lessons(episode: Episode) -> tuple[Rows, Rows, Outcome]:
    """Have student and teacher drive in turn; return the lessons on maps and on control, and how it went."""
    scene, network = _Scene(episode), episode.network
    follow, memory = FollowingTeacher(scene.env), network.memory(step_s=scene.env.config.step_s)
    rows: list[dict[str, Any]] = []
    switch_at, teacher_drives = 0.0, True
    while not scene.over:
        scene.guide.looked(scene.env.belief)
        scene.note_maps()
        observation = scene.observation
        way = memory.way(scene.env.belief)
        inputs = network.inputs(observation, way)
        wanted = follow(way.path, scene.action, observation, scene.env.belief)
        scan, landmarks = (x.astype(np.float16) for x in (observation["scan"], inputs.landmarks))
        rows.append({"scan": scan, "landmarks": landmarks, "numbers": inputs.numbers, "wanted": wanted})
        if scene.time_s >= switch_at:
            teacher_drives = bool(scene.rng.random() < episode.teacher_share)
            switch_at = scene.time_s + float(scene.rng.uniform(*_SEGMENT_S))
        scene.step(wanted if teacher_drives else network.twist(inputs))
    return _stacked(scene.maps), _stacked(rows), scene.outcome


class _Drive:
    """An episode under way: what is seen, and how it goes."""

    def __init__(self, episode: Episode) -> None:
        self._episode, world = episode, episode.config.world
        limit = {"time_limit_s": episode.time_limit_s}
        self.env = ExploreEnv(rooms=episode.rooms, slam=world.slam, noise=world.noise, config=limit)
        observation, _ = self.env.reset(seed=episode.seed, options={"room_seed": episode.room_seed})
        self.observation: dict[str, Any] = dict(observation)
        self.time_s, self._terminated = 0.0, False
        self.outcome = Outcome(None, 0)

    @property
    def over(self) -> bool:
        """Whether it has come to its end."""
        return self._terminated or self.time_s >= self._episode.time_limit_s - 1e-9

    def step(self, action: NDArray[np.float32]) -> None:
        """Act."""
        observation, _, self._terminated, _, info = self.env.step(action)
        self.observation, self.time_s = dict(observation), info["time_s"]
        reached = self.outcome.time_to_90_s
        if reached is None and info["coverage"] >= 0.9:
            reached = self.time_s
        self.outcome = Outcome(reached, info["collisions"])


class _Scene(_Drive):
    """An episode to learn from: what was noted, and the disturbances."""

    def __init__(self, episode: Episode) -> None:
        super().__init__(episode)
        self.rng = np.random.default_rng(episode.seed)
        self._lessons = episode.config.lessons
        self.guide = make_agent(self._lessons.teacher, self.env)
        self.guide.reset(self.env.belief, episode.seed)
        self.action: NDArray[np.float32] = np.zeros(3, np.float32)
        self.maps: list[dict[str, Any]] = []
        self._maps_at = 0.0
        self._shake, self._shake_end = np.zeros(3), 0.0
        first = float(self.rng.exponential(_PAUSE_S))
        self._shake_at = first if self._lessons.shaken > 0.0 else math.inf

    def note_maps(self) -> None:
        """Keep a lesson on the maps, if one is due."""
        if self.time_s >= self._maps_at:
            self.maps += map_lessons(self.guide, self.env, self.rng)
            self._maps_at = self.time_s + _MAPS_S

    def step(self, action: NDArray[np.float32]) -> None:
        """Act, disturbed now and then."""
        if self.time_s >= self._shake_at:
            length = float(self.rng.uniform(0.5, 2.0))
            self._shake_end = self.time_s + length
            pause = length * (1.0 / max(self._lessons.shaken, 1e-3) - 1.0)
            self._shake_at = self._shake_end + float(self.rng.exponential(pause))
            self._shake = self.rng.uniform(-1.0, 1.0, 3) * _SHAKE
        if self.time_s < self._shake_end:
            action = np.clip(0.5 * action + self._shake, -1.0, 1.0).astype(np.float32)
        self.action = action
        super().step(action)


def judge(episode: Episode) -> Outcome:
    """Drive an episode by the network alone, and return how it went."""
    drive, network = _Drive(episode), episode.network
    memory = network.memory(step_s=drive.env.config.step_s)
    while not drive.over:
        drive.step(network.twist(network.inputs(drive.observation, memory.way(drive.env.belief))))
    return drive.outcome


def _stacked(rows: list[dict[str, Any]]) -> dict[str, NDArray[Any]]:
    return {key: np.stack([row[key] for row in rows]) for key in rows[0]}
