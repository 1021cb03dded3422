"""Whether the maps of two robots are merged rightly that know nothing of each other's start.

``mecanum study merging --out out/merging`` lets two robots explore the same room, one after the other, from
different starts with their own noise, each with its own filter alone. Then one is asked where the other's frame
lies (slam.teams.alignment), and their maps are merged (slam.teams.fusion): once knowing nothing, once with starts
that were measured to within :data:`PRIOR_SIGMA`.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer

from mecanum_env.arguments import make_config
from mecanum_env.env import ExploreEnv
from mecanum_env.rooms.floor_plan import FloorPlan
from slam.accounts.account import Account
from slam.accounts.corners import CornerConfig, settled
from slam.geometry import compose, inverse, transform_points, wrap
from slam.grids.occupancy import FREE, OccupancyGrid
from slam.metrics.measures import nees_pose
from slam.settings import to_mapping
from slam.teams.alignment import Alignment, AlignmentConfig, align
from slam.teams.fusion import MergedMap, fuse
from slam.types import Array
from training.episodes.explore import make_agent
from training.episodes.room_pictures import parse_seeds
from training.figures.tables import markdown_table, number
from training.runs.campaign import keep_settings, made_by
from training.runs.errors import bad_input
from training.runs.options import Out, Ray, Seeds, Workers, workers_of
from training.runs.rows import resume
from training.runs.running import write_json
from training.studies.exploring import AGENT

__all__ = ["PRIOR_SIGMA", "RIGHT_M", "RIGHT_RAD", "run_job", "study", "summarise"]

RIGHT_M, RIGHT_RAD = 0.15, math.radians(3.0)
"""An alignment is right where it is off by less."""
PRIOR_SIGMA = (0.1, 0.1, math.radians(2.0))
"""1σ [m, m, rad] of where starts are known to be, where they are."""

FILES = ("merging.json", "pairs.jsonl")
SLAM = "invariant-ekf"
_CLEARANCE_M = 0.6  # of the second robot's start
_SAME_CORNER_M = 0.3  # a mapped corner is the nearest true one, if no farther
_FALSE_M = 0.08  # … and a false one, made by two surfaces that do not meet, if farther than this

Job = tuple[str, int, float, float]  # rooms, seed of the room, coverage and time [s] at which a robot stops
Row = dict[str, Any]


class _Told(NamedTuple):
    """What one robot has to tell, and the truth about it."""

    account: Account
    grid: OccupancyGrid
    start_world: Array
    pose: Array  # true one in its start frame
    corners: Array  # true ones in its start frame
    coverage: float


def run_job(job: Job) -> Row:
    """Let two robots explore one room; return how their maps were aligned and merged."""
    rooms, seed, coverage, time_s = job
    env = ExploreEnv(rooms=rooms, slam=SLAM)
    env.reset(seed=seed, options={"room_seed": seed})
    plan, rng = env.truth.plan, np.random.default_rng((seed, 0x7EA3))
    starts = plan.start, _free_place(plan, env.config.robot.inscribed_radius_m, rng)
    a, b = (_explore(env, seed, k, start, coverage, time_s) for k, start in enumerate(starts))
    true = compose(inverse(a.start_world), b.start_world)
    row: Row = {
        "coverages": [a.coverage, b.coverage], "times_s": [a.account.stamp, b.account.stamp],
        "corners": [len(a.account.points), len(b.account.points)], "overlap": _overlap(a.grid, b.grid, true),
    }  # fmt: skip
    error = rng.normal(size=3) * PRIOR_SIGMA
    prior = true + error, np.diag(np.square(PRIOR_SIGMA))
    for name, known in (("unknown", None), ("known", prior)):
        found = align(a.account, b.account, grids=(a.grid, b.grid), prior=known)
        row[name] = {"outcome": "none"} if found is None else _judged(found, a, b, true, known)
    return row


def _free_place(plan: FloorPlan, radius_m: float, rng: np.random.Generator) -> tuple[float, float, float]:
    """Draw a pose that the robot can reach from the plan's start."""
    reachable = plan.reachable(radius_m, np.array(plan.start))
    cells = np.argwhere(reachable & (plan.clearance() >= _CLEARANCE_M))
    x, y = (rng.choice(cells)[::-1] + 0.5) * plan.resolution + np.array(plan.origin)
    return float(x), float(y), float(rng.uniform(-math.pi, math.pi))


def _explore(
    env: ExploreEnv, room_seed: int, robot: int, start: Iterable[float], coverage: float, time_s: float
) -> _Told:
    """Explore until so much is covered, or so much time has passed."""
    seed, agent = 2 * room_seed + robot + 1, make_agent(AGENT, env)
    observation, info = env.reset(seed=seed, options={"room_seed": room_seed, "start_pose": tuple(start)})
    agent.reset(env.belief, seed=seed)
    ended = False
    while not ended and info["coverage"] < coverage and info["time_s"] < time_s:
        observation, _, ended, _, info = env.step(agent.act(observation, env.belief))
    truth = env.truth
    return _Told(
        Account.of(robot, info["time_s"], env.backend), env.backend.grid, truth.ground.start, truth.pose,
        truth.ground.corners, info["coverage"],
    )  # fmt: skip


def _overlap(a: OccupancyGrid, b: OccupancyGrid, true: Array) -> float:
    """Return the share of the smaller map's free space that the other has free, too."""
    free_a, free_b = a.classes() == FREE, b.classes() == FREE
    cells = a.to_cells(transform_points(true, b.to_points(np.argwhere(free_b))))
    cells = cells[((cells >= 0) & (cells < a.shape)).all(axis=1)]
    return float(free_a[cells[:, 0], cells[:, 1]].sum() / min(free_a.sum(), free_b.sum()))


def _judged(found: Alignment, a: _Told, b: _Told, true: Array, prior: tuple[Array, Array] | None) -> Row:
    error = found.pose - true
    error[2] = wrap(error[2])
    off_m, off_rad = float(np.hypot(*error[:2])), abs(float(error[2]))
    right = off_m < RIGHT_M and off_rad < RIGHT_RAD
    row: Row = {
        "outcome": "right" if right else "wrong", "off_m": off_m, "off_rad": off_rad,
        "nees": float(nees_pose(found.pose, found.cov, true)), "points": len(found.points),
        "walls": len(found.walls), "rival": found.rival, "contradicted": found.contradicted,
    }  # fmt: skip
    frames = None
    if prior is not None:
        frames = {0: (np.zeros(3), np.zeros((3, 3))), 1: prior}
    if right and len(a.corners):  # caves have none
        row |= _merged(fuse([settled(a.account), settled(b.account)], [found], frames=frames), a, b, true)
    return row


def _merged(merged: MergedMap, a: _Told, b: _Told, true: Array) -> Row:
    """Return NEES of the merged corners, of those that both have seen, and of both robots' poses.

    Of corners far from every true one there is no NEES: how many there are is ``corners_nowhere``.
    """
    apart = merged.points[:, None] - a.corners[None]
    nearest = np.linalg.norm(apart, axis=2).argmin(axis=1)
    errors = apart[np.arange(len(nearest)), nearest]
    known = np.linalg.norm(errors, axis=1) < _SAME_CORNER_M
    nees = np.einsum("ni,ni->n", errors, np.linalg.solve(merged.point_covs, errors[..., None])[..., 0])
    both = np.array([len(robots) > 1 for robots in merged.seen_by])
    true_poses = a.pose, compose(true, b.pose)
    return {
        "corner_nees": nees[known].tolist(), "shared_corner_nees": nees[known & both].tolist(),
        "corner_m": np.linalg.norm(errors, axis=1)[known].tolist(),
        "corners_nowhere": int(np.count_nonzero(~known)),
        "pose_nees": [
            float(nees_pose(merged.poses[k], merged.pose_covs[k], pose)) for k, pose in enumerate(true_poses)
        ],
    }  # fmt: skip


# ---- all of them -----------------------------------------------------------------------------------------------


def summarise(rows: Mapping[Job, Row]) -> dict[str, Row]:
    """Return counts and averaged NEES over all pairs, with starts unknown and known."""
    out: dict[str, Row] = {}
    for name in ("unknown", "known"):
        told = [row[name] for row in rows.values()]
        right = [t for t in told if t["outcome"] == "right"]
        missed = [row["overlap"] for row in rows.values() if row[name]["outcome"] == "none"]

        def mean(key: str, dof: int, right: list[Row] = right) -> float | None:
            told = [t[key] for t in right if key in t]
            values = [v for t in told for v in (t if isinstance(t, list) else [t])]
            return statistics.fmean(values) / dof if values else None

        corners = [c for t in right for c in zip(t.get("corner_m", []), t.get("corner_nees", []), strict=True)]
        true = [nees for off, nees in corners if off < _FALSE_M]
        nowhere = sum(t.get("corners_nowhere", 0) for t in right)
        out[name] = {
            **{outcome: sum(t["outcome"] == outcome for t in told) for outcome in ("right", "none", "wrong")},
            "off_m": mean("off_m", 1), "off_deg": None if not right else math.degrees(mean("off_rad", 1) or 0.0),
            "off_m_max": max((t["off_m"] for t in right), default=None),
            "nees": mean("nees", 3), "corner_nees": mean("corner_nees", 2),
            "true_corner_nees": statistics.fmean(true) / 2 if true else None,
            "corners": len(corners) + nowhere, "false_corners": len(corners) - len(true) + nowhere,
            "shared_corner_nees": mean("shared_corner_nees", 2), "corner_m": mean("corner_m", 1),
            "pose_nees": mean("pose_nees", 3),
            "overlap": statistics.fmean(row["overlap"] for row in rows.values()),
            "overlap_of_none": statistics.fmean(missed) if missed else None,
        }  # fmt: skip
    return out


def _table(summary: Mapping[str, Row]) -> str:
    head = [
        "starts", "right", "none", "wrong", "off: mean, max [m]", "off [°]", "NEES/3 of the alignment",
        "NEES/2 of merged corners (of those both saw; without false ones)", "false",
        "NEES/3 of poses", "merged corners off [m]",
    ]  # fmt: skip
    rows = [
        [
            name, str(s["right"]), str(s["none"]), str(s["wrong"]),
            f"{number(s['off_m'], 4)}, {number(s['off_m_max'], 4)}", number(s["off_deg"], 3), number(s["nees"], 2),
            f"{number(s['corner_nees'], 2)} ({number(s['shared_corner_nees'], 2)}; "
            f"{number(s['true_corner_nees'], 2)})",
            f"{s['false_corners']} of {s['corners']}", number(s["pose_nees"], 2), number(s["corner_m"], 4),
        ]
        for name, s in summary.items()
    ]  # fmt: skip
    return markdown_table(head, rows)


def study(
    seeds: Seeds = "10000:10049",
    rooms: Annotated[str, typer.Option(help="Generator of the rooms.")] = "apartment",
    coverage: Annotated[float, typer.Option(min=0.0, max=1.0, help="At which each robot stops …")] = 0.7,
    time_s: Annotated[float, typer.Option(min=0.1, max=1e6, help="… or after so long [s].")] = 100.0,
    workers: Workers = None,
    ray: Ray = None,
    out: Out = Path("out/merging"),
) -> None:
    """Let two robots explore a room each on its own, then align and merge their maps."""
    with bad_input():
        chosen = parse_seeds(seeds)
        make_config(rooms=rooms)
    who = workers_of(workers, ray)
    settings = {
        **made_by(), "slam": SLAM, "agent": AGENT, "rooms": rooms, "coverage": coverage,
        "time_s": time_s, "right": [RIGHT_M, RIGHT_RAD], "prior_sigma": list(PRIOR_SIGMA),
        "alignment": to_mapping(AlignmentConfig()), "corner": to_mapping(CornerConfig()),
    }  # fmt: skip
    keep_settings(out, settings, FILES)
    jobs: list[Job] = [(rooms, seed, coverage, time_s) for seed in chosen]
    rows = resume(out / "pairs.jsonl", jobs, run_job, workers=who, what="pairs")
    summary = summarise(rows)
    write_json(out / "merging.json", {"seeds": seeds, **settings, "summary": summary})
    print(_table(summary))
