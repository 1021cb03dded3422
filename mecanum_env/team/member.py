"""One robot of a team: a single environment whose lidar sees the others, and whose map is the team's."""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mecanum_env.config import EnvConfig
from mecanum_env.env import ExploreEnv
from mecanum_env.ground_truth import Coverage, GroundTruth
from mecanum_env.observation import Observation
from mecanum_env.physics.fleet import Fleet
from mecanum_env.rooms.floor_plan import FloorPlan
from mecanum_env.step_clock import StepClock
from mecanum_env.team.config import TeamConfig
from mecanum_env.team.knowledge import Knowledge
from slam.backend import Backend
from slam.belief import Belief, Teammate
from slam.geometry import wrap_scalar
from slam.grids.occupancy import OccupancyGrid
from slam.teams.apart import Start
from slam.teams.centralised import JointMember
from slam.types import Array, Floats, Scan, Sighting

__all__ = ["Member", "member_observation_space"]

_LEAST_SIGMA = 1e-4  # [m, rad]: never exactly zero
_FAR = 1e3  # [m, s] bound of what is observed of teammates


def member_observation_space(single: spaces.Dict, robots: int) -> spaces.Dict:
    """Return the space of a member's observations: a single robot's, and ``teammates`` where there are others.

    Rows of ``teammates`` ``(robots - 1, 6)``, the others by rising number: 1 where it is known, x, y [m] in this
    robot's body frame, cosine and sine of its heading there, and how old that is [s].
    """
    if robots == 1:
        return single
    others = spaces.Box(-_FAR, _FAR, (robots - 1, 6), np.float32)
    return spaces.Dict(dict(single.spaces) | {"teammates": others})


class Member(ExploreEnv):
    """One robot of a team. :class:`mecanum_env.team.team.Team` drives it; ``reset`` and ``step`` are not for it.

    Parameters
    ----------
    number : int
        Its number in the team, from 0.
    team : TeamConfig
        The team it is in.
    action : str
        As in :class:`ExploreEnv`.
    config : EnvConfig
        Everything else.
    backend : Backend, optional
        Its part of a joint filter, which its team starts; else it has one of its own.
    """

    knowledge: Knowledge
    start: Array
    """Where it believes that it starts ``(3,)``, in its belief's frame."""
    start_cov: Array | None

    def __init__(
        self, number: int, team: TeamConfig, *, action: str, config: EnvConfig, backend: Backend | None = None
    ) -> None:
        super().__init__(action=action, config=config)
        self.number, self._team, self.joint = number, team, backend is not None
        if backend is not None:
            self.backend = backend
        single = cast("spaces.Dict", self.observation_space)
        self.observation_space = cast("Any", member_observation_space(single, team.robots))
        self.sightings: tuple[Sighting, ...] = ()
        self._sighting_sigmas = team.sighting.sigmas.tolist()
        self._sighting_cov = np.diag(np.square(self._sighting_sigmas))
        self._sighting_cov.flags.writeable = False  # every sighting has it
        self.outlines = np.zeros((team.robots, 4, 4))  # of all bodies, as of now: see Fleet.outlines

    # ---- an episode ----------------------------------------------------------------------------------------

    def place(
        self, plan: FloorPlan, seed: int, *, first: Member | None, start_error: Array, step_limit: int
    ) -> None:
        """Put the robot at the plan's start.

        Parameters
        ----------
        first : Member, optional
            The team's first robot: its floor all stand on, its frame beliefs are in where starts are known.
        start_error : Array
            ``(3,)`` by which the start is believed to be elsewhere [m, m, rad].
        step_limit : int
            Steps of the episode.
        """
        known = first is not None and self._team.known_starts
        self._shared_ground = first.truth.ground if first is not None and known else None
        self._start_error, self._clock, self.sightings = start_error, StepClock(step_limit), ()
        self._set_up(plan, seed, None if first is None else first.truth.world.floor)
        self._shared_coverage = first.own_coverage if first is not None and self.joint else None  # of the one grid
        self._sighting_rng = np.random.default_rng(np.random.SeedSequence([seed, 1]))

    def join(self, fleet: Fleet, ground: GroundTruth) -> None:
        """Take note of the other robots, and of the frame of the team's first one."""
        self._fleet = fleet
        plan = ground.plan
        # The other bodies' sides behind the plan's surfaces.
        self._surfaces = np.vstack([plan.segments, np.zeros((4 * (self._team.robots - 1), 4))])
        self._others = [k for k in range(self._team.robots) if k != self.number]
        start = None if self.start_cov is None else Start(self.start, self.start_cov)
        self.knowledge = Knowledge(self.number, self.backend, self._team, start)

    def believe(self) -> float:
        """Sense what a step brought and believe it; return the coverage.

        What others have drawn on the one map of a joint belief since is no reward of its own.
        """
        if self.joint:
            self._remember()
            before = cast(JointMember, self.backend).apart
        coverage = super().believe()
        if self.joint and cast(JointMember, self.backend).apart != before:
            self._remember()  # its map is another one now
        return coverage

    def wheel_targets(self, action: Floats) -> Array:
        """Return the wheels' speeds ``(4,)`` [rad/s] that an action asks for."""
        return np.asarray(self._to_wheels(action), np.float64)

    def observe(self) -> Observation:
        """Return the observation of what is sensed, believed and known of the team now."""
        observation = super().observe()
        if self._team.robots > 1:
            observation["teammates"] = self._observed_teammates()
        return observation

    def _ground_truth(self, plan: FloorPlan) -> GroundTruth:
        return super()._ground_truth(plan) if self._shared_ground is None else self._shared_ground

    def _start_backend(self, start: Array, seed: int) -> None:
        team = self._team
        self.start, self.start_cov = start, None
        if self._shared_ground is not None and not team.starts_exact:
            self.start = start + self._start_error
            self.start[2] = wrap_scalar(self.start[2])
            sigmas = np.maximum((team.start_sigma_m, team.start_sigma_m, team.start_sigma_rad), _LEAST_SIGMA)
            self.start_cov = np.diag(np.square(sigmas))
        if not self.joint:  # else all start together
            self.backend.reset(self.start, pose_cov=self.start_cov, seed=seed)

    # ---- the others ----------------------------------------------------------------------------------------

    def _look(self) -> tuple[Scan, Scan]:
        """Take a scan in which the other robots stand, and one without what came back from them.

        They bear reflective markers: the lidar knows by the strength of a return that it came from a robot.
        """
        if self._team.robots == 1:
            return super()._look()
        plan, pose = self.truth.ground.plan, self.truth.world.pose
        outlines = self.outlines[self._others]
        self._surfaces[len(plan.segments) :] = outlines.reshape(-1, 4)
        scan = self.lidar.scan(self._surfaces, plan.circles, pose, self._sensor_rng)
        noise = self._sighting_rng.standard_normal((len(self._others), 3)).tolist()  # whatever there is to see
        mapped, seen = self.lidar.without(outlines, plan.segments, plan.circles, pose, scan)
        self.sightings = tuple(self._sight(k, noise[i]) for i, k in enumerate(self._others) if seen[i])
        return scan, mapped

    def _sight(self, other: int, noise: list[float]) -> Sighting:
        """Measure another robot: range, bearing and relative heading."""
        x, y, theta = self.truth.world.pose.tolist()
        other_x, other_y, other_theta = self._fleet.worlds[other].pose.tolist()
        dx, dy = other_x - x, other_y - y
        off = [sigma * by for sigma, by in zip(self._sighting_sigmas, noise, strict=True)]
        bearing = wrap_scalar(math.atan2(dy, dx) - theta + off[1])
        measured = np.array([math.hypot(dx, dy) + off[0], bearing, wrap_scalar(other_theta - theta + off[2])])
        return Sighting(other, measured, self._sighting_cov)

    def _observed_teammates(self) -> Floats:
        rows = [[0.0] * 6] * (self._team.robots - 1)
        x, y, theta = self._pose.tolist()
        c, s = math.cos(theta), math.sin(theta)
        for robot, pose, age_s, *_ in self._teammates():
            mate_x, mate_y, mate_theta = pose.tolist()
            dx, dy, turn = mate_x - x, mate_y - y, mate_theta - theta
            ahead, aside = (min(max(v, -_FAR), _FAR) for v in (c * dx + s * dy, c * dy - s * dx))
            rows[robot - (robot > self.number)] = [
                1.0, ahead, aside, math.cos(turn), math.sin(turn), min(age_s, _FAR)
            ]  # fmt: skip
        return np.array(rows, np.float32)

    def _teammates(self) -> tuple[Teammate, ...]:
        return self.knowledge.teammates(self._steps * self.config.step_s)

    # ---- what the robot goes by ----------------------------------------------------------------------------

    @property
    def map_changes(self) -> NDArray[np.int32] | None:
        """As of a single robot; None where all draw on the one map of a joint belief: any cell may be another."""
        return None if self.joint else super().map_changes

    @property
    def own_coverage(self) -> Coverage:
        """What its own map covers, or of a joint belief that of all that is not apart."""
        shared = self._shared_coverage
        return self._coverage if shared is None or cast(JointMember, self.backend).apart else shared

    @property
    def grid(self) -> OccupancyGrid:
        """The map of all that the robot knows."""
        return self.backend.grid if self._team.robots == 1 else self.knowledge.grid

    @property
    def belief(self) -> Belief:
        """What the robot believes, with the map of all that it knows, and the others."""
        own = self.backend.belief
        if self._team.robots == 1:
            return own
        return own.in_team(self.number, self.knowledge.grid, self._teammates())
