"""A team of robots in one building: wiring alone, as :class:`mecanum_env.env.ExploreEnv` is of one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium.utils.seeding import np_random

from mecanum_env.arguments import check_arguments, make_config, make_plan, reset_options, room_seed_of
from mecanum_env.config import EnvConfig, Steps
from mecanum_env.ground_truth import GroundTruth
from mecanum_env.observation import Observation
from mecanum_env.physics.fleet import Fleet
from mecanum_env.rooms import FloorPlan
from mecanum_env.sensing.calibration import backend_settings
from mecanum_env.team.communication import groups
from mecanum_env.team.config import Robots, TeamConfig
from mecanum_env.team.coverage import TeamCoverage
from mecanum_env.team.member import Member
from mecanum_env.team.starts import start_poses
from slam.accounts.account import Account
from slam.files import quoted
from slam.gaussian.settings import EkfLinesConfig
from slam.geometry import compose, inverse
from slam.metrics.chi_square import chi2_quantile
from slam.settings import argument, checked, from_mapping
from slam.teams.centralised import JointEkf
from slam.types import Array, Floats

__all__ = ["JOINT_SLAM", "Outcome", "Team"]

JOINT_SLAM = "ekf-lines"
"""The backend that one filter over all robots is."""

_COVER_EVERY_S = 1.0
_GATE = chi2_quantile(0.999, 3)  # of a sighting
_OPTIONS = ("floor_plan", "start_poses", "room_seed")


class Outcome(NamedTuple):
    """What a step brought one robot."""

    observation: Observation
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]


class Team:
    """Robots of one kind that explore one building.

    Each has its own sensors, noise and belief; a team of one is :class:`mecanum_env.env.ExploreEnv`, bit for bit.

    Parameters
    ----------
    robots : int, optional
        How many; what ``team`` says if left out.
    team : TeamConfig or mapping, optional
        Starts, communication, sightings.
    action : str
        ``"twist"`` or ``"wheels"``.
    floor_plan : FloorPlan or path, optional
        Where to explore, instead of rooms that are drawn.
    max_steps : int
        After which the episode is truncated.
    **settings
        Of :func:`mecanum_env.arguments.make_config`; one robot is like the other.
    """

    def __init__(
        self,
        robots: int | None = None,
        *,
        team: TeamConfig | Mapping[str, Any] | None = None,
        action: str = "twist",
        floor_plan: str | Path | FloorPlan | None = None,
        max_steps: int = 3000,
        **settings: Any,
    ) -> None:
        check_arguments(settings, Team)
        self.max_steps = checked("max_steps", Steps, max_steps)
        with argument("team"):
            given = from_mapping(TeamConfig, team)
        self.team = given if robots is None else replace(given, robots=checked("robots", Robots, robots))
        self._plan = floor_plan if isinstance(floor_plan, FloorPlan) else None
        self.config = make_config(floor_plan=floor_plan, **settings)
        self.joint: JointEkf | None = None
        """The one filter of a joint belief."""
        if self.team.belief == "joint":
            slam = settings.get("slam")
            named = slam.get("name") if isinstance(slam, Mapping) else slam
            default = EnvConfig().slam  # in a configuration it stands for none
            if self.config.slam not in (JOINT_SLAM, default) or named == default:
                raise ValueError(
                    f"a joint belief is {JOINT_SLAM} over all robots; slam must be left out or be that"
                )
            self.config = replace(self.config, slam=JOINT_SLAM)
            settings_of_all = from_mapping(EkfLinesConfig, backend_settings(self.config))
            self.joint = JointEkf(self.team.robots, settings_of_all)
        parts = (None,) * self.team.robots if self.joint is None else self.joint.members
        self.members = tuple(
            Member(k, self.team, action=action, config=self.config, backend=part) for k, part in enumerate(parts)
        )
        if self.team.robots > 1 and self.joint is None and not self.team.starts_exact:
            Account.of(0, 0.0, self.members[0].backend)  # raises where frames could not be found
        self._rng: np.random.Generator | None = None
        self.ends_covered = True
        """Whether coverage of the target ends the episode."""
        self.active: list[int] = []
        """Numbers of the robots that are still exploring; the others stand where they ended."""

    # ---- an episode ----------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> list[tuple[Observation, dict[str, Any]]]:
        """Start an episode; return each robot's observation and info.

        ``options`` are ``floor_plan``, ``start_poses`` ``(robots, 3)`` in the plan's frame and ``room_seed``.
        """
        self.active = []
        options = reset_options(options, _OPTIONS)
        if seed is not None:
            self._rng, _ = np_random(seed)
        seed = int(self.np_random.integers(2**31)) if seed is None else int(seed)
        plans = self._plans(options, seed, room_seed_of(options, seed, self._plan))
        config, team = self.config, self.team
        drawn = np.random.default_rng(np.random.SeedSequence([seed, 2])).standard_normal((team.robots, 3))
        sigmas = np.array([team.start_sigma_m, team.start_sigma_m, team.start_sigma_rad])
        first = self.members[0]
        for member, plan in zip(self.members, plans, strict=True):
            k = member.number
            member.place(
                plan, seed if k == 0 else _seed_of(seed, k), first=first if k > 0 else None,
                start_error=sigmas * drawn[k], step_limit=self.max_steps,
            )  # fmt: skip
        if self.joint is not None:
            exact = np.diag(np.full(3, 1e-12))
            covs = [exact if member.start_cov is None else member.start_cov for member in self.members]
            self.joint.reset([member.start for member in self.members], covs, seed)
        self.ground: GroundTruth = first.truth.ground
        """The truth, in the frame of the first robot's start."""
        self.fleet = Fleet([member.truth.world for member in self.members])
        self.coverage = TeamCoverage(self.ground, [member.truth.ground for member in self.members])
        self.active = list(range(team.robots))
        self._steps, self._every = 0, max(1, round(team.communication.every_s / config.step_s))
        self._cover_every = max(1, round(_COVER_EVERY_S / config.step_s))
        self.groups = np.zeros(team.robots, np.int64)
        for member in self.members:
            member.join(self.fleet, self.ground)
        self._show_bodies()
        infos = [member.first_look() for member in self.members]
        self._communicate()
        self._share(infos)
        return [(member.observe(), info) for member, info in zip(self.members, infos, strict=True)]

    def _plans(self, options: Mapping[str, Any], seed: int, room_seed: int) -> list[FloorPlan]:
        """Return the plan with each robot's start."""
        plan = make_plan(self.config, room_seed, given=options.get("floor_plan", self._plan))
        robots, robot = self.team.robots, self.config.robot
        starts = options.get("start_poses")
        if starts is None:
            rng = np.random.default_rng(np.random.SeedSequence([seed, 3]))
            starts = start_poses(plan, robot, robots, scattered=self.team.starts == "scattered", rng=rng)
        try:
            starts = np.asarray(starts, dtype=np.float64)
        except (TypeError, ValueError):
            raise ValueError(f"start_poses must be {robots} poses x, y, θ; got {quoted(starts)}") from None
        if starts.shape != (robots, 3):
            raise ValueError(f"start_poses must be {robots} poses x, y, θ; got shape {starts.shape}")
        plans = [
            plan if k == 0 and tuple(start) == tuple(plan.start)
            else plan.with_start(start.tolist(), clearance_m=robot.inscribed_radius_m)
            for k, start in enumerate(starts)
        ]  # fmt: skip
        if "start_poses" in options:
            parts = [plan.reachable(robot.inscribed_radius_m, start) for start in starts]
            for k, part in enumerate(parts):
                if not (parts[0] & part).any():
                    raise ValueError(f"start_poses: no robot gets from {k} to 0; start all where they can meet")
        return plans

    def step(self, actions: Mapping[int, Floats]) -> dict[int, Outcome]:
        """Act for one control step; ``actions`` and what is returned are by the numbers of the active robots."""
        if not self.active:
            raise RuntimeError("no robot is exploring: the episode is over, or has not begun; call reset()")
        config, active = self.config, [self.members[k] for k in self.active]
        targets: list[Array] = [np.zeros(4)] * len(self.members)  # who has ended stands still
        for member in active:
            targets[member.number] = member.wheel_targets(actions[member.number])
        before = {member.number: member.truth.world.collisions for member in active}
        self.fleet.step(targets, config.step_s, config.physics_step_s)
        self._show_bodies()
        infos = []
        for member in self.members:
            if member.number in before:
                infos.append(member.perceive(before[member.number]))
            else:  # its episode is over, its sensors are on: it may still be rolling, or be pushed
                member.believe()
                member.truth.record.collisions = member.truth.world.collisions
        self._steps += 1
        late = self._steps >= self.max_steps
        self._communicate()
        self._share(infos, last=late)
        covered = self.coverage_share >= config.coverage_target
        outcomes = {}
        for member, info in zip(active, infos, strict=True):
            hit = config.terminate_on_collision and member.truth.world.collisions > 0
            terminated = bool((covered and self.ends_covered) or hit)
            if terminated or late:
                info["is_success"] = bool(covered)
                info["episode_metrics"] = member.episode_metrics()
            reward = float(sum(info["reward_terms"].values()))
            outcomes[member.number] = Outcome(member.observe(), reward, terminated, late, info)
        self.active = [k for k, outcome in outcomes.items() if not (outcome.terminated or outcome.truncated)]
        return outcomes

    # ---- parts of a step -----------------------------------------------------------------------------------

    def _show_bodies(self) -> None:
        """Have every robot's lidar meet the bodies where they are."""
        bodies = self.fleet.outlines()
        for member in self.members:
            member.outlines = bodies

    def _communicate(self) -> None:
        """Have those that hear each other tell what they know."""
        members = self.members
        if len(members) == 1:
            return
        time_s = self._steps * self.config.step_s
        for member in members:
            member.knowledge.see(member.sightings, time_s)
            if self.joint is not None:
                for other, measured, cov in member.sightings:
                    self.joint.members[member.number].see(other, measured, cov, gate=_GATE)
        places = np.array([member.truth.world.pose[:2] for member in members])
        self.groups = groups(self.team.communication, places, self.ground.plan)
        due = self._steps % self._every == 0
        for group in range(int(self.groups.max()) + 1):
            hearing = [member.knowledge for member in members if self.groups[member.number] == group]
            if len(hearing) == 1:
                continue
            if due:
                for knowledge in hearing:
                    knowledge.chart_now(time_s)
            reports = {
                knowledge.robot: knowledge.report(time_s, ended=knowledge.robot not in self.active)
                for knowledge in hearing
            }
            for knowledge in hearing:  # what they have heard of robots that are elsewhere
                for robot, report in knowledge.heard.items():
                    if robot not in reports or reports[robot].time_s < report.time_s:
                        reports[robot] = report
            for knowledge in hearing:
                if knowledge.hear(reports):
                    knowledge.merge(time_s)

    def _share(self, infos: Sequence[dict[str, Any]], *, last: bool = False) -> None:
        """Put what is the team's into the infos of the active robots.

        Where frames differ, or robots map apart from a joint belief, coverage is brought up to date once a second,
        and at the last step.
        """
        apart = self.joint is not None and any(member.apart for member in self.joint.members)
        if len(self.members) == 1 or (self.joint is not None and not apart):
            self.coverage_share = infos[-1]["coverage"]
        else:
            each_step = self.coverage.each_step and not apart
            if each_step or last or self._steps % self._cover_every == 0:
                for member in self.members:
                    changes = None if apart else member.own_coverage.changes
                    self.coverage.update(member.number, changes, member.backend.grid)
            self.coverage_share = self.coverage.share
        collisions = sum(member.truth.world.robot_collisions for member in self.members)
        for info in infos:
            info["team_coverage"] = self.coverage_share
            info["robot_collisions"] = collisions

    @property
    def frames(self) -> list[Array]:
        """The true poses ``(3,)`` of the frames of the robots' beliefs in that of the first robot."""
        back = inverse(self.ground.start)
        return [compose(back, member.truth.ground.start) for member in self.members]

    @property
    def np_random(self) -> np.random.Generator:
        """What draws the seeds of episodes; made when first asked for, so that copies made before have others."""
        if self._rng is None:
            self._rng, _ = np_random()
        return self._rng

    @property
    def time_s(self) -> float:
        """Simulated time since the start [s]."""
        return self._steps * self.config.step_s


def _seed_of(seed: int, number: int) -> int:
    """Return the seed of a robot's own noise."""
    return int(np.random.SeedSequence([seed, 4, number]).generate_state(1)[0] & 0x7FFFFFFF)
