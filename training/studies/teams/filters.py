"""``mecanum study team-filters``: robots that explore one apartment, by one filter for all or each by its own.

Each robot is driven by the truth through a copy of the rooms that holds no other robot, and what its wheels and
lidar say goes to all filters alike: those of each robot for itself, and :mod:`slam.teams.centralised` for all.
Where a robot starts is known to every filter with the same error and covariance.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

import slam
from mecanum_env.arguments import make_config
from mecanum_env.env import ExploreEnv
from mecanum_env.rooms import FloorPlan
from mecanum_env.sensing.calibration import backend_settings
from slam.backend import Backend
from slam.gaussian.settings import EkfLinesConfig
from slam.geometry import compose, inverse, wrap
from slam.metrics.measures import ate, heading_errors
from slam.settings import from_mapping
from slam.teams.centralised import JointEkf
from slam.types import Array
from training.episodes.explore import make_agent
from training.episodes.room_pictures import parse_seeds
from training.figures.tables import number, text_table
from training.runs.campaign import keep_settings, made_by
from training.runs.errors import bad_input
from training.runs.options import Out, Ray, Seeds, Workers, workers_of
from training.runs.rows import resume
from training.runs.running import write_json
from training.studies.exploring import AGENT

__all__ = ["SINGLE", "TEAM", "explore", "study", "table"]

Job = tuple[int, int, int, float, float, str]  # room seed, robots, steps, start's σ [m, rad], noise

TEAM, SINGLE = "centralised", ("ekf-lines", "invariant-ekf")
FILE = "team_filters.json"
STORE = "episodes.jsonl"
_CLEARANCE_M = 0.5  # of another robot's start
_STREAM = 1000  # a robot's seed is the room's and as much more for each before it, so that its noise is its own


class _Robot:
    """One robot: its environment, its agent on the true map, and where it is in the frame of the first one."""

    def __init__(self, env: ExploreEnv, seed: int, room_seed: int, start: Array | None) -> None:
        self.env = env
        options: dict[str, Any] = {"room_seed": room_seed}
        if start is not None:
            options["start_pose"] = start.tolist()
        self._observation, _ = env.reset(seed=seed, options=options)
        self._agent = make_agent(AGENT, env)
        self._agent.reset(env.belief, seed=seed)
        self._idle, self.done = 0, False

    def step(self) -> None:
        action = self._agent.act(self._observation, self.env.belief)
        self._observation, _, ended, _, _ = self.env.step(action)
        self._idle = self._idle + 1 if self._agent.goal is None else 0
        self.done = ended or self._idle > 20

    def pose(self, frame: Array) -> Array:
        """Return the true pose in the frame of a world pose."""
        return compose(inverse(frame), self.env.truth.world.pose)


def _another_start(plan: FloorPlan, rng: np.random.Generator) -> Array:
    """Return a pose in the world frame that can be reached from the plan's start, any of them alike."""
    cells = np.argwhere(plan.reachable(_CLEARANCE_M, np.array(plan.start)))
    row, col = cells[rng.integers(len(cells))]
    x, y = (np.array([col, row]) + 0.5) * plan.resolution + plan.origin
    return np.array([x, y, rng.uniform(-math.pi, math.pi)])


def explore(job: Job) -> dict[str, dict[str, Any]]:
    """Explore one room with all robots; return per filter what :func:`table` averages, a list entry a robot."""
    room_seed, many, steps, sigma_m, sigma_rad, noise = job
    envs = [ExploreEnv(rooms="apartment", slam="truth", noise=noise) for _ in range(many)]
    rng = np.random.default_rng([room_seed, many])
    robots = [_Robot(envs[0], room_seed, room_seed, None)]
    plan = envs[0].truth.plan
    for i in range(1, many):
        robots.append(_Robot(envs[i], room_seed + _STREAM * i, room_seed, _another_start(plan, rng)))
    frame = robots[0].env.truth.ground.start.copy()
    starts = np.array([r.pose(frame) for r in robots])
    covs = np.repeat(np.diag([1e-4, 1e-4, 1e-4])[None] ** 2, many, axis=0)
    covs[1:] = np.diag([sigma_m, sigma_m, sigma_rad]) ** 2
    guess = starts.copy()
    guess[1:] += rng.standard_normal((many - 1, 3)) * [sigma_m, sigma_m, sigma_rad]
    guess[:, 2] = wrap(guess[:, 2])

    def settings(name: str) -> dict[str, Any]:
        return backend_settings(make_config(rooms="apartment", slam=name, noise=noise))

    team = JointEkf(many, from_mapping(EkfLinesConfig, settings("ekf-lines")))
    team.reset(guess, covs)
    filters: dict[str, list[Backend]] = {TEAM: list(team.members)}
    for name in SINGLE:
        told = settings(name) | ({"wheel_states": False} if name == "ekf-lines" else {})  # a team has none, either
        filters[name] = [slam.make(name, config=told) for _ in robots]
        for backend, pose, cov in zip(filters[name], guess, covs, strict=True):
            backend.reset(pose, pose_cov=cov)
    true: list[list[Array]] = [[] for _ in robots]
    poses: dict[str, list[list[Array]]] = {name: [[] for _ in robots] for name in filters}
    nees: dict[str, list[list[float]]] = {name: [[] for _ in robots] for name in filters}
    joint: list[float] = []
    took: dict[str, list[float]] = {name: [] for name in filters}
    for k in range(steps + 1):
        going = [i for i, r in enumerate(robots) if not r.done]
        if not going:
            break
        for i in going:
            if k:
                robots[i].step()
            env, pose = robots[i].env, robots[i].pose(frame)
            true[i].append(pose)
            for name, members in filters.items():
                began = time.perf_counter()
                if k:
                    members[i].predict(env.odometry)
                members[i].update(env.scan)
                took[name].append(time.perf_counter() - began)
                poses[name][i].append(members[i].pose)
                if k:
                    nees[name][i].append(members[i].pose_nees(pose))
        if k:
            error = team.poses - [r.pose(frame) for r in robots]
            error[:, 2] = wrap(error[:, 2])
            joint.append(float(error.ravel() @ np.linalg.solve(team.joint_pose_cov(), error.ravel())))

    def each(measure: Callable[[str, int], float]) -> dict[str, list[float]]:
        return {name: [measure(name, i) for i in range(many)] for name in filters}

    rows = {
        "nees": each(lambda name, i: float(np.mean(nees[name][i]) / 3)),
        "ate_m": each(lambda name, i: ate(np.array(true[i]), np.array(poses[name][i]))),
        "heading_rad": each(
            lambda name, i: float(
                np.sqrt(np.mean(heading_errors(np.array(true[i]), np.array(poses[name][i])) ** 2))
            )
        ),
        "end_m": each(lambda name, i: float(np.hypot(*(true[i][-1] - poses[name][i][-1])[:2]))),
    }
    return {
        name: {
            **{key: value[name] for key, value in rows.items()},
            "landmarks": [backend.landmark_count for backend in filters[name]],
            "ms": 1e3 * float(np.median(took[name])), "steps": max(map(len, true)) - 1,
            "joint_nees": float(np.mean(joint) / (3 * many)) if name == TEAM else None,
        }
        for name in filters
    }  # fmt: skip


def table(rows: list[dict[str, dict[str, Any]]]) -> str:
    """Return means over the rooms, of the first robot and of all others, a filter and robot a line."""
    lines = []
    for name in rows[0]:
        for which, part in (("first", slice(0, 1)), ("others", slice(1, None))):

            def mean(key: str, name: str = name, part: slice = part) -> float | None:
                values = [v for row in rows for v in row[name][key][part]]
                return float(np.mean(values)) if values else None

            def worst(key: str, name: str = name, part: slice = part) -> float | None:
                return max((v for row in rows for v in row[name][key][part]), default=None)

            together = [row[name]["joint_nees"] for row in rows if row[name]["joint_nees"] is not None]
            lines.append([
                f"{name}, {which}", number(mean("nees"), 2), number(worst("nees"), 1),
                number(float(np.mean(together)) if together and which == "first" else None, 2),
                *(number(v, 1, factor=1e3) for v in (mean("ate_m"), worst("ate_m"), mean("end_m"))),
                number(mean("heading_rad"), 3, factor=180.0 / math.pi),
                number(mean("landmarks"), 0), number(float(np.mean([row[name]["ms"] for row in rows])), 2),
            ])  # fmt: skip
    head = [
        "filter, robot", "NEES/3", "worst", "joint NEES/3N", "ATE mm", "worst", "end mm", "heading °", "landmarks",
        "ms/step",
    ]  # fmt: skip
    return text_table(head, lines)


def study(
    out: Out = Path("out/team_filters"),
    seeds: Seeds = "10000:10015",
    robots: Annotated[int, typer.Option(min=1, max=8, help="How many explore together.")] = 2,
    steps: Annotated[int, typer.Option(min=1, max=1_000_000, help="Most steps of a robot.")] = 3000,
    start_sigma_m: Annotated[float, typer.Option(min=1e-6, max=10, help="Of where the others start [m].")] = 0.02,
    start_sigma_deg: Annotated[
        float, typer.Option(min=1e-6, max=180, help="Of their headings there [degrees].")
    ] = 0.5,
    noise: Annotated[str, typer.Option(help="Noise preset.")] = "nominal",
    workers: Workers = None,
    ray: Ray = None,
) -> None:
    """Explore apartments by several robots; compare one filter for all with a filter each."""
    with bad_input():
        chosen = parse_seeds(seeds)
        make_config(noise=noise)
    who = workers_of(workers, ray)
    keep_settings(out, made_by(), [FILE])
    turn = math.radians(start_sigma_deg)
    jobs: list[Job] = [(seed, robots, steps, start_sigma_m, turn, noise) for seed in chosen]
    rows = list(resume(out / STORE, jobs, explore, workers=who, what="episodes").values())
    print(table(rows))
    write_json(out / FILE, {"jobs": jobs, "rows": rows})
