"""One robot of a team: a single environment whose lidar sees the others, and whose map is the team's."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mecanum_env.config import EnvConfig
from mecanum_env.env import ExploreEnv
from mecanum_env.ground_truth import Coverage, GroundTruth
from mecanum_env.observation import Observation
from mecanum_env.physics.fleet import Fleet
from mecanum_env.physics.floor import Floor
from mecanum_env.rooms.floor_plan import FloorPlan
from mecanum_env.team.config import TeamConfig
from mecanum_env.team.knowledge import Knowledge
from slam.belief import Belief
from slam.geometry import wrap_scalar
from slam.grids.occupancy import OccupancyGrid
from slam.types import Scan, Sighting

__all__ = ["Member", "member_observation_space"]

Array = NDArray[np.float64]

_NO_CIRCLES = np.zeros((0, 3))
_FAR = 1e3  # [m, s] bound of what is observed of teammates


def member_observation_space(single: spaces.Dict, robots: int) -> spaces.Dict:
    """Return the space of a member's observations: a single robot's, and ``teammates`` where there are others.

    Rows of ``teammates`` ``(robots - 1, 6)``, the others by rising number: 1 where it is known, x, y [m] in this
    robot's frame, cosine and sine of its heading there, and how old that is [s].
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
    """

    knowledge: Knowledge

    def __init__(self, number: int, team: TeamConfig, *, action: str, config: EnvConfig) -> None:
        super().__init__(action=action, config=config)
        self.number, self._team = number, team
        single = cast("spaces.Dict", self.observation_space)
        self.observation_space = cast("Any", member_observation_space(single, team.robots))
        self.sightings: tuple[Sighting, ...] = ()

    # ---- an episode ----------------------------------------------------------------------------------------

    def place(
        self, plan: FloorPlan, seed: int, *, floor: Floor | None, ground: GroundTruth | None,
        start_error: Array, step_limit: int,
    ) -> None:  # fmt: skip
        """Put the robot at the plan's start.

        Parameters
        ----------
        floor, ground : optional
            Of the first robot, where they are shared: the floor that all stand on, and the truth in the frame
            that all beliefs are in.
        start_error : Array
            ``(3,)`` by which the start is believed to be elsewhere [m, m, rad].
        step_limit : int
            Steps of the episode.
        """
        self._shared_ground, self._start_error = ground, start_error
        self._step_limit = step_limit
        self.sightings = ()
        self._set_up(plan, seed, floor)
        self._sighting_rng = np.random.default_rng(np.random.SeedSequence([seed, 1]))

    def join(self, fleet: Fleet, ground: GroundTruth) -> None:
        """Take note of the other robots, and of the frame of the team's first one."""
        self._fleet = fleet
        plan = ground.plan
        # The other bodies' sides behind the plan's surfaces.
        self._surfaces = np.vstack([plan.segments, np.zeros((4 * (self._team.robots - 1), 4))])
        self._others = [k for k in range(self._team.robots) if k != self.number]
        frame_known = self._shared_ground is not None or self.number == 0
        self.knowledge = Knowledge(self.number, self.backend, self._team, frame_known=frame_known)

    def first_look(self) -> dict[str, Any]:
        """Take the first scan; return the first info."""
        return self._first_look()

    def wheel_targets(self, action: NDArray[np.float32]) -> Array:
        """Return the wheels' speeds ``(4,)`` [rad/s] that an action asks for."""
        return np.asarray(self._to_wheels(action), np.float64)

    def perceive(self, collisions: int) -> dict[str, Any]:
        """Sense what a step brought; return its info. There were so many collisions before."""
        return self._perceive(collisions)

    def observe(self) -> Observation:
        """Return the observation of what is sensed, believed and known of the team now."""
        observation = self._observe()
        if self._team.robots > 1:
            observation["teammates"] = self._observed_teammates()
        return observation

    def _ground_truth(self, plan: FloorPlan) -> GroundTruth:
        return super()._ground_truth(plan) if self._shared_ground is None else self._shared_ground

    def _start_backend(self, start: Array, seed: int) -> None:
        team = self._team
        if self._shared_ground is None or not (team.start_sigma_m or team.start_sigma_rad):
            super()._start_backend(start, seed)
            return
        believed = start + self._start_error
        believed[2] = wrap_scalar(believed[2])
        sigmas = np.maximum((team.start_sigma_m, team.start_sigma_m, team.start_sigma_rad), 1e-4)
        self.backend.reset(believed, pose_cov=np.diag(np.square(sigmas)), seed=seed)

    # ---- the others ----------------------------------------------------------------------------------------

    def _look(self) -> tuple[Scan, Scan]:
        """Take a scan in which the other robots stand, and one without what came back from them.

        They bear reflective markers: the lidar knows by the strength of a return that it came from a robot.
        """
        if self._team.robots == 1:
            return super()._look()
        plan, pose = self.truth.ground.plan, self.truth.world.pose
        outlines = self._fleet.outlines()[self._others]
        self._surfaces[len(plan.segments) :] = outlines.reshape(-1, 4)
        scan = self.lidar.scan(self._surfaces, plan.circles, pose, self._sensor_rng)
        noise = self._sighting_rng.standard_normal((len(self._others), 3))  # whatever there is to see
        self.sightings = ()
        ranges = np.array([self.lidar.true_ranges(sides, _NO_CIRCLES, pose) for sides in outlines])
        nearest = ranges.min(axis=0)
        if not np.isfinite(nearest).any():
            return scan, scan
        returned = nearest < self.lidar.true_ranges(plan.segments, plan.circles, pose)
        seen = ((ranges == nearest) & returned).any(axis=1)
        self.sightings = tuple(self._sight(k, noise[i]) for i, k in enumerate(self._others) if seen[i])
        return scan, scan._replace(ranges=np.where(returned, np.nan, scan.ranges))

    def _sight(self, other: int, noise: Array) -> Sighting:
        """Measure another robot: range, bearing and relative heading."""
        x, y, theta = self.truth.world.pose.tolist()
        ox, oy, otheta = self._fleet.worlds[other].pose.tolist()
        exact = np.hypot(ox - x, oy - y), np.arctan2(oy - y, ox - x) - theta, otheta - theta
        sigmas = self._team.sighting.sigmas
        measured = np.array(exact) + sigmas * noise
        measured[1:] = [wrap_scalar(float(angle)) for angle in measured[1:]]
        return Sighting(other, measured, np.diag(sigmas**2))

    def _observed_teammates(self) -> NDArray[np.float32]:
        out = np.zeros((self._team.robots - 1, 6), np.float32)
        x, y, theta = self._pose.tolist()
        c, s = np.cos(theta), np.sin(theta)
        for mate in self.belief.teammates:
            dx, dy, turn = mate.pose[0] - x, mate.pose[1] - y, mate.pose[2] - theta
            row = (1.0, c * dx + s * dy, c * dy - s * dx, np.cos(turn), np.sin(turn), mate.age_s)
            out[self._others.index(mate.robot)] = np.clip(row, -_FAR, _FAR)
        return out

    # ---- what the robot goes by ----------------------------------------------------------------------------

    @property
    def own_coverage(self) -> Coverage:
        """What its own map covers."""
        return self._coverage

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
        teammates = self.knowledge.teammates(self._steps * self.config.step_s)
        return own.in_team(self.number, self.knowledge.grid, teammates)
